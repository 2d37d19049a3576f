"""Who waits for kernels is told why, and nobody else is."""

from __future__ import annotations

from pathlib import Path

import pytest

from gimp3d.compute import jit


@pytest.mark.parametrize(("compiled", "said"), [(0, 1), (1, 1), (2, 0), (3, 0)])
def test_compilation_is_announced_once_where_most_is_not_compiled_yet(
    compiled: int, said: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some modules are never compiled, such as those that only the paper's preset needs."""
    monkeypatch.setattr(jit, "_announced", False)
    monkeypatch.setattr(jit, "_there", {Path(str(k)): k < compiled for k in range(3)})
    words: list[str] = []
    for _ in range(2):
        jit.announce_compilation(words.append)
    assert len(words) == said

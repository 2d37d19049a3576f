"""Boxes that other users would draw round the same object."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.scenes import read_scene, redrawn, removal
from gimp3d.presets import PRESETS


@pytest.mark.parametrize(("name", "casts"), [("corner", False), ("corner_shadow", True)])
def test_a_shadow_is_found_where_one_is(shared_data: Path, name: str, casts: bool) -> None:
    """In the box of user 1 a lamp explains 1.8 times what chance does of corner, whose object casts no shadow."""
    scene = read_scene(shared_data / "withwithout" / name)
    settings = replace(PRESETS["draft"], inpaint="telea")
    result = removal(scene, settings, region=redrawn(scene.region, 1))
    assert result.shadow["found"] == casts, result.shadow["reason"]

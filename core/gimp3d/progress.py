"""What users are told: how far work is, by a callable that stages call, and what a removal did."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol


class Progress(Protocol):
    """Called as work goes on; may raise Cancelled to stop it."""

    def __call__(self, stage: str, done: int, total: int, message: str = "") -> None: ...


def silent(stage: str, done: int, total: int, message: str = "") -> None:
    """Report nothing."""


def count_words(counts: Mapping[str, int], things: str = "Gaussians") -> str:
    """What a removal did: those that were changed are counted once."""
    gone, new, changed = counts["removed"] - counts["changed"], counts["added"] - counts["changed"], counts["changed"]
    return f"{gone:,} {things} removed, {new:,} added" + (f", {changed:,} round them changed" if changed else "")

"""Boxes that other users would draw round the same object."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.scenes import read_scene, redrawn, removal
from gimp3d.presets import PRESETS

CASTS_NONE, CASTS = ("corner", 1), ("corner_shadow", 1)  # scenes, and numbers of users


@pytest.mark.parametrize(("name", "user", "casts"), [(*CASTS_NONE, False), (*CASTS, True)])
def test_a_shadow_is_found_where_one_is(shared_data: Path, name: str, user: int, casts: bool) -> None:
    """In the box of this user a lamp explains 1.8 times what chance does of corner, whose object casts no shadow."""
    scene = read_scene(shared_data / "withwithout" / name)
    settings = replace(PRESETS["draft"], inpaint="telea")
    result = removal(scene, settings, region=redrawn(scene.region, user))
    assert result.shadow["found"] == casts, result.shadow["reason"]

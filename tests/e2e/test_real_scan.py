"""A removal from a real scan: what runs behind the object is to be there afterwards, and of the object nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.scenes import Scene, filled, read_scene, removal
from gimp3d.gaussians import Gaussians
from gimp3d.pipeline import render_bytes
from gimp3d.presets import PRESETS

# kitchen_480, scene units: the middle of the dark stripe in the mat below the bulldozer, from one side of it to the
# other, and the same to either side of the stripe
STRIPE = np.array([[-0.5397, 1.5406, 2.0342], [1.2453, 0.8584, 2.4298]])
BESIDE = np.array(
    [[[-0.5944, 1.4387, 2.1351], [1.1906, 0.7565, 2.5308]], [[-0.4806, 1.6349, 1.9396], [1.3143, 0.9554, 2.3316]]]
)
HIDDEN = slice(7, 26)  # of the points along it, what the bulldozer hides or stands beside


@pytest.fixture(scope="module")
def kitchen(shared_data: Path) -> Scene:
    return read_scene(shared_data / "real" / "kitchen_480")


@pytest.fixture(scope="module")
def emptied(kitchen: Scene) -> Gaussians:
    return filled(kitchen.gaussians, removal(kitchen, PRESETS["draft"]))


@pytest.mark.parametrize("view", ["images/06.jpg", "images/16.jpg", "images/21.jpg"])
def test_a_stripe_runs_on_behind_the_object(kitchen: Scene, emptied: Gaussians, view: str) -> None:
    """Darker than the mat on both sides of it, as it is before the hole and behind it."""
    camera = next(c for c in kitchen.train if c.id == view)
    grey = render_bytes(emptied, camera).astype(float).mean(-1)
    lines = []
    for ends in (BESIDE[0], STRIPE, BESIDE[1]):
        points = ends[0] + np.linspace(0, 1, 37)[:, None] * (ends[1] - ends[0])
        cols, rows = camera.project(points)[0].astype(int).T
        lines.append(grey[rows, cols])
    darker = (lines[0] + lines[2]) / 2 - lines[1]
    steady = np.convolve(darker, np.full(5, 0.2), "same")
    assert steady[HIDDEN].min() > 0.4 * np.median(darker[: HIDDEN.start])

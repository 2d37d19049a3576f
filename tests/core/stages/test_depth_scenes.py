"""Depth completion on scenes rendered with and without the object, against the true depth behind it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gimp3d.box import read_region
from gimp3d.geometry import disparity_of
from gimp3d.io.cameras import read_cameras
from gimp3d.io.ply import read_ply
from gimp3d.stages.depth import complete_depth
from gimp3d.stages.depth.layers import distance_to
from gimp3d.stages.masks import find_masks
from gimp3d.stages.reference import rim


@pytest.mark.slow
@pytest.mark.parametrize("name, allowed", [("desk", 0.5), ("corner", 0.5), ("gloss", 0.5), ("rocks", 1.5)])
def test_the_hole_is_nearly_as_right_as_the_splats_round_it(shared_data: Path, name: str, allowed: float) -> None:
    """Median relative error at most the ring's own and half a per cent; rough ground (rocks) one and a half."""
    folder = shared_data / "withwithout" / name
    cameras = read_cameras(folder / "transforms.json")
    camera = next(c for c in cameras if c.id == "test/000.png")
    gaussians, region = read_ply(folder / "scene.ply").gaussians, read_region(folder / "roi.json")
    views = find_masks(gaussians, region, [*(c for c in cameras if c.split == "train"), camera]).views
    view = next(v for v in views if v.camera.id == camera.id)
    truth = np.load(folder / "truth" / "test" / "000.depth.npy").astype(np.float64)
    known = rim(view)
    found = complete_depth(view, views, disparity_of(view.depth_after), known)
    ring = known & (distance_to(view.target) <= 24)
    own = 100 * np.median(np.abs(view.depth_after[ring] / truth[ring] - 1))
    assert 100 * np.median(np.abs(found.depth[view.target] / truth[view.target] - 1)) <= own + allowed
    assert found.confidence > 0.5

"""New Gaussians: on the surface, closed, in the reference's colours."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import cameras, truth

from gimp3d.gaussians import SH_C0, quats_to_matrices
from gimp3d.pipeline import render_bytes
from gimp3d.raster import render
from gimp3d.stages.seed import SeedSettings, colour_gaussians, seed_gaussians


@pytest.mark.parametrize("index", [0, 1, 2])
def test_seeds_alone_redraw_the_reference_without_cracks(index: int) -> None:
    camera = cameras(9)[index].scaled(2)
    drawn = render(truth(), camera)
    image = render_bytes(truth(), camera)
    inner = drawn.median_depth > 0
    seeds = seed_gaussians(camera, image, drawn.median_depth, inner, surfels=False)
    again = render(seeds, camera)
    solid = inner.copy()
    solid[[0, 1, 2, -1, -2, -3]] = False
    solid[:, [0, 1, 2, -1, -2, -3]] = False
    solid &= render(truth(), camera).alpha > 0.97
    assert np.percentile(again.alpha[solid], 2) > 0.9
    error = 255 * np.abs(np.clip(again.rgb, 0, 1) - np.clip(drawn.rgb, 0, 1))[solid]
    assert error.mean() < 8
    relative = np.abs(again.median_depth - drawn.median_depth)[solid] / drawn.median_depth[solid]
    assert np.median(relative) < 0.015  # the discs of the scene are 3 % of the distance wide


@pytest.mark.parametrize("surfels", [False, True])
def test_seeds_are_legal_thin_and_lie_in_the_surface(surfels: bool) -> None:
    camera = cameras(9)[1]
    drawn = render(truth(), camera)
    target = np.zeros(drawn.alpha.shape, bool)
    target[40:60, 40:70] = True
    seeds = seed_gaussians(camera, render_bytes(truth(), camera), drawn.median_depth, target, surfels)
    assert seeds.is_surfels == surfels and seeds.usable.all() and len(seeds) <= target.sum()
    assert np.isfinite(seeds.opacity_logits).all() and (seeds.opacity < 0.999).all()
    normals = quats_to_matrices(seeds.quats)[:, :, 2]
    assert np.median(np.abs(normals[:, 2])) > 0.98  # the floor is level
    assert np.abs(seeds.means[:, 2]).max() < 0.05
    if not surfels:
        assert (seeds.scales[:, 2] < 0.2 * seeds.scales[:, :2].min(1)).all()


def test_pixels_without_depth_make_no_gaussian() -> None:
    camera = cameras(9)[1]
    image = np.zeros((90, 120, 3), np.uint8)
    target = np.ones((90, 120), bool)
    assert len(seed_gaussians(camera, image, np.zeros((90, 120)), target, False)) == 0


def test_one_view_gives_sh_degree_zero() -> None:
    camera = cameras(9)[1]
    drawn = render(truth(), camera)
    image = render_bytes(truth(), camera)
    target = drawn.median_depth > 0
    seeds = seed_gaussians(camera, image, drawn.median_depth, target, False)
    coloured = colour_gaussians(seeds, camera, [], [], scene_degree=2, settings=SeedSettings(sh_degree=2))
    assert coloured.sh.shape[1] == 9 and (coloured.sh[:, 1:] == 0).all()
    rows, cols = np.nonzero(target)
    assert len(rows) == len(seeds)
    np.testing.assert_allclose(0.5 + SH_C0 * coloured.sh[:, 0], image[rows, cols] / 255, atol=1e-6)

"""New Gaussians: on the surface, closed, in the reference's colours."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scenes import cameras, truth

from gimp3d.gaussians import SH_C0, quats_to_matrices
from gimp3d.pipeline import render_bytes
from gimp3d.raster import render
from gimp3d.solvers.harmonics import HarmonicsSettings, sh_basis
from gimp3d.stages.propagate import PaintedView, Rule, ViewToPaint
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


def test_colours_that_change_with_the_view_are_learnt_from_painted_pixels_alone() -> None:
    """The floor brightens towards +x. Every third view is white, but not by pixels of its own."""
    everywhere = cameras(24)
    reference, depths = everywhere[1], [render(truth(), c).median_depth for c in everywhere]

    def brightness(directions: np.ndarray) -> np.ndarray:
        return 0.5 + 0.2 * directions[..., 0]

    views, painted = [], []
    for k, (camera, depth) in enumerate(zip(everywhere, depths)):
        rows, cols = np.indices(depth.shape) + 0.5
        points = camera.unproject(np.stack([cols.ravel(), rows.ravel()], -1), np.maximum(depth, 1e-3).ravel())
        towards = points - camera.centre
        grey = brightness(towards / np.linalg.norm(towards, axis=-1, keepdims=True)).reshape(depth.shape)
        image = np.repeat(np.rint(255 * grey)[..., None], 3, -1).astype(np.uint8)
        rules = np.full(depth.shape, Rule.OWN_PIXELS if k % 3 else Rule.REFERENCE, np.uint8)
        image[rules == Rule.REFERENCE] = 255
        nothing = np.zeros(depth.shape, bool)
        views.append(partial(ViewToPaint, camera, image, image, nothing, ~nothing, depth, depth))
        painted.append(PaintedView(camera.id, 0, 0, image, image, rules))
    target = np.zeros(depths[1].shape, bool)
    target[30:60, 40:80] = depths[1][30:60, 40:80] > 0
    flat = np.full((*target.shape, 3), 128, np.uint8)
    seeds = seed_gaussians(reference, flat, depths[1], target, False)
    means = seeds.means.astype(float)
    to_reference = means - reference.centre
    to_reference /= np.linalg.norm(to_reference, axis=-1, keepdims=True)
    settings = SeedSettings(harmonics=HarmonicsSettings(floor=0.01, offset=True))
    coloured = colour_gaussians(seeds, reference, views, painted, 3, settings)
    assert coloured.sh.shape[1] == 16 and (coloured.sh[:, 9:] == 0).all()
    assert (coloured.sh[:, 1:4] != 0).any((1, 2)).mean() > 0.9

    def shown(directions: np.ndarray) -> np.ndarray:
        return 0.5 + np.einsum("nk,nkc->nc", sh_basis(directions, 3), coloured.sh)

    np.testing.assert_allclose(shown(to_reference), 128 / 255, atol=1e-5)
    for camera in everywhere[::5]:
        towards = means - camera.centre
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        change = shown(towards)[:, 0] - shown(to_reference)[:, 0]
        expected = brightness(towards) - brightness(to_reference)
        assert np.median(np.abs(change - expected)) < 0.03
    careful = colour_gaussians(seeds, reference, views, painted, 3)  # the default holds on to c_0 harder
    assert 0 < np.abs(careful.sh[:, 1:]).mean() < np.abs(coloured.sh[:, 1:]).mean()

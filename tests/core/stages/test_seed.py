"""New Gaussians: on the surface, closed, in the reference's colours."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from property_tests import examples
from scenes import cameras, floor, truth

from gimp3d.camera import Camera
from gimp3d.errors import BadInput
from gimp3d.gaussians import SH_C0, Gaussians, pad_sh, quats_to_matrices, sh_basis
from gimp3d.pipeline import render_bytes
from gimp3d.raster import render
from gimp3d.solvers.harmonics import HarmonicsSettings
from gimp3d.stages.propagate import PaintedView, Rule, ViewToPaint
from gimp3d.stages.seed import (
    CUT,
    SeedSettings,
    _colour_change,
    _patches,
    seed_gaussians,
    settle_gaussians,
)


@pytest.mark.parametrize("largest", [1, 4])
@pytest.mark.parametrize("surfels", [False, True])
@pytest.mark.parametrize("index", [0, 1, 2])
def test_seeds_alone_redraw_the_reference_without_cracks(index: int, surfels: bool, largest: int) -> None:
    camera = cameras(9)[index].scaled(2)
    drawn = render(truth(), camera)
    image = render_bytes(truth(), camera)
    inner = drawn.median_depth > 0
    settings = SeedSettings(largest=largest)
    seeds = seed_gaussians(camera, image, drawn.median_depth, inner, surfels=surfels, settings=settings)
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


@examples(30)
@given(
    arrays(bool, st.tuples(st.integers(1, 30), st.integers(1, 30))),
    st.sampled_from([1, 2, 4, 8]),
    st.sampled_from([0.0, 50.0, 1e9]),
    st.integers(0, 9),
)
def test_patches_tile_the_target_exactly_and_keep_off_its_edge(
    target: np.ndarray, largest: int, detail: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 255, (*target.shape, 3), np.uint8)
    disparity, normals = np.ones(target.shape), np.zeros((*target.shape, 3))
    normals[..., 2] = -1
    target = cv2.dilate(target.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    found, sums = _patches(image, disparity, target, normals, SeedSettings(largest=largest, detail=detail))
    count = np.zeros(target.shape, int)
    around = np.pad(target, largest, constant_values=True)
    for (top, left, h, w), total in zip(found, sums):
        count[top : top + h, left : left + w] += 1
        np.testing.assert_allclose(total[:3], image[top : top + h, left : left + w].sum((0, 1)))
        assert max(h, w) <= min(largest, 4 * min(h, w))
        high, wide = h // 2, w // 2
        assert h * w == 1 or ((image[top : top + h, left : left + w] - total[:3] / h / w) ** 2).sum() <= detail + 1e-3
        top, left = top + largest, left + largest
        assert h * w == 1 or around[top - high : top + h + high, left - wide : left + w + wide].all()
    assert np.array_equal(count, target)


def test_flat_colour_and_surface_need_few_gaussians_and_texture_or_a_fold_many() -> None:
    camera = cameras(9)[1].scaled(2)
    v, u = np.indices((camera.height, camera.width))
    flat = np.full((camera.height, camera.width, 3), 90, np.uint8)
    plane = (1 / (0.2 + 1e-4 * u + 2e-4 * v)).astype(np.float32)
    folded = (1 / (0.2 + 2e-2 * np.abs(v % 42 - 21))).astype(np.float32)
    textured = np.random.default_rng(0).integers(0, 255, flat.shape, np.uint8)
    target = np.zeros(flat.shape[:2], bool)
    target[30:94, 40:168] = True

    def share(image: np.ndarray, depth: np.ndarray) -> float:
        return len(seed_gaussians(camera, image, depth, target, False)) / target.sum()

    assert share(flat, plane) < 0.15
    assert share(textured, plane) > 0.9
    assert share(flat, plane) < share(flat, folded)


@pytest.mark.parametrize("surfels", [False, True])
def test_a_splat_has_its_patchs_shape_in_the_reference(surfels: bool) -> None:
    """The ellipse drawn is σ² diag(w², h²) whatever the slant, as long as the surface is not grazing."""
    camera = cameras(9)[1].scaled(2)
    v, u = np.indices((camera.height, camera.width)) + 0.5
    depth = (1 / (0.3 + 3e-4 * u + 1e-3 * v)).astype(np.float64)
    image = np.full((camera.height, camera.width, 3), 90, np.uint8)
    target = np.zeros(depth.shape, bool)
    target[60:100, 60:100] = True
    seeds = seed_gaussians(camera, image, depth, target, surfels)
    axes = quats_to_matrices(seeds.quats) * np.pad(seeds.scales, ((0, 0), (0, 3 - seeds.scales.shape[1])))[:, None]
    local = np.einsum("ij,njk->nik", camera.R, axes)
    points = (seeds.means - camera.centre) @ camera.R.T
    x, y, z = points.T
    jacobian = np.zeros((len(z), 2, 3))
    jacobian[:, 0, 0], jacobian[:, 0, 2] = camera.fx / z, -camera.fx * x / z**2
    jacobian[:, 1, 1], jacobian[:, 1, 2] = camera.fy / z, -camera.fy * y / z**2
    flat = jacobian @ local
    covariance = flat @ np.swapaxes(flat, 1, 2)
    sides = np.sqrt(covariance[:, [0, 1], [0, 1]] + (0 if surfels else 0.3)) / 0.75
    closest = 2 ** np.rint(np.log2(sides))
    thick = 0 if surfels else 0.05  # the thin axis shows a little, where the surface is seen askew
    np.testing.assert_allclose(sides, closest, rtol=0.02 + thick)
    assert set(np.unique(closest)) == {1, 2, 4}
    assert np.abs(covariance[:, 0, 1]).max() < (0.02 + thick) * covariance[:, [0, 1], [0, 1]].max()


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


def test_seeds_do_not_depend_on_what_lies_round_the_target() -> None:
    camera = cameras(9)[1]
    image, depth = render_bytes(truth(), camera), render(truth(), camera).median_depth
    target = np.zeros(depth.shape, bool)
    target[30:60, 40:80] = depth[30:60, 40:80] > 0
    beyond = ((12, 8), (16, 4))
    larger = replace(camera, width=140, height=110, cx=camera.cx + 16, cy=camera.cy + 12)
    pictures = np.pad(image, (*beyond, (0, 0)), constant_values=9), np.pad(depth, beyond), np.pad(target, beyond)
    found = seed_gaussians(camera, image, depth, target, False), seed_gaussians(larger, *pictures, False)
    for name in ("means", "log_scales", "quats", "sh"):
        np.testing.assert_allclose(*(getattr(g, name) for g in found), atol=1e-5)


def test_pixels_without_depth_make_no_gaussian() -> None:
    camera = cameras(9)[1]
    image = np.zeros((90, 120, 3), np.uint8)
    target = np.ones((90, 120), bool)
    assert len(seed_gaussians(camera, image, np.zeros((90, 120)), target, False)) == 0


def _of_degree(degree: int) -> Gaussians:
    """The floor with its hole, of some SH degree."""
    known = floor(with_hole=True)
    return replace(known, sh=pad_sh(known.sh, (degree + 1) ** 2))


def test_one_view_gives_sh_degree_zero() -> None:
    camera = cameras(9)[1]
    drawn = render(truth(), camera)
    image = render_bytes(truth(), camera)
    target = drawn.median_depth > 0
    seeds = seed_gaussians(camera, image, drawn.median_depth, target, False, SeedSettings(largest=1))
    coloured = settle_gaussians(_of_degree(2), seeds, camera, [], SeedSettings(corrections=0))
    assert coloured.sh.shape[1] == 9 and (coloured.sh[:, 1:] == 0).all()
    rows, cols = np.nonzero(target)
    assert len(rows) == len(seeds)
    np.testing.assert_allclose(0.5 + SH_C0 * coloured.sh[:, 0], image[rows, cols] / 255, atol=1e-6)


def test_without_corrections_view_dependence_is_fitted_to_painted_pixels_alone() -> None:
    """The paper's way. The floor brightens towards +x. Every third view is white, but not by pixels of its own."""
    everywhere = cameras(24)
    reference, depths = everywhere[1], [render(truth(), c).median_depth for c in everywhere]

    def brightness(directions: np.ndarray) -> np.ndarray:
        return 0.5 + 0.2 * directions[..., 0]

    painted = []
    for k, (camera, depth) in enumerate(zip(everywhere, depths)):
        rows, cols = np.indices(depth.shape) + 0.5
        points = camera.unproject(np.stack([cols.ravel(), rows.ravel()], -1), np.maximum(depth, 1e-3).ravel())
        towards = points - camera.centre
        grey = brightness(towards / np.linalg.norm(towards, axis=-1, keepdims=True)).reshape(depth.shape)
        image = np.repeat(np.rint(255 * grey)[..., None], 3, -1).astype(np.uint8)
        rules = np.full(depth.shape, Rule.OWN_PIXELS if k % 3 else Rule.REFERENCE, np.uint8)
        image[rules == Rule.REFERENCE] = 255
        painted.append(PaintedView(camera, 0, 0, image, image, rules, depth))
    target = np.zeros(depths[1].shape, bool)
    target[30:60, 40:80] = depths[1][30:60, 40:80] > 0
    seeds = seed_gaussians(reference, painted[1].image, depths[1], target, False)
    means = seeds.means.astype(float)
    to_reference = means - reference.centre
    to_reference /= np.linalg.norm(to_reference, axis=-1, keepdims=True)
    chosen = SeedSettings(corrections=0, harmonics=HarmonicsSettings(ridge=0.01))
    coloured = settle_gaussians(_of_degree(3), seeds, reference, painted, chosen)
    assert coloured.sh.shape[1] == 16 and (coloured.sh[:, 9:] == 0).all()
    assert (coloured.sh[:, 1:4] != 0).any((1, 2)).mean() > 0.9

    def shown(directions: np.ndarray) -> np.ndarray:
        return 0.5 + np.einsum("nk,nkc->nc", sh_basis(directions, 3), coloured.sh)

    np.testing.assert_allclose(shown(to_reference)[:, 0], brightness(to_reference), atol=2 / 255)
    for camera in everywhere[::5]:
        towards = means - camera.centre
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        change = shown(towards)[:, 0] - shown(to_reference)[:, 0]
        expected = brightness(towards) - brightness(to_reference)
        assert np.median(np.abs(change - expected)) < 0.03
    later = settle_gaussians(_of_degree(3), seeds, reference, [], SeedSettings())  # no view tells more
    assert later.sh.shape[1] == 16 and (later.sh[:, 1:] == 0).all()


def _hole_and_truth(count: int = 9) -> tuple[list[ViewToPaint], list[PaintedView]]:
    """Views of the floor with a hole, and what they should show."""
    views, painted = [], []
    for camera in cameras(count, 360, 270):
        image, drawn = render_bytes(truth(), camera), render(truth(), camera)
        target = (drawn.alpha > 0.9) & (render(floor(with_hole=True), camera).alpha < 0.9)
        rules = np.where(target, Rule.OWN_PIXELS, Rule.UNTOUCHED).astype(np.uint8)
        depth = drawn.median_depth
        views.append(ViewToPaint(camera, image, image, target, target, depth, depth, image))
        painted.append(PaintedView(camera, 0, 0, image, image, rules, depth))
    return views, painted


def _filled(views: list[ViewToPaint], painted: list[PaintedView], chosen: SeedSettings) -> Gaussians:
    known, view = floor(with_hole=True), views[1]
    seeds = seed_gaussians(view.camera, view.image, view.depth_new, view.target, False, chosen)
    return settle_gaussians(known, seeds, view.camera, painted, chosen)


def test_settled_colours_leave_no_seam_and_show_every_view_better_than_pixel_colours() -> None:
    """Across the hole's rim, the drawn picture has hardly more of a step that the true one has not than elsewhere."""
    views, painted = _hole_and_truth()
    known = floor(with_hole=True)
    errors, seams = [], []
    for corrections in (0, 1):
        new = _filled(views, painted, SeedSettings(corrections=corrections))
        assert 0 < len(new) < 0.7 * views[1].target.sum()
        error, at_rim, inside = [], [], []
        for view in views:
            drawn = render_bytes(known.extended(new), view.camera).astype(float)
            wrong = (drawn - view.image).mean(-1)
            steps = np.hypot(*np.gradient(wrong))
            rim = cv2.morphologyEx(view.target.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
            error.append(np.sqrt((wrong[view.target] ** 2).mean()))
            at_rim.append(steps[rim].mean())
            inside.append(steps[view.target & ~rim].mean())
        errors.append(np.mean(error))
        seams.append(np.mean(at_rim) / np.mean(inside))
    assert errors[1] < 0.97 * errors[0] and errors[1] < 9  # grey levels
    assert seams[1] < 1.25
    open_rim = [np.hypot(*np.gradient((render_bytes(known, v.camera).astype(float) - v.image).mean(-1))) for v in views]
    assert np.mean([steps[v.target].mean() for steps, v in zip(open_rim, views)]) > 3 * np.mean(at_rim)


def _tinted(paint: PaintedView, camera: Camera, slope: float, offset: float) -> PaintedView:
    """The picture, brighter by `offset` and, for a camera one radian towards +x, by `slope` grey levels more."""
    towards = -camera.centre / np.linalg.norm(camera.centre)
    image = np.clip(paint.image.astype(float) + offset + slope * towards[0], 0, 255).astype(np.uint8)
    return replace(paint, image=image)


def test_what_each_view_misses_tells_view_dependence_and_what_all_miss_does_not() -> None:
    views, painted = _hole_and_truth()
    known = _of_degree(2)
    seeds = seed_gaussians(views[1].camera, views[1].image, views[1].depth_new, views[1].target, False)

    def error(new: Gaussians, wanted: list[PaintedView]) -> float:
        drawn = [render_bytes(known.extended(new), v.camera).astype(float) for v in views]
        return float(np.mean([(d - p.image)[v.target].mean() ** 2 for d, p, v in zip(drawn, wanted, views)]) ** 0.5)

    def settled(degree: int, wanted: list[PaintedView]) -> Gaussians:
        chosen = SeedSettings(sh_degree=degree)
        return settle_gaussians(known, seeds, views[1].camera, wanted, chosen)

    sloped = [_tinted(p, v.camera, 30, 0) for p, v in zip(painted, views)]
    constant, dependent = settled(0, sloped), settled(2, sloped)
    assert (constant.sh[:, 1:] == 0).all() and (dependent.sh[:, 1:] != 0).any()
    assert error(dependent, sloped) < 0.5 * error(constant, sloped)
    plain = settled(2, painted)
    lifted = settled(2, [_tinted(p, v.camera, 0, 20) for p, v in zip(painted, views)])
    step = lifted.sh[:, 0] - plain.sh[:, 0]
    assert np.median(step) * SH_C0 * 255 > 10
    assert np.median(np.abs(lifted.sh[:, 1:] - plain.sh[:, 1:])) < 0.02 * np.median(step)


def test_few_or_near_views_tell_the_constant_alone() -> None:
    rng = np.random.default_rng(0)
    steps = [(np.full((5, 3), 4.0), rng.choice([-1, 1], (5, 3)) * np.ones((5, 3))) for _ in range(3)]
    towards = np.tile([0.0, 0.6, 0.8], (5, 1))
    same = _colour_change(steps, [towards] * 3, 2, 3.0)
    assert same.shape == (5, 9, 3)
    trust = 1 / (1 + 1 / CUT**2) ** 2  # all miss as much as is usual
    np.testing.assert_allclose(same[:, 0], trust * sum(m for _, m in steps) / (trust * 12 + 3))
    np.testing.assert_allclose(same[:, 1:], 0, atol=1e-12)
    nobody = _colour_change([(0 * w, 0 * m) for w, m in steps], [towards] * 3, 2, 3.0)
    np.testing.assert_array_equal(nobody, 0)


def test_a_wrong_picture_tells_next_to_nothing() -> None:
    rng = np.random.default_rng(1)
    towards = rng.normal(size=(12, 6, 3))
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    steps = [(np.full((6, 3), 9.0), 9 * (0.02 + 0.03 * t[:, :1]) * np.ones((6, 3))) for t in towards]
    right = _colour_change(steps, list(towards), 1, 0.01)
    wrong = _colour_change([*steps[:-1], (steps[-1][0], np.full((6, 3), 9 * 2.0))], list(towards), 1, 0.01)
    shown = np.einsum("nk,nkc->nc", sh_basis(towards[0], 1), right) / SH_C0
    np.testing.assert_allclose(shown, 0.02 + 0.03 * towards[0][:, :1] * np.ones((6, 3)), atol=2e-3)
    assert np.abs(wrong - right).max() < 0.2 * np.abs(right).max()


def test_the_papers_constant_lacks_what_3dgs_adds() -> None:
    camera = cameras(9)[1]
    depth = render(truth(), camera).median_depth
    seeds = seed_gaussians(camera, render_bytes(truth(), camera), depth, depth > 0, False)
    chosen = [SeedSettings(grey=g, corrections=0, sh_degree=0) for g in (0.5, 0.0)]
    ours, papers = (settle_gaussians(_of_degree(2), seeds, camera, [], c) for c in chosen)
    np.testing.assert_allclose(papers.sh[:, 0] - ours.sh[:, 0], 0.5 / SH_C0, rtol=1e-5)
    np.testing.assert_allclose(ours.sh[:, 0], seeds.sh[:, 0], atol=1e-6)  # float32, there and back


def test_gaussians_that_show_nowhere_are_left_out_and_the_rest_stays() -> None:
    views, painted = _hole_and_truth()
    view = views[1]
    seeds = seed_gaussians(view.camera, view.image, view.depth_new, view.target, False)
    below = replace(seeds, means=seeds.means - np.float32([0, 0, 0.1]))
    new = settle_gaussians(truth(), below, view.camera, painted, SeedSettings())
    assert len(new) < 0.1 * len(below)  # the floor hides them
    everything = settle_gaussians(truth(), below, view.camera, painted, SeedSettings(corrections=0))
    assert np.array_equal(everything.means, below.means)


def test_a_patch_size_that_cannot_be_halved_is_refused() -> None:
    camera = cameras(9)[1]
    with pytest.raises(BadInput, match="power of two"):
        seed_gaussians(
            camera,
            np.zeros((90, 120, 3), np.uint8),
            np.ones((90, 120)),
            np.ones((90, 120), bool),
            False,
            SeedSettings(largest=3),
        )

"""The depth of surfaces: planes of flat splats are planes, balls are met at their centres."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_raster_render import CAMERA, one, random_scene

from gimp3d.compute import threads
from gimp3d.gaussians import Gaussians, matrices_to_quats, quats_to_matrices
from gimp3d.raster import RasterSettings, render, surface_depth

SETTINGS = RasterSettings()


def with_scales(gaussians: Gaussians, scales: list[float], rotation: np.ndarray) -> Gaussians:
    quats = matrices_to_quats(rotation[None]).astype(np.float32)
    rows = len(gaussians)
    return replace(
        gaussians,
        log_scales=np.log(np.tile(scales, (rows, 1))).astype(np.float32),
        quats=np.tile(quats, (rows, 1)),
        opacity_logits=np.full(rows, 8, np.float32),
    )


def tilted(degrees: float) -> np.ndarray:
    """A turn about the x axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


@pytest.mark.parametrize("degrees", [-60, -20, 0, 35, 65])
def test_a_flat_splat_is_met_where_the_ray_meets_its_plane(degrees: float) -> None:
    splat = with_scales(one(mean=(0.1, -0.2, 4.0)), [0.6, 0.6, 1e-4], tilted(degrees))
    thin = RasterSettings(low_pass=1e-4)  # the low-pass takes a little of a splat's slope: it is never infinitely thin
    depth, alpha = surface_depth(splat, CAMERA, thin)
    shown = alpha >= 0.5
    assert shown.sum() > 40
    normal = tilted(degrees)[:, 2]
    rays = np.concatenate(
        [(CAMERA.pixel_centres() - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy], np.ones((*depth.shape, 1))], -1
    )
    plane = normal @ [0.1, -0.2, 4.0] / (rays @ normal)
    np.testing.assert_allclose(depth[shown], plane[shown], rtol=1e-4)
    if degrees:
        usual = surface_depth(splat, CAMERA)[0]
        centres = render(splat, CAMERA).median_depth
        assert np.abs(usual / plane - 1)[shown].max() < 0.1 * np.abs(centres / plane - 1)[shown].max()


def test_a_ball_is_met_at_its_centre() -> None:
    ball = with_scales(one(mean=(0.3, 0.2, 4.0)), [0.4, 0.4, 0.4], np.eye(3))
    depth, alpha = surface_depth(ball, CAMERA)
    np.testing.assert_allclose(depth[alpha >= 0.5], 4.0, rtol=1e-6)


@given(
    st.lists(st.floats(-0.5, 0.5), min_size=3, max_size=3),
    st.lists(st.floats(-4, 0), min_size=3, max_size=3),
    st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1),
)
def test_one_splat_against_float64(offset: list[float], log_scales: list[float], quat: list[float]) -> None:
    mean = np.add(offset, [0, 0, 5])
    splat = replace(
        one(mean=tuple(mean)),
        log_scales=np.array([log_scales], np.float32),
        quats=np.array([quat], np.float32),
        opacity_logits=np.array([8], np.float32),
    )
    depth, alpha = surface_depth(splat, CAMERA)
    axes = CAMERA.R @ quats_to_matrices(splat.quats.astype(np.float64))[0]
    centre = CAMERA.to_camera(splat.means.astype(np.float64))[0]
    blur = SETTINGS.low_pass * centre[2] ** 2 / (CAMERA.fx * CAMERA.fy)
    variances = np.exp(2 * splat.log_scales[0].astype(np.float64)) + blur
    precision = axes @ np.diag(1 / variances) @ axes.T
    flatness = 1 - np.sort(variances)[0] / np.sort(variances)[1]
    reach = 3 * np.sqrt(axes[2] ** 2 @ variances)
    for row, col in np.argwhere(alpha >= 0.5)[::7]:
        ray = np.array([(col + 0.5 - CAMERA.cx) / CAMERA.fx, (row + 0.5 - CAMERA.cy) / CAMERA.fy, 1])
        met = ray @ precision @ centre / (ray @ precision @ ray)
        expected = centre[2] + flatness * np.clip(met - centre[2], -reach, reach)
        np.testing.assert_allclose(depth[row, col], max(expected, 0), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", ["3d", "surfels"])
def test_alpha_and_what_is_shown_are_the_renderings(kind: str) -> None:
    scene = random_scene(40, 300)
    if kind == "surfels":
        scene = replace(scene, log_scales=scene.log_scales[:, :2])
    drawn = render(scene, CAMERA, passes=frozenset({"depth"}))
    depth, alpha = surface_depth(scene, CAMERA)
    np.testing.assert_array_equal(alpha, drawn.alpha)
    np.testing.assert_array_equal(depth > 0, drawn.median_depth > 0)
    if kind == "surfels":  # each pixel's ray meets them already
        np.testing.assert_array_equal(depth, drawn.median_depth)


def test_nothing_is_nothing() -> None:
    empty = random_scene(40, 3).take(np.zeros(3, bool))
    depth, alpha = surface_depth(empty, CAMERA)
    assert not depth.any() and not alpha.any()


def test_it_is_bit_equal_for_any_thread_count() -> None:
    scene = random_scene(40, 5000)
    try:
        results = []
        for count in (1, 3):
            threads.set_thread_count(count)
            results.append(surface_depth(scene, CAMERA)[0])
    finally:
        threads.set_thread_count(None)
    np.testing.assert_array_equal(*results)

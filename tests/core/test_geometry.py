"""Frames, windows, surfaces and samples."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from scenes import cameras, scene

from gimp3d.camera import Camera
from gimp3d.compute.jit import exact_kernel
from gimp3d.geometry import (
    blurred,
    bounds,
    colours_at,
    cropped,
    dilated,
    framed,
    pack_camera,
    project,
    sees,
    specks,
    surface_normals,
    surface_points,
    unproject,
)
from gimp3d.raster import render, surface_depth


@exact_kernel
def there_and_back(c, points, found):
    for i in range(len(points)):
        u, v, depth = project(c, points[i, 0], points[i, 1], points[i, 2])
        x, y, z = unproject(c, u, v, depth)
        found[i] = u, v, depth, x, y, z


def test_kernels_project_as_cameras_do() -> None:
    camera, rng = cameras()[3], np.random.default_rng(0)
    points, found = 3 * rng.normal(size=(200, 3)), np.zeros((200, 6))
    there_and_back(pack_camera(camera), points, found)
    uv, z = camera.project(points)
    ahead = z > 0
    assert ahead.any() and (~ahead).any() and (found[~ahead, :2] < -1e8).all()
    np.testing.assert_allclose(found[ahead], np.c_[uv, z, points][ahead], atol=1e-9)
    index, rows, cols, depths = framed(camera, points)
    inside = ahead & (uv >= 0).all(1) & (uv < [camera.width, camera.height]).all(1)
    assert index.tolist() == np.flatnonzero(inside).tolist() and (depths == z[inside]).all()
    assert (np.stack([cols, rows], 1) == np.floor(uv[inside])).all()


@examples(30)
@given(seed=st.integers(0, 10_000), margin=st.integers(0, 4))
def test_bounds_hold_the_mask_and_its_margin_and_no_more(seed: int, margin: int) -> None:
    rng = np.random.default_rng(seed)
    mask = rng.random(rng.integers(1, 20, 2)) < rng.choice([0.0, 0.02, 0.2])
    rows, cols = bounds(mask, margin)
    grown = dilated(mask, margin)
    part = grown[rows, cols]
    assert part.sum() == grown.sum()
    assert all(edge.any() for edge in (part[0], part[-1], part[:, 0], part[:, -1])) if mask.any() else part.size == 0
    square = np.ones((2 * margin + 1,) * 2, np.uint8)
    assert (grown == (cv2.filter2D(mask.astype(np.float32), -1, square, borderType=cv2.BORDER_CONSTANT) > 0.5)).all()


def test_colours_lie_between_pixels_and_may_be_many() -> None:
    ramp = np.repeat(np.arange(8, dtype=np.uint8)[None, :, None] * 10, 3, 2).repeat(4, 0)
    uv = np.stack([np.linspace(0, 8, 40_000), np.full(40_000, 2.0)], -1)
    found = colours_at(ramp, uv)
    assert found.shape == (40_000, 3) and found.dtype == np.uint8
    assert np.abs(found[:, 0] - np.clip(10 * (uv[:, 0] - 0.5), 0, 70)).max() <= 1
    assert colours_at(ramp, uv[:0]).shape == (0, 3)


def test_sees_is_a_depth_test() -> None:
    camera = Camera("c", 10, 10, 10, 10, 5, 5, np.eye(4))
    depth = np.full((10, 10), 2.0)
    depth[0, 0] = 0
    points = np.array([[0, 0, 2.0], [0, 0, 2.5], [0, 0, 1.5], [0, 0, -2], [9, 0, 2], [-0.9, -0.9, 2.0]])
    assert sees(camera, depth, points, 0.02).tolist() == [True, False, False, False, False, False]


def test_a_part_of_a_view_shows_the_same() -> None:
    g, camera = scene(), cameras()[4]
    window = (slice(20, 70), slice(31, 90))
    whole, part = render(g, camera), render(g, cropped(camera, window))
    inner = (slice(25, 65), slice(36, 85))  # splats outside a picture are drawn with a clamped slope (Kerbl 2023)
    assert np.abs(whole.rgb[inner] - part.rgb[5:45, 5:54]).max() < 0.02
    rows, cols, points = surface_points(camera, surface_depth(g, camera)[0], window, 3)
    uv, z = camera.project(points)
    assert np.abs(uv - np.stack([cols + 0.5, rows + 0.5], -1)).max() < 1e-6 and (z > 0).all()
    assert set(np.unique(rows - 20) % 3) == {0} and set(np.unique(cols - 31) % 3) == {0}


def test_a_window_of_a_view_may_be_empty() -> None:
    """A view of which nothing is painted is a part of no pixels, and no fault."""
    part = cropped(cameras(1)[0], (slice(3, 3), slice(5, 5)))
    assert (part.width, part.height) == (0, 0)


def test_normals_of_a_tilted_plane() -> None:
    camera = Camera("c", 40, 30, 35, 35, 20, 15, np.eye(4))
    normal = np.array([0.2, -0.5, -1.0])
    normal /= np.linalg.norm(normal)
    rays = camera.unproject(camera.pixel_centres(), np.ones((30, 40)))
    depth = (normal @ np.array([0, 0, 3.0])) / (rays @ normal)
    depth[10, 10] = 0
    found = surface_normals(camera, depth)
    there = np.ones((30, 40), bool)
    there[9:12, 9:12] = False
    np.testing.assert_allclose(found[there], np.broadcast_to(normal, (there.sum(), 3)), atol=1e-9)


def test_an_edge_does_not_tilt_the_normals_beside_it() -> None:
    camera = Camera("c", 40, 30, 35, 35, 20, 15, np.eye(4))
    depth = np.full((30, 40), 4.0)
    depth[:, 20:] = 2.0
    found = surface_normals(camera, depth)
    np.testing.assert_allclose(found, np.broadcast_to([0, 0, -1.0], found.shape), atol=1e-9)


@pytest.mark.parametrize("channels", [(), (1,), (3,)])
def test_a_blur_of_what_is_shown_is_the_normalised_convolution(channels: tuple[int, ...]) -> None:
    rng = np.random.default_rng(3)
    shown, picture = rng.random((40, 50)) < 0.4, rng.random((40, 50, *channels)).astype(np.float32)
    shown[:20, :20] = False
    hidden = np.where(shown[(..., *[None] * len(channels))], picture, np.nan)  # whatever lies there
    found = blurred(hidden, shown, 1.5)
    assert found.shape == picture.shape and found.dtype == np.float32 and np.isfinite(found).all()
    squared = (np.arange(40)[:, None] - 30) ** 2 + (np.arange(50) - 25) ** 2
    weight = np.exp(-squared / (2 * 1.5**2)) * shown
    expected = np.tensordot(weight, picture.astype(np.float64), 2) / weight.sum()
    np.testing.assert_allclose(found[30, 25], expected, rtol=5e-3)
    assert not found[5, 5].any()  # nothing is shown near
    np.testing.assert_allclose(blurred(np.ones_like(picture), shown, 1.5)[shown], 1, rtol=1e-5)


def test_specks_are_parts_of_a_few_pixels() -> None:
    mask = np.zeros((20, 30), bool)
    mask[4:6, 4:6], mask[10, 10:15], mask[[14, 15], [20, 21]] = True, True, True
    few = mask.copy()
    few[10] = False
    np.testing.assert_array_equal(specks(mask), few)
    assert not specks(np.zeros((3, 3), bool)).any()

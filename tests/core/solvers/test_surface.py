"""Tangent planes of a picture's surface, and how patches on them map to each other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from gimp3d.solvers import surface as module
from gimp3d.solvers.surface import coarser, supports, tangent_planes, warps, whole_patches

K = np.array([[90.0, 0, 52], [0, 95, 37], [0, 0, 1]])
H, W = 80, 100


def rays() -> np.ndarray:
    x, y = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    return np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones((H, W))], -1)


def plane(normal: tuple[float, float, float], distance: float) -> np.ndarray:
    """Disparity of the plane n · X = distance, [H, W]."""
    return rays() @ (np.array(normal) / np.linalg.norm(normal)) / distance


def room() -> np.ndarray:
    """A wall that meets a floor."""
    return np.maximum(plane((0, 0, 1), 4), plane((0, 1, 0), 0.9))


slopes = st.floats(-0.6, 0.6)


@examples(40)
@given(slopes, slopes, st.floats(0.1, 100))
def test_a_plane_is_found_exactly(a: float, b: float, distance: float) -> None:
    disparity = plane((a, b, 1), distance)
    found = tangent_planes(disparity, K)
    np.testing.assert_allclose(
        found.normal, np.broadcast_to(np.array([a, b, 1]) / np.hypot(np.hypot(a, b), 1), (H, W, 3)), atol=2e-4
    )
    np.testing.assert_allclose(found.point[..., 2], 1 / disparity, rtol=1e-3)


@examples(40)
@given(slopes, slopes, st.floats(0.5, 20), st.integers(0, H * W - 1), st.integers(0, H * W - 1))
def test_a_warp_is_the_derivative_of_moving_along_the_plane(
    a: float, b: float, distance: float, p: int, q: int
) -> None:
    """The same step on the plane, from where p shows it and from where q does, in pixels."""
    normal = np.array([a, b, 1]) / np.linalg.norm([a, b, 1])
    found = tangent_planes(plane((a, b, 1), distance), K)
    target = np.zeros((H, W), bool)
    target.flat[p] = True
    rows, cols = np.full((2, H, W), -1)
    rows[target], cols[target] = q // W, q % W
    warp = warps(found, target, rows, cols)[0].reshape(2, 2)

    def on_plane(index: int) -> np.ndarray:
        ray = rays().reshape(-1, 3)[index]
        return ray * distance / (ray @ normal)

    def pixel(point: np.ndarray) -> np.ndarray:
        return (K @ (point / point[2]))[:2]

    for step in np.linalg.svd(normal[None])[2][1:] * distance * 1e-6:  # two directions on the plane
        moves = [pixel(on_plane(k) + step) - pixel(on_plane(k)) for k in (p, q)]
        np.testing.assert_allclose(warp @ moves[0], moves[1], rtol=5e-3, atol=2e-3 * np.abs(moves).max())


def test_planes_do_not_tilt_at_edges() -> None:
    disparity = room()
    found = tangent_planes(disparity, K)
    wall = disparity == plane((0, 0, 1), 4)
    floor_normal = np.array([0, 1, 0])
    assert (found.normal[wall][:, 2] > 0.999).mean() > 0.97
    assert ((found.normal[~wall] @ floor_normal) > 0.999).mean() > 0.97


def test_results_do_not_depend_on_the_strips(monkeypatch: pytest.MonkeyPatch) -> None:
    disparity = room()
    disparity[10:30, 20:50] = 1.0
    whole = tangent_planes(disparity, K)
    monkeypatch.setattr(module, "STRIP", 7)
    for one, other in zip(whole, tangent_planes(disparity, K)):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-3 * np.abs(one).max())


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -1.0])
def test_what_has_no_depth_faces_the_camera_and_lies_far(value: float) -> None:
    disparity = room()
    disparity[:20] = value
    found = tangent_planes(disparity, K)
    assert all(np.isfinite(a).all() for a in found)
    assert (found.normal[:20] == (0, 0, 1)).all()
    assert found.point[:20, :, 2].min() > 100 * found.point[25:, :, 2].max()


def test_a_support_ends_at_another_surface_and_at_the_border() -> None:
    found = tangent_planes(room(), K)
    wall = room() == plane((0, 0, 1), 4)
    corner = int(np.argmax(~wall[:, 50]))  # the floor's first row
    inside, edge, border = supports(found, np.array([[10, 50], [corner - 4, 50], [0, 0]]), 5).reshape(3, 11, 11)
    assert inside.all()
    assert edge[:7].all() and not edge[9:].any()
    assert border[5:, 5:].all() and not border[:5].any() and not border[:, :5].any()
    whole = whole_patches(found, np.ones((H, W), bool), 3)
    assert whole[10, 50] and not whole[0, 0]


def test_colours_beside_something_nearer_are_not_clear() -> None:
    disparity = np.full((H, W), 0.25)
    disparity[30:50, 40:60] = 0.5
    clear = tangent_planes(disparity, K).clear
    assert clear[30:50, 40:60].all() and not clear[28:30, 40:60].any() and clear[:26].all()
    floor = plane((0, 1, 0), 0.9) * (np.arange(H) > 40)[:, None]  # is nearer below, but not before itself
    assert tangent_planes(floor, K).clear[45:].mean() > 0.99


def test_coarser_planes_have_the_same_warps() -> None:
    found = tangent_planes(room(), K)
    half = coarser(found, 1, (H // 2, W // 2))
    target = np.zeros((H // 2, W // 2), bool)
    target[5, 7] = True
    rows, cols = np.where(target, 20, -1), np.where(target, 30, -1)
    fine = np.zeros((H, W), bool)
    fine[11, 15] = True
    there = warps(found, fine, np.where(fine, 41, -1), np.where(fine, 61, -1))
    np.testing.assert_allclose(warps(half, target, rows, cols), there, rtol=1e-5)

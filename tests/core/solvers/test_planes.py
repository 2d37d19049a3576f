"""Planes in disparity maps: found, joined where they meet, told apart where they do not."""

from __future__ import annotations

import numpy as np
import pytest

from gimp3d.camera import Camera
from gimp3d.solvers.planes import planar_surfaces
from gimp3d.stages.depth.layers import distance_to

H, W = 120, 160
V, U = np.mgrid[:H, :W].astype(float)
HOLE = np.hypot(V - 60, U - 80) < 28
DISTANCE = distance_to(HOLE)
FLOOR = 0.002 * V + 0.0004 * U + 0.1
WALL = np.full((H, W), 0.22) + 0.0003 * (U - 80)
SIDE_WALL = 0.24 - 0.002 * (U - 60)
ROOM = np.maximum(np.maximum(FLOOR, WALL), SIDE_WALL)


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_a_room_is_one_surface_of_three_planes(noise):
    scene = ROOM * (1 + noise * np.random.default_rng(0).standard_normal((H, W)))
    found = planar_surfaces(scene, ~HOLE, DISTANCE)
    assert found.share > 0.9 and len(found.surfaces) == 1 and found.surfaces[0].planes == 3
    np.testing.assert_allclose(found.surfaces[0].disparity[HOLE], ROOM[HOLE], rtol=5e-3)


def test_planes_in_space_are_planes_in_disparity_for_any_camera():
    camera = Camera("a", W, H, 130, 170, 70.3, 66.1, np.eye(4))
    rays = camera.unproject(camera.pixel_centres(), np.ones((H, W)))
    normal = np.array([0.2, 0.9, 0.35])
    disparity = rays @ normal / 1.7  # z of normal · z·ray = 1.7
    found = planar_surfaces(disparity, ~HOLE, DISTANCE)
    np.testing.assert_allclose(found.surfaces[0].disparity, disparity, rtol=1e-9)


def test_an_outer_edge_takes_the_farther_plane():
    edge = np.minimum(FLOOR, WALL)
    found = planar_surfaces(edge, ~HOLE, DISTANCE)
    assert len(found.surfaces) == 1
    np.testing.assert_allclose(found.surfaces[0].disparity[HOLE], edge[HOLE], rtol=1e-3)


def test_a_step_is_two_surfaces():
    scene = np.where(V > 60 + 0.2 * (U - 80), FLOOR * 1.25, FLOOR)
    found = planar_surfaces(scene, ~HOLE, DISTANCE)
    assert len(found.surfaces) == 2 and found.share > 0.95


def test_sky_is_a_surface_infinitely_far():
    scene = np.maximum(0.004 * (V - 59.5), 0)
    found = planar_surfaces(scene, ~HOLE, DISTANCE)
    assert any(s.planes == 0 or (s.disparity[:50] == 0).all() for s in found.surfaces)
    assert "on 1 plane" in found.reason


def test_rough_ground_holds_no_planes():
    rough = FLOOR * (1 + 0.05 * np.random.default_rng(1).standard_normal((H, W)))
    assert planar_surfaces(rough, ~HOLE, DISTANCE).share < 0.3


def test_too_few_pixels_hold_no_plane():
    known = np.zeros((H, W), bool)
    known[60, 40:45] = True
    assert planar_surfaces(FLOOR, known, DISTANCE).surfaces == ()
    known = np.zeros((H, W), bool)
    known[60] = True  # a line does not span one
    assert planar_surfaces(FLOOR, known & ~HOLE, DISTANCE).share == 0

"""What the object's Gaussians block is what its shape does."""

from __future__ import annotations

import numpy as np
import pytest
from lit_scenes import Lamp, blocked, cube
from scenes import BLOCK, REGION, block, floor

from gimp3d.box import Box
from gimp3d.stages.charts import Plane, extent
from gimp3d.stages.light_search import Light, taken_from
from gimp3d.stages.occluder import Occluder, support_first

UP = np.array([0.0, 0.0, 1.0])
FLOOR = Plane.make(np.zeros(3), UP, REGION)
BOX = Box.make([0, 0, BLOCK / 2], [BLOCK] * 3)


def in_plane(directions: np.ndarray) -> np.ndarray:
    return directions @ np.stack([FLOOR.right, FLOOR.down, FLOOR.normal], axis=1)


def occluder() -> Occluder:
    made = Occluder.make(cube(BOX, (0.8, 0.1, 0.1)), FLOOR, extent(REGION))
    assert made is not None
    return made


@pytest.mark.parametrize("elevation", [20, 45, 70])
def test_the_shadow_is_that_of_the_shape(elevation: float) -> None:
    grid = np.arange(-1.5, 1.5, 0.04)
    x, y = (g.ravel() for g in np.meshgrid(grid, grid))
    points = np.stack([x, y, np.zeros_like(x)], -1)
    points = points[(np.abs(points[:, :2]) > BLOCK / 2 + 0.05).any(1)]
    rays = Lamp(elevation, 33, 2).rays()
    found, true = occluder().blocked(points, in_plane(rays)).mean(1), blocked(points, rays, BOX)
    assert true.max() == 1.0
    assert np.abs(found - true).mean() < 0.01
    assert np.corrcoef(found, true)[0, 1] > 0.95  # the shadow of 70° is four cells wide


def test_no_light_goes_below_what_stands() -> None:
    beside = np.array([[BLOCK / 2 + 0.03, 0.0, 0.0]])
    low = np.array([[-np.cos(0.02), 0.0, np.sin(0.02)]])  # through its lowest part
    assert occluder().blocked(beside, in_plane(low))[0, 0] > 0.9


def test_far_away_and_behind_the_light_nothing_is_blocked() -> None:
    away = np.array([[-1.0, 0.0, 0.0], [5.0, 5.0, 0.0]])
    light = np.array([[-np.cos(0.7), 0.0, np.sin(0.7)]])  # comes from -x: the shadow falls to +x
    assert (occluder().blocked(away, in_plane(light)) == 0).all()


def test_moved_on_the_plane_its_shadow_moves_along() -> None:
    rays = in_plane(Lamp(40, 70, 2).rays())
    points = np.random.default_rng(0).uniform(-1.2, 1.2, (200, 3)) * [1, 1, 0]
    step = 0.3 * FLOOR.right - 0.2 * FLOOR.down
    here, there = occluder().blocked(points, rays), occluder().moved(0.3, -0.2).blocked(points + step, rays)
    np.testing.assert_allclose(here, there, atol=1e-6)


def test_the_sky_is_seen_where_no_wall_stands() -> None:
    """In a corner only the open quarter of the sky gives light, and the object blocks some of that."""
    walls = [Plane.make(np.array([1.0, 0, 0]), np.array([-1.0, 0, 0]), REGION)]
    walls.append(Plane.make(np.array([0, 1.0, 0]), np.array([0, -1.0, 0]), REGION))
    table = Plane.make(np.array([-2.0, 0, 0]), np.array([-1.0, 0, 0]), REGION)  # its edge: the object is behind that
    made = Occluder.make(cube(BOX, (0.8, 0.1, 0.1)), FLOOR, extent(REGION), [FLOOR, *walls, table])
    assert made is not None and len(made.walls) == 2
    points = np.random.default_rng(0).uniform(-0.8, 0.8, (60, 3)) * [1, 1, 0]
    points = points[(np.abs(points[:, :2]) > BLOCK / 2 + 0.05).any(1)]
    rays = Lamp(90, 0, np.inf).rays()  # the whole sky, as a level surface weighs it
    for place, normal in ((points, None), (points, UP)):
        found = taken_from(made, [Light(UP, np.inf, np.ones(3))], place, normal)[:, 0]
        for keep, near in ((rays[(rays[:, :2] < 0).all(1)], True), (rays, False)):
            share = keep[:, 2] if normal is None and near else np.ones(len(keep))
            true = np.array(
                [np.average([blocked(p[None], r[None], BOX)[0] for r in keep], weights=share) for p in place]
            )
            assert (np.abs(found - true).mean() < 0.04) == near


def test_the_support_is_what_the_object_stands_on() -> None:
    wall = Plane.make(np.array([BLOCK / 2 + 0.1, 0, 0]), np.array([-1.0, 0, 0]), REGION)
    low = Plane.make(np.array([0, 0, -0.3]), UP, REGION)
    assert support_first([wall, low, FLOOR], cube(BOX, (0.8, 0.1, 0.1)))[0] is FLOOR


def test_what_lies_flat_blocks_nothing() -> None:
    assert Occluder.make(floor(with_hole=False), FLOOR, extent(REGION)) is None
    assert Occluder.make(block().take(np.zeros(0, int)), FLOOR, extent(REGION)) is None

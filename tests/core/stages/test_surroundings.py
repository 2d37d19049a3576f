"""Floor and walls that a box cuts into, from depth maps of shapes whose surface is known."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from gimp3d.box import Box
from gimp3d.camera import Camera
from gimp3d.gaussians import quats_to_matrices
from gimp3d.orbit import orbit_cameras
from gimp3d.stages.surroundings import THICKNESS, _tops, follow_surface

Height = Callable[[np.ndarray], np.ndarray]  # signed height of points [N, 3] above the surface, about in scene units
CUBE = 0.5


def march(camera: Camera, height: Height) -> np.ndarray:
    """z-depth of the first surface along every ray, by sphere tracing with a cautious step."""
    rays = camera.unproject(camera.pixel_centres(), np.ones((camera.height, camera.width))) - camera.centre
    rays = rays.reshape(-1, 3)
    length = np.linalg.norm(rays, axis=1)
    z = np.full(len(rays), 0.2)
    for _ in range(100):
        z += 0.7 * height(camera.centre + z[:, None] * rays) / length
    there = (np.abs(height(camera.centre + z[:, None] * rays)) < 0.01) & (z < 30)
    return np.where(there, z, 0).reshape(camera.height, camera.width).astype(np.float32)


def ground(p: np.ndarray) -> np.ndarray:
    return p[:, 2]


def waves(p: np.ndarray) -> np.ndarray:
    return p[:, 2] - 0.05 * np.sin(4 * p[:, 0]) * np.cos(3 * p[:, 1])


def corner(p: np.ndarray) -> np.ndarray:
    return np.minimum(p[:, 2], p[:, 0] + 0.42)


def cube(p: np.ndarray) -> np.ndarray:
    return (np.abs(p - [0, 0, CUBE / 2]) - CUBE / 2).max(1)


def ball(p: np.ndarray) -> np.ndarray:
    return np.linalg.norm(p - [0, 0, 0.3], axis=1) - 0.3


@cache
def views_of(surface: Height, thing: Height) -> list[tuple[Camera, np.ndarray]]:
    cameras = orbit_cameras((Box.make([0, 0, 0.25], [0.6, 0.6, 0.6]),), 12, (0, 0, 1), 150, 110, 50)
    if surface is corner:
        cameras = tuple(c for c in cameras if c.centre[0] > 0.2)
    return [(c, march(c, lambda p: np.minimum(surface(p), thing(p)))) for c in cameras]


def points_of(views: list, box: Box) -> np.ndarray:
    points = np.concatenate([c.unproject(c.pixel_centres(), z)[z > 0] for c, z in views])
    return points[box.contains(points)]


@pytest.mark.parametrize("surface", [ground, waves, corner])
@pytest.mark.parametrize("thing", [cube, ball])
@pytest.mark.parametrize("size", [1.0, 1.2])
def test_surface_is_followed_to_the_object_and_no_further(surface: Height, thing: Height, size: float) -> None:
    box = Box.make([0, 0, 0.26], np.array([0.9, 0.9, 0.66]) * size)
    views = views_of(surface, thing)
    found = follow_surface(box, (box,), views)
    points = points_of(views, box)
    off = found.distance(points) / found.cell
    background = (surface(points) < 0.004) & (thing(points) > 2 * found.cell)
    object_ = (thing(points) < 0.004) & (surface(points) > 2 * found.cell)
    assert background.sum() > 500 and object_.sum() > 500
    assert (off[background] < THICKNESS).mean() > 0.97
    assert (off[object_] < THICKNESS).mean() < 0.01


@examples(8)
@given(seed=st.integers(0, 10_000))
def test_turning_the_world_changes_nothing(seed: int) -> None:
    """The box's own axes do not matter: a turned box follows the same floor."""
    rng = np.random.default_rng(seed)
    turn = np.array([np.cos(a := rng.uniform(0, 3)), 0, 0, np.sin(a)])  # about z, so that it holds the cube
    box = Box.make([0, 0, 0.26], [0.95, 0.95, 0.66], turn)
    views = views_of(ground, cube)
    found = follow_surface(box, (box,), views)
    points = points_of(views, box)
    off = found.distance(points) / found.cell
    assert (off[(points[:, 2] < 0.004) & (cube(points) > 2 * found.cell)] < 0.5).mean() > 0.95
    assert (off[points[:, 2] > 2 * found.cell] < 0.5).mean() < 0.01
    assert np.abs(np.abs(found.normals @ quats_to_matrices(turn[None])[0].T)[:, 2]).min() > 0.9


def test_an_object_that_reaches_beyond_the_box_is_not_its_surroundings() -> None:
    box = Box.make([0, 0, 0.35], [0.4, 0.4, 0.5])  # the cube's sides and foot lie outside
    views = views_of(ground, cube)
    found = follow_surface(box, (box,), views)
    points = points_of(views, box)
    assert len(points) > 500 and np.isinf(found.distance(points)).mean() > 0.99


def statue(p: np.ndarray) -> np.ndarray:
    return (np.abs(p - [0, 0, 0.4]) - [0.12, 0.12, 0.4]).max(1)


def plinth(p: np.ndarray) -> np.ndarray:
    """A block 0.7 wide, its top at z = 0, on a floor 0.8 below."""
    block = (np.abs(p - [0, 0, -0.4]) - [0.35, 0.35, 0.4]).max(1)
    return np.minimum(block, p[:, 2] + 0.8)


@cache
def views_of_plinth() -> list[tuple[Camera, np.ndarray]]:
    cameras = orbit_cameras((Box.make([0, 0, 0.4], [0.7, 0.7, 0.9]),), 16, (0, 0, 1), 320, 240, 50)
    return [(c, march(c, lambda p: np.minimum(plinth(p), statue(p)))) for c in cameras]


@pytest.mark.parametrize("width", [0.5, 0.66, 0.8])  # 0.8: all of the top lies in the box
@pytest.mark.parametrize("deep", [0.01, 0.03])
def test_a_plinth_s_top_is_followed_over_its_edge_but_not_what_stands_on_it(width: float, deep: float) -> None:
    box = Box.make([0, 0, 0.41 - deep / 2], [width, width, 0.82 + deep])
    views = views_of_plinth()
    found = follow_surface(box, (box,), views)
    points = points_of(views, box)
    off = found.distance(points) / found.cell
    top = (np.abs(points[:, 2]) < 0.004) & (statue(points) > 2 * found.cell)
    object_ = (statue(points) < 0.004) & (points[:, 2] > 2 * found.cell)
    assert top.sum() > 300 and object_.sum() > 300
    assert (off[object_] < THICKNESS).mean() < 0.02
    assert (off[top] < THICKNESS).mean() > 0.9


@pytest.mark.parametrize(
    "wide, height, kept",
    [(0.8, -0.48, True), (0.8, 0.48, True), (0.3, -0.48, False), (0.8, -0.2, False), (0.8, 0.0, False)],
)
def test_over_edges_only_what_spans_a_face_of_the_box_is_a_top(wide: float, height: float, kept: bool) -> None:
    """Not a facet of the object that the box cut off, however it was reached, nor what lies deeper."""
    box, cell = Box.make([0, 0, 0], [1, 1, 1]), 0.02
    side = np.arange(-wide / 2, wide / 2, cell)
    x, y = (a.ravel() for a in np.meshgrid(side, side))
    points = np.stack([x, y, np.full(len(x), height)], 1)
    dims = (50, 50, 50)
    cells = np.ravel_multi_index(tuple(np.floor((points + 0.5) / cell + 1e-6).astype(int).T), dims)
    order = np.argsort(cells)
    over = np.ones(len(cells), bool)
    assert (_tops(over, cells[order], dims, points[order], box, 0.05) == kept).all()


def test_growth_does_not_start_in_another_box_of_the_region() -> None:
    halves = (Box.make([-0.2, 0, 0.26], [0.5, 0.9, 0.66]), Box.make([0.2, 0, 0.26], [0.5, 0.9, 0.66]))
    views = views_of(ground, cube)
    for half in halves:
        found = follow_surface(half, halves, views)
        points = points_of(views, half)
        assert (found.distance(points[points[:, 2] > 3 * found.cell]) < 0.5 * found.cell).mean() < 0.01


def test_nothing_to_follow() -> None:
    box = Box.make([0, 0, 0.26], [0.9, 0.9, 0.66])
    camera = orbit_cameras((box,), 1, (0, 0, 1), 80, 60, 50)[0]
    found = follow_surface(box, (box,), [(camera, np.zeros((60, 80), np.float32))])
    assert np.isinf(found.distance(np.zeros((4, 3)))).all()
    broken = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, 1e30]])
    assert np.isinf(found.distance(broken)).all()

"""What the views together have seen."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from scenes import cameras, scene

from gimp3d.camera import Camera
from gimp3d.compute.threads import set_thread_count
from gimp3d.geometry import sees, surface_points
from gimp3d.raster import surface_depth
from gimp3d.stages.visibility import BURIED, HIDES, SEEN_PAST, SHOWN, Sight, depth_agreement

CAMERAS = [c.scaled(f) for c, f in zip(cameras(), (1, 0.5, 1.3, 0.77, 1, 1, 1, 1, 1))]
DEPTHS = [surface_depth(scene(), c)[0] for c in CAMERAS]
UP = np.array([0, 0, 1.0])
FAR = np.array([0, 0, 1e6])  # centres beyond all that is seen: tolerances are of z
WHOLE = [(slice(0, c.height), slice(0, c.width)) for c in CAMERAS]


@examples(20)
@given(seed=st.integers(0, 10_000), tolerance=st.floats(0.001, 0.1))
def test_a_point_is_shown_or_seen_past_by_a_view_that_is_not_hidden(seed: int, tolerance: float) -> None:
    rng = np.random.default_rng(seed)
    hidden = [rng.random(d.shape) < 0.3 for d in DEPTHS]
    surface = surface_points(CAMERAS[2], DEPTHS[2], WHOLE[2], 5)[2]
    points = np.concatenate(
        [surface, surface + rng.uniform(0, 2, (len(surface), 1)) * UP, rng.normal(size=(50, 3)) * 9]
    )
    open_ = [(c, np.where(h, 0, d)) for c, d, h in zip(CAMERAS, DEPTHS, hidden)]
    shown = np.any([sees(c, d, points, tolerance) for c, d in open_], axis=0)
    past = np.any([sees_past(c, d, points) for c, d in open_], axis=0)
    found = Sight.make(list(zip(CAMERAS, DEPTHS, hidden)), FAR).of(points, tolerance)
    assert ((found == SHOWN) == shown).all()
    assert ((found == SEEN_PAST) == past & ~shown).all() and len(np.unique(found)) == 4


def test_what_lies_behind_surfaces_in_most_views_is_buried() -> None:
    inside = np.array([[0, 0, 0.2]])
    for count in range(len(CAMERAS) + 1):  # views in which the object hides it; in the others it is a surface
        views = [(c, d, np.full(d.shape, k < count)) for k, (c, d) in enumerate(zip(CAMERAS, DEPTHS))]
        assert Sight.make(views, FAR).of(inside, 0.001)[0] == (HIDES if 2 * count >= len(CAMERAS) else BURIED)


def sees_past(camera: Camera, depth: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[N] bool: the surface that is seen in the point's pixel lies behind it."""
    uv, z = camera.project(points)
    framed = (z > 0) & (uv >= 0).all(1) & (uv < [camera.width, camera.height]).all(1)
    cols, rows = np.where(framed[:, None], uv, 0).astype(int).T
    return framed & (depth[rows, cols] > z)


def test_far_away_disparity_decides() -> None:
    camera, ray = CAMERAS[0], CAMERAS[0].forward
    sky = Sight.make([(camera, np.full((90, 120), 60, np.float32), np.zeros((90, 120), bool))], camera.centre + 3 * ray)
    points = camera.centre + np.array([[50], [70], [100], [30]]) * ray
    assert (sky.of(points, 0.02) == [SHOWN, SHOWN, BURIED, SEEN_PAST]).all()  # 1/50, 1/70 are within 0.02/3 of 1/60


def test_the_answer_does_not_depend_on_threads_or_on_the_order_of_views() -> None:
    points = surface_points(CAMERAS[5], DEPTHS[5], WHOLE[5])[2]
    views = [(c, d, np.zeros(d.shape, bool)) for c, d in zip(CAMERAS[:5], DEPTHS[:5])]
    first = Sight.make(views, FAR).of(points, 0.02)
    set_thread_count(1)
    try:
        assert (Sight.make(views[::-1], FAR).of(points, 0.02) == first).all()
    finally:
        set_thread_count(None)


def test_views_of_one_scene_agree_and_views_of_noise_do_not() -> None:
    assert depth_agreement(CAMERAS, DEPTHS, WHOLE) > 0.95
    rng = np.random.default_rng(0)
    noise = [np.where(d > 0, d * rng.uniform(0.7, 1.3, d.shape), 0).astype(np.float32) for d in DEPTHS]
    assert depth_agreement(CAMERAS, noise, WHOLE) < 0.3
    assert depth_agreement(CAMERAS[:1], noise[:1], WHOLE[:1]) == 1
    empty = [np.zeros_like(d) for d in DEPTHS]
    assert depth_agreement(CAMERAS, empty, WHOLE) == 1

"""What the views together have seen."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import cameras, scene

from gimp3d.raster import surface_depth
from gimp3d.stages.masks import sees
from gimp3d.stages.outline import surface_points
from gimp3d.stages.visibility import Sight, depth_agreement
from gimp3d.threads import set_thread_count

CAMERAS = [c.scaled(f) for c, f in zip(cameras(), (1, 0.5, 1.3, 0.77, 1, 1, 1, 1, 1))]
DEPTHS = [surface_depth(scene(), c)[0] for c in CAMERAS]
WHOLE = [(slice(0, c.height), slice(0, c.width)) for c in CAMERAS]


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), tolerance=st.floats(0.001, 0.1))
def test_a_point_is_seen_if_a_view_shows_it_unhidden(seed: int, tolerance: float) -> None:
    rng = np.random.default_rng(seed)
    hidden = [rng.random(d.shape) < 0.3 for d in DEPTHS]
    surface = surface_points(CAMERAS[2], DEPTHS[2], WHOLE[2], 5)[2]
    points = np.concatenate([surface, surface * rng.uniform(0.8, 1.2, (len(surface), 1)), rng.normal(size=(50, 3)) * 9])
    expected = np.any(
        [sees(c, np.where(h, 0, d), points, tolerance) for c, d, h in zip(CAMERAS, DEPTHS, hidden)], axis=0
    )
    found = Sight.make(list(zip(CAMERAS, DEPTHS, hidden))).shows(points, tolerance)
    assert (found == expected).all() and found.any() and not found.all()


def test_the_answer_does_not_depend_on_threads_or_on_the_order_of_views() -> None:
    points = surface_points(CAMERAS[5], DEPTHS[5], WHOLE[5])[2]
    views = [(c, d, np.zeros(d.shape, bool)) for c, d in zip(CAMERAS[:5], DEPTHS[:5])]
    first = Sight.make(views).shows(points, 0.02)
    set_thread_count(1)
    try:
        assert (Sight.make(views[::-1]).shows(points, 0.02) == first).all()
    finally:
        set_thread_count(None)


def test_views_of_one_scene_agree_and_views_of_noise_do_not() -> None:
    assert depth_agreement(CAMERAS, DEPTHS, WHOLE, 0.02) > 0.95
    rng = np.random.default_rng(0)
    noise = [np.where(d > 0, d * rng.uniform(0.7, 1.3, d.shape), 0).astype(np.float32) for d in DEPTHS]
    assert depth_agreement(CAMERAS, noise, WHOLE, 0.02) < 0.3
    assert depth_agreement(CAMERAS[:1], noise[:1], WHOLE[:1], 0.02) == 1
    empty = [np.zeros_like(d) for d in DEPTHS]
    assert depth_agreement(CAMERAS, empty, WHOLE, 0.02) == 1

"""What the views together have seen."""

from __future__ import annotations

import numpy as np
from scenes import cameras, scene

from gimp3d.camera import Camera
from gimp3d.raster import surface_depth
from gimp3d.stages.visibility import depth_agreement

CAMERAS = [c.scaled(f) for c, f in zip(cameras(), (1, 0.5, 1.3, 0.77, 1, 1, 1, 1, 1))]
DEPTHS = [surface_depth(scene(), c)[0] for c in CAMERAS]
UP = np.array([0, 0, 1.0])
FAR = np.array([0, 0, 1e6])  # centres beyond all that is seen: tolerances are of z
WHOLE = [(slice(0, c.height), slice(0, c.width)) for c in CAMERAS]


def sees_past(camera: Camera, depth: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[N] bool: the surface that is seen in the point's pixel lies behind it."""
    uv, z = camera.project(points)
    framed = (z > 0) & (uv >= 0).all(1) & (uv < [camera.width, camera.height]).all(1)
    cols, rows = np.where(framed[:, None], uv, 0).astype(int).T
    return framed & (depth[rows, cols] > z)


def test_views_of_one_scene_agree_and_views_of_noise_do_not() -> None:
    assert depth_agreement(CAMERAS, DEPTHS, WHOLE) > 0.95
    rng = np.random.default_rng(0)
    noise = [np.where(d > 0, d * rng.uniform(0.7, 1.3, d.shape), 0).astype(np.float32) for d in DEPTHS]
    assert depth_agreement(CAMERAS, noise, WHOLE) < 0.3
    assert depth_agreement(CAMERAS[:1], noise[:1], WHOLE[:1]) == 1
    empty = [np.zeros_like(d) for d in DEPTHS]
    assert depth_agreement(CAMERAS, empty, WHOLE) == 1

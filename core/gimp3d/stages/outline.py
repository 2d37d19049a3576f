"""A box in a view: its outline, the window that holds it, and the guard band round it (paper 3.2)."""

from __future__ import annotations

import cv2
import numpy as np

from ..box import Box
from ..camera import Camera
from ..gaussians import Gaussians
from ..geometry import Window, window_round

GUARD_SCALE = 1.2  # the guard band's size over the polygon's (paper 3.2, s)
# A box's 12 edges, from and to which of Box.corners.
EDGES = np.array([(a, a | 1 << b) for a in range(8) for b in range(3) if not a >> b & 1]).T


def box_polygon(box: Box, camera: Camera, near: float) -> np.ndarray | None:
    """The convex outline of a box in a view, [M, 2] pixels, cut away at z below `near` (scene units) before projecting.

    None if nothing of the box lies in front of the camera.
    """
    points = camera.to_camera(box.corners())
    in_front = points[:, 2] >= near
    a, b = points[EDGES[:, in_front[EDGES[0]] != in_front[EDGES[1]]]]
    s = (near - a[:, 2:]) / (b[:, 2:] - a[:, 2:])
    cut = np.concatenate([points[in_front], a + s * (b - a)])
    if len(cut) < 3:
        return None
    uv = cut[:, :2] / cut[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    hull = cv2.convexHull(uv.astype(np.float32))[:, 0]
    return hull if len(hull) >= 3 else None


def fill_polygon(polygon: np.ndarray, width: int, height: int) -> np.ndarray:
    """[H, W] bool: pixels whose centre lies inside a convex polygon [M, 2] of either orientation, in pixels."""
    mask = np.zeros((height, width), dtype=bool)
    low = np.clip(np.floor(polygon.min(0)), 0, [width, height]).astype(int)
    high = np.clip(np.ceil(polygon.max(0)), 0, [width, height]).astype(int)
    if (high <= low).any():
        return mask
    x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
    mask[low[1] : high[1], low[0] : high[0]] = _inside(polygon.astype(np.float64), x, y)
    return mask


def _inside(polygon: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Bool of x's shape: points on one side of all edges of a convex polygon [M, 2]."""
    edges = list(zip(polygon, np.roll(polygon, -1, axis=0)))
    sides = [(b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) for a, b in edges]
    return np.all([s >= 0 for s in sides], axis=0) | np.all([s <= 0 for s in sides], axis=0)


def guard_gaussians(gaussians: Gaussians, candidates: np.ndarray, polygon: np.ndarray, camera: Camera) -> np.ndarray:
    """[N] bool: candidates [N] with their centre in the guard band of a polygon [M, 2] (paper 3.2, steps 2 and 3)."""
    uv, _ = camera.project(gaussians.means.astype(np.float64))
    rows = np.flatnonzero(candidates & np.isfinite(uv).all(1))
    centre, (u, v) = polygon.mean(0), uv[rows].T
    found = np.zeros(len(uv), bool)
    found[rows] = _inside(centre + GUARD_SCALE * (polygon - centre), u, v) & ~_inside(polygon, u, v)
    return found


def box_window(box: Box, camera: Camera) -> Window:
    """The rectangle that holds a box; the whole picture if the box reaches behind the camera."""
    corners = box.corners()
    if (camera.to_camera(corners)[:, 2] <= 0).any():
        return slice(0, camera.height), slice(0, camera.width)
    return window_round(camera.project(corners)[0], camera, 1)

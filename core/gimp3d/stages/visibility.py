"""What the views together have seen of the scene: each point of space is judged once, whichever view asks.

That makes target regions consistent between views by construction (METHOD section 1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..camera import Camera
from ..jit import exact_kernel
from ..threads import run_ranges

HIDDEN = -1.0  # limit of a pixel that shows no surface but the object's


@dataclass(frozen=True)
class Sight:
    """How far every pixel of every view sees past the object."""

    cameras: np.ndarray  # [V, 18] float64: rotation, translation, fx, fy, cx, cy, width, height
    starts: np.ndarray  # [V] int64, a view's first pixel
    limits: np.ndarray  # float32, z of the first surface of every pixel; HIDDEN where there is none

    @classmethod
    def make(
        cls,
        views: Sequence[tuple[Camera, np.ndarray, np.ndarray]],  # (camera, z-depth with the object, untrusted pixels)
    ) -> Sight:
        """From depth maps [H, W], 0 = nothing, and masks [H, W] bool of the object and of what else hides the scene."""
        order = [views[k] for k in _spread_order(len(views))]
        packed = [np.concatenate([c.R.ravel(), c.t, [c.fx, c.fy, c.cx, c.cy, c.width, c.height]]) for c, _, _ in order]
        limits = [np.where(hidden | (z <= 0), HIDDEN, z).astype(np.float32).ravel() for _, z, hidden in order]
        sizes = np.array([len(part) for part in limits], np.int64)
        return cls(np.array(packed), np.cumsum(sizes) - sizes, np.concatenate(limits))

    def shows(
        self,
        points: np.ndarray,  # [N, 3] scene coordinates
        tolerance: float,  # relative z
    ) -> np.ndarray:
        """[N] bool: the point is the first surface of some view, which is not hidden there."""
        found = np.zeros(len(points), bool)
        arrays = np.ascontiguousarray(points, np.float64), self.cameras, self.starts, self.limits
        run_ranges(_find_view, len(points), *arrays, float(tolerance), found)
        return found


def _spread_order(count: int) -> list[int]:
    """0 … count−1 so that any first few are spread evenly: neighbouring views see the same."""
    return sorted(range(count), key=lambda k: (k * 0.6180339887498949) % 1.0)


@exact_kernel
def _find_view(lo, hi, points, cameras, starts, limits, tolerance, found):
    """found[i] for i in [lo, hi): views are asked in turn until one sees the point."""
    for i in range(lo, hi):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for v in range(len(cameras)):
            c = cameras[v]
            depth = c[6] * x + c[7] * y + c[8] * z + c[11]
            if not depth > 0:
                continue
            col = c[12] * (c[0] * x + c[1] * y + c[2] * z + c[9]) / depth + c[14]
            row = c[13] * (c[3] * x + c[4] * y + c[5] * z + c[10]) / depth + c[15]
            if not (0 <= col < c[16] and 0 <= row < c[17]):
                continue
            limit = limits[starts[v] + int(row) * int(c[16]) + int(col)]
            if abs(depth - limit) <= tolerance * depth:
                found[i] = True
                break

"""What the views together have seen of the scene: each point of space is judged once, whichever view asks.

That makes target regions consistent between views by construction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..camera import Camera
from ..compute.jit import exact_kernel
from ..compute.threads import parallel_map, run_ranges
from ..geometry import SAME_DEPTH, Window, framed, pack_camera, project, surface_points

SAMPLES = 1000  # of each view's surface that are compared with another's, about
HIDDEN = -1.0  # limit of a pixel that shows no surface but the object's
HIDES, BURIED, SEEN_PAST, SHOWN = 0, 1, 2, 3  # what the views together say of a point, see Sight.of


@dataclass(frozen=True)
class Sight:
    """How far every pixel of every view sees past the object."""

    cameras: np.ndarray  # [V, 19] float64, packed, and the distance of the object's centre
    starts: np.ndarray  # [V] int64, a view's first pixel
    limits: np.ndarray  # float32, z of the first surface of every pixel; HIDDEN where there is none

    @classmethod
    def make(cls, views: Sequence[tuple[Camera, np.ndarray, np.ndarray]], centre: np.ndarray) -> Sight:
        """From views' depth maps with the object [H, W], 0 = nothing, and masks [H, W] bool of the object and of what
        else hides the scene; `centre` [3] is the object's, in scene coordinates.
        """
        # Neighbouring views see the same: any first few of the order are spread evenly.
        order = [views[k] for k in sorted(range(len(views)), key=lambda k: (k * 0.6180339887498949) % 1.0)]
        packed = [np.append(pack_camera(c), np.linalg.norm(c.centre - centre)) for c, _, _ in order]
        limits = [np.where(hidden | (z <= 0), HIDDEN, z).astype(np.float32).ravel() for _, z, hidden in order]
        sizes = np.array([len(part) for part in limits], np.int64)
        return cls(np.array(packed), np.cumsum(sizes) - sizes, np.concatenate(limits))

    def of(self, points: np.ndarray, tolerance: float) -> np.ndarray:
        """[N] uint8 of points [N, 3] in scene coordinates: SHOWN if the point is the first surface of some view, which
        is not hidden there; SEEN_PAST if it is not, and some view sees a surface behind it; BURIED if it lies behind
        surfaces in most views, so that it is on none; else HIDES: the object alone hides it. The tolerance is of z
        (relative) up to the centre's distance, beyond it of disparity times that distance.

        What is far away moves little between views, so depths there are little certain, and need not be: a sky's splats
        lie anywhere. A difference of disparity shifts pixels by the same amount at every distance.
        """
        found = np.zeros(len(points), np.uint8)
        arrays = np.ascontiguousarray(points, np.float64), self.cameras, self.starts, self.limits
        run_ranges(_find_view, len(points), *arrays, float(tolerance), found)
        return found


def depth_agreement(cameras: Sequence[Camera], depths: Sequence[np.ndarray], windows: Sequence[Window]) -> float:
    """Share of the surface which, framed by a neighbouring view and not hidden there, is that view's surface too; 1
    where nothing can be compared. Looked at are the windows of the depth maps [H, W], 0 = nothing.
    """
    centres = np.array([c.centre for c in cameras])
    forwards = np.array([c.forward for c in cameras])
    spread = max(1e-12, float(np.median(np.linalg.norm(centres - centres.mean(0), axis=1))))

    def compared(k: int) -> np.ndarray:
        apart = np.linalg.norm(centres - centres[k], axis=1) / spread + 1 - forwards @ forwards[k]
        apart[k] = np.inf
        other = int(apart.argmin())
        _, _, points = surface_points(cameras[k], depths[k], windows[k])
        _, rows, cols, z = framed(cameras[other], points[:: max(1, len(points) // SAMPLES)])
        there = depths[other][rows, cols]
        coarse = max(SAME_DEPTH, 1 / cameras[other].fx)  # a pixel of a small picture holds many depths
        through = (there > z * (1 + coarse)) | (there == 0)
        return np.array([(np.abs(there - z) <= coarse * z).sum(), through.sum()])

    if len(cameras) < 2:
        return 1.0
    same, through = np.sum(parallel_map(compared, range(len(cameras))), axis=0)
    return float(same / (same + through)) if same + through else 1.0


@exact_kernel
def _find_view(lo, hi, points, cameras, starts, limits, tolerance, found):
    """found[i] for i in [lo, hi): views are asked in turn until one shows the point."""
    for i in range(lo, hi):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        hidden = 0  # views in which the object hides the point, less those in which a surface does
        for v in range(len(cameras)):
            c = cameras[v]
            col, row, depth = project(c, x, y, z)
            if not (0 <= col < c[16] and 0 <= row < c[17]):
                continue
            limit = limits[starts[v] + int(row) * int(c[16]) + int(col)]
            if abs(depth - limit) <= tolerance * depth * max(1.0, limit / c[18]):
                found[i] = SHOWN
                break
            if limit > depth:
                found[i] = SEEN_PAST
            hidden += 1 if limit == HIDDEN else -1
        if found[i] == HIDES and hidden < 0:
            found[i] = BURIED

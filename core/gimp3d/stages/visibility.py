"""Whether views agree on where surfaces are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..camera import Camera
from ..compute.threads import parallel_map
from ..geometry import SAME_DEPTH, Window, framed, surface_points

SAMPLES = 1000  # of each view's surface that are compared with another's, about


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

"""Where rays of a view meet surfaces that are seen straight on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ...camera import Camera
from ...compute.jit import exact_kernel
from ...compute.threads import run_ranges
from ...geometry import pack_camera, project
from .plane import Plane


@dataclass(frozen=True)
class Facing:
    """A surface seen straight on, as photos show it; arrays [H, W] of its camera."""

    plane: Plane
    camera: Camera
    depth: np.ndarray  # float32 z of the surface
    there: np.ndarray  # bool, the surface is there: beyond its edges, what lies behind it shows
    image: np.ndarray  # [H, W, 3] uint8, from photos; 0 where none shows it
    known: np.ndarray  # bool, photos show it, and much the same
    hole: np.ndarray  # bool, the object hides it, or photos may show some of the object there

    def points(self, scale: float = 1) -> np.ndarray:
        """[h, w, 3] scene coordinates of its texels, or of smaller ones."""
        camera = self.camera.scaled(scale)
        z = cv2.resize(self.depth, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)
        return camera.unproject(camera.pixel_centres(), z.astype(np.float64))


@dataclass(frozen=True)
class Hits:
    """What a view's rays meet of surfaces; arrays [H, W] of the view."""

    chart: np.ndarray  # int8, index of the surface met first; −1: none
    depth: np.ndarray  # float32, z there; 0: none
    rows: np.ndarray  # int32, the surface's texel
    cols: np.ndarray

    def behind(self, depth: np.ndarray, tolerance: float) -> np.ndarray:
        """[H, W] bool: the surface lies behind what the view draws (z or 0), by more than a relative tolerance."""
        return (depth > 0) & (depth < (1 - tolerance) * self.depth)


def pictured(surfaces: Sequence[Facing], hits: Hits) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the surfaces show where a view meets them, [H, W, 3] uint8, where that is known, and holes, [H, W] bool."""
    image = np.zeros((*hits.chart.shape, 3), np.uint8)
    known, hole = np.zeros((2, *hits.chart.shape), bool)
    for number, surface in enumerate(surfaces):
        on = hits.chart == number
        at = hits.rows[on], hits.cols[on]
        image[on], known[on], hole[on] = surface.image[at], surface.known[at], surface.hole[at]
    return image, known, hole


def first_hits(
    surfaces: Sequence[Facing],
    camera: Camera,
    pixels: np.ndarray,  # [H, W] bool, the rays that are asked for
) -> Hits:
    """Where rays meet the first of the surfaces: in a room seen from inside, that is what shows."""
    shape = pixels.shape
    hits = Hits(np.full(shape, -1, np.int8), np.zeros(shape, np.float32), *np.zeros((2, *shape), np.int32))
    rows, cols = np.nonzero(pixels)
    for k, surface in enumerate(surfaces):
        where = pack_camera(camera), pack_camera(surface.camera), surface.depth, surface.there
        run_ranges(_meet_range, len(rows), rows, cols, *where, k, hits.chart, hits.depth, hits.rows, hits.cols)
    return hits


@exact_kernel
def _meet_range(lo, hi, rows, cols, c, m, depth, there, number, chart, met, texel_rows, texel_cols):
    """Rays of camera c against the surface of camera m, whose z is near constant: fixed-point steps along the ray."""
    ox = -(c[0] * c[9] + c[3] * c[10] + c[6] * c[11])
    oy = -(c[1] * c[9] + c[4] * c[10] + c[7] * c[11])
    oz = -(c[2] * c[9] + c[5] * c[10] + c[8] * c[11])
    height, width = depth.shape
    for i in range(lo, hi):
        a, b = (cols[i] + 0.5 - c[14]) / c[12], (rows[i] + 0.5 - c[15]) / c[13]
        dx = c[0] * a + c[3] * b + c[6]
        dy = c[1] * a + c[4] * b + c[7]
        dz = c[2] * a + c[5] * b + c[8]
        speed = m[6] * dx + m[7] * dy + m[8] * dz
        start = m[6] * ox + m[7] * oy + m[8] * oz + m[11]
        if not speed > 1e-9:
            continue
        z, row, col, inside = depth[height // 2, width // 2] * 1.0, 0, 0, False
        for _ in range(12):
            t = (z - start) / speed
            x, y, w = ox + t * dx, oy + t * dy, oz + t * dz
            u, v, _ = project(m, x, y, w)
            inside = 0 <= u < width and 0 <= v < height
            if not inside:
                break
            row, col = int(v), int(u)
            if abs(depth[row, col] - z) < 1e-6 * z:
                break
            z += 0.7 * (depth[row, col] - z)
        t = (z - start) / speed
        if not inside or not t > 0 or not there[row, col]:
            continue
        before = met[rows[i], cols[i]]
        if before == 0 or t < before:
            chart[rows[i], cols[i]], met[rows[i], cols[i]] = number, t
            texel_rows[rows[i], cols[i]], texel_cols[rows[i], cols[i]] = row, col

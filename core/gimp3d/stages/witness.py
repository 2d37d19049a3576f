"""What the photos say of points in space: which show them, in which the object hides them, and how alike they look."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np

from ..camera import Camera
from ..compute.jit import exact_kernel, kernel
from ..compute.threads import parallel_map, run_ranges
from ..geometry import cropped
from ..raster import Window

FINE, COARSE = 1.0, 8.0  # px, σ of the two blurs between whose results photos are compared: texture, not light
LOUD = 127  # grey levels beyond which a difference counts no more; kept as int8
AGREEING = 3  # photos that must show a point for their agreement to be asked


class Says(IntEnum):
    """What a photo says of a point."""

    NOTHING = 0  # out of its frame
    SEEN = 1  # it lies on the surface shown
    HIDDEN = 2  # the object is in the way
    BEHIND = 3  # something else is
    THROUGH = 4  # what is shown lies behind it: nothing is there
    BESIDE = 5  # it lies on the surface shown, but right beside the object: the pixel may show both


NOTHING, SEEN, HIDDEN, BEHIND, THROUGH, BESIDE = 0, 1, 2, 3, 4, 5  # the same, for the kernels


@dataclass(frozen=True)
class Witness:
    """A view as evidence."""

    camera: Camera
    photo: np.ndarray  # [H, W, 3] uint8
    hidden: np.ndarray  # [H, W] bool, where the photo shows the object
    beside: np.ndarray  # [H, W] bool, where it may show some of it
    depth: np.ndarray  # [H, W] float32 z of the scene with the object, 0 = nothing

    def cropped(self, window: Window) -> Witness:
        maps = (np.ascontiguousarray(a[window]) for a in (self.photo, self.hidden, self.beside, self.depth))
        return Witness(cropped(self.camera, window), *maps)


def pack(camera: Camera) -> np.ndarray:
    """[18] float64 for kernels: rotation, translation, fx, fy, cx, cy, width, height."""
    c = camera
    return np.concatenate([c.R.ravel(), c.t, [c.fx, c.fy, c.cx, c.cy, c.width, c.height]])


def ask(
    witnesses: Sequence[Witness],
    points: np.ndarray,  # [N, 3] scene coordinates
    tolerance: float,  # relative z within which a point lies on the surface shown
) -> np.ndarray:
    """What every view says of every point, [V, N] uint8, see Says."""
    points = np.ascontiguousarray(points, np.float64)

    def of(witness: Witness) -> np.ndarray:
        said = np.zeros(len(points), np.uint8)
        depth = np.ascontiguousarray(witness.depth, np.float32)
        _ask_range(0, len(points), points, pack(witness.camera), witness.hidden, witness.beside, depth, tolerance, said)
        return said

    return np.array(parallel_map(of, witnesses), np.uint8).reshape(len(witnesses), len(points))


@exact_kernel
def _ask_range(lo, hi, points, c, hidden, beside, depth, tolerance, said):
    for i in range(lo, hi):
        x, y, w = points[i, 0], points[i, 1], points[i, 2]
        z = c[6] * x + c[7] * y + c[8] * w + c[11]
        if not z > 0:
            continue
        u = c[12] * (c[0] * x + c[1] * y + c[2] * w + c[9]) / z + c[14]
        v = c[13] * (c[3] * x + c[4] * y + c[5] * w + c[10]) / z + c[15]
        if not (0 <= u < c[16] and 0 <= v < c[17]):
            continue
        row, col = int(v), int(u)
        front = depth[row, col]
        if hidden[row, col]:
            said[i] = HIDDEN
        elif 0 < front < (1 - tolerance) * z:
            said[i] = BEHIND
        elif front > (1 + tolerance) * z or front == 0:
            said[i] = THROUGH
        else:
            said[i] = BESIDE if beside[row, col] else SEEN


def texture(
    photo: np.ndarray,  # [H, W, 3] uint8
    shown: np.ndarray,  # [H, W] bool, pixels that count
) -> np.ndarray:
    """Band-passed luminance, [H, W] int8 in half grey levels: what tells places apart, whatever the light."""
    grey, weight = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY).astype(np.float32), shown.astype(np.float32)

    def blurred(sigma: float) -> np.ndarray:
        total = cv2.GaussianBlur(grey * weight, (0, 0), sigma)
        return total / np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-3)

    return np.clip(np.rint(2 * (blurred(FINE) - blurred(COARSE))), -LOUD, LOUD).astype(np.int8)


@dataclass(frozen=True)
class Textures:
    """Photos reduced to their texture, for comparing; see agreement."""

    cameras: np.ndarray  # [V, 18]
    starts: np.ndarray  # [V] int64, a view's first pixel
    values: np.ndarray  # int8, band-passed luminance of all views; −128 where it is hidden

    @classmethod
    def make(cls, witnesses: Sequence[Witness], most: int = 32, shrink: int = 1) -> Textures:
        """Of `most` views, evenly chosen, in pictures smaller by a whole factor."""
        count = min(len(witnesses), most)
        used = [witnesses[k * len(witnesses) // count] for k in range(count)]

        def of(witness: Witness) -> tuple[np.ndarray, np.ndarray]:
            hidden = witness.hidden | witness.beside  # the object's edge is no texture of what is beside it
            h, w = (n // shrink for n in hidden.shape)
            whole = slice(0, h * shrink), slice(0, w * shrink)
            photo = cv2.resize(witness.photo[whole], (w, h), interpolation=cv2.INTER_AREA)
            hidden = hidden[whole].reshape(h, shrink, w, shrink).any((1, 3))
            camera = pack(witness.camera)
            camera[12:16] /= shrink
            camera[16:] = w, h
            return camera, np.where(hidden, np.int8(-128), texture(photo, ~hidden)).ravel()

        cameras, values = zip(*parallel_map(of, used))
        sizes = np.array([len(v) for v in values], np.int64)
        return cls(np.array(cameras), np.cumsum(sizes) - sizes, np.concatenate(values))

    def agreement(
        self,
        points: np.ndarray,  # [N, 3] scene coordinates, on a surface
    ) -> float:
        """How alike photos look at the points, 0 to 1: the share of their texture's energy that they have in common.

        Σ n m² / Σ t² over points that at least three photos show, t a photo's value there, m their mean. It is
        greatest where the points lie on the real surface (plane sweep: Collins 1996).
        """
        common, total = self.energy(points).sum(0)
        return float(common / total) if total > 0 else 0.0

    def energy(self, points: np.ndarray) -> np.ndarray:
        """[N, 2]: what the photos have in common at each point, n m², and all they show there, Σ t²."""
        energy = np.zeros((len(points), 2))
        points = np.ascontiguousarray(points, np.float64)
        run_ranges(_compare_range, len(points), points, self.cameras, self.starts, self.values, AGREEING, energy)
        return energy


@kernel
def _compare_range(lo, hi, points, cameras, starts, values, least, energy):
    for i in range(lo, hi):
        x, y, w = points[i, 0], points[i, 1], points[i, 2]
        count, total, squares = 0, 0.0, 0.0
        for k in range(len(cameras)):
            c = cameras[k]
            z = c[6] * x + c[7] * y + c[8] * w + c[11]
            if not z > 0:
                continue
            u = c[12] * (c[0] * x + c[1] * y + c[2] * w + c[9]) / z + c[14] - 0.5
            v = c[13] * (c[3] * x + c[4] * y + c[5] * w + c[10]) / z + c[15] - 0.5
            width, height = int(c[16]), int(c[17])
            if not (0 <= u < width - 1 and 0 <= v < height - 1):
                continue
            col, row = int(u), int(v)
            s, t = u - col, v - row
            at = starts[k] + row * width + col
            a, b = values[at], values[at + 1]
            d, e = values[at + width], values[at + width + 1]
            if a == -128 or b == -128 or d == -128 or e == -128:
                continue
            value = (1 - t) * ((1 - s) * a + s * b) + t * ((1 - s) * d + s * e)
            count += 1
            total += value
            squares += value * value
        if count >= least:
            energy[i, 0] = total * total / count
            energy[i, 1] = squares


@exact_kernel
def meet_range(lo, hi, rows, cols, c, m, depth, there, number, chart, met, texel_rows, texel_cols):
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
            front = m[6] * x + m[7] * y + m[8] * w + m[11]
            u = m[12] * (m[0] * x + m[1] * y + m[2] * w + m[9]) / front + m[14]
            v = m[13] * (m[3] * x + m[4] * y + m[5] * w + m[10]) / front + m[15]
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

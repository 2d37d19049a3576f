"""What the photos say of points in space: which show them, in which the object hides them, and how alike they look.

And one picture of a surface from all photos that show it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import TypeVar

import cv2
import numpy as np

from ..camera import Camera
from ..compute.jit import exact_kernel, inline_kernel
from ..compute.threads import parallel_map, run_ranges
from ..geometry import Window, blurred, bounds, cropped, pack_camera, project

FINE, COARSE = 1.0, 8.0  # px, σ of the two blurs between whose results photos are compared: texture, not light
LOUDEST = 127  # grey levels beyond which a difference counts no more; kept as int8
AT_ONCE = 8  # views whose results are in memory together
TOGETHER = 128  # points that are compared at once
SUBPIXEL = 256  # steps of a pixel in which photos are read
AGREEING = 3  # photos that must show a point for their agreement to be asked
APART = 17  # px beyond what photos show, half of the widest blur's reach: it is not mirrored into that
SEAM = 4.0  # px, σ below which detail is the best photo's, above which colour is what most photos say
FEW = 12.0  # grey levels by which a photo may always differ from what most say
LOUD = 3.0  # times the spread of textures, by which its detail may besides: more is the edge of something before it

T = TypeVar("T")


class Says(IntEnum):
    """What a photo says of a point."""

    NOTHING = 0  # out of its frame
    SEEN = 1  # it lies on the surface shown
    HIDDEN = 2  # the object is in the way
    BEHIND = 3  # something else is
    THROUGH = 4  # what is shown lies behind it: nothing is there
    BESIDE = 5  # it lies on the surface shown, but right beside the object: the pixel may show both


@dataclass(frozen=True)
class Witness:
    """A view as evidence."""

    camera: Camera
    photo: np.ndarray  # [H, W, 3] uint8
    hidden: np.ndarray  # [H, W] bool, where the photo shows the object
    beside: np.ndarray  # [H, W] bool, where it may show some of it
    veiled: np.ndarray  # [H, W] bool, where the scene draws no solid surface, or what stands before the object
    depth: np.ndarray  # [H, W] float32 z of the scene with the object, 0 = nothing

    def cropped(self, window: Window) -> Witness:
        maps = (self.photo, self.hidden, self.beside, self.veiled, self.depth)
        return Witness(cropped(self.camera, window), *(np.ascontiguousarray(m[window]) for m in maps))

    @property
    def depth_beside(self) -> np.ndarray:
        """[H, W] z of the solid surfaces beside the object; 0 elsewhere."""
        return np.where(self.hidden | self.veiled, 0, self.depth)


def ask(witnesses: Sequence[Witness], points: np.ndarray, tolerance: float) -> np.ndarray:
    """What every view says of every point [N, 3], [V, N] uint8, see Says.

    A point lies on the surface shown within a tolerance, relative to z.
    """
    points = np.ascontiguousarray(points, np.float64)

    def of(witness: Witness) -> np.ndarray:
        said = np.zeros(len(points), np.uint8)
        maps = witness.hidden, witness.beside, np.ascontiguousarray(witness.depth, np.float32)
        _ask_range(0, len(points), points, pack_camera(witness.camera), *maps, tolerance, said)
        return said

    return np.array(parallel_map(of, witnesses), np.uint8).reshape(len(witnesses), len(points))


def spread(items: Sequence[T], most: int) -> list[T]:
    """As many of the items, evenly."""
    count = min(most, len(items))
    return [items[k * len(items) // count] for k in range(count)]


def total_over(items: Sequence[T], work: Callable[[T], np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    """The sum of arrays of a shape that `work` makes of items, such as views."""
    total = np.zeros(shape)
    for start in range(0, len(items), AT_ONCE):
        for part in parallel_map(work, items[start : start + AT_ONCE]):
            total += part
    return total


@exact_kernel
def _ask_range(lo, hi, points, c, hidden, beside, depth, tolerance, said):
    for i in range(lo, hi):
        u, v, z = project(c, points[i, 0], points[i, 1], points[i, 2])
        if not (0 <= u < c[16] and 0 <= v < c[17]):
            continue
        row, col = int(v), int(u)
        front = depth[row, col]
        if hidden[row, col]:
            said[i] = Says.HIDDEN
        elif 0 < front < (1 - tolerance) * z:
            said[i] = Says.BEHIND
        elif front > (1 + tolerance) * z or front == 0:
            said[i] = Says.THROUGH
        else:
            said[i] = Says.BESIDE if beside[row, col] else Says.SEEN


def texture(photo: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Band-passed luminance, [H, W] int8 in half grey levels: what tells places apart, whatever the light.

    Of a photo [H, W, 3] uint8 only the pixels shown, [H, W] bool, count.
    """
    grey = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY)
    bands = blurred(grey, shown, FINE) - blurred(grey, shown, COARSE)
    return np.clip(np.rint(2 * bands), -LOUDEST, LOUDEST).astype(np.int8)


@dataclass(frozen=True)
class Textures:
    """Photos reduced to their texture, for comparing; see agreement."""

    witnesses: Sequence[Witness]  # [V], those that are compared
    cameras: np.ndarray  # [V, 18]
    starts: np.ndarray  # [V] int64, a view's first pixel
    values: np.ndarray  # int8, band-passed luminance of all views; −128 where it is hidden

    @classmethod
    def make(cls, witnesses: Sequence[Witness], most: int = 32, shrink: int = 1) -> Textures:
        """Of `most` views, evenly chosen, in pictures smaller by a whole factor."""

        def of(witness: Witness) -> tuple[np.ndarray, np.ndarray]:
            hidden = witness.hidden | witness.beside  # the object's edge is no texture of what is beside it
            h, w = (n // shrink for n in hidden.shape)
            whole = slice(0, h * shrink), slice(0, w * shrink)
            photo = cv2.resize(witness.photo[whole], (w, h), interpolation=cv2.INTER_AREA)
            hidden = hidden[whole].reshape(h, shrink, w, shrink).any((1, 3))
            camera = pack_camera(witness.camera)
            camera[12:16] /= shrink
            camera[16:] = w, h
            return camera, np.where(hidden, np.int8(-128), texture(photo, ~hidden)).ravel()

        witnesses = spread(witnesses, most)
        cameras, values = zip(*parallel_map(of, witnesses))
        sizes = np.array([len(v) for v in values], np.int64)
        return cls(witnesses, np.array(cameras), np.cumsum(sizes) - sizes, np.concatenate(values))

    def agreement(self, points: np.ndarray, free: np.ndarray | None = None) -> float:
        """How alike photos look at points [N, 3], 0 to 1: the share of their texture's energy that they have in common.

        Σ n m² / Σ t² over points that at least three photos show, t a photo's value there, m their mean. It is
        greatest where the points lie on the real surface (plane sweep: Collins 1996). Of each point only the photos
        count that are `free` to see it, [N, V] bool; all without.
        """
        common, total = self.energies(points, free).sum(0)
        return float(common / total) if total > 0 else 0.0

    def energies(self, points: np.ndarray, free: np.ndarray | None = None) -> np.ndarray:
        """[N, 2]: the energy that photos' textures have in common at each point, and all of it; see agreement."""
        energy, points = np.zeros((len(points), 2)), np.ascontiguousarray(points, np.float64)
        free = np.ones((len(points), len(self.cameras)), bool) if free is None else free
        run_ranges(_compare_range, len(points), points, free, self.cameras, self.starts, self.values, AGREEING, energy)
        return energy


@exact_kernel  # points may be NaN
def _compare_range(lo, hi, points, free, cameras, starts, values, least, energy):
    place, side, down = np.empty(TOGETHER, np.int64), np.empty(TOGETHER), np.empty(TOGETHER)
    count, total, squares = np.empty(TOGETHER), np.empty(TOGETHER), np.empty(TOGETHER)
    x, y, z = np.empty(TOGETHER), np.empty(TOGETHER), np.empty(TOGETHER)
    for first in range(lo, hi, TOGETHER):
        n = min(TOGETHER, hi - first)
        for i in range(n):
            x[i], y[i], z[i] = points[first + i]
            count[i] = total[i] = squares[i] = 0.0
        for k in range(len(cameras)):
            r00, r01, r02, r10, r11, r12, r20, r21, r22, t0, t1, t2, fx, fy, cx, cy, width, height = cameras[k]
            row = int(width)
            for i in range(n):  # without branches and without calls: several points at a time
                depth = r20 * x[i] + r21 * y[i] + r22 * z[i] + t2
                u = fx * (r00 * x[i] + r01 * y[i] + r02 * z[i] + t0) / depth + cx
                v = fy * (r10 * x[i] + r11 * y[i] + r12 * z[i] + t1) / depth + cy
                # to 1/256 px: a ray through a pixel's centre must not fall to either side of it by rounding
                u, v = np.rint((u - 0.5) * SUBPIXEL) / SUBPIXEL, np.rint((v - 0.5) * SUBPIXEL) / SUBPIXEL
                framed = (depth > 1e-9) & (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)
                u, v = u if framed else 0.0, v if framed else 0.0
                left, top = np.floor(u), np.floor(v)
                side[i], down[i] = u - left, v - top
                place[i] = int(top) * row + int(left) if framed else -1
            for i in range(n):
                if place[i] < 0 or not free[first + i, k]:
                    continue
                at, s, t = starts[k] + place[i], side[i], down[i]
                a, b, d, e = values[at], values[at + 1], values[at + row], values[at + row + 1]
                if a == -128 or b == -128 or d == -128 or e == -128:
                    continue
                value = (1 - t) * ((1 - s) * a + s * b) + t * ((1 - s) * d + s * e)
                count[i] += 1
                total[i] += value
                squares[i] += value * value
        for i in range(n):
            if count[i] >= least:
                energy[first + i, 0] = total[i] * total[i] / count[i]
                energy[first + i, 1] = squares[i]


def mosaic(
    points: np.ndarray,  # [H, W, 3] scene coordinates of its texels
    normal: np.ndarray,  # [3] unit
    witnesses: Sequence[Witness],
    said: np.ndarray,  # [V, H, W], see ask
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[H, W, 3] uint8: colours that most photos agree on, as sharp as the photo that shows the place best; 0 of none.

    And by how much photos' textures differ round each texel, [H, W] float32 grey levels, the median over photos: things
    that do not lie on the surface show another texture in each, whatever the light. And how loud the texture is that
    most of them show, likewise: a loud one differs more where photos are a little misplaced.

    Where photos disagree, the median of each channel decides. As misplaced photos blur its detail, that comes from one
    photo at a time, brought to the median's colours by a smooth correction: the one with most pixels there of those
    that need little of it. So no seam shows between photos (two bands of Burt & Adelson 1983).
    """
    image, (spread, loud) = np.zeros(points.shape, np.uint8), np.zeros((2, *points.shape[:2]), np.float32)
    clear = (said == Says.SEEN).any(0)  # elsewhere what is beside the object has to do
    told = np.where(clear, said == Says.SEEN, said == Says.BESIDE)
    window = bounds(told.any(0), APART)
    if told.any():
        image[window], spread[window], loud[window] = _mosaic(points[window], normal, witnesses, told[:, *window])
    return image, spread, loud


def _mosaic(
    points: np.ndarray, normal: np.ndarray, witnesses: Sequence[Witness], told: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """See mosaic; `told` [V, H, W] bool: by which photos."""
    h, w = points.shape[:2]
    flat = np.ascontiguousarray(points.reshape(-1, 3), np.float64)

    def of(k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        (x, y), density = np.empty((2, h, w), np.float32), np.empty(h * w, np.float32)
        seen_by = pack_camera(witnesses[k].camera), witnesses[k].camera.centre
        _look_range(0, h * w, flat, normal, *seen_by, told[k].ravel(), x.reshape(-1), y.reshape(-1), density)
        sample = cv2.remap(witnesses[k].photo, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return sample.reshape(-1, 3), texture(sample, told[k]).ravel(), density

    parts = parallel_map(of, range(len(witnesses)))
    samples, textures, density = (np.array([p[k] for p in parts]) for k in range(3))
    middle, (spread, loud) = np.zeros((h * w, 3), np.float32), np.zeros((2, h * w), np.float32)
    run_ranges(_agree_range, h * w, samples, textures, density, middle, spread, loud)
    several = (density > 0).sum(0).reshape(h, w) > 1  # one photo agrees with itself
    spread, loud = (blurred(a.reshape(h, w), several, SEAM) for a in (spread, loud))

    def correction(k: int) -> np.ndarray:
        off = blurred((middle - samples[k]).reshape(h, w, 3), told[k], SEAM)
        return np.clip(np.rint(off), -128, 127).astype(np.int8).reshape(-1, 3)

    corrections = np.array(parallel_map(correction, range(len(witnesses))))
    picture = middle.copy()
    run_ranges(_choose_range, h * w, samples, corrections, density, middle, FEW, FEW + LOUD * spread.ravel(), picture)
    return np.clip(np.rint(picture), 0, 255).reshape(h, w, 3).astype(np.uint8), spread, loud


@exact_kernel
def _look_range(lo, hi, points, normal, c, centre, told, x, y, density):
    """Where a camera shows points, from pixels' centres, and how many of its pixels fall on a unit of their surface; 0
    where it is not told."""
    for i in range(lo, hi):
        u, v, z = project(c, points[i, 0], points[i, 1], points[i, 2])
        x[i], y[i], density[i] = max(u, -1e4) - 0.5, max(v, -1e4) - 0.5, 0.0
        if told[i]:
            along, square = 0.0, 0.0
            for k in range(3):
                towards = centre[k] - points[i, k]
                along += towards * normal[k]
                square += towards * towards
            density[i] = max(along / math.sqrt(square), 0.02) * c[12] * c[13] / max(z, 1e-9) ** 2


@exact_kernel
def _agree_range(lo, hi, samples, textures, density, middle, spread, loud):
    values, apart = np.empty((2, len(samples)))
    for i in range(lo, hi):
        for channel in range(4):  # the fourth is texture
            count = 0
            for k in range(len(samples)):
                if density[k, i] > 0:
                    _insert(values, count, samples[k, i, channel] if channel < 3 else textures[k, i])
                    count += 1
            if count == 0:
                break
            if channel < 3:
                middle[i, channel] = 0.5 * (values[(count - 1) // 2] + values[count // 2])
            else:
                loud[i] = 0.5 * abs(values[count // 2])
                for k in range(count):
                    _insert(apart, k, abs(values[k] - values[count // 2]))
                spread[i] = 0.5 * apart[count // 2]


@inline_kernel
def _insert(values, count, value):
    """Keep so many values, and one more, in order."""
    j = count
    while j > 0 and values[j - 1] > value:
        values[j] = values[j - 1]
        j -= 1
    values[j] = value


@exact_kernel
def _choose_range(lo, hi, samples, corrections, density, middle, few, loud, picture):
    for i in range(lo, hi):
        least, largest = 127.0, 0.0
        for k in range(len(samples)):  # the nearest to the median always agrees
            if density[k, i] > 0:
                least = min(least, _most(corrections, k, i))
        for k in range(len(samples)):
            if not density[k, i] > largest or _most(corrections, k, i) > max(few, least):
                continue
            off = 0.0
            for channel in range(3):
                off = max(off, abs(samples[k, i, channel] + corrections[k, i, channel] - middle[i, channel]))
            if off <= loud[i]:
                largest = density[k, i]
                for channel in range(3):
                    picture[i, channel] = samples[k, i, channel] + corrections[k, i, channel]


@inline_kernel
def _most(corrections, k, i):
    return max(abs(float(corrections[k, i, 0])), abs(float(corrections[k, i, 1])), abs(float(corrections[k, i, 2])))

"""What the photos say of points in space: which show them, in which the object hides them, and how alike they look."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import TypeVar

import cv2
import numpy as np

from ..camera import Camera
from ..compute.jit import exact_kernel
from ..compute.threads import parallel_map, run_ranges
from ..geometry import Window, cropped, pack_camera, project

FINE, COARSE = 1.0, 8.0  # px, σ of the two blurs between whose results photos are compared: texture, not light
LOUD = 127  # grey levels beyond which a difference counts no more; kept as int8
AT_ONCE = 8  # views whose results are in memory together
SUBPIXEL = 256  # steps of a pixel in which photos are read
AGREEING = 3  # photos that must show a point for their agreement to be asked

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

        cameras, values = zip(*parallel_map(of, spread(witnesses, most)))
        sizes = np.array([len(v) for v in values], np.int64)
        return cls(np.array(cameras), np.cumsum(sizes) - sizes, np.concatenate(values))

    def agreement(self, points: np.ndarray) -> float:
        """How alike photos look at points [N, 3], 0 to 1: the share of their texture's energy that they have in common.

        Σ n m² / Σ t² over points that at least three photos show, t a photo's value there, m their mean. It is
        greatest where the points lie on the real surface (plane sweep: Collins 1996).
        """
        energy, points = np.zeros((len(points), 2)), np.ascontiguousarray(points, np.float64)
        run_ranges(_compare_range, len(points), points, self.cameras, self.starts, self.values, AGREEING, energy)
        common, total = energy.sum(0)
        return float(common / total) if total > 0 else 0.0


@exact_kernel  # points may be NaN
def _compare_range(lo, hi, points, cameras, starts, values, least, energy):
    for i in range(lo, hi):
        x, y, w = points[i, 0], points[i, 1], points[i, 2]
        count, total, squares = 0, 0.0, 0.0
        for k in range(len(cameras)):
            c = cameras[k]
            u, v, _ = project(c, x, y, w)
            # to 1/256 px: a ray through a pixel's centre must not fall to either side of it by rounding
            u, v = np.rint((u - 0.5) * SUBPIXEL) / SUBPIXEL, np.rint((v - 0.5) * SUBPIXEL) / SUBPIXEL
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

"""Square patches of a picture: how they lie in memory, and their main components."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from numba import float32

from ..compute.jit import kernel
from ..compute.simd import LANES, fma16, load1, load16, splat16, store16
from ..compute.threads import run_ranges

SAMPLES = 4096  # patches that the main components are found from
BOUND = 0.9999  # by which coordinates are shortened: rounding must not lift their distance above the patches'


class Patches(NamedTuple):
    """A picture laid out so that kernels read a row of a patch as vectors of 16."""

    values: np.ndarray  # flat float32: rows of pixels with their channels, mirrored at the border
    stride: int  # values from one row to the next
    channels: int
    radius: int
    weights: np.ndarray  # [vectors per row · 16] float32: 1 / values of a patch, 0 for what lies beyond the row

    def starts(self, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
        """Where in `values` the patches centred on these pixels begin."""
        return rows.astype(np.int64) * self.stride + cols * self.channels


def lay_out(channels: np.ndarray, radius: int) -> Patches:
    """Patches of side 2·radius + 1 of `channels` [H, W, C] float32, finite; at the border they see it mirrored."""
    count, size = channels.shape[2], 2 * radius + 1
    weights = np.zeros(-(-size * count // LANES) * LANES, np.float32)
    weights[: size * count] = 1 / (size * size * count)
    bordered = cv2.copyMakeBorder(channels, radius, radius, radius, radius, cv2.BORDER_REFLECT_101)
    values = np.zeros(bordered.size + len(weights), np.float32)  # the last row's vectors may reach beyond it
    values[: bordered.size] = bordered.ravel()
    return Patches(values, bordered.shape[1] * count, count, radius, weights)


def repainting(patches: Patches, changing: np.ndarray) -> Callable[[np.ndarray], None]:
    """What puts new colours [N, C] of the pixels `changing` ([H, W] bool), in the order of np.nonzero, into `values`.

    Laying a large picture out anew for a small hole is slow.
    """
    numbers, r = np.full(changing.shape, -1, np.int32), patches.radius
    numbers[changing] = np.arange(changing.sum())
    bordered = cv2.copyMakeBorder(numbers, r, r, r, r, cv2.BORDER_REFLECT_101).ravel()
    places = np.flatnonzero(bordered >= 0)  # at the border, a pixel lies there more than once
    pixels, numbers = patches.values[: bordered.size * patches.channels].reshape(bordered.size, -1), bordered[places]

    def repaint(colours: np.ndarray) -> None:
        pixels[places] = colours[numbers]

    return repaint


class Components(NamedTuple):
    """Coordinates of patches: squared distances between them never exceed the patches' mean squared difference."""

    mean: np.ndarray  # [values of a patch] float32
    basis: np.ndarray  # [values of a patch, 16] float32


def main_components(patches: Patches, starts: np.ndarray) -> Components:
    """Of a sample of the patches that begin at `starts` (PCA); patches of fewer than 16 values leave zeros."""
    size = 2 * patches.radius + 1
    chosen = starts[:: -(-len(starts) // SAMPLES)]
    within = np.arange(size)[:, None] * patches.stride + np.arange(size * patches.channels)
    sample = patches.values[chosen[:, None] + within.ravel()].astype(np.float64)
    mean = sample.mean(0)
    vectors = np.linalg.eigh((sample - mean).T @ (sample - mean))[1][:, ::-1][:, :LANES]
    basis = np.zeros((within.size, LANES), np.float32)
    basis[:, : vectors.shape[1]] = vectors * (BOUND / np.sqrt(within.size))
    return Components(mean.astype(np.float32), basis)


def coordinates(patches: Patches, components: Components, starts: np.ndarray) -> np.ndarray:
    """[N, 16] float32 of the patches that begin at `starts` [N] int64."""
    out = np.empty((len(starts), LANES), np.float32)
    size = 2 * patches.radius + 1
    parts = components.mean, components.basis.ravel(), starts, out.ravel()
    run_ranges(_project, len(starts), patches.values, patches.stride, size, size * patches.channels, *parts)
    return out


@kernel
def _project(lo, hi, values, stride, size, width, mean, basis, starts, out):
    for i in range(lo, hi):
        even, odd, k, place = splat16(float32(0)), splat16(float32(0)), 0, starts[i]
        for _ in range(size):
            for c in range(0, width - 1, 2):  # two sums: one would wait for itself
                even = fma16(load16(basis, 16 * k), load1(values, place + c) - mean[k], even)
                odd = fma16(load16(basis, 16 * k + 16), load1(values, place + c + 1) - mean[k + 1], odd)
                k += 2
            if width % 2:
                even = fma16(load16(basis, 16 * k), load1(values, place + width - 1) - mean[k], even)
                k += 1
            place += stride
        store16(out, 16 * i, even + odd)

"""A first guess for a hole: it is filled from its rim inwards, each time where most around is known."""

from __future__ import annotations

import cv2
import numpy as np
from numba import float32

from ..jit import kernel
from ..raster.vec16 import fma16, load16, splat16, sum16
from .patches import lay_out

MOST_SOURCES = 4096  # patches that are tried for each place
STAMP = 1  # px: half the square that is copied at once


def fill_inwards(
    channels: np.ndarray,  # [H, W, C] float32
    hole: np.ndarray,  # [H, W] bool
    allowed: np.ndarray,  # [H, W] bool, centres of source patches, at least one
    radius: int,
) -> tuple[np.ndarray, np.ndarray]:
    """(rows, cols) [H, W] int32: the pixel that each hole pixel is copied from, -1 elsewhere.

    The next place is the one with most known around it; what was copied counts as less known the further from
    the rim it lies (confidence of Criminisi 2004). The source is the patch that differs least from what is
    known of the place's own.
    """
    patches = lay_out(channels, radius)
    rows, cols = np.nonzero(allowed)
    thinned = slice(None, None, -(-len(rows) // MOST_SOURCES))
    known = np.pad((~hole).astype(np.float32), radius)
    found_rows, found_cols = np.full((2, *hole.shape), -1, np.int32)
    share = cv2.blur(known, (2 * radius + 1,) * 2, borderType=cv2.BORDER_CONSTANT)
    _fill_inwards(
        *patches,
        np.argwhere(hole),
        rows[thinned],
        cols[thinned],
        known,
        share,
        found_rows,
        found_cols,
    )
    return found_rows, found_cols


@kernel
def _fill_inwards(
    values, stride, channels, radius, row_weights, places, source_rows, source_cols, known, share, rows, cols
):  # fmt: skip
    """`known` and `share` are [H + 2 radius, W + 2 radius]: a pixel's confidence and its mean over the patch."""
    h, w = rows.shape
    size, width = 2 * radius + 1, len(row_weights)
    weights = np.empty(size * width, np.float32)
    for _ in range(len(places)):
        best_share, y, x = float32(-1), -1, -1
        for k in range(len(places)):
            a, b = places[k]
            if rows[a, b] < 0 and share[a + radius, b + radius] > best_share:
                best_share, y, x = share[a + radius, b + radius], a, b
        if y < 0:
            return
        for i in range(size):
            for j in range(width):
                there = j < size * channels and known[y + i, x + j // channels] > 0
                weights[i * width + j] = float32(1) if there else float32(0)
        least, v, u = float32(1e30), 0, 0
        for k in range(len(source_rows)):
            one, other = y * stride + x * channels, source_rows[k] * stride + source_cols[k] * channels
            total = splat16(float32(0))
            for i in range(size):
                for j in range(0, width, 16):
                    difference = load16(values, one + j) - load16(values, other + j)
                    total = fma16(difference * load16(weights, i * width + j), difference, total)
                one += stride
                other += stride
            distance = sum16(total)
            if distance < least:
                least, v, u = distance, source_rows[k], source_cols[k]
        reach = min(STAMP, radius)
        for a in range(max(0, y - reach), min(h, y + reach + 1)):
            for b in range(max(0, x - reach), min(w, x + reach + 1)):
                if known[a + radius, b + radius] > 0:
                    continue
                q, p = v + a - y, u + b - x
                rows[a, b], cols[a, b] = q, p
                one = (a + radius) * stride + (b + radius) * channels
                other = (q + radius) * stride + (p + radius) * channels
                for c in range(channels):
                    values[one + c] = values[other + c]
                known[a + radius, b + radius] = best_share
                for i in range(size):
                    for j in range(size):
                        share[a + i, b + j] += best_share / (size * size)

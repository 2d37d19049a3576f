"""Which ellipses each 16×16 tile has to blend, front to back.

The Gaussians are sorted by depth once; a stable counting scatter then deals them into tiles. The lists do not
depend on how the work is cut into chunks.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float64, int64

from ..jit import exact_kernel, inline_kernel, kernel
from ..threads import parallel_map, thread_count
from .project import (
    DEPTH,
    DRAWN,
    FEATURES,
    HALF_HEIGHT,
    MEAN_X,
    MEAN_Y,
    TILE,
    WHITEN_XX,
    WHITEN_XY,
    WHITEN_YY,
)
from .vec16 import prefetch

RADIX_BITS = 11
AHEAD = 16  # feature rows to prefetch: in depth order each is a cache miss
ROWS_PER_CHUNK = 4096  # fewer Gaussians than this are not worth a thread


def tile_lists(
    features: np.ndarray,  # [N, 16] float32
    states: np.ndarray,  # [N] int8
    across: int,  # tiles per row of tiles
    down: int,
) -> tuple[np.ndarray, np.ndarray]:
    """(starts [T+1] int64, entries [P] int32): tile t blends entries[starts[t]:starts[t+1]], near to far."""
    order = _depth_order(features, states)
    chunks = max(1, min(thread_count(), len(order) // ROWS_PER_CHUNK))
    bounds = [len(order) * k // chunks for k in range(chunks + 1)]
    counts = np.zeros((chunks, across * down), np.int64)
    parallel_map(lambda k: _count(bounds[k], bounds[k + 1], order, features, across, down, counts[k]), range(chunks))
    ends = np.cumsum(counts.T).reshape(across * down, chunks)  # tile by tile, and in a tile chunk by chunk
    places = np.ascontiguousarray(ends.T) - counts
    starts = np.append(places[0], ends[-1, -1])
    entries = np.empty(starts[-1], np.int32)
    parallel_map(
        lambda k: _scatter(bounds[k], bounds[k + 1], order, features, across, down, places[k], entries),
        range(chunks),
    )
    return starts, entries


def _depth_order(
    features: np.ndarray,  # [N, 16] float32
    states: np.ndarray,  # [N] int8
) -> np.ndarray:
    """Drawn rows from near to far, rows of equal depth in file order, [D] int32."""
    rows, keys = np.empty((2, 2, len(states)), np.int32)
    drawn = _radix_sort(features.view(np.int32), states, rows, keys)  # positive floats sort like their bits
    return rows[1, :drawn]


@kernel
def _radix_sort(feature_bits, states, rows, keys):
    """Three passes of 11 bits, least significant first, between two buffers; the result lies in rows[1]."""
    n = 0
    for i in range(len(states)):
        if states[i] == DRAWN:
            rows[0, n] = i
            keys[0, n] = feature_bits[i, DEPTH]
            n += 1
    size = 1 << RADIX_BITS
    starts = np.zeros((3, size), np.int32)
    for i in range(n):
        for p in range(3):
            starts[p, (keys[0, i] >> (RADIX_BITS * p)) & (size - 1)] += 1
    for p in range(3):
        total = 0
        for digit in range(size):
            count = starts[p, digit]
            starts[p, digit] = total
            total += count
        source, target = p % 2, 1 - p % 2
        for i in range(n):
            key = keys[source, i]
            digit = (key >> (RADIX_BITS * p)) & (size - 1)
            place = starts[p, digit]
            starts[p, digit] = place + 1
            keys[target, place] = key
            rows[target, place] = rows[source, i]
    return n


@inline_kernel
def _tile_range(low, high, tiles):
    """First tile, and one past the last, with a pixel centre between low and high (px)."""
    first = min(max(math.ceil((low - (TILE - 0.5)) / TILE), 0.0), float64(tiles))
    end = min(max(math.floor((high - 0.5) / TILE) + 1.0, 0.0), float64(tiles))
    return int64(first), int64(end)


@inline_kernel
def _tile_rows(f, down):
    """Rows of tiles that the ellipse of feature row f reaches."""
    mean_y, half_height = float64(f[MEAN_Y]), float64(f[HALF_HEIGHT])
    return _tile_range(mean_y - half_height, mean_y + half_height, down)


@inline_kernel
def _tile_columns(f, tile_y, across):
    """Tiles of row tile_y that the ellipse of feature row f reaches, exactly."""
    xx, xy, yy = float64(f[WHITEN_XX]), float64(f[WHITEN_XY]), float64(f[WHITEN_YY])
    mean_x, half_height = float64(f[MEAN_X]), float64(f[HALF_HEIGHT])
    radius = half_height * yy
    top = tile_y * TILE + 0.5 - f[MEAN_Y]
    low, high = max(top, -half_height), min(top + (TILE - 1.0), half_height)
    # the ellipse reaches furthest right at dy = tip and furthest left at dy = −tip
    tip = -xy * radius / (yy * math.sqrt(xy * xy + yy * yy))
    right, left = min(max(tip, low), high), min(max(-tip, low), high)
    reach_right = math.sqrt(max(radius * radius - (yy * right) ** 2, 0.0)) - xy * right
    reach_left = math.sqrt(max(radius * radius - (yy * left) ** 2, 0.0)) + xy * left
    return _tile_range(mean_x - reach_left / xx, mean_x + reach_right / xx, across)


# Not fast-math: both must come to the same tiles.
@exact_kernel
def _count(lo, hi, order, features, across, down, counts):
    flat = features.reshape(-1)
    for k in range(lo, hi):
        prefetch(flat, int64(order[min(k + AHEAD, hi - 1)]) * FEATURES)
        f = features[order[k]]
        y0, y1 = _tile_rows(f, down)
        for y in range(y0, y1):
            x0, x1 = _tile_columns(f, y, across)
            for x in range(x0, x1):
                counts[y * across + x] += 1


@exact_kernel
def _scatter(lo, hi, order, features, across, down, places, entries):
    flat = features.reshape(-1)
    for k in range(lo, hi):
        prefetch(flat, int64(order[min(k + AHEAD, hi - 1)]) * FEATURES)
        f = features[order[k]]
        y0, y1 = _tile_rows(f, down)
        for y in range(y0, y1):
            x0, x1 = _tile_columns(f, y, across)
            for x in range(x0, x1):
                t = y * across + x
                entries[places[t]] = order[k]
                places[t] += 1

"""Which ellipses each 16×16 tile has to blend, front to back.

The Gaussians are sorted by depth once; a stable counting scatter then deals them into tiles. The lists do not depend
on how the work is cut into chunks.
"""

from __future__ import annotations

import numpy as np

from ..jit import kernel
from ..threads import parallel_map, thread_count
from .project import TILE

RADIX_BITS = 11


def tile_lists(
    features_depth: np.ndarray,  # [M] float32 z > 0
    rects: np.ndarray,  # [M, 4] int32 tile ranges
    tiles: np.ndarray,  # [M] int32, 0 = not drawn
    width: int,
    height: int,
) -> tuple[np.ndarray, np.ndarray]:
    """(starts [T+1] int64, entries [P] int32): tile t blends rows entries[starts[t]:starts[t+1]], nearest first."""
    across, down = -(-width // TILE), -(-height // TILE)
    order = depth_order(features_depth.view(np.int32), tiles)  # positive floats sort like their bits
    chunks = max(1, min(thread_count(), len(order) // 4096))
    bounds = [len(order) * k // chunks for k in range(chunks + 1)]
    counts = np.zeros((chunks, across * down), np.int64)
    parallel_map(lambda k: _count(bounds[k], bounds[k + 1], order, rects, across, counts[k]), range(chunks))
    flat = counts.T.ravel()
    ends = np.cumsum(flat)
    offsets = np.ascontiguousarray((ends - flat).reshape(across * down, chunks).T)
    entries = np.empty(int(ends[-1]) if len(ends) else 0, np.int32)
    starts = np.append(offsets[0], len(entries)).astype(np.int64)
    parallel_map(
        lambda k: _scatter(bounds[k], bounds[k + 1], order, rects, across, offsets[k], entries), range(chunks)
    )
    return starts, entries


def depth_order(keys: np.ndarray, tiles: np.ndarray) -> np.ndarray:
    """Drawn rows in stable order of their keys, [D] int32."""
    n = len(keys)
    scratch = np.empty((4, n), np.int32)
    drawn = _radix_sort(keys, tiles, scratch[0], scratch[1], scratch[2], scratch[3])
    return scratch[1, :drawn]


@kernel
def _radix_sort(keys, tiles, rows_a, rows_b, keys_a, keys_b):
    """Three passes of 11 bits, least significant first; the result lies in rows_b."""
    n = 0
    for i in range(len(keys)):
        if tiles[i] > 0:
            rows_a[n] = i
            keys_a[n] = keys[i]
            n += 1
    size = 1 << RADIX_BITS
    starts = np.zeros((3, size), np.int32)
    for i in range(n):
        for p in range(3):
            starts[p, (keys_a[i] >> (RADIX_BITS * p)) & (size - 1)] += 1
    for p in range(3):
        total = 0
        for d in range(size):
            count = starts[p, d]
            starts[p, d] = total
            total += count
    for p in range(3):
        for i in range(n):
            key, row = (keys_a[i], rows_a[i]) if p != 1 else (keys_b[i], rows_b[i])
            d = (key >> (RADIX_BITS * p)) & (size - 1)
            place = starts[p, d]
            starts[p, d] = place + 1
            if p != 1:
                keys_b[place] = key
                rows_b[place] = row
            else:
                keys_a[place] = key
                rows_a[place] = row
    return n


@kernel
def _count(lo, hi, order, rects, across, counts):
    for k in range(lo, hi):
        m = order[k]
        for y in range(rects[m, 1], rects[m, 3]):
            for x in range(rects[m, 0], rects[m, 2]):
                counts[y * across + x] += 1


@kernel
def _scatter(lo, hi, order, rects, across, offsets, entries):
    for k in range(lo, hi):
        m = order[k]
        for y in range(rects[m, 1], rects[m, 3]):
            for x in range(rects[m, 0], rects[m, 2]):
                t = y * across + x
                entries[offsets[t]] = m
                offsets[t] += 1

"""PatchMatch as published, for comparison: a random start, propagation and random search (Barnes 2009), one thread;
and the same from coarse to fine, as the paper does it. Patches are 5×5 pixels of 8-bit RGB."""

from __future__ import annotations

import cv2
import numba
import numpy as np
from numba import njit

from gimp3d.solvers.patchmatch import patch_centres

RADIUS = 2
SIDE = 2 * RADIUS + 1
SMALLEST = 32  # px, no level of the pyramid is smaller
Field = tuple[np.ndarray, np.ndarray, np.ndarray]  # rows, cols [H, W] int32; mean squared difference [H, W] in [0, 1]²


def classic(image: np.ndarray, target: np.ndarray, sweeps: int, seed: int = 0) -> Field:
    """The published algorithm: the random search reaches over the whole image."""
    return _swept(image, target, *_random_start(image, target, seed), sweeps, max(target.shape), seed)


def pyramid(image: np.ndarray, target: np.ndarray, sweeps: int, reach: int, seed: int = 0) -> Field:
    """From coarse to fine; below the coarsest level the random search reaches `reach` pixels."""
    levels = [(image, target)]
    while min(levels[-1][1].shape) // 2 >= SMALLEST:
        picture, hole = levels[-1]
        size = ((hole.shape[1] + 1) // 2, (hole.shape[0] + 1) // 2)
        smaller = cv2.resize(hole.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
        if not patch_centres(~smaller, RADIUS).any():
            break
        levels.append((cv2.resize(picture, size, interpolation=cv2.INTER_AREA), smaller))
    field: Field | None = None
    for picture, hole in reversed(levels):
        rows, cols = _random_start(picture, hole, seed)
        if field is not None:
            h, w = hole.shape
            y, x = np.mgrid[:h, :w]
            finer = [np.minimum(2 * field[k][y // 2, x // 2] + c % 2, n - 1) for k, c, n in ((0, y, h), (1, x, w))]
            kept = patch_centres(~hole, RADIUS)[finer[0], finer[1]] & (field[0][y // 2, x // 2] >= 0)
            rows, cols = np.where(kept, finer[0], rows), np.where(kept, finer[1], cols)
        field = _swept(picture, hole, rows, cols, sweeps, max(hole.shape) if field is None else reach, seed)
    assert field is not None
    return field


def _random_start(image: np.ndarray, target: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    allowed = np.flatnonzero(patch_centres(~target, RADIUS))
    chosen = allowed[np.random.default_rng(seed).integers(0, len(allowed), target.shape)]
    return chosen // target.shape[1], chosen % target.shape[1]


def _swept(
    image: np.ndarray, target: np.ndarray, rows: np.ndarray, cols: np.ndarray, sweeps: int, reach: int, seed: int
) -> Field:
    values = cv2.copyMakeBorder(image, RADIUS, RADIUS, RADIUS, RADIUS, cv2.BORDER_REFLECT_101).astype(np.int16)
    values = values.reshape(len(values), -1)
    rows, cols = (np.where(target, a, -1).astype(np.int32) for a in (rows, cols))
    cost = np.zeros(target.shape, np.int64)
    allowed = patch_centres(~target, RADIUS)
    _evaluate(values, target, rows, cols, cost)
    for sweep in range(sweeps):
        _sweep(values, target, allowed, rows, cols, cost, reach, sweep % 2 == 0, np.uint32(seed * 1009 + sweep))
    return rows, cols, (cost / (255.0**2 * 3 * SIDE * SIDE)).astype(np.float32)


@njit(inline="always", cache=True)
def _distance(values, y, x, v, u, most):
    total = numba.int32(0)
    for i in range(SIDE):
        for c in range(3 * SIDE):
            difference = numba.int32(values[y + i, 3 * x + c]) - numba.int32(values[v + i, 3 * u + c])
            total += difference * difference
        if total >= most:
            break
    return total


@njit(cache=True)
def _evaluate(values, target, rows, cols, cost):
    for y in range(target.shape[0]):
        for x in range(target.shape[1]):
            if target[y, x]:
                cost[y, x] = _distance(values, y, x, rows[y, x], cols[y, x], numba.int32(2**31 - 1))


@njit(cache=True)
def _sweep(values, target, allowed, rows, cols, cost, reach, forward, salt):
    h, w = target.shape
    step = 1 if forward else -1
    for i in range(h):
        y = i if forward else h - 1 - i
        for j in range(w):
            x = j if forward else w - 1 - j
            if not target[y, x]:
                continue
            best, v, u = numba.int32(cost[y, x]), rows[y, x], cols[y, x]
            for k in range(2):
                a, b = (y - step, x) if k == 0 else (y, x - step)
                if 0 <= a < h and 0 <= b < w and target[a, b]:
                    q, p = rows[a, b] + y - a, cols[a, b] + x - b
                    if 0 <= q < h and 0 <= p < w and allowed[q, p]:
                        found = _distance(values, y, x, q, p, best)
                        if found < best:
                            best, v, u = found, q, p
            state = numba.uint32(y * w + x) * numba.uint32(2654435761) + salt
            span = reach
            while span >= 1:
                for _ in range(2):  # xorshift
                    state ^= numba.uint32(state << numba.uint32(13))
                    state ^= numba.uint32(state >> numba.uint32(17))
                    state ^= numba.uint32(state << numba.uint32(5))
                q = v - span + numba.int64(state >> numba.uint32(16)) % (2 * span + 1)
                p = u - span + numba.int64(state & numba.uint32(0xFFFF)) % (2 * span + 1)
                span //= 2
                if 0 <= q < h and 0 <= p < w and allowed[q, p]:
                    found = _distance(values, y, x, q, p, best)
                    if found < best:
                        best, v, u = found, q, p
            rows[y, x], cols[y, x], cost[y, x] = v, u, best

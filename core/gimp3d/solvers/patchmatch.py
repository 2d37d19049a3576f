"""Nearest-neighbour fields by multi-scale PatchMatch (Barnes 2009; paper Algorithm 2 with its loop mended).

Rows are swept in fixed bands, so that the result depends on the seed and not on the number of threads: inside a band
propagation sees this sweep's values, across a band's edge the last sweep's. Random numbers are hashes of the pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import float32, int64, uint32

from ..jit import inline_kernel, kernel
from ..threads import parallel_map

BANDS = 16
SMALLEST = 32  # px, no level is smaller
HUGE = np.float32(1e30)


@dataclass(frozen=True)
class PatchMatchSettings:
    """Costs are mean squared RGB differences in [0, 1]; lengths in pixels."""

    patch: int = 5  # side, odd (paper 4.1)
    coherence: float = 0.01  # λ_s, weight of the spatial term
    truncation: float = 8.0  # offsets that differ by more count as incoherent (METHOD section 4: local, not image-sized)
    sweeps: int = 4  # per level
    levels: int = 5  # at most
    radius: int = 16  # of the random search on fine levels; the coarsest searches everywhere
    seed: int = 0


@dataclass(frozen=True)
class NearestNeighbourField:
    """For every target pixel its source pixel."""

    rows: np.ndarray  # [H, W] int32 source row, -1 outside the target or without a source
    cols: np.ndarray  # [H, W] int32
    cost: np.ndarray  # [H, W] float32, appearance + penalty


def nearest_neighbour_field(
    image: np.ndarray,  # [H, W, 3] uint8
    target: np.ndarray,  # [H, W] bool
    source: np.ndarray,  # [H, W] bool, pixels that may be copied
    penalty: np.ndarray | None = None,  # [H, W] float32 ≥ 0, added to the cost of each source
    settings: PatchMatchSettings = PatchMatchSettings(),  # noqa: B008
) -> NearestNeighbourField:
    """The source patch that each target patch resembles most.

    Minimises (1 − λ_s)·appearance + λ_s·spatial + penalty: appearance is the mean squared difference over the patch,
    spatial the neighbours' mean truncated squared deviation of offsets (PixMix, Herling & Broll 2014). A source patch
    lies inside the image and holds no target pixel. Where the image is too small for a patch, patches shrink.
    """
    radius = settings.patch // 2
    while radius > 0 and not source_centres(target, source, radius).any():
        radius -= 1
    levels = [(image, target, source, np.zeros(target.shape, np.float32) if penalty is None else penalty)]
    while len(levels) < settings.levels and min(target.shape) >> len(levels) >= SMALLEST:
        smaller = _halved(*levels[-1])
        if not source_centres(smaller[1], smaller[2], radius).any():
            break
        levels.append(smaller)
    field: NearestNeighbourField | None = None
    for number in range(len(levels) - 1, -1, -1):
        field = _match_level(*levels[number], radius, number == len(levels) - 1, field, settings)
    assert field is not None
    return field


def source_centres(
    target: np.ndarray,  # [H, W] bool
    source: np.ndarray,  # [H, W] bool
    radius: int,
) -> np.ndarray:
    """[H, W] bool: centres whose whole patch lies in the image, in the source and off the target."""
    usable = (source & ~target).astype(np.uint8)
    size = 2 * radius + 1
    return cv2.erode(usable, np.ones((size, size), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0


def _halved(
    image: np.ndarray, target: np.ndarray, source: np.ndarray, penalty: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    size = ((target.shape[1] + 1) // 2, (target.shape[0] + 1) // 2)

    def shrink(a: np.ndarray) -> np.ndarray:
        return cv2.resize(a, size, interpolation=cv2.INTER_AREA)

    return shrink(image), shrink(target.astype(np.float32)) > 0, shrink(source.astype(np.float32)) > 0.99, shrink(penalty)


def _match_level(
    image: np.ndarray,
    target: np.ndarray,
    source: np.ndarray,
    penalty: np.ndarray,
    radius: int,
    coarsest: bool,
    coarser: NearestNeighbourField | None,
    settings: PatchMatchSettings,
) -> NearestNeighbourField:
    allowed = source_centres(target, source, radius)
    rows, cols = np.full((2, *target.shape), -1, np.int32)
    cost = np.zeros(target.shape, np.float32)
    centres = np.argwhere(allowed).astype(np.int32)
    if len(centres) == 0 or not target.any():
        return NearestNeighbourField(rows, cols, cost)
    padded = cv2.copyMakeBorder(image, radius, radius, radius, radius, cv2.BORDER_REFLECT_101)
    padded = np.ascontiguousarray(padded.reshape(padded.shape[0], -1).astype(np.float32) / 255)
    if coarser is not None:
        _upsample(coarser.rows, coarser.cols, target, rows, cols)
    penalty = np.ascontiguousarray(penalty, np.float32)
    _initialise(target, allowed, padded, penalty, centres, radius, uint32(settings.seed), rows, cols, cost)
    bands = row_bands(target)
    reach = max(target.shape) if coarsest else settings.radius
    for sweep in range(settings.sweeps):
        old_rows, old_cols = rows.copy(), cols.copy()
        arguments = (
            target, allowed, padded, penalty, radius, sweep, reach, uint32(settings.seed),
            float32(settings.coherence), float32(settings.truncation**2), old_rows, old_cols, rows, cols, cost,
        )  # fmt: skip
        parallel_map(lambda band, a=arguments: _sweep_band(band[0], band[1], *a), bands)
    return NearestNeighbourField(rows, cols, cost)


def row_bands(target: np.ndarray) -> list[tuple[int, int]]:
    """At most BANDS ranges of rows that hold about as many target pixels each; the same for any thread count."""
    per_row = np.cumsum(target.sum(1))
    limits = np.searchsorted(per_row, per_row[-1] * np.arange(1, BANDS) / BANDS) + 1
    edges = np.unique(np.concatenate([[0], limits, [len(per_row)]]))
    return list(zip(edges[:-1].tolist(), edges[1:].tolist()))


@inline_kernel
def _hash(x):
    x ^= x >> uint32(16)
    x *= uint32(0x7FEB352D)
    x ^= x >> uint32(15)
    x *= uint32(0x846CA68B)
    return x ^ (x >> uint32(16))


@inline_kernel
def _appearance(padded, y, x, v, u, radius, limit):
    """Mean squared difference of the patches at (y, x) and (v, u), or anything ≥ limit once it is reached."""
    size = 2 * radius + 1
    scale = float32(1.0) / float32(3 * size * size)
    total = float32(0)
    for k in range(size):
        for c in range(3 * size):
            d = padded[y + k, 3 * x + c] - padded[v + k, 3 * u + c]
            total += d * d
        if total * scale >= limit:
            break
    return total * scale


@inline_kernel
def _incoherence(target, rows, cols, y, x, v, u, truncation):
    """Mean over the 4-neighbours of the truncated squared deviation of offsets, in [0, 1]."""
    total, count = float32(0), 0
    for k in range(4):
        dy, dx = (k == 0) - (k == 1), (k == 2) - (k == 3)
        a, b = y + dy, x + dx
        if 0 <= a < target.shape[0] and 0 <= b < target.shape[1] and target[a, b] and rows[a, b] >= 0:
            e = float32((v + dy - rows[a, b]) ** 2 + (u + dx - cols[a, b]) ** 2)
            total += min(e, truncation)
            count += 1
    return total / (truncation * float32(max(count, 1)))


@kernel
def _upsample(coarse_rows, coarse_cols, target, rows, cols):
    """f ← 2·f of the coarser level plus the pixel's parity."""
    h, w = target.shape
    for y in range(h):
        for x in range(w):
            if target[y, x]:
                a, b = min(y // 2, coarse_rows.shape[0] - 1), min(x // 2, coarse_rows.shape[1] - 1)
                if coarse_rows[a, b] >= 0:
                    rows[y, x] = min(2 * coarse_rows[a, b] + (y & 1), h - 1)
                    cols[y, x] = min(2 * coarse_cols[a, b] + (x & 1), w - 1)


@kernel
def _initialise(target, allowed, padded, penalty, centres, radius, seed, rows, cols, cost):
    """Keep valid sources, draw random ones elsewhere, and cost them all."""
    h, w = target.shape
    for y in range(h):
        for x in range(w):
            if target[y, x]:
                if rows[y, x] < 0 or not allowed[rows[y, x], cols[y, x]]:
                    k = int64(_hash(uint32(y * w + x) * uint32(2654435761) + seed)) % len(centres)
                    rows[y, x], cols[y, x] = centres[k, 0], centres[k, 1]
                v, u = rows[y, x], cols[y, x]
                cost[y, x] = _appearance(padded, y, x, v, u, radius, HUGE) + penalty[v, u]


@kernel
def _sweep_band(
    lo, hi, target, allowed, padded, penalty, radius, sweep, reach, seed, coherence, truncation,
    old_rows, old_cols, rows, cols, cost,
):  # fmt: skip
    """One propagation and random-search sweep over rows [lo, hi): downward on even sweeps, upward on odd ones."""
    h, w = target.shape
    step = 1 if sweep % 2 == 0 else -1
    weight = float32(1) - coherence
    for yy in range(hi - lo):
        y = lo + yy if step == 1 else hi - 1 - yy
        for xx in range(w):
            x = xx if step == 1 else w - 1 - xx
            if not target[y, x]:
                continue
            v, u = rows[y, x], cols[y, x]
            # rows of this band are up to date; rows of others come from the last sweep
            best = weight * cost[y, x]
            if coherence > 0:
                best += coherence * _band_incoherence(target, lo, hi, old_rows, old_cols, rows, cols, y, x, v, u, truncation)
            state = _hash(uint32(y * w + x) * uint32(2654435761) + seed * uint32(97) + uint32(sweep * 7919 + 1))
            tries = 2 + 2 * _log2(reach)
            span = reach
            for k in range(tries):
                if k < 2:
                    a, b = (y - step, x) if k == 0 else (y, x - step)
                    if a < 0 or b < 0 or a >= h or b >= w or not target[a, b]:
                        continue
                    if lo <= a < hi:
                        q, p = rows[a, b] + (y - a), cols[a, b] + (x - b)
                    else:
                        q, p = old_rows[a, b] + (y - a), old_cols[a, b] + (x - b)
                else:
                    state = _hash(state + uint32(0x9E3779B9))
                    q = v - span + int64(state) % (2 * span + 1)
                    state = _hash(state + uint32(0x9E3779B9))
                    p = u - span + int64(state) % (2 * span + 1)
                    if k % 2 == 1:
                        span = max(span // 2, 1)
                if q < 0 or p < 0 or q >= h or p >= w or not allowed[q, p] or (q == v and p == u):
                    continue
                extra = weight * penalty[q, p]
                if coherence > 0:
                    extra += coherence * _band_incoherence(target, lo, hi, old_rows, old_cols, rows, cols, y, x, q, p, truncation)
                if extra >= best:
                    continue
                found = _appearance(padded, y, x, q, p, radius, (best - extra) / weight)
                if weight * found + extra < best:
                    best = weight * found + extra
                    v, u = q, p
                    cost[y, x] = found + penalty[q, p]
            rows[y, x], cols[y, x] = v, u


@inline_kernel
def _log2(n):
    count = 0
    while n > 0:
        n //= 2
        count += 1
    return count


@inline_kernel
def _band_incoherence(target, lo, hi, old_rows, old_cols, rows, cols, y, x, v, u, truncation):
    if y == lo or y == hi - 1:
        return _incoherence(target, old_rows, old_cols, y, x, v, u, truncation)
    return _incoherence(target, rows, cols, y, x, v, u, truncation)


@kernel
def vote_range(lo, hi, image, target, rows, cols, cost, weights, sharpness, radius, out):
    """Colours of target rows [lo, hi) as the weighted mean of what overlapping patches say (Wexler 2007)."""
    h, w = target.shape
    for y in range(lo, hi):
        for x in range(w):
            if not target[y, x]:
                continue
            total = float32(0)
            r, g, b = float32(0), float32(0), float32(0)
            for dy in range(-radius, radius + 1):
                for dx in range(-radius, radius + 1):
                    i, j = y + dy, x + dx
                    if i < 0 or j < 0 or i >= h or j >= w or rows[i, j] < 0:
                        continue
                    q, p = rows[i, j] - dy, cols[i, j] - dx
                    if q < 0 or p < 0 or q >= h or p >= w:
                        continue
                    weight = weights[i, j] * np.exp(-cost[i, j] * sharpness) + float32(1e-12)
                    total += weight
                    r += weight * image[q, p, 0]
                    g += weight * image[q, p, 1]
                    b += weight * image[q, p, 2]
            if total > 0:
                out[y, x, 0], out[y, x, 1], out[y, x, 2] = r / total, g / total, b / total

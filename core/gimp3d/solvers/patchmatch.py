"""Nearest-neighbour fields by multi-scale PatchMatch (Barnes 2009; paper Algorithm 2 with its loop mended).

The target is swept in fixed bands of rows, so that the result depends on the seed and not on the number of
threads: inside a band propagation sees this sweep's values, across a band's edge the last sweep's. Random
numbers are hashes of seed, sweep and pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from numba import float32, int64, uint32

from ..jit import inline_kernel, kernel
from ..threads import parallel_map

MOST_BANDS = 16
BAND_ROWS = 8  # px; thinner bands would slow propagation down, which crosses a band's edge once per sweep
SMALLEST = 32  # px, no level is smaller
TIE = 1e-6  # cost of a source one image width away, (1/4 grey level)²: it only decides between equal patches


@dataclass(frozen=True)
class PatchMatchSettings:
    """Costs are mean squared differences of colours in [0, 1]; lengths in pixels."""

    patch: int = 5  # side, odd (paper 4.1)
    coherence: float = 0.001  # λ_s, weight of the spatial term (paper 4.1)
    truncation: float = 8.0  # offsets that differ by more are incoherent (METHOD section 4: local, not image-sized)
    levels: int = 5  # of the pyramid, at most
    sweeps: int = 5  # per level
    draws: int = 4  # random candidates per octave of distance and sweep
    seed: int = 0


@dataclass(frozen=True)
class NearestNeighbourField:
    """For every target pixel its source pixel."""

    rows: np.ndarray  # [H, W] int32 source row, -1 outside the target or where there is no source
    cols: np.ndarray  # [H, W] int32
    cost: np.ndarray  # [H, W] float32, (1 − λ_s)·appearance + penalty
    radius: int  # px: half the patch that was compared, smaller than asked for where the image has no room

    @property
    def found(self) -> np.ndarray:
        """[H, W] bool: target pixels that have a source; none if no source patch is allowed."""
        return self.rows >= 0


def nearest_neighbour_field(
    image: np.ndarray,  # [H, W, 3] uint8
    target: np.ndarray,  # [H, W] bool
    source: np.ndarray,  # [H, W] bool, centres of patches that may be copied
    penalty: np.ndarray | None = None,  # [H, W] float32 ≥ 0, added to the cost of each source
    settings: PatchMatchSettings = PatchMatchSettings(),
) -> NearestNeighbourField:
    """The source patch that each target patch resembles most, found from the coarsest level to the finest.

    Minimises (1 − λ_s)·appearance + λ_s·spatial + penalty (paper eq. 8). Appearance is the mean squared
    difference over the patch; spatial is the neighbours' mean squared deviation of offsets, truncated and
    scaled to [0, 1] (PixMix, Herling & Broll 2014). A source patch lies inside the image and holds no target
    pixel; where the image has no room for one, patches shrink. Between equal sources the nearest wins.
    """
    radius = settings.patch // 2
    while radius > 0 and not (source & patch_centres(~target, radius)).any():
        radius -= 1
    extra = np.zeros(target.shape, np.float32) if penalty is None else penalty.astype(np.float32)
    levels = [(image.astype(np.float32) / 255, target, source, extra)]
    while len(levels) < settings.levels and min(target.shape) >> len(levels) >= SMALLEST:
        smaller = _halved(*levels[-1])
        if not (smaller[2] & patch_centres(~smaller[1], radius)).any():
            break
        levels.append(smaller)
    field: NearestNeighbourField | None = None
    for picture, inside, centres, extra in reversed(levels):
        allowed = centres & patch_centres(~inside, radius)
        start = None if field is None else upsampled(field, inside)
        field = refined(start, picture, inside, allowed, radius, settings, extra)
    assert field is not None
    return field


def patch_centres(
    usable: np.ndarray,  # [H, W] bool
    radius: int,
) -> np.ndarray:
    """[H, W] bool: centres of the patches that lie wholly in the image and on usable pixels."""
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    return cv2.erode(usable.astype(np.uint8), window, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0


def _halved(
    image: np.ndarray, target: np.ndarray, source: np.ndarray, penalty: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    size = ((target.shape[1] + 1) // 2, (target.shape[0] + 1) // 2)

    def shrink(a: np.ndarray) -> np.ndarray:
        return cv2.resize(a.astype(np.float32), size, interpolation=cv2.INTER_AREA)

    return shrink(image), shrink(target) > 0, shrink(source) > 0.5, shrink(penalty)


def upsampled(
    field: NearestNeighbourField,
    target: np.ndarray,  # [H, W] bool at the finer level
) -> NearestNeighbourField:
    """The field at twice the resolution: f ← 2·f plus the pixel's parity; its cost is not known yet."""
    h, w = target.shape
    y, x = np.nonzero(target & (field.rows.repeat(2, 0).repeat(2, 1)[:h, :w] >= 0))
    rows, cols = np.full((2, h, w), -1, np.int32)
    rows[y, x] = np.minimum(2 * field.rows[y // 2, x // 2] + (y & 1), h - 1)
    cols[y, x] = np.minimum(2 * field.cols[y // 2, x // 2] + (x & 1), w - 1)
    return NearestNeighbourField(rows, cols, np.zeros((h, w), np.float32), field.radius)


def refined(
    field: NearestNeighbourField | None,  # a first guess; random where it has no allowed source
    channels: np.ndarray,  # [H, W, C] float32: colours in [0, 1], and what else is to be compared
    target: np.ndarray,  # [H, W] bool
    allowed: np.ndarray,  # [H, W] bool, source patch centres
    radius: int,
    settings: PatchMatchSettings,
    penalty: np.ndarray | None = None,  # [H, W] float32
    reach: int = 0,  # px of the random search; 0 = everywhere
) -> NearestNeighbourField:
    """Sweeps of propagation and random search at one resolution."""
    h, w = target.shape
    rows, cols = np.full((2, h, w), -1, np.int32)
    cost = np.zeros((h, w), np.float32)
    centres = np.argwhere(allowed).astype(np.int32)
    if len(centres) == 0 or not target.any():
        return NearestNeighbourField(rows, cols, cost, radius)
    if field is not None:
        rows[:], cols[:] = field.rows, field.cols
    size = 2 * radius + 1
    padded = cv2.copyMakeBorder(channels, radius, radius, radius, radius, cv2.BORDER_REFLECT_101)
    means = np.ascontiguousarray(cv2.blur(padded, (size, size))[radius : radius + h, radius : radius + w])
    padded = np.ascontiguousarray(padded.reshape(len(padded), -1))
    extra = np.zeros((h, w), np.float32) if penalty is None else penalty
    weight = float32(1 - settings.coherence)
    bands = row_bands(target)
    random = uint32(settings.seed * 1009 & 0xFFFFFFFF)
    setup = target, allowed, padded, extra, radius, weight, random, centres, rows, cols, cost
    parallel_map(partial(_run_band, _start_band, setup), bands)
    limits = float32(settings.coherence), float32(settings.truncation**2), float32(TIE / w)
    for sweep in range(settings.sweeps):
        random = uint32((settings.seed * 1009 + sweep + 1) & 0xFFFFFFFF)
        sweeping = (
            target, allowed, padded, means, extra, radius, weight, *limits, reach or h + w, settings.draws,
            sweep % 2 == 0, random, rows.copy(), cols.copy(), rows, cols, cost,
        )  # fmt: skip
        parallel_map(partial(_run_band, _sweep_band, sweeping), bands)
    return NearestNeighbourField(rows, cols, cost, radius)


def _run_band(work: Callable[..., None], arguments: tuple[Any, ...], band: tuple[int, int]) -> None:
    work(*band, *arguments)


def row_bands(target: np.ndarray) -> list[tuple[int, int]]:
    """Ranges of rows that hold about as many target pixels each; they depend on nothing else."""
    per_row = np.cumsum(target.sum(1))
    count = min(MOST_BANDS, max(1, int(target.any(1).sum()) // BAND_ROWS))
    limits = np.searchsorted(per_row, per_row[-1] * np.arange(1, count) / count) + 1
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
def _appearance(padded, channels, y, x, v, u, radius, limit):
    """Mean squared difference of the patches at (y, x) and (v, u), or anything ≥ limit once that is sure."""
    size = 2 * radius + 1
    scale = float32(1.0) / float32(channels * size * size)
    total = float32(0)
    for k in range(size):
        for c in range(channels * size):
            d = padded[y + k, channels * x + c] - padded[v + k, channels * u + c]
            total += d * d
        if total * scale >= limit:
            break
    return total * scale


@inline_kernel
def _mean_difference(means, y, x, v, u):
    """Squared difference of the patches' means: by Jensen's inequality never above their appearance term."""
    total = float32(0)
    for c in range(means.shape[2]):
        d = means[y, x, c] - means[v, u, c]
        total += d * d
    return total / float32(means.shape[2])


@inline_kernel
def _incoherence(target, lo, hi, old_rows, old_cols, rows, cols, y, x, v, u, truncation):
    """Mean over the 4-neighbours of the truncated squared deviation of offsets, in [0, 1].

    Neighbours in this band are up to date, others are as the last sweep left them.
    """
    total, count = float32(0), 0
    for k in range(4):
        dy, dx = (k == 0) - (k == 1), (k == 2) - (k == 3)
        a, b = y + dy, x + dx
        if 0 <= a < target.shape[0] and 0 <= b < target.shape[1] and target[a, b]:
            q, p = (rows[a, b], cols[a, b]) if lo <= a < hi else (old_rows[a, b], old_cols[a, b])
            total += min(float32((v + dy - q) ** 2 + (u + dx - p) ** 2), truncation)
            count += 1
    return total / (truncation * float32(max(count, 1)))


@inline_kernel
def _distance(y, x, v, u):
    return np.sqrt(float32((y - v) ** 2 + (x - u) ** 2))


@kernel
def _start_band(lo, hi, target, allowed, padded, penalty, radius, weight, random, centres, rows, cols, cost):
    """Keep allowed sources, draw random ones elsewhere, and cost them all."""
    w = target.shape[1]
    channels = padded.shape[1] // (w + 2 * radius)
    for y in range(lo, hi):
        for x in range(w):
            if target[y, x]:
                if rows[y, x] < 0 or not allowed[rows[y, x], cols[y, x]]:
                    k = int64(_hash(uint32(y * w + x) ^ _hash(random))) % len(centres)
                    rows[y, x], cols[y, x] = centres[k, 0], centres[k, 1]
                v, u = rows[y, x], cols[y, x]
                cost[y, x] = weight * _appearance(padded, channels, y, x, v, u, radius, float32(1e30)) + penalty[v, u]
            else:
                rows[y, x], cols[y, x] = -1, -1


@kernel
def _sweep_band(
    lo, hi, target, allowed, padded, means, penalty, radius, weight, coherence, truncation, tie, reach, draws,
    downward, random, old_rows, old_cols, rows, cols, cost,
):  # fmt: skip
    """One sweep over rows [lo, hi): candidates are the neighbours' sources, shifted, and random ones."""
    h, w = target.shape
    channels = means.shape[2]
    step = 1 if downward else -1
    salt = _hash(random)
    for i in range(hi - lo):
        y = lo + i if downward else hi - 1 - i
        for j in range(w):
            x = j if downward else w - 1 - j
            if not target[y, x]:
                continue
            v, u = rows[y, x], cols[y, x]
            best = cost[y, x] + tie * _distance(y, x, v, u)
            if coherence > 0:
                best += coherence * _incoherence(target, lo, hi, old_rows, old_cols, rows, cols, y, x, v, u, truncation)
            state = _hash(uint32(y * w + x) ^ salt)
            candidate, span = 0, reach
            while span > 0:
                if candidate < 4:
                    # the two neighbours visited just now, then the two that the last sweep left
                    dy = (-step, 0, step, 0)[candidate]
                    dx = (0, -step, 0, step)[candidate]
                    a, b = y + dy, x + dx
                    candidate += 1
                    if a < 0 or b < 0 or a >= h or b >= w or not target[a, b]:
                        continue
                    q, p = (rows[a, b], cols[a, b]) if lo <= a < hi else (old_rows[a, b], old_cols[a, b])
                    q, p = q - dy, p - dx
                else:
                    state = _hash(state + uint32(0x9E3779B9))
                    q = v - span + int64(state) % (2 * span + 1)
                    state = _hash(state + uint32(0x9E3779B9))
                    p = u - span + int64(state) % (2 * span + 1)
                    candidate += 1
                    if (candidate - 4) % draws == 0:
                        span //= 2
                if q < 0 or p < 0 or q >= h or p >= w or not allowed[q, p] or (q == v and p == u):
                    continue
                extra = penalty[q, p] + tie * _distance(y, x, q, p)
                if extra + weight * _mean_difference(means, y, x, q, p) >= best:
                    continue
                if coherence > 0:
                    extra += coherence * _incoherence(
                        target, lo, hi, old_rows, old_cols, rows, cols, y, x, q, p, truncation
                    )
                    if extra >= best:
                        continue
                found = weight * _appearance(padded, channels, y, x, q, p, radius, (best - extra) / weight)
                if found + extra < best:
                    best = found + extra
                    v, u = q, p
                    cost[y, x] = found + penalty[q, p]
            rows[y, x], cols[y, x] = v, u

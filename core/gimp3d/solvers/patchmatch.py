"""Nearest-neighbour fields: a kd-tree's guesses, propagated and refined by PatchMatch sweeps.

Sources come from a tree over the patches' main components and from the leaves of the neighbours' sources (He & Sun
2012), then from propagation and random search (Barnes 2009; paper Algorithm 2 with its loop mended). The target is
swept in fixed bands of rows, so that the result depends on the seed and not on the number of threads: inside a band
propagation sees this sweep's values, across a band's edge the last sweep's. Random numbers are hashes of seed, sweep
and pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from numba import float32, int64, uint32

from ..compute.jit import inline_kernel, kernel
from ..compute.simd import any_between, fma16, load1, load16, splat16, store16, sum16
from ..compute.threads import parallel_map
from ..schema import AtLeastOne, Seed
from .patches import NO_TREE, Components, Patches, Tree, coordinates, index_patches, lay_out, leaf_of

MOST_BANDS = 16
BAND_ROWS = 8  # px; thinner bands would slow propagation down, which crosses a band's edge once per sweep
TRUNCATION = 8.0  # px; offsets that differ by more are incoherent: coherence is local, not of the whole image
GRID = 2  # px between the sources that the tree holds; sweeps look at those between
TREE_SWEEPS = 2  # the first ones, which look into the neighbours' leaves of the tree
REACH = 4  # px, of the random search round the best source
SAME = np.float32(255.0**-2 / 4)  # half a grey level: the tree is not asked for better, or plain areas lose coherence
TIE = 1e-6  # cost of a source one image width away, (1/4 grey level)²: it only decides between equal patches


@dataclass(frozen=True)
class PatchMatchSettings:
    """Costs are mean squared differences of colours in [0, 1]."""

    patch: AtLeastOne = 5  # px, side, odd (paper 4.1); larger ones tell more apart and reach less close to the hole
    coherence: float = 0.001  # λ_s (paper 4.1); higher copies larger pieces that fit less
    sweeps: int = 4  # number; more come nearer to the best sources and take as much longer
    seed: Seed = 0  # number; added to the removal's: another one gives another field


class NearestNeighbourField(NamedTuple):
    """For every target pixel its source pixel."""

    rows: np.ndarray  # [H, W] int32 source row, -1 outside the target or where there is no source
    cols: np.ndarray  # [H, W] int32
    cost: np.ndarray  # [H, W] float32, (1 − λ_s)·appearance + penalty

    @property
    def found(self) -> np.ndarray:
        """[H, W] bool: target pixels that have a source; none if no source patch is allowed."""
        return self.rows >= 0


def nearest_neighbour_field(
    image: np.ndarray,  # [H, W, 3] uint8
    target: np.ndarray,  # [H, W] bool
    source: np.ndarray,  # [H, W] bool, centres of patches that may be copied
    penalty: np.ndarray,  # [H, W] float32 ≥ 0, added to the cost of each source
    settings: PatchMatchSettings = PatchMatchSettings(),
) -> NearestNeighbourField:
    """The source patch that each target patch resembles most.

    Minimises (1 − λ_s)·appearance + λ_s·spatial + penalty (paper eq. 8). Appearance is the mean squared difference over
    the patch; spatial is the neighbours' mean squared deviation of offsets, truncated and scaled to [0, 1] (PixMix,
    Herling & Broll 2014). A source patch lies inside the image and holds no target pixel; where there is no room for
    one, patches shrink. Between equal sources the nearest wins.
    """
    radius = settings.patch // 2
    while not (allowed := source & patch_centres(~target, radius)).any() and radius > 0:
        radius -= 1
    patches = lay_out(image.astype(np.float32) / 255, radius)
    index = index_patches(patches, allowed, GRID) if allowed.any() and target.any() else None
    rows, cols = np.full((2, *target.shape), -1, np.int32)
    nothing = NearestNeighbourField(rows, cols, np.zeros(target.shape, np.float32))
    unguided = np.empty((*target.shape, 0), np.float32)
    return refined(nothing, patches, target, allowed, settings, penalty, unguided, index)


def patch_centres(usable: np.ndarray, radius: int) -> np.ndarray:
    """[H, W] bool: centres of the patches that lie wholly in the image and on `usable` pixels ([H, W] bool)."""
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    return cv2.erode(usable.astype(np.uint8), window, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0


def upsampled(field: NearestNeighbourField, target: np.ndarray, allowed: np.ndarray) -> NearestNeighbourField:
    """The field at twice the resolution, that of `target`: f ← 2·f plus the pixel's parity, where that is allowed.

    Its cost is not known yet.
    """
    h, w = target.shape
    y, x = np.nonzero(target & field.found.repeat(2, 0).repeat(2, 1)[:h, :w])
    v = np.minimum(2 * field.rows[y // 2, x // 2] + (y & 1), h - 1)
    u = np.minimum(2 * field.cols[y // 2, x // 2] + (x & 1), w - 1)
    kept = allowed[v, u]
    rows, cols = np.full((2, h, w), -1, np.int32)
    rows[y[kept], x[kept]], cols[y[kept], x[kept]] = v[kept], u[kept]
    return NearestNeighbourField(rows, cols, np.zeros((h, w), np.float32))


def refined(
    field: NearestNeighbourField,  # a first guess; where it has no allowed source the nearest one is tried
    patches: Patches,
    target: np.ndarray,  # [H, W] bool
    allowed: np.ndarray,  # [H, W] bool, source patch centres
    settings: PatchMatchSettings,
    penalty: np.ndarray,  # [H, W] float32
    guides: np.ndarray,  # [H, W, G] float32, compared at the patches' centres: squared differences add up
    index: tuple[Components, Tree] | None,  # of allowed patches
    tree_sweeps: int = TREE_SWEEPS,
) -> NearestNeighbourField:
    """Sweeps at one resolution."""
    h, w = target.shape
    (rows, cols), cost = np.full((2, h, w), -1, np.int32), np.zeros((h, w), np.float32)
    if not allowed.any() or not target.any():
        return NearestNeighbourField(rows, cols, cost)
    kept, start = field.found & target, np.stack([field.rows, field.cols])
    kept[kept] = allowed[field.rows[kept], field.cols[kept]]
    if (kept != target).any():
        start = np.where(kept, start, nearest_allowed(allowed))
    weights = np.array([1 - settings.coherence, settings.coherence, TRUNCATION**2, TIE / w], np.float32)
    number, wanted = np.zeros((h, w), np.int32), np.nonzero(target)
    number[wanted] = np.arange(len(wanted[0]))
    tree, looks = NO_TREE, np.empty(0, np.float32)
    if index is not None:
        components, tree = index
        looks = coordinates(patches, components, patches.starts(*wanted)).ravel()
    # Bands hold about as many target pixels each; they depend on nothing else.
    per_row = np.cumsum(target.sum(1))
    count = min(MOST_BANDS, max(1, int(target.any(1).sum()) // BAND_ROWS))
    limits = np.searchsorted(per_row, per_row[-1] * np.arange(1, count) / count) + 1
    edges = np.unique(np.concatenate([[0], limits, [h]])).tolist()
    for sweep in range(settings.sweeps):
        arguments = (
            target, allowed, *patches, penalty, *weights, guides,
            *tree, index is not None and sweep < tree_sweeps, looks, number,
            *start, sweep == 0, sweep % 2 == 0, uint32((settings.seed * 1009 + sweep) & 0xFFFFFFFF),
            rows.copy(), cols.copy(), rows, cols, cost,
        )  # fmt: skip
        parallel_map(partial(_sweep_band, *arguments), pairwise(edges))
    return NearestNeighbourField(rows, cols, cost)


def nearest_allowed(allowed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(rows, cols) [H, W] int32 of the allowed pixel nearest to each pixel."""
    blocked = (~allowed).astype(np.uint8)
    _, labels = cv2.distanceTransformWithLabels(blocked, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    places = np.zeros(labels.max() + 1, np.int32)
    places[labels[allowed]] = np.flatnonzero(allowed)
    nearest = places[labels]
    return nearest // allowed.shape[1], nearest % allowed.shape[1]


@inline_kernel
def _hash(x):
    x ^= x >> uint32(16)
    x = uint32(x * uint32(0x7FEB352D))
    x ^= x >> uint32(15)
    x = uint32(x * uint32(0x846CA68B))
    return uint32(x ^ (x >> uint32(16)))


@kernel
def _sweep_band(
    target, allowed, values, stride, channels, radius, row_weights, penalty,
    weight, coherence, truncation, tie, guides,
    features, tree_rows, tree_cols, split_component, split_value, grid, grid_step, in_leaves, looks, number,
    start_rows, start_cols, first, downward, random, old_rows, old_cols, rows, cols, cost, band,
):  # fmt: skip
    """A sweep over a band's rows [lo, hi): candidates are neighbours' sources, shifted, their leaves, and random ones.

    The first sweep begins with `start` and each patch's own leaf. A candidate's cost is found in one place, written
    out: a helper that takes arrays would count references for each.
    """
    (lo, hi), (h, w) = band, target.shape
    size, step, salt = 2 * radius + 1, 1 if downward else -1, _hash(random)
    bounds, to_scan = np.empty(16, np.float32), np.empty(3, np.int64)
    for i in range(hi - lo):
        y = lo + i if downward else hi - 1 - i
        for j in range(w):
            x = j if downward else w - 1 - j
            if not target[y, x]:
                continue
            here, at, scans = y * stride + x * channels, int64(number[y, x]) * 16, 0
            if first:
                v, u = int64(start_rows[y, x]), int64(start_cols[y, x])
                if in_leaves:
                    to_scan[0], scans = leaf_of(looks, at, split_component, split_value), 1
            else:
                v, u = int64(rows[y, x]), int64(cols[y, x])
            state = _hash(uint32(y * w + x) ^ salt)
            best, own = float32(1e30), float32(0)
            turn, block, lane, span = 0, 0, 16, REACH
            while True:
                bound = float32(0)
                if turn == 0:
                    q, p = v, u
                    turn = 1
                elif turn < 3:  # the two neighbours visited just now
                    dy, dx = (step, 0) if turn == 1 else (0, step)
                    a, b = y - dy, x - dx
                    turn += 1
                    if a < 0 or b < 0 or a >= h or b >= w or not target[a, b]:
                        continue
                    q, p = (rows[a, b], cols[a, b]) if lo <= a < hi else (old_rows[a, b], old_cols[a, b])
                    q, p = int64(q), int64(p)
                    q, p = q + dy, p + dx
                    if q < 0 or p < 0 or q >= h or p >= w:
                        continue
                    if in_leaves:
                        leaf = int64(grid[q // grid_step, p // grid_step])
                        known = leaf < 0
                        for k in range(scans):
                            known |= to_scan[k] == leaf
                        if not known:
                            to_scan[scans] = leaf
                            scans += 1
                elif lane < 16:  # the patches of a leaf that may be better
                    bound = weight * bounds[lane]
                    q, p = int64(tree_rows[block + lane]), int64(tree_cols[block + lane])
                    lane += 1
                    if bound >= best:
                        continue
                elif scans > 0:
                    scans -= 1
                    if own < SAME:
                        continue
                    block = to_scan[scans] * 16
                    total = splat16(float32(0))
                    for k in range(16):
                        d = load16(features, (block + k) * 16) - load1(looks, at + k)
                        total = fma16(d, d, total)
                    if any_between(total, float32(-1), best / weight):
                        store16(bounds, 0, total)
                        lane = 0
                    continue
                elif span > 0:
                    state = _hash(state + uint32(0x9E3779B9))
                    side = 2 * span + 1
                    q = v - span + (int64(state >> uint32(16)) * side >> 16)
                    p = u - span + (int64(state & uint32(0xFFFF)) * side >> 16)
                    span //= 2
                else:
                    break
                if q < 0 or p < 0 or q >= h or p >= w or not allowed[q, p]:
                    continue
                extra = penalty[q, p] + tie * np.sqrt(float32((y - q) ** 2 + (x - p) ** 2))
                if coherence > 0:  # the 4 neighbours' mean truncated squared deviation of offsets, in [0, 1]
                    if extra + bound >= best:
                        continue
                    total_deviation, count = float32(0), 0
                    for k in range(4):
                        dy, dx = (k == 0) - (k == 1), (k == 2) - (k == 3)
                        a, b = y + dy, x + dx
                        if 0 <= a < h and 0 <= b < w and target[a, b]:
                            c, d = (rows[a, b], cols[a, b]) if lo <= a < hi else (old_rows[a, b], old_cols[a, b])
                            if c >= 0:
                                total_deviation += min(float32((q + dy - c) ** 2 + (p + dx - d) ** 2), truncation)
                                count += 1
                    extra += coherence * total_deviation / (truncation * float32(max(count, 1)))
                for k in range(guides.shape[2]):
                    extra += (guides[y, x, k] - guides[q, p, k]) ** 2
                if extra + bound >= best:
                    continue
                one, other = here, q * stride + p * channels
                total = splat16(float32(0))
                for _ in range(size):
                    for k in range(0, len(row_weights), 16):
                        difference = load16(values, one + k) - load16(values, other + k)
                        total = fma16(difference * load16(row_weights, k), difference, total)
                    one += stride
                    other += stride
                found = weight * sum16(total)
                if found + extra < best:
                    best, own = found + extra, found + penalty[q, p]
                    v, u = q, p
            rows[y, x], cols[y, x], cost[y, x] = v, u, own

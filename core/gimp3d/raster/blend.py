"""Front-to-back alpha blending of a tile's ellipses (paper eq. 2); one tile row is one 16-lane vector."""

from __future__ import annotations

import numpy as np
from numba import float32, int32

from ..jit import kernel
from .project import (
    ALPHA_MIN,
    BLUE,
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    DEPTH,
    FEATURES,
    GREEN,
    HALF,
    HALF_HEIGHT,
    LOG2_OPACITY,
    MEAN_X,
    MEAN_Y,
    NORMAL_X,
    NORMAL_Y,
    NORMAL_Z,
    ONE,
    RED,
    TILE,
    ZERO,
)
from .vec16 import (
    exp2_16,
    highest16,
    load1,
    load16,
    max16,
    prefetch,
    ramp16,
    splat16,
    store16,
    sum16,
    where_greater,
)

ALPHA_MAX = np.float32(0.99)
OPAQUE = np.float32(1e-4)  # transmittance at which a tile is finished
CHECK = 16  # Gaussians between two looks at the tile's transmittance
AHEAD = 4  # feature rows to prefetch

# Planes of the output image, and of a tile's scratch rows: [y][plane][16 lanes].
TRANSMITTANCE, OUT_RED, OUT_GREEN, OUT_BLUE, OUT_DEPTH, OUT_MEDIAN, OUT_NORMAL = 0, 1, 2, 3, 4, 5, 6
PLANES = 9
ROW = PLANES * TILE


@kernel
def blend_range(
    lo,
    hi,
    tile_ids,  # [T] the order in which tiles are done
    across,
    width,
    height,
    starts,  # [T+1]
    entries,  # [P]
    features,  # [M, 16]
    with_depth,
    with_normals,
    image,  # [PLANES, H, W] out
):
    """Blend the tiles tile_ids[lo:hi]. Colours are always blended; depths and normals on request."""
    flat = features.reshape(-1)
    scratch = np.empty(TILE * ROW, np.float32)
    zero, one, most = splat16(ZERO), splat16(ONE), splat16(ALPHA_MAX)
    for j in range(lo, hi):
        t = tile_ids[j]
        left, top = (t % across) * TILE, (t // across) * TILE
        for y in range(TILE):
            store16(scratch, y * ROW, one)
            for plane in range(1, PLANES):
                store16(scratch, y * ROW + TILE * plane, zero)
        x = ramp16(float32(left) + HALF)
        first, end = starts[t], starts[t + 1]
        for i in range(first, end):
            o = np.int64(entries[i]) * FEATURES
            prefetch(flat, np.int64(entries[min(i + AHEAD, end - 1)]) * FEATURES)
            mean_y, half_height = load1(flat, o + MEAN_Y), load1(flat, o + HALF_HEIGHT)
            y0 = int32(max(mean_y - half_height + HALF - float32(top), ZERO))
            y1 = int32(min(max(mean_y + half_height + HALF - float32(top), ZERO), float32(TILE)))
            conic_yy, z = load1(flat, o + CONIC_YY), load1(flat, o + DEPTH)
            red, green, blue = load1(flat, o + RED), load1(flat, o + GREEN), load1(flat, o + BLUE)
            nx, ny, nz = load1(flat, o + NORMAL_X), load1(flat, o + NORMAL_Y), load1(flat, o + NORMAL_Z)
            depth = splat16(z)
            dx = x - load1(flat, o + MEAN_X)
            constant = dx * dx * load1(flat, o + CONIC_XX) + load1(flat, o + LOG2_OPACITY)
            linear = dx * load1(flat, o + CONIC_XY)
            dy = float32(top + y0) + HALF - mean_y
            for y in range(y0, y1):
                alpha = exp2_16(constant + (linear + conic_yy * dy) * dy)
                dy = dy + ONE
                alpha = where_greater(alpha, ALPHA_MAX, most, alpha)
                alpha = where_greater(alpha, ALPHA_MIN, alpha, zero)
                k = y * ROW
                before = load16(scratch, k)
                weight = alpha * before
                after = before - weight
                store16(scratch, k, after)
                store16(scratch, k + TILE * OUT_RED, load16(scratch, k + TILE * OUT_RED) + weight * red)
                store16(scratch, k + TILE * OUT_GREEN, load16(scratch, k + TILE * OUT_GREEN) + weight * green)
                store16(scratch, k + TILE * OUT_BLUE, load16(scratch, k + TILE * OUT_BLUE) + weight * blue)
                if with_depth:
                    store16(scratch, k + TILE * OUT_DEPTH, load16(scratch, k + TILE * OUT_DEPTH) + weight * z)
                    median = load16(scratch, k + TILE * OUT_MEDIAN)
                    passed = where_greater(after, HALF, median, depth)
                    store16(scratch, k + TILE * OUT_MEDIAN, where_greater(before, HALF, passed, median))
                if with_normals:
                    n = k + TILE * OUT_NORMAL
                    store16(scratch, n, load16(scratch, n) + weight * nx)
                    store16(scratch, n + TILE, load16(scratch, n + TILE) + weight * ny)
                    store16(scratch, n + 2 * TILE, load16(scratch, n + 2 * TILE) + weight * nz)
            if (i - first) % CHECK == CHECK - 1:
                clear = load16(scratch, 0)
                for y in range(1, TILE):
                    clear = max16(clear, load16(scratch, y * ROW))
                if highest16(clear) < OPAQUE:
                    break
        for y in range(min(TILE, height - top)):
            for plane in range(PLANES):
                for lane in range(min(TILE, width - left)):
                    image[plane, top + y, left + lane] = load1(scratch, y * ROW + TILE * plane + lane)


@kernel
def weigh_range(
    lo,
    hi,
    tile_ids,
    across,
    width,
    height,
    starts,
    entries,
    features,
    pixels,  # [H, W] float32, 1 where weights count
    sums,  # [P] out: Σ of the blend weights of each list entry
    peaks,  # [P] out: their maximum
):
    """Blend weights per (tile, Gaussian), each in its own slot: no atomics, the same for any thread count."""
    flat = features.reshape(-1)
    clear = np.empty(TILE * TILE, np.float32)
    counted = np.empty(TILE * TILE, np.float32)
    zero, most = splat16(ZERO), splat16(ALPHA_MAX)
    for j in range(lo, hi):
        t = tile_ids[j]
        left, top = (t % across) * TILE, (t // across) * TILE
        for y in range(TILE):
            for lane in range(TILE):
                inside = top + y < height and left + lane < width
                clear[y * TILE + lane] = ONE
                counted[y * TILE + lane] = pixels[top + y, left + lane] if inside else ZERO
        x = ramp16(float32(left) + HALF)
        for i in range(starts[t], starts[t + 1]):
            o = np.int64(entries[i]) * FEATURES
            mean_y, half_height = load1(flat, o + MEAN_Y), load1(flat, o + HALF_HEIGHT)
            y0 = int32(max(mean_y - half_height + HALF - float32(top), ZERO))
            y1 = int32(min(max(mean_y + half_height + HALF - float32(top), ZERO), float32(TILE)))
            dx = x - load1(flat, o + MEAN_X)
            constant = dx * dx * load1(flat, o + CONIC_XX) + load1(flat, o + LOG2_OPACITY)
            linear = dx * load1(flat, o + CONIC_XY)
            conic_yy = load1(flat, o + CONIC_YY)
            dy = float32(top + y0) + HALF - mean_y
            total, peak = zero, zero
            for y in range(y0, y1):
                alpha = exp2_16(constant + (linear + conic_yy * dy) * dy)
                dy = dy + ONE
                alpha = where_greater(alpha, ALPHA_MAX, most, alpha)
                alpha = where_greater(alpha, ALPHA_MIN, alpha, zero)
                before = load16(clear, y * TILE)
                weight = alpha * before
                store16(clear, y * TILE, before - weight)
                weight = weight * load16(counted, y * TILE)
                total = total + weight
                peak = max16(peak, weight)
            sums[i], peaks[i] = sum16(total), highest16(peak)


@kernel
def gather_weights(entries, sums, peaks, total, peak):
    """Add each entry's weights to its Gaussian, in list order."""
    for i in range(len(entries)):
        m = entries[i]
        total[m] += sums[i]
        peak[m] = max(peak[m], peaks[i])

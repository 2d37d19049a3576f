"""Front-to-back alpha blending of a tile's ellipses (paper eq. 2); one tile row is one 16-lane vector."""

from __future__ import annotations

import math

import numpy as np
from numba import float32, int32

from ..jit import inline_kernel, kernel
from .project import (
    BLUE,
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
    RED,
    TILE,
    WHITEN_XX,
    WHITEN_XY,
    WHITEN_YY,
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

CHECK = 16  # Gaussians between two looks at the tile's transmittance
AHEAD = 4  # feature rows to prefetch
ONE = np.float32(1)
NOTHING = np.float32(1e-6)  # weights and lengths below it are rounding

# A tile's scratch: for each of its rows these planes of 16 lanes.
T, R, G, B, Z, MEDIAN, NX, NY, NZ = range(0, 9 * TILE, TILE)  # T: transmittance; the others are weighted sums
ROW = 9 * TILE


@inline_kernel
def _pixel_rows(flat, o, top):
    """Rows y0 … y1−1 of the tile at `top` whose pixel centres lie within the ellipse's height."""
    mean_y, half_height = load1(flat, o + MEAN_Y), load1(flat, o + HALF_HEIGHT)
    y0 = int32(max(mean_y - half_height + HALF - float32(top), ZERO))
    y1 = int32(min(max(mean_y + half_height + HALF - float32(top), ZERO), float32(TILE)))
    return y0, y1


@inline_kernel
def _alpha(along, shear, squash, log2_opacity, dy, alpha_min, alpha_max, zero, most):
    """opacity · 2^−(squared whitened length) in a row dy below the mean, thresholded and capped."""
    across = along + shear * dy
    down = squash * dy
    alpha = exp2_16((log2_opacity - down * down) - across * across)
    alpha = where_greater(alpha, alpha_max, most, alpha)
    return where_greater(alpha, alpha_min, alpha, zero)


@inline_kernel
def _opaque(scratch, stride, stop):
    """Whether less than `stop` of the light passes every pixel of the tile."""
    clear = load16(scratch, 0)
    for y in range(1, TILE):
        clear = max16(clear, load16(scratch, y * stride))
    return highest16(clear) < stop


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
    features,  # [N, 16]
    alpha_min,
    alpha_max,
    stop,
    background,  # [3]
    with_rgb,
    with_depth,
    with_normals,
    rgb,  # [H, W, 3] out; the outputs that are not asked for are empty
    alpha_out,  # [H, W] out
    expected,  # [H, W] out
    median,  # [H, W] out
    normals,  # [H, W, 3] out
):
    """Blend the tiles tile_ids[lo:hi]."""
    flat = features.reshape(-1)
    scratch = np.empty(TILE * ROW, np.float32)
    zero, one, most = splat16(ZERO), splat16(ONE), splat16(alpha_max)
    for j in range(lo, hi):
        t = tile_ids[j]
        left, top = (t % across) * TILE, (t // across) * TILE
        for k in range(0, TILE * ROW, TILE):
            store16(scratch, k, zero)
        for k in range(T, TILE * ROW, ROW):
            store16(scratch, k, one)
        x = ramp16(float32(left) + HALF)
        first, end = starts[t], starts[t + 1]
        for i in range(first, end):
            o = np.int64(entries[i]) * FEATURES
            prefetch(flat, np.int64(entries[min(i + AHEAD, end - 1)]) * FEATURES)
            y0, y1 = _pixel_rows(flat, o, top)
            along = (x - load1(flat, o + MEAN_X)) * load1(flat, o + WHITEN_XX)
            shear, squash = load1(flat, o + WHITEN_XY), load1(flat, o + WHITEN_YY)
            log2_opacity, z = load1(flat, o + LOG2_OPACITY), load1(flat, o + DEPTH)
            red, green, blue = load1(flat, o + RED), load1(flat, o + GREEN), load1(flat, o + BLUE)
            nx, ny, nz = load1(flat, o + NORMAL_X), load1(flat, o + NORMAL_Y), load1(flat, o + NORMAL_Z)
            depth = splat16(z)
            dy = float32(top + y0) + HALF - load1(flat, o + MEAN_Y)
            for y in range(y0, y1):
                k = y * ROW
                alpha = _alpha(along, shear, squash, log2_opacity, dy, alpha_min, alpha_max, zero, most)
                dy = dy + ONE
                before = load16(scratch, k + T)
                weight = alpha * before
                after = before - weight
                store16(scratch, k + T, after)
                if with_rgb:
                    store16(scratch, k + R, load16(scratch, k + R) + weight * red)
                    store16(scratch, k + G, load16(scratch, k + G) + weight * green)
                    store16(scratch, k + B, load16(scratch, k + B) + weight * blue)
                if with_depth:
                    store16(scratch, k + Z, load16(scratch, k + Z) + weight * z)
                    so_far = load16(scratch, k + MEDIAN)
                    passed = where_greater(after, HALF, so_far, depth)
                    store16(scratch, k + MEDIAN, where_greater(before, HALF, passed, so_far))
                if with_normals:
                    store16(scratch, k + NX, load16(scratch, k + NX) + weight * nx)
                    store16(scratch, k + NY, load16(scratch, k + NY) + weight * ny)
                    store16(scratch, k + NZ, load16(scratch, k + NZ) + weight * nz)
            if (i - first) % CHECK == CHECK - 1 and _opaque(scratch, ROW, stop):
                break
        for y in range(min(TILE, height - top)):
            for lane in range(min(TILE, width - left)):
                k, v, u = y * ROW + lane, top + y, left + lane
                clear = load1(scratch, k + T)
                weight_sum = ONE - clear
                alpha_out[v, u] = weight_sum
                if with_rgb:
                    for c in range(3):
                        rgb[v, u, c] = load1(scratch, k + R + c * TILE) + clear * background[c]
                if with_depth:
                    there = weight_sum > NOTHING
                    expected[v, u] = load1(scratch, k + Z) / weight_sum if there else ZERO
                    median[v, u] = load1(scratch, k + MEDIAN)
                if with_normals:
                    nx, ny, nz = load1(scratch, k + NX), load1(scratch, k + NY), load1(scratch, k + NZ)
                    length = math.sqrt(nx * nx + ny * ny + nz * nz)
                    inverse = ONE / length if length > NOTHING else ZERO
                    normals[v, u, 0], normals[v, u, 1], normals[v, u, 2] = (
                        nx * inverse,
                        ny * inverse,
                        nz * inverse,
                    )


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
    alpha_min,
    alpha_max,
    stop,
    pixels,  # [H, W] bool, True where weights count
    sums,  # [P] out: Σ of the blend weights of each list entry; zero on entry
    peaks,  # [P] out: their maximum
):
    """Blend weights per (tile, Gaussian), each in its own slot: no atomics, the same for any thread count."""
    flat = features.reshape(-1)
    transmittance = np.empty(TILE * TILE, np.float32)
    counted = np.empty(TILE * TILE, np.float32)
    zero, one, most = splat16(ZERO), splat16(ONE), splat16(alpha_max)
    for j in range(lo, hi):
        t = tile_ids[j]
        left, top = (t % across) * TILE, (t // across) * TILE
        if not pixels[top : top + TILE, left : left + TILE].any():
            continue
        counted[:] = ZERO
        for y in range(min(TILE, height - top)):
            for lane in range(min(TILE, width - left)):
                counted[y * TILE + lane] = ONE if pixels[top + y, left + lane] else ZERO
        for k in range(0, TILE * TILE, TILE):
            store16(transmittance, k, one)
        x = ramp16(float32(left) + HALF)
        first, end = starts[t], starts[t + 1]
        for i in range(first, end):
            o = np.int64(entries[i]) * FEATURES
            prefetch(flat, np.int64(entries[min(i + AHEAD, end - 1)]) * FEATURES)
            y0, y1 = _pixel_rows(flat, o, top)
            along = (x - load1(flat, o + MEAN_X)) * load1(flat, o + WHITEN_XX)
            shear, squash = load1(flat, o + WHITEN_XY), load1(flat, o + WHITEN_YY)
            log2_opacity = load1(flat, o + LOG2_OPACITY)
            dy = float32(top + y0) + HALF - load1(flat, o + MEAN_Y)
            total, peak = zero, zero
            for y in range(y0, y1):
                k = y * TILE
                alpha = _alpha(along, shear, squash, log2_opacity, dy, alpha_min, alpha_max, zero, most)
                dy = dy + ONE
                before = load16(transmittance, k)
                weight = alpha * before
                store16(transmittance, k, before - weight)
                weight = weight * load16(counted, k)
                total = total + weight
                peak = max16(peak, weight)
            sums[i], peaks[i] = sum16(total), highest16(peak)
            if (i - first) % CHECK == CHECK - 1 and _opaque(transmittance, TILE, stop):
                break


@kernel
def gather_weights(entries, sums, peaks, total, peak):
    """Add each entry's weights to its Gaussian, in list order."""
    for i in range(len(entries)):
        m = entries[i]
        total[m] += sums[i]
        peak[m] = max(peak[m], peaks[i])

"""The way back through a tile's blending: from pictures' gradients to sums per list entry.

Every entry has its own record of 16 float32, so that no two threads ever add to the same place: the gradients are the
same for any number of threads. Going back to front, T is divided by 1 − alpha, and `behind` is what a pixel would
show if everything up to here were taken away: dL/dalpha_i = T_i (v_i − behind_i), behind ← behind + alpha (v − behind),
where v is a Gaussian's value under the pixel's gradient. The walk repeats forward's arithmetic bit for bit.
"""

from __future__ import annotations

import numpy as np
from numba import float32, int64

from ..compute.jit import exact_kernel, inline_kernel
from ..compute.simd import (
    LN2,
    columns16,
    fma16,
    load16,
    load_block,
    load_block3,
    max16,
    next_bit,
    prefetch,
    rows16,
    splat16,
    store16,
    sums16,
    where_equal,
    where_greater,
)
from .blend import (
    BLOCK,
    BLOCK_PX,
    BLOCK_STATE,
    BLOCKS,
    CHECK,
    CLOSED,
    HELD,
    MEDIAN,
    NOTHING,
    NX,
    ONE,
    R,
    T,
    Z,
    aligned_empty,
    ellipse_alpha,
    surfel_alpha,
    total,
    total_normal,
)
from .project import HALF, TILE, ZERO, ellipse_of, shown_of, surfel_of

RECORD = 16

# Planes of a block on the way back: T, which is 0 until a closed pixel is opened again; what lies behind, now and at
# the START; gradients with respect to the sums of the same name and the sum of weights; the median's, and its entry.
BEHIND, G_W, G_R, G_G, G_B, G_Z, G_MEDIAN, MEDIAN_ENTRY, G_NX, G_NY, G_NZ, START = range(16, 13 * 16, 16)
BACK_STATE = 13 * 16
TWICE_LN2, TWO = np.float32(2 * LN2), np.float32(2)


@exact_kernel
def unblend_range(slots, lists, given, kept, flags, gradients, first_active, record_rows, records):
    """Records [Q · 16] of some slots' entries: row record_rows[i] for entry i [P], none for rows below `first_active`,
    which are frozen.

    `lists` and `given` are those of blend_range, `kept` is what it left; `gradients` lie as its pictures do, empty
    where not given; `flags` [4] bool: which of rgb, expected depth, median depth and normals are.
    """
    tiles, across, width, starts, stops, entries = lists
    features, surfels, limits, wanted, shifts, background, back = given
    masks, closings, ends, states = kept
    _, alpha_max, _, _, disc = limits
    with_rgb, with_depth, with_median, with_normals = flags
    flat, row_size = features.reshape(-1), int64(features.shape[1])
    column, row, none = columns16(), rows16(), splat16(ZERO)
    work = aligned_empty(BLOCKS * BACK_STATE)
    for slot in slots:
        left, top = (tiles[slot] % across) * TILE, (tiles[slot] // across) * TILE
        state, shift = states[slot], shifts[slot]
        first, end = starts[slot], stops[slot]
        _prepare(state, work, wanted[slot], left, top, width, flags, background, back, slot, gradients)
        for i in range(ends[slot], end):
            if entries[i] >= first_active:
                store16(records, record_rows[i] * RECORD, none)
        for i in range(ends[slot] - 1, first - 1, -1):
            done = i + 1 - first
            if done % CHECK == 0:
                _reopen(state, work, closings[first // CHECK + slot + done // CHECK], float32(done))
            mask = masks[i]
            o = int64(entries[i]) * row_size
            prefetch(flat, int64(entries[max(i - CHECK, first)]) * row_size)
            number = splat16(float32(done))
            log2_opacity, depth, red, green, blue, nx, ny, nz = shown_of(flat, o)
            active = entries[i] >= first_active
            s_red, s_green, s_blue, s_depth, s_log = none, none, none, none, none
            s_nx, s_ny, s_nz = none, none, none
            if surfels:
                surfel = surfel_of(flat, o)
                x, y, u_x, u_y, v_x, v_y, a_x, a_y = surfel
                x, y = float32(left) + HALF - x, float32(top) + HALF - y
                s_ux, s_uy, s_vx, s_vy, s_ax, s_ay, s_cx, s_cy = none, none, none, none, none, none, none, none
                while mask:
                    b, mask = next_bit(mask)
                    k = b * BACK_STATE
                    dx, dy = column + (x + BLOCK_PX * float32(b & 7)), row + (y + BLOCK_PX * float32(b >> 3))
                    u, v, _, free, alpha, inverse, blurred = surfel_alpha(surfel, dx, dy, log2_opacity, depth, limits)
                    z = where_greater(blurred, ZERO, splat16(depth), inverse * depth) - shift
                    value = load16(work, k + G_W)
                    if with_rgb:
                        value = _three(work, k, G_R, red, green, blue, value)
                    if with_depth:
                        value = fma16(load16(work, k + G_Z), z, value)
                    if with_normals:
                        value = _three(work, k, G_NX, nx, ny, nz, value)
                    weight, p = _step(work, k, alpha, value)
                    if active:
                        if with_rgb:
                            s_red, s_green, s_blue = _add_three(work, k, G_R, weight, s_red, s_green, s_blue)
                        if with_normals:
                            s_nx, s_ny, s_nz = _add_three(work, k, G_NX, weight, s_nx, s_ny, s_nz)
                        p = where_greater(free, alpha_max, ZERO, p)
                        s_log = s_log + p
                        d_z = none
                        if with_depth:
                            d_z = weight * load16(work, k + G_Z)
                        if with_median:
                            d_z = d_z + _median_gradient(work, k, number)
                        d_inverse = d_z * depth
                        s_depth = s_depth + where_greater(blurred, ZERO, d_z, d_z * inverse)
                        # ln alpha = ln opacity − ln 2 ((U·δ)² + (V·δ)²) / (1 + A·δ)²
                        p_ray = where_greater(blurred, ZERO, ZERO, p) * TWICE_LN2
                        d_u, d_v = ZERO - p_ray * u * inverse * inverse, ZERO - p_ray * v * inverse * inverse
                        d_inverse = d_inverse - p_ray * fma16(u, u, v * v) * inverse
                        d_a = where_greater(blurred, ZERO, ZERO, ZERO - d_inverse * inverse * inverse)
                        s_ux, s_uy = fma16(d_u, dx, s_ux), fma16(d_u, dy, s_uy)
                        s_vx, s_vy = fma16(d_v, dx, s_vx), fma16(d_v, dy, s_vy)
                        s_ax, s_ay = fma16(d_a, dx, s_ax), fma16(d_a, dy, s_ay)
                        p_disc = where_greater(blurred, ZERO, p, ZERO) * (TWICE_LN2 * disc)
                        s_cx = s_cx + fma16(p_disc, dx, ZERO - fma16(d_u, u_x, fma16(d_v, v_x, d_a * a_x)))
                        s_cy = s_cy + fma16(p_disc, dy, ZERO - fma16(d_u, u_y, fma16(d_v, v_y, d_a * a_y)))
                if active:
                    sums = sums16(
                        s_red, s_green, s_blue, s_depth, s_log, s_ux, s_uy, s_vx, s_vy, s_ax, s_ay, s_cx, s_cy,
                        s_nx, s_ny, s_nz,
                    )  # fmt: skip
                    store16(records, record_rows[i] * RECORD, sums)
            else:
                x, y, xx, xy, yy = ellipse_of(flat, o)
                x, y = float32(left) + HALF - x, float32(top) + HALF - y
                along0, down0 = fma16(column, xx, row * xy), row * yy
                z = splat16(depth - shift)
                q, q_x, q_y, q_xx, q_xy, q_yy = none, none, none, none, none, none
                while mask:
                    b, mask = next_bit(mask)
                    k = b * BACK_STATE
                    dx, dy = x + BLOCK_PX * float32(b & 7), y + BLOCK_PX * float32(b >> 3)
                    along, down = along0 + (dx * xx + dy * xy), down0 + dy * yy
                    free, alpha = ellipse_alpha(along, down, log2_opacity, limits)
                    value = load16(work, k + G_W)
                    if with_rgb:
                        value = _three(work, k, G_R, red, green, blue, value)
                    if with_depth:
                        value = fma16(load16(work, k + G_Z), z, value)
                    if with_normals:
                        value = _three(work, k, G_NX, nx, ny, nz, value)
                    weight, p = _step(work, k, alpha, value)
                    if active:
                        if with_rgb:
                            s_red, s_green, s_blue = _add_three(work, k, G_R, weight, s_red, s_green, s_blue)
                        if with_normals:
                            s_nx, s_ny, s_nz = _add_three(work, k, G_NX, weight, s_nx, s_ny, s_nz)
                        if with_depth:
                            s_depth = fma16(weight, load16(work, k + G_Z), s_depth)
                        if with_median:
                            s_depth = s_depth + _median_gradient(work, k, number)
                        p = where_greater(free, alpha_max, ZERO, p)
                        # Moments about the block's corner: the offset within it is the same for all blocks.
                        p_x, p_y = p * dx, p * dy
                        q, q_x, q_y = q + p, q_x + p_x, q_y + p_y
                        q_xx, q_xy, q_yy = fma16(p_x, dx, q_xx), fma16(p_x, dy, q_xy), fma16(p_y, dy, q_yy)
                if active:
                    s_xx = fma16(column, fma16(column, q, TWO * q_x), q_xx)
                    s_xy = fma16(column, fma16(row, q, q_y), fma16(row, q_x, q_xy))
                    s_yy = fma16(row, fma16(row, q, TWO * q_y), q_yy)
                    sums = sums16(
                        s_red, s_green, s_blue, s_depth, q, fma16(column, q, q_x), fma16(row, q, q_y), s_xx, s_xy, s_yy,
                        none, none, none, s_nx, s_ny, s_nz,
                    )  # fmt: skip
                    store16(records, record_rows[i] * RECORD, sums)


# The helpers inside the loop over blocks have no branches: numba would count references around each.
@inline_kernel
def _three(work, k, plane, x, y, z, value):
    """value + the planes' product with (x, y, z)."""
    value = fma16(load16(work, k + plane), x, value)
    return fma16(load16(work, k + plane + 16), y, fma16(load16(work, k + plane + 32), z, value))


@inline_kernel
def _add_three(work, k, plane, weight, x, y, z):
    """(x, y, z) + weight · the planes."""
    return (
        fma16(weight, load16(work, k + plane), x),
        fma16(weight, load16(work, k + plane + 16), y),
        fma16(weight, load16(work, k + plane + 32), z),
    )


@inline_kernel
def _step(work, k, alpha, value):
    """Take a Gaussian away from the pixels; (its weight, the gradient with respect to ln alpha)."""
    before = load16(work, k + T) / (ONE - alpha)
    store16(work, k + T, before)
    weight = alpha * before
    behind = load16(work, k + BEHIND)
    difference = value - behind
    store16(work, k + BEHIND, fma16(alpha, difference, behind))
    return weight, weight * difference


@inline_kernel
def _median_gradient(work, k, number):
    """The median depth's gradient where this list entry is the median."""
    return where_equal(load16(work, k + MEDIAN_ENTRY), number, load16(work, k + G_MEDIAN), ZERO)


@inline_kernel
def _reopen(state, work, mask, entry):
    """Pixels that were closed after this many entries take part from here on."""
    while mask:
        b, mask = next_bit(mask)
        k, w = b * BLOCK_STATE, b * BACK_STATE
        closed = load16(state, k + CLOSED)
        store16(work, w + T, where_equal(closed, entry, load16(state, k + HELD), load16(work, w + T)))
        store16(work, w + BEHIND, where_equal(closed, entry, load16(work, w + START), load16(work, w + BEHIND)))


@inline_kernel
def _prepare(state, work, mask, left, top, width, flags, background, back, slot, gradients):
    """The pixels' gradients with respect to the sums over Gaussians, from those of the pictures."""
    d_rgb, d_alpha, d_expected, d_median, d_normals = gradients
    while mask:
        b, mask = next_bit(mask)
        k, w = b * BLOCK_STATE, b * BACK_STATE
        o = (top + BLOCK * (b >> 3)) * width + left + BLOCK * (b & 7)
        clear = load16(state, k + T) + load16(state, k + HELD)
        passing = clear
        if len(back):
            passing = clear * (load16(back[slot], k + T) + load16(back[slot], k + HELD))
        weight, g_w, g_z = ONE - passing, splat16(ZERO), splat16(ZERO)
        if len(d_alpha):
            g_w = load_block(d_alpha, o, width)
        behind = splat16(ZERO)  # what shows where no Gaussian is left
        if flags[0]:
            g_red, g_green, g_blue = load_block3(d_rgb, 3 * o, 3 * width)
            behind = fma16(g_red, background[0], fma16(g_green, background[1], g_blue * background[2]))
            store16(work, w + G_R, g_red)
            store16(work, w + G_G, g_green)
            store16(work, w + G_B, g_blue)
        if flags[1]:
            enough = where_greater(weight, NOTHING, ONE / max16(weight, NOTHING), ZERO)
            g_z = load_block(d_expected, o, width) * enough
            g_w = g_w - g_z * total(state, back, slot, k, Z, clear) * enough
            store16(work, w + G_Z, g_z)
        if flags[3]:
            nx, ny, nz, inverse = total_normal(state, back, slot, k, clear)
            nx, ny, nz = nx * inverse, ny * inverse, nz * inverse
            g_x, g_y, g_n = load_block3(d_normals, 3 * o, 3 * width)
            along = fma16(g_x, nx, fma16(g_y, ny, g_n * nz))
            store16(work, w + G_NX, (g_x - along * nx) * inverse)
            store16(work, w + G_NY, (g_y - along * ny) * inverse)
            store16(work, w + G_NZ, (g_n - along * nz) * inverse)
        store16(work, w + G_W, g_w)
        if len(back):
            # the layer behind is one Gaussian of alpha 1 − T whose value is that of its sums
            through = load16(back[slot], k + T) + load16(back[slot], k + HELD)
            behind = fma16(through, behind, g_w * (ONE - through))
            if flags[0]:
                for c in range(3):
                    behind = fma16(load16(work, w + G_R + 16 * c), load16(back[slot], k + R + 16 * c), behind)
            if flags[1]:
                behind = fma16(g_z, load16(back[slot], k + Z), behind)
            if flags[3]:
                for c in range(3):
                    behind = fma16(load16(work, w + G_NX + 16 * c), load16(back[slot], k + NX + 16 * c), behind)
        store16(work, w + BEHIND, behind)
        store16(work, w + START, behind)
        store16(work, w + T, load16(state, k + T))
        if flags[2]:
            store16(work, w + G_MEDIAN, load_block(d_median, o, width))
            store16(work, w + MEDIAN_ENTRY, load16(state, k + MEDIAN))

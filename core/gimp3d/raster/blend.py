"""Front-to-back alpha blending of a tile's Gaussians (paper eq. 2), a block of 4×4 pixels at a time.

A tile is 8×8 blocks, a block is one 16-lane vector, and a 64-bit mask says which blocks a Gaussian can reach. While a
tile is blended its state lies in one scratch array: for each block PLANES vectors. Every CHECK list entries, pixels
through which less than `stop` of the light passes are closed; blocks and tiles without open pixels are done.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float32, float64, int64, uint64

from ..compute.jit import exact_kernel, inline_kernel
from ..compute.simd import (
    any_between,
    columns16,
    exp2_16,
    floor16,
    fma16,
    highest16,
    load1,
    load16,
    max16,
    min16,
    next_bit,
    prefetch,
    ramp16,
    rows16,
    spans_to_bits,
    splat16,
    sqrt16,
    store16,
    store_block,
    store_block3,
    sum16,
    where_greater,
)
from .project import DEPTH, HALF, HALF_HEIGHT, TILE, ZERO, ellipse_of, shown_of, surfel_of

BLOCK = 4  # px, side of a block
BLOCKS = 64  # in a tile
CHECK = 16  # list entries between two looks at the transmittance; 0.99^16 of 1e-4 is still a normal float32
NOTHING = np.float32(1e-6)  # weights and lengths below it are rounding
HORIZON = np.float32(1e-6)  # 1 + A·δ of a surfel met a million times further away than its centre
NEVER = np.float32(1e30)  # a squared length that no exponential survives
CELLS = 8  # a mask has a bit for each of 8×8 cells
ONE, EIGHT, BLOCK_PX = np.float32(1), np.float32(CELLS), np.float32(BLOCK)
SLACK_PX, SLACK = np.float32(0.01), np.float32(5e-4)  # of the bound, for float32's rounding: at worst √(2·6e-8)

# Planes of a block's state. T is the transmittance of open pixels and 0 for closed ones, whose transmittance is kept
# in HELD with the number of list entries after which they closed in CLOSED. MEDIAN is 1 + the list entry that took T
# below one half. The others are sums over the Gaussians, weighted with their share in the pixel.
T, HELD, CLOSED, MEDIAN, R, G, B, Z, NX, NY, NZ = range(0, 11 * 16, 16)
PLANES = 11
BLOCK_STATE = PLANES * 16
TILE_STATE = BLOCKS * BLOCK_STATE
COUNTED = 48  # the first of weigh_range's planes after T, HELD and CLOSED: for each label whether pixels carry it


@inline_kernel
def aligned_empty(size):
    """`size` float32 that begin with a cache line: vectors astride two lines cost twice."""
    room = np.empty(size + 16, np.float32)
    skip = (-(room.ctypes.data // 4)) % 16
    return room[skip : skip + size]


@inline_kernel
def ellipse_alpha(along, down, log2_opacity, limits):
    """(alpha before it is capped, alpha) of a 3D Gaussian at whitened offsets; limits as blend_range's."""
    free = exp2_16(log2_opacity - fma16(along, along, down * down))
    return free, where_greater(free, limits[0], min16(free, limits[1]), ZERO)


@inline_kernel
def surfel_alpha(surfel, dx, dy, log2_opacity, depth, limits):
    """U·δ, V·δ, 1 + A·δ (Huang 2024, eq. 8–11), alpha before it is capped, alpha, 1/(1 + A·δ), whether the low-pass
    decides as 1 or 0, of surfel_of a row, at offsets δ = (dx, dy)."""
    _, _, u_x, u_y, v_x, v_y, a_x, a_y = surfel
    alpha_min, alpha_max, _, near, disc = limits
    u, v = fma16(dx, u_x, dy * u_y), fma16(dx, v_x, dy * v_y)
    den = fma16(dx, a_x, fma16(dy, a_y, splat16(ONE)))
    inverse = where_greater(den, HORIZON, ONE / den, ZERO)  # no hit behind the camera
    near_plane = depth / near  # den beyond which the surfel lies before the near plane
    squared = fma16(u, u, v * v) * inverse * inverse
    squared = where_greater(den, HORIZON, where_greater(den, near_plane, NEVER, squared), NEVER)
    low_pass = fma16(dx, dx, dy * dy) * disc
    free = exp2_16(log2_opacity - min16(low_pass, squared))
    alpha = where_greater(free, alpha_min, min16(free, alpha_max), ZERO)
    return u, v, den, free, alpha, inverse, where_greater(squared, low_pass, splat16(ONE), ZERO)


@inline_kernel
def cover_mask(flat, o, left, top, cell):
    """Which of the 8×8 cells of `cell` px, from pixel (left, top) on, have a pixel centre in the bound of row o.

    Bit 8 r + c stands for column c of row r. Lane r of the vectors is row r. Rounding may add a cell, never lose one.
    """
    x, y, xx, xy, yy = ellipse_of(flat, o)
    half_height = load1(flat, o + HALF_HEIGHT)
    radius, inverse = half_height * yy, ONE / xx
    first_centre = fma16(ramp16(), cell, top + HALF - y)
    low = max16(first_centre, -half_height)
    high = min16(first_centre + (cell - ONE), half_height)
    # the bound reaches furthest right at dy = tip and furthest left at dy = −tip
    slope = float64(xy) / float64(yy)
    tip = float32(-slope * float64(radius) / (float64(yy) * math.sqrt(1.0 + slope * slope)))
    right, left_dy = min16(max16(tip, low), high), min16(max16(-tip, low), high)
    down_right, down_left = right * yy, left_dy * yy
    reach_right = sqrt16(max16(radius * radius - down_right * down_right, ZERO)) - right * xy + SLACK * radius
    reach_left = sqrt16(max16(radius * radius - down_left * down_left, ZERO)) + left_dy * xy + SLACK * radius
    middle, per_cell = x - left, ONE / cell
    # pixel centres lie at +½: the first pixel right of v is −⌊½ − v⌋, the last one left of it ⌊v − ½⌋
    first_pixel = ZERO - floor16(HALF + SLACK_PX - (middle - reach_left * inverse))
    last_pixel = floor16(middle + reach_right * inverse - (HALF - SLACK_PX))
    first = floor16(max16(min16(first_pixel * per_cell, EIGHT), ZERO))
    end = floor16(max16(min16(last_pixel * per_cell, EIGHT - ONE), -ONE)) + ONE
    return spans_to_bits(first, where_greater(low, high + SLACK_PX, ZERO, end))


@inline_kernel
def _cover(entries, i, stop, end, flat, row_size, left, top, covers):
    """The masks of entries i … stop−1. All at once, because each takes long to come out, and the loop over a mask's
    bits cannot be predicted: asked for one by one, every mask would be waited for."""
    for k in range(stop - i):
        prefetch(flat, int64(entries[min(i + k + CHECK, end - 1)]) * row_size)
        covers[k] = cover_mask(flat, int64(entries[i + k]) * row_size, float32(left), float32(top), BLOCK_PX)


@inline_kernel
def _close(state, size, mask, entry, stop):
    """Close pixels that less than `stop` of the light passes; the blocks of `mask` that still have open ones, and
    those in which some were closed."""
    still, closing = uint64(0), uint64(0)
    while mask:
        b, mask = next_bit(mask)
        bit = uint64(1) << uint64(b)
        k = b * size
        t = load16(state, k + T)
        if any_between(t, ZERO, stop):
            closing |= bit
            closes = where_greater(t, ZERO, where_greater(stop, t, splat16(ONE), ZERO), ZERO)
            store16(state, k + HELD, where_greater(closes, ZERO, t, load16(state, k + HELD)))
            store16(state, k + CLOSED, where_greater(closes, ZERO, splat16(entry), load16(state, k + CLOSED)))
            t = where_greater(closes, ZERO, ZERO, t)
            store16(state, k + T, t)
            if highest16(t) > ZERO:
                still |= bit
        else:
            still |= bit
    return still, closing


@inline_kernel
def _open(state, mask, stop):
    """Of a state to go on from: close what is dark, forget when pixels closed; the blocks of `mask` with open ones."""
    _, _ = _close(state, BLOCK_STATE, mask, ZERO, stop)
    still = uint64(0)
    while mask:
        b, mask = next_bit(mask)
        bit = uint64(1) << uint64(b)
        store16(state, b * BLOCK_STATE + CLOSED, splat16(ZERO))
        if highest16(load16(state, b * BLOCK_STATE + T)) > ZERO:
            still |= bit
    return still


@exact_kernel
def blend_range(slots, lists, given, kept, flags, front, pictures):
    """Blend the tiles of some slots into pictures, or, if the alpha of these is empty, only make the states.

    lists: tiles [S], how many across, the pictures' width, starts [S], stops [S], entries [P].
    given: features [N, 16 or 32]; whether of surfels; limits (alpha_min, alpha_max, stop, near, surfels' low-pass
      factor); blocks to draw, wanted [S] uint64; shifts [S] float32 > 0: depths are summed less this one, against
      cancellation; background [3]; what lies behind, back [S, TILE_STATE], or empty.
    kept, out, where not empty: the blocks that each entry was blended into, masks [P] uint64; those with closing pixels
      at each check, closings [P/CHECK + S + 1] uint64; one past the last entry that was looked at, ends [S] int64
      (never empty); states [S, TILE_STATE].
    flags [5] bool: with rgb, expected depth, median depth, normals; and in place of the median depth, 1 + its
      Gaussian's row as int32 bits.
    front [S, TILE_STATE]: what lies before the entries, or empty.
    pictures, out: rgb [3 W H], alpha, expected, median [W H], normals [3 W H], flat, W = width and H rounded up to
      whole blocks; empty where not asked for.
    """
    tiles, across, _, starts, stops, entries = lists
    features, surfels, limits, wanted, shifts, _, _ = given
    masks, closings, ends, states = kept
    stop = limits[2]
    with_rgb, with_depth, with_median, with_normals, _ = flags
    flat, row_size = features.reshape(-1), int64(features.shape[1])
    column, row, none, one = columns16(), rows16(), splat16(ZERO), splat16(ONE)
    own_state, covers = aligned_empty(TILE_STATE), np.empty(CHECK, np.uint64)
    for slot in slots:
        left, top = (tiles[slot] % across) * TILE, (tiles[slot] // across) * TILE
        state = states[slot] if len(states) else own_state
        if len(front):
            for k in range(0, TILE_STATE, 16):
                store16(state, k, load16(front[slot], k))
        else:
            for b in range(BLOCKS):
                for plane in range(PLANES):
                    store16(state, b * BLOCK_STATE + 16 * plane, none)
                store16(state, b * BLOCK_STATE + T, one)
        alive, shift = wanted[slot], shifts[slot]
        if len(front):
            alive = _open(state, alive, stop)
        first, end, i = starts[slot], stops[slot], starts[slot]
        while i < end and alive:
            o = int64(entries[i]) * row_size
            if (i - first) % CHECK == 0:
                _cover(entries, i, min(i + CHECK, end), end, flat, row_size, left, top, covers)
            mask = alive & covers[(i - first) % CHECK]
            if len(masks):
                masks[i] = mask
            number = splat16(float32(i - first + 1))
            log2_opacity, depth, red, green, blue, nx, ny, nz = shown_of(flat, o)
            if surfels:
                surfel = surfel_of(flat, o)
                x, y = float32(left) + HALF - surfel[0], float32(top) + HALF - surfel[1]
            else:
                x, y, xx, xy, yy = ellipse_of(flat, o)
                x, y = float32(left) + HALF - x, float32(top) + HALF - y
                along0, down0 = fma16(column, xx, row * xy), row * yy
            while mask:
                b, mask = next_bit(mask)
                k = b * BLOCK_STATE
                dx, dy = x + BLOCK_PX * float32(b & 7), y + BLOCK_PX * float32(b >> 3)
                if surfels:
                    hit = surfel_alpha(surfel, column + dx, row + dy, log2_opacity, depth, limits)
                    alpha, z = hit[4], where_greater(hit[6], ZERO, splat16(depth), hit[5] * depth)
                else:
                    along, down = along0 + (dx * xx + dy * xy), down0 + dy * yy
                    _, alpha = ellipse_alpha(along, down, log2_opacity, limits)
                    z = splat16(depth)
                before = load16(state, k + T)
                weight = alpha * before
                after = before - weight
                store16(state, k + T, after)
                if with_rgb:
                    _add_three(state, k + R, weight, red, green, blue)
                if with_depth:
                    store16(state, k + Z, fma16(weight, z - shift, load16(state, k + Z)))
                if with_median:
                    crossed = where_greater(after, HALF, load16(state, k + MEDIAN), number)
                    store16(state, k + MEDIAN, where_greater(before, HALF, crossed, load16(state, k + MEDIAN)))
                if with_normals:
                    _add_three(state, k + NX, weight, nx, ny, nz)
            i += 1
            if (i - first) % CHECK == 0:
                alive, closing = _close(state, BLOCK_STATE, alive, float32(i - first), stop)
                if len(closings):
                    closings[(first // CHECK) + slot + (i - first) // CHECK] = closing
        ends[slot] = i
        if len(pictures[1]):
            _finish(state, left, top, slot, lists, given, flat, flags, pictures)


@inline_kernel
def _add_three(state, k, weight, a, b, c):
    """Add a weighted colour or normal to the three planes from k on."""
    store16(state, k, fma16(weight, a, load16(state, k)))
    store16(state, k + 16, fma16(weight, b, load16(state, k + 16)))
    store16(state, k + 32, fma16(weight, c, load16(state, k + 32)))


@inline_kernel
def total(state, back, slot, k, plane, clear):
    """A weighted sum of the whole ray: what the state holds, and what shines through it from the layer behind."""
    own = load16(state, k + plane)
    return fma16(clear, load16(back[slot], k + plane), own) if len(back) else own


@inline_kernel
def total_normal(state, back, slot, k, clear):
    """The sum of the normals along the ray, and 1 / its length, or 0 where there is nothing."""
    nx, ny = total(state, back, slot, k, NX, clear), total(state, back, slot, k, NY, clear)
    nz = total(state, back, slot, k, NZ, clear)
    length = sqrt16(fma16(nx, nx, fma16(ny, ny, nz * nz)))
    return nx, ny, nz, where_greater(length, NOTHING, ONE / max16(length, NOTHING), ZERO)


@inline_kernel
def _finish(state, left, top, slot, lists, given, flat, flags, pictures):
    """Write the tile's blocks into the pictures; blocks that are not wanted are left alone."""
    _, _, width, starts, _, entries = lists
    features, surfels, limits, wanted, shifts, background, back = given
    first, row_size, shift = starts[slot], int64(features.shape[1]), shifts[slot]
    rgb, alpha, expected, median, normals = pictures
    depths = np.empty(16, np.float32)
    numbers = depths.view(np.int32)
    mask = wanted[slot]
    while mask:
        b, mask = next_bit(mask)
        k = b * BLOCK_STATE
        u, v = left + BLOCK * (b & 7), top + BLOCK * (b >> 3)
        o = v * width + u
        clear = load16(state, k + T) + load16(state, k + HELD)
        passing = clear
        if len(back):
            passing = clear * (load16(back[slot], k + T) + load16(back[slot], k + HELD))
        weight = ONE - passing
        store_block(alpha, o, width, weight)
        if flags[0]:
            red = fma16(passing, background[0], total(state, back, slot, k, R, clear))
            green = fma16(passing, background[1], total(state, back, slot, k, G, clear))
            blue = fma16(passing, background[2], total(state, back, slot, k, B, clear))
            store_block3(rgb, 3 * o, 3 * width, red, green, blue)
        if flags[1]:
            z = total(state, back, slot, k, Z, clear)
            store_block(expected, o, width, where_greater(weight, NOTHING, z / max16(weight, NOTHING) + shift, ZERO))
        if flags[2]:
            for lane in range(16):
                number = int64(load1(state, k + MEDIAN + lane))
                depths[lane] = ZERO
                if number > 0 and flags[4]:
                    numbers[lane] = entries[first + number - 1] + 1
                elif number > 0:
                    at = int64(entries[first + number - 1]) * row_size
                    depths[lane] = depth_at(flat, at, u + lane % BLOCK, v + lane // BLOCK, surfels, limits)
            store_block(median, o, width, load16(depths, 0))
        if flags[3]:
            nx, ny, nz, inverse = total_normal(state, back, slot, k, clear)
            store_block3(normals, 3 * o, 3 * width, nx * inverse, ny * inverse, nz * inverse)


@inline_kernel
def depth_at(flat, o, u, v, surfels, limits):
    """z at pixel (u, v) of the Gaussian whose feature row begins at o."""
    depth = load1(flat, o + DEPTH)
    if surfels:
        x, y, u_x, u_y, v_x, v_y, a_x, a_y = surfel_of(flat, o)
        dx, dy = float32(u) + HALF - x, float32(v) + HALF - y
        along_u, along_v = u_x * dx + u_y * dy, v_x * dx + v_y * dy
        den = ONE + a_x * dx + a_y * dy
        squared = (along_u * along_u + along_v * along_v) / (den * den)
        if den > HORIZON and depth >= limits[3] * den and squared <= (dx * dx + dy * dy) * limits[4]:
            depth = depth / den
    return depth


@exact_kernel
def weigh_range(slots, lists, features, surfels, limits, wanted, labels, sums, peaks):
    """Blend weights per (tile, Gaussian), each in its own place: no atomics, the same for any thread count.

    `labels` [H, W] uint8: 0 where weights do not count, else 1 … K. Out: `sums` [K, P], zero on entry, of the weights
    of each list entry over the pixels of a label, and `peaks` [P], their maximum. The others as for blend_range.
    """
    tiles, across, _, starts, stops, entries = lists
    stop = limits[2]
    flat, row_size = features.reshape(-1), int64(features.shape[1])
    column, row, none, one = columns16(), rows16(), splat16(ZERO), splat16(ONE)
    height, width = labels.shape
    kinds = len(sums)
    size = COUNTED + 16 * kinds
    state, covers = aligned_empty(BLOCKS * size), np.empty(CHECK, np.uint64)
    weight_sums = aligned_empty(16 * kinds)
    for slot in slots:
        left, top = (tiles[slot] % across) * TILE, (tiles[slot] // across) * TILE
        for b in range(BLOCKS):
            k = b * size
            store16(state, k + T, one)
            for label in range(kinds):
                store16(state, k + COUNTED + 16 * label, none)
            for y in range(min(BLOCK, height - top - BLOCK * (b >> 3))):
                for x in range(min(BLOCK, width - left - BLOCK * (b & 7))):
                    label = int64(labels[top + BLOCK * (b >> 3) + y, left + BLOCK * (b & 7) + x])
                    if 0 < label <= kinds:
                        state[k + COUNTED + 16 * (label - 1) + 4 * y + x] = ONE
        alive = wanted[slot]
        first, end, i = starts[slot], stops[slot], starts[slot]
        while i < end and alive:
            o = int64(entries[i]) * row_size
            if (i - first) % CHECK == 0:
                _cover(entries, i, min(i + CHECK, end), end, flat, row_size, left, top, covers)
            mask = alive & covers[(i - first) % CHECK]
            log2_opacity, depth, _, _, _, _, _, _ = shown_of(flat, o)
            peak = none
            for label in range(kinds):
                store16(weight_sums, 16 * label, none)
            while mask:
                b, mask = next_bit(mask)
                k = b * size
                x = float32(left) + HALF + BLOCK_PX * float32(b & 7)
                y = float32(top) + HALF + BLOCK_PX * float32(b >> 3)
                if surfels:
                    surfel = surfel_of(flat, o)
                    dx, dy = column + (x - surfel[0]), row + (y - surfel[1])
                    _, _, _, _, alpha, _, _ = surfel_alpha(surfel, dx, dy, log2_opacity, depth, limits)
                else:
                    centre_x, centre_y, xx, xy, yy = ellipse_of(flat, o)
                    dx, dy = column + (x - centre_x), row + (y - centre_y)
                    along = fma16(dx, xx, dy * xy)
                    _, alpha = ellipse_alpha(along, dy * yy, log2_opacity, limits)
                before = load16(state, k + T)
                weight = alpha * before
                store16(state, k + T, before - weight)
                for label in range(kinds):
                    counted = weight * load16(state, k + COUNTED + 16 * label)
                    store16(weight_sums, 16 * label, load16(weight_sums, 16 * label) + counted)
                    peak = max16(peak, counted)
            for label in range(kinds):
                sums[label, i] = sum16(load16(weight_sums, 16 * label))
            peaks[i] = highest16(peak)
            i += 1
            if (i - first) % CHECK == 0:
                alive, _ = _close(state, size, alive, float32(i - first), stop)


@exact_kernel
def gather_weights(entries, sums, peaks, total_weight, peak):
    """Add each entry's weights to its Gaussian, in list order; sums [K, P], total_weight [K, N]."""
    for i in range(len(entries)):
        m = entries[i]
        for label in range(len(sums)):
            total_weight[label, m] += sums[label, i]
        peak[m] = max(peak[m], peaks[i])

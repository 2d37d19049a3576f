"""Which Gaussians each tile has to blend, front to back.

The drawn Gaussians are sorted by depth once; a stable counting scatter then deals them into tiles. The lists do not
depend on how the work is cut into chunks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from numba import float32, float64, int64, uint64

from ..compute.jit import exact_kernel, inline_kernel
from ..compute.simd import (
    floor16,
    fma16,
    load1,
    max16,
    min16,
    next_bit,
    prefetch,
    ramp16,
    spans_to_bits,
    sqrt16,
    where_greater,
)
from ..compute.threads import parallel_map, run_ranges, thread_count
from .project import DEPTH, DRAWN, HALF, HALF_HEIGHT, HIDDEN, TILE, ZERO, Projected, ellipse_of

AHEAD = 16  # rows to prefetch: in depth order each is a cache miss
CELLS = 8  # a mask has a bit for each of 8×8 cells
MOST_DIGIT_BITS = 12  # of the radix sort: 4096 counters fit into a core's nearest cache
ROWS_PER_CHUNK = 8192  # fewer Gaussians than this are not worth a thread
FIRST_COLUMN = np.uint64(0x0101010101010101)  # of a mask of cells
ONE, EIGHT, CELL = np.float32(1), np.float32(CELLS), np.float32(TILE)
SLACK_PX, SLACK = np.float32(0.01), np.float32(5e-4)  # of the bound, for float32's rounding: at worst √(2·6e-8)


@dataclass(frozen=True)
class TileLists:
    """Slot s is tile `tiles[s]`; it blends entries[starts[s]:stops[s]], near to far."""

    tiles: np.ndarray  # [S] int32, row-major tile numbers
    starts: np.ndarray  # [S] int64
    stops: np.ndarray  # [S] int64
    entries: np.ndarray  # [P] int32, rows of features
    records: np.ndarray  # [P] int64, each entry's own row for sums, or empty if they were not asked for
    spans: np.ndarray  # [N, 2] int64: a Gaussian's rows for sums are spans[g, 0] … spans[g, 1] − 1; or empty


def tile_lists(view: Projected, slots: np.ndarray, with_records: bool) -> TileLists:
    """Deal the drawn Gaussians into the wanted tiles; the states of those that reach none become HIDDEN.

    `slots` [down, across] int32: a tile's slot, −1 where it is not wanted.
    """
    features, rects, states = view.features, view.rects, view.states
    tiles = np.flatnonzero(slots.ravel() >= 0).astype(np.int32)
    if len(tiles) < slots.size:
        sums = np.zeros((slots.shape[0] + 1, slots.shape[1] + 1), np.int32)
        sums[1:, 1:] = (slots >= 0).cumsum(0).cumsum(1)
        run_ranges(_hide_range, len(states), rects, sums, states)
    order = depth_order(features, states)
    chunks = _chunks(len(order))
    places = np.zeros((len(chunks), len(tiles)), np.int64)
    ordered, masks = np.empty(len(order), np.int64), np.empty(len(order), np.uint64)
    spans = np.zeros((len(states) if with_records else 0, 2), np.int64)
    packed = rects.view(np.int64).ravel()

    def deal(entries: np.ndarray, records: np.ndarray, first: list[int]) -> list[int]:
        def work(k: int) -> int:
            given = order, features, packed, ordered, masks, slots, places[k], entries, first[k], records, spans
            return _deal(*chunks[k], *given)

        return parallel_map(work, range(len(chunks)))

    counts = deal(np.empty(0, np.int32), np.empty(0, np.int64), [0] * len(chunks))
    ends = np.cumsum(places.T).reshape(places.T.shape)  # tile by tile, and in a tile chunk by chunk
    places = np.ascontiguousarray(ends.T) - places
    starts = np.zeros(len(tiles) + 1, np.int64)
    starts[1:] = ends[:, -1]
    entries, records = np.empty(starts[-1], np.int32), np.empty(starts[-1] if with_records else 0, np.int64)
    if starts[-1]:
        deal(entries, records, list(accumulate(counts, initial=0)))
    return TileLists(tiles, starts[:-1], starts[1:], entries, records, spans)


def _chunks(count: int) -> list[tuple[int, int]]:
    chunks = max(1, min(thread_count(), count // ROWS_PER_CHUNK))
    return [(count * k // chunks, count * (k + 1) // chunks) for k in range(chunks)]


def depth_order(features: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Drawn rows from near to far, rows of equal depth in file order, [D] int32.

    A least-significant-digit radix sort of the float32 depths, whose bits sort like their values (they are positive);
    digits cover only the bits in which the depths differ.
    """
    chunks = _chunks(len(states))
    *starts, total = accumulate((int(np.count_nonzero(states[lo:hi] == DRAWN)) for lo, hi in chunks), initial=0)
    rows, keys = np.empty((2, total), np.int32), np.empty((2, total), np.int32)
    bits = features.view(np.int32)
    parallel_map(lambda part: _gather_keys(*part[0], bits, states, part[1], rows[0], keys[0]), zip(chunks, starts))
    if not total:
        return rows[0]
    lowest = int(keys[0].min())
    length = (int(keys[0].max()) - lowest).bit_length()
    passes = -(-length // MOST_DIGIT_BITS)
    for p in range(passes):
        a, b, width = p % 2, 1 - p % 2, -(-length // passes)
        _sort_by_digit(keys[a], rows[a], lowest, p * width, width, keys[b], rows[b])
    return rows[passes % 2]


def _sort_by_digit(
    keys: np.ndarray, rows: np.ndarray, lowest: int, shift: int, width: int, keys_out: np.ndarray, rows_out: np.ndarray
) -> None:
    """A stable counting sort by `width` bits of the keys, each chunk of them on its own thread."""
    chunks = _chunks(len(keys))
    counts = np.zeros((len(chunks), 1 << width), np.int32)
    parallel_map(lambda part: _count_digits(*part[0], keys, lowest, shift, part[1]), zip(chunks, counts))
    ends = np.cumsum(counts.T, dtype=np.int32).reshape(counts.T.shape)
    places = np.ascontiguousarray(ends.T) - counts
    out = keys_out, rows_out
    parallel_map(lambda part: _scatter_digits(*part[0], keys, rows, lowest, shift, part[1], *out), zip(chunks, places))


@exact_kernel
def _gather_keys(lo, hi, feature_bits, states, place, rows, keys):
    for i in range(lo, hi):
        if states[i] == DRAWN:
            rows[place] = i
            keys[place] = feature_bits[i, DEPTH]
            place += 1


@exact_kernel
def _count_digits(lo, hi, keys, lowest, shift, counts):
    last = len(counts) - 1
    for i in range(lo, hi):
        counts[((keys[i] - lowest) >> shift) & last] += 1


@exact_kernel
def _scatter_digits(lo, hi, keys, rows, lowest, shift, places, keys_out, rows_out):
    last = len(places) - 1
    for i in range(lo, hi):
        digit = ((keys[i] - lowest) >> shift) & last
        place = places[digit]
        places[digit] = place + 1
        keys_out[place] = keys[i]
        rows_out[place] = rows[i]


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


@exact_kernel
def _hide_range(lo, hi, rects, sums, states):
    """Hide what reaches no wanted tile; sums[v, u] counts those above row v and left of column u."""
    for i in range(lo, hi):
        if states[i] == DRAWN:
            x0, y0, x1, y1 = rects[i, 0], rects[i, 1], rects[i, 2], rects[i, 3]
            if sums[y1, x1] - sums[y0, x1] - sums[y1, x0] + sums[y0, x0] == 0:
                states[i] = HIDDEN


@exact_kernel
def mark_touched(rects, states, rows, touched):
    """touched[v, u]: whether a drawn Gaussian of `rows` [N] bool may reach that tile."""
    for i in range(len(rows)):
        if rows[i] and states[i] == DRAWN:
            for v in range(rects[i, 1], rects[i, 3]):
                for u in range(rects[i, 0], rects[i, 2]):
                    touched[v, u] = True


@inline_kernel
def _put(slot, g, record, counting, recording, places, entries, records):
    """Count or write an entry; the next record."""
    if slot < 0:
        return record
    place = places[slot]
    places[slot] = place + 1
    if not counting:
        entries[place] = g
        if recording:
            records[place] = record
    return record + 1


@exact_kernel
def _deal(lo, hi, order, features, rects, ordered, masks, slots, places, entries, record, records, spans):
    """Count the entries of each slot in `places`, or, when there is room for them, write them there.

    The first pass leaves the rectangles in order of depth, and masks of tiles, for the second. Returns one past the
    last record.
    """
    flat, width = features.reshape(-1), features.shape[1]
    counting, recording = len(entries) == 0, len(spans) > 0
    for k in range(lo, hi):
        g = order[k]
        if counting:
            prefetch(rects, int64(order[min(k + AHEAD, hi - 1)]))
            ordered[k] = rects[g]
        rect = ordered[k]
        x0, y0, x1, y1 = rect & 0xFFFF, (rect >> 16) & 0xFFFF, (rect >> 32) & 0xFFFF, (rect >> 48) & 0xFFFF
        first = record
        # of one row or column of tiles the bound reaches every one
        if x1 - x0 == 1 or y1 - y0 == 1:
            for v in range(y0, y1):
                for u in range(x0, x1):
                    record = _put(slots[v, u], g, record, counting, recording, places, entries, records)
        else:
            small = x1 - x0 <= CELLS and y1 - y0 <= CELLS  # one mask holds all
            for top in range(y0, y1, CELLS):
                for left in range(x0, x1, CELLS):
                    if small and not counting:
                        mask = masks[k]
                    else:
                        columns, rows = min(x1 - left, CELLS), min(y1 - top, CELLS)
                        mask = ((uint64(1) << uint64(columns)) - uint64(1)) * (FIRST_COLUMN >> uint64(64 - 8 * rows))
                        mask &= cover_mask(flat, int64(g) * width, float32(left * TILE), float32(top * TILE), CELL)
                        masks[k] = mask
                    while mask:
                        bit, mask = next_bit(mask)
                        slot = slots[top + (bit >> 3), left + (bit & 7)]
                        record = _put(slot, g, record, counting, recording, places, entries, records)
        if recording and not counting:
            spans[g, 0], spans[g, 1] = first, record
    return record

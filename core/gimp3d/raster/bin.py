"""Which Gaussians each tile has to blend, front to back.

The drawn Gaussians are sorted by depth once; a stable counting scatter then deals them into tiles. The lists do not
depend on how the work is cut into chunks.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from numba import float32, int64, uint64

from ..compute.jit import exact_kernel, inline_kernel
from ..compute.simd import next_bit, prefetch
from ..compute.threads import parallel_map, run_ranges, thread_count
from .blend import CELLS, cover_mask
from .project import DEPTH, DRAWN, HIDDEN, TILE, Projected

AHEAD = 16  # rows to prefetch: in depth order each is a cache miss
MOST_DIGIT_BITS = 12  # of the radix sort: 4096 counters fit into a core's nearest cache
ROWS_PER_CHUNK = 8192  # fewer Gaussians than this are not worth a thread
FIRST_COLUMN = np.uint64(0x0101010101010101)  # of a mask of cells
CELL = np.float32(TILE)


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
    items, bits = np.empty(total, np.int64), features.view(np.int32)
    parallel_map(lambda part: _gather(*part[0], bits, states, part[1], items), zip(chunks, starts))
    if total:
        items -= items.min() >> 32 << 32
        length = int(items.max() >> 32).bit_length()
        passes = max(1, -(-length // MOST_DIGIT_BITS))
        width = -(-length // passes)
        for p in range(passes):
            items = _sorted_by_digit(items, 32 + p * width, width)
    return items.astype(np.int32)


def _sorted_by_digit(items: np.ndarray, shift: int, width: int) -> np.ndarray:
    """A stable counting sort by `width` bits of the items, each chunk of them on its own thread."""
    chunks, result = _chunks(len(items)), np.empty_like(items)
    counts = np.zeros((len(chunks), 1 << width), np.int32)
    parallel_map(lambda part: _count_digits(*part[0], items, shift, part[1]), zip(chunks, counts))
    ends = np.cumsum(counts.T, dtype=np.int32).reshape(counts.T.shape)
    places = np.ascontiguousarray(ends.T) - counts
    parallel_map(lambda part: _scatter_digits(*part[0], items, shift, part[1], result), zip(chunks, places))
    return result


@exact_kernel
def _gather(lo, hi, feature_bits, states, place, items):
    """Of each drawn row its depth's bits above its number."""
    for i in range(lo, hi):
        if states[i] == DRAWN:
            items[place] = (int64(feature_bits[i, DEPTH]) << 32) | i
            place += 1


@exact_kernel
def _count_digits(lo, hi, items, shift, counts):
    last = len(counts) - 1
    for i in range(lo, hi):
        counts[(items[i] >> shift) & last] += 1


@exact_kernel
def _scatter_digits(lo, hi, items, shift, places, result):
    last = len(places) - 1
    for i in range(lo, hi):
        digit = (items[i] >> shift) & last
        place = places[digit]
        places[digit] = place + 1
        result[place] = items[i]


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

"""A hole as a mosaic of real pixels: where each is copied from, as a first guess and, seams showing least, in the end.

Patches' votes, averaged, are smooth wherever patches differ; what is copied whole is as sharp as its source. The energy
is that of shift-maps (Pritch, Kav-Venaki and Peleg 2009) with the seams of graph cut textures (Kwatra 2003), lowered by
iterated conditional modes (Besag 1986): a nearest-neighbour field is a good start.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import float32

from ..compute.jit import exact_kernel, inline_kernel, kernel
from ..compute.simd import fma16, load16, splat16, sum16
from ..geometry import blurred
from .patches import lay_out
from .patchmatch import NearestNeighbourField

SEAM = 1.0  # of a seam's squared differences beside those of a pixel from what patches vote for
WINDOW = 3  # px round a pixel in which its source is compared with the votes …
BLUR = 1.5  # px, σ, … both blurred: votes are smooth, and what is smooth shall not be copied for that
SWEEPS = 4  # over the hole, there and back
MOST_SOURCES = 4096  # patches that are tried for each place
LEAST_SHARE = 1e-6  # what was copied without anything known around
FIRST = float32(10)  # times as urgent as others are places on lines
PLAIN = 0.03  # slope of colour per pixel, where no edge runs into the hole, by which a place counts nevertheless


def shift_map(
    picture: np.ndarray, hole: np.ndarray, usable: np.ndarray, field: NearestNeighbourField
) -> NearestNeighbourField:
    """The field in which each of the hole's pixels has a source that it is to be copied from, not a patch's centre.

    The picture [H, W, 3] float32 shows in its hole what patches vote for; `usable` [H, W] bool are pixels to copy; the
    field is of patches that the hole changes. A pixel takes its own shift or one of its eight neighbours', whichever
    costs least: the mean squared difference of source and votes in a window, and along a seam how much the two shifts'
    sources differ on both its sides.
    """
    sources, votes = blurred(picture, usable, BLUR), cv2.GaussianBlur(picture, (0, 0), BLUR)
    here, found = np.indices(hole.shape), field.found
    shifts = np.where(found, np.stack([field.rows, field.cols]) - here, 0)
    _lower(np.argwhere(hole & found), picture, sources, votes, usable, hole & found, *shifts)
    rows, cols = np.where(found, here + shifts, -1).astype(np.int32)
    return field._replace(rows=rows, cols=cols)


@exact_kernel
def _lower(places, picture, sources, votes, usable, free, shift_y, shift_x):
    h, w, _ = picture.shape
    tried_y, tried_x = np.empty(9, np.int64), np.empty(9, np.int64)
    for sweep in range(SWEEPS):
        for k in range(len(places)):
            y, x = places[k if sweep % 2 == 0 else len(places) - 1 - k]
            tried_y[0], tried_x[0], count = shift_y[y, x], shift_x[y, x], 1
            for a in range(max(0, y - 1), min(h, y + 2)):
                for b in range(max(0, x - 1), min(w, x + 2)):
                    new = free[a, b]
                    for j in range(count):
                        new = new and (tried_y[j] != shift_y[a, b] or tried_x[j] != shift_x[a, b])
                    if new:
                        tried_y[count], tried_x[count] = shift_y[a, b], shift_x[a, b]
                        count += 1
            if count == 1:
                continue
            least = np.inf
            for j in range(count):
                v, u = y + tried_y[j], x + tried_x[j]
                if not (WINDOW <= v < h - WINDOW and WINDOW <= u < w - WINDOW and usable[v, u]):
                    continue
                cost = _unlike(sources, votes, usable, y, x, v, u)
                for dy, dx in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                    a, b = y + dy, x + dx
                    if 0 <= a < h and 0 <= b < w:
                        if free[a, b]:
                            other_v, other_u = a + shift_y[a, b], b + shift_x[a, b]
                            cost += SEAM * _seam(picture, v, u, dy, dx, other_v, other_u)
                        elif usable[a, b]:
                            cost += SEAM * 2 * _apart(picture, v + dy, u + dx, a, b)
                if cost < least:
                    least, shift_y[y, x], shift_x[y, x] = cost, tried_y[j], tried_x[j]


@kernel
def _unlike(sources, votes, usable, y, x, v, u):
    h, w, _ = votes.shape
    total, count = 0.0, 0
    for dy in range(-WINDOW, WINDOW + 1):
        for dx in range(-WINDOW, WINDOW + 1):
            if 0 <= y + dy < h and 0 <= x + dx < w and usable[v + dy, u + dx]:
                for c in range(3):
                    total += (votes[y + dy, x + dx, c] - sources[v + dy, u + dx, c]) ** 2
                count += 1
    return total / count


@kernel
def _seam(picture, v, u, dy, dx, other_v, other_u):
    """Of a pixel that is copied from (v, u) and its neighbour, copied from elsewhere."""
    if other_v == v + dy and other_u == u + dx:
        return 0.0
    return _apart(picture, v, u, other_v - dy, other_u - dx) + _apart(picture, v + dy, u + dx, other_v, other_u)


@kernel
def _apart(picture, v, u, other_v, other_u):
    h, w, _ = picture.shape
    a, b = min(max(other_v, 0), h - 1), min(max(other_u, 0), w - 1)
    total = 0.0
    for c in range(3):
        total += (picture[v, u, c] - picture[a, b, c]) ** 2
    return total


def fill_inwards(
    channels: np.ndarray,  # [H, W, C] float32, colours first
    hole: np.ndarray,  # [H, W] bool
    allowed: np.ndarray,  # [H, W] bool, centres of source patches, at least one
    radius: int,
    first: np.ndarray,  # [H, W] float32 in [0, 1]: how near a place is to a line that is filled before the rest
) -> tuple[np.ndarray, np.ndarray]:
    """(rows, cols) [H, W] int32: the pixel that each hole pixel is copied from, -1 elsewhere.

    The next place is the one with most known around it where the strongest edges run into the hole (Criminisi 2004):
    so edges are continued straight until they meet. What was copied counts as less known the further from the rim it
    lies. The source is the patch that differs least from what is known of the place's own.
    """
    sources = np.argwhere(allowed)
    sources = sources[:: -(-len(sources) // MOST_SOURCES)]
    known = np.pad((~hole).astype(np.float32), radius)
    share = cv2.blur(known, (2 * radius + 1,) * 2, borderType=cv2.BORDER_CONSTANT)
    rows, cols = np.full((2, *hole.shape), -1, np.int32)
    _fill_inwards(*lay_out(channels, radius), first, np.argwhere(hole), sources, known, share, rows, cols)
    return rows, cols


@inline_kernel
def _edge_into_hole(values, stride, channels, radius, known, y, x):
    """How steep the strongest edge near a place of the rim is, times how straight it runs into the hole. The patch
    begins at (y, x) in the layout and in `known`."""
    size = 2 * radius + 1
    steepest, along_x, along_y, inward_x, inward_y = float32(0), float32(0), float32(0), float32(0), float32(0)
    for i in range(size):
        for j in range(size):
            if known[y + i, x + j] <= 0:
                continue
            inward_x -= j - radius
            inward_y -= i - radius
            if i + 1 == size or j + 1 == size or known[y + i + 1, x + j] <= 0 or known[y + i, x + j + 1] <= 0:
                continue
            here = (y + i) * stride + (x + j) * channels
            slope_x, slope_y = float32(0), float32(0)
            for c in range(3):
                right = values[here + channels + c] - values[here + c]
                down = values[here + stride + c] - values[here + c]
                slope_x = right if abs(right) > abs(slope_x) else slope_x
                slope_y = down if abs(down) > abs(slope_y) else slope_y
            steep = slope_x * slope_x + slope_y * slope_y
            if steep > steepest:
                steepest, along_x, along_y = steep, -slope_y, slope_x
    length = np.sqrt(inward_x * inward_x + inward_y * inward_y) + float32(1e-6)
    return abs(along_x * inward_x + along_y * inward_y) / length


@kernel
def _fill_inwards(values, stride, channels, radius, row_weights, first, places, sources, known, share, rows, cols):
    """`known` and `share` are [H + 2 radius, W + 2 radius]: a pixel's confidence and its mean over the patch."""
    h, w = rows.shape
    size, width = 2 * radius + 1, len(row_weights)
    weights = np.empty(size * width, np.float32)
    edges = np.full((h, w), float32(-1))  # into the hole at places of its rim; negative: to be told anew
    stamp = min(radius, max(1, radius // 2))  # half the square that is copied at once
    left = len(places)
    while left > 0:
        best, y, x = float32(-1), -1, -1
        for k in range(len(places)):
            a, b = places[k]
            if rows[a, b] >= 0:
                continue
            beside = False
            for d in range(4):
                v, u = a + radius + (d == 0) - (d == 1), b + radius + (d == 2) - (d == 3)
                beside = beside or known[v, u] > 0
            if beside and edges[a, b] < 0:
                edges[a, b] = _edge_into_hole(values, stride, channels, radius, known, a, b)
            priority = share[a + radius, b + radius] * (PLAIN + max(edges[a, b], float32(0)))
            priority *= float32(1) + FIRST * first[a, b]
            if not beside:
                priority *= float32(1e-6)  # its turn comes only where the hole has no rim
            if priority > best:
                best, y, x = priority, a, b
        best_share = share[y + radius, x + radius]
        for i in range(size):
            for j in range(width):
                there = j < size * channels and known[y + i, x + j // channels] > 0
                weights[i * width + j] = float32(1) if there else float32(0)
        least, (best_v, best_u) = float32(1e30), sources[0]
        for k in range(len(sources)):
            v, u = sources[k]
            one, other = y * stride + x * channels, v * stride + u * channels
            total = splat16(float32(0))
            for i in range(size):
                for j in range(0, width, 16):
                    difference = load16(values, one + j) - load16(values, other + j)
                    total = fma16(difference * load16(weights, i * width + j), difference, total)
                one += stride
                other += stride
            distance = sum16(total)
            if distance < least:
                least, best_v, best_u = distance, v, u
        for a in range(max(0, y - stamp), min(h, y + stamp + 1)):
            for b in range(max(0, x - stamp), min(w, x + stamp + 1)):
                if known[a + radius, b + radius] > 0:
                    continue
                q, p = best_v + a - y, best_u + b - x
                rows[a, b], cols[a, b] = q, p
                left -= 1
                one = (a + radius) * stride + (b + radius) * channels
                other = (q + radius) * stride + (p + radius) * channels
                for c in range(channels):
                    values[one + c] = values[other + c]
                known[a + radius, b + radius] = max(best_share, LEAST_SHARE)
                for i in range(size):
                    for j in range(size):
                        share[a + i, b + j] += max(best_share, LEAST_SHARE) / (size * size)
        around = radius + stamp
        edges[max(0, y - around) : y + around + 1, max(0, x - around) : x + around + 1] = float32(-1)

"""A hole as a mosaic of real pixels: where each of them is copied from, so that seams show least.

Patches' votes, averaged, are smooth wherever patches differ; what is copied whole is as sharp as its source. The energy
is that of shift-maps (Pritch, Kav-Venaki and Peleg 2009) with the seams of graph cut textures (Kwatra 2003), lowered by
iterated conditional modes (Besag 1986): a nearest-neighbour field is a good start.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from ..compute.jit import exact_kernel, kernel
from .patchmatch import NearestNeighbourField

SEAM = 1.0  # of a seam's squared differences beside those of a pixel from what patches vote for
WINDOW = 3  # px round a pixel in which its source is compared with the votes …
BLUR = 1.5  # px, σ, … both blurred: votes are smooth, and what is smooth shall not be copied for that
SWEEPS = 4  # over the hole, there and back


def shift_map(
    picture: np.ndarray,  # [H, W, 3] float32, the hole as patches vote
    hole: np.ndarray,  # [H, W] bool
    usable: np.ndarray,  # [H, W] bool, pixels to copy
    field: NearestNeighbourField,  # of patches that the hole changes
) -> NearestNeighbourField:
    """The field in which each of the hole's pixels has a source that it is to be copied from, not a patch's centre.

    A pixel takes its own shift or one of its eight neighbours', whichever costs least: the mean squared difference of
    source and votes in a window, and along a seam how much the two shifts' sources differ on both its sides.
    """
    known = usable.astype(np.float32)
    share = np.maximum(cv2.GaussianBlur(known, (0, 0), BLUR), 1e-3)[..., None]
    sources = cv2.GaussianBlur(picture * known[..., None], (0, 0), BLUR) / share
    votes = cv2.GaussianBlur(picture, (0, 0), BLUR)
    y, x = np.indices(hole.shape)
    shift_y, shift_x = np.where(field.found, field.rows - y, 0), np.where(field.found, field.cols - x, 0)
    places = np.argwhere(hole & field.found)
    _lower(places, picture, sources, votes, usable, hole & field.found, shift_y, shift_x)
    rows, cols = np.where(field.found, y + shift_y, -1), np.where(field.found, x + shift_x, -1)
    return replace(field, rows=rows.astype(np.int32), cols=cols.astype(np.int32))


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

"""The detail that a fill lacks, copied from the places that its patches resemble: as much of it as those have.

What is guessed of a texture is an average, and what resembles an average is smooth, so fills are smoother than what
they continue. Detail is copied in overlapping windows, weighted so that its variance is the same everywhere (Heitz and
Neyret 2018).
"""

from __future__ import annotations

import itertools

import cv2
import numpy as np

from ..geometry import blurred, bounds
from .patchmatch import NearestNeighbourField

FINE, BROAD = 2.0, 4.0  # px, σ of the blurs: that leaves detail out, and whose colours tell where it may lie
ABOUT = 8.0  # px, σ of the neighbourhood whose detail is compared
REACH = 33  # px, farther than that goes
WINDOW = 16  # px, half a side of what is copied from one place
LIKE = 20 / 255  # by which such colours may differ: beyond, it is another material's detail, or their edge
LOUD = 3.0  # times the median of detail: what is louder is an edge, of which only so much is copied
LEAST = 1e-12  # squared colours: far below a grey level


def with_grain(picture: np.ndarray, hole: np.ndarray, usable: np.ndarray, field: NearestNeighbourField) -> np.ndarray:
    """[N, 3] float32: the hole's colours in a filled picture [H, W, 3], with detail.

    `hole` and `usable`, what may be copied, are [H, W] bool; the field tells what patches of the hole resemble. Detail
    that a place has already counts: where a brick's joint is, the same joint is not added.
    """
    box = bounds(hole, REACH)
    here, laid = hole[box], np.zeros_like(picture[box])
    places, filled = np.argwhere(hole), (picture[box], usable[box] | here)
    detail, around = picture - blurred(picture, usable, FINE), blurred(picture, usable, BROAD)
    own, own_around = (picture[box] - blurred(*filled, FINE))[here], blurred(*filled, BROAD)[here]
    parts = []
    for first in itertools.product((0, WINDOW), (0, WINDOW)):
        weight, (v, u) = _in_windows(usable, field, places, first)
        like = np.abs(around[v, u] - own_around).max(1) < LIKE
        parts.append(((weight * like)[:, None], detail[v, u]))
    weight, copied = (np.array(part) for part in zip(*parts))
    if not weight.any():
        return picture[hole]
    most = LOUD * np.median(np.abs(copied[weight[..., 0] > 0]), axis=0)
    copied, own = (np.clip(d, -most, most) for d in (copied, own))
    grain = (weight * copied).sum(0) / np.sqrt(np.maximum((weight**2).sum(0), LEAST))
    usual = (weight * copied**2).sum((0, 2)) / np.maximum(weight.sum((0, 2)), LEAST)
    laid[here] = grain
    felt = (laid - blurred(laid, here, FINE))[here]  # a blur leaves some of it out again
    energies = usual - (own**2).sum(1), (felt**2).sum(1), (own * felt).sum(1)
    lacking, energy, common = (np.maximum(_about(e, here), 0) for e in energies)
    more = (np.sqrt(common**2 + energy * lacking) - common) / np.maximum(energy, LEAST)
    return (picture[hole] + more[:, None] * grain).astype(np.float32)


def _in_windows(
    usable: np.ndarray, field: NearestNeighbourField, places: np.ndarray, first: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Weights [N] of places [N, 2], and the rows and columns [2, N] that they are copied from.

    They are from as far off as the middles of their windows. Windows lie side by side from a row and column on;
    with those half a side further, weights sum to 1.
    """
    size = np.array(usable.shape)
    middle = (places - first) // (2 * WINDOW) * (2 * WINDOW) + WINDOW + first
    weight = (np.cos(np.pi / 2 * (places + 0.5 - middle) / WINDOW) ** 2).prod(1)
    y, x = np.clip(middle, 0, size - 1).T
    source = places + np.stack([field.rows[y, x] - y, field.cols[y, x] - x], axis=1)
    v, u = np.clip(source, 0, size - 1).T
    inside = (source >= 0).all(1) & (source < size).all(1)
    weight = np.where(field.found[y, x] & inside & usable[v, u], weight, 0)
    return weight, np.stack([v, u])


def _about(values: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """[N] means of the hole's values [N] about each of its pixels."""
    spread = np.zeros(hole.shape)
    spread[hole] = values
    weight = cv2.GaussianBlur(hole.astype(np.float64), (0, 0), ABOUT)[hole]
    return np.asarray(cv2.GaussianBlur(spread, (0, 0), ABOUT)[hole] / weight)

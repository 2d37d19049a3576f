"""Which Gaussians photos show to be surroundings, though depths and boxes took them for the object, the other way, or
to be both.

docs/method.md, "Where views are filled".
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np

from ..camera import Camera
from ..gaussians import Gaussians
from ..geometry import Window
from ..raster import drawing, label_weights
from .selection import LEAST_WEIGHT
from .witness import total_over

ROUNDS = 1, 2  # times a photo's size at which it is cut, from what the round before found in all; larger cuts lose less
MOSTLY = 0.5  # share of blend weight in a pixel that decides: the majority
PURE = 0.7  # share from which a pixel has nobody else's colour
LEAST = 0.1  # share of a Gaussian's weight that photos must show as the object's for it to be the object's, too
SOME = 0.25  # share from which the next round begins with it as the object's
MARGIN = 12  # px round the boxes whose colours are the surroundings' for certain
LARGEST = 512  # px, longest side of what is cut at once: colours need no more
ELSE, OBJECT = 1, 2  # labels of a view's pixels


class Sight(NamedTuple):
    """A view, as far as it tells what is beside the object; arrays [H, W]."""

    camera: Camera
    photo: np.ndarray  # [H, W, 3] uint8, with the object
    polygon: np.ndarray  # bool, the boxes
    marked: np.ndarray  # bool, what the user named beside the object: its colours are the surroundings', yet it goes


class Shown(NamedTuple):
    """What photos show of Gaussians; [N] bool but for the last two."""

    beside: np.ndarray  # beside the object, of those that may be surroundings
    object_: np.ndarray  # as the object, of those in the boxes that yet would be left
    both: np.ndarray  # of both: more beside the object than not, yet some of it
    share: np.ndarray  # [N] of the weight that is shown, that on the object
    photos: list[tuple[Camera, np.ndarray]]  # and where photos show what is beside the object, [H, W] bool


def shown_beside(
    scene: Gaussians, goes: np.ndarray, stays: np.ndarray, may: np.ndarray, sights: Sequence[Sight]
) -> Shown:
    """What photos show of the rows that go, though they `may` be surroundings, and of those that would be left in the
    boxes; all [N] bool.

    Each photo is cut by its colours into the object and the rest (GrabCut, Rother et al. 2004): of what `goes`, as it
    is drawn there, what may be nothing else is the object's for certain. Once more, from what in the boxes all photos
    show as the object's to some share: so they tell each other.
    """
    begins, sure, in_boxes = goes, goes & ~may, goes | stays
    sights = [sight for sight in sights if sight.polygon.any()]
    elsewhere, on_object = np.zeros((2, len(scene)))
    clear = [s.polygon for s in sights]

    def of(size: float, k: int) -> np.ndarray:
        sight = sights[k]
        drawn = drawing(scene, sight.camera, with_colour=False, pixels=sight.polygon)
        certain = cv2.erode((drawn.footprint(sure) > PURE).astype(np.uint8), np.ones((3, 3))) > 0
        start = np.full(sight.polygon.shape, cv2.GC_BGD, np.uint8)
        start[sight.polygon] = cv2.GC_PR_BGD
        start[sight.polygon & (drawn.footprint(begins) > MOSTLY)] = cv2.GC_PR_FGD
        start[sight.polygon & certain] = cv2.GC_FGD
        start[sight.marked] = cv2.GC_BGD
        window = _window(sight.polygon)
        labels = np.where(sight.marked, OBJECT, ELSE).astype(np.uint8)
        labels[window][_cut(sight.photo[window], start[window], size)] = OBJECT
        clear[k] = labels == ELSE
        return label_weights(scene, sight.camera, labels, OBJECT, in_boxes | may)

    for size in ROUNDS:
        elsewhere, on_object = total_over(range(len(sights)), partial(of, size), (OBJECT, len(scene)))
        shown = elsewhere + on_object
        sure = sure | (in_boxes & (on_object > MOSTLY * shown))
        begins = in_boxes & (on_object > SOME * shown)
    shown = elsewhere + on_object
    share = on_object / np.maximum(shown, LEAST_WEIGHT)
    told, some, mostly = shown > LEAST_WEIGHT, share > LEAST, share > MOSTLY
    both = ((goes & may) | stays) & told & some & ~mostly
    photos = [(s.camera, beside) for s, beside in zip(sights, clear)]
    return Shown(may & told & ~some, stays & told & mostly, both, share, photos)


def _window(polygon: np.ndarray) -> Window:
    """The rectangle round what is not False, and a margin."""
    (top, bottom), (left, right) = (np.flatnonzero(polygon.any(axis))[[0, -1]] for axis in (1, 0))
    return slice(max(0, top - MARGIN), bottom + 1 + MARGIN), slice(max(0, left - MARGIN), right + 1 + MARGIN)


def _cut(photo: np.ndarray, start: np.ndarray, times: float) -> np.ndarray:
    """[h, w] bool: what is the object's by its colours; `start` as GrabCut names it."""
    times = min(times, LARGEST / max(start.shape))
    size = [max(1, round(n * times)) for n in start.shape[::-1]]
    labels = cv2.resize(start, size, interpolation=cv2.INTER_NEAREST)
    if len(np.unique(labels & 1)) == 2:
        background, foreground = np.zeros((2, 1, 65))
        cv2.setRNGSeed(0)  # of this thread: what k-means begins with
        small = cv2.resize(photo, size, interpolation=cv2.INTER_AREA if times < 1 else cv2.INTER_LINEAR)
        cv2.grabCut(small, labels, None, background, foreground, 1, cv2.GC_INIT_WITH_MASK)
    return cv2.resize(labels & 1, start.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0

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
LEAST_VARIANCE = 1e-3  # squared grey levels, added to what a mixture's colours vary by: one may be even
LARGEST = 512  # px, longest side of what is cut at once: colours need no more
ELSE, OBJECT, ALIKE = 1, 2, 3  # labels of a view's pixels; alike: it is cut off, and yet has the object's colours


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
    alike: np.ndarray  # beside the object, yet some of it in colours that are rather the object's: it may be a foot
    share: np.ndarray  # [N] of the weight that is shown, that on the object
    photos: list[tuple[Camera, np.ndarray]]  # and where photos show what is beside the object, [H, W] bool


def shown_beside(
    scene: Gaussians, goes: np.ndarray, stays: np.ndarray, may: np.ndarray, sights: Sequence[Sight]
) -> Shown:
    """What photos show of the rows that go, though they `may` be surroundings, and of those that would be left in the
    boxes; all [N] bool.

    Each photo is cut by its colours into the object and the rest (GrabCut, Rother et al. 2004): of what `goes`, as it
    is drawn there, what may be nothing else is the object's for certain. Once more, larger, from what in the boxes all
    photos show as the object's to some share: so they tell each other. What a cut takes off hangs together; of thin
    feet that stand on what looks much like them single pixels tell.
    """
    begins, sure, in_boxes = goes, goes & ~may, goes | stays
    sights = [sight for sight in sights if sight.polygon.any()]
    elsewhere, on_object = np.zeros((2, len(scene)))
    clear = [s.polygon for s in sights]

    def of(size: float, k: int) -> np.ndarray:
        sight = sights[k]
        drawn = drawing(scene, sight.camera, with_colour=False, pixels=sight.polygon)
        surely, about = drawn.footprints(sure, begins)
        certain = cv2.erode((surely > PURE).astype(np.uint8), np.ones((3, 3))) > 0
        start = np.full(sight.polygon.shape, cv2.GC_BGD, np.uint8)
        start[sight.polygon] = cv2.GC_PR_BGD
        start[sight.polygon & (about > MOSTLY)] = cv2.GC_PR_FGD
        start[sight.polygon & certain] = cv2.GC_FGD
        start[sight.marked] = cv2.GC_BGD
        window = _window(sight.polygon)
        labels = np.full(sight.polygon.shape, ELSE, np.uint8)
        cut, mixtures = _cut(sight.photo[window], start[window], size)
        if size == ROUNDS[-1]:
            labels[window][_alike(sight.photo[window], mixtures) & sight.polygon[window]] = ALIKE
        labels[window][_begun(cut, start[window])] = OBJECT
        labels[sight.marked] = OBJECT
        clear[k] = labels != OBJECT
        return label_weights(scene, sight.camera, labels, ALIKE, in_boxes | may)

    for size in ROUNDS:
        unlike, on_object, alike = total_over(range(len(sights)), partial(of, size), (ALIKE, len(scene)))
        elsewhere = unlike + alike
        shown = elsewhere + on_object
        sure = sure | (in_boxes & (on_object > MOSTLY * shown))
        begins = in_boxes & (on_object > SOME * shown)
    shown = elsewhere + on_object
    share = on_object / np.maximum(shown, LEAST_WEIGHT)
    told, some, mostly = shown > LEAST_WEIGHT, share > LEAST, share > MOSTLY
    both = ((goes & may) | stays) & told & some & ~mostly
    photos = [(s.camera, beside) for s, beside in zip(sights, clear)]
    found = may & told & ~some
    return Shown(found, stays & told & mostly, both, found & (on_object + alike > LEAST * shown), share, photos)


def _window(polygon: np.ndarray) -> Window:
    """The rectangle round what is not False, and a margin."""
    (top, bottom), (left, right) = (np.flatnonzero(polygon.any(axis))[[0, -1]] for axis in (1, 0))
    return slice(max(0, top - MARGIN), bottom + 1 + MARGIN), slice(max(0, left - MARGIN), right + 1 + MARGIN)


def _cut(photo: np.ndarray, start: np.ndarray, times: float) -> tuple[np.ndarray, np.ndarray]:
    """[h, w] bool: what is the object's by its colours and hangs together; and the mixtures of the rest's and of the
    object's colours, [2, 65], 0 if one of them is empty. `start` as GrabCut names it."""
    times = min(times, LARGEST / max(start.shape))
    size = [max(1, round(n * times)) for n in start.shape[::-1]]
    labels, mixtures = cv2.resize(start, size, interpolation=cv2.INTER_NEAREST), np.zeros((2, 1, 65))
    if len(np.unique(labels & 1)) == 2:
        cv2.setRNGSeed(0)  # of this thread: what k-means begins with
        small = cv2.resize(photo, size, interpolation=cv2.INTER_AREA if times < 1 else cv2.INTER_LINEAR)
        cv2.grabCut(small, labels, None, mixtures[0], mixtures[1], 1, cv2.GC_INIT_WITH_MASK)
    return cv2.resize(labels & 1, start.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0, mixtures[:, 0]


def _begun(cut: np.ndarray, start: np.ndarray) -> np.ndarray:
    """[h, w] bool: the parts of a cut that hold some of what it began from; others only have the object's colours."""
    _, parts = cv2.connectedComponents(cut.astype(np.uint8), connectivity=8)
    return cut & np.isin(parts, parts[cut & (start & 1 > 0)])


def _alike(photo: np.ndarray, mixtures: np.ndarray) -> np.ndarray:
    """[h, w] bool: pixels whose colours are rather the object's."""
    elsewhere, object_ = (_likelihood(photo, mixture) for mixture in mixtures)
    return object_ > elsewhere


def _likelihood(photo: np.ndarray, mixture: np.ndarray) -> np.ndarray:
    """[h, w] of the colours in one of GrabCut's mixtures of five Gaussians, but for a factor."""
    total = np.zeros(photo.shape[:2], np.float32)
    weights, means, covariances = np.split(mixture, [5, 20])
    for weight, mean, covariance in zip(weights, means.reshape(5, 3), covariances.reshape(5, 3, 3)):
        if weight > 0:
            whitening = np.linalg.inv(np.linalg.cholesky(covariance + LEAST_VARIANCE * np.eye(3)))
            off = cv2.transform(photo.astype(np.float32), np.column_stack([whitening, -whitening @ mean]))
            total += weight * np.linalg.det(whitening) * np.exp(-0.5 * (off**2).sum(-1))
    return total

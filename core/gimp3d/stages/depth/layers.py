"""Which surfaces round a hole go on behind the object, and where each of them lies: nothing smears across a step."""

from __future__ import annotations

from itertools import combinations

import cv2
import numpy as np
import scipy.ndimage

from ...solvers.poisson import solve_poisson

AROUND = np.ones((3, 3), bool)  # a pixel and its 8 neighbours
STEP = 0.06  # relative difference of disparity that parts two layers: six times what made scenes scatter by
BAND = 4  # px, width of the ring on which occluders are told
REACH = 24  # px, width of the ring in which a surface in front of the object is followed
LEAST_LAYER = 0.1  # share of the rim that a layer must hold to reach into the hole
OCCLUDERS = 0.25  # share of the rim, at most, that is taken for occluders; more is what the object stood on
FRONT = 0.05  # share of a part of the ring that must be seen to be in front for all of it to be
STRAIGHT = 0.97  # share of two layers' pixels that a line must part for it to be their border


def steps(disparity: np.ndarray, known: np.ndarray, step: float = STEP) -> np.ndarray:
    """[H, W] bool: known pixels within 2 px of a relative step.

    The measure is the second difference over ±2 px, which is 0 on planes at any slant and the step's height at a
    step, also one blurred over a pixel or two.
    """
    padded = np.pad(np.where(known, disparity, np.nan), 2, constant_values=np.nan)
    h, w = disparity.shape
    found = np.zeros(disparity.shape, bool)
    with np.errstate(invalid="ignore"):
        for dy, dx in ((0, 2), (2, 0), (2, 2), (2, -2)):
            after = padded[2 + dy : 2 + dy + h, 2 + dx : 2 + dx + w]
            before = padded[2 - dy : 2 - dy + h, 2 - dx : 2 - dx + w]
            found |= np.abs(before + after - 2 * disparity) > step * np.maximum(before, after)
    return found & known


def background_rim(disparity: np.ndarray, known: np.ndarray, hole: np.ndarray, step: float = STEP) -> np.ndarray:
    """[H, W] bool: the known pixels that may bound the hole, that is, not those of occluders in front of it.

    Layers are the parts of the band round the hole between steps. Taken from the farthest on, those that together make
    up most of the rim are what the hole lies in; nearer ones that end at a step are occluders, behind which the others
    go on. Surfaces that meet, as a floor and a wall, have no step between them, however steep.
    """
    distance = distance_to(hole)
    band = known & (distance <= BAND)
    edges = band & steps(disparity, known, step)
    layers, count = scipy.ndimage.label(band & ~edges, AROUND)
    if count < 2:
        return known
    numbers = np.arange(1, count + 1)
    sizes = scipy.ndimage.sum_labels(distance < 2, layers, numbers)
    heights = scipy.ndimage.median(disparity, layers, numbers)
    far_first = np.argsort(heights)
    reached = np.cumsum(sizes[far_first])
    background = heights[far_first][np.searchsorted(reached, (1 - OCCLUDERS) * reached[-1])]
    nearer = heights > (1 + step) * background
    behind = np.isin(layers, numbers[~nearer])
    occluder = [k for k in numbers[nearer] if _stepped(disparity, layers == k, behind, step)]
    front = np.isin(layers, occluder)
    # Of the step's own pixels, those on its upper half belong to the occluder.
    top = scipy.ndimage.maximum_filter(np.where(known, disparity, -np.inf), 5)
    bottom = scipy.ndimage.minimum_filter(np.where(known, disparity, np.inf), 5)
    with np.errstate(invalid="ignore"):
        upper = disparity > (top + bottom) / 2
    edge = edges & scipy.ndimage.binary_dilation(front, AROUND, iterations=2) & upper
    return known & ~front & ~edge


def without_front(
    disparity: np.ndarray, known: np.ndarray, hole: np.ndarray, front: np.ndarray, step: float, share: float = FRONT
) -> np.ndarray:
    """[H, W] bool: the known pixels without surfaces that must not be continued into the hole.

    Those are surfaces that hide the object itself, as the hole lies behind them, and surfaces that are not there. The
    ring round the hole is cut at steps into parts; a part goes if the given share of it is `front` [H, W] bool: pixels
    seen to lie in front of the object, at its outline, or wrong.
    """
    if not (front & known).any():
        return known
    ring = known & (distance_to(hole) <= REACH)
    labels, _ = scipy.ndimage.label(ring & ~steps(disparity, known, step), AROUND)
    size, marked = np.bincount(labels.ravel()), np.bincount(labels[front], minlength=labels.max() + 1)
    gone = marked >= share * size
    gone[0] = False
    edge = ring & (labels == 0) & (front | scipy.ndimage.binary_dilation(gone[labels], AROUND, iterations=2))
    return known & ~gone[labels] & ~edge


def separated(disparity: np.ndarray, measured: np.ndarray, rim: np.ndarray, step: float = STEP) -> list[np.ndarray]:
    """The layers [H, W] bool into which steps part the measured pixels; one if nothing parts them for certain.

    Only parts that hold enough of the rim, the pixels that touch the hole, count, and only those between which the
    disparity really steps.
    """
    labels, _ = scipy.ndimage.label(measured & ~steps(disparity, measured, step), AROUND)
    held = np.bincount(labels[rim], minlength=labels.max() + 1)
    held[0] = 0
    parts = [labels == k for k in np.flatnonzero(held >= max(1.0, LEAST_LAYER * rim.sum()))]
    group = list(range(len(parts)))
    for i, j in combinations(range(len(parts)), 2):
        if not _stepped(disparity, parts[i], parts[j], step):
            group = [group[i] if g == group[j] else g for g in group]
    layers = [np.any([p for p, g in zip(parts, group) if g == k], axis=0) for k in sorted(set(group))]
    return layers if len(layers) > 1 else [measured]


def _stepped(disparity: np.ndarray, a: np.ndarray, b: np.ndarray, step: float) -> bool:
    """Whether two parts differ clearly where they come near each other; parts that do not come near are not parted.

    Each part's plane there is continued to the other part and half way to it: a slope across a gap is no step, nor are
    two slopes that meet in it.
    """
    reach = np.ones((15, 15), np.uint8)
    near = [p & (cv2.dilate(q.astype(np.uint8), reach) > 0) for p, q in ((a, b), (b, a))]
    if not near[0].any() or not near[1].any():
        return False
    points = [np.stack([*np.nonzero(p), np.ones(p.sum())], -1) for p in near]
    values = [disparity[p] for p in near]
    planes = [np.linalg.lstsq(p, v, rcond=None)[0] for p, v in zip(points, values)]
    places = [points[0].mean(0), points[1].mean(0), (points[0].mean(0) + points[1].mean(0)) / 2]
    apart = min(abs(float(place @ (planes[0] - planes[1]))) for place in places)
    level = abs(float(np.median(values[0])) - float(np.median(values[1])))
    return min(apart, level) > step * max(float(np.median(v)) for v in values)


def divided(hole: np.ndarray, seeds: np.ndarray, rings: list[np.ndarray]) -> np.ndarray:
    """[H, W] int: the layer of each of the hole's pixels.

    `seeds` [H, W] int are the layers of rim pixels and of what is measured in the hole, −1 elsewhere; `rings` [H, W]
    bool all measured pixels of each layer. Where a straight line parts the measured pixels of two layers, it parts the
    hole: edges of things that people build are straight. Otherwise each pixel goes to the layer with the largest
    harmonic extension of its share of the rim.
    """
    present = np.unique(seeds[seeds >= 0])
    if len(present) < 2:
        return np.full(hole.shape, present[0] if len(present) else 0)
    if len(present) == 2:
        side = _straight_border(rings[present[0]], rings[present[1]])
        inside = hole & (seeds >= 0)
        if side is not None and (side == (seeds == present[0]))[inside].sum() >= STRAIGHT * inside.sum():
            return np.where(side, present[0], present[1])
    votes = solve_poisson(hole & (seeds < 0), seeds >= 0, (seeds[..., None] == present).astype(np.float64)).values
    return present[np.nan_to_num(votes).argmax(-1)]


def _straight_border(a: np.ndarray, b: np.ndarray) -> np.ndarray | None:
    """[H, W] bool: the side of the first of two sets of pixels, if a line parts them (logistic regression)."""
    v, u = np.mgrid[: a.shape[0], : a.shape[1]]
    sets = [np.stack([u[s], v[s], np.ones(s.sum())], -1) for s in (a, b)]
    thinned = [p[:: max(1, len(p) // 500)] for p in sets]
    points = np.concatenate(thinned)
    centre, size = points[:, :2].mean(0), points[:, :2].std() + 1e-9
    points[:, :2] = (points[:, :2] - centre) / size
    sign = np.repeat([1.0, -1.0], [len(p) for p in thinned])
    weight = np.repeat([1 / len(p) for p in thinned], [len(p) for p in thinned])  # both sets count the same
    line = np.zeros(3)
    for _ in range(25):  # Newton steps, slightly ridged: separable sets have no finite optimum
        odds = 1 / (1 + np.exp(np.clip(sign * (points @ line), -30, 30)))
        gradient = points.T @ (weight * sign * odds) - 1e-3 * line
        curvature = (points.T * (weight * odds * (1 - odds))) @ points + 1e-3 * np.eye(3)
        line = line + np.linalg.solve(curvature, gradient)
    if ((sign * (points @ line) > 0) * weight).sum() < 2 * STRAIGHT:
        return None
    return line[0] * (u - centre[0]) / size + line[1] * (v - centre[1]) / size + line[2] > 0


def distance_to(hole: np.ndarray) -> np.ndarray:
    """[H, W] float32: distance to the hole in pixels, 0 inside."""
    return cv2.distanceTransform((~hole).astype(np.uint8), cv2.DIST_L2, 5)

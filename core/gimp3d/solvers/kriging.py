"""What a picture's own statistics let expect of a hole, given what is round it: smooth colours, and how sure they are.

The picture, made small, counts as a stationary Gaussian texture with the covariance that it has round the hole: that
knows stripes, grain and what repeats. Its mean in the hole, given the rim, is the best linear guess (simple kriging:
Matheron 1963; of textures: Galerne and Leclaire 2017). Without weights, colours are carried inwards from the rim, and
the variogram tells how far the truth may lie from them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from ..geometry import bounds
from .edges import Edge

SIDE = 64  # px: the hole and what is given round it are shrunk to this
GIVEN, TELLING = 0.3, 2.0  # of the hole's thickness: how far known pixels are given, and tell the covariance
LEAST_GIVEN = 4  # px
NUGGET = 0.02  # of the variance: what neighbours do not have in common
NO_GUESS = 1e3  # variance where nothing is known: far above that of any colours
ROUNDING = 2.0**-12  # of results: the solver's own hangs on the number of threads
LEAST_BAND, BAND = 4.0, 0.5  # rim that tells what is carried inwards: px at least, and of the unknown part's depth
LEAST_PAIRS = 100  # of pixels, that tell how colours vary at a distance

# Lags 0, 1, 2, 4 … px, and half the mean squared difference of pixels that far apart, as np.interp takes them
Variogram = tuple[list[float], list[float]]


class Expected(NamedTuple):
    """Smooth colours, of what is known and of what is expected in the hole."""

    colours: np.ndarray  # [H, W, 3] float32
    variance: np.ndarray  # [H, W] float32, mean over channels, of the truth about them; 0 where it is known

    def sized(self, shape: tuple[int, ...], patch: int) -> Expected:
        """At another size [h, w], and means of patches of so many px."""
        resized = (cv2.resize(a, shape[::-1], interpolation=cv2.INTER_AREA) for a in self)
        return Expected(*(cv2.blur(a, (patch,) * 2) for a in resized))


def expect(image: np.ndarray, hole: np.ndarray, known: np.ndarray, edges: Sequence[Edge] = ()) -> Expected:
    """A picture [H, W, 3] in [0, 1] at the size that tells the hole's: detail finer than `SIDE` allows is left out.

    Hole and what is known are [H, W] bool, some of it each. What edges part has a mean of its own on either side.
    """
    height, width = hole.shape
    thickness = 2 * float(cv2.distanceTransform(hole.astype(np.uint8), cv2.DIST_L2, 5).max())
    reach = max(LEAST_GIVEN, GIVEN * thickness)
    longest = max(side.stop - side.start for side in bounds(hole)) - 1
    scale = min(1.0, SIDE / (longest + 2 * reach))
    size = max(2, round(width * scale)), max(2, round(height * scale))
    share, total, open_ = (
        cv2.resize(a.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        for a in (known, image * known[..., None], hole)
    )
    picture, there = total / np.maximum(share, 1e-3)[..., None], share > 0.5
    unknown = (open_ > 0) & ~there
    away = cv2.distanceTransform((~unknown).astype(np.uint8), cv2.DIST_L2, 5)
    variance = np.where(unknown, np.float32(NO_GUESS), np.float32(0))
    if unknown.any() and there.any():
        begins = float(away[there].min()) - 1  # other things may stand all round the hole
        near = there & (away <= begins + max(LEAST_GIVEN, TELLING * thickness * scale))
        given = there & (away <= begins + max(LEAST_GIVEN, reach * scale))
        window = bounds(near | unknown)
        mean = _means(picture, unknown, given, near, edges, scale)
        parts = (a[window] for a in (picture - mean, unknown, given, near))
        deviations, variance[unknown] = _kriged(*parts)
        picture[unknown] = mean[unknown] + deviations
    colours, variance = (cv2.resize(a, (width, height), interpolation=cv2.INTER_LINEAR) for a in (picture, variance))
    return Expected(colours, np.where(known, 0, variance))


def _means(
    picture: np.ndarray, unknown: np.ndarray, given: np.ndarray, near: np.ndarray, edges: Sequence[Edge], scale: float
) -> np.ndarray:
    """[h, w, 3]: of what is near, on this side of the edges that cut the hole and what is given round it."""
    mean = np.broadcast_to(picture[near].mean(0, dtype=np.float64), picture.shape).copy()
    parts = (unknown | given).astype(np.uint8)
    for edge in edges:
        ends = ((edge.origin + t * edge.along + 0.5) * scale - 0.5 for t in edge.ends)
        first, last = (tuple(int(v) for v in np.rint(end)) for end in ends)
        cv2.line(parts, first, last, 0)
    count, labels = cv2.connectedComponents(parts, connectivity=4)
    if count > 2:
        _, nearest = cv2.distanceTransformWithLabels(1 - parts, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
        of = np.zeros(nearest.max() + 1, labels.dtype)
        of[nearest[parts > 0]] = labels[parts > 0]
        labels = of[nearest]
        for label in range(1, count):
            of_label = given & (labels == label)
            if of_label.any():
                mean[labels == label] = picture[of_label].mean(0, dtype=np.float64)
    return mean


def _kriged(
    picture: np.ndarray, unknown: np.ndarray, given: np.ndarray, near: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Means [N, 3] and variances [N] of the unknown pixels; the covariance is of what is near."""
    import scipy.linalg  # slow to import, and many removals fill no picture

    deviations = np.where(near[..., None], picture, 0)
    twice = 2 * near.shape[0], 2 * near.shape[1]  # so that nothing wraps round
    # divided by all pixels, not by the pairs at a lag, it is a covariance: no combination has a negative variance
    spectrum = (np.abs(np.fft.rfft2(deviations, twice, axes=(0, 1))) ** 2).sum(-1)
    covariance = np.fft.irfft2(spectrum, twice) / near.sum() / 3

    def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        lag = a[:, None] - b[None]
        return np.asarray(covariance[lag[..., 0], lag[..., 1]])

    places, wanted = np.argwhere(given), np.argwhere(unknown)
    own = float(covariance[0, 0])
    system = between(places, places) + NUGGET * max(own, ROUNDING) * np.eye(len(places))
    lower = scipy.linalg.cholesky(system, lower=True, overwrite_a=True)
    across = scipy.linalg.solve_triangular(lower, between(places, wanted), lower=True)
    values = scipy.linalg.solve_triangular(lower, picture[given], lower=True)
    found, variance = across.T @ values, np.maximum(own - (across**2).sum(0), 0)
    return ROUNDING * np.rint(found / ROUNDING), ROUNDING**2 * np.rint(variance / ROUNDING**2)


def foretell(picture: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray, Variogram]:
    """The rim's colours carried inwards [H, W, 3], the variance of the true ones about them [H, W], and the variogram.

    The picture is [H, W, 3] float32, `known` [H, W] bool. At a distance from the rim, the variance is the rim's own
    semivariance at that lag.
    """
    away = cv2.distanceTransform((~known).astype(np.uint8), cv2.DIST_L2, 5)
    depth = float(away.max())
    outwards = cv2.distanceTransform(known.astype(np.uint8), cv2.DIST_L2, 5)
    rim = known & (outwards <= max(LEAST_BAND, BAND * depth))
    lags = variogram(picture, rim, depth)
    variance = np.where(known, 0, np.interp(away, *lags)).astype(np.float32)
    return np.where(known[..., None], picture, carried(picture, rim)), variance, lags


def variogram(picture: np.ndarray, known: np.ndarray, reach: float) -> Variogram:
    """Of a picture's [H, W, C] known pixels [H, W] bool, to twice a reach in px; the semivariance never falls."""
    lags, found = [0.0], [0.0]
    (height, width), lag = known.shape, 1
    while lag < 2 * reach and lag < max(height, width):
        slant = max(1, round(lag / 2**0.5))
        total, count = 0.0, 0
        for down, right in ((0, lag), (lag, 0), (slant, slant), (slant, -slant)):
            if down >= height or abs(right) >= width:
                continue
            here = slice(0, height - down), slice(max(0, -right), width - max(0, right))
            there = slice(down, height), slice(max(0, right), width + min(0, right))
            both = known[here] & known[there]
            total += float(((picture[here][both] - picture[there][both]) ** 2).mean(-1).sum())
            count += int(both.sum())
        if count >= LEAST_PAIRS:
            lags.append(float(lag))
            found.append(max(found[-1], total / count / 2))
        lag *= 2
    return lags, found


def carried(picture: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The known colours, [H, W] bool, of a picture [H, W, 3] float32, and coarser means of them where there are none.

    Push-pull (Grossman 1998); float32.
    """
    weight = known.astype(np.float32)
    levels = [(picture * weight[..., None], weight)]
    while max(levels[-1][1].shape) > 1:
        half = [-(-side // 2) for side in levels[-1][1].shape[::-1]]
        levels.append(tuple(cv2.resize(a, half, interpolation=cv2.INTER_AREA) for a in levels[-1]))
    total, weight = levels.pop()
    colour = total / max(1e-9, float(weight[0, 0]))
    for total, weight in reversed(levels):
        coarse = cv2.resize(colour, weight.shape[::-1], interpolation=cv2.INTER_LINEAR)
        colour = total + (1 - weight[..., None]) * coarse
    return colour

"""What known colours let expect of unknown ones: a mean carried inwards, and how far the truth may lie from it."""

from __future__ import annotations

import cv2
import numpy as np

LEAST_BAND = 4.0  # px of rim that tell, at least
BAND = 0.5  # and of the unknown part's depth
LEAST_PAIRS = 100  # of pixels, that tell how colours vary at a distance


def foretell(
    picture: np.ndarray,  # [H, W, 3] float32
    known: np.ndarray,  # [H, W] bool
) -> tuple[np.ndarray, np.ndarray, list[tuple[float, float]]]:
    """The rim's colours carried inwards [H, W, 3], the variance of the true ones about them [H, W], and the variogram.

    The variance at a distance from the rim is the rim's own semivariance at that lag (kriging without its weights).
    """
    away = cv2.distanceTransform((~known).astype(np.uint8), cv2.DIST_L2, 5)
    depth = float(away.max())
    outwards = cv2.distanceTransform(known.astype(np.uint8), cv2.DIST_L2, 5)
    rim = known & (outwards <= max(LEAST_BAND, BAND * depth))
    lags = variogram(picture, rim, depth)
    variance = np.where(known, 0, at_lag(lags, away)).astype(np.float32)
    return np.where(known[..., None], picture, carried(picture, rim)), variance, lags


def variogram(
    picture: np.ndarray,  # [H, W, C]
    known: np.ndarray,  # [H, W] bool
    reach: float,  # px
) -> list[tuple[float, float]]:
    """(lag, half the mean squared difference of known pixels that far apart): lags of 1, 2, 4 … px, never falling."""
    found: list[tuple[float, float]] = [(0.0, 0.0)]
    height, width = known.shape
    lag = 1
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
            found.append((float(lag), max(found[-1][1], total / count / 2)))
        lag *= 2
    return found


def at_lag(lags: list[tuple[float, float]], distance: np.ndarray) -> np.ndarray:
    """The variogram between its lags and beyond."""
    return np.interp(distance, [lag for lag, _ in lags], [value for _, value in lags])


def carried(
    picture: np.ndarray,  # [H, W, 3] float32
    known: np.ndarray,  # [H, W] bool
) -> np.ndarray:
    """Known colours, and coarser means of them where there are none (push-pull: Grossman 1998); float32."""
    weight = known.astype(np.float32)
    levels = [(picture * weight[..., None], weight)]
    while max(levels[-1][1].shape) > 1:
        half = [-(-side // 2) for side in levels[-1][1].shape[::-1]]
        levels.append(tuple(cv2.resize(a, half, interpolation=cv2.INTER_AREA) for a in levels[-1]))
    total, weight = levels.pop()
    colour = total / max(1e-9, float(weight[0, 0]))
    for total, weight in reversed(levels):
        coarse = cv2.resize(colour, weight.shape[::-1], interpolation=cv2.INTER_LINEAR)
        own = weight[..., None]
        colour = total + (1 - own) * coarse
    return colour

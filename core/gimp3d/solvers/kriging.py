"""What a picture's own statistics let expect of a hole, given what is round it: smooth colours, and how sure they are.

The picture, made small, counts as a stationary Gaussian texture with the covariance that it has round the hole: that
knows stripes, grain and what repeats. Its mean in the hole, given the rim, is the best linear guess (simple kriging:
Matheron 1963; of textures: Galerne and Leclaire 2017).
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from ..geometry import bounds

SIDE = 64  # px: the hole and what is given round it are shrunk to this
GIVEN, TELLING = 0.3, 2.0  # of the hole's thickness: how far known pixels are given, and tell the covariance
LEAST_GIVEN = 4  # px
NUGGET = 0.02  # of the variance: what neighbours do not have in common
NO_GUESS = 1e3  # variance where nothing is known: far above that of any colours
ROUNDING = 2.0**-12  # of results: the solver's own hangs on the number of threads


class Expected(NamedTuple):
    """Smooth colours, of what is known and of what is expected in the hole."""

    colours: np.ndarray  # [H, W, 3] float32
    variance: np.ndarray  # [H, W] float32, mean over channels, of the truth about them; 0 where it is known

    def sized(self, shape: tuple[int, ...], patch: int) -> Expected:
        """At another size [h, w], and means of patches of so many px."""
        return Expected(
            *(cv2.blur(cv2.resize(a, shape[::-1], interpolation=cv2.INTER_AREA), (patch,) * 2) for a in self)
        )


def expect(
    image: np.ndarray,  # [H, W, 3], colours in [0, 1]
    hole: np.ndarray,  # [H, W] bool, some of it
    known: np.ndarray,  # [H, W] bool, some of it
) -> Expected:
    """The picture at the size that tells the hole's: detail finer than `SIDE` allows is left out."""
    height, width = hole.shape
    thickness = 2 * float(cv2.distanceTransform(hole.astype(np.uint8), cv2.DIST_L2, 5).max())
    reach = max(LEAST_GIVEN, GIVEN * thickness)
    rows, cols = np.nonzero(hole)
    longest = float(max(rows.max() - rows.min(), cols.max() - cols.min()))
    scale = min(1.0, SIDE / (longest + 2 * reach))
    size = max(2, round(width * scale)), max(2, round(height * scale))

    def small(a: np.ndarray) -> np.ndarray:
        return cv2.resize(a.astype(np.float32), size, interpolation=cv2.INTER_AREA)

    share = small(known)
    picture = small(image * known[..., None]) / np.maximum(share, 1e-3)[..., None]
    there, unknown = share > 0.5, (small(hole) > 0) & (share <= 0.5)
    away = cv2.distanceTransform((~unknown).astype(np.uint8), cv2.DIST_L2, 5)
    variance = np.where(unknown, np.float32(NO_GUESS), np.float32(0))
    if unknown.any() and there.any():
        begins = float(away[there].min()) - 1  # other things may stand all round the hole
        near = there & (away <= begins + max(LEAST_GIVEN, TELLING * thickness * scale))
        given = there & (away <= begins + max(LEAST_GIVEN, reach * scale))
        window = bounds(near | unknown)
        picture[unknown], variance[unknown] = _kriged(*(a[window] for a in (picture, unknown, given, near)))

    def large(a: np.ndarray) -> np.ndarray:
        return cv2.resize(a, (width, height), interpolation=cv2.INTER_LINEAR)

    return Expected(large(picture), np.where(known, 0, large(variance)))


def _kriged(
    picture: np.ndarray, unknown: np.ndarray, given: np.ndarray, near: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Means [N, 3] and variances [N] of the unknown pixels; the covariance is of what is near."""
    import scipy.linalg  # slow to import, and many removals fill no picture

    mean = picture[near].mean(0, dtype=np.float64)
    deviations = np.where(near[..., None], picture - mean, 0)
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
    values = scipy.linalg.solve_triangular(lower, picture[given] - mean, lower=True)
    found, variance = mean + across.T @ values, np.maximum(own - (across**2).sum(0), 0)
    return ROUNDING * np.rint(found / ROUNDING), ROUNDING**2 * np.rint(variance / ROUNDING**2)

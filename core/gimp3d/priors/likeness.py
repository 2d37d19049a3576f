"""Whether a picture shows a view, and how it is brought to the view's place and exposure."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..solvers.robust import CUT, ROUNDS

WIDTH = 240  # px to which pictures are reduced before their details are compared
DETAILS = (1.0, 4.0)  # px there: σ of the blurs whose difference are details; coarser ones any two photos share
STRONG = 3.0  # robust standard deviations at which details are cut off: a few changed objects do not decide
MAX_SHIFT = 0.02  # of the picture's width; a picture that is off by more is not an edited copy of the view
ELSEWHERE = 3  # times MAX_SHIFT, from which on a place is another one
OVERLAP = 0.5  # share of the details that must be compared at another place
HALO = 4  # px round a hole in which a picture is not compared with the view
REACH = 24  # px, least width of the ring by which a picture is levelled; as exposure.LEAST_REACH
BLOCK = 12  # px; blocks of the ring of which each has one gain
LEAST_BLOCKS = 6
LEAST_FILLED = 0.25  # of a block
LEAST_AGREEING = 0.25  # of the ring's blocks
LEAST_SCATTER = 0.003  # of the blocks' logarithms: rounding to whole grey levels
NORMAL_HALF = 1.349  # σ that hold half of normal values
DARK, BRIGHT = 16.0, 250.0  # grey levels between which a camera is linear enough
MAX_GAIN = 2.0
SAME_GAIN = 0.01  # two grey levels of white: less is no difference in exposure


@dataclass(frozen=True)
class Likeness:
    """How a picture's details agree with a view's."""

    agreement: float  # their correlation, at the best place within MAX_SHIFT
    chance: float  # standard deviation of what they reach at other places


def likeness(
    image: np.ndarray,  # [H, W, 3] uint8, the view, as a photo or as splats draw it
    picture: np.ndarray,  # [H, W, 3] uint8
    known: np.ndarray,  # [H, W] bool, where the view is right
) -> Likeness:
    """Correlate the details of a view and of a picture at their place and, to know what chance does, at all others.

    Levels do not matter, nor do noise, blur and haze as long as edges lie where they should: a picture of something
    else agrees at its place no better than at others, however rough the view is drawn.
    """
    h, w = known.shape
    scale = min(1.0, WIDTH / w)
    size = (round(w * scale), max(1, round(h * scale)))
    reduced = [cv2.resize(_grey(p), size, interpolation=cv2.INTER_AREA) for p in (image, picture)]
    share = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    inside = cv2.erode((share > 0.99).astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=1) > 0
    everywhere = np.ones(inside.shape, bool)
    details = [_details(p, where) for p, where in zip(reduced, (inside, everywhere))]
    found = _correlations(details[0], details[1], inside)
    rows, cols = inside.shape
    reach = max(1, int(np.ceil(MAX_SHIFT * cols)))
    agreement = float(np.nanmax(found[rows - reach : rows + reach + 1, cols - reach : cols + reach + 1]))
    far = ELSEWHERE * reach
    found[max(0, rows - far) : rows + far + 1, max(0, cols - far) : cols + far + 1] = np.nan
    elsewhere = found[np.isfinite(found)]
    return Likeness(agreement, float(np.sqrt(np.mean(elsewhere**2))) if len(elsewhere) else 0.0)


def _details(grey: np.ndarray, where: np.ndarray) -> np.ndarray:
    """[H, W] float64: what lies between two scales, in robust standard deviations."""
    fine, coarse = (cv2.GaussianBlur(grey, (0, 0), s) for s in DETAILS)
    details = (fine - coarse).astype(np.float64)
    spread = 1.4826 * float(np.median(np.abs(details[where]))) if where.any() else 0.0
    return np.clip(details / max(spread, 0.1), -STRONG, STRONG)


def _correlations(a: np.ndarray, b: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """[2H, 2W] correlation of `a`, where inside, with `b` moved by (row − H, column − W); NaN where too few overlap.

    Masked normalised cross-correlation by Fourier transforms (Padfield 2012).
    """
    shape = (2 * a.shape[0], 2 * a.shape[1])
    mask = inside.astype(np.float64)
    moved = [np.fft.rfft2(x, shape) for x in (np.ones(a.shape), b, b * b)]
    still = [np.conj(np.fft.rfft2(x, shape)) for x in (mask, mask * a, mask * a * a)]

    def sums(k: int, j: int) -> np.ndarray:
        return np.fft.fftshift(np.fft.irfft2(still[k] * moved[j], shape))

    count = np.maximum(np.rint(sums(0, 0)), 1)
    mean_a, mean_b = sums(1, 0) / count, sums(0, 1) / count
    varied = np.maximum(sums(2, 0) / count - mean_a**2, 1e-9) * np.maximum(sums(0, 2) / count - mean_b**2, 1e-9)
    found = (sums(1, 1) / count - mean_a * mean_b) / np.sqrt(varied)
    return np.where(count >= max(1.0, OVERLAP * mask.sum()), found, np.nan)


def shift_between(image: np.ndarray, picture: np.ndarray, known: np.ndarray) -> tuple[float, float]:
    """(x, y) px where the view's origin lies in the picture, from coarse to fine; 0 if it cannot be told.

    Found by the details (Evangelidis 2008): a haze over the luminances pulls them by pixels.
    """
    h, w = known.shape
    warp = np.eye(2, 3, dtype=np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-4)
    for factor in (4, 2, 1):
        if min(h, w) < 32 * factor:
            continue
        size = (w // factor, h // factor)
        reduced = (cv2.resize(_grey(p), size, interpolation=cv2.INTER_AREA) for p in (image, picture))
        mask = cv2.resize(known.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        view, other = (_details(p, mask > 0).astype(np.float32) for p in reduced)
        warp[:, 2] /= factor
        try:
            warp = cv2.findTransformECC(view, other, warp, cv2.MOTION_TRANSLATION, criteria, mask, 5)[1]
        except cv2.error:  # no texture, or nothing alike
            return 0.0, 0.0
        warp[:, 2] *= factor
    if np.abs(warp[:, 2]).max() > MAX_SHIFT * w:
        return 0.0, 0.0
    return float(warp[0, 2]), float(warp[1, 2])


def ring_gain(
    image: np.ndarray,  # [H, W, 3] uint8, the view
    picture: np.ndarray,  # [H, W, 3] uint8
    hole: np.ndarray,  # [H, W] bool
    known: np.ndarray,  # [H, W] bool
) -> np.ndarray:
    """[3] factors that bring a picture to the view's exposure and white balance round the hole; 1 where it has them.

    Blocks of 12 px have a ratio per channel. All of the view tell what its exposure is about, and by how much blocks
    scatter; those of the ring that agree with that tell it there. A shadow on a part of the ring, which only the view
    shows, is no exposure; if hardly a block of the ring agrees, its own do. With an offset as well, or measured on the
    whole view alone, it fits parts of the ring that are held out worse on real scenes.
    """
    distance = cv2.distanceTransform((~hole).astype(np.uint8), cv2.DIST_L2, 5)
    ring = known & (distance > HALO) & (distance <= max(REACH, 0.5 * np.sqrt(hole.sum())))
    logarithms, differs = np.zeros(3), False
    for channel in range(3):
        about, near = (_ratios(image[..., channel], picture[..., channel], where) for where in (known, ring))
        if len(about) < LEAST_BLOCKS:
            continue
        middle, sigma = _densest(about)
        middle, counted = _biweight(about, middle, sigma)
        if len(near) >= LEAST_BLOCKS:
            middle, counted = _biweight(near, middle, sigma)
            if counted < LEAST_AGREEING * len(near):  # round the hole the view is in another light altogether
                middle, sigma = _densest(near)
                middle, counted = _biweight(near, middle, sigma)
        logarithms[channel] = middle
        differs |= abs(middle) > max(SAME_GAIN, 3 * sigma / np.sqrt(counted))
    limit = np.log(MAX_GAIN)
    return np.exp(np.clip(logarithms, -limit, limit)) if differs else np.ones(3)


def _ratios(
    image: np.ndarray,  # [H, W] one channel
    picture: np.ndarray,  # [H, W]
    where: np.ndarray,  # [H, W] bool
) -> np.ndarray:
    """Logarithms of the ratio of the two means in each well exposed block, in ascending order.

    Means of a block differ neither by noise nor by blur, which select among its dark and bright pixels.
    """
    y, x = np.nonzero(where)
    blocks = y // BLOCK * (where.shape[1] // BLOCK + 1) + x // BLOCK
    a, b = image[where].astype(np.float64), picture[where].astype(np.float64)
    fits = (a < BRIGHT) & (b < BRIGHT)
    count, sum_a, sum_b = (np.bincount(blocks, fits * v) for v in (np.ones(len(a)), a, b))
    taken = (count >= LEAST_FILLED * BLOCK**2) & (np.minimum(sum_a, sum_b) > DARK * count)
    return np.sort(np.log(sum_a[taken] / sum_b[taken]))


def _densest(values: np.ndarray) -> tuple[float, float]:
    """(middle, σ) of the half of ascending values that lie closest together (Rousseeuw's shorth)."""
    half = (len(values) + 1) // 2
    widths = values[half - 1 :] - values[: len(values) - half + 1]
    first = int(np.argmin(widths))
    return float(values[first : first + half].mean()), max(float(widths[first]) / NORMAL_HALF, LEAST_SCATTER)


def _biweight(values: np.ndarray, middle: float, sigma: float) -> tuple[float, float]:
    """Tukey's location of values near a first guess, and how many count; the guess if none does."""
    weight: np.ndarray = np.zeros(len(values))
    for _ in range(ROUNDS):
        weight = np.maximum(1 - ((values - middle) / (CUT * sigma)) ** 2, 0) ** 2
        if not weight.any():
            break
        middle = float((weight * values).sum() / weight.sum())
    return middle, float(weight.sum())


def _grey(picture: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)

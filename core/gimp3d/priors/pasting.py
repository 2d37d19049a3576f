"""Pictures from outside: whether they show the view, brought to its place and exposure, and pasted into the hole."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..errors import BadInput
from ..geometry import bounds, dilated
from ..solvers.patchmatch import nearest_allowed
from ..solvers.robust import CUT, ROUNDS

LEAST_SURROUNDINGS = 32  # px, at least, round the hole's bounding box that textures are taken from
LEAST_COMPARED = 0.02  # share of the view that must be known outside the hole to judge a picture by
GROSS = 64.0  # grey levels; larger differences count as this much, so that a few changed objects do not decide
CLEARLY = 0.9  # a shift is kept if it lowers the residual to this share, and by MARGIN
MARGIN = 0.25  # grey levels
SURE_SHIFT = 1.0  # px, from which it need not lower it so much: photos are found 0.75 px off at most in poor drawings
# A picture is of another view if its details agree by less than FOREIGN with the view's and by no more than so many
# times what chance gives, and its colours differ. On ten scenes, true photos against drawings of poor splats (exposure
# ±30 %, colour cast, noise, JPEG, 5 px off, half the size) agree by 0.53 and more, by 0.41 if the drawing is blurred or
# hazed beyond use; photos less than 14° aside by at most 0.46, others of the scene by 0.31, of other scenes by 0.15.
FOREIGN, FOREIGN_CHANCE = 0.3, 8.0
DOUBTFUL = 0.6  # agreement below which the user is told
SAME_COLOURS = 4.0  # grey levels of mean difference up to which a picture is the view, whatever its details
CONFIDENCE_SCALE = 20.0  # grey levels of residual at which the confidence has fallen to 1/e
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
class Appearance:
    """The reference without the object."""

    image: np.ndarray  # [H, W, 3] uint8; outside the hole it is the input, bit for bit
    confidence: float
    reason: str
    warnings: tuple[str, ...] = ()


def window_round_hole(hole: np.ndarray) -> tuple[slice, slice]:
    """The hole's bounding box, larger by its own size on every side."""
    spans = bounds(hole)
    margins = [max(LEAST_SURROUNDINGS, s.stop - s.start) for s in spans]
    rows, cols = (slice(max(0, s.start - m), s.stop + m) for s, m in zip(spans, margins))
    return rows, cols


def interpolated(image: np.ndarray, hole: np.ndarray, method: int = cv2.INPAINT_TELEA) -> np.ndarray:
    """By cv2.inpaint, which looks at a few pixels of the hole at the image's border: they hold the nearest colour."""
    return cv2.inpaint(image[nearest_allowed(~hole)], hole.astype(np.uint8), 3, method)


def paste_picture(
    image: np.ndarray,  # [H, W, 3] uint8, the view
    hole: np.ndarray,  # [H, W] bool
    picture: np.ndarray,  # [H', W', 3] uint8, the view without the object
    name: str = "the picture",
    known: np.ndarray | None = None,  # [H, W] bool, where the view shows what it will without the object; None: outside
) -> Appearance:
    """A given picture, registered to the view (size, shift, levels) and pasted inside the hole only.

    It takes the exposure and white balance of the view round the hole. Shift and levels are applied only if they
    clearly differ: a picture that matches is pasted bit for bit. One that agrees poorly is pasted with a warning.
    Raises BadInput if it has another shape or shows something else.
    """
    picture = resized(picture, hole.shape, name)
    outside = ~dilated(hole, HALO)
    if known is not None and (outside & known).mean() >= LEAST_COMPARED:
        outside &= known
    if outside.mean() < LEAST_COMPARED:
        pasted = np.where(hole[..., None], picture, image)
        return Appearance(pasted, 0.5, "picture pasted; too little of the view is left to check it by")
    agreement, chance = likeness(image, picture, outside)
    picture, words = _registered(image, picture, hole, outside)
    residual = _difference(image, picture, outside)
    compared = (
        f"outside the hole it agrees by {agreement:.2f} with what is known of the view (1 = the same details, "
        f"{2 * chance:.2f} = chance) and differs by {residual:.0f} grey levels on average"
    )
    differs = residual > SAME_COLOURS
    if differs and agreement < FOREIGN and agreement <= FOREIGN_CHANCE * chance:
        raise BadInput(f"{name} does not match the view: {compared}; give a picture of the reference view itself")
    warnings = (f"{name} matches the view poorly: {compared}",) if differs and agreement < DOUBTFUL else ()
    words = f"picture pasted {words}, agreement {agreement:.2f}, residual {residual:.1f} grey levels"
    confidence = max(0.0, agreement) * float(np.exp(-residual / CONFIDENCE_SCALE)) if differs else 1.0
    return Appearance(np.where(hole[..., None], picture, image), confidence, words, warnings)


def resized(picture: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    """The picture in a size (height, width) of about its own shape."""
    (h, w), (height, width) = shape, picture.shape[:2]
    if abs(width * h - height * w) > 1.5 * max(width, height, w, h):  # sizes are rounded to whole pixels
        raise BadInput(f"{name} has {width}×{height} pixels, which is not the shape of the view ({w}×{h})")
    return scaled(picture, w, h)


def scaled(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    """The picture in another size, whatever its shape; in its own, bit for bit."""
    smaller = width * height < picture.shape[0] * picture.shape[1]
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC)


def _registered(image: np.ndarray, picture: np.ndarray, hole: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, str]:
    """The picture at the view's levels, shifted if that clearly fits better, and what was done."""
    dx, dy = shift_between(image, picture, known)
    h, w = known.shape
    matrix, way = np.array([[1, 0, dx], [0, 1, dy]]), cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    moved = cv2.warpAffine(picture, matrix, (w, h), flags=way, borderMode=cv2.BORDER_REPLICATE)
    gains = [ring_gain(image, p, hole, known) for p in (picture, moved)]
    levelled = [np.clip(np.rint(p * g), 0, 255).astype(np.uint8) for p, g in zip((picture, moved), gains)]
    residuals = [_difference(image, p, known) for p in levelled]
    clearly = residuals[1] < CLEARLY * residuals[0] - MARGIN
    shifted = int(clearly or (np.hypot(dx, dy) > SURE_SHIFT and residuals[1] < residuals[0]))
    words = [f"shifted by ({-dx:.1f}, {-dy:.1f}) px"] if shifted else []
    if (gains[shifted] != 1).any():
        words.append("with gain " + ", ".join(f"{g:.2f}" for g in gains[shifted]))
    return levelled[shifted], " ".join(words) or "as it is"


def _difference(image: np.ndarray, picture: np.ndarray, where: np.ndarray) -> float:
    """Mean absolute difference in grey levels; gross ones are cut off."""
    difference = np.abs(image[where].astype(np.float32) - picture[where]).mean(-1)
    return float(np.minimum(difference, GROSS).mean())


def likeness(
    image: np.ndarray,  # [H, W, 3] uint8, the view, as a photo or as splats draw it
    picture: np.ndarray,  # [H, W, 3] uint8
    known: np.ndarray,  # [H, W] bool, where the view is right
) -> tuple[float, float]:
    """(agreement, chance): the correlation of a view's and a picture's details at the best place within MAX_SHIFT, and
    the standard deviation of what they reach at other places.

    Levels do not matter, nor do noise, blur and haze as long as edges lie where they should: a picture of something
    else agrees at its place no better than at others, however rough the view is drawn.
    """
    h, w = known.shape
    scale = min(1.0, WIDTH / w)
    size = (round(w * scale), max(1, round(h * scale)))
    share = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    inside = cv2.erode((share > 0.99).astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=1) > 0
    found = _correlations(_details(image, size, inside), _details(picture, size, np.ones_like(inside)), inside)
    rows, cols = inside.shape
    reach = max(1, int(np.ceil(MAX_SHIFT * cols)))
    agreement = float(np.nanmax(found[rows - reach : rows + reach + 1, cols - reach : cols + reach + 1]))
    far = ELSEWHERE * reach
    found[max(0, rows - far) : rows + far + 1, max(0, cols - far) : cols + far + 1] = np.nan
    elsewhere = found[np.isfinite(found)]
    return agreement, float(np.sqrt(np.mean(elsewhere**2))) if len(elsewhere) else 0.0


def _details(picture: np.ndarray, size: tuple[int, int], where: np.ndarray) -> np.ndarray:
    """[H, W] float64 of a picture in that size: what lies between two scales, in robust standard deviations."""
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)
    grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
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
    for factor in (f for f in (4, 2, 1) if min(h, w) >= 32 * f):
        size = (w // factor, h // factor)
        mask = cv2.resize(known.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        view, other = (_details(p, size, mask > 0).astype(np.float32) for p in (image, picture))
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
        middle, sigma, counted = _biweight(about, *_densest(about))
        if len(near) >= LEAST_BLOCKS:
            middle, sigma, counted = _biweight(near, middle, sigma)
            if counted < LEAST_AGREEING * len(near):  # round the hole the view is in another light altogether
                middle, sigma, counted = _biweight(near, *_densest(near))
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


def _biweight(values: np.ndarray, middle: float, sigma: float) -> tuple[float, float, float]:
    """(Tukey's location of values near a first guess, σ, how many count); the guess if none does."""
    weight: np.ndarray = np.zeros(len(values))
    for _ in range(ROUNDS):
        weight = np.maximum(1 - ((values - middle) / (CUT * sigma)) ** 2, 0) ** 2
        if not weight.any():
            break
        middle = float((weight * values).sum() / weight.sum())
    return middle, sigma, float(weight.sum())

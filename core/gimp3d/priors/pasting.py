"""Pictures from outside: registered to the view, checked, and pasted into the hole."""

from __future__ import annotations

import cv2
import numpy as np

from ..errors import BadInput
from .appearance import Appearance
from .likeness import HALO, likeness, ring_gain, shift_between

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

    Raises
    ------
    BadInput
        If it has another shape or shows something else.
    """
    picture = resized(picture, hole.shape, name)
    size = 2 * HALO + 1
    outside = cv2.dilate(hole.astype(np.uint8), np.ones((size, size), np.uint8)) == 0
    if known is not None and (outside & known).mean() >= LEAST_COMPARED:
        outside &= known
    if outside.mean() < LEAST_COMPARED:
        pasted = np.where(hole[..., None], picture, image)
        return Appearance(pasted, 0.5, "picture pasted; too little of the view is left to check it by")
    like = likeness(image, picture, outside)
    picture, words = _registered(image, picture, hole, outside)
    residual = _difference(image, picture, outside)
    compared = (
        f"outside the hole it agrees by {like.agreement:.2f} with what is known of the view (1 = the same details, "
        f"{2 * like.chance:.2f} = chance) and differs by {residual:.0f} grey levels on average"
    )
    differs = residual > SAME_COLOURS
    if differs and like.agreement < FOREIGN and like.agreement <= FOREIGN_CHANCE * like.chance:
        raise BadInput(f"{name} does not match the view: {compared}; give a picture of the reference view itself")
    warnings = (f"{name} matches the view poorly: {compared}",) if differs and like.agreement < DOUBTFUL else ()
    words = f"picture pasted {words}, agreement {like.agreement:.2f}, residual {residual:.1f} grey levels"
    confidence = max(0.0, like.agreement) * float(np.exp(-residual / CONFIDENCE_SCALE)) if differs else 1.0
    return Appearance(np.where(hole[..., None], picture, image), confidence, words, warnings)


def resized(picture: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    """The picture in a size (height, width) of about its own shape."""
    h, w = shape
    height, width = picture.shape[:2]
    if abs(width * h - height * w) > 1.5 * max(width, height, w, h):  # sizes are rounded to whole pixels
        raise BadInput(f"{name} has {width}×{height} pixels, which is not the shape of the view ({w}×{h})")
    if (height, width) == (h, w):
        return picture
    return scaled(picture, w, h)


def scaled(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    """The picture in another size, whatever its shape."""
    smaller = width * height < picture.shape[0] * picture.shape[1]
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC)


def _registered(image: np.ndarray, picture: np.ndarray, hole: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, str]:
    """The picture at the view's levels, shifted if that clearly fits better, and what was done."""
    dx, dy = shift_between(image, picture, known)
    h, w = known.shape
    moved = cv2.warpAffine(
        picture,
        np.array([[1, 0, dx], [0, 1, dy]]),
        (w, h),
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    gains = [ring_gain(image, p, hole, known) for p in (picture, moved)]
    levelled = [_times(p, g) for p, g in zip((picture, moved), gains)]
    residuals = [_difference(image, p, known) for p in levelled]
    clearly = residuals[1] < CLEARLY * residuals[0] - MARGIN
    shifted = int(clearly or (np.hypot(dx, dy) > SURE_SHIFT and residuals[1] < residuals[0]))
    words = [f"shifted by ({-dx:.1f}, {-dy:.1f}) px"] if shifted else []
    if (gains[shifted] != 1).any():
        words.append("with gain " + ", ".join(f"{g:.2f}" for g in gains[shifted]))
    return levelled[shifted], " ".join(words) or "as it is"


def _times(picture: np.ndarray, gain: np.ndarray) -> np.ndarray:
    return picture if (gain == 1).all() else np.clip(np.rint(picture * gain), 0, 255).astype(np.uint8)


def _difference(image: np.ndarray, picture: np.ndarray, where: np.ndarray) -> float:
    """Mean absolute difference in grey levels; gross ones are cut off."""
    difference = np.abs(image[where].astype(np.float32) - picture[where]).mean(-1)
    return float(np.minimum(difference, GROSS).mean())

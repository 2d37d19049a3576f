"""Brings photos to the exposure of the splats, so that new Gaussians match those round the hole."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..geometry import SOLID
from ..solvers.colours import exposure_gain
from .masks import ViewMasks

LEAST_REACH = 24  # px round what the object touched that are compared, at least
CLEARLY = 0.9  # a gain is applied if it lowers the difference to this share, and by MARGIN
MARGIN = 0.25  # grey levels
GROSS = 48.0  # grey levels; larger differences count as this much
MAX_GAIN = 3.0  # what is beyond is no exposure


@dataclass(frozen=True)
class Exposure:
    """A photo at the splats' exposure."""

    image: np.ndarray  # [H, W, 3] uint8; the photo itself if its gain is 1
    gain: np.ndarray  # [3], the photo's exposure over the splats'

    def back(
        self,
        picture: np.ndarray,  # [H, W, 3] uint8 at the splats' exposure
        photo: np.ndarray,  # [H, W, 3] uint8
        changed: np.ndarray,  # [H, W] bool
    ) -> np.ndarray:
        """The photo with the picture, at the photo's exposure, where it was changed."""
        return np.where(changed[..., None], _times(picture, self.gain), photo)


def exposure_ring(view: ViewMasks) -> np.ndarray:
    """[H, W] bool: the pixels round the object that a photo and the splats are compared in."""
    silhouette = view.silhouette
    if not silhouette.any():
        return silhouette
    distance = cv2.distanceTransform((~silhouette).astype(np.uint8), cv2.DIST_L2, 5)
    reach = max(LEAST_REACH, 0.5 * float(np.sqrt(silhouette.sum())))
    return (distance > 0) & (distance <= reach) & (view.alpha_after > SOLID) & ~view.target


def level_exposure(
    ring: np.ndarray,  # [H, W] bool, see exposure_ring
    photo: np.ndarray,  # [H, W, 3] uint8
    drawn: np.ndarray,  # [H, W, 3] uint8, the splats without the object; only the ring is looked at
) -> Exposure:
    """Divide a photo by its gain over the splats, measured round the object, if that clearly fits better."""
    unchanged = Exposure(photo, np.ones(3))
    gain = exposure_gain(drawn[ring], photo[ring])
    if (gain > MAX_GAIN).any() or (gain < 1 / MAX_GAIN).any():
        return unchanged
    level = _times(photo[ring], 1 / gain)
    if _difference(level, drawn[ring]) < CLEARLY * _difference(photo[ring], drawn[ring]) - MARGIN:
        return Exposure(_times(photo, 1 / gain), gain)
    return unchanged


def _difference(a: np.ndarray, b: np.ndarray) -> float:
    """Mean absolute difference [N, 3] in grey levels; 0 of nothing."""
    if len(a) == 0:
        return 0.0
    return float(np.minimum(np.abs(a.astype(np.float32) - b), GROSS).mean())


def _times(picture: np.ndarray, gain: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(picture * gain), 0, 255).astype(np.uint8)

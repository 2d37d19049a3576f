"""Brings photos to the exposure of the splats, so that new Gaussians match those round the hole."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ..compute.threads import parallel_map
from ..gaussians import Gaussians
from ..geometry import SOLID
from ..raster import render_bytes
from ..solvers.robust import exposure_gain
from .masks import ViewMasks

LEAST_REACH = 24  # px round what the object touched that are compared, at least
CLEARLY = 0.9  # a gain is applied if it lowers the difference to this share, and by MARGIN
MARGIN = 0.25  # grey levels
GROSS = 48.0  # grey levels; larger differences count as this much
MAX_GAIN = 3.0  # what is beyond is no exposure


@dataclass(frozen=True)
class Exposure:
    """A photo's exposure over the splats'."""

    gain: np.ndarray  # [3]; 1 where no gain clearly fits better

    def level(self, photo: np.ndarray) -> np.ndarray:
        """A photo [H, W, 3] uint8 at the splats' exposure; the photo itself if its gain is 1."""
        return photo if (self.gain == 1).all() else _times(photo, 1 / self.gain)

    def back(self, picture: np.ndarray, photo: np.ndarray, changed: np.ndarray) -> np.ndarray:
        """The photo with the picture at its exposure, both [H, W, 3] uint8, where that was changed [H, W] bool."""
        return np.where(changed[..., None], _times(picture, self.gain), photo)


def exposures_of(kept: Gaussians, views: Sequence[ViewMasks], photos: Mapping[str, np.ndarray]) -> tuple[Exposure, ...]:
    """Compare photos (by ID, [H, W, 3] uint8) with the splats round the object; `kept` is the scene without it."""

    def compare(view: ViewMasks) -> Exposure:
        ring = exposure_ring(view)
        return level_exposure(ring, photos[view.camera.id], render_bytes(kept, view.camera, pixels=ring))

    return tuple(parallel_map(compare, views))


def levelled(found: Sequence[Exposure]) -> tuple[float, str]:
    """The words of the stage that compares."""
    count = sum(bool((e.gain != 1).any()) for e in found)
    return 1.0, f"{count} of {len(found)} photos are brought to the splats' exposure"


def exposure_ring(view: ViewMasks) -> np.ndarray:
    """[H, W] bool: the pixels round the object that a photo and the splats are compared in."""
    silhouette = view.silhouette
    distance = cv2.distanceTransform((~silhouette).astype(np.uint8), cv2.DIST_L2, 5)
    reach = max(LEAST_REACH, 0.5 * float(np.sqrt(silhouette.sum())))
    return (distance > 0) & (distance <= reach) & (view.alpha_after > SOLID) & ~view.target


def level_exposure(ring: np.ndarray, photo: np.ndarray, drawn: np.ndarray) -> Exposure:
    """A photo's [H, W, 3] gain over the splats, as `drawn`, in a ring (see above), if that clearly fits better."""
    gain, unchanged = exposure_gain(drawn[ring], photo[ring]), Exposure(np.ones(3))
    if (gain == 1).all() or (gain > MAX_GAIN).any() or (gain < 1 / MAX_GAIN).any():
        return unchanged

    def off(colours: np.ndarray) -> float:
        return float(np.minimum(np.abs(colours.astype(np.float32) - drawn[ring]), GROSS).mean())

    clearly = off(_times(photo[ring], 1 / gain)) < CLEARLY * off(photo[ring]) - MARGIN
    return Exposure(gain) if clearly else unchanged


def _times(picture: np.ndarray, gain: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(picture * gain), 0, 255).astype(np.uint8)

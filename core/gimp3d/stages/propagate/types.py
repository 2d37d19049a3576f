"""What goes into the propagation, and what comes out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

import numpy as np

from ...camera import Camera


class Rule(IntEnum):
    """How a pixel of T_t got its colour."""

    UNTOUCHED = 0
    EVIDENCE = 1  # the photo shows the new surface itself here: T reaches beyond the object
    OWN_PIXELS = 2  # by the view's own: fitted to those round the hole, or (paper) those at the mapped source
    REFERENCE = 3  # the warped reference colour (paper: where nothing shows the mapped source)
    UNREACHED = 4  # the reference does not see this surface
    RETARGETED = 5  # by the view's own pixels near the mapped source, which is itself hidden or off-screen
    OTHER_VIEW = 6  # the mapped source as another view shows it
    REFINED = 7  # by whoever --refine-views asked; the last one, as it comes after the propagation


@dataclass(frozen=True)
class PropagateSettings:
    """How a view is painted: by default what was measured to be best, else as in the paper."""

    # warp: the reference's colours; sample: the colours of this view's mapped sources (paper)
    transfer: Literal["warp", "sample"] = "warp"  # way; the reference's texture against the view's light
    # band: fitted to the photo round the hole; rim: to the rim's pixels alone (paper)
    blend: Literal["band", "rim"] = "band"  # way; an even level against no seam at any pixel of the rim
    retarget: int = 32  # px searched round a source that is not to be seen (sample only); time against more own pixels
    donors: int = 8  # views that lend samples of sources a view does not show (sample only); time against holes


@dataclass(frozen=True)
class Reference:
    """The completed reference view."""

    camera: Camera
    image: np.ndarray  # [H, W, 3] uint8, inpainted
    depth: np.ndarray  # [H, W] float32, completed
    target: np.ndarray  # [H, W] bool, T_0
    source: np.ndarray  # [H, W] bool, pixels that show a photo's unhidden surface


@dataclass(frozen=True)
class ViewToPaint:
    """A view before its hole is painted."""

    camera: Camera
    image: np.ndarray  # [H, W, 3] uint8, the photo (or rendering) with the object
    base: np.ndarray  # [H, W, 3] uint8, without the object: the photo round it, the emptied scene where it was
    silhouette: np.ndarray  # [H, W] bool, touched by the object
    target: np.ndarray  # [H, W] bool, T_t
    depth_before: np.ndarray  # [H, W] z with the object
    depth_new: np.ndarray  # [H, W] z of the scene with the new surface; used within `near_hole`


Loader = Callable[[], ViewToPaint]  # brings a view into memory; it is let go again once it is painted


@dataclass(frozen=True)
class PaintedView:
    """The part of a view round its painted hole."""

    camera_id: str
    top: int  # row and column of the view where the part begins
    left: int
    image: np.ndarray  # [h, w, 3] uint8, I_t*
    raw: np.ndarray  # [h, w, 3] uint8, before Poisson blending
    rules: np.ndarray  # [h, w] uint8, see Rule
    depth: np.ndarray  # [h, w] z of the scene with the new surface

    def pasted(self, picture: np.ndarray, part: np.ndarray | None = None) -> np.ndarray:
        """The picture [H, W, 3] uint8, this part's hole pasted in: from `part` [h, w, 3], by default `image`."""
        whole = picture.copy()
        h, w = self.rules.shape
        place = whole[self.top : self.top + h, self.left : self.left + w]
        there = self.rules != Rule.UNTOUCHED
        place[there] = (self.image if part is None else part)[there]
        return whole

    def rule_map(self, height: int, width: int) -> np.ndarray:
        """The rules in the whole view, [height, width] uint8."""
        whole = np.zeros((height, width), np.uint8)
        h, w = self.rules.shape
        whole[self.top : self.top + h, self.left : self.left + w] = self.rules
        return whole


@dataclass(frozen=True)
class Propagation:
    """Every view painted, in the order given."""

    views: tuple[PaintedView, ...]
    confidence: float
    reason: str

"""One view on its way through a removal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .camera import Camera
from .stages.charts import Hits
from .stages.exposure import Exposure
from .stages.masks import ViewMasks
from .stages.propagate import Reference


@dataclass(frozen=True)
class ViewState:
    """What is known of a view; pictures are [H, W] of its camera."""

    masks: ViewMasks  # what the object touched, and where the view has to be filled
    photo: np.ndarray  # [H, W, 3] uint8, with the object, as it came
    exposure: Exposure  # of the photo over the splats'
    bare: np.ndarray  # [H, W, 3] uint8, the photo at the splats' exposure, the object's shadow and reflection undone
    painted: np.ndarray  # [H, W, 3] uint8, the same without the object, as far as that is known
    left: ViewMasks  # the masks as they are now: T shrinks with every reference
    hits: Hits | None = None  # where its rays meet charts; None without them
    rules: np.ndarray | None = None  # [H, W] Rule that gave each pixel its last colour; None: nothing was painted yet
    best: tuple[int, Reference] | None = None  # the reference that painted most of it, and how many pixels it did

    @classmethod
    def first(cls, masks: ViewMasks, photo: np.ndarray, exposure: Exposure) -> ViewState:
        """A view of which nothing is known but its photo and what has to be filled of it."""
        level = exposure.level(photo)
        return cls(masks, photo, exposure, level, level, masks)

    @property
    def camera(self) -> Camera:
        return self.masks.camera

    @property
    def id(self) -> str:
        return self.masks.camera.id


def open_pixels(views: Sequence[ViewState]) -> int:
    """What is still to be filled, in all views."""
    return sum(int(v.left.target.sum()) for v in views)

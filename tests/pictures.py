"""Small pictures and holes that the tests of providers share."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from gimp3d.errors import BadInput
from gimp3d.priors.calls import Call
from gimp3d.priors.inpaint import inpaint_reference
from gimp3d.run import ViewState
from gimp3d.stages.propagate import Reference


def scenery(height: int = 120, width: int = 160, seed: int = 0) -> np.ndarray:
    """Noise of several scales, [H, W, 3] uint8."""
    random = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(random.normal(size=(height, width, 3)), (0, 0), s) * s for s in (1.5, 4, 12)]
    return np.clip(128 + 70 * sum(layers), 10, 245).astype(np.uint8)


def disc(height: int = 120, width: int = 160, radius: float = 22) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return (y - height / 2) ** 2 + (x - width / 2) ** 2 < radius**2


def holed(picture: np.ndarray, hole: np.ndarray) -> np.ndarray:
    return np.where(hole[..., None], np.uint8(255), picture)


def badly_drawn(picture: np.ndarray) -> np.ndarray:
    """As splats of few views show it: blurred, with haze in patches."""
    haze = cv2.GaussianBlur(np.random.default_rng(7).normal(size=picture.shape), (0, 0), 12) * 600
    return np.clip(0.3 * cv2.GaussianBlur(picture, (0, 0), 4) + 90 + haze, 0, 255).astype(np.uint8)


def inner(hole: np.ndarray, margin: int = 4) -> np.ndarray:
    """The hole without its rim, which resampling mixes with what is round it."""
    side = 2 * margin + 1
    return cv2.erode(hole.astype(np.uint8), np.ones((side, side), np.uint8)) > 0


def error(filled: np.ndarray, truth: np.ndarray, where: np.ndarray) -> float:
    """Mean absolute difference, grey levels."""
    return float(np.abs(filled[where].astype(float) - truth[where]).mean())


def refuse(message: str, spec: str, image: np.ndarray, hole: np.ndarray, call: Call = Call()) -> str:
    """What the provider is refused with: one line that matches."""
    with pytest.raises(BadInput, match=message) as found:
        inpaint_reference(spec, image, hole, call=call)
    assert "\n" not in str(found.value)
    return str(found.value)


def painted_view(
    name: str, painted: np.ndarray, rules: np.ndarray, reference: np.ndarray, target: np.ndarray
) -> ViewState:
    """A view of which is known what was painted, by which rules, and from which reference: picture and its hole."""
    camera: Any = SimpleNamespace(id=name)
    masks: Any = SimpleNamespace(camera=camera)
    best = Reference(camera, reference, np.ones(target.shape, np.float32), target, ~target)
    exposure: Any = None  # of no interest
    return ViewState(masks, painted, exposure, painted, painted, masks, rules=rules, best=(1, best))

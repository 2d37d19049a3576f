"""Drawing Gaussians on a CPU: project → bin → blend.

Conventions as in Inria's and gsplat's rasterisers: the projected covariance gets a 0.3 px² low-pass, alpha
below 1/255 is nothing and above 0.99 is 0.99, colours are max(0, 0.5 + SH), pixel centres lie at +0.5.
Unlike there, a pixel is looked at every 16 Gaussians, not at each, to see whether it takes more: the difference
is below `RasterSettings.stop`. The result is bit-equal for any number of threads.
"""

from __future__ import annotations

import numpy as np

from ..camera import Camera
from ..gaussians import Gaussians
from . import cpu
from .types import ALL_PASSES, PASSES, Contributions, RasterSettings, Rendering

__all__ = ["ALL_PASSES", "PASSES", "Contributions", "RasterSettings", "Rendering", "contributions", "footprint", "render"]

def render(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings = RasterSettings(),
    passes: frozenset[str] = ALL_PASSES,
) -> Rendering:
    return cpu.render(gaussians, camera, settings, passes)


def footprint(
    gaussians: Gaussians,
    camera: Camera,
    chosen: np.ndarray,  # [N] bool
    settings: RasterSettings = RasterSettings(),
) -> np.ndarray:
    """Accumulated blend weight of the chosen Gaussians, [H, W] float32; others may hide them."""
    return cpu.footprint(gaussians, camera, chosen, settings)


def contributions(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings = RasterSettings(),
    pixels: np.ndarray | None = None,  # [H, W] bool: only these count
) -> Contributions:
    """Sum and maximum of every Gaussian's blend weights over the pixels of a view."""
    return cpu.contributions(gaussians, camera, settings, pixels)

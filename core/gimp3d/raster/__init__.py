"""Drawing Gaussians, and the way back: project → bin → blend, unblend → unproject.

Conventions as in Inria's and gsplat's rasterisers: the projected covariance gets a 0.3 px² low-pass, alpha below 1/255
is nothing and above 0.99 is 0.99, colours are max(0, 0.5 + SH), pixel centres lie at +0.5. Unlike there, a pixel is
looked at every 16 Gaussians, not at each, to see whether it takes more: the difference is below `RasterSettings.stop`.
Surfels are met by each pixel's ray (Huang 2024). The result is bit-equal for any number of threads.
"""

from __future__ import annotations

import numpy as np

from ..camera import Camera
from ..gaussians import Gaussians
from .backend import Backend, Trace, current_backend, use_backend
from .region import Region
from .types import (
    ALL_PASSES,
    PASSES,
    Contributions,
    Gradients,
    PictureGradients,
    RasterSettings,
    Rendering,
)

__all__ = [
    "ALL_PASSES",
    "PASSES",
    "Backend",
    "Contributions",
    "Gradients",
    "PictureGradients",
    "RasterSettings",
    "Region",
    "Rendering",
    "Trace",
    "backward",
    "contributions",
    "footprint",
    "render",
    "trace",
    "use_backend",
]


def render(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings = RasterSettings(),
    passes: frozenset[str] = ALL_PASSES,
) -> Rendering:
    """Draw a scene (paper eq. 1 and 2).

    Parameters
    ----------
    passes
        Any of rgb, alpha, depth (both depths), expected_depth, normal and distortion; only these are computed.

    Raises
    ------
    ValueError
        If a pass is unknown.
    """
    return current_backend().render(gaussians, camera, settings, passes)


def trace(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings = RasterSettings(),
    passes: frozenset[str] = ALL_PASSES,
) -> tuple[Rendering, Trace]:
    """As `render`, and what `backward` needs. The Gaussians' arrays must not change until then."""
    return current_backend().trace(gaussians, camera, settings, passes)


def backward(traced: Trace, gradients: PictureGradients) -> Gradients:
    """The gradient of a loss with respect to the traced Gaussians, given that with respect to their pictures.

    Raises
    ------
    ValueError
        If a gradient has not its picture's shape, or the picture was not rendered.
    """
    return traced.backward(gradients)


def footprint(
    gaussians: Gaussians,
    camera: Camera,
    chosen: np.ndarray,  # [N] bool
    settings: RasterSettings = RasterSettings(),
) -> np.ndarray:
    """Accumulated blend weight of the chosen Gaussians, [H, W] float32; others may hide them."""
    return current_backend().footprint(gaussians, camera, chosen, settings)


def contributions(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings = RasterSettings(),
    pixels: np.ndarray | None = None,  # [H, W] bool: only these count
) -> Contributions:
    """Sum and maximum of every Gaussian's blend weights over the pixels of a view."""
    return current_backend().contributions(gaussians, camera, settings, pixels)

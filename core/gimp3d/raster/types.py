"""What goes into a rasteriser and what comes out of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

Mask = np.ndarray | None  # bool, of a picture's pixels [H, W] or a scene's rows [N]; None: all
PASSES = frozenset({"rgb", "alpha", "depth", "expected_depth", "normal"})
ALL_PASSES = frozenset({"rgb", "alpha", "depth", "normal"})  # what a picture usually needs


@dataclass(frozen=True)
class RasterSettings:
    """How Gaussians are drawn."""

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # RGB in [0, 1]
    near: float = 0.01  # z below which a Gaussian's centre is cut away, scene units (absolute), as gsplat
    low_pass: float = 0.3  # px², added to the projected covariance of 3D Gaussians
    surfel_low_pass: float = 0.5  # px², variance of the disc that a surfel never gets smaller than (Huang 2024, eq. 11)
    alpha_min: float = 1 / 255  # > 0; a Gaussian is nothing where its alpha is not above this
    alpha_max: float = 0.99
    stop: float = 1e-4  # transmittance below which a pixel takes no more Gaussians (looked at every 16)


@dataclass(frozen=True)
class Rendering:
    """A view of a scene. Passes that were not asked for are empty arrays, but alpha is always there."""

    rgb: np.ndarray  # [H, W, 3] float32, ≥ 0, may exceed 1
    alpha: np.ndarray  # [H, W] float32, accumulated opacity
    expected_depth: np.ndarray  # [H, W] float32, Σ w z / Σ w; 0 where there is nothing
    median_depth: np.ndarray  # [H, W] float32, z of the Gaussian that blocks half of the light; 0 where alpha < 0.5
    normals: np.ndarray  # [H, W, 3] float32, unit, camera axes, facing the camera; 0 where there is nothing
    ignored: int  # rows that cannot be drawn: broken geometry, or in the picture with broken SH coefficients


def _nothing(*channels: int) -> Any:
    return field(default_factory=lambda: np.empty((0, 0, *channels), np.float32))


@dataclass(frozen=True)
class PictureGradients:
    """The gradient of a loss with respect to a Rendering; what is empty is zero. Shapes as there, float32."""

    rgb: np.ndarray = _nothing(3)
    alpha: np.ndarray = _nothing()
    expected_depth: np.ndarray = _nothing()
    median_depth: np.ndarray = _nothing()
    normals: np.ndarray = _nothing(3)


@dataclass(frozen=True)
class Gradients:
    """The gradient of a loss with respect to the stored (raw) values of Gaussians; zero rows where nothing is drawn."""

    means: np.ndarray  # [N, 3] float32
    log_scales: np.ndarray  # [N, 3 or 2]
    quats: np.ndarray  # [N, 4]; normal to the quaternion, whose length does not matter
    opacity_logits: np.ndarray  # [N]
    sh: np.ndarray  # [N, K, 3]


@dataclass(frozen=True)
class Contributions:
    """Each Gaussian's share in a picture."""

    total: np.ndarray  # [N] float32, Σ of its blend weights over the pixels
    peak: np.ndarray  # [N] float32, its largest blend weight

"""A pinhole view. OpenCV axes (x right, y down, z forward); pixel (i, j) covers [i, i+1) × [j, j+1)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

LARGEST_SIDE, LARGEST_PICTURE = (1 << 16) - 1, 1 << 27  # pixels


@dataclass(frozen=True)
class Distortion:
    """OpenCV's radial and tangential coefficients of a photo; photos are undistorted on reading, never later."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @property
    def coefficients(self) -> np.ndarray:
        """In OpenCV's order (k1, k2, p1, p2, k3)."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3])


@dataclass(frozen=True)
class Camera:
    """One view of the scene: its pose, intrinsics, and where its photo lies; ValueError for numbers that are none."""

    id: str  # file_path / image name / img_name, as the camera file gives it
    width: int  # pixels
    height: int  # pixels
    fx: float  # pixels
    fy: float
    cx: float  # pixels from the left edge of the image, so the centre of a 480 px image is 240
    cy: float
    viewmat: np.ndarray  # [4, 4] float64, world→camera, rotation part orthonormal
    split: str = "train"
    image: Path | None = None  # the photo, if one is known; may not exist
    distortion: Distortion | None = None

    def __post_init__(self) -> None:
        if self.width < 0 or self.height < 0:  # the window of a view may be empty
            raise ValueError(f"camera {self.id}: a picture of {self.width}×{self.height} pixels")
        if self.viewmat.shape != (4, 4) or not np.isfinite(self.viewmat).all():
            raise ValueError(f"camera {self.id}: viewmat must be 4×4 finite numbers")
        if not all(map(math.isfinite, (self.fx, self.fy, self.cx, self.cy))):
            raise ValueError(f"camera {self.id}: focal lengths and centre must be finite")

    @property
    def K(self) -> np.ndarray:
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    @property
    def R(self) -> np.ndarray:
        return self.viewmat[:3, :3]

    @property
    def t(self) -> np.ndarray:
        return self.viewmat[:3, 3]

    @property
    def centre(self) -> np.ndarray:
        """Camera position in the world, [3]."""
        return -self.R.T @ self.t

    @property
    def forward(self) -> np.ndarray:
        """Viewing direction in the world, [3]."""
        return self.R[2]

    def to_camera(self, points: np.ndarray) -> np.ndarray:
        """World points [..., 3] in camera axes."""
        return points @ self.R.T + self.t

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixel coordinates [..., 2] (continuous, centres at +0.5) and z-depth [...] of world points [..., 3]; points
        with z ≤ 0 give NaN."""
        p = self.to_camera(points)
        z = p[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = np.where(z > 0, 1.0 / z, np.nan)
        return np.stack([self.fx * p[..., 0] * inverse + self.cx, self.fy * p[..., 1] * inverse + self.cy], -1), z

    def unproject(self, uv: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """World points [..., 3] seen at pixels `uv` [..., 2] at z-depth `depth` [...]."""
        x = (uv[..., 0] - self.cx) / self.fx * depth
        y = (uv[..., 1] - self.cy) / self.fy * depth
        return (np.stack([x, y, depth], -1) - self.t) @ self.R

    def pixel_centres(self) -> np.ndarray:
        """Continuous coordinates of every pixel's centre, [H, W, 2]."""
        u, v = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return np.stack([u, v], -1)

    def scaled(self, factor: float) -> Camera:
        """The same view at `factor` times the resolution (rounded to whole pixels, exact intrinsics)."""
        width, height = max(1, round(self.width * factor)), max(1, round(self.height * factor))
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )


def output_name(camera_id: str) -> str:
    """A camera's ID without its extension, as a relative output path."""
    head, _, tail = camera_id.rpartition("/")
    stem = tail.rsplit(".", 1)[0] if "." in tail[1:] else tail
    return f"{head}/{stem}" if head else stem

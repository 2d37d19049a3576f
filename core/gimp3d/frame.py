"""The frame in which a scene is worked on: units and an origin that suit it, whatever those of its file are.

Single precision holds seven digits and a few lengths are absolute (`RasterSettings.near`), so a scene in microns, or
one that lies kilometres off the origin, is looked at through this frame. Ordinary scenes keep their own, bit by bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .box import Box, Region
from .camera import Camera
from .gaussians import Gaussians
from .geometry import framed
from .stages.charts import Chart

ORDINARY = (0.5, 128.0)  # scene units: usual depths in views at which a scene keeps its units …
USUAL = 4.0  # … and what they are in a frame of its own
FAR = 4.0  # usual depths from the origin beyond which a scene gets an origin of its own
SAMPLED, VIEWS = 20_000, 32  # Gaussians and views looked at


@dataclass(frozen=True)
class Frame:
    """Points p of the file are (p − origin) · scale here."""

    origin: np.ndarray  # [3] float64, scene units
    scale: float  # a power of two

    @property
    def is_files(self) -> bool:
        """True where nothing is changed."""
        return self.scale == 1 and not self.origin.any()

    def scene(self, scene: Gaussians) -> Gaussians:
        """The Gaussians in this frame, in single precision; of means in double precision it keeps the digits."""
        if self.is_files:
            return replace(scene, means=scene.means.astype(np.float32, copy=False))
        with np.errstate(over="ignore", invalid="ignore"):
            means = ((scene.means.astype(np.float64) - self.origin) * self.scale).astype(np.float32)
        return replace(scene, means=means, log_scales=self._sizes(scene, self.scale))

    def camera(self, camera: Camera) -> Camera:
        """A camera of the file's frame in this one."""
        return self._moved(camera, (camera.t + camera.R @ self.origin) * self.scale)

    def region(self, region: Region) -> Region:
        """Boxes of the file's frame in this one."""
        return tuple(replace(b, center=(b.center - self.origin) * self.scale, size=b.size * self.scale) for b in region)

    def back(self, gaussians: Gaussians | None) -> Gaussians | None:
        """Gaussians of this frame in the file's, their means in float64."""
        if gaussians is None or self.is_files:
            return gaussians
        means = gaussians.means.astype(np.float64) / self.scale + self.origin
        return replace(gaussians, means=means, log_scales=self._sizes(gaussians, 1 / self.scale))

    def charts_back(self, charts: Sequence[Chart]) -> tuple[Chart, ...]:
        """Charts whose cameras are in the file's frame."""
        pairs = [(chart, chart.camera) for chart in charts]
        return tuple(replace(c, camera=self._moved(b, b.t / self.scale - b.R @ self.origin)) for c, b in pairs)

    def proposed_back(self, proposed: dict[str, Any]) -> dict[str, Any]:
        """What a removal proposes to take along, see Growth.facts."""
        box = proposed.get("box")
        if box is None or self.is_files:
            return proposed
        center, size = np.array(box["center"]) / self.scale + self.origin, np.array(box["size"]) / self.scale
        return {**proposed, "box": Box.make(center, size, box["rotation_wxyz"]).to_json()}

    def _moved(self, camera: Camera, translation: np.ndarray) -> Camera:
        if self.is_files:
            return camera
        viewmat = camera.viewmat.copy()
        viewmat[:3, 3] = translation
        return replace(camera, viewmat=viewmat)

    @staticmethod
    def _sizes(gaussians: Gaussians, scale: float) -> np.ndarray:
        return (gaussians.log_scales.astype(np.float64) + np.log(scale)).astype(np.float32)


def frame_of(scene: Gaussians, cameras: Sequence[Camera]) -> Frame:
    """The frame that suits a scene as these cameras see it: near the origin and of ordinary size.

    Most scenes are so already, and keep theirs.

    Examples
    --------
    >>> scene, cameras = read_ply("scene.ply").gaussians, read_cameras("transforms.json")
    >>> frame_of(scene, cameras).scale
    1.0
    """
    usable = np.flatnonzero(scene.usable)
    points = scene.means[usable[:: len(usable) // SAMPLED + 1]].astype(np.float64)
    in_view = [framed(c, points)[3] for c in cameras[:: len(cameras) // VIEWS + 1]]
    depths = [np.median(z) if len(z) else np.nan for z in in_view]
    usual = float(np.nanmedian(depths)) if np.isfinite(depths).any() else np.nan
    if not np.isfinite(usual) or usual <= 0:
        return Frame(np.zeros(3), 1.0)
    scale = 1.0 if ORDINARY[0] <= usual <= ORDINARY[1] else 2.0 ** -round(np.log2(usual / USUAL))
    middle = np.median(points, axis=0)
    if np.linalg.norm(middle) <= FAR * usual:
        return Frame(np.zeros(3), scale)
    step = 2.0 ** round(np.log2(usual))  # so that single precision loses nothing by the difference
    return Frame(np.round(middle / step) * step, scale)

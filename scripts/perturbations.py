"""Small errors of what a removal is given: poses, depths, the region. Each the same for the same seed."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from gimp3d.box import Region
from gimp3d.camera import Camera
from gimp3d.gaussians import Gaussians
from gimp3d.raster import Drawing, RasterSettings, Rendering, use_backend
from gimp3d.raster.backend import Backend, current_backend

GRAIN = 3.0  # px, σ of the blur that makes depth errors as coarse as splats are


def turned(camera: Camera, pixels: float, rng: np.random.Generator) -> Camera:
    """The camera turned about its centre, round a random axis, so that its picture moves by `pixels` RMS.

    A turn moves what is near and what is far alike, so the amount does not depend on the scene.
    """
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    pixel_grid = camera.pixel_centres()[::8, ::8]
    points = camera.unproject(pixel_grid, np.ones(pixel_grid.shape[:2]))

    def by(angle: float) -> Camera:
        turn = np.eye(4)
        turn[:3, :3] = cv2.Rodrigues(angle * axis)[0]
        return replace(camera, viewmat=turn @ camera.viewmat)

    def moved(angle: float) -> float:
        return float(np.sqrt(((by(angle).project(points)[0] - pixel_grid) ** 2).sum(-1).mean()))

    angle = pixels / camera.fx
    for _ in range(3):  # a turn of a few pixels is almost linear
        angle *= pixels / moved(angle) if pixels else 0.0
    return by(angle)


class NoisyDepths:
    """A `Backend` that draws as another does, with errors in every view's depths.

    Every stage reads depths off renderings, so this is where errors of geometry reach all of them and nothing else. A
    view has one field of errors: the surface is as wrong with the object there as without it. Views have fields of
    their own, so they contradict each other, which is what tests between views must survive.
    """

    def __init__(self, backend: Backend, relative: float, seed: int) -> None:
        self.backend, self.relative, self.seed = backend, relative, seed

    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        settings: RasterSettings,
        passes: frozenset[str],
        pixels: np.ndarray | None,
    ) -> Rendering:
        drawn = self.backend.render(gaussians, camera, settings, passes, pixels)
        depths = {"median_depth": drawn.median_depth, "expected_depth": drawn.expected_depth}
        return replace(drawn, **{name: z * self._factor(camera) for name, z in depths.items() if z.size})

    def drawing(self, gaussians: Gaussians, camera: Camera, *options: Any) -> NoisyDrawing:
        return NoisyDrawing(self.backend.drawing(gaussians, camera, *options), self._factor(camera))

    def _factor(self, camera: Camera) -> np.ndarray:
        return 1 + self.relative * depth_errors(camera.id, camera.height, camera.width, self.seed)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.backend, name)


@dataclass
class NoisyDrawing:
    """A `Drawing` whose surface is off by a factor [H, W]."""

    drawing: Drawing
    factor: np.ndarray

    def surface_depth(self, gone: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        depth, alpha = self.drawing.surface_depth(gone)
        return depth * self.factor, alpha

    def __getattr__(self, name: str) -> Any:
        return getattr(self.drawing, name)


@lru_cache(maxsize=256)
def depth_errors(name: str, height: int, width: int, seed: int) -> np.ndarray:
    """[H, W] float32 with mean 0 and deviation 1, smooth over a few pixels as splats' errors are."""
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    errors = gaussian_filter(rng.normal(size=(height, width)), GRAIN, mode="wrap")
    return (errors / errors.std()).astype(np.float32)


@contextmanager
def noisy_depths(relative: float, seed: int) -> Iterator[None]:
    """Depths of all renderings are off by `relative` (one standard deviation) inside."""
    before = use_backend(NoisyDepths(current_backend(), relative, seed))
    try:
        yield
    finally:
        use_backend(before)


def resized(region: Region, factor: float) -> Region:
    """Boxes that are `factor` times as large about their centres."""
    return tuple(replace(box, size=box.size * factor) for box in region)


def moved(region: Region, axis: int, share: float) -> Region:
    """Boxes moved along one of their own axes by a share of their size."""
    return tuple(replace(box, center=box.center + share * box.size[axis] * box.axes[:, axis]) for box in region)

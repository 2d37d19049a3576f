"""Errors of what a removal is given: poses, depths, photos, region, views. Each the same for the same seed."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from gimp3d.raster import Backend, Drawing, Rendering, current_backend, use_backend
from gimp3d.run import Observer
from gimp3d.stages.depth import DepthCompletion

GRAIN = 3.0  # px, σ of the blur that makes depth errors as coarse as splats are
GARBLED = 16  # px, side of the squares that hold another part of a garbled photo
Photos = Mapping[str, np.ndarray]  # ID → [H, W, 3] uint8


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

    def drawing(self, gaussians: Gaussians, camera: Camera, *options: Any) -> NoisyDrawing:
        return NoisyDrawing(self.backend.drawing(gaussians, camera, *options), self._factor(camera))

    def _factor(self, camera: Camera) -> np.ndarray:
        return 1 + self.relative * depth_errors(camera.id, camera.height, camera.width, self.seed)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.backend, name)


@dataclass
class NoisyDrawing:
    """A `Drawing` whose depths are off by a factor [H, W]."""

    drawing: Drawing
    factor: np.ndarray

    def render(self, *options: Any) -> Rendering:
        drawn = self.drawing.render(*options)
        depths = {"median_depth": drawn.median_depth, "expected_depth": drawn.expected_depth}
        return replace(drawn, **{name: z * self.factor for name, z in depths.items() if z.size})

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


def noisy_surfaces(relative: float, seed: int) -> Observer:
    """A removal's observer: the completed surfaces of all references are off by `relative` (one standard deviation)."""

    def observe(name: str, work: Callable[..., Any], inputs: tuple[Any, ...]) -> Any:
        done = work(*inputs)
        if not isinstance(done, DepthCompletion):
            return done
        errors = depth_errors(inputs[0].id, *done.depth.shape, seed)
        return replace(done, depth=done.depth * (1 + relative * errors))

    return observe


def gathered(cameras: Sequence[Camera], middle: Camera, centre: np.ndarray, degrees: float) -> tuple[Camera, ...]:
    """The middle camera, turned about what they look at [3] towards each camera: by `degrees` towards the farthest."""

    def towards(camera: Camera) -> np.ndarray:
        away = camera.centre - centre
        return away / np.linalg.norm(away)

    turns = []
    for camera in cameras:
        across = np.cross(towards(middle), towards(camera))
        angle = np.arctan2(np.linalg.norm(across), towards(middle) @ towards(camera))
        turns.append(angle * across / max(np.linalg.norm(across), 1e-12))
    widest = max(np.linalg.norm(turns, axis=1).max(), 1e-12)
    found = []
    for camera, turn in zip(cameras, turns):
        moved_scene = np.eye(4)
        moved_scene[:3, :3] = cv2.Rodrigues(-turn * np.radians(degrees) / widest)[0]
        moved_scene[:3, 3] = centre - moved_scene[:3, :3] @ centre
        found.append(replace(middle, id=camera.id, viewmat=middle.viewmat @ moved_scene, split="train", image=None))
    return tuple(found)


def exposed(photos: Photos, share: float, seed: int) -> dict[str, np.ndarray]:
    """Each photo times a gain of its own, from 1 − share to 1 + share."""
    gains = np.random.default_rng(seed).uniform(1 - share, 1 + share, len(photos))
    return {n: np.clip(np.rint(p * g), 0, 255).astype(np.uint8) for (n, p), g in zip(photos.items(), gains)}


def misplaced(photos: Photos, share: float, seed: int) -> dict[str, np.ndarray]:
    """A share of the photos, at least two, under each other's names."""
    names = np.random.default_rng(seed).permutation(list(photos))[: max(2, round(share * len(photos)))]
    return {**photos, **{str(a): photos[b] for a, b in zip(names, np.roll(names, 1))}}


def garbled(photos: Photos, share: float, seed: int) -> dict[str, np.ndarray]:
    """Squares that cover about a share of every photo show another part of it."""
    rng = np.random.default_rng(seed)
    found = {name: photo.copy() for name, photo in photos.items()}
    for whole in found.values():
        rows, cols = (n // GARBLED for n in whole.shape[:2])
        tiled = whole[: rows * GARBLED, : cols * GARBLED]
        squares = tiled.reshape(rows, GARBLED, cols, GARBLED, 3).swapaxes(1, 2)
        wrong = rng.random((rows, cols)) < share
        squares[wrong] = squares[rng.integers(rows, size=wrong.sum()), rng.integers(cols, size=wrong.sum())]
        tiled[:] = squares.swapaxes(1, 2).reshape(tiled.shape)
    return found


def resized(region: Region, factor: float) -> Region:
    """Boxes that are `factor` times as large about their centres."""
    return tuple(replace(box, size=box.size * factor) for box in region)


def moved(region: Region, axis: int, share: float) -> Region:
    """Boxes moved along one of their own axes by a share of their size."""
    return tuple(replace(box, center=box.center + share * box.size[axis] * box.axes[:, axis]) for box in region)

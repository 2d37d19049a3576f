"""The seam between callers and the machine that draws: today the CPU, later perhaps a GPU beside it."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ..camera import Camera
from ..gaussians import Gaussians
from . import cpu
from .types import Contributions, Gradients, PictureGradients, RasterSettings, Rendering


class Trace(Protocol):
    """What a backend keeps of a rendering for the way back."""

    def backward(self, gradients: PictureGradients) -> Gradients: ...


class Backend(Protocol):
    """What a backend must do; the functions of this package say what each means. Arrays are NumPy's, in and out."""

    def render(
        self, gaussians: Gaussians, camera: Camera, settings: RasterSettings, passes: frozenset[str]
    ) -> Rendering: ...

    def trace(
        self, gaussians: Gaussians, camera: Camera, settings: RasterSettings, passes: frozenset[str]
    ) -> tuple[Rendering, Trace]: ...

    def footprint(
        self, gaussians: Gaussians, camera: Camera, chosen: np.ndarray, settings: RasterSettings
    ) -> np.ndarray: ...

    def contributions(
        self, gaussians: Gaussians, camera: Camera, settings: RasterSettings, pixels: np.ndarray | None
    ) -> Contributions: ...


CPU: Backend = cpu
_current: Backend = CPU


def current_backend() -> Backend:
    return _current


def use_backend(backend: Backend) -> Backend:
    """Let `backend` draw from now on; returns the one that did so far."""
    global _current
    before, _current = _current, backend
    return before

"""The seam between callers and the machine that draws: today the CPU, later perhaps a GPU beside it."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ..camera import Camera
from ..gaussians import Gaussians
from . import cpu
from .cpu_drawing import CpuDrawing
from .region import CpuPixelRegion
from .types import Contributions, Gradients, Mask, PictureGradients, RasterSettings, Rendering, Window


class Trace(Protocol):
    """What a backend keeps of a rendering for the way back."""

    def backward(self, gradients: PictureGradients) -> Gradients: ...


class PixelRegion(Protocol):
    """A part of a view where some Gaussians change and the rest does not; see `pixel_region`."""

    def render(self, active: Gaussians) -> Rendering:
        """The region with the active Gaussians in it, as if they followed the frozen ones in one scene."""

    def trace(self, active: Gaussians) -> tuple[Rendering, Trace]:
        """As `render`, and the way back to the active Gaussians, open until the region is rendered again."""


class Drawing(Protocol):
    """A view of a scene, made ready once and drawn in several ways; see `drawing`."""

    def render(self, passes: frozenset[str], pixels: Mask = None) -> Rendering:
        """As `render`; of the drawing's own pixels only those given."""

    def surface_depth(self, gone: Mask = None) -> tuple[np.ndarray, np.ndarray]:
        """As `surface_depth`, without some Gaussians ([N] bool)."""

    def footprint(self, chosen: np.ndarray) -> np.ndarray:
        """As `footprint`; only for drawings without colours."""


class Backend(Protocol):
    """What a backend must do; the functions of this package say what each means. Arrays are NumPy's, in and out."""

    def render(
        self, gaussians: Gaussians, camera: Camera, settings: RasterSettings, passes: frozenset[str], pixels: Mask
    ) -> Rendering: ...

    def trace(
        self, gaussians: Gaussians, camera: Camera, settings: RasterSettings, passes: frozenset[str]
    ) -> tuple[Rendering, Trace]: ...

    def pixel_region(
        self, frozen: Gaussians, camera: Camera, pixels: np.ndarray, settings: RasterSettings, passes: frozenset[str]
    ) -> PixelRegion: ...

    def drawing(
        self, gaussians: Gaussians, camera: Camera, settings: RasterSettings, with_colour: bool, pixels: Mask
    ) -> Drawing: ...

    def contributions(
        self, gaussians: Gaussians, camera: Camera, settings: RasterSettings, pixels: Mask
    ) -> Contributions: ...

    def label_weights(
        self, gaussians: Gaussians, camera: Camera, labels: np.ndarray, count: int, rows: Mask
    ) -> np.ndarray: ...

    def touched_window(self, gaussians: Gaussians, camera: Camera, margin: int) -> Window: ...


class CpuBackend:
    """This machine's cores."""

    @staticmethod
    def render(
        gaussians: Gaussians, camera: Camera, settings: RasterSettings, passes: frozenset[str], pixels: Mask
    ) -> Rendering:
        return CpuDrawing(gaussians, camera, settings, "rgb" in passes, pixels).render(passes)

    trace = staticmethod(cpu.trace)
    pixel_region = staticmethod(CpuPixelRegion)
    drawing = staticmethod(CpuDrawing)
    contributions = staticmethod(cpu.contributions)
    label_weights = staticmethod(cpu.label_weights)
    touched_window = staticmethod(cpu.touched_window)


_current: Backend = CpuBackend()


def current_backend() -> Backend:
    return _current


def use_backend(backend: Backend) -> Backend:
    """Let `backend` draw from now on; returns the one that did so far."""
    global _current
    before, _current = _current, backend
    return before

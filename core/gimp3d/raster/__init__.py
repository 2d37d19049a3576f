"""Drawing Gaussians, and the way back: project → bin → blend, unblend → unproject.

Conventions as in Inria's and gsplat's rasterisers: the projected covariance gets a 0.3 px² low-pass, alpha below 1/255
is nothing and above 0.99 is 0.99, colours are max(0, 0.5 + SH), pixel centres lie at +0.5. Unlike there, a pixel is
looked at every 16 Gaussians, not at each, to see whether it takes more: the difference is below `RasterSettings.stop`.
Surfels are met by each pixel's ray (Huang 2024). The result is bit-equal for any number of threads.

A mask of `pixels`, [H, W] bool, says which are wanted. All functions that take a mask raise a ValueError if it has not
the picture's shape, and those that take passes if one is unknown.
"""

from __future__ import annotations

import numpy as np

from ..camera import Camera
from ..gaussians import Gaussians
from ..geometry import Window
from . import cpu
from .cpu import Trace
from .cpu_drawing import Drawing
from .region import PixelRegion, RegionTrace
from .types import ALL_PASSES, Contributions, Gradients, Mask, PictureGradients, RasterSettings, Rendering
from .types import PASSES as PASSES


class Backend:
    """What draws: the cores of this machine. Whatever is to draw in its place has the same functions, and classes as
    these; the functions of this package say what each means. Arrays are NumPy's, in and out."""

    drawing = Drawing
    pixel_region = PixelRegion
    trace = staticmethod(cpu.trace)
    weigh = staticmethod(cpu.weigh)
    touched_window = staticmethod(cpu.touched_window)


_current = Backend()


def current_backend() -> Backend:
    return _current


def use_backend(backend: Backend) -> Backend:
    """Let `backend` draw from now on; returns the one that did so far."""
    global _current
    before, _current = _current, backend
    return before


def render(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings = RasterSettings(),
    passes: frozenset[str] = ALL_PASSES,
    pixels: Mask = None,
) -> Rendering:
    """Draw a scene (paper, equations 1 and 2).

    Of the passes rgb, alpha, depth (both depths), expected_depth and normal only those given are computed.

    Examples
    --------
    >>> picture = render(read_ply("scene.ply").gaussians, read_cameras("transforms.json")[0])
    >>> picture.rgb.shape, float(picture.alpha.max()) > 0.9
    ((45, 60, 3), True)
    """
    return drawing(gaussians, camera, settings, "rgb" in passes, pixels).render(passes)


def render_bytes(
    gaussians: Gaussians, camera: Camera, background: tuple[float, float, float] = (0, 0, 0), pixels: Mask = None
) -> np.ndarray:
    """The scene as 8-bit RGB, [H, W, 3]."""
    rgb = render(gaussians, camera, RasterSettings(background=background), frozenset({"rgb"}), pixels).rgb
    return np.clip(np.rint(rgb * 255), 0, 255).astype(np.uint8)


def trace(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings = RasterSettings(),
    passes: frozenset[str] = ALL_PASSES,
) -> tuple[Rendering, Trace]:
    """As `render`, and what `backward` needs. The Gaussians' arrays must not change until then.

    Examples
    --------
    >>> scene, camera = read_ply("scene.ply").gaussians, read_cameras("transforms.json")[0]
    >>> picture, traced = trace(scene, camera, passes=frozenset({"rgb"}))
    >>> bool((picture.rgb == render(scene, camera).rgb).all())
    True
    """
    return current_backend().trace(gaussians, camera, settings, passes)


def backward(traced: Trace | RegionTrace, gradients: PictureGradients) -> Gradients:
    """The gradient of a loss with respect to the traced Gaussians, given that with respect to their pictures.

    A ValueError if a gradient has not its picture's shape, or the picture was not rendered.

    Examples
    --------
    >>> scene, camera = read_ply("scene.ply").gaussians, read_cameras("transforms.json")[0]
    >>> picture, traced = trace(scene, camera, passes=frozenset({"rgb"}))
    >>> gradients = backward(traced, PictureGradients(rgb=np.ones_like(picture.rgb)))  # of the sum of all colours
    >>> gradients.sh.shape == scene.sh.shape
    True
    """
    return traced.backward(gradients)


def pixel_region(
    frozen: Gaussians,
    camera: Camera,
    pixels: np.ndarray,
    settings: RasterSettings = RasterSettings(),
    passes: frozenset[str] = frozenset({"rgb", "alpha"}),
) -> PixelRegion:
    """Wanted pixels of a view over Gaussians that do not change: prepared once, then drawn with others many times.

    In every tile, what lies before the nearest and behind the farthest of the others is blended only when they leave
    the depths they were at. That is not done with the pass `depth` (the median needs every Gaussian); ask for
    `expected_depth` alone where speed counts. A region is not for two threads at once.

    Examples
    --------
    >>> scene, camera = read_ply("scene.ply").gaussians, read_cameras("transforms.json")[0]
    >>> moving = np.arange(len(scene)) >= len(scene) - 10
    >>> region = pixel_region(scene.take(~moving), camera, np.ones((45, 60), bool))
    >>> picture, traced = region.trace(scene.take(moving))
    >>> bool(np.allclose(picture.rgb, render(scene, camera).rgb, atol=1e-3))
    True
    """
    return current_backend().pixel_region(frozen, camera, pixels, settings, passes)


def drawing(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings = RasterSettings(),
    with_colour: bool = True,
    pixels: Mask = None,
) -> Drawing:
    """A view that is to be drawn in more than one way: the Gaussians are projected and sorted once.

    Pixels are those of the whole picture, bit by bit, however few are wanted. The Gaussians' arrays must not change
    while a drawing is in use, and it is not for two threads at once.

    Examples
    --------
    >>> scene, camera = read_ply("scene.ply").gaussians, read_cameras("transforms.json")[0]
    >>> view = drawing(scene, camera)
    >>> rgb, (depth, alpha) = view.render(frozenset({"rgb"})).rgb, view.surface_depth()
    >>> rgb.shape, depth.shape
    ((45, 60, 3), (45, 60))
    """
    return current_backend().drawing(gaussians, camera, settings, with_colour, pixels)


def footprint(
    gaussians: Gaussians,
    camera: Camera,
    chosen: np.ndarray,
    settings: RasterSettings = RasterSettings(),
    pixels: Mask = None,
) -> np.ndarray:
    """Accumulated blend weight of the chosen Gaussians [N] bool, [H, W] float32 in 0 … 1; others may hide them.

    A ValueError if `chosen` has the wrong shape.

    Examples
    --------
    >>> scene, camera = read_ply("scene.ply").gaussians, read_cameras("transforms.json")[0]
    >>> shown = footprint(scene, camera, chosen=scene.means[:, 2] > 0.1)
    >>> shown.shape, 0 < (shown > 0.5).mean() < 1
    ((45, 60), True)
    """
    return drawing(gaussians, camera, settings, False, pixels).footprint(chosen)


def surface_depth(
    gaussians: Gaussians, camera: Camera, settings: RasterSettings = RasterSettings(), pixels: Mask = None
) -> tuple[np.ndarray, np.ndarray]:
    """z where each pixel's ray meets the Gaussian that blocks half of the light, and alpha, [H, W] float32 both.

    `Rendering.median_depth` is the z of that Gaussian's centre (but for surfels); this follows the slant of large
    splats (Yu 2024; Zhang 2024). In scene units; 0 where alpha < 0.5.

    Examples
    --------
    >>> depth, alpha = surface_depth(read_ply("scene.ply").gaussians, read_cameras("transforms.json")[0])
    >>> bool((depth[alpha < 0.5] == 0).all())
    True
    """
    return drawing(gaussians, camera, settings, False, pixels).surface_depth()


def contributions(
    gaussians: Gaussians, camera: Camera, settings: RasterSettings = RasterSettings(), pixels: Mask = None
) -> Contributions:
    """Sum and maximum of every Gaussian's blend weights over the pixels of a view.

    Examples
    --------
    >>> scene, camera = read_ply("scene.ply").gaussians, read_cameras("transforms.json")[0]
    >>> weights = contributions(scene, camera)
    >>> bool((weights.peak <= weights.total + 1e-6).all())
    True
    """
    labels = np.ones((camera.height, camera.width), bool) if pixels is None else pixels != 0
    total, peak = current_backend().weigh(gaussians, camera, settings, labels, 1, None)
    return Contributions(total[0], peak)


def label_weights(
    gaussians: Gaussians, camera: Camera, labels: np.ndarray, count: int, rows: Mask = None
) -> np.ndarray:
    """Sum of every Gaussian's blend weights over the pixels of each label, [count, N] float32.

    `labels` [H, W] are 0 where weights do not count, else 1 … count. Where `rows` [N] bool are given, only theirs are
    needed; others may come out too small.
    """
    return current_backend().weigh(gaussians, camera, RasterSettings(), labels, count, rows)[0]


def touched_window(gaussians: Gaussians, camera: Camera, margin: int = 0) -> Window:
    """A rectangle outside of which the Gaussians draw nothing, and `margin` pixels, within the picture; never empty."""
    return current_backend().touched_window(gaussians, camera, margin)

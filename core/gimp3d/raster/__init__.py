"""Drawing Gaussians on a CPU: project → bin → blend.

Conventions as in Inria's and gsplat's rasterisers: the projected covariance gets a 0.3 px² low-pass, alpha
below 1/255 is nothing and above 0.99 is 0.99, colours are max(0, 0.5 + SH), pixel centres lie at +0.5.
Unlike there, a whole tile ends when light passes none of its pixels, not each pixel by itself: the difference
is below `RasterSettings.stop`. The result is bit-equal for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..camera import Camera
from ..gaussians import Gaussians
from ..threads import parallel_map, run_ranges, thread_count
from .bin import tile_lists
from .blend import blend_range, gather_weights, weigh_range
from .project import BLUE, FEATURES, RED, TILE, UNUSABLE, project_range

ALL_PASSES = frozenset({"rgb", "alpha", "depth", "normal"})
FRUSTUM_MARGIN = 0.3  # the Jacobian is evaluated no further out than 1.3 × the half frustum (Kerbl 2023, gsplat)


@dataclass(frozen=True)
class RasterSettings:
    """How Gaussians are drawn."""

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # RGB in [0, 1]
    near: float = 0.01  # z below which a Gaussian's centre is cut away, scene units (absolute), as gsplat
    low_pass: float = 0.3  # px², added to the projected covariance
    alpha_min: float = 1 / 255  # > 0; a Gaussian is nothing where its alpha is not above this
    alpha_max: float = 0.99
    stop: float = 1e-4  # transmittance at which a tile is finished


@dataclass(frozen=True)
class Rendering:
    """A view of a scene. Passes that were not asked for are empty arrays, but alpha is always there."""

    rgb: np.ndarray  # [H, W, 3] float32, ≥ 0, may exceed 1
    alpha: np.ndarray  # [H, W] float32, accumulated opacity
    expected_depth: np.ndarray  # [H, W] float32, Σ w z / Σ w; 0 where there is nothing
    median_depth: np.ndarray  # [H, W] float32, z of the Gaussian that blocks half of the light; 0 where alpha < 0.5
    normals: np.ndarray  # [H, W, 3] float32, unit, camera axes, facing the camera; 0 where there is nothing
    ignored: int  # rows that cannot be drawn (NaN, zero quaternion, …: not `Gaussians.usable`)


@dataclass(frozen=True)
class Contributions:
    """Each Gaussian's share in a picture."""

    total: np.ndarray  # [N] float32, Σ of its blend weights over the pixels
    peak: np.ndarray  # [N] float32, its largest blend weight


@dataclass(frozen=True)
class _View:
    """Gaussians projected into a camera, and the tiles they reach."""

    features: np.ndarray  # [N, 16] float32
    ignored: int
    across: int  # tiles per row of tiles
    starts: np.ndarray  # [T+1] int64
    entries: np.ndarray  # [P] int32


def render(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings = RasterSettings(),
    passes: frozenset[str] = ALL_PASSES,
) -> Rendering:
    """Draw a scene (paper eq. 1 and 2). Surfels are drawn as flat 3D Gaussians.

    Parameters
    ----------
    passes
        Any of rgb, alpha, depth (both depths) and normal; only these are computed.

    Raises
    ------
    ValueError
        If a pass is unknown.
    """
    if unknown := passes - ALL_PASSES:
        raise ValueError(f"unknown passes {sorted(unknown)}; there are {sorted(ALL_PASSES)}")
    return _blend(_project_and_bin(gaussians, camera, settings, "rgb" in passes), camera, settings, passes)


def footprint(
    gaussians: Gaussians,
    camera: Camera,
    chosen: np.ndarray,  # [N] bool
    settings: RasterSettings = RasterSettings(),
) -> np.ndarray:
    """Accumulated blend weight of the chosen Gaussians, [H, W] float32; others may hide them."""
    if chosen.shape != (len(gaussians),):
        raise ValueError(f"chosen: expected shape {(len(gaussians),)}, got {chosen.shape}")
    view = _project_and_bin(gaussians, camera, settings, with_colour=False)
    view.features[:, RED : BLUE + 1] = chosen[:, None]  # painted white on black
    rgb = _blend(view, camera, replace(settings, background=(0.0, 0.0, 0.0)), frozenset({"rgb"})).rgb
    return np.ascontiguousarray(rgb[..., 0])


def contributions(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings = RasterSettings(),
    pixels: np.ndarray | None = None,  # [H, W] bool: only these count
) -> Contributions:
    """Sum and maximum of every Gaussian's blend weights over the pixels of a view."""
    shape = (camera.height, camera.width)
    counted = np.ones(shape, bool) if pixels is None else np.require(pixels, bool, ["C", "W"])
    if counted.shape != shape:
        raise ValueError(f"pixels: expected shape {shape}, got {counted.shape}")
    view = _project_and_bin(gaussians, camera, settings, with_colour=False)
    sums, peaks = np.zeros((2, len(view.entries)), np.float32)
    _over_tiles(weigh_range, view, camera, settings, counted, sums, peaks)
    total, peak = np.zeros((2, len(gaussians)), np.float32)
    gather_weights(view.entries, sums, peaks, total, peak)
    return Contributions(total, peak)


def _project_and_bin(gaussians: Gaussians, camera: Camera, settings: RasterSettings, with_colour: bool) -> _View:
    n = len(gaussians)
    sh = _raw(gaussians.sh)
    features, states = np.empty((n, FEATURES), np.float32), np.empty(n, np.int8)
    run_ranges(
        project_range,
        n,
        _raw(gaussians.means),
        _raw(gaussians.log_scales),
        _raw(gaussians.quats),
        _raw(gaussians.opacity_logits),
        sh,
        sh.reshape(n, 3 * sh.shape[1]).view(np.int32),
        _pack_camera(camera),
        int(camera.width),
        int(camera.height),
        float(settings.near),
        float(settings.low_pass),
        float(settings.alpha_min),
        bool(gaussians.antialiased),
        with_colour,
        features,
        states,
    )
    across, down = -(-int(camera.width) // TILE), -(-int(camera.height) // TILE)
    starts, entries = tile_lists(features, states, across, down)
    return _View(features, int(np.count_nonzero(states == UNUSABLE)), across, starts, entries)


def _raw(values: np.ndarray) -> np.ndarray:
    """The values as kernels always get them: another layout, or read-only memory, would compile them anew."""
    return np.require(values, np.float32, ["C", "A", "W"])


def _pack_camera(camera: Camera) -> np.ndarray:
    """What project_range reads of a camera, [23] float64; the Jacobian's bounds are gsplat's."""
    margin_x, margin_y = 0.5 * FRUSTUM_MARGIN * camera.width, 0.5 * FRUSTUM_MARGIN * camera.height
    bounds = [
        (-camera.cx - margin_x) / camera.fx,
        (camera.width - camera.cx + margin_x) / camera.fx,
        (-camera.cy - margin_y) / camera.fy,
        (camera.height - camera.cy + margin_y) / camera.fy,
    ]
    intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy]
    return np.concatenate([camera.R.ravel(), camera.t, intrinsics, camera.centre, bounds]).astype(np.float64)


def _blend(view: _View, camera: Camera, settings: RasterSettings, passes: frozenset[str]) -> Rendering:
    def picture(wanted: bool, *channels: int) -> np.ndarray:
        return np.empty((camera.height, camera.width, *channels) if wanted else (0, 0, *channels), np.float32)

    with_rgb, with_depth, with_normals = "rgb" in passes, "depth" in passes, "normal" in passes
    rgb, alpha, normals = picture(with_rgb, 3), picture(True), picture(with_normals, 3)
    expected, median = picture(with_depth), picture(with_depth)
    background = np.asarray(settings.background, np.float32)
    flags = with_rgb, with_depth, with_normals
    _over_tiles(blend_range, view, camera, settings, background, *flags, rgb, alpha, expected, median, normals)
    return Rendering(rgb, alpha, expected, median, normals, view.ignored)


def _over_tiles(
    kernel_range: Callable[..., Any], view: _View, camera: Camera, settings: RasterSettings, *args: Any
) -> None:
    """Run a tile kernel over all tiles: longest first, dealt round-robin, so that threads end together."""
    limits = [np.float32(v) for v in (settings.alpha_min, settings.alpha_max, settings.stop)]
    order = np.argsort(-np.diff(view.starts), kind="stable")
    chunks = 1 if thread_count() == 1 else 6 * thread_count()
    parallel_map(
        lambda ids: kernel_range(
            0,
            len(ids),
            ids,
            view.across,
            int(camera.width),
            int(camera.height),
            view.starts,
            view.entries,
            view.features,
            *limits,
            *args,
        ),
        [np.ascontiguousarray(order[k::chunks]) for k in range(chunks)],
    )

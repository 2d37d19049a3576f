"""Drawing Gaussians on a CPU: project → bin → blend.

Conventions as in Inria's and gsplat's rasterisers: 0.3 px² low-pass, alpha in [1/255, 0.99], colours 0.5 + SH clamped
at 0, pixel centres at +0.5. The result is bit-equal for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..camera import Camera
from ..gaussians import Gaussians, pad_sh
from ..threads import parallel_map, run_ranges, thread_count
from .bin import tile_lists
from .blend import (
    OUT_DEPTH,
    OUT_MEDIAN,
    OUT_NORMAL,
    OUT_RED,
    PLANES,
    TRANSMITTANCE,
    blend_range,
    gather_weights,
    weigh_range,
)
from .project import BLUE, DEPTH, FEATURES, FRUSTUM, RED, TILE, project_range

ALL_PASSES = frozenset({"rgb", "alpha", "depth", "normal"})
FLAT = 1e-7  # third scale of a surfel drawn as a flat Gaussian, scene units


@dataclass(frozen=True)
class RasterSettings:
    """How Gaussians are drawn."""

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # RGB in [0, 1]
    near: float = 0.01  # z below which a Gaussian's centre is cut away, scene units
    low_pass: float = 0.3  # px², added to the projected covariance


@dataclass(frozen=True)
class Rendering:
    """A view of a scene. Passes that were not asked for are empty arrays."""

    rgb: np.ndarray  # [H, W, 3] float32, ≥ 0
    alpha: np.ndarray  # [H, W] float32, accumulated opacity
    expected_depth: np.ndarray  # [H, W] float32, Σ w z / Σ w; 0 where there is nothing
    median_depth: np.ndarray  # [H, W] float32, z at which half of the light is blocked; 0 where alpha < 0.5
    normals: np.ndarray  # [H, W, 3] float32, unit, camera axes, facing the camera; 0 where there is nothing
    ignored: int  # rows that cannot be drawn (NaN, zero quaternion, …)


@dataclass(frozen=True)
class Contributions:
    """Each Gaussian's share in a picture."""

    total: np.ndarray  # [N] float32, Σ of its blend weights over the pixels
    peak: np.ndarray  # [N] float32, its largest blend weight


@dataclass(frozen=True)
class _Binned:
    """Projected Gaussians in tile lists."""

    rows: np.ndarray  # [M] indices of drawable Gaussians
    features: np.ndarray  # [M, 16]
    starts: np.ndarray  # [T+1]
    entries: np.ndarray  # [P]


def render(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings = RasterSettings(),  # noqa: B008
    passes: frozenset[str] = ALL_PASSES,
) -> Rendering:
    """Draw a scene (paper eq. 1 and 2). Surfels are drawn as flat Gaussians."""
    return _draw(gaussians, camera, settings, passes, None)


def footprint(
    gaussians: Gaussians,
    camera: Camera,
    chosen: np.ndarray,  # [N] bool
    settings: RasterSettings = RasterSettings(),  # noqa: B008
) -> np.ndarray:
    """Accumulated blend weight of the chosen Gaussians, [H, W] float32, hidden by the rest where it lies in front."""
    flags = np.repeat(np.asarray(chosen, np.float32)[:, None], 3, axis=1)
    return _draw(gaussians, camera, settings, frozenset({"rgb"}), flags).rgb[..., 0]


def contributions(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings = RasterSettings(),  # noqa: B008
    pixels: np.ndarray | None = None,  # [H, W] bool: only these count
) -> Contributions:
    """Sum and maximum of every Gaussian's blend weights."""
    binned = _project_and_bin(gaussians, camera, settings)
    counted = np.ones((camera.height, camera.width), np.float32) if pixels is None else pixels.astype(np.float32)
    sums, peaks = np.zeros((2, len(binned.entries)), np.float32)
    _over_tiles(weigh_range, binned, camera, binned.features, counted, sums, peaks)
    total, peak = np.zeros((2, len(binned.rows)), np.float32)
    gather_weights(binned.entries, sums, peaks, total, peak)
    everything = np.zeros((2, len(gaussians)), np.float32)
    everything[0, binned.rows], everything[1, binned.rows] = total, peak
    return Contributions(everything[0], everything[1])


def _draw(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings,
    passes: frozenset[str],
    colours: np.ndarray | None,  # [N, 3], instead of SH
) -> Rendering:
    unknown = passes - ALL_PASSES
    if unknown:
        raise ValueError(f"unknown passes {sorted(unknown)}; there are {sorted(ALL_PASSES)}")
    with_depth, with_normals = "depth" in passes, "normal" in passes
    binned = _project_and_bin(gaussians, camera, settings)
    if colours is not None:
        binned.features[:, RED : BLUE + 1] = colours[binned.rows]
    image = np.empty((PLANES, camera.height, camera.width), np.float32)
    _over_tiles(blend_range, binned, camera, binned.features, with_depth, with_normals, image)
    alpha = 1.0 - image[TRANSMITTANCE]
    background = np.asarray(settings.background, np.float32)
    rgb = np.moveaxis(image[OUT_RED : OUT_RED + 3], 0, -1) + image[TRANSMITTANCE][..., None] * background
    empty = np.zeros(0, np.float32)
    expected = median = normals = empty
    if with_depth:
        expected = np.divide(image[OUT_DEPTH], alpha, out=np.zeros_like(alpha), where=alpha > 1e-6)
        median = image[OUT_MEDIAN]
    if with_normals:
        summed = np.moveaxis(image[OUT_NORMAL : OUT_NORMAL + 3], 0, -1)
        length = np.linalg.norm(summed, axis=-1, keepdims=True)
        normals = np.divide(summed, length, out=np.zeros_like(summed), where=length > 1e-6)
    return Rendering(rgb, alpha, expected, median, normals, len(gaussians) - len(binned.rows))


def _project_and_bin(gaussians: Gaussians, camera: Camera, settings: RasterSettings) -> _Binned:
    rows = np.flatnonzero(gaussians.usable)
    scales = gaussians.scales
    if gaussians.is_surfels:
        scales = np.concatenate([scales, np.full((len(scales), 1), FLAT, np.float32)], axis=1)
    features = np.empty((len(rows), FEATURES), np.float32)
    rects, tiles = np.empty((len(rows), 4), np.int32), np.zeros(len(rows), np.int32)
    run_ranges(
        project_range,
        len(rows),
        rows,
        np.ascontiguousarray(gaussians.means, np.float32),
        np.ascontiguousarray(scales, np.float32),
        np.ascontiguousarray(gaussians.quats, np.float32),
        np.ascontiguousarray(gaussians.opacity, np.float32),
        np.ascontiguousarray(pad_sh(gaussians.sh, gaussians.sh.shape[1]), np.float32),
        _pack_camera(camera),
        camera.width,
        camera.height,
        np.float32(settings.near),
        np.float32(settings.low_pass),
        gaussians.antialiased,
        features,
        rects,
        tiles,
    )
    depth = np.ascontiguousarray(features[:, DEPTH])
    starts, entries = tile_lists(depth, rects, tiles, camera.width, camera.height)
    return _Binned(rows, features, starts, entries)


def _pack_camera(camera: Camera) -> np.ndarray:
    """What project_range reads: pose, intrinsics, centre and the clamp of the Jacobian (gsplat's, off-centre K)."""
    margin = (float(FRUSTUM) - 1) * 0.5
    w, h = camera.width, camera.height
    limits = [
        (-camera.cx - margin * w) / camera.fx,
        (w - camera.cx + margin * w) / camera.fx,
        (-camera.cy - margin * h) / camera.fy,
        (h - camera.cy + margin * h) / camera.fy,
    ]
    intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy]
    return np.concatenate([camera.R.ravel(), camera.t, intrinsics, camera.centre, limits]).astype(np.float32)


def _over_tiles(kernel_range: Callable[..., Any], binned: _Binned, camera: Camera, *args: Any) -> None:
    """Run a tile kernel over all tiles: the longest first, dealt round-robin, so that threads end together."""
    across = -(-camera.width // TILE)
    order = np.argsort(-np.diff(binned.starts), kind="stable")
    chunks = 1 if thread_count() == 1 else 6 * thread_count()
    dealt = [np.ascontiguousarray(order[k::chunks]) for k in range(chunks)]
    parallel_map(
        lambda ids: kernel_range(
            0, len(ids), ids, across, camera.width, camera.height, binned.starts, binned.entries, *args
        ),
        dealt,
    )

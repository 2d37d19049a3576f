"""Where the rays of a picture meet the surface: the depth map that geometry is built on.

A rasteriser's depth is that of Gaussians' centres, so a large slanted splat draws a flat step. Here each pixel's median
Gaussian, the one that blocks half of the light, is met where the ray passes through the most of it (Yu 2024, Gaussian
Opacity Fields; Zhang 2024, RaDe-GS): on a flat splat that is the ray's intersection with its plane. A ball has no slope
and is met at its centre; what lies between the two, between them.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float64

from ..camera import Camera
from ..gaussians import Gaussians
from ..jit import exact_kernel
from ..threads import run_ranges
from . import cpu
from .bin import tile_lists
from .project import DEPTH, exp64, rotation
from .types import RasterSettings

REACH = 3.0  # standard deviations from its centre, along z, within which a Gaussian is met
MEDIAN_ONLY = np.array([False, False, True, False, False])  # blend_range's flags


def surface_depth(
    gaussians: Gaussians, camera: Camera, settings: RasterSettings, pixels: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    view = cpu.project(gaussians, camera, settings, with_colour=False)
    slots, wanted = cpu.wanted_tiles(camera, pixels)
    lists = tile_lists(view.features, view.rects, view.states, slots, with_records=False)
    if not gaussians.is_surfels:  # their numbers, from 1 on, are drawn in place of the depths
        view.features.view(np.int32)[:, DEPTH] = np.arange(1, len(gaussians) + 1)
    shifts = np.ones(len(wanted), np.float32)
    pictures, _ = cpu.blend(
        gaussians, view, camera, settings, MEDIAN_ONLY, view.features, lists, wanted, shifts, keep=False
    )
    drawn = cpu.as_rendering(pictures, camera, view.ignored)
    if gaussians.is_surfels:
        return drawn.median_depth, drawn.alpha
    depth = np.zeros(drawn.alpha.shape, np.float32)
    run_ranges(
        _meet_range,
        depth.size,
        drawn.median_depth.view(np.int32).reshape(-1),
        int(camera.width),
        cpu.raw(gaussians.means),
        cpu.raw(gaussians.log_scales),
        cpu.raw(gaussians.quats),
        cpu.pack_camera(camera),
        float(settings.low_pass),
        depth.reshape(-1),
    )
    return depth, drawn.alpha


@exact_kernel
def _meet_range(
    lo,
    hi,
    numbers,  # [H W] int32: 1 + the Gaussian that the pixel shows, 0 for none
    width,
    means,  # [N, 3]
    log_scales,  # [N, 3]
    quats,  # [N, 4]
    camera,  # [23] as project_range reads it
    low_pass,  # px²
    depth,  # [H W] float32 out
):
    """z at which the rays of pixels lo … hi−1 pass through the most of their Gaussian."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = (
        camera[0], camera[1], camera[2], camera[3], camera[4], camera[5], camera[6], camera[7], camera[8],
    )  # fmt: skip
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    for pixel in range(lo, hi):
        i = numbers[pixel] - 1
        if i < 0:
            continue
        dx, dy = (pixel % width + 0.5 - cx) / fx, (pixel // width + 0.5 - cy) / fy
        mx, my, mz = float64(means[i, 0]), float64(means[i, 1]), float64(means[i, 2])
        x = r00 * mx + r01 * my + r02 * mz + camera[9]
        y = r10 * mx + r11 * my + r12 * mz + camera[10]
        z = r20 * mx + r21 * my + r22 * mz + camera[11]
        q00, q01, q02, q10, q11, q12, q20, q21, q22 = rotation(
            float64(quats[i, 0]), float64(quats[i, 1]), float64(quats[i, 2]), float64(quats[i, 3])
        )
        blur = low_pass * z * z / (fx * fy)  # the low-pass as a ball: what is thinner than a pixel has no slope
        along, squared, spread = 0.0, 0.0, 0.0
        least, most, total = math.inf, 0.0, 0.0  # variances along the axes
        for a0, a1, a2, log_scale in (
            (q00, q10, q20, log_scales[i, 0]),
            (q01, q11, q21, log_scales[i, 1]),
            (q02, q12, q22, log_scales[i, 2]),
        ):  # the Gaussian's axes: the ray and the centre in units of the standard deviation there
            ax, ay, az = r00 * a0 + r01 * a1 + r02 * a2, r10 * a0 + r11 * a1 + r12 * a2, r20 * a0 + r21 * a1 + r22 * a2
            variance = exp64(2.0 * float64(log_scale)) + blur
            ray = ax * dx + ay * dy + az
            along += ray * (ax * x + ay * y + az * z) / variance
            squared += ray * ray / variance
            spread += az * az * variance
            least, most, total = min(least, variance), max(most, variance), total + variance
        reach = REACH * math.sqrt(spread)
        slope = min(max(along / squared - z, -reach), reach)
        flatness = 1.0 - least / max(total - least - most, least)
        depth[pixel] = max(z + flatness * slope, 0.0)

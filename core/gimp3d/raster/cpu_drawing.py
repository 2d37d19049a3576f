"""A scene projected into a view once, to be drawn in several ways, all of it or a part.

A rasteriser's depth is that of Gaussians' centres, so a large slanted splat draws a flat step. For the surface, which
geometry is built on, each pixel's median Gaussian, the one that blocks half of the light, is met where the ray passes
through the most of it (Yu 2024, Gaussian Opacity Fields; Zhang 2024, RaDe-GS): on a flat splat that is the ray's
intersection with its plane. A ball has no slope and is met at its centre; what lies between the two, between them.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numba import float64, int64

from ..camera import Camera
from ..compute.jit import exact_kernel
from ..compute.simd import exp64
from ..compute.threads import run_ranges
from ..gaussians import Gaussians
from . import cpu
from .bin import TileLists
from .project import RED
from .staging import rotation, to_camera
from .types import Mask, RasterSettings, Rendering

NUMBERS_ONLY = (False, False, True, False, True)  # blend_range's flags
REACH = 3.0  # standard deviations from its centre, along z, within which a Gaussian is met


class Drawing:
    """A view of a scene, made ready once and drawn in several ways; see `drawing`."""

    def __init__(
        self, gaussians: Gaussians, camera: Camera, settings: RasterSettings, with_colour: bool, pixels: Mask
    ) -> None:
        self.gaussians, self.camera, self.with_colour = gaussians, camera, with_colour
        flags = (with_colour, False, False, False, False)
        self._made = cpu.prepare(gaussians, camera, settings, flags, pixels, with_records=False)

    def render(self, passes: frozenset[str], pixels: Mask = None) -> Rendering:
        """As `render`; of the drawing's own pixels only those given."""
        flags = cpu.pass_flags(passes)
        if flags[0] and not self.with_colour:
            raise ValueError("this drawing has no colours")
        if pixels is None:
            return self._draw(flags)
        there = cpu.wanted_blocks(pixels).ravel()[self._made.lists.tiles]
        return self._draw(flags, wanted=self._made.wanted & there)

    def surface_depth(self, gone: Mask = None) -> tuple[np.ndarray, np.ndarray]:
        """As `surface_depth`, without some Gaussians ([N] bool)."""
        lists = self._made.lists if gone is None else _without(self._made.lists, gone)
        shifts = cpu.depth_shifts(lists, self._made.features)
        if self.gaussians.is_surfels:
            drawn = self._draw(cpu.pass_flags(frozenset({"depth"})), lists=lists, shifts=shifts)
            return drawn.median_depth, drawn.alpha
        drawn = self._draw(NUMBERS_ONLY, lists=lists, shifts=shifts)
        depth, numbers = np.zeros(drawn.alpha.shape, np.float32), drawn.median_depth.view(np.int32)
        means, log_scales, quats, _, _ = cpu.values_of(self.gaussians)
        camera, low_pass = cpu.pack_camera(self.camera), float(self._made.settings.low_pass)
        run_ranges(_meet_range, len(depth), numbers, means, log_scales, quats, camera, low_pass, depth)
        return depth, drawn.alpha

    def footprint(self, chosen: np.ndarray) -> np.ndarray:
        """As `footprint`; only for drawings without colours."""
        return self.footprints(chosen)[0]

    def footprints(self, *chosen: np.ndarray) -> tuple[np.ndarray, ...]:
        """Those of up to three sets, at the cost of one."""
        if not 1 <= len(chosen) <= 3:
            raise ValueError(f"chosen: expected one to three sets, got {len(chosen)}")
        for one in chosen:
            if one.shape != (len(self.gaussians),):
                raise ValueError(f"chosen: expected shape {(len(self.gaussians),)}, got {one.shape}")
        if self.with_colour:
            raise ValueError("footprint: this drawing has colours; make one without")
        for channel, one in enumerate((*chosen, *[chosen[-1]] * (3 - len(chosen)))):
            _paint(self._made.lists.entries, one, RED + channel, self._made.features)
        black = replace(self._made.settings, background=(0.0, 0.0, 0.0))
        rgb = self._draw(cpu.pass_flags(frozenset({"rgb"})), settings=black).rgb
        return tuple(np.ascontiguousarray(rgb[..., k]) for k in range(len(chosen)))

    def _draw(self, flags: cpu.Flags, **changed: Any) -> Rendering:
        return cpu.blend(replace(self._made, flags=flags, **changed), keep=False)[0]


def _without(lists: TileLists, gone: np.ndarray) -> TileLists:
    """The lists without some Gaussians [N] bool."""
    stays = ~gone[lists.entries]
    before = np.concatenate([[0], np.cumsum(stays)])  # entries that stay, before each
    return replace(lists, starts=before[lists.starts], stops=before[lists.stops], entries=lists.entries[stays])


@exact_kernel
def _paint(entries, chosen, channel, features):
    """A channel of the listed Gaussians: 1 if they are chosen, else 0."""
    for k in range(len(entries)):
        features[entries[k], channel] = 1.0 if chosen[entries[k]] else 0.0


@exact_kernel
def _meet_range(lo, hi, numbers, means, log_scales, quats, camera, low_pass, depth):
    """z at which the rays of rows lo … hi−1 pass through the most of their Gaussian: `depth` [H, W] float32, out.

    `numbers` [H, W] int32: 1 + the Gaussian that the pixel shows, 0 for none; `low_pass` in px²; the others as for
    project_range.
    """
    r = (camera[0], camera[1], camera[2], camera[3], camera[4], camera[5], camera[6], camera[7], camera[8])
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    axes = np.empty((3, 5))  # of the Gaussian met last: direction, the centre along it, 1 / variance
    met, z, reach, flatness = int64(-1), 0.0, 0.0, 0.0
    for row in range(lo, hi):
        dy = (row + 0.5 - cy) / fy
        for column in range(numbers.shape[1]):
            i = int64(numbers[row, column]) - 1
            if i < 0:
                continue
            if i != met:  # neighbours mostly show the same one
                met = i
                mx, my, mz = float64(means[i, 0]), float64(means[i, 1]), float64(means[i, 2])
                x, y, z = to_camera(r, mx, my, mz)
                x, y, z = x + camera[9], y + camera[10], z + camera[11]
                q00, q01, q02, q10, q11, q12, q20, q21, q22 = rotation(
                    float64(quats[i, 0]), float64(quats[i, 1]), float64(quats[i, 2]), float64(quats[i, 3])
                )
                blur = low_pass * z * z / (fx * fy)  # the low-pass as a ball: what is thinner than a pixel has no slope
                spread, least, most, total = 0.0, math.inf, 0.0, 0.0  # the last three: variances along the axes
                for k, (a0, a1, a2) in enumerate(((q00, q10, q20), (q01, q11, q21), (q02, q12, q22))):
                    ax, ay, az = to_camera(r, a0, a1, a2)
                    variance = exp64(2.0 * float64(log_scales[i, k])) + blur
                    axes[k, 0], axes[k, 1], axes[k, 2], axes[k, 3] = ax, ay, az, ax * x + ay * y + az * z
                    axes[k, 4] = 1.0 / variance
                    spread += az * az * variance
                    least, most, total = min(least, variance), max(most, variance), total + variance
                reach = REACH * math.sqrt(spread)
                flatness = 1.0 - least / max(total - least - most, least)
            dx = (column + 0.5 - cx) / fx
            along, squared = 0.0, 0.0
            for k in range(3):  # the ray and the centre in units of the standard deviation along each axis
                ray = axes[k, 0] * dx + axes[k, 1] * dy + axes[k, 2]
                along += ray * axes[k, 3] * axes[k, 4]
                squared += ray * ray * axes[k, 4]
            slope = min(max(along / squared - z, -reach), reach)
            depth[row, column] = max(z + flatness * slope, 0.0)

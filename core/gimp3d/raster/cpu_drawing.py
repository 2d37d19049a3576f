"""A scene projected into a view once, to be drawn in several ways, all of it or a part."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..camera import Camera
from ..compute.jit import exact_kernel
from ..compute.threads import run_ranges
from ..gaussians import Gaussians
from . import cpu
from .bin import TileLists
from .project import BLUE, RED
from .surface import meet_range
from .types import Mask, RasterSettings, Rendering

NUMBERS_ONLY = (False, False, True, False, True)  # blend_range's flags


class CpuDrawing:
    """See `Drawing`. Not for two threads at once."""

    def __init__(
        self, gaussians: Gaussians, camera: Camera, settings: RasterSettings, with_colour: bool, pixels: Mask
    ) -> None:
        self.gaussians, self.camera, self.with_colour = gaussians, camera, with_colour
        flags = (with_colour, False, False, False, False)
        self._made = cpu.prepare(gaussians, camera, settings, flags, pixels, with_records=False)

    def render(self, passes: frozenset[str], pixels: Mask = None) -> Rendering:
        flags = cpu.pass_flags(passes)
        if flags[0] and not self.with_colour:
            raise ValueError("this drawing has no colours")
        if pixels is None:
            return self._draw(flags)
        there = cpu.wanted_blocks(pixels).ravel()[self._made.lists.tiles]
        return self._draw(flags, wanted=self._made.wanted & there)

    def surface_depth(self, gone: Mask = None) -> tuple[np.ndarray, np.ndarray]:
        lists = self._made.lists if gone is None else _without(self._made.lists, gone)
        shifts = cpu.depth_shifts(lists, self._made.features)
        if self.gaussians.is_surfels:
            drawn = self._draw(cpu.pass_flags(frozenset({"depth"})), lists=lists, shifts=shifts)
            return drawn.median_depth, drawn.alpha
        drawn = self._draw(NUMBERS_ONLY, lists=lists, shifts=shifts)
        depth, numbers = np.zeros(drawn.alpha.shape, np.float32), drawn.median_depth.view(np.int32)
        means, log_scales, quats, _, _ = cpu.values_of(self.gaussians)
        camera, low_pass = cpu.pack_camera(self.camera), float(self._made.settings.low_pass)
        run_ranges(meet_range, len(depth), numbers, means, log_scales, quats, camera, low_pass, depth)
        return depth, drawn.alpha

    def footprint(self, chosen: np.ndarray) -> np.ndarray:
        if chosen.shape != (len(self.gaussians),):
            raise ValueError(f"chosen: expected shape {(len(self.gaussians),)}, got {chosen.shape}")
        if self.with_colour:
            raise ValueError("footprint: this drawing has colours; make one without")
        _paint(self._made.lists.entries, chosen, self._made.features)
        black = replace(self._made.settings, background=(0.0, 0.0, 0.0))
        return np.ascontiguousarray(self._draw(cpu.pass_flags(frozenset({"rgb"})), settings=black).rgb[..., 0])

    def _draw(self, flags: cpu.Flags, **changed: Any) -> Rendering:
        return cpu.blend(replace(self._made, flags=flags, **changed), keep=False)[0]


def _without(lists: TileLists, gone: np.ndarray) -> TileLists:
    """The lists without some Gaussians [N] bool."""
    stays = ~gone[lists.entries]
    before = np.concatenate([[0], np.cumsum(stays)])  # entries that stay, before each
    return replace(lists, starts=before[lists.starts], stops=before[lists.stops], entries=lists.entries[stays])


@exact_kernel
def _paint(entries, chosen, features):
    """The listed Gaussians white if they are chosen, else black."""
    for k in range(len(entries)):
        for channel in range(RED, BLUE + 1):
            features[entries[k], channel] = 1.0 if chosen[entries[k]] else 0.0

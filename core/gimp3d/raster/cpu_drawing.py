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
from .bin import TileLists, tile_lists
from .project import BLUE, RED
from .surface import meet_range
from .types import Mask, RasterSettings, Rendering

NUMBERS_ONLY = (False, False, True, False, False, True)  # blend_range's flags


class CpuDrawing:
    """See `Drawing`. Not for two threads at once."""

    def __init__(
        self, gaussians: Gaussians, camera: Camera, settings: RasterSettings, with_colour: bool, pixels: Mask
    ) -> None:
        self.gaussians, self.camera, self.settings, self.with_colour = gaussians, camera, settings, with_colour
        self._slots, self._wanted = cpu.wanted_tiles(camera, pixels)
        self._view = view = cpu.project(gaussians, camera, settings, with_colour, self._slots)
        self._lists = tile_lists(view.features, view.rects, view.states, self._slots, with_records=False)

    def render(self, passes: frozenset[str], pixels: Mask = None) -> Rendering:
        flags = cpu.pass_flags(passes)
        if flags[0] and not self.with_colour:
            raise ValueError("this drawing has no colours")
        if pixels is None:
            return self._draw(flags, self._wanted)
        blocks = cpu.wanted_blocks(self.camera, np.require(pixels, bool, ["C", "W"]).view(np.uint8))
        return self._draw(flags, self._wanted & blocks[self._slots >= 0])

    def surface_depth(self, gone: Mask = None) -> tuple[np.ndarray, np.ndarray]:
        lists = self._lists if gone is None else _without(self._lists, gone)
        if self.gaussians.is_surfels:
            drawn = self._draw(cpu.pass_flags(frozenset({"depth"})), self._wanted, lists)
            return drawn.median_depth, drawn.alpha
        drawn = self._draw(NUMBERS_ONLY, self._wanted, lists)
        depth, numbers = np.zeros(drawn.alpha.shape, np.float32), drawn.median_depth.view(np.int32)
        means, log_scales, quats, _, _ = cpu.values_of(self.gaussians)
        camera, low_pass = cpu.pack_camera(self.camera), float(self.settings.low_pass)
        run_ranges(meet_range, len(depth), numbers, means, log_scales, quats, camera, low_pass, depth)
        return depth, drawn.alpha

    def footprint(self, chosen: np.ndarray) -> np.ndarray:
        if chosen.shape != (len(self.gaussians),):
            raise ValueError(f"chosen: expected shape {(len(self.gaussians),)}, got {chosen.shape}")
        if self.with_colour:
            raise ValueError("footprint: this drawing has colours; make one without")
        _paint(self._lists.entries, chosen, self._view.features)
        drawn = self._draw(cpu.pass_flags(frozenset({"rgb"})), self._wanted, background=(0.0, 0.0, 0.0))
        return np.ascontiguousarray(drawn.rgb[..., 0])

    def _draw(
        self, flags: tuple[bool, ...], wanted: np.ndarray, lists: TileLists | None = None, **changed: Any
    ) -> Rendering:
        """Draw the wanted blocks, of the drawing's lists and with its settings where no others are given."""
        view, lists, settings = self._view, lists or self._lists, replace(self.settings, **changed)
        shifts = cpu.depth_shifts(lists, view.features)
        traced = cpu.Trace(self.gaussians, view, self.camera, settings, flags, lists, view.features, wanted, shifts)
        return cpu.blend(traced, keep=False)[0]


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

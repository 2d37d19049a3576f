"""A part of a view where some Gaussians change from one rendering to the next, and the rest of the scene does not.

What does not change is projected, dealt into tiles and, where it pays, blended only once: in every tile the frozen
Gaussians before the nearest active one, and those behind the farthest, are kept per pixel as a layer in front and a
layer behind. Only what lies between is blended again. When an active Gaussian leaves a tile's slab of depths, that
tile's layers are made anew.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..camera import Camera
from ..compute.jit import exact_kernel
from ..gaussians import Gaussians
from . import cpu
from .bin import TileLists, tile_lists
from .blend import TILE_STATE, blend_range
from .project import DEPTH, Projected
from .types import Gradients, PictureGradients, RasterSettings, Rendering

SLAB_MARGIN = 0.02  # of the depth: how far active Gaussians may move before layers are made anew
WORTH_LAYERS = 0.5  # a tile gets layers if its slab holds fewer of its frozen entries than this


class PixelRegion:
    """A part of a view where some Gaussians change and the rest does not; see `pixel_region`.

    The layers need no median depth: with the pass `depth`, everything in the tiles is blended every time.
    """

    def __init__(
        self, frozen: Gaussians, camera: Camera, pixels: np.ndarray, settings: RasterSettings, passes: frozenset[str]
    ) -> None:
        self.camera, self.settings, self.passes = camera, settings, passes
        self._flags = cpu.pass_flags(passes)
        self._slots, self._wanted = cpu.wanted_tiles(camera, pixels)
        view = cpu.project(frozen, camera, settings, self._flags[0])
        self._ignored = view.ignored
        lists = tile_lists(view, self._slots, with_records=False)
        rows, entries = np.unique(lists.entries, return_inverse=True)
        self._frozen_count, self._surfels = len(rows), frozen.is_surfels
        self._features = view.features[rows]
        self._lists = replace(lists, entries=entries.astype(np.int32).ravel())
        self._depths = np.ascontiguousarray(self._features[self._lists.entries, DEPTH])
        self._shifts = cpu.depth_shifts(self._lists, self._features)
        slots = len(self._wanted)
        self._layered = np.zeros(slots, bool)
        self._near, self._far = np.empty((2, slots), np.float32)  # the slabs of depths that the layers leave out
        self._slab_starts, self._slab_stops = lists.starts.copy(), lists.stops.copy()
        self._front, self._back = np.empty((2, 0 if self._flags[2] else slots, TILE_STATE), np.float32)
        self._renderings = 0

    def render(self, active: Gaussians) -> Rendering:
        """The region with the active Gaussians in it, as if they followed the frozen ones in one scene."""
        return self._draw(active, keep=False)[0]

    def trace(self, active: Gaussians) -> tuple[Rendering, RegionTrace]:
        """As `render`, and the way back to the active Gaussians, open until the region is rendered again."""
        return self._draw(active, keep=True)

    def _draw(self, active: Gaussians, keep: bool) -> tuple[Rendering, RegionTrace]:
        if active.is_surfels != self._surfels:
            raise ValueError("cannot draw 3D Gaussians and surfels together")
        self._renderings += 1
        frozen, needed = self._frozen_count, self._frozen_count + len(active)
        if len(self._features) != needed:  # the active ones' rows lie behind the frozen ones'
            before, self._features = self._features, np.empty((needed, self._features.shape[1]), np.float32)
            self._features[:frozen] = before[:frozen]
        drawn = self._features[frozen:]
        view = cpu.project(active, self.camera, self.settings, self._flags[0], features=drawn)
        lists = tile_lists(view, self._slots, with_records=keep)
        if len(self._front):
            self._renew_layers(view, lists)
        given = self._flags, self._merge(view, lists), self._features, self._wanted, self._shifts, self._back
        picture, kept = cpu.blend(cpu.Trace(active, view, self.camera, self.settings, *given), keep, self._front)
        picture = replace(picture, ignored=self._ignored + picture.ignored)
        return picture, RegionTrace(self, self._renderings, kept)

    def _renew_layers(self, view: Projected, lists: TileLists) -> None:
        """Make the layers of tiles whose active Gaussians have left the slab of depths that they were made for."""
        filled = np.flatnonzero(lists.stops > lists.starts)
        near, far = np.full((2, len(lists.tiles)), np.nan, np.float32)
        near[filled] = view.features[lists.entries[lists.starts[filled]], DEPTH]
        far[filled] = view.features[lists.entries[lists.stops[filled] - 1], DEPTH]
        stale = np.flatnonzero(~self._layered | (near < self._near) | (far > self._far))
        if not len(stale):
            return
        starts, stops = self._lists.starts[stale], self._lists.stops[stale]
        empty = np.isnan(near[stale])
        self._near[stale] = np.where(empty, np.inf, near[stale] * np.float32(1 - SLAB_MARGIN))
        self._far[stale] = np.where(empty, -np.inf, far[stale] * np.float32(1 + SLAB_MARGIN))
        slab_starts, slab_stops = np.empty_like(starts), np.empty_like(stops)
        _find_slabs(self._depths, starts, stops, self._near[stale], self._far[stale], slab_starts, slab_stops)
        whole = slab_stops - slab_starts > WORTH_LAYERS * (stops - starts)
        slab_starts[whole], slab_stops[whole] = starts[whole], stops[whole]
        self._near[stale[whole]], self._far[stale[whole]] = 0.0, np.inf
        self._slab_starts[stale], self._slab_stops[stale], self._layered[stale] = slab_starts, slab_stops, True
        self._front[stale] = self._layer(stale, starts, slab_starts)
        self._back[stale] = self._layer(stale, slab_stops, stops)

    def _layer(self, slots: np.ndarray, starts: np.ndarray, stops: np.ndarray) -> np.ndarray:
        """The state of the slots' tiles after a part of their frozen entries, [·, TILE_STATE]."""
        states = np.empty((len(slots), TILE_STATE), np.float32)
        lists = replace(self._lists, tiles=self._lists.tiles[slots], starts=starts, stops=stops)
        how = self._features, self._surfels, cpu.pack_limits(self.settings), self._wanted[slots], self._shifts[slots]
        given = *how, np.zeros(3, np.float32), cpu.NO_STATES
        kept = cpu.NO_MASKS, cpu.NO_MASKS, np.empty(len(slots), np.int64), states
        cpu.over_tiles(blend_range, lists, self.camera, given, kept, self._flags, cpu.NO_STATES, cpu.NO_PICTURES)
        return states

    def _merge(self, view: Projected, lists: TileLists) -> TileLists:
        """Frozen entries of the slabs and active ones in one list, by depth, frozen first where that is equal."""
        counts = (self._slab_stops - self._slab_starts) + (lists.stops - lists.starts)
        stops = np.cumsum(counts)
        starts, entries = stops - counts, np.empty(int(counts.sum()), np.int32)
        records = np.empty(len(entries) if len(lists.records) else 0, np.int64)
        frozen = self._slab_starts, self._slab_stops, self._lists.entries, self._depths
        active = lists.starts, lists.stops, lists.entries, lists.records, view.features
        _merge_lists(frozen, active, self._frozen_count, starts, entries, records)
        return TileLists(lists.tiles, starts, stops, entries, records, lists.spans)


@dataclass(frozen=True)
class RegionTrace:
    """The way back from a rendering of a region."""

    region: PixelRegion
    rendering: int  # which of the region's renderings
    traced: cpu.Trace

    def backward(self, gradients: PictureGradients) -> Gradients:
        """The gradient with respect to the active Gaussians; a RuntimeError if the region has been rendered again, as
        its rows are those of the later rendering."""
        if self.region._renderings != self.rendering:
            raise RuntimeError("backward: the region has been rendered again since")
        return self.traced.backward(gradients)


@exact_kernel
def _find_slabs(depths, starts, stops, near, far, slab_starts, slab_stops):
    """Of each slot's entries, which are in order of depth: the first not before `near`, the first behind `far`."""
    for s in range(len(starts)):
        entry = starts[s]
        while entry < stops[s] and depths[entry] < near[s]:
            entry += 1
        slab_starts[s] = entry
        while entry < stops[s] and depths[entry] <= far[s]:
            entry += 1
        slab_stops[s] = entry


@exact_kernel
def _merge_lists(frozen, active, offset, starts, entries, records):
    a_starts, a_stops, a_entries, a_depths = frozen
    b_starts, b_stops, b_entries, b_records, b_features = active
    for s in range(len(starts)):
        a, b = a_starts[s], b_starts[s]
        for place in range(starts[s], starts[s] + a_stops[s] - a + b_stops[s] - b):
            if a < a_stops[s] and (b == b_stops[s] or a_depths[a] <= b_features[b_entries[b], DEPTH]):
                entries[place] = a_entries[a]
                a += 1
            else:
                entries[place] = offset + b_entries[b]
                if len(records):
                    records[place] = b_records[b]
                b += 1

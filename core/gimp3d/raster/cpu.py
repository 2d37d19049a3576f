"""The CPU rasteriser: project → bin → blend, and back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from ..camera import Camera
from ..compute.jit import announce_compilation
from ..compute.threads import parallel_map, run_ranges, thread_count
from ..gaussians import ARRAYS, Gaussians
from ..geometry import Window, bounds
from ..geometry import pack_camera as pack_pinhole
from .bin import TileLists, mark_touched, tile_lists
from .blend import BLOCK, CHECK, TILE_STATE, blend_range, gather_weights, weigh_range
from .project import DEPTH, DRAWN, ELLIPSE_ROW, HALF_LOG2E, SURFEL_ROW, TILE, Projected, project_range
from .types import PASSES, Gradients, Mask, PictureGradients, RasterSettings, Rendering
from .unblend import RECORD, unblend_range
from .unproject import unproject_range

FRUSTUM_MARGIN = 0.3  # the Jacobian is evaluated no further out than 1.3 × the half frustum (Kerbl 2023, gsplat)
Flags = tuple[bool, ...]  # blend_range's
NO_STATES = np.empty((0, TILE_STATE), np.float32)
NO_MASKS = np.empty(0, np.uint64)
NO_PICTURES = (np.empty(0, np.float32),) * 5


def project(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings,
    with_colour: bool,
    slots: np.ndarray | None = None,
    features: np.ndarray | None = None,
) -> Projected:
    """Feature rows of the Gaussians that reach the picture, or what slots there are; into `features` if given."""
    announce_compilation()
    n, low_pass = len(gaussians), settings.surfel_low_pass if gaussians.is_surfels else settings.low_pass
    if features is None:
        features = np.empty((n, SURFEL_ROW if gaussians.is_surfels else ELLIPSE_ROW), np.float32)
    out = Projected(features, np.empty((n, 4), np.int16), np.empty(n, np.int8))
    grid = tile_grid(camera)
    wanted = np.ones(grid[::-1], bool) if slots is None else slots >= 0
    (top, bottom), (left, right) = ((rows.start, rows.stop) for rows in bounds(wanted))
    tiles = np.array([left, top, right, bottom, *grid], np.int64)
    limits = float(settings.near), float(low_pass), float(settings.alpha_min), bool(gaussians.antialiased)
    given = values_of(gaussians), pack_camera(camera), tiles, limits, with_colour
    run_ranges(project_range, n, *given, out.features, out.rects, out.states)
    return out


def raw(values: np.ndarray) -> np.ndarray:
    """The values as kernels always get them: another layout, or read-only memory, would compile them anew."""
    return np.require(values, np.float32, ["C", "A", "W"])


def values_of(gaussians: Gaussians) -> tuple[np.ndarray, ...]:
    """What is stored of Gaussians, in the order in which all kernels take it and give gradients."""
    return tuple(raw(getattr(gaussians, name)) for name in ARRAYS)


def tile_grid(camera: Camera) -> tuple[int, int]:
    """Tiles (across, down) of a camera's picture."""
    return -(-int(camera.width) // TILE), -(-int(camera.height) // TILE)


def pack_camera(camera: Camera) -> np.ndarray:
    """What project_range reads of a camera, [22] float64; the Jacobian's bounds are gsplat's."""
    margin_x, margin_y = 0.5 * FRUSTUM_MARGIN * camera.width, 0.5 * FRUSTUM_MARGIN * camera.height
    across = (-camera.cx - margin_x) / camera.fx, (camera.width - camera.cx + margin_x) / camera.fx
    down = (-camera.cy - margin_y) / camera.fy, (camera.height - camera.cy + margin_y) / camera.fy
    return np.concatenate([pack_pinhole(camera), across, down])


def pass_flags(passes: frozenset[str]) -> Flags:
    """blend_range's flags; a ValueError if a pass is unknown."""
    if unknown := passes - PASSES:
        raise ValueError(f"unknown passes {sorted(unknown)}; there are {sorted(PASSES)}")
    either_depth = bool(passes & {"depth", "expected_depth"})
    return ("rgb" in passes, either_depth, "depth" in passes, "normal" in passes, False)


def pack_limits(settings: RasterSettings) -> tuple[np.float32, ...]:
    """blend_range's limits."""
    disc = HALF_LOG2E / settings.surfel_low_pass
    limits = (settings.alpha_min, settings.alpha_max, settings.stop, settings.near, disc)
    return tuple(np.float32(value) for value in limits)


def padded_size(camera: Camera) -> tuple[int, int]:
    """Height and width of the kernels' pictures: whole blocks."""
    return -(-int(camera.height) // BLOCK) * BLOCK, -(-int(camera.width) // BLOCK) * BLOCK


def padded(picture: np.ndarray, camera: Camera) -> np.ndarray:
    """A picture as kernels read it: flat, of whole blocks; empty if it has no pixels."""
    if not picture.size:
        return np.empty(0, np.float32)
    height, width = padded_size(camera)
    missing = ((0, height - camera.height), (0, width - camera.width), (0, 0))[: picture.ndim]
    return raw(np.pad(picture, missing) if missing[0][1] or missing[1][1] else picture).reshape(-1)


def wanted_tiles(camera: Camera, pixels: Mask) -> tuple[np.ndarray, np.ndarray]:
    """Slots [down, across] int32 of the tiles, and blocks [S] uint64 of each slot, with wanted pixels [H, W] bool."""
    if pixels is None:
        pixels = np.ones((camera.height, camera.width), bool)
    if pixels.shape != (camera.height, camera.width):
        raise ValueError(f"pixels: expected shape {(camera.height, camera.width)}, got {pixels.shape}")
    blocks = wanted_blocks(pixels)
    return slots_of(blocks > 0), blocks[blocks > 0]


def wanted_blocks(pixels: np.ndarray) -> np.ndarray:
    """The blocks of each tile, [down, across] uint64, that hold a pixel [H, W] which is not 0."""
    down, across = (-(-side // TILE) for side in pixels.shape)
    whole = np.zeros((TILE * down, TILE * across), bool)
    whole[: pixels.shape[0], : pixels.shape[1]] = pixels
    blocks = whole.view(np.uint32).reshape(8 * down, BLOCK, 8 * across).any(1)  # 4 pixels of a row at a time
    masks = np.packbits(blocks.reshape(down, 8, across, 8).swapaxes(1, 2), axis=-1, bitorder="little")
    return masks.reshape(down, 8 * across).view(np.uint64)


def slots_of(wanted: np.ndarray) -> np.ndarray:
    """Slots [down, across] int32 of the wanted tiles [down, across] bool in row-major order, −1 elsewhere."""
    return np.where(wanted, np.cumsum(wanted).reshape(wanted.shape) - 1, -1).astype(np.int32)


@dataclass(frozen=True)
class Trace:
    """Lists to blend into a view, and, once they are, what the way back needs."""

    gaussians: Gaussians  # those that get gradients
    view: Projected  # of them
    camera: Camera
    settings: RasterSettings
    flags: Flags
    lists: TileLists
    features: np.ndarray  # [·, 16 or 32] that the lists' entries mean: perhaps frozen ones, then those of `view`
    wanted: np.ndarray  # [S] uint64
    shifts: np.ndarray  # [S] float32, see depth_shifts
    back: np.ndarray = field(default_factory=lambda: NO_STATES)  # [S, TILE_STATE] or empty
    kept: tuple[np.ndarray, ...] = ()  # what blend_range keeps

    def given(self) -> tuple[Any, ...]:
        """As kernels over tiles take it."""
        limits, background = pack_limits(self.settings), np.asarray(self.settings.background, np.float32)
        surfels = self.gaussians.is_surfels
        return self.features, surfels, limits, self.wanted, self.shifts, background, self.back

    def backward(self, gradients: PictureGradients) -> Gradients:
        camera, pictures = self.camera, {f.name: getattr(gradients, f.name) for f in fields(gradients)}
        for name, picture in pictures.items():
            expected = (camera.height, camera.width, *((3,) if name in ("rgb", "normals") else ()))
            if picture.size and picture.shape != expected:
                raise ValueError(f"gradient of {name}: expected shape {expected}, got {picture.shape}")
        given = tuple(padded(picture, camera) for picture in pictures.values())
        wanted = {name: picture.size > 0 for name, picture in pictures.items() if name != "alpha"}
        missing = [name for name, drawn in zip(wanted, self.flags) if wanted[name] and not drawn]
        if missing:
            raise ValueError(f"gradients of {', '.join(missing)}: the rendering has no such pass")
        records = np.empty(len(self.lists.records) * RECORD, np.float32)
        active = len(self.features) - len(self.gaussians), self.lists.records, records
        over_tiles(unblend_range, self.lists, camera, self.given(), self.kept, tuple(wanted.values()), given, *active)
        values = values_of(self.gaussians)
        found = tuple(np.zeros(v.shape, np.float32) for v in values)
        how = pack_camera(camera), float(self.settings.low_pass), bool(self.gaussians.antialiased)
        drawn = self.view.features, self.view.states, self.lists.spans, records
        run_ranges(unproject_range, len(self.gaussians), values, *how, *drawn, found)
        return Gradients(*found)


def depth_shifts(lists: TileLists, features: np.ndarray) -> np.ndarray:
    """A typical depth of each tile, [S] float32: that of the middle entry, 1 without entries."""
    shifts = np.ones(len(lists.tiles), np.float32)
    filled = np.flatnonzero(lists.stops > lists.starts)
    middle = lists.entries[(lists.starts[filled] + lists.stops[filled]) // 2]
    shifts[filled] = features[middle, DEPTH]
    return shifts


def prepare(
    gaussians: Gaussians, camera: Camera, settings: RasterSettings, flags: Flags, pixels: Mask, with_records: bool
) -> Trace:
    """All that is done before blending."""
    slots, wanted = wanted_tiles(camera, pixels)
    view = project(gaussians, camera, settings, flags[0], slots)
    lists = tile_lists(view, slots, with_records)
    shifts = depth_shifts(lists, view.features)
    return Trace(gaussians, view, camera, settings, flags, lists, view.features, wanted, shifts)


def trace(
    gaussians: Gaussians, camera: Camera, settings: RasterSettings, passes: frozenset[str]
) -> tuple[Rendering, Trace]:
    return blend(prepare(gaussians, camera, settings, pass_flags(passes), None, with_records=True), keep=True)


def blend(traced: Trace, keep: bool, front: np.ndarray = NO_STATES) -> tuple[Rendering, Trace]:
    """Blend the lists, behind what is in front, into pictures."""
    slots, entries = len(traced.lists.tiles), len(traced.lists.entries)
    kept = (
        np.empty(entries if keep else 0, np.uint64),
        np.empty(entries // CHECK + slots + 1 if keep else 0, np.uint64),
        np.empty(slots, np.int64),
        np.empty((slots if keep else 0, TILE_STATE), np.float32),
    )
    camera, flags = traced.camera, traced.flags
    sides = [padded_size(camera) if wanted else (0, 0) for wanted in (flags[0], True, *flags[1:4])]
    pictures = [np.zeros(size, np.float32) for size in ((*sides[0], 3), *sides[1:4], (*sides[4], 3))]
    flat = tuple(p.reshape(-1) for p in pictures)
    over_tiles(blend_range, traced.lists, camera, traced.given(), kept, flags, front, flat)
    cut = [np.ascontiguousarray(p[: camera.height, : camera.width]) for p in pictures]
    rgb, alpha, expected, median, normals = cut
    return Rendering(rgb, alpha, expected, median, normals, traced.view.ignored), replace(traced, kept=kept)


def over_tiles(kernel_range: Callable[..., Any], lists: TileLists, camera: Camera, *args: Any) -> None:
    """Run a tile kernel over all slots: longest first, dealt round-robin, so that threads end together."""
    order = np.argsort(lists.starts - lists.stops, kind="stable")
    threads = thread_count()
    chunks = 1 if threads == 1 else min(6 * threads, max(threads, len(order) // 4))
    packed = lists.tiles, tile_grid(camera)[0], padded_size(camera)[1], lists.starts, lists.stops, lists.entries
    parts = [np.ascontiguousarray(order[k::chunks]) for k in range(chunks)]
    parallel_map(lambda part: kernel_range(part, packed, *args), parts)


def weigh(
    gaussians: Gaussians, camera: Camera, settings: RasterSettings, labels: np.ndarray, count: int, rows: Mask
) -> tuple[np.ndarray, np.ndarray]:
    """Sums of blend weights over the pixels of each label, [count, N], and their maximum over all of them, [N]; those
    of other `rows` than the given may be too small."""
    shape = (camera.height, camera.width)
    if labels.shape != shape:
        raise ValueError(f"pixels: expected shape {shape}, got {labels.shape}")
    view = project(gaussians, camera, settings, with_colour=False)
    counted = np.require(labels, np.uint8, ["C", "W"])
    blocks = wanted_blocks(counted)
    wanted = blocks > 0
    if rows is not None:
        touched = np.zeros(wanted.shape, bool)
        mark_touched(view.rects, view.states, rows, touched)
        wanted &= touched
    lists = tile_lists(view, slots_of(wanted), with_records=False)
    sums, peaks = np.zeros((count, len(lists.entries)), np.float32), np.zeros(len(lists.entries), np.float32)
    given = view.features, gaussians.is_surfels, pack_limits(settings), blocks[wanted]
    over_tiles(weigh_range, lists, camera, *given, counted, sums, peaks)
    total, peak = np.zeros((count, len(gaussians)), np.float32), np.zeros(len(gaussians), np.float32)
    gather_weights(lists.entries, sums, peaks, total, peak)
    return total, peak


def touched_window(gaussians: Gaussians, camera: Camera, margin: int) -> Window:
    view = project(gaussians, camera, RasterSettings(), with_colour=False)
    rects = view.rects[view.states == DRAWN]
    if not len(rects):
        return slice(0, 1), slice(0, 1)
    left, top = TILE * rects[:, :2].min(0).astype(int) - margin
    right, bottom = TILE * rects[:, 2:].max(0).astype(int) + margin
    return slice(max(0, top), min(camera.height, bottom)), slice(max(0, left), min(camera.width, right))

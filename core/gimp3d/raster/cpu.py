"""The CPU rasteriser: project → bin → blend, and back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from ..buffers import empty, zeros
from ..camera import Camera
from ..gaussians import Gaussians
from ..jit import announce_compilation
from ..threads import parallel_map, run_ranges, thread_count
from .bin import TileLists, tile_lists
from .blend import BLOCK, CHECK, TILE_STATE, blend_range, gather_weights, region_blocks, weigh_range
from .project import (
    BLUE,
    DEPTH,
    ELLIPSE_ROW,
    HALF_LOG2E,
    RED,
    SURFEL_ROW,
    TILE,
    UNUSABLE,
    project_range,
)
from .types import PASSES, Contributions, Gradients, PictureGradients, RasterSettings, Rendering
from .unblend import RECORD, unblend_range
from .unproject import unproject_range

FRUSTUM_MARGIN = 0.3  # the Jacobian is evaluated no further out than 1.3 × the half frustum (Kerbl 2023, gsplat)
NO_STATES = np.empty((0, TILE_STATE), np.float32)
NO_MASKS = np.empty(0, np.uint64)
CHANNELS = (3, 1, 1, 1, 3, 1)  # of rgb, alpha, expected depth, median depth, normals, distortion
NO_PICTURES = (np.empty(0, np.float32),) * len(CHANNELS)


@dataclass(frozen=True)
class View:
    """Gaussians projected into a camera."""

    features: np.ndarray  # [N, 16 or 32] float32
    rects: np.ndarray  # [N, 4] int16
    states: np.ndarray  # [N] int8

    @property
    def ignored(self) -> int:
        return int(np.count_nonzero(self.states == UNUSABLE))


def project(
    gaussians: Gaussians, camera: Camera, settings: RasterSettings, with_colour: bool, out: View | None = None
) -> View:
    """Feature rows of the Gaussians that reach the picture; into `out` where it is given."""
    announce_compilation()
    n = len(gaussians)
    if out is None:
        features = empty((n, SURFEL_ROW if gaussians.is_surfels else ELLIPSE_ROW), np.float32)
        out = View(features, empty((n, 4), np.int16), empty(n, np.int8))
    sh = raw(gaussians.sh)
    across, down = tile_grid(camera)
    run_ranges(
        project_range,
        n,
        raw(gaussians.means),
        raw(gaussians.log_scales),
        raw(gaussians.quats),
        raw(gaussians.opacity_logits),
        sh,
        sh.reshape(n, 3 * sh.shape[1]).view(np.int32),
        pack_camera(camera),
        across,
        down,
        float(settings.near),
        float(settings.surfel_low_pass if gaussians.is_surfels else settings.low_pass),
        float(settings.alpha_min),
        bool(gaussians.antialiased),
        with_colour,
        out.features,
        out.rects,
        out.states,
    )
    return out


def raw(values: np.ndarray) -> np.ndarray:
    """The values as kernels always get them: another layout, or read-only memory, would compile them anew."""
    return np.require(values, np.float32, ["C", "A", "W"])


def tile_grid(camera: Camera) -> tuple[int, int]:
    """Tiles (across, down) of a camera's picture."""
    return -(-int(camera.width) // TILE), -(-int(camera.height) // TILE)


def pack_camera(camera: Camera) -> np.ndarray:
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


def pass_flags(passes: frozenset[str]) -> np.ndarray:
    """blend_range's flags, [5] bool: rgb, expected depth, median depth, normals, distortion.

    Raises
    ------
    ValueError
        If a pass is unknown.
    """
    if unknown := passes - PASSES:
        raise ValueError(f"unknown passes {sorted(unknown)}; there are {sorted(PASSES)}")
    either_depth = bool(passes & {"depth", "expected_depth"})
    return np.array(["rgb" in passes, either_depth, "depth" in passes, "normal" in passes, "distortion" in passes])


def pack_limits(settings: RasterSettings) -> np.ndarray:
    """blend_range's limits, [6] float32."""
    disc = HALF_LOG2E / settings.surfel_low_pass
    limits = [settings.alpha_min, settings.alpha_max, settings.stop, settings.near, disc, settings.distortion_near]
    return np.array(limits, np.float32)


def padded_size(camera: Camera) -> tuple[int, int]:
    """Height and width of the kernels' pictures: whole blocks."""
    return -(-int(camera.height) // BLOCK) * BLOCK, -(-int(camera.width) // BLOCK) * BLOCK


def empty_pictures(camera: Camera, flags: np.ndarray) -> tuple[np.ndarray, ...]:
    """rgb, alpha, expected, median, normals, distortion of whole blocks, flat: zeros where asked for, else nothing."""
    wanted = (flags[0], True, flags[1], flags[2], flags[3], flags[4])
    height, width = padded_size(camera)
    return tuple(zeros(height * width * c if w else 0, np.float32) for w, c in zip(wanted, CHANNELS))


def padded(picture: np.ndarray, camera: Camera) -> np.ndarray:
    """A picture as kernels read it: flat, of whole blocks; empty if it has no pixels."""
    if not picture.size:
        return np.empty(0, np.float32)
    height, width = padded_size(camera)
    missing = ((0, height - camera.height), (0, width - camera.width), (0, 0))[: picture.ndim]
    return raw(np.pad(picture, missing) if missing[0][1] or missing[1][1] else picture).reshape(-1)


def as_rendering(pictures: tuple[np.ndarray, ...], camera: Camera, ignored: int) -> Rendering:
    """The kernels' pictures without what pads them to whole blocks."""
    height, width = padded_size(camera)
    cut = []
    for flat, channels in zip(pictures, CHANNELS):
        picture = flat.reshape(height if len(flat) else 0, width if len(flat) else 0, channels)
        picture = picture[: camera.height, : camera.width]
        cut.append(np.ascontiguousarray(picture if channels == 3 else picture[..., 0]))
    rgb, alpha, expected, median, normals, distortion = cut
    return Rendering(rgb, alpha, expected, median, normals, distortion, ignored)


def whole_picture(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Slots [down, across] int32 of all tiles and their wanted blocks [S] uint64, for a picture without a region."""
    across, down = tile_grid(camera)
    columns = np.minimum(-(-(camera.width - TILE * np.arange(across)) // 4), 8).astype(np.uint64)
    rows = np.minimum(-(-(camera.height - TILE * np.arange(down)) // 4), 8).astype(np.uint64)
    first_column = np.uint64(0x0101010101010101) >> (np.uint64(64) - np.uint64(8) * rows)
    wanted = ((np.uint64(1) << columns) - np.uint64(1))[None] * first_column[:, None]
    return np.arange(across * down, dtype=np.int32).reshape(down, across), wanted.ravel()


def wanted_tiles(camera: Camera, pixels: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """As `whole_picture`, but only of the 4×4 blocks that hold one of the pixels [H, W] bool, where they are given."""
    if pixels is None:
        return whole_picture(camera)
    if pixels.shape != (camera.height, camera.width):
        raise ValueError(f"pixels: expected shape {(camera.height, camera.width)}, got {pixels.shape}")
    across, down = tile_grid(camera)
    blocks = np.empty(across * down, np.uint64)
    region_blocks(np.require(pixels, bool, ["C", "W"]), across, blocks)
    slots = np.full(across * down, -1, np.int32)
    slots[blocks > 0] = np.arange(np.count_nonzero(blocks))
    return slots.reshape(down, across), blocks[blocks > 0]


@dataclass(frozen=True)
class Trace:
    """What the way back needs of a rendering."""

    gaussians: Gaussians  # those that get gradients
    view: View  # of them
    camera: Camera
    settings: RasterSettings
    flags: np.ndarray
    features: np.ndarray  # [·, 16 or 32] that the lists' entries mean: perhaps frozen ones, then those of `view`
    lists: TileLists
    wanted: np.ndarray  # [S] uint64
    shifts: np.ndarray  # [S] float32
    masks: np.ndarray  # [P] uint64
    closings: np.ndarray  # uint64
    ends: np.ndarray  # [S] int64
    states: np.ndarray  # [S, TILE_STATE] float32
    back: np.ndarray  # [S, TILE_STATE] or empty

    def backward(self, gradients: PictureGradients) -> Gradients:
        return _backward(self, gradients)


def depth_shifts(lists: TileLists, features: np.ndarray) -> np.ndarray:
    """A typical depth of each tile, [S] float32: that of the middle entry, 1 without entries."""
    shifts = np.ones(len(lists.tiles), np.float32)
    filled = np.flatnonzero(lists.stops > lists.starts)
    middle = lists.entries[(lists.starts[filled] + lists.stops[filled]) // 2]
    shifts[filled] = features[middle, DEPTH]
    return shifts


def render(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings,
    passes: frozenset[str],
    pixels: np.ndarray | None,
) -> Rendering:
    return _draw(gaussians, camera, settings, passes, False, pixels)[0]


def trace(
    gaussians: Gaussians, camera: Camera, settings: RasterSettings, passes: frozenset[str]
) -> tuple[Rendering, Trace]:
    return _draw(gaussians, camera, settings, passes, True, None)


def _draw(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings,
    passes: frozenset[str],
    keep: bool,
    pixels: np.ndarray | None,
) -> tuple[Rendering, Trace]:
    flags = pass_flags(passes)
    slots, wanted = wanted_tiles(camera, pixels)
    view = project(gaussians, camera, settings, with_colour=bool(flags[0]))
    lists = tile_lists(view.features, view.rects, view.states, slots, with_records=keep)
    shifts = depth_shifts(lists, view.features)
    pictures, kept = blend(gaussians, view, camera, settings, flags, view.features, lists, wanted, shifts, keep)
    return as_rendering(pictures, camera, view.ignored), kept


def blend(
    gaussians: Gaussians,
    view: View,
    camera: Camera,
    settings: RasterSettings,
    flags: np.ndarray,
    features: np.ndarray,
    lists: TileLists,
    wanted: np.ndarray,
    shifts: np.ndarray,
    keep: bool,
    front: np.ndarray = NO_STATES,
    back: np.ndarray = NO_STATES,
) -> tuple[tuple[np.ndarray, ...], Trace]:
    """Blend the lists into pictures."""
    slot_count, entry_count = len(lists.tiles), len(lists.entries)
    kept = Trace(
        gaussians,
        view,
        camera,
        settings,
        flags,
        features,
        lists,
        wanted,
        shifts,
        empty(entry_count, np.uint64) if keep else NO_MASKS,
        np.empty(entry_count // CHECK + slot_count + 1, np.uint64) if keep else NO_MASKS,
        np.empty(slot_count, np.int64),
        empty((slot_count, TILE_STATE), np.float32) if keep else NO_STATES,
        back,
    )
    pictures = empty_pictures(camera, flags)
    over_tiles(
        blend_range,
        lists,
        camera,
        features,
        gaussians.is_surfels,
        pack_limits(settings),
        shifts,
        flags,
        wanted,
        front,
        kept.masks,
        kept.closings,
        kept.ends,
        kept.states,
        np.asarray(settings.background, np.float32),
        back,
        pictures,
    )
    return pictures, kept


def _backward(traced: Trace, given: PictureGradients) -> Gradients:
    lists, settings = traced.lists, traced.settings
    check_gradients(given, traced.camera)
    gradients = [padded(getattr(given, f.name), traced.camera) for f in fields(given)]
    flags = np.array([gradients[k].size > 0 for k in (0, 2, 3, 4, 5)])
    missing = [
        name
        for name, g, f in zip(("rgb", "expected_depth", "median_depth", "normals", "distortion"), flags, traced.flags)
        if g and not f
    ]
    if missing:
        raise ValueError(f"gradients of {', '.join(missing)}: the rendering has no such pass")
    records = empty((len(lists.records), RECORD), np.float32)
    over_tiles(
        unblend_range,
        lists,
        traced.camera,
        traced.features,
        traced.gaussians.is_surfels,
        pack_limits(settings),
        traced.shifts,
        flags,
        traced.wanted,
        traced.masks,
        traced.closings,
        traced.ends,
        traced.states,
        np.asarray(settings.background, np.float32),
        traced.back,
        tuple(gradients),
        len(traced.features) - len(traced.gaussians),
        lists.records,
        records.reshape(-1),
    )
    return _unproject(traced, records)


def _unproject(traced: Trace, records: np.ndarray) -> Gradients:
    """Gradients of the traced Gaussians."""
    gaussians, settings, lists = traced.gaussians, traced.settings, traced.lists
    out = Gradients(
        empty(gaussians.means.shape, np.float32),
        empty(gaussians.log_scales.shape, np.float32),
        empty(gaussians.quats.shape, np.float32),
        empty(gaussians.opacity_logits.shape, np.float32),
        empty(gaussians.sh.shape, np.float32),
    )
    run_ranges(
        unproject_range,
        len(gaussians),
        raw(gaussians.means),
        raw(gaussians.log_scales),
        raw(gaussians.quats),
        raw(gaussians.opacity_logits),
        raw(gaussians.sh),
        pack_camera(traced.camera),
        float(settings.low_pass),
        bool(gaussians.antialiased),
        traced.view.features,
        traced.view.states,
        lists.spans,
        records.reshape(-1),
        out.means,
        out.log_scales,
        out.quats,
        out.opacity_logits,
        out.sh,
    )
    return out


def check_gradients(given: PictureGradients, camera: Camera) -> None:
    """Every picture's gradient is empty or has the picture's shape."""
    for f in fields(given):
        value = getattr(given, f.name)
        expected = (camera.height, camera.width, *((3,) if f.name in ("rgb", "normals") else ()))
        if value.size and value.shape != expected:
            raise ValueError(f"gradient of {f.name}: expected shape {expected}, got {value.shape}")


def over_tiles(kernel_range: Callable[..., Any], lists: TileLists, camera: Camera, *args: Any) -> None:
    """Run a tile kernel over all slots: longest first, dealt round-robin, so that threads end together."""
    order = np.argsort(lists.starts - lists.stops, kind="stable")
    threads = thread_count()
    chunks = 1 if threads == 1 else min(6 * threads, max(threads, len(order) // 4))
    across, _ = tile_grid(camera)
    shared = (lists.tiles, across, padded_size(camera)[1], lists.starts, lists.stops, lists.entries)
    parallel_map(
        lambda part: kernel_range(0, len(part), part, *shared, *args),
        [np.ascontiguousarray(order[k::chunks]) for k in range(chunks)],
    )


def footprint(
    gaussians: Gaussians, camera: Camera, chosen: np.ndarray, settings: RasterSettings, pixels: np.ndarray | None
) -> np.ndarray:
    if chosen.shape != (len(gaussians),):
        raise ValueError(f"chosen: expected shape {(len(gaussians),)}, got {chosen.shape}")
    view = project(gaussians, camera, settings, with_colour=False)
    view.features[:, RED : BLUE + 1] = chosen[:, None]  # painted white on black
    slots, wanted = wanted_tiles(camera, pixels)
    lists = tile_lists(view.features, view.rects, view.states, slots, with_records=False)
    black = replace(settings, background=(0.0, 0.0, 0.0))
    flags, shifts = pass_flags(frozenset({"rgb"})), np.ones(len(wanted), np.float32)
    pictures, _ = blend(gaussians, view, camera, black, flags, view.features, lists, wanted, shifts, keep=False)
    return np.ascontiguousarray(as_rendering(pictures, camera, view.ignored).rgb[..., 0])


def contributions(
    gaussians: Gaussians, camera: Camera, settings: RasterSettings, pixels: np.ndarray | None
) -> Contributions:
    shape = (camera.height, camera.width)
    counted = np.ones(shape, bool) if pixels is None else np.require(pixels, bool, ["C", "W"])
    if counted.shape != shape:
        raise ValueError(f"pixels: expected shape {shape}, got {counted.shape}")
    view = project(gaussians, camera, settings, with_colour=False)
    lists = tile_lists(view.features, view.rects, view.states, wanted_tiles(camera, pixels)[0], with_records=False)
    sums, peaks = np.zeros((2, len(lists.entries)), np.float32)
    limits = pack_limits(settings)
    over_tiles(weigh_range, lists, camera, view.features, gaussians.is_surfels, limits, counted, sums, peaks)
    total, peak = np.zeros((2, len(gaussians)), np.float32)
    gather_weights(lists.entries, sums, peaks, total, peak)
    return Contributions(total, peak)

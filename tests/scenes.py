"""Small synthetic splat scenes for tests: a patterned floor with a red block on it, and cameras round it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gimp3d.behind import Behind, look_behind
from gimp3d.box import Box, Region
from gimp3d.camera import Camera
from gimp3d.gaussians import SH_C0, Gaussians
from gimp3d.orbit import orbit_cameras
from gimp3d.presets import PRESETS, RemovalSettings
from gimp3d.raster import render_bytes
from gimp3d.run import Run
from gimp3d.stages.charts import Chart, ChartSettings, Plane, draw_charts, lay_planes
from gimp3d.stages.masks import find_masks
from gimp3d.stages.witness import Witness

BLOCK = 0.5  # side of the block, scene units
REGION = (Box.make([0, 0, 0.26], [0.62, 0.62, 0.56]),)  # cuts 2 cm into the floor, as users' boxes do


def discs(points: np.ndarray, normal: tuple[float, float, float], colours: np.ndarray, size: float) -> Gaussians:
    """Thin Gaussians of SH degree 0 on a surface; the normal is one of the axes."""
    axis = int(np.argmax(np.abs(normal)))
    scales = np.full((len(points), 3), size)
    scales[:, axis] = 0.1 * size
    return Gaussians(
        means=points.astype(np.float32),
        log_scales=np.log(scales).astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (len(points), 1)),
        opacity_logits=np.full(len(points), 4.0, np.float32),
        sh=((colours - 0.5) / SH_C0)[:, None].astype(np.float32),
    )


def floor_colours(points: np.ndarray) -> np.ndarray:
    """Smooth stripes and waves, so that a wrong fill shows."""
    x, y = points[:, 0], points[:, 1]
    wave = 0.5 + 0.25 * np.sin(9 * x) + 0.2 * np.sin(7 * y + 2 * x)
    return np.clip(np.stack([0.9 * wave, 0.7 * wave + 0.1, 0.35 + 0.3 * wave], -1), 0, 1)


def floor(with_hole: bool, step: float = 0.035) -> Gaussians:
    """The floor z = 0; real scans have no splats under an object."""
    grid = np.arange(-1.6, 1.6, step)
    points = np.stack([*(g.ravel() for g in np.meshgrid(grid, grid)), np.zeros(grid.size**2)], -1)
    if with_hole:
        points = points[(np.abs(points[:, :2]) > BLOCK / 2).any(1)]
    return discs(points, (0, 0, 1), floor_colours(points), 0.7 * step)


def block(step: float = 0.035) -> Gaussians:
    """A red block standing on the floor, open below."""
    grid = np.arange(-BLOCK / 2, BLOCK / 2 + 1e-6, step)
    a, b = (g.ravel() for g in np.meshgrid(grid, grid))
    half, up = np.full_like(a, BLOCK / 2), BLOCK / 2
    sides = [
        (np.stack([a, b, half + up], -1), (0, 0, 1)),
        (np.stack([half, a, b + up], -1), (1, 0, 0)),
        (np.stack([-half, a, b + up], -1), (1, 0, 0)),
        (np.stack([a, half, b + up], -1), (0, 1, 0)),
        (np.stack([a, -half, b + up], -1), (0, 1, 0)),
    ]
    red = np.tile([0.85, 0.12, 0.1], (a.size, 1))
    parts = [discs(points, normal, red, 0.7 * step) for points, normal in sides]
    whole = parts[0]
    for part in parts[1:]:
        whole = whole.extended(part)
    return whole


def scene() -> Gaussians:
    """The floor (with its hole) and the block."""
    return floor(with_hole=True).extended(block())


def truth() -> Gaussians:
    """The floor without a hole."""
    return floor(with_hole=False)


def cameras(count: int = 9, width: int = 120, height: int = 90) -> tuple[Camera, ...]:
    """Views from rings round the block."""
    return orbit_cameras(REGION, count, (0, 0, 1), width, height, 50)


def charts_of(
    planes: Sequence[Plane], witnesses: Sequence[Witness], settings: ChartSettings = ChartSettings()
) -> tuple[Chart, ...]:
    """What photos show at planes round the block."""
    return draw_charts(lay_planes(planes, witnesses, REGION, settings), witnesses, REGION)


def charted(
    gaussians: Gaussians,
    region: Region,
    views: Sequence[Camera],
    photos: Mapping[str, np.ndarray] | None = None,  # ID → picture; None: as drawn
    extra: Mapping[str, np.ndarray] | None = None,  # see find_masks
    settings: RemovalSettings = PRESETS["draft"],
) -> Behind:
    """What a removal knows of what is behind the object, T of every view for one."""
    photos = {c.id: render_bytes(gaussians, c) for c in views} if photos is None else photos
    masks = find_masks(gaussians, region, views, settings.masks, photos=photos, extra=extra)
    return look_behind(Run(settings), gaussians, region, masks, photos, {})

"""What each view shows: of the whole scene, beside its photo, and of the scene without the object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..box import Region
from ..camera import Camera
from ..errors import BadInput
from ..gaussians import Gaussians
from ..geometry import Window, window_mask, window_round
from ..raster import drawing, touched_window
from .outline import box_polygon, fill_polygon

AROUND = 24  # px round what the object touched that are drawn anew without it: depths and edges there are looked at too
MOSTLY_OBJECT = 0.5  # blend weight of removed Gaussians above which a pixel shows the object and not what surrounds it
NEAR_PLANE = 1e-3  # z below which a box is cut away, as a share of its diagonal
MISFIT = 4.0  # a photo is not what the scene shows where they differ by so many times the view's median …
LEAST_MISFIT = 0.1  # … and by so much, colours in [0, 1]


@dataclass(frozen=True)
class ViewBefore:
    """A view with the object; arrays [H, W]."""

    camera: Camera
    polygons: list[np.ndarray]  # each box's outline, see box_polygon
    window: Window  # of the region and a margin
    depth: np.ndarray  # float32 z, 0 = nothing
    alpha: np.ndarray  # float32
    agrees: np.ndarray | None  # bool, of the window: the photo shows what the scene shows; None if there is none
    likeness: float  # correlation of photo and scene in the window; NaN if it cannot be told
    extra: np.ndarray | None  # bool, the extra mask

    @property
    def misfit(self) -> np.ndarray:
        """[H, W] bool: the photo shows something else, as far as it was looked at."""
        found = np.zeros(self.depth.shape, bool)
        if self.agrees is not None:
            found[self.window] = ~self.agrees
        return found

    @property
    def polygon(self) -> np.ndarray:
        """[H, W] bool: the boxes' outlines, filled."""
        return np.any([fill_polygon(p, self.camera.width, self.camera.height) for p in self.polygons], axis=0)


@dataclass(frozen=True)
class ViewAfter:
    """The part of a view that the object touched, and a margin, without the object; arrays of the window's size."""

    window: Window
    depth: np.ndarray  # float32 z, 0 = nothing
    alpha: np.ndarray  # float32
    weight: np.ndarray  # blend weight of the removed Gaussians, with the object in place


def outlines(region: Region, camera: Camera) -> list[np.ndarray]:
    """The boxes' outlines in a view, [M, 2] pixels each; none where no pixel's centre lies in any."""
    found = (box_polygon(b, camera, NEAR_PLANE * float(np.linalg.norm(b.size))) for b in region)
    polygons = [p for p in found if p is not None]
    return polygons if any(fill_polygon(p, camera.width, camera.height).any() for p in polygons) else []


def look(
    gaussians: Gaussians,
    camera: Camera,
    polygons: list[np.ndarray],  # see outlines
    photo: np.ndarray | None,  # [H, W, 3] uint8, with the object
    extra: np.ndarray | None,  # [H, W] bool
    compare: bool,  # the photo with the scene
) -> ViewBefore:
    """A view with the object.

    Raises
    ------
    BadInput
        If the photo or the extra mask has not the view's size.
    """
    for kind, picture in (("photo", photo), ("extra mask", extra)):
        if picture is not None and picture.shape[:2] != (camera.height, camera.width):
            sizes = f"{picture.shape[1]}×{picture.shape[0]}, not {camera.width}×{camera.height}"
            raise BadInput(f"masks: the {kind} of {camera.id} is {sizes}")
    window = window_round(np.concatenate(polygons), camera, AROUND)
    agrees, likeness = None, np.nan
    scene = drawing(gaussians, camera, with_colour=photo is not None and compare)
    depth, alpha = scene.surface_depth()
    if photo is not None and compare:
        drawn = np.clip(scene.render(frozenset({"rgb"}), window_mask(window, camera)).rgb[window], 0, 1)
        shown = photo[window] / np.float32(255)
        misfit = np.abs(drawn - shown).max(-1)
        agrees = misfit <= max(LEAST_MISFIT, MISFIT * float(np.median(misfit)))
        likeness = _correlation(drawn.mean(-1), shown.mean(-1))
    return ViewBefore(camera, polygons, window, depth, alpha, agrees, likeness, extra)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson's; NaN where either is constant."""
    a, b = a - a.mean(), b - b.mean()
    spread = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / spread if spread > 1e-6 * a.size else np.nan


def look_without(gaussians: Gaussians, gone: Gaussians, removed: np.ndarray, view: ViewBefore) -> ViewAfter:
    """A view without the object, `gone`, the rows `removed` [N] bool; only the part that it touched is drawn anew."""
    window = touched_window(gone, view.camera, AROUND)
    scene = drawing(gaussians, view.camera, with_colour=False, pixels=window_mask(window, view.camera))
    depth, alpha = scene.surface_depth(gone=removed)
    return ViewAfter(window, depth[window].copy(), alpha[window].copy(), scene.footprint(removed)[window].copy())

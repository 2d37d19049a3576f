"""The stage that finds what goes, and what each view shows then (paper 3.2, docs/method.md)."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np

from ..box import Region, in_region
from ..camera import Camera
from ..compute.threads import parallel_map
from ..errors import BadInput, IllPosed
from ..gaussians import Gaussians
from ..geometry import bounds, dilated, window_mask
from ..progress import Progress, silent
from ..raster import drawing, touched_window
from .look import AROUND, ViewBefore, box_polygon, depth_agreement, fill_polygon, in_front, look, uncovered
from .selection import Growth, Selection, SelectionSettings, by_centre, choose, select_removed

T = TypeVar("T")
R = TypeVar("R")
# Share of surface that two views of a good scan place alike; of scenes below it, photos must vouch for more of what the
# removal reveals: 9 to 26 more smears go from real_bed, real_table and tiles_mug.
USUAL_AGREEMENT = 0.97
LEAST_AGREEMENT = 0.5  # share of surface that two views must place alike, else the mode is "paper": the majority
LEAST_LIKENESS = 0.5  # correlation of photos with what the scene shows, else the mode is "paper"
CHANGED = 0.02  # blend weight of removed Gaussians above which the object touched a pixel: five grey levels of 255
MOSTLY_OBJECT = 0.5  # blend weight of removed Gaussians above which a pixel shows the object and not what surrounds it


@dataclass(frozen=True)
class MaskSettings:
    """How it is found what goes, and which pixels are to be filled."""

    mode: Literal["need", "paper"] = "need"  # need or paper; only what no view shows, or all that guards leave open
    grow: bool = False  # yes or no; what the boxes cut off of the object goes too, and maybe what only looks like it
    selection: SelectionSettings = SelectionSettings()


class _Part:
    """A field of a dataclass whose picture is mostly that of an earlier field, or False: only the rectangle is kept in
    which it is not, and the picture is made anew each time it is read.
    """

    def __init__(self, base: str = "") -> None:
        self.base = base

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __set__(self, view: Any, picture: np.ndarray) -> None:
        window = bounds(picture != getattr(view, self.base) if self.base else picture)
        view.__dict__[self.name] = picture.shape, window, picture[window].copy()

    def __get__(self, view: Any, owner: type) -> np.ndarray:
        if view is None:
            raise AttributeError(self.name)  # tells dataclass that the field has no default
        shape, window, values = view.__dict__[self.name]
        picture = getattr(view, self.base).copy() if self.base else np.zeros(shape, values.dtype)
        picture[window] = values
        return picture


@dataclass(frozen=True)
class ViewMasks:
    """What a view shows before and after the removal; all arrays [H, W] of the view. Hundreds are held at once."""

    camera: Camera
    polygon: _Part = _Part()  # bool, the projected boxes
    silhouette: _Part = _Part()  # bool, pixels that the removed Gaussians touched, and those of the extra mask
    occluder: _Part = _Part()  # bool, kept surfaces in front of the object, at its outline
    target: _Part = _Part()  # bool, T: the pixels to fill
    depth_before: np.ndarray  # type: ignore[misc]  # float32 z with the object, 0 = nothing, or nothing to be trusted
    alpha_before: np.ndarray  # type: ignore[misc]  # float32
    depth_after: _Part = _Part("depth_before")  # float32 z without it
    alpha_after: _Part = _Part("alpha_before")  # float32
    weight: _Part = _Part()  # float32, blend weight of the removed Gaussians


@dataclass(frozen=True)
class Masks:
    """The removal's masks in every usable view."""

    selection: Selection
    views: tuple[ViewMasks, ...]  # but those inside the region, or whose frame misses it
    mode: str  # the mode really used
    confidence: float
    reason: str
    warnings: tuple[str, ...] = ()
    growth: Growth | None = None  # what the boxes cut off; None if nothing was looked for, as in the preset paper

    @property
    def removed(self) -> np.ndarray:
        """[N] bool."""
        return self.selection.removed

    @property
    def proposed(self) -> dict[str, Any]:
        """What of the object stays, as in a removal's summary: how many Gaussians, and a box that holds them too."""
        if self.growth is None or self.growth.taken or self.growth.box is None:
            return {"gaussians": 0, "box": None}
        return {"gaussians": int(self.growth.rows.sum()), "box": self.growth.box.to_json()}

    def grown(self, region: Region) -> Region:
        """The boxes that hold what goes: larger ones if what they cut off goes too."""
        return self.growth.region if self.growth and self.growth.taken else region

    @property
    def hole_pixels(self) -> int:
        return int(sum(v.target.sum() for v in self.views))


def find_masks(
    gaussians: Gaussians,
    region: Region,
    cameras: Sequence[Camera],
    settings: MaskSettings = MaskSettings(),
    progress: Progress = silent,
    photos: Mapping[str, np.ndarray] | None = None,  # ID → [H, W, 3] uint8, with the object
    extra: Mapping[str, np.ndarray] | None = None,  # ID → [H, W] bool, to be filled too: shadows, reflections
) -> Masks:
    """Select the object's Gaussians and tell what every view shows with and without them (paper 3.2; docs/method.md).

    The target region T of a view is what the extra masks ask for and, in the mode "paper", what the paper fills; else
    charts add to it what no photo shows (`clearing.chart_targets`). Every view is drawn a fixed number of times.

    Raises
    ------
    BadInput
        If the mode is unknown, or a photo or an extra mask has not its view's size.
    IllPosed
        If every Gaussian is selected, or no camera sees the region from outside.
    """
    if settings.mode not in ("need", "paper"):
        raise BadInput(f"masks: unknown mode {settings.mode!r}; use need or paper")
    inside = select_removed(gaussians, region)
    if not inside.any():
        return Masks(by_centre(inside), (), settings.mode, 1.0, "the region holds no Gaussian: nothing to remove")
    if inside[gaussians.usable].all():
        raise IllPosed("ROI: it holds the whole scene; nothing would be left to fill from, make it smaller")
    outlined = _outlined(region, cameras)
    if not outlined:
        within = sum(bool(in_region(region, c.centre[None])[0]) for c in cameras)
        raise IllPosed(
            f"no usable view: of {len(cameras)} cameras {within} are inside the ROI and the others do not frame it; "
            "add views that look at it from outside"
        )
    photos, extra, rule = photos or {}, extra or {}, settings.selection
    over = _counting(progress, 3 * len(outlined))

    def looked(view: tuple[Camera, list[np.ndarray]]) -> ViewBefore:
        camera, polygons = view
        return look(gaussians, camera, polygons, photos.get(camera.id), extra.get(camera.id), not rule.by_centre)

    before = over(looked, outlined)
    agreement = depth_agreement(before)
    selection, growth = by_centre(inside), None
    if not rule.by_centre:
        # Where views disagree on what they see, trainers have left that much more smears behind the object.
        support = rule.support and rule.support + max(0.0, USUAL_AGREEMENT - agreement)
        selection, before, growth = choose(gaussians, region, before, support, settings.grow, over)
    gone = gaussians.take(selection.removed)
    warnings = _inconsistencies(before, agreement) if settings.mode == "need" else ()
    mode = "paper" if warnings else settings.mode

    def masked(view: ViewBefore) -> ViewMasks:
        return _view_masks(gaussians, gone, selection.removed, view, mode, not warnings)

    views = tuple(over(masked, before))
    confidence = len(views) / len(cameras) * (0.5 if warnings else 1.0)
    reason = "; ".join([*warnings, selection.words, f"{len(views)} views see the region"])
    told = [growth.words] if growth and growth.words else []
    if settings.grow and growth is None:
        told = ["--grow does nothing here: the boxes alone tell what goes, as always in the preset paper"]
    return Masks(selection, views, mode, confidence, reason, (*warnings, *told), growth)


def _outlined(region: Region, cameras: Sequence[Camera]) -> list[tuple[Camera, list[np.ndarray]]]:
    """The cameras that see the region from outside, each with the boxes' outlines [M, 2] in pixels."""
    usable = [c for c in cameras if not in_region(region, c.centre[None])[0]]
    outlines = [(c, [p for box in region if (p := box_polygon(box, c)) is not None]) for c in usable]
    return [(c, polygons) for c, polygons in outlines if any(fill_polygon(p, c).any() for p in polygons)]


def spread_views(
    cameras: Sequence[Camera],
    region: Region,
    most: int,  # 0: all
    needed: Collection[str] = (),  # IDs of those that have to be among them
) -> tuple[Camera, ...]:
    """At most so many cameras of those that see the region, in their order, as far from each other as can be.

    What a view right beside another one shows is known already (farthest points, Gonzalez 1985).
    """
    if not 0 < most < len(cameras):
        return tuple(cameras)
    seeing = {c.id for c, _ in _outlined(region, cameras)}
    candidates = [c for c in cameras if c.id in seeing or c.id in needed]
    places = np.array([c.centre for c in candidates]).reshape(-1, 3)
    away = np.full(len(places), np.inf)
    chosen = [k for k, c in enumerate(candidates) if c.id in needed]
    for k in chosen:
        away = np.minimum(away, np.linalg.norm(places - places[k], axis=1))
    while len(chosen) < min(most, len(places)):
        chosen.append(int(np.argmax(away)))
        away = np.minimum(away, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return tuple(candidates[k] for k in sorted(chosen))


def _counting(progress: Progress, total: int) -> Callable[[Callable[[T], R], Iterable[T]], list[R]]:
    """parallel_map, telling how many of all items are done."""
    done = itertools.count(1)

    def over(work: Callable[[T], R], items: Iterable[T]) -> list[R]:
        def counted(item: T) -> R:
            result = work(item)
            progress("masks", next(done), total)
            return result

        return parallel_map(counted, items)

    return over


def _inconsistencies(before: Sequence[ViewBefore], agreement: float) -> tuple[str, ...]:
    """In words, why depths and photos of one view tell nothing of other views; empty if they do."""
    instead = "every pixel of the box's outline is filled (mode paper)"
    likeness = [b.likeness for b in before if np.isfinite(b.likeness)]
    found = []
    if agreement < LEAST_AGREEMENT:
        found.append(f"views place only {agreement:.0%} of the surface alike: {instead}")
    if likeness and np.median(likeness) < LEAST_LIKENESS:
        found.append(
            f"photos and scene do not match (correlation {np.median(likeness):.2f}), check the poses: {instead}"
        )
    return tuple(found)


def _view_masks(
    gaussians: Gaussians,
    gone: Gaussians,  # the object, of the rows …
    removed: np.ndarray,  # … [N] bool
    before: ViewBefore,
    mode: str,
    consistent: bool,  # what depths say of other views
) -> ViewMasks:
    """A view's masks; without the object only the part that it touched is drawn anew."""
    camera, depth = before.camera, before.depth
    window = touched_window(gone, camera, AROUND)
    scene = drawing(gaussians, camera, with_colour=False, pixels=window_mask(window, camera))
    shown_after = before.depth.copy(), before.alpha.copy()
    for whole, part in zip(shown_after, scene.surface_depth(gone=removed)):
        whole[window] = part[window]
    weight = scene.footprint(removed)  # 0 beyond the window
    silhouette, occluder, target = np.zeros((3, *depth.shape), bool)
    silhouette[window] = weight[window] > CHANGED
    if consistent:
        occluder[window] = in_front(depth[window], weight[window] > MOSTLY_OBJECT)
    if mode == "paper":  # beside what is in front T must not outgrow the object
        target = uncovered(gaussians, removed, before) & ~occluder & (silhouette | ~dilated(occluder, 2))
    if before.extra is not None:
        target, silhouette, depth = target | before.extra, silhouette | before.extra, np.where(before.extra, 0, depth)
    return ViewMasks(camera, before.polygon, silhouette, occluder, target, depth, before.alpha, *shown_after, weight)

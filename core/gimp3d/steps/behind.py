"""What is behind the object: its surfaces and their charts, their light without it, and what stays, learned again.

Planes run in behind the object; of their charts follows what is air, and T. Its shadow and its reflection are found and
undone. Splats round it were fitted with the object's before and among them: photos teach them again. And after the hole
is filled, what is drawn before the new Gaussians takes their colours: where drawn depths scatter, splats of the floor
lie before the floor that photos tell.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from ..box import Region
from ..compute.threads import parallel_map
from ..errors import IllPosed
from ..gaussians import SH_C0, Gaussians
from ..geometry import SOLID
from ..presets import RemovalSettings
from ..progress import Progress
from ..raster import label_weights
from ..run import ViewState
from ..stages.beside import Sight, shown_beside
from ..stages.charts import Chart, Hits, Laid, Plane, draw_charts, extent, find_planes, lay_planes, pictured
from ..stages.clearing import chart_targets, clear_air, object_pixels, over_surfaces, pixels_of
from ..stages.ground import look_at
from ..stages.lifting import Lifted, bare_photos, lift, recoloured
from ..stages.masks import Masks, ViewMasks, spread_views
from ..stages.occluder import support_first
from ..stages.refine import Observation, looked_at, refine_gaussians
from ..stages.reflection import Reflection, find_reflection
from ..stages.seed import OWN_RULES
from ..stages.selection import Fate, Selection, near_region
from ..stages.shadow import Shadow, find_contact, find_shadow, marked_shadow
from ..stages.splitting import split_at_outline
from ..stages.witness import Witness, total_over
from .references import emptied

NOTHING: dict[str, dict[str, Any]] = {
    "shadow": {"found": False, "lights": [], "explained": 0.0},
    "reflection": {"found": False, "explained": 0.0},
}
LEARNED = ("opacity_logits", "sh")  # shapes stay: photos of one side tear them (kitchen_monkey −0.2 dB, real_bed −0.1)
ROUND = 24  # px round the object in which photos teach
PLACE, ELSEWHERE = 1, 2  # labels of a view's pixels: the object's place, and all others
LEFT = Fate.KEPT_STRADDLING, Fate.KEPT_SURFACE  # what stays of what reaches into the boxes
CUT = 24  # photos cut by their colours: half of 42 and 48 tell the same of real_table and real_bed
NAMED = Fate.REMOVED_MASKED, Fate.REMOVED_GROWN  # what the user wants gone whatever it looks like
SHOWN = 2.0  # px of blend weight in the object's place, over all views, from which a Gaussian learns
SHARE = 0.1  # of all its weight; what draws other places more than this one is left alone
LARGEST = 0.5  # diagonals of the region, σ: giants of the background show in many places
SMOOTHING = 1.0  # px, σ by which splats and charts are blurred before they are compared
VISIBLE = 0.5 / 255  # change of a Gaussian's colour from which it shows
WRONG = 2.0  # times the charts' usual error beyond which what is drawn in the object's place is none of the surface


@dataclass(frozen=True)
class Surfaces:
    """What is round the object, and where photos show it; tuples are of the masks' views."""

    planes: tuple[Plane, ...]
    laid: tuple[Laid, ...]  # those of which the object hides something
    selection: Selection  # without what photos show beside the object
    beside: np.ndarray  # [N] bool, that
    objects: Sequence[tuple[np.ndarray, np.ndarray]]  # see pixels_of
    doubtful: Sequence[tuple[np.ndarray, np.ndarray]]  # the same, with what stands before a surface though it stays
    marked: tuple[np.ndarray, ...]  # [H, W] bool, what the user named beside the object, and what is too dark to lift
    confidence: float
    reason: str
    scene: Gaussians  # what photos show as the object's and as its surroundings' is split; the object's parts come last
    split: np.ndarray  # [M] of its rows, that are the surroundings' parts

    def witnesses(self, views: Sequence[ViewState], wary: bool = False) -> list[Witness]:
        """The views; with `wary`, of nothing that may be a foot: some of it has the object's colours."""
        found = []
        for v, (hidden, beside), marked in zip(views, self.doubtful if wary else self.objects, self.marked):
            veiled = (v.masks.alpha_before < SOLID) | v.masks.occluder
            found.append(Witness(v.camera, v.bare, hidden | marked, beside, veiled, v.masks.depth_before))
        return found

    def with_marked(self, more: Sequence[np.ndarray]) -> Surfaces:
        return replace(self, marked=tuple(a | b for a, b in zip(self.marked, more)))


def find_surfaces(
    scene: Gaussians,
    region: Region,
    masks: Masks,
    views: Sequence[ViewState],
    settings: RemovalSettings,
    settled: bool = True,
) -> Surfaces:
    """The planes that run into what the object hid, settled by photos or as they are drawn."""
    assert settings.charts is not None
    if all(view.silhouette.all() for view in masks.views):
        raise IllPosed("the object hides everything in every view: nothing is left to fill from, add views")
    # What the user named beside the object, by a mask or a box of its own: masks let no depth stand there.
    marked = tuple(v.silhouette & v.target & (v.depth_before == 0) & (v.alpha_before > 0) for v in masks.views)

    objects, selection = parallel_map(lambda v: pixels_of(v.weight, settings.clearing), masks.views), masks.selection
    none, split = np.zeros(len(scene), bool), np.zeros(0, int)
    found = Surfaces((), (), selection, none, objects, objects, marked, 1.0, "", scene, split)
    witnesses = found.witnesses(views)
    planes = find_planes(witnesses, region, settings.charts, settled)
    laid = lay_planes(planes, witnesses, region, settings.charts)
    reason = f"{len(planes)} planes run into what the object hid"
    return _as_photos_show(replace(found, planes=planes, laid=laid, reason=reason), region, masks, views, settings)


def _as_photos_show(
    found: Surfaces, region: Region, masks: Masks, views: Sequence[ViewState], settings: RemovalSettings
) -> Surfaces:
    """The same, but what photos show beside the object stays, what they show as it goes, and what is both is split."""
    scene, selection = found.scene, found.selection
    low, sunk = over_surfaces(scene, region, found.laid)
    may = low & scene.usable & near_region(scene, region, 1.0) & ~np.isin(selection.fates, NAMED)
    if not may.any():
        return found
    asked = {camera.id for camera in spread_views([v.camera for v in masks.views], region, CUT)}
    looks = zip(masks.views, views, found.marked)
    sights = [Sight(v.camera, s.bare, v.polygon, m) for v, s, m in looks if v.camera.id in asked]
    goes = selection.removed & (selection.fates != Fate.REMOVED_MASKED)
    stays = np.isin(selection.fates, LEFT)
    shown = shown_beside(scene, goes, stays, may, sights)
    both = shown.both & _may_change(scene, region) & np.isfinite(scene.log_scales).all(1)
    fates = np.where(shown.object_, np.uint8(Fate.REMOVED_STRADDLING), selection.fates)
    fates[selection.removed & (shown.beside | both)] = Fate.KEPT_SURFACE
    back, gone, split = selection.removed & (fates == Fate.KEPT_SURFACE), int(shown.object_.sum()), np.flatnonzero(both)
    if not (back.any() or gone or len(split)):
        return replace(found, beside=shown.beside)
    if len(split):
        rest, parts = split_at_outline(scene.take(split), shown.share[split], shown.photos)
        scene = scene.with_rows(split, rest).extended(parts)
    more = np.zeros(len(split), bool)
    selection = Selection(np.append(fates, np.full(len(split), np.uint8(Fate.REMOVED_STRADDLING))))
    wary = selection.removed | np.append(back & (shown.alike | (both & ~sunk)), more)
    objects, doubtful = object_pixels(scene, masks.views, settings.clearing, selection.removed, wary)
    reason = f"{found.reason}, {int((back & ~both).sum())} Gaussians are shown beside it and stay, {gone} as it and go"
    reason += f", {len(split)} are both and split"
    found = replace(found, selection=selection, objects=objects, doubtful=doubtful, reason=reason)
    return replace(found, beside=np.append(shown.beside, more), scene=scene, split=split)


def _may_change(scene: Gaussians, region: Region) -> np.ndarray:
    """[N] bool: what may get other values: near the object, small, and of an opacity that has a slope."""
    fits = near_region(scene, region, 1.0) & (scene.scales.max(1) < LARGEST * extent(region))
    return scene.usable & fits & np.isfinite(scene.opacity_logits)  # infinite ones are legal


@dataclass(frozen=True)
class Charted:
    """The surfaces that the object hid, seen straight on."""

    charts: tuple[Chart, ...]
    confidence: float
    reason: str


def chart_surfaces(region: Region, surfaces: Surfaces, views: Sequence[ViewState]) -> Charted:
    """Show the hidden surfaces."""
    charts = draw_charts(surfaces.laid, surfaces.witnesses(views, wary=True), region)
    words = [f"{c.kind}: {c.reason}, {int(c.hole.sum())} texels that no photo shows" for c in charts]
    if not charts:
        return Charted((), 0.0, "no surface runs into what the object hid")
    return Charted(charts, charts[0].agreement, "; ".join(words))


@dataclass(frozen=True)
class Cleared:
    """What follows from charts."""

    selection: Selection  # with what had to be cleared away
    targets: Sequence[tuple[ViewMasks, Hits]]  # see chart_targets
    confidence: float
    reason: str


def clear_round(
    scene: Gaussians,
    region: Region,
    surfaces: Surfaces,
    charts: Sequence[Chart],
    views: Sequence[ViewState],
    settings: RemovalSettings,
) -> Cleared:
    """Clear the air before charts, and say where they have to be filled."""
    wary, witnesses = surfaces.witnesses(views, wary=True), surfaces.witnesses(views)
    selection = clear_air(scene, region, surfaces.selection, wary, surfaces.beside, settings.clearing)
    targets = chart_targets(scene, selection, [v.masks for v in views], witnesses, charts, surfaces.marked)
    cleared = int((selection.removed & ~surfaces.selection.removed).sum())
    return Cleared(selection, targets, 1.0, f"{cleared} of haze go")


@dataclass(frozen=True)
class Relit:
    """What the object does to the light round it; in words, why it seems to do nothing. Undone, once it is lifted."""

    reflection: Reflection | str
    shadow: Shadow | str  # that lamps cast, or that is marked
    contact: Shadow | str = ""  # what the object keeps from its foot of light from all sides; nobody asked: ""
    lifted: Lifted | None = None

    @property
    def effects(self) -> list[Reflection | Shadow]:
        return [f for f in (self.shadow, self.contact, self.reflection) if not isinstance(f, str)]

    @property
    def confidence(self) -> float:
        return min((f.confidence for f in self.effects), default=0.0)

    @property
    def reason(self) -> str:
        return _words(self.shadow, self.contact, self.reflection)

    def facts(self) -> dict[str, Any]:
        """For the summary, by name: see Shadow.facts and Reflection.facts; without a lamp's shadow its foot's."""
        shadow = self.contact if isinstance(self.shadow, str) else self.shadow
        told = {"shadow": shadow, "reflection": self.reflection}
        facts = {name: NOTHING[name] if isinstance(f, str) else f.facts() for name, f in told.items()}
        reasons = {"shadow": _words(self.shadow, self.contact), "reflection": _words(self.reflection)}
        return {name: {**of, "reason": reasons[name]} for name, of in facts.items()}

    def scene(self, scene: Gaussians) -> Gaussians:
        """The scene in its new light."""
        return scene if self.lifted is None else scene.with_rows(self.lifted.rows, self.lifted.gaussians)

    @property
    def rows(self) -> np.ndarray:
        """[M] of the scene, whose light changed."""
        return np.zeros(0, int) if self.lifted is None else self.lifted.rows

    def views(self, views: Sequence[ViewState]) -> tuple[ViewState, ...]:
        """The views in it."""
        if self.lifted is None:
            return tuple(views)
        return tuple(replace(v, bare=photo, painted=photo) for v, photo in zip(views, self.lifted.photos))


NOT_LIT = Relit("not looked for", "not looked for")


def _words(*found: Shadow | Reflection | str) -> str:
    return "; ".join(filter(None, (f if isinstance(f, str) else f.reason for f in found)))


def find_light(
    region: Region,
    surfaces: Surfaces,
    views: Sequence[ViewState],
    shadow_masks: Mapping[str, np.ndarray],  # ID → [H, W] bool, the shadow as the user marked it
    settings: RemovalSettings,
) -> Relit:
    """Look for the object's reflection, and in photos without that for its shadow."""
    gone = surfaces.scene.take(surfaces.selection.removed)
    planes = support_first(surfaces.planes, gone)
    if not planes:
        none = "no surface is known round the object"
        return Relit(f"no reflection found: {none}", f"no shadow found: {none}")
    witnesses: Sequence[Witness] = surfaces.witnesses(views)
    grounds = look_at(planes, witnesses, region)
    reflection = find_reflection(gone, planes[0], grounds, witnesses, region)
    if isinstance(reflection, Reflection):
        bare = bare_photos(reflection, witnesses)
        witnesses = [replace(w, photo=photo) for w, (photo, *_) in zip(witnesses, bare)]
        grounds = look_at(planes, witnesses, region)
    shadow = find_shadow(gone, planes[0], grounds, region)
    if settings.shadow == "mask":
        shadow = marked_shadow([shadow_masks.get(v.id) for v in views], grounds, witnesses, shadow)
    return Relit(reflection, shadow)


def undo_light(surfaces: Surfaces, views: Sequence[ViewState], found: Relit) -> Lifted:
    """Subtract the reflection, then lift the shadows, in photos and in splats; one of them at least is found."""
    shadows = [s for s in (found.shadow, found.contact) if isinstance(s, Shadow)]
    return lift(surfaces.scene, surfaces.selection.removed, surfaces.witnesses(views), found.reflection, shadows)


def with_contact(found: Relit, charts: Sequence[Chart]) -> Relit:
    """The same with the shadow where the object touches a surface, as charts show it that are lifted by the others."""
    return replace(found, contact=find_contact(charts))


@dataclass(frozen=True)
class Relearned:
    """Gaussians round the object, as photos teach them."""

    rows: np.ndarray  # [M] of the scene
    gaussians: Gaussians  # [M], their new values
    confidence: float
    reason: str


def relearn(
    scene: Gaussians,
    region: Region,
    removed: np.ndarray,  # [N] bool
    views: Sequence[ViewState],
    charts: Sequence[Chart],
    settings: RemovalSettings,
    progress: Progress,
) -> Relearned:
    """Fit colours and opacity of what draws the object's place to the photos round it, and to the charts inside.

    Inside, charts teach only what cannot be true: a Gaussian that nobody saw there may draw anything, but where it
    draws about what charts show, a photo of its own place knows better than a chart's mosaic.
    """
    kept = scene.take(~removed)
    showing = looked_at([v for v in views if v.masks.silhouette.any()], settings.refine)
    near = _may_change(kept, region)

    def weights(view: ViewState) -> np.ndarray:
        labels = np.where(view.masks.silhouette, PLACE, ELSEWHERE).astype(np.uint8)
        return label_weights(kept, view.camera, labels, ELSEWHERE, near)

    place, elsewhere = total_over(showing, weights, (2, len(kept)))
    learns = near & (place > SHOWN) & (place > SHARE * (place + elsewhere))
    observations = parallel_map(lambda v: observed_round(v, charts), emptied(kept, showing))
    how = settings.refine, settings.random_seed, lambda _, *step: progress("relearn", *step), LEARNED, ROUND
    refined = refine_gaussians(kept.take(~learns), kept.take(learns), observations, *how)
    rows = np.flatnonzero(~removed)[learns] if refined.steps else np.zeros(0, int)
    reason = f"{len(rows)} Gaussians round the object: {refined.reason}"
    return Relearned(rows, refined.gaussians.take(np.arange(len(rows))), refined.confidence, reason)


def take_painted_colours(kept: Gaussians, added: Gaussians, views: Sequence[ViewState]) -> Relearned:
    """The kept Gaussians that show where views are painted, in colours by which the filled scene shows what is painted.

    What they show elsewhere holds them.
    """
    wanted = [np.isin(v.rules, OWN_RULES) for v in views if v.rules is not None]
    views = [v for v in views if v.rules is not None]
    hidden = [(v.masks.silhouette | v.masks.target) & ~own for v, own in zip(views, wanted)]
    no, whole, painted = [np.zeros_like(h) for h in hidden], kept.extended(added), [v.painted for v in views]
    witnesses = [Witness(v.camera, v.painted, h, n, n, v.masks.depth_before) for v, h, n in zip(views, hidden, no)]
    may = (np.arange(len(whole)) < len(kept)) & whole.usable & np.isfinite(whole.opacity_logits)
    rows, sh = recoloured(whole, np.zeros(len(whole), bool), witnesses, painted, wanted, wanted, 0, may)
    seen = np.abs(sh[:, 0] - kept.sh[rows, 0]).max(1) > VISIBLE / SH_C0
    rows, sh = rows[seen], sh[seen]
    reason = f"{len(rows)} Gaussians before the new ones take the colours that are painted there"
    return Relearned(rows, replace(kept.take(rows), sh=sh), 1.0, reason)


def observed_round(view: ViewState, charts: Sequence[Chart]) -> Observation:
    """What a view teaches of the object's surroundings; it is painted with the emptied scene in the object's place."""
    place = view.masks.silhouette | view.masks.target
    image, weight = view.painted, np.zeros(place.shape, np.float32)
    if view.hits is not None:
        shown, known, hole = pictured(charts, view.hits)
        tolerance = max(c.tolerance for c in charts)
        known &= ~hole & ~view.hits.behind(view.masks.depth_after, tolerance)
        was, taught = (cv2.GaussianBlur(p.astype(np.float32), (0, 0), SMOOTHING) for p in (image, shown))
        off = np.sqrt(((was - taught) ** 2).mean(-1))
        beside = known & ~place
        if beside.any():
            wrong = known & place & ~view.masks.target & (off > WRONG * np.sqrt((off[beside] ** 2).mean()))
            image = np.where(wrong[..., None], shown, image)
            weight[wrong] = 1
    return Observation(view.camera, image, place, weight)

"""The stages in order: a scene, its views and a region in; the scene without the object out (DESIGN: how it flows)."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Protocol, TypeVar

import cv2
import numpy as np

from . import buffers
from .box import Region
from .camera import Camera
from .errors import IllPosed
from .gaussians import Gaussians
from .priors.inpaint import Appearance, inpaint_reference, paste_picture
from .priors.monodepth import depth_prior
from .progress import Progress, silent
from .raster import RasterSettings, Window, drawing, render, surface_depth, touched_window
from .solvers.harmonics import HarmonicsSettings
from .stages.depth import DepthCompletion, DepthSettings, complete_depth
from .stages.exposure import Exposure, exposure_ring, level_exposure
from .stages.layers import LayerSettings
from .stages.mapping import MappingField, MappingSettings, mapping_field, source_visibility
from .stages.masks import Masks, MaskSettings, ViewMasks, find_masks
from .stages.outline import window_mask
from .stages.propagate import (
    PaintedView,
    PropagateSettings,
    Propagation,
    Reference,
    Rule,
    ViewToPaint,
    near_hole,
    propagate,
)
from .stages.reference import (
    EvidenceSettings,
    ReferenceChoice,
    ReferenceSettings,
    ViewScore,
    choose_reference,
    disparity_of,
    gather_evidence,
    rim,
)
from .stages.refine import (
    Refinement,
    RefineSettings,
    observed,
    refine_gaussians,
)
from .stages.seed import SeedSettings, colour_gaussians, seed_gaussians, settle_gaussians
from .stages.selection import Selection, SelectionSettings
from .threads import parallel_map

R = TypeVar("R")
NEGLIGIBLE = 1e-3  # share of what the object touches in all views up to which a hole that cannot be filled is let be


@dataclass(frozen=True)
class RemovalSettings:
    """Every stage's settings, and the providers of what no view shows."""

    masks: MaskSettings = MaskSettings()
    reference: ReferenceSettings = ReferenceSettings()
    evidence: EvidenceSettings = EvidenceSettings()
    depth: DepthSettings = DepthSettings()
    mapping: MappingSettings = MappingSettings()
    propagate: PropagateSettings = PropagateSettings()
    seed: SeedSettings = SeedSettings()
    refine: RefineSettings = RefineSettings()
    inpaint: str = "exemplar"
    depth_prior: str = "auto"
    use_evidence: bool = True  # copy what photos show of the hidden surface before inventing the rest
    extra_references: int = 3  # views completed after the first one, where it does not reach
    extra_gain: float = 0.01  # share of the hole that an extra reference must still find open
    random_seed: int = 0


PRESETS: dict[str, RemovalSettings] = {
    "draft": RemovalSettings(extra_references=1, extra_gain=0.02),
    "balanced": RemovalSettings(refine=RefineSettings(steps=100)),
    "best": RemovalSettings(refine=RefineSettings(steps=400), extra_references=4, extra_gain=0.005),
    "paper": RemovalSettings(
        masks=MaskSettings(mode="paper", selection=SelectionSettings(by_centre=True)),
        depth=DepthSettings(scale_factor=0.1, surface="harmonic", layers=LayerSettings(step=1e9)),
        mapping=MappingSettings(geometry=False),
        propagate=PropagateSettings(transfer="sample", blend="rim"),
        seed=SeedSettings(
            largest=1, sink=0, needed=0, corrections=0, sh_degree=3, harmonics=HarmonicsSettings(ridge=1e-3)
        ),
        refine=RefineSettings(steps=3000, patience=120),
        use_evidence=False,
        extra_references=0,
    ),
}
# The paper as it is printed: the signs of the guidance (told only with a depth prior) and of the visibility, the patch
# cost without p, SH that are not anchored and lack 3DGS's 0.5. Of several levels, the finest first gives no field.
_PAPER = PRESETS["paper"]
PRESETS["paper-literal"] = replace(
    _PAPER,
    depth=replace(_PAPER.depth, scale_factor=-0.1),
    mapping=replace(_PAPER.mapping, visibility=-_PAPER.mapping.visibility, as_printed=True),
    seed=replace(_PAPER.seed, grey=0.0, harmonics=replace(_PAPER.seed.harmonics, anchored=False)),
)


@dataclass(frozen=True)
class StageReport:
    """What a stage says of itself."""

    name: str
    seconds: float
    confidence: float
    reason: str


@dataclass(frozen=True)
class Picture:
    """A stage's result to look at; `report` draws it by its kind."""

    kind: str  # mask | depth | fit | appearance | mapping | rules
    title: str
    image: np.ndarray  # [H, W, 3] uint8, the view
    # per kind: (target) | (depth, target) | (ring, line, s_f) | (target) | (rows, cols) | (rules, raw)
    data: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class RemovalResult:
    """The removal: which rows stay, what is added, and how it came about."""

    keep: np.ndarray  # [N] bool over the input's rows
    added: Gaussians | None
    stages: tuple[StageReport, ...] = ()
    hole_pixels: int = 0
    open_pixels: int = 0  # of these, what no reference reached
    views: int = 0
    painted: dict[str, np.ndarray] = field(default_factory=dict)  # ID → I_t* [H, W, 3] uint8
    pictures: tuple[Picture, ...] = ()
    references: tuple[ReferenceChoice, ...] = ()  # in the order in which they were completed
    warnings: tuple[str, ...] = ()
    selection: dict[str, int] = field(default_factory=dict)  # how many rows have which masks' Fate


class Store(Protocol):
    """Where finished stages are kept, so that a stopped run can go on (job.StageStore)."""

    def load(self, name: str) -> Any | None: ...

    def save(self, name: str, result: Any) -> None: ...


@dataclass(frozen=True)
class View:
    """A camera and what it sees, the object included."""

    camera: Camera
    image: np.ndarray  # [H, W, 3] uint8


class _Run:
    """Runs stages one after the other: times them, keeps their words, and takes finished ones from the store."""

    def __init__(self, store: Store | None, progress: Progress) -> None:
        self.store, self.progress = store, progress
        self.stages: list[StageReport] = []
        self.warnings: list[str] = []
        self.pictures: list[Picture] = []
        self.references: list[ReferenceChoice] = []

    def __call__(self, name: str, work: Callable[[], R], words: Callable[[R], tuple[float, str]] | None = None) -> R:
        self.progress(name, 0, 1)
        start = time.perf_counter()
        result = self.store.load(name) if self.store else None
        if result is None:
            result = work()
            if self.store:
                self.store.save(name, result)
        confidence, reason = words(result) if words else (result.confidence, result.reason)  # type: ignore
        self.stages.append(StageReport(name, time.perf_counter() - start, float(confidence), reason))
        self.progress(name, 1, 1, reason)
        return result


def remove_object(
    scene: Gaussians,
    views: Sequence[View],
    region: Region,
    settings: RemovalSettings = RemovalSettings(),
    reference: str | None = None,
    reference_image: np.ndarray | None = None,  # [H, W, 3] uint8, the reference view without the object
    progress: Progress = silent,
    store: Store | None = None,
    extra_masks: Mapping[str, np.ndarray] | None = None,  # ID → [H, W] bool, filled too: shadows, reflections
) -> RemovalResult:
    """Remove what lies in the region and fill what it hid (the paper's pipeline; METHOD).

    Parameters
    ----------
    views
        Training views and, if it is another one, the reference view. Their images show the scene with the object.
    reference
        ID of the reference view; None chooses one.
    reference_image
        What the reference view looks like without the object; None fills it by `settings.inpaint`.

    Raises
    ------
    BadInput
        If a provider cannot be used.
    IllPosed
        If the task has no defined answer, with the reason.
    """
    run = _Run(store, progress)
    photos = {v.camera.id: v.image for v in views}
    cameras = [v.camera for v in views]
    masks = run("masks", lambda: find_masks(scene, region, cameras, settings.masks, progress, photos, extra_masks))
    run.warnings += masks.warnings
    keep = ~masks.removed
    for v in _spread(masks.views):
        run.pictures.append(Picture("mask", f"Region to fill in {v.camera.id}", photos[v.camera.id], (v.target,)))
    if not masks.removed.any():
        return _finish(run, keep, None, masks, {}, ["nothing to remove: the region holds no Gaussian"])
    if masks.left_out:
        run.warnings.append(f"{len(masks.left_out)} views do not frame the region or lie inside it: not used")
    if masks.hole_pixels == 0:
        why = "nothing to fill: every view sees what is behind the object"
        if masks.mode == "paper":
            why = "nothing to fill: what surrounds the box covers its outline in every view"
        return _finish(run, keep, None, masks, {}, [why])
    kept = scene.take(keep)

    def emptied(v: ViewMasks) -> tuple[Exposure, np.ndarray]:
        """A view's photo at the splats' exposure, and with the emptied scene in the object's place."""
        silhouette, ring = v.silhouette, exposure_ring(v)
        drawn = render_bytes(kept, v.camera, pixels=silhouette | ring)
        exposure = level_exposure(ring, photos[v.camera.id], drawn)
        return exposure, np.where(silhouette[..., None], drawn, exposure.image)

    names = [v.camera.id for v in masks.views]
    found = parallel_map(emptied, masks.views)
    exposures, painted = {n: e for n, (e, _) in zip(names, found)}, {n: p for n, (_, p) in zip(names, found)}
    del found
    levelled = {name: e.image for name, e in exposures.items()}
    filled, added = kept, None
    open_views = masks.views
    told: dict[str, np.ndarray] = {}  # ID → [H, W] the rule that gave each pixel its last colour
    for round_ in range(1 + settings.extra_references):
        buffers.release()  # a stage's leavings are of little use to the next
        if round_ and _open_pixels(open_views) < settings.extra_gain * masks.hole_pixels:
            break
        first = round_ == 0
        try:
            new, painting = _fill_from_one_view(
                run,
                "" if first else f" {round_ + 1}",
                filled,
                open_views,
                levelled,
                painted,
                settings,
                reference if first else None,
                reference_image if first else None,
            )
        except IllPosed as error:
            touched = sum(int(v.silhouette.sum()) for v in masks.views)
            if first and masks.hole_pixels > NEGLIGIBLE * touched:
                raise
            run.warnings.append(f"no {'' if first else 'further '}reference view helps: {error}")
            break
        added = new if added is None else added.extended(new)
        filled = kept.extended(added)
        painted.update({p.camera_id: p.pasted(painted[p.camera_id]) for p in painting.views})
        rules = {p.camera_id: p.rule_map(*painted[p.camera_id].shape[:2]) for p in painting.views}
        del painting
        for name, rule in rules.items():
            told[name] = np.where((rule == Rule.UNTOUCHED) | (rule == Rule.UNREACHED), told.get(name, rule), rule)
        near_new = _where_drawn(new, masks.views)
        painted = _redrawn(painted, filled, masks.views, near_new)
        open_views = _all_still_open(open_views, filled, len(added), rules, near_new, settings.masks)
    buffers.release()
    added = _refined(run, kept, added, masks, painted, told, settings)
    left = _open_pixels(open_views)
    if left > settings.extra_gain * masks.hole_pixels:
        share = left / masks.hole_pixels
        run.warnings.append(f"{share:.0%} of the hole's pixels ({left}) are reached by no reference view and stay open")

    def finish(v: ViewMasks) -> None:
        name = v.camera.id
        painted[name] = exposures[name].back(painted[name], photos[name], v.silhouette | v.target)

    parallel_map(finish, masks.views)
    return replace(_finish(run, keep, added, masks, painted, []), open_pixels=left)


def _refined(
    run: _Run,
    kept: Gaussians,
    added: Gaussians | None,
    masks: Masks,
    painted: dict[str, np.ndarray],
    told: dict[str, np.ndarray],
    settings: RemovalSettings,
) -> Gaussians | None:
    """The new Gaussians, optimised where the settings ask for it."""
    if added is None or not settings.refine.steps:
        return added
    views = [observed(v.camera, painted[v.camera.id], told[v.camera.id]) for v in masks.views if v.camera.id in told]
    refinement: Refinement = run(
        "refine",
        lambda: refine_gaussians(kept, added, views, settings.refine, settings.random_seed, run.progress),
    )
    return refinement.gaussians


def _fill_from_one_view(
    run: _Run,
    suffix: str,
    filled: Gaussians,  # the scene so far, without the object
    open_views: Sequence[ViewMasks],
    photos: dict[str, np.ndarray],  # with the object, at the splats' exposure
    painted: dict[str, np.ndarray],  # without it, as far as that is known
    settings: RemovalSettings,
    wanted: str | None,
    given: np.ndarray | None,
) -> tuple[Gaussians, Propagation]:
    """Complete one reference, carry it into every view, and make its Gaussians."""
    solid, tried = settings.masks.solid, {c.camera_id for c in run.references}
    choice: ReferenceChoice = run(
        f"reference{suffix}", lambda: choose_reference(open_views, wanted, solid, settings.reference, tried)
    )
    run.references.append(choice)
    view = next(v for v in open_views if v.camera.id == choice.camera_id)
    completed: DepthCompletion = run(
        f"depth{suffix}",
        lambda: _complete_depth(view, open_views, painted[view.camera.id], settings, given, first=not suffix),
    )
    depth = np.where(view.target, completed.depth, view.depth_after).astype(np.float32)
    appearance: Appearance = run(
        f"appearance{suffix}",
        lambda: _appearance(view, depth, open_views, photos, painted[view.camera.id], settings, given),
    )
    run.warnings += appearance.warnings
    seeds = seed_gaussians(view.camera, appearance.image, depth, view.target, filled.is_surfels, settings.seed)
    if len(seeds) == 0:
        raise IllPosed(f"reference {view.camera.id}: what is behind the object is infinitely far; nothing to build")
    with_seeds = filled.extended(seeds)

    def to_paint(v: ViewMasks) -> ViewToPaint:
        name = v.camera.id
        window = near_hole(v.target, settings.propagate)
        depth_new = np.zeros_like(v.depth_before)
        if v.target.any():
            depth_new = surface_depth(with_seeds, v.camera, pixels=window_mask(window, v.camera))[0]
        return ViewToPaint(v.camera, photos[name], painted[name], v.silhouette, v.target, v.depth_before, depth_new)

    source = ~view.target & ~view.silhouette & (depth > 0)
    field_: MappingField = run(
        f"mapping{suffix}",
        lambda: mapping_field(
            appearance.image,
            view.target,
            source,
            source_visibility(
                view.camera,
                depth,
                [(v.camera, v.depth_before, v.silhouette) for v in open_views],
                settings.mapping,
            ),
            settings.mapping,
            settings.random_seed,
            view.camera,
            depth,
        ),
    )
    reference = Reference(view.camera, appearance.image, depth, view.target, source, field_.rows, field_.cols)
    painting: Propagation = run(
        f"propagate{suffix}",
        lambda: propagate(reference, [partial(to_paint, v) for v in open_views], settings.propagate, run.progress),
    )
    painting = _with_reference(painting, view, appearance)
    name = view.camera.id
    run.pictures += [
        Picture("depth", f"Completed surface in {name}", appearance.image, (depth, view.target)),
        *_fit_picture(completed, appearance.image, name),
        Picture("appearance", f"The reference without the object, {name}", appearance.image, (view.target,)),
        Picture("mapping", f"Mapping field of {name}", appearance.image, (field_.rows, field_.cols)),
        *(
            Picture(
                "rules",
                f"Filled view {p.camera_id}",
                p.pasted(painted[p.camera_id]),
                (p.rule_map(*painted[p.camera_id].shape[:2]), p.pasted(painted[p.camera_id], p.raw)),
            )
            for p in _spread(painting.views)
        ),
    ]
    cameras = [v.camera for v in open_views]
    new: Gaussians = run(
        f"seed{suffix}",
        lambda: settle_gaussians(
            filled,
            colour_gaussians(seeds, view.camera, cameras, painting.views, filled.sh_degree, settings.seed),
            view.camera,
            cameras,
            painting.views,
            settings.seed,
        ),
        lambda g: (1.0, f"{len(g)} new Gaussians"),
    )
    return new, painting


def _with_reference(painting: Propagation, view: ViewMasks, appearance: Appearance) -> Propagation:
    """The reference itself shows its own completed picture, not a mapped one."""

    def shown(paint: PaintedView) -> PaintedView:
        if paint.camera_id != view.camera.id:
            return paint
        h, w = paint.rules.shape
        part = slice(paint.top, paint.top + h), slice(paint.left, paint.left + w)
        rules = np.where(view.target[part], Rule.EVIDENCE, Rule.UNTOUCHED).astype(np.uint8)
        return replace(paint, image=appearance.image[part], raw=appearance.image[part], rules=rules)

    return replace(painting, views=tuple(shown(p) for p in painting.views))


def _complete_depth(
    view: ViewMasks,
    open_views: Sequence[ViewMasks],
    base: np.ndarray,
    settings: RemovalSettings,
    given: np.ndarray | None,
    first: bool = True,  # reference; a file's prior is of that view
) -> DepthCompletion:
    """The reference's depth; a model that estimates it looks at the picture given, or at a first fill."""
    picture, spec = None, settings.depth_prior
    if spec.startswith("file:") and not first:
        spec = "auto"
    if spec.startswith("onnx:"):
        if given is not None:
            picture = paste_picture(base, view.target, given, "--reference-image", ~view.silhouette).image
        else:
            picture = inpaint_reference(settings.inpaint, base, view.target, settings.random_seed).image
    prior = depth_prior(spec, view.camera.height, view.camera.width, picture)
    surface = spec if spec in ("harmonic", "planar") else settings.depth.surface
    known = rim(view, settings.masks.solid)
    return complete_depth(
        view, open_views, disparity_of(view.depth_after), known, prior, replace(settings.depth, surface=surface)
    )


def preview(
    view: ViewMasks, views: Sequence[ViewMasks], picture: np.ndarray, settings: RemovalSettings = RemovalSettings()
) -> tuple[Picture, ...]:
    """What a removal would do in a view: where it would fill, on what surface, and how a depth prior was scaled."""
    name = view.camera.id
    shown = [Picture("mask", f"Region to fill in {name}", picture, (view.target,))]
    if view.target.any():
        try:
            completed = _complete_depth(view, views, picture, settings, None)
        except IllPosed:
            return tuple(shown)  # the region is worth seeing all the more
        depth = np.where(view.target, completed.depth, view.depth_after).astype(np.float32)
        shown.append(Picture("depth", f"Completed surface in {name}", picture, (depth, view.target)))
        shown += _fit_picture(completed, picture, name)
    return tuple(shown)


def _fit_picture(completed: DepthCompletion, image: np.ndarray, name: str) -> list[Picture]:
    """How the depth prior was scaled, if there was one."""
    if len(completed.ring) == 0:
        return []
    data = (completed.ring, np.array(completed.line), np.array([completed.scale_factor]))
    return [Picture("fit", f"Scale of the depth prior, measured round the hole of {name}", image, data)]


def _appearance(
    view: ViewMasks,
    depth: np.ndarray,
    open_views: Sequence[ViewMasks],
    photos: dict[str, np.ndarray],
    base: np.ndarray,
    settings: RemovalSettings,
    given: np.ndarray | None,
) -> Appearance:
    """The reference without the object: the given picture, or what photos show and the provider's fill for the rest."""
    if given is not None:
        return paste_picture(base, view.target, given, "--reference-image", ~view.silhouette)
    seen = np.zeros_like(view.target)
    if settings.use_evidence:
        # What the removed Gaussians show, such as a shadow in a box of its own, is no evidence.
        sources = ((v.camera, photos[v.camera.id], np.where(v.silhouette, 0, v.depth_before)) for v in open_views)
        evidence = gather_evidence(view.camera, depth, view.target, sources, settings.evidence)
        seen = evidence.seen
        base = np.where(seen[..., None], evidence.image, base)
    hole = view.target & ~seen
    filled = inpaint_reference(settings.inpaint, base, hole, settings.random_seed, disparity_of(depth), view.camera.K)
    share = seen.sum() / max(1, view.target.sum())
    return replace(filled, reason=f"{share:.0%} of the hole is seen in photos; {filled.reason}")


def _where_drawn(gaussians: Gaussians, views: Sequence[ViewMasks]) -> dict[str, Window]:
    """By ID, where Gaussians may be seen."""
    return {v.camera.id: touched_window(gaussians, v.camera) for v in views}


def _redrawn(
    painted: dict[str, np.ndarray],
    filled: Gaussians,
    views: Sequence[ViewMasks],
    touched: dict[str, Window],  # by ID, where the last new Gaussians may be
) -> dict[str, np.ndarray]:
    """The painted views, with the filled scene where the removal left a gap that was never to be filled.

    Beside what is in front, its soft edge is no target, but the emptied scene shows through it.
    """

    def redraw(view: ViewMasks) -> np.ndarray:
        picture = painted[view.camera.id]
        gap = (
            view.silhouette
            & ~view.target
            & (view.alpha_after < 0.99)
            & window_mask(touched[view.camera.id], view.camera)
        )
        if not gap.any():
            return picture
        return np.where(gap[..., None], render_bytes(filled, view.camera, pixels=gap), picture)

    return dict(zip((v.camera.id for v in views), parallel_map(redraw, views)))


def _all_still_open(
    views: Sequence[ViewMasks],
    filled: Gaussians,
    added: int,
    rules: dict[str, np.ndarray],
    touched: dict[str, Window],
    masks: MaskSettings,
) -> tuple[ViewMasks, ...]:
    def left(view: ViewMasks) -> ViewMasks:
        if not view.target.any():
            return view
        name = view.camera.id
        return _still_open(view, filled, added, rules[name], window_mask(touched[name], view.camera), masks)

    return tuple(parallel_map(left, views))


def _still_open(
    view: ViewMasks,
    filled: Gaussians,
    added: int,
    rules: np.ndarray,
    touched: np.ndarray,  # [H, W] bool, where the last new Gaussians may be: elsewhere the view is as it was
    masks: MaskSettings,
) -> ViewMasks:
    """A view's masks once the new Gaussians (the last `added` rows) are there: T is what they do not cover.

    A pixel that a splat's edge covers but that got no colour stays open, or the next fill would continue its old one.
    What is left of the margin round T is closed where the scene's own surface joins the new one, and beside what is
    in front, where a splat's soft edge has the depth of neither.
    """
    new = np.zeros(len(filled), bool)
    new[-added:] = True
    side = 2 * masks.margin + 1
    near = touched | (cv2.dilate(view.target.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)
    scene = drawing(filled, view.camera, with_colour=False, pixels=near)
    before = view.depth_after, view.alpha_after
    depth, alpha = (np.where(touched, d, b) for d, b in zip(scene.surface_depth(), before))
    covered = scene.footprint(new) > 0.5
    coloured = (rules != Rule.UNREACHED) | (view.alpha_after > masks.solid)
    target = view.target & (~covered | (rules == Rule.UNREACHED))
    farthest = cv2.dilate(np.where(covered, depth, 0).astype(np.float32), np.ones((side, side), np.uint8))
    nearest = cv2.erode(np.where(depth > 0, depth, np.inf).astype(np.float32), np.ones((side, side), np.uint8))
    at_edge = nearest < (1 - masks.layer_step) * depth
    joined = coloured & (alpha > masks.solid) & (at_edge | (depth < (1 + masks.layer_step) * farthest))
    wide = cv2.morphologyEx(target.astype(np.uint8), cv2.MORPH_OPEN, np.ones((side - 1, side - 1), np.uint8)) > 0
    return replace(view, target=target & (wide | ~joined), depth_after=depth, alpha_after=alpha)


def _spread(items: Sequence[R], count: int = 3) -> list[R]:
    """A few of many, evenly."""
    return [items[k * len(items) // count] for k in range(min(count, len(items)))]


def _open_pixels(open_views: Sequence[ViewMasks]) -> int:
    return sum(int(v.target.sum()) for v in open_views)


def render_bytes(
    gaussians: Gaussians,
    camera: Camera,
    background: tuple[float, float, float] = (0, 0, 0),
    pixels: np.ndarray | None = None,  # [H, W] bool, those that are wanted
) -> np.ndarray:
    """The scene as 8-bit RGB, [H, W, 3]."""
    rgb = render(gaussians, camera, RasterSettings(background=background), frozenset({"rgb"}), pixels).rgb
    return np.clip(np.rint(rgb * 255), 0, 255).astype(np.uint8)


def _finish(
    run: _Run,
    keep: np.ndarray,
    added: Gaussians | None,
    masks: Masks,
    painted: dict[str, np.ndarray],
    warnings: list[str],
) -> RemovalResult:
    return RemovalResult(
        keep=keep,
        added=added,
        stages=tuple(run.stages),
        hole_pixels=masks.hole_pixels,
        views=len(masks.views),
        painted=painted,
        pictures=tuple(run.pictures),
        references=tuple(run.references),
        warnings=tuple(run.warnings + warnings),
        selection=masks.selection.counts,
    )


# What a stage store has to know to bring results back.
STORED = (
    Camera,
    Gaussians,
    Masks,
    Selection,
    ViewMasks,
    ReferenceChoice,
    ViewScore,
    DepthCompletion,
    MappingField,
    Propagation,
    PaintedView,
    Appearance,
    Refinement,
)

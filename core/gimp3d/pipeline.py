"""The stages in order: a scene, its views and a region in; the scene without the object out (DESIGN: how it flows)."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, Protocol, TypeVar

import cv2
import numpy as np
import scipy.ndimage

from .box import Box, Region
from .camera import Camera
from .compute import buffers
from .compute.threads import parallel_map
from .errors import BadInput, IllPosed
from .gaussians import Gaussians
from .priors.calls import Call
from .priors.inpaint import Appearance, check_provider, inpaint_reference, painter, paste_picture
from .priors.monodepth import check_depth_prior, depth_prior, looks
from .progress import Progress, silent
from .raster import RasterSettings, Window, drawing, footprint, render, surface_depth, touched_window
from .schema import Seed, Share
from .solvers.harmonics import HarmonicsSettings
from .stages.charts import CHART, Chart, ChartSettings, Hits, Plane, chart_number, draw_charts, find_planes
from .stages.clearing import ClearingSettings, Targets, chart_targets, clear_air, object_pixels
from .stages.depth import DepthCompletion, DepthSettings, complete_depth
from .stages.exposure import Exposure, exposure_ring, level_exposure
from .stages.ground import Ground, look_at
from .stages.growth import Growth
from .stages.layers import LayerSettings
from .stages.lifting import Lifted, bare_photos, lift_shadow, subtract_reflection
from .stages.light_search import Light
from .stages.mapping import MappingField, MappingSettings, mapping_field, source_visibility
from .stages.masks import Masks, MaskSettings, ViewMasks, find_masks, sees
from .stages.occluder import Occluder
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
    looked_at,
    observed,
    refine_gaussians,
)
from .stages.reflection import Reflection, find_reflection
from .stages.seed import SeedSettings, colour_gaussians, seed_gaussians, settle_gaussians
from .stages.selection import Selection, SelectionSettings
from .stages.shadow import Shadow, find_shadow, marked_shadow
from .stages.verdict import Verdict, judge
from .stages.view_refinement import RefinedView, ViewRefinement, ViewToRefine, refine_views
from .stages.witness import Witness

R = TypeVar("R")
SAME = 0.01  # relative z within which two references show the same surface
SAME_TEXELS = 1.0  # of a chart, within which it is that of another one: its camera stands too far away for shares of z
REFINERS = ("command", "http", "https")  # who may be asked to refine views
REFINING = 0.5  # share of a painted hole that a refining painter may change (img2img's denoising strength)
NEGLIGIBLE = 1e-3  # share of what the object touches in all views up to which a hole that cannot be filled is let be


@dataclass(frozen=True)
class RemovalSettings:
    """Every stage's settings, and the providers of what no view shows."""

    masks: MaskSettings = MaskSettings()
    charts: ChartSettings | None = ChartSettings()  # None: photos are the only references (paper)
    clearing: ClearingSettings = ClearingSettings()
    reference: ReferenceSettings = ReferenceSettings()
    evidence: EvidenceSettings = EvidenceSettings()
    depth: DepthSettings = DepthSettings()
    mapping: MappingSettings = MappingSettings()
    propagate: PropagateSettings = PropagateSettings()
    seed: SeedSettings = SeedSettings()
    refine: RefineSettings = RefineSettings()
    inpaint: str = "exemplar"
    depth_prior: str = "auto"
    shadow: Literal["auto", "off", "mask"] = "auto"  # auto | off | mask: what the object's own shadow is taken for
    use_evidence: bool = True  # copy what photos show of the hidden surface before inventing the rest
    extra_references: int = 3  # views completed after the first one, where it does not reach
    extra_gain: Share = 0.01  # share of the hole that an extra reference must still find open
    random_seed: Seed = 0
    refine_views: str = ""  # who is asked to refine painted views beside their reference; empty: nobody
    painter_seconds: float = 600.0  # that a painter or model outside this program may take for one picture
    prompt: str = ""  # what stands behind the object, for painters that read


PRESETS: dict[str, RemovalSettings] = {
    "draft": RemovalSettings(extra_references=1, extra_gain=0.02),
    "balanced": RemovalSettings(refine=RefineSettings(steps=100)),
    "best": RemovalSettings(refine=RefineSettings(steps=400), extra_references=4, extra_gain=0.005),
    "paper": RemovalSettings(
        masks=MaskSettings(mode="paper", selection=SelectionSettings(by_centre=True)),
        charts=None,
        depth=DepthSettings(scale_factor=0.1, surface="harmonic", layers=LayerSettings(step=1e9)),
        mapping=MappingSettings(geometry=False),
        propagate=PropagateSettings(transfer="sample", blend="rim"),
        seed=SeedSettings(
            largest=1, sink=0, needed=0, corrections=0, sh_degree=3, harmonics=HarmonicsSettings(ridge=1e-3)
        ),
        refine=RefineSettings(steps=3000, patience=120),
        shadow="off",
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

    kind: str  # mask | chart | shadow | depth | fit | appearance | mapping | rules | refined
    title: str
    image: np.ndarray  # [H, W, 3] uint8, the view
    # per kind: (target) | (hole) | (light that arrives, lifted) | (depth, target) | (ring, line, s_f) | (target)
    # | (rows, cols) | (rules, raw) | (the view before)
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
    charts: tuple[Chart, ...] = ()  # as completed; see _to_paint
    references: tuple[ReferenceChoice, ...] = ()  # in the order in which they were completed
    warnings: tuple[str, ...] = ()
    selection: dict[str, int] = field(default_factory=dict)  # how many rows have which masks' Fate
    verdict: Verdict | None = None  # None where nothing was removed
    proposed: dict[str, Any] = field(default_factory=dict)  # what of the object the boxes cut off, see Growth.facts
    shadow: dict[str, Any] = field(default_factory=dict)  # see Shadow.facts
    reflection: dict[str, Any] = field(default_factory=dict)  # see Reflection.facts
    lifted: int = 0  # Gaussians that are removed and added as their light changed
    refined_views: dict[str, Any] = field(default_factory=dict)  # see ViewRefinement.facts; empty: nobody was asked


class Store(Protocol):
    """Where finished stages are kept, so that a stopped run can go on (job.StageStore)."""

    def load(self, name: str) -> Any | None: ...

    def save(self, name: str, result: Any) -> None: ...


@dataclass(frozen=True)
class View:
    """A camera and what it sees, the object included."""

    camera: Camera
    image: np.ndarray  # [H, W, 3] uint8
    is_photo: bool = True  # False: drawn from the scene


class _Run:
    """Runs stages one after the other: times them, keeps their words, and takes finished ones from the store."""

    def __init__(self, store: Store | None, progress: Progress, allow_network: bool = False) -> None:
        self.store, self.progress, self.allow_network = store, progress, allow_network
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

    def call(self, option: str, stage: str, settings: RemovalSettings, strength: float = 1.0) -> Call:
        """What whoever a stage asks outside this program may do."""
        seconds, network = settings.painter_seconds, self.allow_network
        return Call(option, stage, self.progress, seconds, network, settings.prompt, strength)


def remove_object(
    scene: Gaussians,
    views: Sequence[View],
    region: Region,
    settings: RemovalSettings = RemovalSettings(),
    reference: str | None = None,
    reference_image: np.ndarray | None = None,  # [H, W, 3] uint8, the reference without the object
    progress: Progress = silent,
    store: Store | None = None,
    extra_masks: Mapping[str, np.ndarray] | None = None,  # ID → [H, W] bool, filled too: shadows, reflections
    shadow_masks: Mapping[str, np.ndarray] | None = None,  # ID → [H, W] bool, for shadow="mask": its shadow
    allow_network: bool = False,  # whether providers may send pictures off this machine
) -> RemovalResult:
    """Remove what lies in the region and fill what it hid: the stages of docs/method.md, in their order.

    Parameters
    ----------
    views
        Training views and, if it is another one, the reference view. Their images show the scene with the object.
    reference
        ID of the reference view, or chart:N as numbered in the result's charts; None chooses.
    reference_image
        What the reference looks like without the object; None fills it by `settings.inpaint`.

    Returns
    -------
    RemovalResult
        `keep` [N] bool over the scene's rows, `added` new Gaussians (or None); and what each stage says of itself.

    Raises
    ------
    BadInput
        If a provider cannot be used, or the chart that is named does not exist.
    IllPosed
        If the task has no defined answer, with the reason.

    Examples
    --------
    >>> file, region = read_ply("scene.ply"), (Box.make([0, 0, 0.26], [0.62, 0.62, 0.56]),)
    >>> views = [View(c, load_view(c)[0]) for c in read_cameras("transforms.json")]
    >>> result = remove_object(file.gaussians, views, region, PRESETS["draft"])
    >>> bool(result.keep.all()), len(result.added) > 0
    (False, True)
    """
    run = _Run(store, progress, allow_network)
    for notice in provider_notices(settings, allow_network):
        progress("read", 0, 1, notice)
    photos = {v.camera.id: v.image for v in views}
    cameras = [v.camera for v in views]
    for camera in cameras:
        if camera.width < 1 or camera.height < 1:
            raise BadInput(f"camera {camera.id}: a picture of {camera.width}×{camera.height} pixels")
    masks = run("masks", lambda: find_masks(scene, region, cameras, settings.masks, progress, photos, extra_masks))
    run.warnings += masks.warnings
    region = masks.grown(region)
    if not masks.removed.any():
        none = ["nothing to remove: the region holds no Gaussian"]
        return NOT_LIT.with_changes(_finish(run, ~masks.removed, None, masks, (), {}, none), scene)
    if masks.left_out:
        run.warnings.append(f"{len(masks.left_out)} views do not frame the region or lie inside it: not used")
    exposures = _exposures(scene, masks, photos)
    levelled = {name: e.image for name, e in exposures.items()}
    open_views = masks.views
    best: dict[str, tuple[int, Reference]] = {}  # ID → how many pixels the reference painted that painted most of them
    hits: dict[str, Hits] = {}
    charts: tuple[Chart, ...] = ()
    unlit, lit = scene, NOT_LIT
    if settings.charts is not None and masks.mode == "need":
        charted, lit = _charted(run, scene, region, masks, levelled, settings, shadow_masks or {})
        if lit.lifted is not None:
            scene, levelled = lit.lifted.scene(scene), lit.photos(masks.views)
        if charted.charts:
            charts, open_views = charted.charts, charted.targets.views
            hits = {v.camera.id: h for v, h in zip(open_views, charted.targets.hits)}
            masks = replace(masks, selection=charted.selection, views=open_views)
    named = _named_chart(reference, charts, settings)
    shown = _to_paint(charts, open_views, hits)
    run.pictures += [Picture("chart", f"What photos show of {c.camera.id}", c.image, (c.hole,)) for c in shown]
    keep = ~masks.removed
    kept = scene.take(keep)
    run.pictures += _pictures_of_growth(scene, masks, photos)

    def judged(added: Gaussians | None, left: Sequence[ViewMasks], given: Reference | None) -> Verdict | None:
        seen = {v.camera.id for v in views if v.is_photo}
        still_open = [v.target for v in left]
        return run(
            "verdict",
            lambda: judge(scene, keep, added, masks.views, still_open, levelled, seen, charts, hits, given),
            lambda v: (v.score, "; ".join(v.words)) if v else (1.0, "no view shows the object"),
        )

    for v in _spread(open_views):
        run.pictures.append(Picture("mask", f"Region to fill in {v.camera.id}", photos[v.camera.id], (v.target,)))
    if masks.hole_pixels == 0:
        why = "nothing to fill: every view sees what is behind the object"
        if masks.mode == "paper":
            why = "nothing to fill: what surrounds the box covers its outline in every view"
        verdict = judged(None, masks.views, None)
        return lit.with_changes(replace(_finish(run, keep, None, masks, charts, {}, [why]), verdict=verdict), unlit)

    def emptied(v: ViewMasks) -> np.ndarray:
        """A view's photo with the emptied scene in the object's place."""
        silhouette = v.silhouette
        drawn = render_bytes(kept, v.camera, pixels=silhouette)
        return np.where(silhouette[..., None], drawn, levelled[v.camera.id])

    painted = dict(zip((v.camera.id for v in open_views), parallel_map(emptied, open_views)))
    filled, added = kept, None
    told: dict[str, np.ndarray] = {}  # ID → [H, W] the rule that gave each pixel its last colour
    # a picture or a depth that belongs to a view needs that view
    of_view = settings.depth_prior != "auto" or settings.inpaint.startswith("file:")
    as_photo = not charts or reference is not None or of_view
    numbers = range(len(charts))
    turns: list[int | None] = [*[None] * (as_photo * (1 + settings.extra_references)), *numbers]
    if named is not None:
        turns = [named, *(k for k in numbers if k != named)]
        if settings.depth_prior != "auto":
            run.warnings.append(f"--depth-prior {settings.depth_prior} is not used: the reference is a chart")
    done: list[Reference] = []
    for round_, number in enumerate(turns):
        buffers.release()  # a stage's leavings are of little use to the next
        if round_ and _open_pixels(open_views) < settings.extra_gain * masks.hole_pixels:
            break
        first = round_ == 0
        so_far = _SoFar("" if first else f" {round_ + 1}", filled, open_views, charts, hits, levelled, painted)
        try:
            if number is not None:
                given = reference_image if number == named else None
                chart = _carried_over(charts[number], done)
                step = _fill_from_chart(run, so_far, chart, number, settings, number == named, given)
                if step is None:
                    if number == named:
                        run.warnings.append(f"--reference {reference}: no view needs this chart, it is not used")
                    continue
                completed, new, painting = step
            else:
                wanted, given = (reference, reference_image) if first else (None, None)
                completed, new, painting = _fill_from_one_view(run, so_far, settings, wanted, given)
        except IllPosed as error:
            touched = sum(int(v.silhouette.sum()) for v in masks.views)
            if first and masks.hole_pixels > NEGLIGIBLE * touched:
                raise
            run.warnings.append(f"no {'' if first else 'further '}reference view helps: {error}")
            break
        done.append(completed)
        added = new if added is None else added.extended(new)
        filled = kept.extended(added)
        painted.update({p.camera_id: p.pasted(painted[p.camera_id]) for p in painting.views})
        rules = {p.camera_id: p.rule_map(*painted[p.camera_id].shape[:2]) for p in painting.views}
        del painting
        for name, rule in rules.items():
            reached = int(((rule != Rule.UNTOUCHED) & (rule != Rule.UNREACHED)).sum())
            best[name] = max(best.get(name, (0, completed)), (reached, completed), key=lambda found: found[0])
            told[name] = np.where((rule == Rule.UNTOUCHED) | (rule == Rule.UNREACHED), told.get(name, rule), rule)
        near_new = _where_drawn(new, masks.views)
        painted = _redrawn(painted, filled, masks.views, near_new)
        open_views = _all_still_open(open_views, filled, len(added), rules, near_new, settings.masks)
    buffers.release()
    asked = _views_refined(run, masks, painted, told, {name: r for name, (_, r) in best.items()}, settings)
    added = _refined(run, kept, added, masks, painted, told, settings)
    left = _open_pixels(open_views)
    if left > settings.extra_gain * masks.hole_pixels:
        share = left / masks.hole_pixels
        run.warnings.append(f"{share:.0%} of the hole's pixels ({left}) are reached by no reference view and stay open")

    by_picture = reference_image is not None or settings.inpaint.startswith("file:")
    verdict = judged(added, open_views, done[0] if done and by_picture else None)

    shaded = lit.shaded(masks.views)

    def finish(v: ViewMasks) -> None:
        name = v.camera.id
        changed = v.silhouette | v.target | shaded.get(name, False)
        painted[name] = exposures[name].back(painted[name], photos[name], changed)

    parallel_map(finish, masks.views)
    pictures = {r.camera.id: r.image for r in done}
    charts = tuple(replace(c, image=pictures.get(c.camera.id, c.image)) for c in shown)
    result = _finish(run, keep, added, masks, charts, painted, [])
    result = replace(result, open_pixels=left, verdict=verdict, refined_views=asked)
    return lit.with_changes(result, unlit)


def provider_notices(settings: RemovalSettings, allow_network: bool = False) -> list[str]:
    """What providers send where and what that costs, to be said before they do.

    Raises
    ------
    BadInput
        If a provider would fail after minutes: it is unknown, lacks a file or a library, or is not allowed.
    """
    run = _Run(None, silent, allow_network)
    notices = [check_provider(settings.inpaint, run.call("--inpaint", "read", settings))]
    check_depth_prior(settings.depth_prior, run.call("--depth-prior", "read", settings))
    if settings.refine_views:
        if not settings.refine.steps:
            raise BadInput("--refine-views: this preset does no refinement that would use them; use balanced or best")
        if settings.refine_views.partition(":")[0] not in REFINERS:
            raise BadInput(f"--refine-views: unknown provider {settings.refine_views!r}; use http://… or command:CMD")
        notices.append(painter(settings.refine_views, run.call("--refine-views", "read", settings)).notice)
    return [notice for notice in notices if notice]


def _named_chart(reference: str | None, charts: Sequence[Chart], settings: RemovalSettings) -> int | None:
    """The index of the chart that the reference names; None if it names a view, or nothing."""
    number = chart_number(reference)
    if number is None:
        return None
    if not charts:
        why = "photos are the only references of this preset" if settings.charts is None else "no chart is found here"
        raise BadInput(f"--reference {reference}: {why}; name a view")
    if not 1 <= number <= len(charts):
        there = (
            "is 1 chart, chart:1" if len(charts) == 1 else f"are {len(charts)} charts, chart:1 to chart:{len(charts)}"
        )
        raise BadInput(f"--reference {reference}: there {there}")
    return number - 1


def _exposures(scene: Gaussians, masks: Masks, photos: Mapping[str, np.ndarray]) -> dict[str, Exposure]:
    """Every view's photo at the splats' exposure, by ID."""
    kept = scene.take(~masks.removed)

    def level(v: ViewMasks) -> Exposure:
        ring = exposure_ring(v)
        return level_exposure(ring, photos[v.camera.id], render_bytes(kept, v.camera, pixels=ring))

    return dict(zip((v.camera.id for v in masks.views), parallel_map(level, masks.views)))


def with_charts(
    scene: Gaussians,
    region: Region,
    masks: Masks,
    photos: Mapping[str, np.ndarray],  # ID → [H, W, 3] uint8, of every view
    settings: RemovalSettings = RemovalSettings(),
    shadow_masks: Mapping[str, np.ndarray] | None = None,
) -> tuple[Masks, tuple[Chart, ...], Relit]:
    """The masks that a removal really uses, its charts with what photos show of them (see _to_paint), and the shadow.

    If there are any, the masks' targets are what no photo shows of them.
    """
    if settings.charts is None or masks.mode != "need" or not masks.removed.any():
        return masks, (), NOT_LIT
    levelled = {name: e.image for name, e in _exposures(scene, masks, photos).items()}
    run = _Run(None, silent)
    charted, lit = _charted(run, scene, masks.grown(region), masks, levelled, settings, shadow_masks or {})
    if not charted.charts:
        return masks, (), lit
    masks = replace(masks, selection=charted.selection, views=charted.targets.views)
    hits = {v.camera.id: h for v, h in zip(masks.views, charted.targets.hits)}
    return masks, _to_paint(charted.charts, masks.views, hits), lit


@dataclass(frozen=True)
class Surfaces:
    """What is round the object, and where photos show it; tuples are of the masks' views."""

    planes: tuple[Plane, ...]
    objects: tuple[tuple[np.ndarray, np.ndarray], ...]  # see object_pixels
    marked: tuple[np.ndarray, ...]  # [H, W] bool, what the user named beside the object
    confidence: float
    reason: str

    def witnesses(self, views: Sequence[ViewMasks], photos: Mapping[str, np.ndarray]) -> list[Witness]:
        return [
            Witness(v.camera, photos[v.camera.id], o | m, s, v.depth_before)
            for v, (o, s), m in zip(views, self.objects, self.marked)
        ]


@dataclass(frozen=True)
class Relit:
    """What the object does to the light round it undone, or why it is not."""

    lifted: Lifted | None
    shadow: dict[str, Any]  # see Shadow.facts
    reflection: dict[str, Any]  # see Reflection.facts

    def photos(self, views: Sequence[ViewMasks]) -> dict[str, np.ndarray]:
        assert self.lifted is not None
        return {v.camera.id: photo for v, photo in zip(views, self.lifted.photos)}

    def shaded(self, views: Sequence[ViewMasks]) -> dict[str, np.ndarray]:
        return {v.camera.id: s for v, s in zip(views, self.lifted.shaded)} if self.lifted else {}

    def pictures(self, views: Sequence[ViewMasks], shown: ViewMasks) -> list[Picture]:
        """A view's photo, the light that arrives, and the photo as it would be; nothing if nothing changes there."""
        for k, view in enumerate(views):
            if view.camera.id == shown.camera.id and self.lifted is not None and self.lifted.shaded[k].any():
                what = [n for n, f in (("shadow", self.shadow), ("reflection", self.reflection)) if f["found"]]
                title = f"The object's {' and '.join(what)} in {view.camera.id}: photo, what is left alone, undone"
                lifted = self.lifted
                return [Picture("shadow", title, lifted.before[k], (lifted.light[k], lifted.photos[k]))]
        return []

    def with_changes(self, result: RemovalResult, scene: Gaussians) -> RemovalResult:
        """The result with the Gaussians whose light changed: as any changed row, they are removed and added."""
        result = replace(result, shadow=self.shadow, reflection=self.reflection)
        if self.lifted is None or not len(self.lifted.rows):
            return result
        changed = np.zeros(len(scene), bool)
        changed[self.lifted.rows] = True
        changed &= result.keep  # some were taken away since
        relit = self.lifted.scene(scene).take(changed)
        added = relit if result.added is None else relit.extended(result.added)
        return replace(result, keep=result.keep & ~changed, added=added, lifted=int(changed.sum()))


NOT_LOOKED_FOR = "not looked for"
NOT_LIT = Relit(
    None,
    {"found": False, "lights": [], "explained": 0.0, "reason": NOT_LOOKED_FOR},
    {"found": False, "explained": 0.0, "reason": NOT_LOOKED_FOR},
)


def _charted(
    run: _Run,
    scene: Gaussians,
    region: Region,
    masks: Masks,
    photos: dict[str, np.ndarray],  # at the splats' exposure
    settings: RemovalSettings,
    shadow_masks: Mapping[str, np.ndarray],
) -> tuple[Charted, Relit]:
    """The surfaces that the object hid, without its shadow."""
    surfaces: Surfaces = run("surfaces", lambda: _surfaces(scene, region, masks, photos, settings))
    lit = _light(run, scene, region, masks, surfaces, photos, settings, shadow_masks)
    if lit.lifted is not None:
        scene, photos = lit.lifted.scene(scene), lit.photos(masks.views)
        marked = tuple(m | d for m, d in zip(surfaces.marked, lit.lifted.dark))
        surfaces = replace(surfaces, marked=marked)
    return run("charts", lambda: _chart(scene, region, masks, surfaces, photos, settings)), lit


def _surfaces(
    scene: Gaussians, region: Region, masks: Masks, photos: Mapping[str, np.ndarray], settings: RemovalSettings
) -> Surfaces:
    assert settings.charts is not None
    views = masks.views
    # what the user named beside the object, by a mask or a box of its own: masks let no depth stand there
    marked = tuple(v.silhouette & v.target & (v.depth_before == 0) & (v.alpha_before > 0) for v in views)
    objects = tuple(object_pixels(scene, masks.removed, views, settings.clearing))
    found = Surfaces((), objects, marked, 1.0, "")
    planes = find_planes(views, found.witnesses(views, photos), region, settings.charts)
    return replace(found, planes=planes, reason=f"{len(planes)} planes run into what the object hid")


def _light(
    run: _Run,
    scene: Gaussians,
    region: Region,
    masks: Masks,
    surfaces: Surfaces,
    photos: Mapping[str, np.ndarray],
    settings: RemovalSettings,
    shadow_masks: Mapping[str, np.ndarray],
) -> Relit:
    """Find the object's reflection and its shadow, and undo them."""
    if settings.shadow == "off":
        return NOT_LIT
    witnesses, planes = surfaces.witnesses(masks.views, photos), surfaces.planes

    def find() -> Found:
        if not planes:
            none = "no surface is known round the object"
            return Found(None, f"no reflection found: {none}", None, f"no shadow found: {none}")
        grounds, gone = look_at(planes, masks.views, witnesses, region), scene.take(masks.removed)
        reflection = find_reflection(gone, planes[0], grounds, witnesses, region)
        looked: Sequence[Witness] = witnesses
        if isinstance(reflection, Reflection):
            bare = bare_photos(reflection, witnesses)
            looked = [replace(w, photo=photo) for w, (photo, _, _) in zip(witnesses, bare)]
            grounds = look_at(planes, masks.views, looked, region)
        if settings.shadow == "mask":
            shadow = marked_shadow([shadow_masks.get(v.camera.id) for v in masks.views], grounds, looked)
        else:
            shadow = find_shadow(gone, planes, grounds, region)
        return Found.of(reflection, shadow)

    found: Found = run("light", find)
    if found.shadow is None and settings.shadow == "mask":
        run.warnings.append(found.why_shadow)
    facts = [
        {**(what.facts() if what is not None else none), "reason": why}
        for what, why, none in (
            (found.shadow, found.why_shadow, NOT_LIT.shadow),
            (found.reflection, found.why_reflection, NOT_LIT.reflection),
        )
    ]
    if found.shadow is None and found.reflection is None:
        return Relit(None, *facts)

    def lift() -> Lifted:
        first = None
        lit, looked = scene, witnesses
        if found.reflection is not None:
            first = subtract_reflection(scene, masks.removed, found.reflection, witnesses)
            lit, looked = first.scene(scene), [replace(w, photo=p) for w, p in zip(witnesses, first.photos)]
        if found.shadow is None:
            assert first is not None
            return first
        lifted = lift_shadow(lit, masks.removed, found.shadow, looked)
        return lifted if first is None else lifted.after(first)

    relit = Relit(run("lift", lift), *facts)
    most = sorted(masks.views, key=lambda v: -int(relit.shaded(masks.views)[v.camera.id].sum()))
    run.pictures += [picture for v in most[:2] for picture in relit.pictures(masks.views, v)]
    return relit


@dataclass(frozen=True)
class Found:
    """What the object does to the light round it, as far as it is found."""

    reflection: Reflection | None
    why_reflection: str
    shadow: Shadow | None
    why_shadow: str

    @classmethod
    def of(cls, reflection: Reflection | str, shadow: Shadow | str) -> Found:
        one = (None, reflection) if isinstance(reflection, str) else (reflection, reflection.reason)
        other = (None, shadow) if isinstance(shadow, str) else (shadow, shadow.reason)
        return cls(*one, *other)

    @property
    def confidence(self) -> float:
        return min((f.confidence for f in (self.reflection, self.shadow) if f is not None), default=0.0)

    @property
    def reason(self) -> str:
        return f"{self.why_shadow}; {self.why_reflection}"


@dataclass(frozen=True)
class Charted:
    """The surfaces that the object hid, and what follows from them."""

    charts: tuple[Chart, ...]
    selection: Selection  # with what had to be cleared away
    targets: Targets
    confidence: float
    reason: str


def _chart(
    scene: Gaussians,
    region: Region,
    masks: Masks,
    surfaces: Surfaces,
    photos: Mapping[str, np.ndarray],  # at the splats' exposure
    settings: RemovalSettings,
) -> Charted:
    """Show the hidden surfaces, clear the air before them, and say where they have to be filled."""
    assert settings.charts is not None
    views, marked = masks.views, surfaces.marked
    witnesses = surfaces.witnesses(views, photos)
    charts = draw_charts(surfaces.planes, views, witnesses, region, settings.charts, marked)
    if not charts:
        return Charted((), masks.selection, Targets((), ()), 0.0, "no surface runs into what the object hid")
    tolerance, scatter = max(c.tolerance for c in charts), max(c.scatter for c in charts)
    selection = clear_air(scene, region, masks.selection, views, witnesses, charts, scatter, settings.clearing)
    targets = chart_targets(scene, selection, views, witnesses, charts, tolerance, marked, settings.clearing)
    words = [f"{c.kind}: {c.reason}, {int(c.hole.sum())} texels that no photo shows" for c in charts]
    cleared = int(selection.removed.sum() - masks.removed.sum())
    return Charted(charts, selection, targets, charts[0].agreement, "; ".join([*words, f"{cleared} of haze go"]))


@dataclass(frozen=True)
class _SoFar:
    """How far the removal has come when a reference is to be completed."""

    suffix: str  # of the stages' names
    filled: Gaussians  # the scene without the object, the new Gaussians in it
    views: Sequence[ViewMasks]  # what is open of them
    charts: Sequence[Chart]
    hits: dict[str, Hits]  # by ID, where charts are; empty without them
    photos: dict[str, np.ndarray]  # by ID, with the object, at the splats' exposure
    painted: dict[str, np.ndarray]  # by ID, without it, as far as that is known


def _fill_from_chart(
    run: _Run,
    so_far: _SoFar,
    chart: Chart,
    number: int,  # its index
    settings: RemovalSettings,
    named: bool = False,  # the user's reference
    given: np.ndarray | None = None,  # [H, W, 3] uint8, its picture
) -> tuple[Reference, Gaussians, Propagation] | None:
    """Complete one chart, carry it into every view, and make its Gaussians; None if no view needs it."""
    target, hole = _texels_to_fill(chart, number, so_far.views, so_far.hits)
    if not target.any():
        return None

    def complete() -> Appearance:
        if given is not None:
            return paste_picture(chart.image, hole | chart.hole, given, "--reference-image", chart.known)
        of_another = settings.inpaint.startswith("file:") and not named
        return inpaint_reference(
            "exemplar" if of_another else settings.inpaint,
            chart.image,
            hole,
            settings.random_seed,
            None if chart.kind == "plane" else disparity_of(chart.depth),
            chart.camera.K,
            ~chart.known & ~hole,
            run.call("--inpaint", f"appearance{so_far.suffix}", settings),
        )

    appearance: Appearance = run(f"appearance{so_far.suffix}", complete)
    run.warnings += appearance.warnings
    source = ~target & ~hole & chart.known

    return _carried(
        run,
        so_far,
        chart.camera,
        appearance,
        chart.depth,
        target,
        source,
        lambda v, _: _on_charts(v, so_far, [chart]),
        settings,
    )


def _rough(charts: Sequence[Chart], settings: RemovalSettings) -> bool:
    """The views' drawn surfaces scatter about the charts by more than a z-test allows."""
    return any(c.scatter > settings.propagate.depth_tolerance for c in charts)


def _on_charts(v: ViewMasks, so_far: _SoFar, charts: Sequence[Chart]) -> ViewToPaint:
    """The view with the charts for its depth, where its own is theirs or none."""
    name = v.camera.id
    there = so_far.hits[name].depth
    tolerance, scatter = max(c.tolerance for c in charts), max(c.scatter for c in charts)
    behind = (v.depth_after == 0) | (v.depth_after > (1 - tolerance) * there)
    after = np.where(v.target & (there > 0) & behind, there, snapped(v.depth_after, there, scatter))
    before = snapped(v.depth_before, there, scatter)
    return ViewToPaint(v.camera, so_far.photos[name], so_far.painted[name], v.silhouette, v.target, before, after)


def _as_drawn(v: ViewMasks, so_far: _SoFar, with_seeds: Gaussians, settings: RemovalSettings) -> ViewToPaint:
    """The view with the depth of its splats, the new ones among them."""
    name, after = v.camera.id, np.zeros_like(v.depth_before)
    if v.target.any():
        window = window_mask(near_hole(v.target, settings.propagate), v.camera)
        after = surface_depth(with_seeds, v.camera, pixels=window)[0]
    photo, painted = so_far.photos[name], so_far.painted[name]
    return ViewToPaint(v.camera, photo, painted, v.silhouette, v.target, v.depth_before, after)


def _carried_over(chart: Chart, done: Sequence[Reference]) -> Chart:
    """The chart with what completed references show of its hole: a picture that was given rules where it sees it."""
    points = chart.camera.unproject(chart.camera.pixel_centres(), chart.depth.astype(np.float64))
    for reference in done:
        open_points = np.argwhere(chart.hole)
        if not len(open_points):
            break
        rows, cols = open_points.T
        uv, _ = reference.camera.project(points[rows, cols])
        same = SAME_TEXELS / reference.camera.fx if reference.camera.split == CHART else SAME
        seen = sees(reference.camera, np.where(reference.target, reference.depth, 0), points[rows, cols], same)
        x, y = np.where(seen[:, None], uv, 0).astype(np.float32).T[:, :, None] - np.float32(0.5)
        colours = cv2.remap(reference.image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)[:, 0]
        image, known, hole = chart.image.copy(), chart.known.copy(), chart.hole.copy()
        photos = chart.photos.copy()
        shown = rows[seen], cols[seen]
        image[shown], known[shown], hole[shown], photos[shown] = colours[seen], True, False, 1
        chart = replace(chart, image=image, known=known, hole=hole, photos=photos)
    return chart


def snapped(
    depth: np.ndarray,  # [H, W] z, 0 = nothing
    there: np.ndarray,  # [H, W] z of a chart, 0 = none
    tolerance: float,  # relative
) -> np.ndarray:
    """The depth, but the chart's where it is the chart's surface: splats' depths are rough, photos place charts."""
    same = (there > 0) & (np.abs(depth - there) < tolerance * there)
    return np.where(same, there, depth)


def _texels_to_fill(
    chart: Chart, number: int, views: Sequence[ViewMasks], hits: dict[str, Hits]
) -> tuple[np.ndarray, np.ndarray]:
    """[H, W] bool each: texels that views need, and those that are filled for that, as no photo shows them well."""
    target = _needed_texels(chart, number, views, hits)
    hole = target & (chart.hole | (chart.photos == 0))
    return target, hole


def _to_paint(charts: Sequence[Chart], views: Sequence[ViewMasks], hits: dict[str, Hits]) -> tuple[Chart, ...]:
    """The charts as a user gets them: the hole is all that a picture of one has to show."""
    return tuple(
        replace(c, hole=c.hole | _texels_to_fill(c, number, views, hits)[1]) for number, c in enumerate(charts)
    )


def _needed_texels(chart: Chart, number: int, views: Sequence[ViewMasks], hits: dict[str, Hits]) -> np.ndarray:
    """[H, W] bool: texels that the targets of some view meet."""
    marked = np.zeros(chart.hole.shape, np.uint8)
    for view in views:
        met = hits[view.camera.id]
        on = view.target & (met.chart == number)
        marked[met.rows[on], met.cols[on]] = 1
    # a view that looks on from the side or from afar has fewer pixels than the chart has texels
    kernel = np.ones((5, 5), np.uint8)
    closed = cv2.morphologyEx(marked, cv2.MORPH_CLOSE, kernel) > 0
    needed = (closed | (chart.hole & (cv2.dilate(marked, kernel) > 0))) & chart.there
    return needed | (scipy.ndimage.binary_fill_holes(needed) & chart.hole)


def _views_refined(
    run: _Run,
    masks: Masks,
    painted: dict[str, np.ndarray],  # changed where an answer is accepted
    told: dict[str, np.ndarray],  # the same
    references: Mapping[str, Reference],  # ID → the one that painted most of the view
    settings: RemovalSettings,
) -> dict[str, Any]:
    """Ask a painter to refine the painted views beside their reference; returns what became of that."""
    if not settings.refine_views:
        return {}
    views = [
        ViewToRefine(v.camera.id, painted[v.camera.id], told[v.camera.id], references[v.camera.id].image,
                     references[v.camera.id].target)
        for v in masks.views
        if v.camera.id in told
    ]  # fmt: skip
    call = run.call("--refine-views", "refine views", settings, REFINING)
    asked: ViewRefinement = run(
        call.stage,
        lambda: refine_views(
            painter(settings.refine_views, call), looked_at(views, settings.refine), settings.random_seed, call
        ),
    )
    pictures = []
    for view in asked.views:
        name = view.camera_id
        if view.image is None:
            run.warnings.append(f"--refine-views: {name} is left as it was: {view.reason}")
            continue
        before, rule = painted[name], told[name]
        told[name] = np.where((view.image != before).any(-1), np.uint8(Rule.REFINED), rule)
        painted[name] = view.image
        pictures.append(Picture("refined", f"{name} refined: before, after", view.image, (before,)))
    run.pictures += _spread(pictures)
    return {"provider": settings.refine_views, **asked.facts()}


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
    so_far: _SoFar,
    settings: RemovalSettings,
    wanted: str | None,  # ID of the reference; None chooses
    given: np.ndarray | None,  # [H, W, 3] uint8, its picture
) -> tuple[Reference, Gaussians, Propagation]:
    """Complete one reference, carry it into every view, and make its Gaussians."""
    solid, tried = settings.masks.solid, {c.camera_id for c in run.references}
    choice: ReferenceChoice = run(
        f"reference{so_far.suffix}", lambda: choose_reference(so_far.views, wanted, solid, settings.reference, tried)
    )
    run.references.append(choice)
    view = next(v for v in so_far.views if v.camera.id == choice.camera_id)
    base, rough = so_far.painted[view.camera.id], _rough(so_far.charts, settings)
    completed: DepthCompletion = run(
        f"depth{so_far.suffix}",
        lambda: _complete_depth(
            view, so_far.views, so_far.hits, base, settings, given, run, f"depth{so_far.suffix}", not so_far.suffix
        ),
    )
    depth = np.where(view.target, completed.depth, view.depth_after).astype(np.float32)
    if rough:
        scatter = max(c.scatter for c in so_far.charts)
        depth = snapped(depth, so_far.hits[view.camera.id].depth, scatter).astype(np.float32)
    appearance: Appearance = run(
        f"appearance{so_far.suffix}",
        lambda: _appearance(
            view,
            depth,
            so_far.views,
            so_far.photos,
            base,
            settings,
            given,
            run.call("--inpaint", f"appearance{so_far.suffix}", settings),
        ),
    )
    run.warnings += appearance.warnings
    name = view.camera.id
    run.pictures += [
        Picture("depth", f"Completed surface in {name}", appearance.image, (depth, view.target)),
        *_fit_picture(completed, appearance.image, name),
    ]

    def to_paint(v: ViewMasks, with_seeds: Gaussians) -> ViewToPaint:
        return _on_charts(v, so_far, so_far.charts) if rough else _as_drawn(v, so_far, with_seeds, settings)

    source = ~view.target & ~view.silhouette & (depth > 0)
    completed_reference, new, painting = _carried(
        run, so_far, view.camera, appearance, depth, view.target, source, to_paint, settings
    )
    return completed_reference, new, _with_reference(painting, view, appearance)


def _carried(
    run: _Run,
    so_far: _SoFar,
    camera: Camera,  # the reference
    appearance: Appearance,
    depth: np.ndarray,
    target: np.ndarray,
    source: np.ndarray,
    to_paint: Callable[[ViewMasks, Gaussians], ViewToPaint],
    settings: RemovalSettings,
) -> tuple[Reference, Gaussians, Propagation]:
    """A completed reference in every view, and the Gaussians that show it."""
    at_chart = camera.split == CHART
    seeds = seed_gaussians(camera, appearance.image, depth, target, so_far.filled.is_surfels, settings.seed, at_chart)
    if len(seeds) == 0:
        raise IllPosed(f"reference {camera.id}: what is behind the object is infinitely far; nothing to build")
    with_seeds = so_far.filled.extended(seeds)
    field_: MappingField = run(
        f"mapping{so_far.suffix}",
        lambda: mapping_field(
            appearance.image,
            target,
            source,
            source_visibility(
                camera,
                depth,
                [(v.camera, v.depth_before, v.silhouette) for v in so_far.views],
                settings.mapping,
            ),
            settings.mapping,
            settings.random_seed,
            camera,
            depth,
        ),
    )
    reference = Reference(camera, appearance.image, depth, target, source, field_.rows, field_.cols)
    painting: Propagation = run(
        f"propagate{so_far.suffix}",
        lambda: propagate(
            reference, [partial(to_paint, v, with_seeds) for v in so_far.views], settings.propagate, run.progress
        ),
    )
    name = camera.id
    run.pictures += [
        Picture("appearance", f"The reference without the object, {name}", appearance.image, (target,)),
        Picture("mapping", f"Mapping field of {name}", appearance.image, (field_.rows, field_.cols)),
        *(
            Picture(
                "rules",
                f"Filled view {p.camera_id}",
                p.pasted(so_far.painted[p.camera_id]),
                (p.rule_map(*so_far.painted[p.camera_id].shape[:2]), p.pasted(so_far.painted[p.camera_id], p.raw)),
            )
            for p in _spread(painting.views)
        ),
    ]
    cameras = [v.camera for v in so_far.views]
    new: Gaussians = run(
        f"seed{so_far.suffix}",
        lambda: settle_gaussians(
            so_far.filled,
            colour_gaussians(seeds, camera, cameras, painting.views, so_far.filled.sh_degree, settings.seed),
            camera,
            cameras,
            painting.views,
            settings.seed,
        ),
        lambda g: (1.0, f"{len(g)} new Gaussians"),
    )
    return reference, new, painting


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
    hits: dict[str, Hits],
    base: np.ndarray,
    settings: RemovalSettings,
    given: np.ndarray | None,
    run: _Run,
    stage: str = "depth",
    first: bool = True,  # reference; a file's prior is of that view
) -> DepthCompletion:
    """The reference's depth: the charts', unless the user has another prior.

    A model that estimates it looks at the picture given, or at a first fill.
    """
    if hits and settings.depth_prior == "auto":
        there = hits[view.camera.id].depth
        depth = np.where(view.target & (there > 0), there, view.depth_after).astype(np.float32)
        share = float((there[view.target] > 0).mean())
        words = f"{share:.0%} of the hole lies on charts"
        known = np.ones(depth.shape, np.float32)
        return DepthCompletion(
            disparity_of(depth), depth, known, 0.0, np.zeros((0, 2), np.float32), (0.0, 0.0), 0, 0, share, words
        )
    picture, spec = None, settings.depth_prior
    if spec.startswith("file:") and not first:
        spec = "auto"
    if looks(spec):
        if given is not None:
            picture = paste_picture(base, view.target, given, "--reference-image", ~view.silhouette).image
        else:
            first_fill = run.call("--inpaint", stage, settings)
            picture = inpaint_reference(
                settings.inpaint, base, view.target, settings.random_seed, call=first_fill
            ).image
    call = run.call("--depth-prior", stage, settings)
    prior = depth_prior(spec, view.camera.height, view.camera.width, picture, call)
    surface: Any = spec if spec in ("harmonic", "planar") else settings.depth.surface
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
            completed = _complete_depth(view, views, {}, picture, settings, None, _Run(None, silent))
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
    call: Call,
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
    filled = inpaint_reference(
        settings.inpaint, base, hole, settings.random_seed, disparity_of(depth), view.camera.K, call=call
    )
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


def _pictures_of_growth(scene: Gaussians, masks: Masks, photos: Mapping[str, np.ndarray]) -> list[Picture]:
    """What of the object the boxes cut off, in the two views that show most of it."""
    if masks.growth is None or not masks.growth.rows.any():
        return []
    rows, title = masks.growth.rows, "Taken along" if masks.growth.taken else "Cut off by the box"
    cut = scene.take(rows)

    def shown(v: ViewMasks) -> np.ndarray:
        window = window_mask(touched_window(cut, v.camera), v.camera)
        return footprint(scene, v.camera, rows, pixels=window) > 0.25

    found = zip(masks.views, parallel_map(shown, masks.views))
    most = sorted(found, key=lambda pair: -int(pair[1].sum()))[:2]
    return [Picture("mask", f"{title}, in {v.camera.id}", photos[v.camera.id], (mask,)) for v, mask in most]


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
    charts: Sequence[Chart],
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
        charts=tuple(charts),
        pictures=tuple(run.pictures),
        references=tuple(run.references),
        warnings=tuple(run.warnings + warnings),
        selection=masks.selection.counts,
        proposed=masks.proposed,
    )


# What a stage store has to know to bring results back.
STORED = (
    Box,
    Camera,
    Chart,
    Charted,
    Found,
    Gaussians,
    Ground,
    Growth,
    Hits,
    Lifted,
    Light,
    Masks,
    Occluder,
    Plane,
    Reflection,
    Selection,
    Shadow,
    Surfaces,
    Targets,
    ViewMasks,
    ReferenceChoice,
    ViewScore,
    DepthCompletion,
    MappingField,
    Propagation,
    PaintedView,
    Appearance,
    Refinement,
    RefinedView,
    ViewRefinement,
    Verdict,
)

"""A removal from beginning to end: a scene, its views and a region in, the scene without the object out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from . import pictures
from .behind import Behind, look_behind
from .box import Region
from .compute.threads import parallel_map
from .errors import BadInput, IllPosed
from .filling import Filling, ask_for_refinement, fill_hole, recolour, refine
from .frame import Frame, frame_of
from .gaussians import Gaussians
from .presets import PRESETS, RemovalSettings
from .priors.inpaint import check_provider, painter
from .priors.monodepth import depth_provider
from .progress import Progress, silent
from .raster import render_bytes
from .run import Observer, Picture, RemovalResult, Run, StageReport, Store, View, ViewState, open_pixels
from .stages.masks import find_masks
from .stages.selection import Selection
from .stages.verdict import Verdict, judge
from .steps.behind import (
    Relit,
)
from .steps.references import charts_to_paint, complete_view_depth, turns_of

__all__ = [
    "PRESETS", "Picture", "RemovalResult", "RemovalSettings", "StageReport", "View", "look", "preview",
    "provider_notices", "remove_object", "render_bytes",
]  # fmt: skip
REFINERS = ("command", "http", "https")  # who may be asked to refine views


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
    observer: Observer | None = None,  # runs each stage: to watch it, or to replace it
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
        `keep` [N] bool over the scene's rows, `added` new Gaussians (or None; their means are float64 where the
        scene's units or origin ask for it, see frame.py); and what each stage says of itself.

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
    frame = frame_of(scene, [v.camera for v in views])
    run = Run(settings, progress, store, allow_network, observer)
    for notice in provider_notices(settings, allow_network):
        progress("read", 0, 1, notice)
    behind = look(run, frame, scene, views, region, extra_masks or {}, shadow_masks or {})
    result = _filled(run, views, behind, reference, reference_image)
    charts, proposed = frame.charts_back(result.charts), frame.proposed_back(result.proposed)
    return replace(result, added=frame.back(result.added), charts=charts, proposed=proposed)


def look(
    run: Run,
    frame: Frame,  # in which the result is; all else is in the file's
    scene: Gaussians,
    views: Sequence[View],
    region: Region,
    extra_masks: Mapping[str, np.ndarray],
    shadow_masks: Mapping[str, np.ndarray],
) -> Behind:
    """What goes, what that leaves open in every view, and what is behind it."""
    scene, region = frame.scene(scene), frame.region(region)
    cameras, photos = [frame.camera(v.camera) for v in views], {v.camera.id: v.image for v in views}
    for camera in cameras:
        if camera.width < 1 or camera.height < 1:
            raise BadInput(f"camera {camera.id}: a picture of {camera.width}×{camera.height} pixels")
    settings = run.settings.masks
    if run.settings.charts is None:  # nothing else tells T then
        settings = replace(settings, mode="paper")
    masks = run("masks", find_masks, scene, region, cameras, settings, run.progress, photos, extra_masks)
    run.warnings += masks.warnings
    if masks.removed.any() and (left_out := len(cameras) - len(masks.views)):
        run.warnings.append(f"{left_out} views do not frame the region or lie inside it: not used")
    return look_behind(run, scene, region, masks, photos, shadow_masks)


def _filled(
    run: Run, views: Sequence[View], behind: Behind, reference: str | None, reference_image: np.ndarray | None
) -> RemovalResult:
    """The result with the hole filled, as far as there is one."""
    settings, masks = run.settings, behind.masks
    if not masks.removed.any():
        run.warnings.append("nothing to remove: the region holds no Gaussian")
        return _result(run, behind)
    to_paint = charts_to_paint(behind.charts, behind.views)
    turns = turns_of(reference, reference_image, behind.charts, settings)
    run.pictures += pictures.of_light(behind.lit, [v.id for v in behind.views])
    run.pictures += pictures.of_charts(to_paint)
    run.pictures += pictures.of_growth(behind.scene, masks, behind.views)
    run.pictures += pictures.of_targets(behind.views)

    filling = Filling(behind.scene.take(~masks.removed), behind.views)
    if masks.hole_pixels:
        filling = fill_hole(run, filling, behind.charts, turns)
        filling = recolour(run, refine(run, ask_for_refinement(run, filling)))
        behind = behind.recoloured(filling.kept, filling.recoloured)
    else:
        why = "every view sees what is behind the object"
        if masks.mode == "paper":
            why = "what surrounds the box covers its outline in every view"
        elif not behind.charts:
            why = "no surface is found of which the object hides something from every view"
        run.warnings.append(f"nothing to fill: {why}")
    if (left := open_pixels(filling.views)) > settings.extra_gain * masks.hole_pixels:
        share = left / masks.hole_pixels
        run.warnings.append(f"{share:.0%} of the hole's pixels ({left}) are reached by no reference view and stay open")
    by_picture = reference_image is not None or settings.inpaint.startswith("file:")
    verdict = _judge(run, views, behind, filling, by_picture)
    completed = {r.camera.id: r.image for r in filling.done}
    return _result(
        run,
        behind,
        filling.added,
        open_pixels=left,
        painted=_painted(filling, behind.lit) if masks.hole_pixels else {},
        charts=tuple(replace(c, image=completed.get(c.camera.id, c.image)) for c in to_paint),
        verdict=verdict,
        refined_views=filling.asked,
    )


def _judge(run: Run, views: Sequence[View], behind: Behind, filling: Filling, by_picture: bool) -> Verdict | None:
    """How good the result probably is; a reference whose picture was given is what it is held against."""
    photos, photographed = {v.id: v.bare for v in filling.views}, {v.camera.id for v in views if v.is_photo}
    hits = {v.id: v.hits for v in filling.views if v.hits is not None}
    given = filling.done[0] if filling.done and by_picture else None
    final, still_open = filling.kept.extended(filling.added), [v.left.target for v in filling.views]
    inputs = behind.before, final, behind.masks.views, still_open, photos, photographed, behind.charts, hits, given
    nothing = 1.0, "no view shows the object"
    return run("verdict", judge, *inputs, words=lambda v: (v.score, "; ".join(v.words)) if v else nothing)


def provider_notices(settings: RemovalSettings, allow_network: bool = False) -> list[str]:
    """What providers send where and what that costs, to be said before they do.

    BadInput if one would fail after minutes: it is unknown, lacks a file or a library, or is not allowed.
    """
    run = Run(settings, silent, allow_network=allow_network)
    notices = [check_provider(settings.inpaint, run.call("--inpaint", "read"))]
    depth_provider(settings.depth_prior, run.call("--depth-prior", "read"))
    if settings.refine_views:
        if not settings.refine.steps:
            raise BadInput("--refine-views: this preset does no refinement that would use them; use balanced or best")
        if settings.refine_views.partition(":")[0] not in REFINERS:
            raise BadInput(f"--refine-views: unknown provider {settings.refine_views!r}; use http://… or command:CMD")
        notices.append(painter(settings.refine_views, run.call("--refine-views", "read")).notice)
    return [notice for notice in notices if notice]


def _painted(filling: Filling, lit: Relit) -> dict[str, np.ndarray]:
    """ID → the view's photo, at its own exposure, with what the removal changed of it."""

    def finished(number: int) -> np.ndarray:
        v, shaded = filling.views[number], lit.lifted.shaded[number] if lit.lifted else False
        return v.exposure.back(v.painted, v.photo, v.masks.silhouette | v.masks.target | shaded)

    return dict(zip((v.id for v in filling.views), parallel_map(finished, range(len(filling.views)))))


def _result(run: Run, behind: Behind, added: Gaussians | None = None, **more: Any) -> RemovalResult:
    """What stays, but not as it was, counts as removed and added."""
    masks, lit, keep = behind.masks, behind.lit, ~behind.masks.removed
    changed = np.intersect1d(behind.changed, np.flatnonzero(keep))  # some were taken away since
    lifted = int(keep[lit.rows].sum())
    keep[changed] = False
    given = len(keep) - behind.parts
    return RemovalResult(
        keep=keep[:given],
        added=behind.scene.take(changed).extended(added) if len(changed) else added,
        stages=tuple(run.stages),
        hole_pixels=masks.hole_pixels,
        views=len(masks.views),
        pictures=tuple(run.pictures),
        references=tuple(run.references),
        warnings=tuple(run.warnings),
        selection=Selection(masks.selection.fates[:given]).counts,
        proposed=masks.proposed,
        lifted=lifted,
        changed=len(changed),
        **lit.facts(),
        **more,
    )


def preview(view: ViewState, settings: RemovalSettings) -> list[Picture]:
    """What a removal would do in a view: where it would fill, on what surface, and how a depth prior was scaled."""
    target, run = view.left.target, Run(settings)
    shown = pictures.of_targets([view])
    if target.any():
        calls = run.call("--inpaint", "depth"), run.call("--depth-prior", "depth")
        try:
            completed = complete_view_depth(view, settings, None, True, *calls)
        except IllPosed:
            return shown  # the region is worth seeing all the more
        depth = np.where(target, completed.depth, view.left.depth_after).astype(np.float32)
        shown += pictures.of_depth(completed, depth, target, view.id)
    return shown

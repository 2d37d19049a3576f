"""References without the object: which comes next, its depth and picture, and how it is carried into all views.

A completed reference is tiled with Gaussians; views are painted with it, and the Gaussians take the colours that views
were painted with. What no reference reaches stays open.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
import scipy.ndimage

from ..camera import Camera
from ..compute.threads import parallel_map
from ..errors import BadInput
from ..gaussians import Gaussians
from ..geometry import SOLID, colours_at, dilated, disparity_of, sees, window_mask
from ..orbit import cameras_between
from ..presets import RemovalSettings
from ..priors.calls import Call
from ..priors.inpaint import PROVIDERS, inpaint_reference
from ..priors.monodepth import depth_prior
from ..priors.pasting import Appearance, paste_picture
from ..progress import Progress
from ..raster import Window, drawing, render_bytes, surface_depth, touched_window
from ..run import ViewState
from ..stages.charts import CHART, Chart, chart_number, first_hits, pictured
from ..stages.depth import DepthCompletion, PriorFit, complete_depth
from ..stages.exposure import Exposure
from ..stages.masks import ViewMasks
from ..stages.propagate import PaintedView, Propagation, Reference, Rule, ViewToPaint, near_hole, propagate, round_hole
from ..stages.propagate.paper import MappingField, mapping_field, source_visibility
from ..stages.reference import rim

SAME = 0.01  # relative z within which two references show the same surface
SAME_TEXELS = 1.0  # of a chart, within which it is that of another one: its camera stands too far away for shares of z
CUBIC = np.ones((5, 5), np.uint8)  # px of a picture that a colour between them is made of: none may show the object
OPAQUE = 0.99  # alpha of the emptied scene below which a gap shows through
LAYER_STEP = 0.05  # relative z step that parts two surfaces
MARGIN = 2  # px round T in which splats mix what is old and new
DRAWN = 0.5  # blend weight of new Gaussians from which they cover a pixel


@dataclass(frozen=True)
class Turn:
    """What is completed next."""

    chart: int | None = None  # index of a chart; None: a view
    name: str | None = None  # ID of the view, or the chart's name, if the user gave one
    picture: np.ndarray | None = None  # [H, W, 3] uint8, what the user gave for it


@dataclass(frozen=True)
class Completed(Reference):
    """A reference without the object; its target is what views need of what was completed."""

    charts: tuple[Chart, ...]  # that views take their depths from; none: from their splats


def turns_of(
    reference: str | None, picture: np.ndarray | None, charts: Sequence[Chart], settings: RemovalSettings
) -> list[Turn]:
    """In which order references are completed, as far as there is something left to fill.

    Raises BadInput if the chart that is named does not exist.
    """
    number, count = chart_number(reference), len(charts)
    if number is not None:
        if not charts:
            why = "no chart is found here" if settings.charts else "photos are the only references of this preset"
            raise BadInput(f"--reference {reference}: {why}; name a view")
        if not 1 <= number <= count:
            there = f"are {count} charts, chart:1 to chart:{count}" if count > 1 else "is 1 chart, chart:1"
            raise BadInput(f"--reference {reference}: there {there}")
        return [Turn(number - 1, reference, picture), *(Turn(k) for k in range(count) if k != number - 1)]
    # A depth prior, or a file that fills, belongs to a view and needs that view.
    of_view = settings.depth_prior != "auto" or settings.inpaint.startswith("file:")
    first, on_charts = Turn(None, reference, picture), [Turn(k) for k in range(count)]
    if charts and reference is None and not of_view:
        return on_charts
    further = [] if left_to_charts(charts, first, settings) else [Turn()] * settings.extra_references
    # whoever tells a view's depth means it to hold beside charts
    return [first, *on_charts, *further] if settings.depth_prior == "auto" else [first, *further, *on_charts]


def left_to_charts(charts: Sequence[Chart], turn: Turn, settings: RemovalSettings) -> bool:
    """Whether a view's hole is filled on charts, where textures lie flat: nobody else paints it or tells its depth."""
    return bool(charts) and turn.picture is None and settings.inpaint in PROVIDERS and settings.depth_prior == "auto"


def charts_to_paint(charts: Sequence[Chart], views: Sequence[ViewState]) -> tuple[Chart, ...]:
    """The charts as a user gets them: the hole is all that a picture of one has to show."""
    return tuple(replace(c, hole=c.hole | texels_to_fill(c, number, views)[1]) for number, c in enumerate(charts))


def texels_to_fill(chart: Chart, number: int, views: Sequence[ViewState]) -> tuple[np.ndarray, np.ndarray]:
    """[H, W] bool each: texels that views need, and those of them to fill: no photo shows them, or photos disagree."""
    marked = np.zeros(chart.hole.shape, np.uint8)
    for view in views:
        assert view.hits is not None
        on = view.left.target & (view.hits.chart == number)
        marked[view.hits.rows[on], view.hits.cols[on]] = 1
    # A view that looks on from the side or from afar has fewer pixels than the chart has texels.
    kernel = np.ones((5, 5), np.uint8)
    closed = cv2.morphologyEx(marked, cv2.MORPH_CLOSE, kernel) > 0
    needed = (closed | (chart.hole & (cv2.dilate(marked, kernel) > 0))) & chart.there
    target = needed | (scipy.ndimage.binary_fill_holes(needed) & chart.hole)
    return target, target & ~chart.known


def carried_over(chart: Chart, done: Sequence[Reference]) -> Chart:
    """The chart with what completed references show of its hole: a picture that was given rules where it sees it."""
    points = chart.points()
    image, photos, known, hole = (a.copy() for a in (chart.image, chart.photos, chart.known, chart.hole))
    for reference in done:
        rows, cols = np.nonzero(~known)
        uv, _ = reference.camera.project(points[rows, cols])
        same = SAME_TEXELS / reference.camera.fx if reference.camera.split == CHART else SAME
        clean = cv2.erode((reference.target | reference.source).astype(np.uint8), CUBIC) > 0
        completed = np.where(reference.target & clean, reference.depth, 0)
        seen = sees(reference.camera, completed, points[rows, cols], same)
        shown = rows[seen], cols[seen]
        image[shown] = colours_at(reference.image, uv[seen], cv2.INTER_CUBIC)
        photos[shown], known[shown], hole[shown] = 1, True, False
    return replace(chart, image=image, photos=photos, known=known, hole=hole)


def paint_chart(chart: Chart, hole: np.ndarray, turn: Turn, settings: RemovalSettings, call: Call) -> Appearance:
    """The chart without its hole: the given picture, or the provider's fill."""
    if turn.picture is not None:
        return paste_picture(chart.image, hole | chart.hole, turn.picture, "--reference-image", chart.known)
    of_another = settings.inpaint.startswith("file:") and turn.name is None
    who, unknown = "exemplar" if of_another else settings.inpaint, ~chart.known & ~hole
    return inpaint_reference(who, chart.image, hole, settings.random_seed, unknown, call, settings.variant)


def complete_view_depth(
    view: ViewState, settings: RemovalSettings, picture: np.ndarray | None, first: bool, ask: Call, model: Call
) -> DepthCompletion:
    """The reference's depth: the charts', unless the user has another prior; a file's is of the first reference.

    A model that estimates it looks at the picture given, or at a first fill.
    """
    masks = view.left
    if view.hits is not None and settings.depth_prior == "auto":
        there = view.hits.depth
        depth = np.where(masks.target & (there > 0), there, masks.depth_after).astype(np.float32)
        share = float((there[masks.target] > 0).mean())
        return DepthCompletion(depth, share, f"{share:.0%} of the hole lies on charts", PriorFit())

    def first_fill() -> np.ndarray:
        return paint_view(replace(view, hits=None), (), replace(settings, variant=0), picture, ask).image

    spec = "auto" if settings.depth_prior.startswith("file:") and not first else settings.depth_prior
    prior = depth_prior(spec, masks.camera.height, masks.camera.width, first_fill, model)
    surface: Any = spec if spec in ("harmonic", "planar") else settings.depth.surface
    known, continued = rim(masks) & ~masks.occluder, replace(settings.depth, surface=surface)
    return complete_depth(disparity_of(masks.depth_after), known, masks.target, prior, continued)


def paint_view(
    view: ViewState, charts: Sequence[Chart], settings: RemovalSettings, picture: np.ndarray | None, call: Call
) -> Appearance:
    """The view without the object: the given picture, or what charts show and the provider's fill for the rest."""
    masks, base, seen = view.left, view.painted, np.zeros(view.left.target.shape, bool)
    if view.hits is not None:
        shown, known, _ = pictured(charts, view.hits)
        seen = masks.target & known
        base = np.where(seen[..., None], shown, base)
    if picture is not None:
        return paste_picture(base, masks.target, picture, "--reference-image", ~masks.silhouette)
    hole, seed = masks.target & ~seen, settings.random_seed
    filled = inpaint_reference(settings.inpaint, base, hole, seed, None, call, settings.variant)
    share = seen.sum() / max(1, masks.target.sum())
    return replace(filled, reason=f"{share:.0%} of the hole is seen in photos; {filled.reason}")


def emptied(kept: Gaussians, views: Sequence[ViewState]) -> tuple[ViewState, ...]:
    """The views' photos with the emptied scene in the object's place."""

    def empty(view: ViewState) -> ViewState:
        silhouette = view.masks.silhouette
        drawn = render_bytes(kept, view.camera, pixels=silhouette)
        return replace(view, painted=np.where(silhouette[..., None], drawn, view.bare))

    return tuple(parallel_map(empty, views))


def views_between(kept: Gaussians, charts: Sequence[Chart], views: Sequence[ViewState]) -> tuple[ViewState, ...]:
    """Drawn views of the emptied scene where photos leave gaps round what is to be filled on charts.

    Photos tell what is there. But scans extrapolate their splats' view dependence where no photo looks from, and
    what is filled has to follow what is drawn round it there, or it shows as a patch.
    """
    needed = [texels_to_fill(chart, number, views)[0] for number, chart in enumerate(charts)]
    if not any(n.any() for n in needed):
        return ()
    centre = np.concatenate([c.points()[n] for c, n in zip(charts, needed)]).mean(0)
    tolerance = max(c.tolerance for c in charts)

    def look(camera: Camera) -> ViewState:
        image, (depth, alpha) = render_bytes(kept, camera), surface_depth(kept, camera)
        hits = first_hits(charts, camera, np.ones(depth.shape, bool))
        target = hits.of(needed) & ~hits.behind(depth, tolerance)
        open_, no = dilated(target, MARGIN) | (alpha < SOLID), np.zeros_like(target)
        before = np.where(target, 0, depth).astype(np.float32)
        masks = ViewMasks(camera, target, open_, no, target, before, alpha, depth, alpha, target.astype(np.float32))
        return replace(ViewState.first(masks, image, Exposure(np.ones(3))), hits=hits)

    looks = parallel_map(look, cameras_between([v.camera for v in views], centre))
    return tuple(v for v in looks if v.masks.target.any())


def map_reference(completed: Completed, views: Sequence[ViewState], settings: RemovalSettings) -> MappingField:
    """Where each pixel of the reference's hole has its like, in what the views show: the paper's sampling asks."""
    c = completed
    seen = [(v.camera, v.left.depth_before, v.left.silhouette) for v in views]
    visibility = source_visibility(c.camera, c.depth, seen)
    return mapping_field(c.image, c.target, c.source, visibility, settings.mapping, settings.random_seed)


def paint_views(
    completed: Completed,
    field: MappingField | None,
    views: Sequence[ViewState],
    with_seeds: Gaussians,  # the scene without the object, the seeds in it
    settings: RemovalSettings,
    progress: Progress,
) -> Propagation:
    """Every view with the completed reference in its hole."""
    loaders = [partial(_to_paint, v, completed, with_seeds) for v in views]
    return propagate(completed, loaders, settings.propagate, progress, field)


def _to_paint(view: ViewState, completed: Completed, with_seeds: Gaussians) -> ViewToPaint:
    """The view with the depth of its splats, new ones too; or with the charts', where its own is theirs or none.

    What meets another chart than the completed one has no depth: where charts meet, z-tests take one for the other.
    """
    v, charts = view.left, completed.charts
    number = chart_number(completed.camera.id) if completed.camera.split == CHART else None
    before, after = v.depth_before, np.zeros_like(v.depth_before)
    if charts:
        assert view.hits is not None
        there, after = view.hits.depth, v.depth_after
        tolerance, scatter = max(c.tolerance for c in charts), max(c.scatter for c in charts)
        behind = (after == 0) | (after > (1 - tolerance) * there)
        after = np.where(v.target & (there > 0) & behind, there, snapped(after, there, scatter))
        before = snapped(before, there, scatter)
        if number is not None:
            after = np.where((view.hits.chart >= 0) & (view.hits.chart != number - 1), 0, after)
    elif v.target.any():
        window = window_mask(near_hole(v.target), v.camera)
        after = surface_depth(with_seeds, v.camera, pixels=window)[0]
    drawn = render_bytes(with_seeds, v.camera, pixels=round_hole(v.target, v.silhouette))
    return ViewToPaint(v.camera, view.bare, view.painted, v.silhouette, v.target, before, after, drawn)


def snapped(depth: np.ndarray, there: np.ndarray, tolerance: float) -> np.ndarray:
    """z [H, W]; a chart's (0 = none) where they are within a share of it: splats' are rough, photos place charts."""
    return np.where((there > 0) & (np.abs(depth - there) < tolerance * there), there, depth)


def after_reference(
    views: Sequence[ViewState],
    painted: Sequence[PaintedView],  # the same
    completed: Completed,
    filled: Gaussians,  # the scene with the new Gaussians, which are its last rows
    new: Gaussians,  # that this reference brought
    added: int,  # all new ones
) -> tuple[ViewState, ...]:
    """The views with what a reference painted, and what of them it left open."""

    def after(view: ViewState, part: PaintedView) -> ViewState:
        touched = touched_window(new, view.camera)
        if view.id == completed.camera.id:  # it shows its completed picture, not a mapped one
            rules = np.where(completed.target[part.part], Rule.EVIDENCE, Rule.UNTOUCHED).astype(np.uint8)
            part = replace(part, image=completed.image[part.part], rules=rules)
        rules = part.rule_map()
        coloured = (rules != Rule.UNTOUCHED) & (rules != Rule.UNREACHED)
        best = max(view.best or (0, completed), (int(coloured.sum()), completed), key=lambda found: found[0])
        told = rules if view.rules is None else np.where(coloured, rules, view.rules)
        picture = redrawn(part.pasted(view.painted), filled, view.masks, touched)
        left = view.left
        if left.target.any():
            left = still_open(left, filled, added, rules, window_mask(touched, view.camera))
        return replace(view, painted=picture, rules=told, best=best, left=left)

    return tuple(parallel_map(lambda pair: after(*pair), zip(views, painted)))


def redrawn(picture: np.ndarray, filled: Gaussians, view: ViewMasks, touched: Window) -> np.ndarray:
    """A painted view [H, W, 3] uint8, with the filled scene where the removal left a gap that was never to be filled.

    Beside what is in front, its soft edge is no target, but the emptied scene shows through it. The last new Gaussians
    may be where the view is `touched`.
    """
    gap = view.silhouette & ~view.target & (view.alpha_after < OPAQUE) & window_mask(touched, view.camera)
    if not gap.any():
        return picture
    return np.where(gap[..., None], render_bytes(filled, view.camera, pixels=gap), picture)


def still_open(view: ViewMasks, filled: Gaussians, added: int, rules: np.ndarray, touched: np.ndarray) -> ViewMasks:
    """A view's masks once the new Gaussians (the last `added` rows) are there: T is what they do not cover. Where no
    last one may be, not `touched` [H, W] bool, the view is as it was.

    A pixel that a splat's edge covers but that got no colour stays open, or the next fill would continue its old one.
    What is left of the margin round T is closed where the scene's own surface joins the new one, and beside what is
    in front, where a splat's soft edge has the depth of neither.
    """
    new = np.arange(len(filled)) >= len(filled) - added
    around = np.ones((2 * MARGIN + 1,) * 2, np.uint8)
    scene = drawing(filled, view.camera, with_colour=False, pixels=touched | dilated(view.target, MARGIN))
    before, uncoloured = (view.depth_after, view.alpha_after), rules == Rule.UNREACHED
    depth, alpha = (np.where(touched, d, b) for d, b in zip(scene.surface_depth(), before))
    covered = scene.footprint(new) > DRAWN
    target = view.target & (~covered | uncoloured)
    farthest = cv2.dilate(np.where(covered, depth, 0).astype(np.float32), around)
    nearest = cv2.erode(np.where(depth > 0, depth, np.inf).astype(np.float32), around)
    at_edge = nearest < (1 - LAYER_STEP) * depth
    joined = (~uncoloured | (before[1] > SOLID)) & (alpha > SOLID)
    joined &= at_edge | (depth < (1 + LAYER_STEP) * farthest)
    wide = cv2.morphologyEx(target.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2 * MARGIN,) * 2, np.uint8)) > 0
    return replace(view, target=target & (wide | ~joined), depth_after=depth, alpha_after=alpha)

"""A reference without the object: which chart or view comes next, its depth, and its picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import scipy.ndimage

from ..errors import BadInput
from ..geometry import colours_at, disparity_of, sees
from ..presets import RemovalSettings
from ..priors.appearance import Appearance
from ..priors.builtin import PROVIDERS
from ..priors.calls import Call
from ..priors.inpaint import inpaint_reference
from ..priors.monodepth import depth_prior, looks
from ..priors.pasting import paste_picture
from ..stages.charts import CHART, Chart, chart_number, pictured
from ..stages.depth import DepthCompletion, PriorFit, complete_depth
from ..stages.propagate import Reference
from ..stages.reference import rim
from ..view_state import ViewState

SAME = 0.01  # relative z within which two references show the same surface
SAME_TEXELS = 1.0  # of a chart, within which it is that of another one: its camera stands too far away for shares of z
CUBIC = np.ones((5, 5), np.uint8)  # px of a picture that a colour between them is made of: none may show the object


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

    Raises
    ------
    BadInput
        If the chart that is named does not exist.
    """
    named = _named_chart(reference, charts, settings)
    if named is not None:
        return [Turn(named, reference, picture), *(Turn(k) for k in range(len(charts)) if k != named)]
    # A depth prior, or a file that fills, belongs to a view and needs that view.
    of_view = settings.depth_prior != "auto" or settings.inpaint.startswith("file:")
    first, on_charts = Turn(None, reference, picture), [Turn(k) for k in range(len(charts))]
    if charts and reference is None and not of_view:
        return on_charts
    further = [] if left_to_charts(charts, first, settings) else [Turn()] * settings.extra_references
    # whoever tells a view's depth means it to hold beside charts
    return [first, *on_charts, *further] if settings.depth_prior == "auto" else [first, *further, *on_charts]


def left_to_charts(charts: Sequence[Chart], turn: Turn, settings: RemovalSettings) -> bool:
    """Whether a view's hole is filled on charts, where textures lie flat: nobody else paints it or tells its depth."""
    ours = settings.inpaint in PROVIDERS and settings.depth_prior == "auto"
    return bool(charts) and turn.picture is None and ours


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
    return inpaint_reference(
        "exemplar" if of_another else settings.inpaint,
        chart.image,
        hole,
        settings.random_seed,
        unknown=~chart.known & ~hole,
        call=call,
        variant=settings.variant,
    )


def complete_view_depth(
    view: ViewState,
    settings: RemovalSettings,
    picture: np.ndarray | None,
    first: bool,  # reference; a file's prior is of that view
    painter: Call,
    model: Call,
) -> DepthCompletion:
    """The reference's depth: the charts', unless the user has another prior.

    A model that estimates it looks at the picture given, or at a first fill.
    """
    masks = view.left
    if view.hits is not None and settings.depth_prior == "auto":
        there = view.hits.depth
        depth = np.where(masks.target & (there > 0), there, masks.depth_after).astype(np.float32)
        share = float((there[masks.target] > 0).mean())
        words = f"{share:.0%} of the hole lies on charts"
        return DepthCompletion(disparity_of(depth), depth, share, words, PriorFit())
    looked_at, spec = None, settings.depth_prior
    if spec.startswith("file:") and not first:
        spec = "auto"
    if looks(spec):
        if picture is not None:
            pasted = paste_picture(view.painted, masks.target, picture, "--reference-image", ~masks.silhouette)
        else:
            pasted = inpaint_reference(settings.inpaint, view.painted, masks.target, settings.random_seed, call=painter)
        looked_at = pasted.image
    prior = depth_prior(spec, masks.camera.height, masks.camera.width, looked_at, model)
    surface: Any = spec if spec in ("harmonic", "planar") else settings.depth.surface
    depth_settings = replace(settings.depth, surface=surface)
    known = rim(masks) & ~masks.occluder
    return complete_depth(disparity_of(masks.depth_after), known, masks.target, prior, depth_settings)


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
    filled = inpaint_reference(
        settings.inpaint, base, masks.target & ~seen, settings.random_seed, call=call, variant=settings.variant
    )
    share = seen.sum() / max(1, masks.target.sum())
    return replace(filled, reason=f"{share:.0%} of the hole is seen in photos; {filled.reason}")

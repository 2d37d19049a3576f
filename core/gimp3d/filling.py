"""The hole filled: one reference after the other is completed and carried into every view, then the whole refined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from . import pictures
from .errors import IllPosed
from .gaussians import Gaussians
from .geometry import SAME_DEPTH
from .priors.inpaint import painter
from .run import Run, ViewState, counted, open_pixels
from .stages.charts import CHART, Chart
from .stages.propagate import Reference
from .stages.reference import choose_reference
from .stages.refine import looked_at, observed, refine_gaussians
from .stages.seed import seed_gaussians, settle_gaussians
from .steps import references
from .steps.behind import take_painted_colours
from .steps.references import Completed, Turn
from .steps.view_refinement import refine_views

NEGLIGIBLE = 1e-3  # share of what the object touches in all views; a smaller hole that cannot be filled stays open
REFINING = 0.5  # share of a painted hole that a refining painter may change (img2img's denoising strength)


@dataclass(frozen=True)
class Filling:
    """How far the hole is filled."""

    kept: Gaussians  # the scene without the object
    views: tuple[ViewState, ...]
    between: tuple[ViewState, ...] = ()  # drawn ones, see references.views_between
    added: Gaussians | None = None
    done: tuple[Reference, ...] = ()  # completed references
    recoloured: np.ndarray = field(default_factory=lambda: np.zeros(0, int))  # rows of `kept` that are not as they came
    asked: dict[str, Any] = field(default_factory=dict)  # see ViewRefinement.facts


def fill_hole(run: Run, filling: Filling, charts: tuple[Chart, ...], turns: Sequence[Turn]) -> Filling:
    """Complete one reference after the other and carry it into every view, until little is left open."""
    hole = open_pixels(filling.views)
    touched = sum(int(v.masks.silhouette.sum()) for v in filling.views)
    if turns[0].chart is not None and turns[0].name and run.settings.depth_prior != "auto":
        run.warnings.append(f"--depth-prior {run.settings.depth_prior} is not used: the reference is a chart")
    filling = replace(filling, views=references.emptied(filling.kept, filling.views))
    if charts and run.settings.seed.corrections:
        filling = replace(filling, between=references.views_between(filling.kept, charts, filling.views))
    for number, turn in enumerate(turns):
        if number and open_pixels(filling.views) < run.settings.extra_gain * hole:
            break
        suffix = f" {number + 1}" if number else ""
        try:
            if turn.chart is None:
                completed = _complete_view(run, filling, charts, turn, suffix)
            else:
                completed = _complete_chart(run, filling, charts[turn.chart], turn, suffix)
            if completed is not None:
                filling = _carry(run, filling, completed, suffix)
        except IllPosed as error:
            if not number and hole > NEGLIGIBLE * touched:
                raise
            run.warnings.append(f"no {'further ' if number else ''}reference view helps: {error}")
            break
    return filling


def _complete_chart(run: Run, filling: Filling, chart: Chart, turn: Turn, suffix: str) -> Completed | None:
    """One chart without its hole; None if no view needs it."""
    assert turn.chart is not None
    shown, chart = chart.shown, references.carried_over(chart, filling.done)
    target, hole = references.texels_to_fill(chart, turn.chart, filling.views)
    if not target.any():
        if turn.name:
            run.warnings.append(f"--reference {turn.name}: no view needs this chart, it is not used")
        return None
    name = f"appearance{suffix}"
    appearance = run(name, references.paint_chart, chart, hole, turn, run.settings, run.call("--inpaint", name))
    run.warnings += appearance.warnings
    return Completed(chart.camera, appearance.image, chart.depth, target, shown, (chart,))


def _complete_view(run: Run, filling: Filling, charts: tuple[Chart, ...], turn: Turn, suffix: str) -> Completed | None:
    """One view without the object, which the program chooses unless the user did; None if charts are filled for it."""
    settings, views, tried = run.settings, filling.views, {c.camera_id for c in run.references}
    choice = run(f"reference{suffix}", choose_reference, [v.left for v in views], turn.name, tried)
    run.references.append(choice)
    if turn.name and references.left_to_charts(charts, turn, settings):
        run.warnings.append(f"--reference {turn.name}: without a picture of it, its hole is filled on charts")
        return None
    view = next(v for v in views if v.id == choice.camera_id)
    name, first = f"depth{suffix}", not suffix
    calls = run.call("--inpaint", name), run.call("--depth-prior", name)
    completion = run(name, references.complete_view_depth, view, settings, turn.picture, first, *calls)
    depth = np.where(view.left.target, completion.depth, view.left.depth_after).astype(np.float32)
    # Where drawn surfaces scatter about the charts by more than a z-test allows, the charts tell the depth.
    rough = any(c.scatter > SAME_DEPTH for c in charts)
    if rough and view.hits is not None:
        depth = references.snapped(depth, view.hits.depth, max(c.scatter for c in charts)).astype(np.float32)
    name = f"appearance{suffix}"
    appearance = run(name, references.paint_view, view, charts, settings, turn.picture, run.call("--inpaint", name))
    run.warnings += appearance.warnings
    run.pictures += pictures.of_depth(completion, depth, view.left.target, view.id)
    shown = False if view.hits is None else view.hits.of([c.shown for c in charts])
    source = np.where(view.left.target, shown, ~view.left.silhouette & (depth > 0))
    return Completed(view.camera, appearance.image, depth, view.left.target, source, charts if rough else ())


def _carry(run: Run, filling: Filling, completed: Completed, suffix: str) -> Filling:
    """A completed reference in every view, and the Gaussians that show it."""
    settings, filled, count = run.settings, filling.kept.extended(filling.added), len(filling.views)
    views = *filling.views, *filling.between
    camera, of_seeds = completed.camera, settings.seed
    surface = completed.image, completed.depth, completed.target, filled.is_surfels, of_seeds, camera.split == CHART
    seeds = run(f"seed{suffix}", seed_gaussians, camera, *surface, words=counted)
    if len(seeds) == 0:
        raise IllPosed(f"reference {camera.id}: what is behind the object is infinitely far; nothing to build")
    sampled = settings.propagate.transfer == "sample"
    field_ = run(f"mapping{suffix}", references.map_reference, completed, filling.views, settings) if sampled else None
    inputs = completed, field_, views, filled.extended(seeds), settings, run.progress
    painting = run(f"propagate{suffix}", references.paint_views, *inputs)
    run.pictures += pictures.of_reference(completed, field_)
    run.pictures += pictures.of_painting(painting.views[:count], filling.views)
    given = filled, seeds, completed.camera, painting.views[:count], settings.seed, painting.views[count:]
    new = run(f"settle{suffix}", settle_gaussians, *given, words=counted)
    added = new if filling.added is None else filling.added.extended(new)
    filled = filling.kept.extended(added)
    views = references.after_reference(views, painting.views, completed, filled, new, len(added))
    filling = replace(filling, views=views[:count], between=views[count:])
    return replace(filling, added=added, done=(*filling.done, completed))


def ask_for_refinement(run: Run, filling: Filling) -> Filling:
    """The painted views, refined by a painter that sees their reference beside them if the user asked for one."""
    if not run.settings.refine_views:
        return filling
    call, settings = run.call("--refine-views", "refine views", REFINING), run.settings
    who = painter(settings.refine_views, call)
    views = looked_at([v for v in filling.views if v.best is not None], settings.refine)
    asked = run(call.stage, refine_views, who, views, settings.random_seed, call)
    run.warnings += asked.warnings
    run.pictures += pictures.of_refinement(asked, filling.views)
    facts = {"provider": settings.refine_views, **asked.facts()}
    return replace(filling, views=asked.applied(filling.views), asked=facts)


def refine(run: Run, filling: Filling) -> Filling:
    """The new Gaussians, optimised where the settings ask for it."""
    settings = run.settings
    if filling.added is None or not settings.refine.steps:
        return filling
    seen = [observed(v.camera, v.painted, v.rules) for v in filling.views if v.rules is not None]
    seen = [o for o in seen if o.weight.any()]
    inputs = filling.kept, filling.added, seen, settings.refine, settings.random_seed, run.progress
    return replace(filling, added=run("refine", refine_gaussians, *inputs).gaussians)


def recolour(run: Run, filling: Filling) -> Filling:
    """What is drawn before the new Gaussians, in the colours painted there; without refinement it is left alone."""
    if filling.added is None or run.settings.charts is None or not run.settings.refine.steps:
        return filling
    found = run("recolour", take_painted_colours, filling.kept, filling.added, filling.views)
    return replace(filling, kept=filling.kept.with_rows(found.rows, found.gaussians), recoloured=found.rows)

"""Painted views shown to a painter that the user named, beside the reference that painted most of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..presets import RemovalSettings
from ..priors.calls import Call
from ..priors.inpaint import painter
from ..stages.propagate import Rule
from ..stages.refine import looked_at
from ..stages.view_refinement import ViewRefinement, ViewToRefine, refine_views
from ..view_state import ViewState


def ask_to_refine(views: Sequence[ViewState], settings: RemovalSettings, call: Call) -> ViewRefinement:
    """Ask the painter that the settings name about as many painted views as refinement looks at."""
    asked = [
        ViewToRefine(v.id, v.painted, v.rules, v.best[1].image, v.best[1].target)
        for v in views
        if v.rules is not None and v.best is not None
    ]
    who = painter(settings.refine_views, call)
    return refine_views(who, looked_at(asked, settings.refine), settings.random_seed, call)


def with_answers(views: Sequence[ViewState], asked: ViewRefinement) -> tuple[ViewState, ...]:
    """The views with the answers that were accepted."""
    answers = {a.camera_id: a.image for a in asked.views if a.image is not None}

    def answered(view: ViewState) -> ViewState:
        image = answers.get(view.id)
        if image is None or view.rules is None:
            return view
        rules = np.where((image != view.painted).any(-1), np.uint8(Rule.REFINED), view.rules)
        return replace(view, painted=image, rules=rules)

    return tuple(map(answered, views))

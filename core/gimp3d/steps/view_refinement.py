"""Painted views refined by a painter that sees the completed reference beside them (paper 4.4: Ours + LeftRefill).

LeftRefill (Cao 2024) stitches a reference and a masked view side by side, so that an inpainting model looks left to
paint right. Here the right half is the propagated painting, which the painter may change inside the mask. Its answer
is believed only where it is the view round the mask and still that painting inside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from ..errors import BadInput
from ..geometry import blurred
from ..priors.calls import Call, Painter
from ..priors.pasting import paste_picture, resized, scaled, window_round_hole
from ..run import ViewState
from ..stages.propagate import Rule

KEPT = (Rule.UNTOUCHED, Rule.UNREACHED, Rule.EVIDENCE)  # pixels that nobody is asked about: known, or without a colour
LEAST = 64  # pixels of a view that somebody is asked about
LONGEST = 1024  # px of a panel's longer side; larger ones are reduced
COARSE = 4.0  # px, σ of the blur under which answer and painting are compared: texture may change, structure may not
# Grey levels, mean under that blur. On four scenes with truth, filled without a given picture, the true view is at most
# 15 from the painting (median 7), the photo with the object 20 and more (median 48).
MOST_DRIFT = 17.0


@dataclass(frozen=True)
class RefinedView:
    """What became of a view."""

    camera_id: str
    image: np.ndarray | None  # [H, W, 3] uint8; None: refused, the view stays as it was
    reason: str


@dataclass(frozen=True)
class ViewRefinement:
    """All views that a painter was asked about."""

    views: tuple[RefinedView, ...]
    confidence: float  # share of the answers that were accepted
    reason: str

    @property
    def warnings(self) -> tuple[str, ...]:
        refused = (v for v in self.views if v.image is None)
        return tuple(f"--refine-views: {v.camera_id} is left as it was: {v.reason}" for v in refused)

    def facts(self) -> dict[str, Any]:
        """For the summary: where each view's refinement came from, or why there is none."""
        return {
            "asked": len(self.views),
            "accepted": sum(v.image is not None for v in self.views),
            "views": {v.camera_id: {"accepted": v.image is not None, "reason": v.reason} for v in self.views},
        }

    def applied(self, views: Sequence[ViewState]) -> tuple[ViewState, ...]:
        """The views with the answers that were accepted."""
        found = {view.id: view for view in views}
        for answer in self.views:
            view = found[answer.camera_id]
            if answer.image is not None and view.rules is not None:
                rules = np.where((answer.image != view.painted).any(-1), np.uint8(Rule.REFINED), view.rules)
                found[view.id] = replace(view, painted=answer.image, rules=rules)
        return tuple(found.values())


def refine_views(who: Painter, views: Sequence[ViewState], seed: int, call: Call) -> ViewRefinement:
    """Ask about one painted view after the other.

    Raises BadInput if the painter fails at the first view; later failures only refuse their view.
    """
    asked = [(v, m) for v in views if v.rules is not None and (m := ~np.isin(v.rules, KEPT)).sum() >= LEAST]
    done: list[RefinedView] = []
    for k, (view, mask) in enumerate(asked):
        part = replace(call, progress=lambda stage, _, __, words="", k=k: call.progress(stage, k, len(asked), words))
        part.tell(f"{who.who} looks at {view.id}")
        try:
            done.append(refine_view(who, view, mask, seed, part))
        except BadInput as error:
            if not done:
                raise
            done.append(RefinedView(view.id, None, str(error)))
    accepted = sum(v.image is not None for v in done)
    words = f"{accepted} of {len(done)} views refined by {who.who}" if done else "no view has anything to refine"
    return ViewRefinement(tuple(done), accepted / max(1, len(done)), words)


def refine_view(who: Painter, view: ViewState, mask: np.ndarray, seed: int, call: Call) -> RefinedView:
    """One view where it is masked [H, W] bool; BadInput if the painter fails, refused if its answer does not agree."""
    assert view.best is not None
    part, (_, reference) = window_round_hole(mask), view.best
    painted, mask = view.painted[part], mask[part]
    left = reference.image[window_round_hole(reference.target)]
    stitched, stitched_mask, beside = side_by_side(left, painted, mask)
    answer = resized(who.paint(stitched, stitched_mask, seed, call), stitched_mask.shape, who.answer)
    try:
        right = scaled(answer[:, beside:], *mask.shape[::-1])
        pasted = paste_picture(painted, mask, right, f"the answer of {who.who}")
        if pasted.warnings:
            raise BadInput(pasted.warnings[0])
        off = blurred(pasted.image.astype(np.float32) - painted, mask, COARSE)
        drift = float(np.abs(off)[mask].mean())
        words = f"{drift:.0f} grey levels from what was propagated"
        if drift > MOST_DRIFT:
            raise BadInput(f"{who.who} painted something else: {words}, under a blur")
    except BadInput as error:
        return RefinedView(view.id, None, str(error))
    whole = view.painted.copy()
    whole[part] = pasted.image
    return RefinedView(view.id, whole, f"{words}; {pasted.reason}")


def side_by_side(reference: np.ndarray, view: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """The reference [h', w', 3] uint8 left, as high as the view [h, w, 3] uint8 right; the mask [h, w] bool, empty on
    the left; the column where right begins.
    """
    factor = min(1.0, LONGEST / max(mask.shape))
    height, width = (max(1, round(factor * side)) for side in mask.shape)
    beside = max(1, min(LONGEST, round(reference.shape[1] * height / reference.shape[0])))
    shrunk = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0
    both = np.hstack([scaled(reference, beside, height), scaled(view, width, height)])
    return both, np.hstack([np.zeros((height, beside), bool), shrunk]), beside

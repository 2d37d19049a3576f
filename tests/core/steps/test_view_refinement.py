"""Views refined beside their reference: what the painter sees, and which of its answers are believed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from pictures import disc, error, painted_view, scenery

from gimp3d.errors import BadInput
from gimp3d.job import StageStore
from gimp3d.priors.calls import Call, Painter
from gimp3d.priors.pasting import window_round_hole
from gimp3d.run import ViewState
from gimp3d.stages.propagate import Rule
from gimp3d.steps.view_refinement import ViewRefinement, refine_views, side_by_side

TRUTH, HOLE = scenery(120, 160), disc()
REFERENCE = scenery(90, 200, seed=1)


def view(name: str = "a") -> ViewState:
    """The truth, with its hole painted without details; a corner of the hole is photo."""
    painted = np.where(HOLE[..., None], cv2.GaussianBlur(TRUTH, (0, 0), 3), TRUTH)
    rules = np.where(HOLE, Rule.REFERENCE, Rule.UNTOUCHED).astype(np.uint8)
    rules[:55][HOLE[:55]] = Rule.EVIDENCE
    return painted_view(name, painted, rules, REFERENCE, disc(90, 200, 15))


ASKED = HOLE.copy()
ASKED[:55] = False


PANEL = window_round_hole(ASKED)  # what of the view the painter sees


def painter(change, seen: list | None = None) -> Painter:
    """Who changes the right half, [h, w, 3], given its mask."""

    def paint(image, mask, seed, call):
        if seen is not None:
            seen.append((image, mask))
        beside = image.shape[1] - ASKED[PANEL].shape[1]
        return np.hstack([image[:, :beside], change(image[:, beside:], mask[:, beside:])])

    return Painter("leftrefill", paint, "the picture that leftrefill painted")


def truth(right: np.ndarray, mask: np.ndarray) -> np.ndarray:
    return TRUTH[PANEL]


def test_the_painter_sees_the_reference_left_and_the_masked_view_right() -> None:
    mask = disc(60, 80, 10)
    both, where, beside = side_by_side(REFERENCE, TRUTH[:60, :80], mask)
    assert both.shape == (60, beside + 80, 3) and abs(beside / 60 - 200 / 90) < 0.02
    assert (both[:, beside:] == TRUTH[:60, :80]).all() and (where[:, beside:] == mask).all()
    assert not where[:, :beside].any()
    assert error(both[:, :beside], cv2.resize(REFERENCE, (beside, 60), interpolation=cv2.INTER_AREA), slice(None)) < 1


def test_large_views_are_reduced_for_the_painter() -> None:
    both, where, beside = side_by_side(REFERENCE, np.zeros((1500, 3000, 3), np.uint8), np.ones((1500, 3000), bool))
    assert both.shape[:2] == where.shape == (512, beside + 1024) and where[:, beside:].all()


def test_an_answer_that_agrees_brings_details_inside_the_mask_alone() -> None:
    seen: list = []
    done = refine_views(painter(truth, seen), [view()], 3, Call("--refine-views"))
    (refined,) = done.views
    assert refined.image is not None and done.confidence == 1 and int(refined.reason.split()[0]) < 10
    before = view().painted
    assert (refined.image[~ASKED] == before[~ASKED]).all()
    assert error(refined.image, TRUTH, ASKED) < 0.2 * error(before, TRUTH, ASKED)
    ((image, mask),) = seen
    assert mask.sum() == ASKED.sum() and image.shape[:2] == mask.shape
    assert done.facts()["views"]["a"]["accepted"] and done.facts()["asked"] == done.facts()["accepted"] == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda right, mask: right[:, ::-1], "does not match the view"),
        (lambda right, mask: np.where(mask[..., None], np.uint8(255), right), "painted something else"),
        (lambda right, mask: np.where(mask[..., None], 255 - right, right), "painted something else"),
        (lambda right, mask: scenery(*mask.shape, seed=9), "does not match the view"),
    ],
)
def test_an_answer_that_does_not_agree_leaves_the_view_as_it_was(change, words: str) -> None:
    done = refine_views(painter(change), [view()], 0, Call("--refine-views"))
    (refined,) = done.views
    assert refined.image is None and words in refined.reason and done.confidence == 0
    assert done.facts()["views"]["a"] == {"accepted": False, "reason": refined.reason}


def test_a_painter_that_fails_at_the_first_view_ends_the_run_and_later_only_refuses() -> None:
    count = []

    def paint(image, mask, seed, call):
        count.append(1)
        if len(count) != 1:
            raise BadInput("out of memory")
        return image

    done = refine_views(Painter("p", paint, "it"), [view("a"), view("b"), view("c")], 0, Call())
    assert [v.image is not None for v in done.views] == [True, False, False]
    assert done.views[1].reason == "out of memory"
    with pytest.raises(BadInput, match="out of memory"):
        refine_views(Painter("p", paint, "it"), [view("a"), view("b")], 0, Call())


def test_progress_counts_the_views() -> None:
    told = []

    def progress(stage: str, done: int, total: int, message: str = "") -> None:
        told.append((stage, done, total, message))

    call = Call("--refine-views", "refine views", progress)
    refine_views(painter(truth), [view("a"), view("b")], 0, call)
    assert told == [("refine views", k, 2, f"leftrefill looks at {n}") for k, n in enumerate("ab")]


def test_views_with_nothing_invented_are_not_asked_about() -> None:
    photo = replace(view(), rules=np.where(HOLE, Rule.EVIDENCE, Rule.UNTOUCHED))
    done = refine_views(painter(truth), [photo], 0, Call())
    assert done.views == () and done.facts()["asked"] == 0


def test_an_answer_of_another_shape_is_refused() -> None:
    with pytest.raises(BadInput, match="not the shape"):
        refine_views(Painter("p", lambda i, *_: i[:40], "its picture"), [view()], 0, Call())


def test_accepted_answers_stand_for_what_was_painted() -> None:
    views = view("a"), view("b")
    first, second = refine_views(painter(truth), views[:1], 0, Call()).applied(views)
    changed = (first.painted != views[0].painted).any(-1)
    assert changed.any() and (first.rules == np.where(changed, Rule.REFINED, views[0].rules)).all()
    assert second is views[1]


def test_what_was_asked_is_kept_for_resume(tmp_path: Path) -> None:
    done = refine_views(painter(truth), [view()], 0, Call())
    refused = refine_views(painter(lambda right, mask: right[:, ::-1]), [view("b")], 0, Call())
    kept = ViewRefinement(done.views + refused.views, 0.5, "1 of 2")
    StageStore(tmp_path, "key", resume=True).save("refine views", kept)
    found = StageStore(tmp_path, "key", resume=True).load("refine views")
    assert found is not None and found.facts() == kept.facts()
    np.testing.assert_array_equal(found.views[0].image, kept.views[0].image)
    assert found.views[1].image is None

"""Carrying the reference into other views."""

from __future__ import annotations

import gc
import threading
import weakref
from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scenes import cameras, truth

from gimp3d.camera import Camera
from gimp3d.compute.threads import set_thread_count
from gimp3d.errors import BadInput
from gimp3d.pipeline import render_bytes
from gimp3d.raster import render
from gimp3d.stages.propagate import (
    PaintedView,
    PropagateSettings,
    Propagation,
    Reference,
    Rule,
    ViewToPaint,
    near_hole,
    paper,
    propagate,
)
from gimp3d.stages.propagate.paper import MappingField

HOLE = (40, 60, 40, 65)  # rows and columns of T_0
SHIFT = 30  # columns from a hole pixel to its source
SAMPLE = PropagateSettings(transfer="sample", blend="rim")  # as the paper


def whole(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    return render_bytes(truth(), camera), render(truth(), camera).median_depth


@pytest.fixture(scope="module")
def reference() -> Reference:
    """A view whose hole is completed truly."""
    camera = cameras(9)[1]
    image, depth = whole(camera)
    target = np.zeros(depth.shape, bool)
    target[HOLE[0] : HOLE[1], HOLE[2] : HOLE[3]] = True
    target &= depth > 0
    return Reference(camera, image, depth, target, ~target & (depth > 0))


def shifted_sources(reference: Reference) -> MappingField:
    """Every hole pixel maps to itself shifted by 30 columns."""
    rows, cols = np.indices(reference.target.shape, np.int32)
    found = (np.where(reference.target, x, -1) for x in (rows, cols + SHIFT))
    return MappingField(*found, 1.0, "")


def view(
    reference: Reference, index: int, look: Callable[[np.ndarray], np.ndarray] = lambda colours: colours
) -> ViewToPaint:
    """Another view whose hole is what the reference's hole looks like from there; `look` changes its colours."""
    camera = cameras(9)[index]
    image, depth = whole(camera)
    image = np.clip(np.rint(look(image.astype(float))), 0, 255).astype(np.uint8)
    points = camera.unproject(camera.pixel_centres(), depth.astype(float))
    uv, _ = reference.camera.project(points)
    with np.errstate(invalid="ignore"):
        inside = (uv[..., 0] > HOLE[2]) & (uv[..., 0] < HOLE[3]) & (uv[..., 1] > HOLE[0]) & (uv[..., 1] < HOLE[1])
    inside &= depth > 0
    photo = image.copy()
    photo[inside] = [200, 0, 0]
    before = np.where(inside, 0.5 * depth, depth).astype(np.float32)
    base = np.where(inside[..., None], 0, photo).astype(np.uint8)
    return ViewToPaint(camera, photo, base, inside, inside, before, depth, photo)


def run(
    reference: Reference, views: Sequence[ViewToPaint], settings: PropagateSettings = PropagateSettings()
) -> Propagation:
    return propagate(reference, [lambda v=v: v for v in views], settings, sources=shifted_sources(reference))


def paint(
    reference: Reference, target: ViewToPaint, settings: PropagateSettings = PropagateSettings()
) -> tuple[PaintedView, np.ndarray, np.ndarray]:
    """The painted part, and the whole picture and rules."""
    (painted,) = run(reference, [target], settings).views
    return painted, painted.pasted(target.base), painted.rule_map()


def error(image: np.ndarray, target: ViewToPaint, where: np.ndarray, look=lambda colours: colours) -> float:
    """RMS in grey levels against the true picture."""
    expected = np.clip(look(whole(target.camera)[0].astype(float)), 0, 255)
    return float(np.sqrt(((image[where] - expected[where]) ** 2).mean()))


@pytest.mark.parametrize("index", [0, 2, 4])
def test_the_hole_is_painted_with_the_true_picture(reference: Reference, index: int) -> None:
    target = view(reference, index)
    _, image, rules = paint(reference, target)
    hole = target.target & (rules != Rule.UNREACHED)
    assert hole.sum() > 0.8 * target.target.sum()
    assert error(image, target, hole) < 7


def test_the_hole_is_as_sharp_as_the_scene_is_drawn_beside_it(reference: Reference) -> None:
    sharp = view(reference, 2)
    soft = replace(sharp, drawn=cv2.GaussianBlur(sharp.image, (0, 0), 4.0))
    inner = cv2.erode(sharp.target.astype(np.uint8), np.ones((5, 5))) > 0

    def detail(target: ViewToPaint, settings: PropagateSettings) -> float:
        picture = paint(reference, target, settings)[1].astype(float)
        return float(np.abs(picture - cv2.GaussianBlur(picture, (0, 0), 1.0))[inner].mean())

    own = PropagateSettings()
    assert detail(soft, own) < 0.6 * detail(sharp, own)
    assert detail(soft, SAMPLE) == detail(sharp, SAMPLE)  # the paper takes colours as they are


@pytest.mark.parametrize("blend", ["band", "rim"])
@pytest.mark.parametrize("transfer", ["warp", "sample"])
def test_nothing_outside_the_hole_changes(reference: Reference, transfer: str, blend: str) -> None:
    target = view(reference, 2)
    painted, image, rules = paint(reference, target, PropagateSettings(transfer=transfer, blend=blend))
    assert (image[~target.target] == target.base[~target.target]).all()
    assert (rules[~target.target] == Rule.UNTOUCHED).all() and (rules[target.target] != Rule.UNTOUCHED).all()
    raw = painted.pasted(target.base, painted.raw)
    assert (raw[~target.target] == target.base[~target.target]).all()


def test_the_order_and_company_of_views_does_not_matter(reference: Reference) -> None:
    views = [view(reference, k) for k in (0, 2, 4)]
    forward, backward = run(reference, views), run(reference, views[::-1])
    for a, b in zip(forward.views, backward.views[::-1]):
        assert a.camera.id == b.camera.id and (a.image == b.image).all() and (a.rules == b.rules).all()
    (alone,) = run(reference, views[1:2]).views
    assert (alone.image == forward.views[1].image).all()


@pytest.mark.parametrize("transfer", ["warp", "sample"])
def test_the_number_of_threads_does_not_matter(reference: Reference, transfer: str) -> None:
    views = [view(reference, k) for k in (0, 2, 3, 4)]
    try:
        results = []
        for count in (1, 4):
            set_thread_count(count)
            results.append(run(reference, views, PropagateSettings(transfer=transfer)))
    finally:
        set_thread_count(None)
    for a, b in zip(*(r.views for r in results)):
        assert (a.image == b.image).all() and (a.raw == b.raw).all() and (a.rules == b.rules).all()


@pytest.mark.parametrize("settings_", [PropagateSettings(), SAMPLE])
def test_the_new_surface_is_asked_for_near_the_hole_only(reference: Reference, settings_: PropagateSettings) -> None:
    target = view(reference, 2)
    unknown = np.full_like(target.depth_new, 0.3)
    unknown[near_hole(target.target)] = target.depth_new[near_hole(target.target)]
    assert (unknown != target.depth_new).any()
    whole_, part = (paint(reference, v, settings_)[0] for v in (target, replace(target, depth_new=unknown)))
    for name in ("image", "raw", "rules", "depth"):
        np.testing.assert_array_equal(getattr(whole_, name), getattr(part, name))
    np.testing.assert_array_equal(part.depth, target.depth_new[part.part])


def test_views_are_let_go_once_they_are_painted(reference: Reference) -> None:
    alive: set[int] = set()
    most, lock = 0, threading.Lock()

    def loader(k: int) -> Callable[[], ViewToPaint]:
        def load() -> ViewToPaint:
            nonlocal most
            loaded = view(reference, 2 + k % 3)
            with lock:
                alive.add(k)
                most = max(most, len(alive))
            weakref.finalize(loaded, alive.discard, k)
            return loaded

        return load

    try:
        set_thread_count(2)
        result = propagate(reference, [loader(k) for k in range(8)])
    finally:
        set_thread_count(None)
    gc.collect()
    assert len(result.views) == 8 and most <= 3 and not alive
    kept = sum(a.nbytes for p in result.views for a in (p.image, p.raw, p.rules))
    assert kept < 8 * 7 * 90 * 120


def test_the_level_of_the_view_is_met(reference: Reference) -> None:
    """Light, that is: exposures are levelled before (`stages.exposure`)."""

    def darker(colours: np.ndarray) -> np.ndarray:
        return colours - 30

    target = view(reference, 2, darker)
    _, image, rules = paint(reference, target)
    hole = target.target & (rules != Rule.UNREACHED)
    assert error(image, target, hole, darker) < 6


def test_the_level_is_met_where_the_hole_touches_no_photo(reference: Reference) -> None:
    """A part of the hole that only renderings surround takes the level that the rest of the view tells."""

    def darker(colours: np.ndarray) -> np.ndarray:
        return colours - 40

    target = view(reference, 2, darker)
    grown = np.zeros_like(target.silhouette)
    rows, cols = np.nonzero(target.target)
    grown[rows.min() - 6 : rows.max() + 7, cols.min() - 6 : cols.max() + 7] = True
    _, image, rules = paint(reference, replace(target, silhouette=grown))
    hole = target.target & (rules != Rule.UNREACHED)
    assert error(image, target, hole, darker) < 8


def test_photo_of_places_that_no_photo_shows_tells_no_light(reference: Reference) -> None:
    """Something stands there, whatever depths say: in a rough scan they do not tell it from the surface behind."""
    target = view(reference, 2)
    cols = np.nonzero(target.target)[1]
    there = target.target & (np.arange(target.target.shape[1]) > (cols.min() + cols.max()) / 2)
    left = target.target & ~there  # red
    base = np.where(there[..., None], np.uint8(0), target.image)
    half = replace(target, base=base, silhouette=there, target=there, depth_before=target.depth_new)
    assert left.any() and (half.base[left] == [200, 0, 0]).all()
    _, image, rules = paint(reference, half)
    assert error(image, target, there & (rules == Rule.OWN_PIXELS)) < 7


def test_what_the_reference_does_not_see_is_said_to_be_unreached(reference: Reference) -> None:
    target = view(reference, 2)
    shifted = replace(target, depth_new=0.6 * target.depth_new)
    _, image, rules = paint(reference, shifted)
    assert (rules[target.target] == Rule.UNREACHED).all()
    assert (image[target.target] == target.base[target.target]).all()
    assert run(reference, [shifted]).confidence == 0.0


def test_what_the_reference_has_no_colour_of_is_not_painted(reference: Reference) -> None:
    """A chart goes on where no photo shows it and no view asked for it: black, at the surface's depth."""
    completed = reference.target & (np.arange(reference.target.shape[1]) < (HOLE[2] + HOLE[3]) // 2)
    left = reference.target & ~completed
    half = replace(reference, image=np.where(left[..., None], np.uint8(0), reference.image), target=completed)
    target = view(reference, 2)
    _, image, rules = paint(half, target)
    painted = target.target & (rules == Rule.OWN_PIXELS)
    assert 0.3 < painted.sum() / target.target.sum() < 0.7
    assert error(image, target, painted) < 7


def test_a_view_without_a_hole_is_left_alone(reference: Reference) -> None:
    target = view(reference, 2)
    nothing = replace(target, target=np.zeros_like(target.target), silhouette=np.zeros_like(target.target))
    _, image, rules = paint(reference, nothing)
    assert (image == nothing.base).all() and not rules.any()


def test_without_sources_the_warped_reference_is_used(reference: Reference) -> None:
    none = np.full(reference.target.shape, -1, np.int32)
    target = view(reference, 2)
    (painted,) = propagate(reference, [lambda: target], SAMPLE, sources=MappingField(none, none, 1.0, "")).views
    image, rules = painted.pasted(target.base), painted.rule_map()
    assert (rules == Rule.REFERENCE).sum() > 0.8 * target.target.sum()
    assert error(image, target, rules == Rule.REFERENCE) < 12


def test_where_the_photo_shows_the_surface_it_is_kept(reference: Reference) -> None:
    target = view(reference, 2)
    wide = np.ones_like(target.target)
    _, image, rules = paint(reference, replace(target, target=wide & (target.depth_new > 0)))
    seen = rules == Rule.EVIDENCE
    assert seen.sum() > 1000 and (image[seen] == target.image[seen]).all()
    assert not (seen & target.silhouette).any()


def test_what_the_removed_gaussians_show_is_no_evidence(reference: Reference) -> None:
    """A shadow in a box of its own lies on the new surface, but is not what is to be seen there."""
    target = view(reference, 2)
    shadow = replace(
        target,
        depth_before=target.depth_new,
        image=np.where(target.silhouette[..., None], target.image // 3, target.image),
    )
    _, image, rules = paint(reference, shadow)
    assert not (rules == Rule.EVIDENCE).any()
    assert error(image, target, target.target & (rules != Rule.UNREACHED)) < 7


def test_the_papers_transfer_samples_the_views_own_pixels(
    reference: Reference, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every source is 30 columns off in the reference: that place's colour in the view is what is painted."""
    target = view(reference, 2)
    monkeypatch.setattr(paper, "RADIUS", 0)
    settings_ = PropagateSettings(transfer="sample")
    painted, _, rules = paint(reference, target, settings_)
    raw = painted.pasted(target.base, painted.raw)
    own = rules == Rule.OWN_PIXELS
    assert own.sum() > 0.5 * target.target.sum()
    rows, cols = np.nonzero(own)
    points = target.camera.unproject(np.stack([cols + 0.5, rows + 0.5], -1), target.depth_new[own].astype(float))
    uv, _ = reference.camera.project(points)
    uv[:, 0] += SHIFT
    z = reference.depth[uv[:, 1].astype(int), uv[:, 0].astype(int)].astype(float)
    there, _ = target.camera.project(reference.camera.unproject(uv, z))
    j, i = there.astype(int).T
    np.testing.assert_allclose(raw[own].mean(0), target.image[i, j].mean(0), atol=2)
    assert np.median(np.abs(raw[own].astype(int) - target.image[i, j])) < 8


def hide_sources(reference: Reference, target: ViewToPaint, beyond: int) -> ViewToPaint:
    """The view with something before the sources, up to `beyond` columns round them in the reference."""
    points = target.camera.unproject(target.camera.pixel_centres(), target.depth_new.astype(float))
    uv, _ = reference.camera.project(points)
    left, right = HOLE[2] + SHIFT - beyond, HOLE[3] + SHIFT + beyond
    with np.errstate(invalid="ignore"):
        there = (uv[..., 0] > left) & (uv[..., 0] < right) & (target.depth_new > 0) & ~target.target
    return replace(
        target,
        silhouette=target.silhouette | there,
        image=np.where(there[..., None], [200, 0, 0], target.image).astype(np.uint8),
    )


def test_a_hidden_source_is_retargeted_to_a_patch_that_looks_alike(
    reference: Reference, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(paper, "ALIKE", 40.0)
    target = hide_sources(reference, view(reference, 2), beyond=0)
    alone = PropagateSettings(transfer="sample", retarget=0, donors=0)
    _, _, without = paint(reference, target, alone)
    painted, _, rules = paint(reference, target, replace(alone, retarget=32))
    found = rules == Rule.RETARGETED
    assert not (without == Rule.RETARGETED).any()
    assert found.sum() > 0.3 * target.target.sum()
    raw = painted.pasted(target.base, painted.raw)
    assert error(raw, target, found) < 40 and not (raw[found] == [200, 0, 0]).all(-1).any()


def test_nothing_that_looks_different_is_retargeted_to(reference: Reference, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper, "ALIKE", 0.0)
    target = hide_sources(reference, view(reference, 2), beyond=0)
    _, _, rules = paint(reference, target, PropagateSettings(transfer="sample", donors=0))
    assert not (rules == Rule.RETARGETED).any()


def test_another_view_lends_its_pixels_at_this_views_exposure(reference: Reference) -> None:
    """One view shows no source at all; the other, twice as bright, shows them."""
    dim = view(reference, 2, lambda colours: 0.5 * colours)
    hidden = hide_sources(reference, dim, beyond=-8)  # some stay in view: they tell the exposure
    other = view(reference, 3)
    settings_ = PropagateSettings(transfer="sample", retarget=0)
    painted = run(reference, [hidden, other], settings_).views[0]
    lent = painted.rule_map() == Rule.OTHER_VIEW
    assert lent.sum() > 20
    raw = painted.pasted(hidden.base, painted.raw)
    assert abs(raw[lent].mean() - 0.5 * whole(dim.camera)[0][lent].mean()) < 15
    alone = run(reference, [hidden], settings_).views[0]
    assert not (alone.rules == Rule.OTHER_VIEW).any()


@pytest.mark.parametrize("what", ["transfer", "blend"])
def test_unknown_ways_are_refused(reference: Reference, what: str) -> None:
    with pytest.raises(BadInput, match=f"{what} 'wobble'"):
        propagate(reference, [], PropagateSettings(**{what: "wobble"}))


def test_no_views_give_no_pictures(reference: Reference) -> None:
    assert run(reference, []).views == ()


@pytest.mark.parametrize("transfer", ["warp", "sample"])
@pytest.mark.parametrize("place", [(0, 1, 0, 1), (30, 31, 60, 62), (0, 90, 0, 120), (0, 25, 0, 40), (80, 90, 100, 120)])
def test_holes_of_any_size_at_any_place_are_painted(
    reference: Reference, place: tuple[int, int, int, int], transfer: str
) -> None:
    """One pixel in the corner, two pixels, the whole picture, holes at the border."""
    top, bottom, left, right = place
    camera = cameras(9)[2]
    photo, depth = whole(camera)
    target = np.zeros(depth.shape, bool)
    target[top:bottom, left:right] = True
    base = np.where(target[..., None], 0, photo).astype(np.uint8)
    before = np.where(target, 0.5 * depth, depth).astype(np.float32)
    plain = ViewToPaint(camera, photo, base, target, target, before, depth, photo)
    _, image, rules = paint(reference, plain, PropagateSettings(transfer=transfer))
    assert image.dtype == np.uint8 and (rules[target] != Rule.UNTOUCHED).all()
    reached = target & (rules != Rule.UNREACHED)
    assert reached.any() == (place != (0, 1, 0, 1))  # the reference does not see that corner
    assert not reached.any() or error(image, plain, reached) < 60


def test_a_part_is_pasted_where_it_belongs() -> None:
    rules = np.array([[0, Rule.OWN_PIXELS], [Rule.UNREACHED, 0]], np.uint8)
    camera = replace(cameras(1)[0], width=4, height=6)
    part = PaintedView(
        camera, 3, 1, np.full((2, 2, 3), 9, np.uint8), np.full((2, 2, 3), 5, np.uint8), rules, np.ones((2, 2))
    )
    picture = np.zeros((6, 4, 3), np.uint8)
    changed = np.argwhere(part.pasted(picture).any(-1)).tolist()
    assert changed == [[3, 2], [4, 1]] and not picture.any()
    assert part.pasted(picture, part.raw).max() == 5
    assert part.rule_map()[3:5, 1:3].tolist() == rules.tolist() and part.rule_map().sum() == rules.sum()

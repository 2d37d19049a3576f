"""Photos' colours tell what stands beside the object from the object."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scenes import BLOCK, REGION, block, cameras, discs, floor

from gimp3d.gaussians import Gaussians
from gimp3d.geometry import dilated
from gimp3d.raster import footprint, render_bytes
from gimp3d.stages import beside
from gimp3d.stages.beside import Sight, shown_beside
from gimp3d.stages.look import box_polygon, fill_polygon

LOW = 0.08  # height up to which a splat may be the floor's
SURROUNDINGS = floor(with_hole=True)
SCENE = SURROUNDINGS.extended(block())
OBJECT = np.arange(len(SCENE)) >= len(SURROUNDINGS)
RING = ~OBJECT & (np.abs(SCENE.means[:, :2]).max(1) < BLOCK / 2 + 0.15)  # of the floor, that a box took too
OUTER = RING & (np.abs(SCENE.means[:, :2]).max(1) > BLOCK / 2 + 0.06)  # of it, what shares no pixels with the block
MAY = np.abs(SCENE.means[:, 2]) < LOW


def sights(scene: Gaussians = SCENE, scale: int = 1) -> list[Sight]:
    found = []
    for camera in cameras(9, 200 * scale, 150 * scale):
        polygon = box_polygon(REGION[0], camera)
        assert polygon is not None
        inside = fill_polygon(polygon, camera)
        found.append(Sight(camera, render_bytes(scene, camera), inside, np.zeros_like(inside)))
    return found


NONE = np.zeros(len(SCENE), bool)


def weight(rows: np.ndarray) -> float:
    """Of the ring's rows, those that are given."""
    return float(rows[RING].mean())


def test_floor_that_a_box_took_is_shown_beside_the_object_and_its_foot_is_not() -> None:
    found, object_, *_ = shown_beside(SCENE, OBJECT | RING, NONE, MAY, sights())
    assert found[OUTER].mean() > 0.9 and not found[OBJECT].any()
    assert not found[~MAY].any() and not object_.any()


def test_of_what_stays_it_tells_too() -> None:
    found = shown_beside(SCENE, OBJECT, NONE, MAY, sights()).beside
    away = MAY & ~OBJECT & (np.abs(SCENE.means[:, :2]).max(1) > BLOCK / 2 + 0.1)
    near = away & (np.abs(SCENE.means[:, :2]).max(1) < BLOCK)
    assert found[near].all()


def test_a_foot_that_was_taken_for_the_floor_is_shown_as_the_object() -> None:
    foot = OBJECT & MAY
    object_ = shown_beside(SCENE, OBJECT & ~MAY, foot | RING, MAY, sights()).object_
    seen = foot & (np.abs(SCENE.means[:, :2]).max(1) > 0.9 * BLOCK / 2)
    assert object_[seen].mean() > 0.9 and not object_[OUTER].any()
    assert not object_[~(foot | RING)].any()


def test_what_stands_clear_of_the_floor_is_never_the_floors_and_tells_of_its_foot() -> None:
    """An object of the floor's own colours: little of its foot is taken for the floor."""
    grey = replace(SCENE, sh=np.where(OBJECT[:, None, None], SURROUNDINGS.sh.mean(0), SCENE.sh).astype(np.float32))
    found = shown_beside(grey, OBJECT | RING, NONE, MAY, sights(grey)).beside
    assert found[OBJECT & MAY].mean() < 0.1


def test_what_is_marked_goes_whatever_its_colours_say() -> None:
    marked = [s._replace(marked=np.ones_like(s.polygon)) for s in sights()]
    assert weight(shown_beside(SCENE, OBJECT | RING, NONE, MAY, sights())[0]) > 0.5
    assert not shown_beside(SCENE, OBJECT | RING, NONE, MAY, marked)[0].any()


def test_large_photos_are_cut_small(monkeypatch: pytest.MonkeyPatch) -> None:
    large = sights(scale=2)
    whole = shown_beside(SCENE, OBJECT | RING, NONE, MAY, large).beside
    monkeypatch.setattr(beside, "LARGEST", 100)
    small = shown_beside(SCENE, OBJECT | RING, NONE, MAY, large).beside
    assert weight(whole ^ small) < 0.15 and not small[OBJECT].any()


def test_what_most_photos_show_as_the_object_is_so_for_certain_in_the_next_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each photo is cut twice, the second time at twice its size: what one cuts off wrongly, the others give back."""
    first, certain, cuts = sights()[0], dict[float, int](), list[float]()
    window = beside._window(first.polygon)

    def cut(photo: np.ndarray, start: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
        wrong = np.array_equal(photo, first.photo[window])
        if wrong:
            certain[size] = int((start == cv2.GC_FGD).sum())
        cuts.append(size)
        return np.full(start.shape, not wrong), np.zeros((2, 65))

    monkeypatch.setattr(beside, "_cut", cut)
    found = shown_beside(SCENE, OBJECT | RING, NONE, MAY, sights()).beside
    assert sorted(cuts) == [1] * len(sights()) + [2] * len(sights())
    assert certain[2] > 1.1 * certain[1] and not found[OBJECT | RING].any()


def test_it_tells_the_same_each_time() -> None:
    first, again = (shown_beside(SCENE, OBJECT | RING, RING, MAY, sights()) for _ in range(2))
    for one, other in zip(first[:5], again[:5]):
        np.testing.assert_array_equal(one, other)
    for (_, one), (_, other) in zip(first.photos, again.photos, strict=True):
        np.testing.assert_array_equal(one, other)


def test_what_reaches_under_the_foot_is_both() -> None:
    """Some of it shows on either side of the outline; photos tell how much, and where the outline is."""
    at = np.array([[BLOCK / 2 + off, 0, 0.005] for off in (0.03, 0.3)])
    large = discs(at, (0, 0, 1), np.full((2, 3), 0.6), 0.08)
    scene = SCENE.extended(large)
    rows, none = np.arange(len(scene)) - len(SCENE), np.zeros(len(scene), bool)
    may, object_ = np.append(MAY, np.ones(2, bool)), np.append(OBJECT, np.zeros(2, bool))
    taken, left = (
        shown_beside(scene, goes, stays, may, sights(scene))
        for goes, stays in ((object_ | (rows >= 0), none), (object_, rows >= 0))
    )
    for shown in (taken, left):
        assert list(rows[shown.both & (rows >= 0)]) == [0] and shown.share[-2] > 0.1 > shown.share[-1]
        assert not (shown.both & (shown.beside | shown.object_)).any()
    assert not shown_beside(scene, object_, none, may, sights(scene)).both[-2:].any()  # nobody asked
    truth = [footprint(scene, s.camera, object_) > 0.5 for s in sights(scene)]
    assert np.mean([(b == ~t)[t | s.polygon].mean() for (_, b), t, s in zip(taken.photos, truth, sights(scene))]) > 0.9


def test_a_cut_has_no_thin_foot_and_yet_tells_that_pixels_look_like_it() -> None:
    """A line from the object across a ground of many colours, one of which is much like it."""
    rng = np.random.default_rng(0)
    stripes = np.array([[120, 125, 132], [190, 60, 60], [60, 160, 60], [220, 210, 90], [150, 90, 200]])
    ground = stripes[np.where(np.arange(160) < 130, 0, 1 + np.arange(160) % 4)]
    photo = np.clip(rng.normal(ground, 5, (120, 160, 3)), 0, 255).astype(np.uint8)
    object_, line = np.zeros((2, 120, 160), bool)
    object_[40:80, 20:60], line[59:61, 62:120] = True, True
    tones = np.where(rng.uniform(size=(object_.sum(), 1)) < 0.5, (20, 20, 30), (95, 100, 110))
    photo[object_] = np.clip(rng.normal(tones, 8), 0, 255)
    photo[line] = (97, 100, 108)
    start = np.full(object_.shape, cv2.GC_BGD, np.uint8)
    start[20:100, 10:150] = cv2.GC_PR_BGD
    start[object_] = cv2.GC_FGD
    cut, mixtures = beside._cut(photo, start, 1)
    alike = beside._alike(photo, mixtures)
    assert cut[object_].all() and alike[object_].mean() > 0.9
    assert alike[line].mean() > 0.9 > cut[line].mean() + 0.4
    assert alike[~(object_ | line)].mean() < 0.05


@pytest.mark.parametrize("apart", [True, False])
def test_what_has_the_objects_colours_and_lies_apart_from_it_stays(apart: bool) -> None:
    """A dark spot on the floor of the box is no piece of a dark object; the same spot at its foot may be."""
    away = SCENE.means[:, :2] - [BLOCK / 2 + (0.11 if apart else 0.02), 0]
    spot = RING & (np.abs(away).max(1) < 0.04)
    painted = replace(SCENE, sh=SCENE.sh.copy())
    painted.sh[spot] = SCENE.sh[OBJECT].mean(0)
    wide = [s._replace(polygon=dilated(s.polygon, 20)) for s in sights(painted)]
    shown = shown_beside(painted, OBJECT, RING, MAY, wide)
    assert spot.sum() >= 4 and shown.object_[spot].mean() == (0 if apart else 1)


def test_what_may_be_a_foot_is_told_of_what_is_shown_beside_the_object() -> None:
    shown = shown_beside(SCENE, OBJECT | RING, NONE, MAY, sights())
    assert not shown.alike[~shown.beside].any() and shown.alike[OUTER].mean() < 0.1
    stained = replace(SCENE, sh=SCENE.sh.copy())
    spot = OUTER & (np.random.default_rng(0).uniform(size=len(SCENE)) < 0.1)
    stained.sh[spot] = SCENE.sh[OBJECT].mean(0)
    shown = shown_beside(stained, OBJECT | RING, NONE, MAY, sights(stained))
    assert shown.alike[spot & shown.beside].mean() > 0.25 > 0.1 > shown.alike[OUTER & ~spot].mean()


@pytest.mark.parametrize("goes", [np.zeros(len(SCENE), bool), np.ones(len(SCENE), bool)])
def test_photos_that_show_one_thing_only_are_no_error(goes: np.ndarray) -> None:
    found, object_, *_ = shown_beside(SCENE, goes, ~goes, MAY, sights()[:2])
    assert found.shape == goes.shape == object_.shape and not found[~MAY].any()


def test_without_views_nothing_is_shown() -> None:
    empty = [s._replace(polygon=np.zeros_like(s.polygon)) for s in sights()]
    for none in ([], empty):
        shown = shown_beside(SCENE, OBJECT, RING, MAY, none)
        assert not np.any(shown[:5]) and not shown.photos

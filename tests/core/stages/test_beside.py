"""Photos' colours tell what stands beside the object from the object."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import BLOCK, REGION, block, cameras, floor

from gimp3d.gaussians import Gaussians
from gimp3d.raster import render_bytes
from gimp3d.stages import beside
from gimp3d.stages.beside import Sight, shown_beside
from gimp3d.stages.look import box_polygon, fill_polygon

LOW = 0.08  # height up to which a splat may be the floor's
SURROUNDINGS = floor(with_hole=True)
SCENE = SURROUNDINGS.extended(block())
OBJECT = np.arange(len(SCENE)) >= len(SURROUNDINGS)
RING = ~OBJECT & (np.abs(SCENE.means[:, :2]).max(1) < BLOCK / 2 + 0.15)  # of the floor, that a box took too
MAY = np.abs(SCENE.means[:, 2]) < LOW


def sights(scene: Gaussians = SCENE, scale: int = 1) -> list[Sight]:
    found = []
    for camera in cameras(9, 200 * scale, 150 * scale):
        polygon = box_polygon(REGION[0], camera)
        assert polygon is not None
        inside = fill_polygon(polygon, camera)
        found.append(Sight(camera, render_bytes(scene, camera), inside, np.zeros_like(inside)))
    return found


def weight(rows: np.ndarray) -> float:
    """Of the ring's rows, those that are given."""
    return float(rows[RING].mean())


def test_floor_that_a_box_took_is_shown_beside_the_object_and_its_foot_is_not() -> None:
    found = shown_beside(SCENE, OBJECT | RING, MAY, sights())
    outer = RING & (np.abs(SCENE.means[:, :2]).max(1) > BLOCK / 2 + 0.06)  # beside what its pixels show of the block
    assert found[outer].mean() > 0.9 and not found[OBJECT].any()
    assert not found[~MAY].any()


def test_of_what_stays_it_tells_too() -> None:
    found = shown_beside(SCENE, OBJECT, MAY, sights())
    away = MAY & ~OBJECT & (np.abs(SCENE.means[:, :2]).max(1) > BLOCK / 2 + 0.1)
    near = away & (np.abs(SCENE.means[:, :2]).max(1) < BLOCK)
    assert found[near].mean() > 0.98


def test_what_stands_clear_of_the_floor_is_never_the_floors_and_tells_of_its_foot() -> None:
    """An object of the floor's own colours: little of its foot is taken for the floor."""
    grey = replace(SCENE, sh=np.where(OBJECT[:, None, None], SURROUNDINGS.sh.mean(0), SCENE.sh).astype(np.float32))
    found = shown_beside(grey, OBJECT | RING, MAY, sights(grey))
    assert found[OBJECT & MAY].mean() < 0.1


def test_what_is_marked_goes_whatever_its_colours_say() -> None:
    marked = [s._replace(marked=np.ones_like(s.polygon)) for s in sights()]
    assert weight(shown_beside(SCENE, OBJECT | RING, MAY, sights())) > 0.5
    assert not shown_beside(SCENE, OBJECT | RING, MAY, marked).any()


def test_large_photos_are_cut_small(monkeypatch: pytest.MonkeyPatch) -> None:
    large = sights(scale=2)
    whole = shown_beside(SCENE, OBJECT | RING, MAY, large)
    monkeypatch.setattr(beside, "LARGEST", 100)
    small = shown_beside(SCENE, OBJECT | RING, MAY, large)
    assert weight(whole ^ small) < 0.15 and not small[OBJECT].any()


def test_it_tells_the_same_each_time() -> None:
    first, again = (shown_beside(SCENE, OBJECT | RING, MAY, sights()) for _ in range(2))
    np.testing.assert_array_equal(first, again)


@pytest.mark.parametrize("goes", [np.zeros(len(SCENE), bool), np.ones(len(SCENE), bool)])
def test_photos_that_show_one_thing_only_are_no_error(goes: np.ndarray) -> None:
    found = shown_beside(SCENE, goes, MAY, sights()[:2])
    assert found.shape == goes.shape and not found[~MAY].any()


def test_without_views_nothing_is_shown() -> None:
    assert not shown_beside(SCENE, OBJECT, MAY, []).any()
    empty = [s._replace(polygon=np.zeros_like(s.polygon)) for s in sights()]
    assert not shown_beside(SCENE, OBJECT, MAY, empty).any()

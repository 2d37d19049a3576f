"""Which chart or view comes next, what of it is completed, what stays open then, and what is drawn anew."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from scenes import BLOCK, REGION, block, cameras, charted, floor, floor_colours, scene
from scenes import discs as discs_on

from gimp3d.box import Box
from gimp3d.camera import Camera
from gimp3d.errors import BadInput
from gimp3d.gaussians import Gaussians
from gimp3d.geometry import window_mask
from gimp3d.io.images import write_png
from gimp3d.orbit import look_at
from gimp3d.pipeline import PRESETS, RemovalResult, View, remove_object, render_bytes
from gimp3d.raster import footprint, surface_depth, touched_window
from gimp3d.stages.charts import first_hits
from gimp3d.stages.masks import ViewMasks
from gimp3d.stages.propagate import Reference, Rule
from gimp3d.steps.references import MARGIN, Turn, carried_over, redrawn, still_open, turns_of

WALL = BLOCK / 2 + 0.02  # y of a wall right behind the block
CORNER = (Box.make([0, 0, 0.26], [0.52, 0.52, 0.56]),)


@cache
def corner() -> tuple[Gaussians, tuple[View, ...]]:
    """The block on the floor, before a wall, and views from the front: two charts."""
    step = 0.035
    x, z = (g.ravel() for g in np.meshgrid(np.arange(-1.6, 1.6, step), np.arange(0, 1.2, step)))
    points = np.stack([x, np.full_like(x, WALL), z], -1)[(np.abs(x) > BLOCK / 2) | (z > BLOCK)]
    wall = discs_on(points, (0, 1, 0), floor_colours(points[:, [0, 2, 1]])[:, ::-1], 0.7 * step)
    ground = floor(with_hole=True)
    whole = ground.take(ground.means[:, 1] < WALL).extended(block()).extended(wall)
    views = []
    for k in range(7):
        angle = np.radians(-90 + 14 * (k - 3))
        eye = np.array([2 * np.cos(angle), 2 * np.sin(angle), (0.5, 0.9, 1.3)[k % 3]])
        pose = look_at(eye, np.array([0, 0, 0.25]), np.array([0, 0, 1.0]))
        camera = Camera(str(k), 160, 120, 150.0, 150.0, 80.0, 60.0, pose)
        views.append(View(camera, render_bytes(whole, camera)))
    return whole, tuple(views)


@cache
def cleared(reference: str | None) -> RemovalResult:
    return remove_object(*corner(), CORNER, PRESETS["draft"], reference)


def in_turn(result: RemovalResult) -> list[str]:
    """IDs of the references that were completed."""
    return [p.title.rpartition(" ")[2] for p in result.pictures if p.kind == "appearance"]


def test_the_chart_that_is_named_comes_first() -> None:
    assert in_turn(cleared(None)) == ["chart:1", "chart:2"]
    assert in_turn(cleared("chart:2")) == ["chart:2", "chart:1"]
    for one, other in zip(cleared(None).charts, cleared("chart:2").charts, strict=True):
        assert one.camera.id == other.camera.id
        np.testing.assert_array_equal(one.camera.viewmat, other.camera.viewmat)
        np.testing.assert_array_equal(one.hole, other.hole)
        np.testing.assert_array_equal(one.there, other.there)
        shown = one.there & ~one.hole
        np.testing.assert_array_equal(one.image[shown], other.image[shown])


def test_a_depth_prior_has_no_say_where_a_chart_is_named() -> None:
    settings = replace(PRESETS["draft"], depth_prior="planar")
    result = remove_object(*corner(), CORNER, settings, "chart:1")
    assert in_turn(result) == ["chart:1", "chart:2"]
    assert result.warnings == ("--depth-prior planar is not used: the reference is a chart",)


def test_the_picture_of_a_chart_is_of_that_chart_alone() -> None:
    first, second = cleared(None).charts
    given = np.where(second.hole[..., None], np.uint8((20, 200, 40)), second.image)
    painted = remove_object(*corner(), CORNER, PRESETS["draft"], "chart:2", given)
    np.testing.assert_array_equal(painted.charts[1].image, given)
    assert not painted.warnings and in_turn(painted) == ["chart:2", "chart:1"]
    wall = painted.charts[0]
    shown = first.there & ~first.hole
    np.testing.assert_array_equal(wall.image[shown], first.image[shown])
    assert (wall.image[wall.hole].astype(int) @ [-1, 2, -1] > 120).mean() < 0.05  # hardly any green


@pytest.mark.parametrize("number", [1, 2])
def test_a_chart_paints_nothing_of_another_one_that_it_meets(number: int) -> None:
    """At the wall's foot, a z-test takes the floor for the wall."""
    chart = cleared(None).charts[number - 1]
    given = np.where(chart.hole[..., None], np.uint8((20, 200, 40)), chart.image)
    painted = remove_object(*corner(), CORNER, PRESETS["draft"], f"chart:{number}", given)
    for view in corner()[1]:
        picture = painted.painted[view.camera.id]
        met = first_hits(painted.charts, view.camera, np.ones(picture.shape[:2], bool)).chart
        green = picture.astype(int) @ [-1, 2, -1] > 120
        assert green[met == number - 1].sum() > 400
        assert not green[(met >= 0) & (met != number - 1)].any()


def test_a_file_that_fills_is_of_the_chart_that_is_named(tmp_path: Path) -> None:
    second = cleared(None).charts[1]
    given = np.where(second.hole[..., None], np.uint8((20, 200, 40)), second.image)
    write_png(tmp_path / "given.png", given)
    settings = replace(PRESETS["draft"], inpaint=f"file:{tmp_path / 'given.png'}")
    wall, ground = remove_object(*corner(), CORNER, settings, "chart:2").charts
    assert ((ground.image == given).all(-1) | ~second.hole).mean() > 0.99
    assert (wall.image[wall.hole].astype(int) @ [-1, 2, -1] > 120).mean() < 0.05


def test_a_picture_in_another_light_is_levelled_by_what_photos_show_of_the_chart() -> None:
    second = cleared("chart:2").charts[1]
    brighter = np.clip(1.15 * second.image.astype(float), 0, 255).astype(np.uint8)
    levelled = remove_object(*corner(), CORNER, PRESETS["draft"], "chart:2", brighter)
    off = levelled.charts[1].image.astype(int) - second.image
    assert np.abs(off[second.hole]).mean() < 3 and not off[~second.hole].any()


@pytest.mark.parametrize(
    ("reference", "count", "words"),
    [("chart:3", 2, "there are 2 charts, chart:1 to chart:2"), ("chart:0", 1, "there is 1 chart, chart:1")],
)
def test_a_chart_that_there_is_not_is_refused(reference: str, count: int, words: str) -> None:
    charts = cleared(None).charts[:count]
    with pytest.raises(BadInput, match=words):
        turns_of(reference, None, charts, PRESETS["draft"])
    with pytest.raises(BadInput, match="no chart is found"):
        turns_of(reference, None, (), PRESETS["draft"])
    with pytest.raises(BadInput, match="photos are the only references"):
        turns_of(reference, None, (), PRESETS["paper"])


def test_views_are_no_charts() -> None:
    for name in (None, "view", "chart", "chart:", "chart:one", "my/chart:1"):
        assert turns_of(name, None, (), PRESETS["paper"]) == [Turn(None, name)]


def test_after_a_view_whose_picture_is_given_charts_come_before_other_views() -> None:
    charts, given = cleared(None).charts, np.zeros((120, 160, 3), np.uint8)
    settings = replace(PRESETS["balanced"], extra_references=1)
    first = Turn(None, "3", given)
    assert turns_of("3", given, charts, settings) == [first, Turn(0), Turn(1), Turn()]
    told = replace(settings, depth_prior="onnx:model.onnx")
    assert turns_of("3", given, charts, told) == [first, Turn(), Turn(0), Turn(1)]
    assert turns_of("3", given, (), settings) == [first, Turn()]
    assert turns_of(None, None, charts, settings) == [Turn(0), Turn(1)]


def test_a_chart_takes_over_nothing_of_what_lies_beside_a_completed_hole() -> None:
    chart = cleared(None).charts[0]
    camera = replace(chart.camera, id="view", split="train", cx=chart.camera.cx + 0.5, cy=chart.camera.cy + 0.5)
    rows = np.argwhere(chart.hole)[:, 0]
    completed = chart.hole & (
        np.arange(len(chart.hole))[:, None] < np.median(rows)
    )  # the object stands before the rest
    image = np.where(completed[..., None], np.uint8((20, 200, 40)), np.uint8((250, 0, 0)))
    alone, beside_photo = (
        carried_over(chart, [Reference(camera, image, chart.depth, completed, source)])
        for source in (np.zeros_like(chart.hole), ~chart.hole)
    )
    new = alone.known & ~chart.known
    assert new.sum() > 0.1 * chart.hole.sum() and (alone.image[new] == (20, 200, 40)).all()
    assert (beside_photo.known & ~alone.known).any()  # the rim is as good as the photo beside it


@cache
def view() -> ViewMasks:
    """A view of the block; T is the hole in the floor under it, and the margin."""
    seen = max(charted(scene(), REGION, cameras(9, 160, 120)).masks.views, key=lambda v: int(v.target.sum()))
    depth, alpha = surface_depth(floor(with_hole=True), seen.camera)
    emptied = replace(seen, depth_after=depth, alpha_after=alpha)
    side = 2 * MARGIN + 1
    return replace(emptied, target=cv2.dilate(hole_of(emptied).astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def hole_of(seen: ViewMasks) -> np.ndarray:
    return seen.polygon & (seen.alpha_after < 0.5)


def floor_at_pixels() -> np.ndarray:
    """[H, W, 3]: the point of the floor z = 0 that each pixel shows."""
    camera = view().camera
    rays = camera.unproject(camera.pixel_centres(), np.ones((camera.height, camera.width))) - camera.centre
    return camera.centre + rays * (-camera.centre[2] / rays[..., 2])[..., None]


def patch(least_x: float = -BLOCK / 2) -> Gaussians:
    """The floor under the block, from an x on."""
    step = 0.02
    grid = np.arange(-BLOCK / 2, BLOCK / 2 + 1e-6, step)
    points = np.stack(
        [
            *(g.ravel() for g in np.meshgrid(grid[grid >= least_x], grid)),
        ],
        -1,
    )
    points = np.concatenate([points, np.zeros((len(points), 1))], 1)
    return discs_on(points, (0, 0, 1), floor_colours(points), 0.7 * step)


def opened(new: Gaussians, rules: np.ndarray) -> ViewMasks:
    camera = view().camera
    touched = window_mask(touched_window(new, camera), camera)
    return still_open(view(), floor(with_hole=True).extended(new), len(new), rules, touched)


def told() -> np.ndarray:
    return np.where(view().target, Rule.OWN_PIXELS, Rule.UNTOUCHED).astype(np.uint8)


def test_a_hole_that_is_covered_and_coloured_is_closed_with_its_margin() -> None:
    new = patch()
    filled = floor(with_hole=True).extended(new)
    rows = np.arange(len(filled)) >= len(filled) - len(new)
    margin = view().target & (footprint(filled, view().camera, rows) <= 0.5)
    assert margin.any()  # coverage alone would not close it
    after = opened(new, told())
    assert not after.target.any()
    depth, alpha = surface_depth(filled, view().camera)
    np.testing.assert_array_equal(after.depth_after, depth)
    np.testing.assert_array_equal(after.alpha_after, alpha)
    np.testing.assert_array_equal(after.depth_before, view().depth_before)


def test_what_the_new_surface_does_not_cover_stays_open() -> None:
    after, x = opened(patch(least_x=0.0), told()), floor_at_pixels()[..., 0]
    assert not (after.target & ~view().target).any()
    inside = np.abs(floor_at_pixels()[..., :2]).max(-1) < 0.8 * BLOCK / 2  # away from the floor round the hole
    missing, covered = (view().target & inside & side for side in (x < -0.06, x > 0.06))
    assert missing.sum() > 50 and after.target[missing].all()
    assert covered.sum() > 50 and not after.target[covered].any()


def test_covered_pixels_that_got_no_colour_stay_open() -> None:
    in_hole = hole_of(view())
    rows, cols = np.nonzero(in_hole)
    square = np.zeros_like(in_hole)
    middle = len(rows) // 2
    square[rows[middle] - 4 : rows[middle] + 4, cols[middle] - 4 : cols[middle] + 4] = True
    square &= in_hole
    after = opened(patch(), np.where(square, np.uint8(Rule.UNREACHED), told()))
    assert square.sum() > 30
    np.testing.assert_array_equal(after.target, square)


def test_where_no_seed_stays_the_hole_stays_open() -> None:
    """What the scene itself draws there is nothing new."""
    after = still_open(view(), floor(with_hole=False), 0, told(), np.ones_like(view().target))
    inside = cv2.erode(hole_of(view()).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert inside.sum() > 50 and after.target[inside & view().target].all()


def test_nothing_new_leaves_the_hole_as_it_was() -> None:
    far = patch()
    far = replace(far, means=far.means + np.float32([0, 0, -50]))  # below the floor, seen through the hole
    after = opened(far, told())
    hole = hole_of(view())
    assert after.target[hole].mean() > 0.95


def test_gaps_that_were_no_target_are_drawn_from_the_filled_scene() -> None:
    camera = view().camera
    grey = np.full((camera.height, camera.width, 3), 128, np.uint8)
    gap = np.zeros((camera.height, camera.width), bool)
    gap[40:45, 50:60] = True
    one = replace(
        view(),
        silhouette=gap | view().silhouette,
        target=view().target & ~gap,
        alpha_after=np.where(gap | view().target, np.float32(0.5), np.float32(1.0)),
    )
    filled, everywhere, elsewhere = floor(with_hole=False), np.s_[:, :], np.s_[60:, :]
    done = redrawn(grey, filled, one, everywhere)
    np.testing.assert_array_equal(done[gap], render_bytes(filled, camera)[gap])
    np.testing.assert_array_equal(done[~gap], grey[~gap])
    assert (done[gap] != 128).any()
    assert redrawn(grey, filled, one, elsewhere) is grey


def test_views_without_gaps_are_not_drawn_anew() -> None:
    camera = view().camera
    solid = replace(view(), alpha_after=np.ones_like(view().alpha_after))
    grey = np.full((camera.height, camera.width, 3), 128, np.uint8)
    assert redrawn(grey, floor(with_hole=False), solid, np.s_[:, :]) is grey

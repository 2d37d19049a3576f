"""Which chart or view comes next, and what of it is completed."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scenes import BLOCK, block, floor, floor_colours
from scenes import discs as discs_on

from gimp3d.box import Box
from gimp3d.camera import Camera
from gimp3d.errors import BadInput
from gimp3d.gaussians import Gaussians
from gimp3d.io.images import write_png
from gimp3d.orbit import look_at
from gimp3d.pipeline import (
    PRESETS,
    RemovalResult,
    View,
    remove_object,
    render_bytes,
)
from gimp3d.stages.propagate import Reference
from gimp3d.steps.completion import Turn, carried_over, turns_of

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
        np.testing.assert_array_equal(one.image[~one.hole], other.image[~other.hole])


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
    np.testing.assert_array_equal(wall.image[~wall.hole], first.image[~first.hole])
    assert (wall.image[wall.hole].astype(int) @ [-1, 2, -1] > 120).mean() < 0.05  # hardly any green


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

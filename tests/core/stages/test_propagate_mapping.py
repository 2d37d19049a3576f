"""The mapping field and the visibility of its sources."""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest

from gimp3d.camera import Camera
from gimp3d.compute.threads import set_thread_count
from gimp3d.geometry import SAME_DEPTH
from gimp3d.stages.propagate.paper import MappingSettings, mapping_field, source_visibility

View = tuple[Camera, np.ndarray, np.ndarray]


@pytest.fixture(autouse=True)
def _default_threads() -> Iterator[None]:
    yield
    set_thread_count(None)


def camera(x: float = 0.0, turn: float = 0.0, width: int = 64, height: int = 48, f: float = 60.0) -> Camera:
    """At (x, 0, 0), turned by `turn` radians about the vertical axis, with a lens shift."""
    c, s = np.cos(turn), np.sin(turn)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    viewmat[:3, 3] = -viewmat[:3, :3] @ [x, 0, 0]
    return Camera(f"{x}", width, height, f, 1.1 * f, width / 2 + 2, height / 2 - 3, viewmat)


def wall(view: Camera, distance: float = 4.0) -> np.ndarray:
    """z-depth of the plane z = distance, [H, W] float32."""
    rays = (view.unproject(view.pixel_centres(), np.ones((view.height, view.width))) - view.centre)[..., 2]
    return np.where(rays > 0, distance / rays, 0).astype(np.float32)


def nothing_hidden(view: Camera) -> np.ndarray:
    return np.zeros((view.height, view.width), bool)


def by_projection(reference: Camera, depth: np.ndarray, views: list[View], tolerance: float) -> np.ndarray:
    """The definition, pixel by pixel, in float64."""
    shares = np.zeros(depth.shape)
    for i, j in np.argwhere(depth > 0):
        point = reference.unproject(np.array([j + 0.5, i + 0.5]), np.asarray(depth[i, j], float))
        for view, there, hidden in views:
            uv, z = view.project(point)
            if z > 0 and 0 <= uv[0] < view.width and 0 <= uv[1] < view.height:
                a, b = int(uv[1]), int(uv[0])
                shares[i, j] += not hidden[a, b] and abs(there[a, b] - z) < tolerance * z
    return shares / len(views)


def test_visibility_is_the_share_of_views_that_show_the_point() -> None:
    reference = camera()
    others = [camera(0.7, 0.1), camera(-1.0, -0.3, 90, 31, 75.0), camera(3.0), camera(0.2, 2.0)]
    views = [(c, wall(c), nothing_hidden(c)) for c in others]
    views[0][2][10:20, 20:40] = True
    views[1][1][:, 60:] = 1.0  # an occluder
    depth = wall(reference)
    depth[:5] = 0
    found = source_visibility(reference, depth, views)
    expected = by_projection(reference, depth, views, SAME_DEPTH)
    assert 0.2 < expected.mean() < 0.8
    assert np.abs(found - expected).max() < 1e-6 or (np.abs(found - expected) > 1e-6).mean() < 0.001


@pytest.mark.parametrize(
    ("change", "share"),
    [("none", 1.0), ("hidden", 0.0), ("occluded", 0.0), ("sees farther", 0.0), ("empty", 0.0)],
)
def test_a_view_counts_only_where_it_shows_the_same_surface(change: str, share: float) -> None:
    view = camera()
    depth = wall(view)
    there = {"occluded": 0.5 * depth, "sees farther": 2 * depth, "empty": 0 * depth}.get(change, depth)
    hidden = np.full(depth.shape, change == "hidden")
    assert (source_visibility(view, depth, [(view, there, hidden)]) == share).all()


def test_points_at_no_depth_at_infinity_or_without_views_are_seen_by_nobody() -> None:
    view = camera()
    depth = wall(view)
    depth[0, :4] = 0, np.nan, np.inf, -1
    visible = source_visibility(view, depth, [(view, depth, nothing_hidden(view))])
    assert (visible[0, :4] == 0).all()
    assert visible.sum() == depth.size - 4
    assert not source_visibility(view, depth, []).any()


def test_depth_tolerance_is_relative() -> None:
    view = camera()
    for distance in (0.1, 4.0, 1000.0):
        depth = wall(view, distance)
        near, far = ((view, factor * depth, nothing_hidden(view)) for factor in (1.01, 1.03))
        assert source_visibility(view, depth, [near]).all()
        assert not source_visibility(view, depth, [far]).any()


def test_visibility_does_not_depend_on_the_thread_count() -> None:
    reference, others = camera(), [camera(0.7, 0.1), camera(-0.4, -0.2)]
    views = [(c, wall(c), nothing_hidden(c)) for c in others]
    results = []
    for threads in (1, 2, 4):
        set_thread_count(threads)
        results.append(source_visibility(reference, wall(reference), views))
    assert (results[0] == results[1]).all() and (results[0] == results[2]).all()


def twins() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A picture that shows what is in its hole twice more, left and right; the hole; v, 0 on the left."""
    noise = cv2.GaussianBlur(np.random.default_rng(3).normal(size=(64, 128, 3)), (0, 0), 2)
    picture = np.clip(128 + 350 * noise, 0, 255).astype(np.uint8)
    picture[20:44, 10:34] = picture[20:44, 52:76]
    picture[20:44, 94:118] = picture[20:44, 52:76]
    target = np.zeros((64, 128), bool)
    target[26:38, 58:70] = True
    return picture, target, np.broadcast_to(np.arange(128) >= 64, target.shape).astype(np.float32)


def test_of_two_equal_sources_the_more_visible_one_is_taken() -> None:
    picture, target, visibility = twins()
    field = mapping_field(picture, target, ~target, visibility)
    rows, cols = np.nonzero(target)
    assert ((field.rows[target] == rows) & (field.cols[target] == cols + 42)).mean() > 0.95
    assert field.confidence > 0.8
    assert "100% of the views" in field.reason


def test_visibility_weighs_less_than_likeness() -> None:
    picture, target, visibility = twins()
    picture[:, 78:] = 255 - picture[:, 78:]  # only the unseen copy is left
    field = mapping_field(picture, target, ~target, visibility)
    assert (field.cols[target] < 64).mean() > 0.95


def test_a_reference_that_is_all_hole_maps_nothing_and_says_so() -> None:
    picture, target, visibility = twins()
    field = mapping_field(picture, np.ones_like(target), np.zeros_like(target), visibility)
    assert (field.rows == -1).all()
    assert field.confidence == 0.0
    assert "no source" in field.reason


def test_an_empty_target_needs_no_map() -> None:
    picture, target, visibility = twins()
    field = mapping_field(picture, np.zeros_like(target), ~target, visibility)
    assert (field.rows == -1).all()
    assert field.confidence == 1.0


def test_the_seed_of_the_run_and_of_the_settings_both_count() -> None:
    picture, target, visibility = twins()
    settings = MappingSettings()
    shifted = replace(settings, patchmatch=replace(settings.patchmatch, seed=4))
    by_run = mapping_field(picture, target, ~target, visibility, settings, seed=4)
    by_settings = mapping_field(picture, target, ~target, visibility, shifted)
    assert (by_run.rows == by_settings.rows).all() and (by_run.cols == by_settings.cols).all()


def test_as_printed_sources_are_off_by_the_place_that_they_are_for() -> None:
    rng = np.random.default_rng(2)
    image = rng.integers(0, 256, (60, 80, 3), np.uint8)
    target = np.zeros((60, 80), bool)
    target[20:30, 20:36] = True
    nowhere = np.zeros(target.shape, np.float32)
    plain, printed = (
        mapping_field(image, target, ~target, nowhere, MappingSettings(as_printed=p)) for p in (False, True)
    )
    rows, cols = np.indices(target.shape)
    legal = target & (plain.rows + rows < 60) & (plain.cols + cols < 80)
    legal[legal] = ~target[(plain.rows + rows)[legal], (plain.cols + cols)[legal]]
    assert 0 < legal.sum() < target.sum()
    np.testing.assert_array_equal(printed.rows, np.where(legal, plain.rows + rows, -1))
    np.testing.assert_array_equal(printed.cols, np.where(legal, plain.cols + cols, -1))

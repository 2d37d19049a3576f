"""Choosing the reference."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import REGION, cameras, charted, scene

from gimp3d.camera import Camera
from gimp3d.errors import IllPosed
from gimp3d.orbit import look_at
from gimp3d.stages.reference import _coarse, choose_reference, needed_surface

UP = np.array([0, 0, 1.0])


def camera_at(name: str, eye: tuple[float, float, float], target: tuple[float, float, float] = (0, 0, 0)) -> Camera:
    return Camera(name, 120, 90, 110, 110, 60, 45, look_at(np.array(eye), np.array(target, float), UP))


def test_the_steep_view_wins_over_the_grazing_one_and_the_cut_off_one() -> None:
    views = [
        camera_at("grazing", (2.2, 0, 0.5)),
        camera_at("steep", (0.8, 0.3, 2.0)),
        camera_at("cut off", (0.8, 0.3, 2.0), (0.65, 0.65, 0)),
    ]
    choice = choose_reference(charted(scene(), REGION, views).masks.views)
    assert choice.camera_id == "steep" and choice.confidence == 1
    scores = {s.camera_id: s for s in choice.scores}
    assert scores["steep"].covered > 0.7 and scores["grazing"].covered > 0.7
    assert scores["cut off"].covered < 0.8 * scores["steep"].covered
    assert scores["grazing"].facing < 0.5 * scores["steep"].facing
    assert all(0 < s.score <= 1 and 0 < s.detail <= 1 for s in choice.scores)


def test_the_needed_surface_is_the_floor_under_the_object() -> None:
    points, normals = needed_surface(charted(scene(), REGION, cameras()).masks.views)
    assert len(points) > 100
    assert np.percentile(np.abs(points[:, 2]), 90) < 0.05  # the floor lies at z = 0
    assert np.median(normals[:, 2]) > 0.95
    assert np.abs(points[:, :2]).max() < 2


@pytest.mark.parametrize("step", [1, 2, 3])
def test_a_coarse_view_shows_the_same_points(step: int) -> None:
    view = charted(scene(), REGION, cameras()).masks.views[0]
    camera, part = _coarse(view, step)
    depth = view.depth_before.astype(np.float64)
    points = view.camera.unproject(view.camera.pixel_centres(), depth)[part]
    np.testing.assert_allclose(camera.unproject(camera.pixel_centres(), depth[part]), points, atol=1e-9)
    assert view.target[part].sum() > 0.8 * view.target.sum() / step**2


def test_large_holes_are_sampled_as_well_as_small_ones() -> None:
    views = charted(scene(), REGION, cameras()).masks.views
    fine, coarse = (needed_surface(views, samples=n)[0] for n in (10**6, 50))
    assert 0 < len(coarse) < 0.5 * len(fine)
    apart = np.linalg.norm(fine[:, None] - coarse[None], axis=-1)
    assert apart.min(1).max() < 0.18 and apart.min(0).max() < 0.1  # one surface, and all of it


def test_a_view_is_completed_once() -> None:
    views = charted(scene(), REGION, cameras()).masks.views
    first = choose_reference(views)
    second = choose_reference(views, tried={first.camera_id})
    assert second.camera_id == first.scores[1].camera_id
    with pytest.raises(IllPosed, match="no view"):
        choose_reference(views, tried=[v.camera.id for v in views])


def test_a_wanted_view_is_taken_unless_it_does_not_see_the_hole() -> None:
    masks = charted(scene(), REGION, cameras()).masks
    assert choose_reference(masks.views, "orbit/001").camera_id == "orbit/001"
    with pytest.raises(IllPosed, match="does not see"):
        choose_reference(masks.views, "elsewhere")
    with pytest.raises(IllPosed, match="no view"):
        choose_reference([])

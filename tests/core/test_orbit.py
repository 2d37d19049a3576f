"""Cameras round a region."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from gimp3d.box import Box
from gimp3d.camera import Camera
from gimp3d.errors import BadInput
from gimp3d.gaussians import Gaussians, quats_to_matrices
from gimp3d.orbit import GAP, cameras_between, look_at, measured_up, orbit_cameras


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (1, 0, 0), (0.3, -2, 0.5)])
def test_all_cameras_frame_the_region_from_above_and_outside(up: tuple[float, float, float]) -> None:
    boxes = (Box.make([5, 1, -2], [1, 2, 0.5], [0.9, 0.1, 0.3, 0.2]), Box.make([6, 1, -2], [1, 1, 1]))
    axis = np.array(up) / np.linalg.norm(up)
    cameras = orbit_cameras(boxes, 11, up, 320, 200, 60)
    assert len({c.id for c in cameras}) == 11 and all(c.split == "train" for c in cameras)
    corners = np.concatenate([b.corners() for b in boxes])
    for camera in cameras:
        uv, z = camera.project(corners)
        assert (z > 0).all() and (uv >= 0).all() and (uv < [320, 200]).all()
        assert (camera.centre - corners.mean(0)) @ axis > 0
        assert not any(b.contains(camera.centre[None])[0] for b in boxes)
        np.testing.assert_allclose(camera.R @ camera.R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(camera.R) == pytest.approx(1)
        assert camera.R[1] @ axis < 0  # the picture is upright: its y axis points down
        assert 2 * np.degrees(np.arctan(160 / camera.fx)) == pytest.approx(60)


@pytest.mark.parametrize("fov", [1.5, 50, 120, 169])
@pytest.mark.parametrize(("width", "height"), [(320, 200), (90, 160)])
def test_the_regions_sphere_fills_two_fifths_of_the_smaller_side(fov: float, width: int, height: int) -> None:
    box = Box.make([1, 2, 3], [0.4, 0.8, 0.2])
    radius = np.linalg.norm(box.size) / 2
    for camera in orbit_cameras((box,), 6, (0, 0, 1), width, height, fov):
        distance = np.linalg.norm(camera.centre - box.center)
        outline = camera.fx * np.tan(np.arcsin(radius / distance))  # of a sphere on the optical axis, pixels
        assert outline == pytest.approx(0.4 * min(width, height) / 2)
        assert camera.project(box.center)[0] == pytest.approx([width / 2, height / 2])


def test_orbits_are_the_same_every_time_and_spread_over_three_rings() -> None:
    box = Box.make([0, 0, 0], [1, 1, 1])
    first, second = orbit_cameras((box,), 12), orbit_cameras((box,), 12)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.viewmat, b.viewmat)
    assert [c.id for c in first[:2]] == ["orbit/000", "orbit/001"]
    away = np.array([c.centre / np.linalg.norm(c.centre) for c in first])
    assert {round(e) for e in np.degrees(np.arcsin(away[:, 2]))} == {15, 35, 60}
    angles = np.sort(np.degrees(np.arctan2(away[:, 1], away[:, 0])) % 360)
    np.testing.assert_allclose(np.diff(angles), 30, atol=1e-9)


@pytest.mark.parametrize("count", [1, 2, 3, 7, 12])
def test_cameras_between_others_leave_no_gap(count: int) -> None:
    """But beyond the outermost ones: there nothing is drawn that a photo told."""
    box = Box.make([1, 2, 3], [1, 1, 1])
    given = orbit_cameras((box,), 24)[:: 24 // count][:count]
    found = cameras_between(given, box.center)
    assert (len(found) == 0) == (count < 3) and len({c.id for c in found}) == len(found)

    def towards(cameras: Sequence[Camera]) -> np.ndarray:
        away = np.array([c.centre for c in cameras]).reshape(-1, 3) - box.center
        return away / np.linalg.norm(away, axis=1, keepdims=True)

    middle = (towards(given)[:, None] + towards(given)).reshape(-1, 3)
    middle = middle[np.linalg.norm(middle, axis=1) > 1]  # of those 120° apart
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    both = np.concatenate([towards(given), towards(found)])
    assert ((middle @ both.T).max(1, initial=-1) > np.cos(np.radians(GAP + 1e-6))).all()
    apart = towards(found) @ both.T
    apart[:, count:][np.diag_indices(len(found))] = -1
    assert (apart < np.cos(np.radians(GAP - 1e-6))).all()  # and none where another one stands
    for camera in found:
        assert camera.project(box.center)[0] == pytest.approx([camera.width / 2, camera.height / 2])
        assert camera.R[1, 2] < 1e-9  # not upside down


def test_hundreds_of_cameras_in_two_groups_have_some_between_them() -> None:
    box = Box.make([0, 0, 0], [1, 1, 1])
    around = orbit_cameras((box,), 3600)
    groups = [*around[:400], *around[900:1300]]  # 40° wide, 50° apart
    assert 2 <= len(cameras_between(groups, box.center)) <= 12


@pytest.mark.parametrize("apart", [119, 121, 180])
def test_cameras_far_apart_have_none_between_them(apart: float) -> None:
    """Half way between two that face each other a camera would look straight down, and could not be upright."""
    lens, a = orbit_cameras((Box.make([0, 0, 0], [1, 1, 1]),), 1)[0], np.radians(apart)
    eyes = 3.0 * np.array([[1, 0, 0], [np.cos(a), 0, np.sin(a)]])
    up = np.cross(eyes, [0.0, 1, 0])
    two = [replace(lens, viewmat=look_at(e, np.zeros(3), u)) for e, u in zip(eyes, up)]
    found = cameras_between(two, np.zeros(3))
    assert len(found) == (apart < 120) and all(np.isfinite(c.viewmat).all() for c in found)


def splats(points: np.ndarray) -> Gaussians:
    n = len(points)
    quats = np.tile([1.0, 0, 0, 0], (n, 1))
    return Gaussians(
        means=points.astype(np.float32),
        log_scales=np.full((n, 3), -3, np.float32),
        quats=quats.astype(np.float32),
        opacity_logits=np.full(n, 2, np.float32),
        sh=np.zeros((n, 1, 3), np.float32),
    )


@pytest.mark.parametrize("seed", range(5))
def test_up_is_away_from_the_floor_and_not_from_a_wall(seed: int) -> None:
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=4)
    turn = quats_to_matrices(quat[None])[0]
    floor = np.column_stack([rng.uniform(-3, 3, (3000, 2)), rng.normal(0, 0.005, 3000)])
    wall = np.column_stack([rng.uniform(-3, 3, 3000), np.full(3000, 1.2), rng.uniform(0, 3, 3000)])
    thing = rng.uniform([-0.5, -0.5, 0], [0.5, 0.5, 1], (3000, 3))  # what is to be removed is no floor
    box = Box.make(np.array([0, 0, 0.55]) @ turn.T + 7, [1, 1, 1], quat)
    up = measured_up(splats(np.concatenate([floor, wall, thing]) @ turn.T + 7), (box,))
    assert up is not None
    np.testing.assert_allclose(up, turn[:, 2], atol=0.01)


def test_without_a_floor_up_is_unknown() -> None:
    cloud = np.random.default_rng(0).normal(size=(3000, 3)) * 2
    box = (Box.make([0, 0, 0], [1, 1, 1]),)
    assert measured_up(splats(cloud), box) is None
    assert measured_up(splats(cloud[:3]), box) is None


def test_an_orbit_round_nothing_is_refused() -> None:
    with pytest.raises(BadInput, match="at least one box"):
        orbit_cameras(())


@pytest.mark.parametrize(
    "change",
    [{"up": (0, 0, 0)}, {"count": 0}, {"fov_degrees": 0.5}, {"fov_degrees": 180}, {"width": 0}, {"up": (np.nan, 0, 0)}],
)
def test_senseless_orbits_are_refused(change: dict) -> None:
    with pytest.raises(BadInput, match="orbit"):
        orbit_cameras((Box.make([0, 0, 0], [1, 1, 1]),), **change)

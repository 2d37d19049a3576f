"""A made object in a scan's photos: where it stands, what hides it, and a scene from end to end."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest

from benchmarks.scenes import read_scene
from gimp3d.box import Box
from gimp3d.camera import Camera
from gimp3d.errors import BadInput
from gimp3d.orbit import look_at
from gimp3d.stages.charts.plane import Plane
from tools import make_real_scenes, make_scenes
from tools.make_real_scenes import THINGS, cut_out, place_on, put_up

FLOOR = Plane.make(np.zeros(3), np.array([0.0, 0, 1.0]), (Box.make([0, 0, 0.5], [1, 1, 1]),))
ABOVE = Camera(
    "a", 96, 64, 80.0, 80.0, 50.0, 30.0, look_at(np.array([0.5, -2.0, 2.0]), np.zeros(3), np.array([0, 0, 1.0]))
)


def test_it_stands_where_the_pixel_shows_the_surface() -> None:
    place = place_on(FLOOR, ABOVE, (40.0, 35.0), 0.2)
    uv, z = ABOVE.project(place.at[None])
    assert np.allclose(uv, [[40, 35]]) and np.isclose(place.size, 0.2 * z[0])
    assert (
        np.isclose(place.at[2], 0)
        and np.isclose(np.linalg.det(place.axes), 1)
        and np.allclose(place.axes[:, 2], [0, 0, 1])
    )


def test_a_pixel_of_the_sky_is_refused() -> None:
    level = Camera(
        "b",
        96,
        64,
        80.0,
        80.0,
        48.0,
        32.0,
        look_at(np.array([0, -2.0, 1.0]), np.array([0, 0, 1.0]), np.array([0, 0, 1.0])),
    )
    with pytest.raises(BadInput, match="does not show the surface"):
        place_on(FLOOR, level, (48.0, 10.0), 0.2)


@pytest.mark.parametrize("thing", THINGS)
def test_it_is_drawn_where_the_camera_sees_its_box_and_hidden_by_what_is_before_it(thing: str) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    make_scenes.lit(0.9, 1.2)
    place = place_on(FLOOR, ABOVE, (40.0, 35.0), 0.3)
    parts = THINGS[thing]()
    box, studio = put_up(parts, place), make_scenes.Studio(parts)
    corners = np.concatenate([[one.matrix_world @ v.co for v in one.data.vertices] for one in parts])
    assert box.contains(corners.astype(float)).all() and not box.contains(
        place.at[None] - 0.2 * place.size * place.axes[:, 2]
    )
    floor = np.full((64, 96), 100.0)
    shown, z = cut_out(studio, ABOVE, place, floor, floor < 0)
    rows, cols = np.nonzero(shown[..., 3] > 0.5)
    uv, _ = ABOVE.project(corners.astype(float))
    assert abs(cols.min() - uv[:, 0].min()) < 1.5 and abs(cols.max() + 1 - uv[:, 0].max()) < 1.5
    assert abs(rows.min() - uv[:, 1].min()) < 1.5 and abs(rows.max() + 1 - uv[:, 1].max()) < 1.5
    points = ABOVE.unproject(ABOVE.pixel_centres(), z)[shown[..., 3] > 0.95]
    assert box.contains(points).mean() > 0.98
    half = floor.copy()
    half[:, :40] = 0.5  # a pillar before its left half
    hidden, _ = cut_out(studio, ABOVE, place, half, floor < 0)
    assert not hidden[:, :40, 3].any() and (hidden[:, 41:, 3] == shown[:, 41:, 3]).all()
    assert (cut_out(studio, ABOVE, place, half, floor > 0)[0] == shown).all()  # it is floor, drawn where it is not


@pytest.mark.slow
def test_a_scene_is_made_as_benchmarks_read_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"SAMPLES": 2, "TRAIN": 10, "TEST": 2, "POINTS": 20_000, "STEPS": 10}.items():
        monkeypatch.setattr(make_scenes, name, value)
    for name, value in {"STEPS": 5, "LEAST": 50}.items():
        monkeypatch.setattr(make_real_scenes, name, value)
    monkeypatch.setattr(make_real_scenes, "support", lambda scan: FLOOR)
    make_scenes.make("edge", tmp_path / "edge")
    scan = read_scene(tmp_path / "edge")
    make_real_scenes.make(scan, scan.train[3].id, (150.0, 150.0), "pot", 0.1, tmp_path / "new")
    scene = read_scene(tmp_path / "new", needs_truth=True)
    assert len(scene.test) >= 2 and len(scene.views) + len(scene.test) == 10
    for camera in scene.test:
        hidden = scene.hides(camera)
        changed = np.abs(scene.truth(camera).astype(int) - scene.with_object(camera)).max(-1)
        assert hidden.any() and not changed[~hidden].any() and np.median(changed[hidden]) > 20

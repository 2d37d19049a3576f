"""Scenes that are made to measure removals with: what they hold, and one of them small, from end to end."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest

from benchmarks.scenes import read_scene
from gimp3d.box import in_region
from gimp3d.camera import Camera
from tools import make_scenes


@pytest.mark.parametrize("name", make_scenes.SCENES)
def test_the_box_holds_the_object_and_no_camera(name: str) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    made = make_scenes.SCENES[name]()
    bpy.context.view_layer.update()
    corners = np.concatenate([[one.matrix_world @ v.co for v in one.data.vertices] for one in made.thing])
    assert in_region((made.region,), corners.astype(float)).all()
    views = make_scenes.cameras(made)
    assert not in_region((made.region,), np.array([c.centre for c in views])).any()
    for camera in views:  # each shows it whole
        uv, z = camera.project(corners.astype(float))
        assert (z > 0).all() and ((uv > 0) & (uv < make_scenes.SIZE)).all()


def test_a_view_shows_what_no_object_and_nothing_else_is_before() -> None:
    camera = Camera("a", 8, 6, 10.0, 10.0, 4.0, 3.0, np.eye(4))
    depth, mask = np.full((6, 8), 2.0), np.zeros((6, 8), bool)
    mask[:, :4] = True  # the object covers the left half
    points = np.array([[0.3, 0, 2.0], [-0.3, 0, 2.0], [0.3, 0, 2.5], [9.0, 0, 2.0]])
    assert make_scenes.shown_by_any(points, [(camera, depth, mask)]).tolist() == [True, False, False, False]


@pytest.mark.slow
def test_a_scene_is_made_as_benchmarks_read_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"SAMPLES": 2, "TRAIN": 5, "TEST": 2, "POINTS": 3000, "STEPS": 10}.items():
        monkeypatch.setattr(make_scenes, name, value)
    make_scenes.make("edge", tmp_path / "edge")
    scene = read_scene(tmp_path / "edge", needs_truth=True)
    assert len(scene.train) == 5 and len(scene.test) == 2 and len(scene.views) == 5
    assert scene.gaussians.usable.all()
    for camera in scene.test:
        hidden, unseen = scene.hides(camera), scene.unseen(camera)
        assert unseen.any() and hidden[unseen].all() and not unseen[hidden].all()
        changed = np.abs(scene.truth(camera).astype(int) - scene.with_object(camera)).max(-1)
        assert np.median(changed[hidden]) > 10 * np.median(changed[~hidden])

"""Blender's cameras, cubes and object frames against independent computations."""

from __future__ import annotations

import json
import math
from pathlib import Path

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from hypothesis import HealthCheck, given
from hypothesis import strategies as st
from mathutils import Euler, Matrix, Vector
from property_tests import examples
from scenes import cameras, scene

from gimp3d.box import Box
from gimp3d.errors import BadInput
from gimp3d.io.cameras import read_cameras, write_transforms
from gimp3d.pipeline import render_bytes
from gimp3d_addon import bridge

NO_FIXTURE_CHECK = examples(40, suppress_health_check=[HealthCheck.function_scoped_fixture])


def add_camera(name: str = "cam") -> bpy.types.Object:
    obj = bpy.data.objects.new(name, bpy.data.cameras.new(name))
    bpy.context.scene.collection.objects.link(obj)
    return obj


def read(obj: bpy.types.Object, frame: np.ndarray | None = None):
    bpy.context.view_layer.update()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    return bridge.camera_from_blender(obj, np.eye(4) if frame is None else frame, bpy.context.scene, depsgraph)


@NO_FIXTURE_CHECK
@given(
    fit=st.sampled_from(["AUTO", "HORIZONTAL", "VERTICAL"]),
    lens=st.floats(12, 120),
    sensor=st.tuples(st.floats(8, 40), st.floats(8, 40)),
    shift=st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4)),
    size=st.tuples(st.integers(40, 900), st.integers(40, 900)),
    percentage=st.sampled_from([25, 50, 100, 150]),
    aspect=st.tuples(st.floats(1, 2), st.floats(1, 2)),
)
def test_camera_projects_like_blender(fit, lens, sensor, shift, size, percentage, aspect) -> None:
    scene, obj = bpy.context.scene, add_camera()
    data = obj.data
    data.sensor_fit, data.lens = fit, lens
    data.sensor_width, data.sensor_height = sensor
    data.shift_x, data.shift_y = shift
    render = scene.render
    render.resolution_x, render.resolution_y = size
    render.resolution_percentage = percentage
    render.pixel_aspect_x, render.pixel_aspect_y = aspect
    obj.location, obj.rotation_euler, obj.scale = (1, -4, 2), (1.1, 0.2, 0.3), (2, 2, 2)
    camera = read(obj)
    for point in ((0, 0, 0), (0.3, -0.2, 0.4), (-0.5, 0.8, 0.1)):
        u, v, _ = world_to_camera_view(scene, obj, Vector(point))
        if percentage == 100:  # world_to_camera_view ignores the percentage's rounding to whole pixels
            expected = (u * camera.width, (1 - v) * camera.height)
            assert camera.project(np.array(point, float))[0] == pytest.approx(expected, abs=0.02 * max(size) / 100)
    bpy.data.objects.remove(obj)


@pytest.mark.parametrize("kind", ["ORTHO", "PANO"])
def test_cameras_without_perspective_are_refused_by_name(kind: str) -> None:
    obj = add_camera("fish")
    obj.data.type = kind
    with pytest.raises(BadInput, match="fish is"):
        read(obj)


def test_the_same_camera_from_a_file_and_through_blender(tmp_path: Path) -> None:
    write_transforms(tmp_path / "t.json", cameras())
    frame = Matrix.LocRotScale(Vector((1, 2, 3)), Euler((0.3, 0.5, -1.0)), Vector((2.5, 2.5, 2.5)))
    for camera in read_cameras(tmp_path / "t.json"):
        obj = bridge.camera_to_blender(camera, frame)
        bpy.context.scene.collection.objects.link(obj)
        back = read(obj, np.array(frame))
        assert np.allclose(back.K, camera.K, rtol=1e-12) and back.id == camera.id
        assert np.abs(back.viewmat - camera.viewmat).max() < 2e-5  # Blender's matrices are float32
        pictures = [render_bytes(scene(), c).astype(int) for c in (camera, back)]
        assert np.abs(pictures[0] - pictures[1]).max() <= 1
        del obj[bridge.CAMERA]  # and what Blender itself frames is the same picture
        render = bpy.context.scene.render
        render.resolution_x, render.resolution_y, render.resolution_percentage = (
            camera.width,
            camera.height,
            100,
        )
        assert np.allclose(read(obj, np.array(frame)).K, camera.K, rtol=1e-5)


@NO_FIXTURE_CHECK
@given(
    angles=st.tuples(*[st.floats(-3, 3)] * 3),
    scale=st.tuples(*[st.floats(0.2, 3)] * 3),
    place=st.tuples(*[st.floats(-5, 5)] * 3),
    splat=st.tuples(st.floats(-3, 3), st.floats(0.2, 4)),
)
def test_a_cube_is_the_same_points_in_the_splats_frame(angles, scale, place, splat) -> None:
    mesh = bpy.data.meshes.new("cube")
    mesh.from_pydata([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], [], [])
    cube = bpy.data.objects.new("cube", mesh)
    bpy.context.scene.collection.objects.link(cube)
    cube.matrix_world = Matrix.LocRotScale(Vector(place), Euler(angles), Vector(scale))
    frame = np.array(Matrix.LocRotScale(Vector((1, 0, 2)), Euler((splat[0], 0.2, 1)), Vector((splat[1],) * 3)))
    bpy.context.view_layer.update()
    box = bridge.box_from_blender(cube, frame)
    points = np.random.default_rng(0).uniform(-9, 9, (500, 3))
    local = np.c_[points, np.ones(500)] @ np.linalg.inv(np.linalg.inv(frame) @ np.array(cube.matrix_world)).T
    margin = np.abs(np.abs(local[:, :3]).max(1) - 1) > 1e-4
    assert (box.contains(points) == (np.abs(local[:, :3]) <= 1).all(1))[margin].all()
    bpy.data.objects.remove(cube)


def test_a_parented_cube_follows_its_parent() -> None:
    mesh = bpy.data.meshes.new("cube")
    mesh.from_pydata([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], [], [])
    cube, parent = bpy.data.objects.new("cube", mesh), bpy.data.objects.new("parent", None)
    for obj in (cube, parent):
        bpy.context.scene.collection.objects.link(obj)
    cube.parent, parent.location, parent.scale = parent, (1, 2, 3), (2, 2, 2)
    bpy.context.view_layer.update()
    box = bridge.box_from_blender(cube, np.eye(4))
    expected = Box.make([1, 2, 3], [4, 4, 4])
    assert np.allclose(box.center, expected.center) and np.allclose(box.size, expected.size)
    parent.scale, cube.rotation_euler = (1, 3, 1), (0, 0, math.pi / 4)
    bpy.context.view_layer.update()
    with pytest.raises(BadInput, match="sheared"):
        bridge.box_from_blender(cube, np.eye(4))


@pytest.mark.parametrize("scale", [(1, 2, 1), (-1, 1, 1), (1, 1, 0)])
def test_uneven_or_mirrored_splat_objects_are_refused(scale: tuple[float, float, float]) -> None:
    obj = bpy.data.objects.new("splat", None)
    bpy.context.scene.collection.objects.link(obj)
    obj.scale = scale
    bpy.context.view_layer.update()
    with pytest.raises(BadInput, match="splat is"):
        bridge.splat_frame(obj)


def test_frames_of_an_animated_camera_are_views() -> None:
    obj = add_camera("moving")
    scene = bpy.context.scene
    scene.camera, scene.gimp3d.views = obj, "ANIMATED"
    scene.frame_start, scene.frame_end, scene.frame_step = 1, 9, 4
    for frame, x in ((1, 0.0), (9, 8.0)):
        obj.location.x = x
        obj.keyframe_insert("location", frame=frame)
    scene.frame_set(3)
    found = [c for c, _ in bridge.views_of(bpy.context, np.eye(4))]
    assert [c.id for c in found] == ["moving/0001", "moving/0005", "moving/0009"]
    assert found[0].centre[0] == pytest.approx(0, abs=1e-5) and found[2].centre[0] == pytest.approx(8, abs=1e-5)
    assert scene.frame_current == 3


def test_imported_cameras_remember_their_photo(tmp_path: Path) -> None:
    views = cameras(2)
    write_transforms(tmp_path / "t.json", views)
    (tmp_path / "orbit").mkdir()
    (tmp_path / "orbit" / "000.png").write_bytes(b"photo")
    loaded = read_cameras(tmp_path / "t.json")
    stored = [json.loads(bridge.camera_to_blender(c, Matrix.Identity(4))[bridge.CAMERA]) for c in loaded]
    assert stored[0]["image"] == str((tmp_path / "orbit" / "000.png").resolve()) and stored[1]["image"] is None

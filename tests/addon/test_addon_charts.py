"""Charts in Blender: cameras that face the hidden surface, in the scene's own place, and never views."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Euler, Matrix, Vector
from scenes import cameras, scene

from gimp3d.io.cameras import read_cameras
from gimp3d.io.images import read_image, write_png
from gimp3d.pipeline import render_bytes
from gimp3d_addon import bridge, charts, steps


def chart_cameras() -> list[bpy.types.Object]:
    return charts.of_scene(bpy.context.scene)


def test_a_preview_shows_charts_as_cameras_with_their_pictures(splat: bpy.types.Object) -> None:
    bpy.ops.gimp3d.preview_masks()
    (chart,) = chart_cameras()
    assert chart.name == "chart:1" and chart.users_collection[0].name == "3D-GIMP charts"
    assert chart.data.type == "PERSP" and (chart.matrix_world.to_quaternion() @ Vector((0, 0, -1))).z < -0.99  # a floor
    (behind,) = chart.data.background_images
    assert behind.image.name == "3D-GIMP chart 1" and behind.display_depth == "BACK"
    assert tuple(behind.image.size) == bridge.own_size(chart, bpy.context.scene)
    bpy.ops.gimp3d.look_through(camera="chart:1")
    render = bpy.context.scene.render
    assert (render.resolution_x, render.resolution_y) == tuple(behind.image.size)
    assert chart.data.clip_end > chart.location.length


def test_a_chart_is_no_view(splat: bpy.types.Object) -> None:
    settings = bpy.context.scene.gimp3d
    settings.views = "ALL"
    views = steps.views_step(bpy.context).facts
    bpy.ops.gimp3d.preview_masks()
    (chart,) = chart_cameras()
    assert steps.views_step(bpy.context).facts == views
    for reference in (None, chart):
        settings.reference = reference
        assert chart not in [obj for _, obj in bridge.views_of(bpy.context, np.eye(4))]
    bpy.context.scene.camera = chart
    bpy.ops.gimp3d.preview_masks()  # of a view
    assert (
        settings.hole.endswith("in orbit/000") and settings.reference == bpy.context.scene.camera == chart_cameras()[0]
    )
    settings.views = "ANIMATED"
    assert "No view" in steps.views_step(bpy.context).missing


def test_charts_lie_in_the_splats_frame_and_are_replaced_by_the_removals(splat: bpy.types.Object) -> None:
    bpy.ops.gimp3d.preview_masks()
    count = len(bpy.data.cameras)
    moved = Matrix.LocRotScale(Vector((3, -2, 1)), Euler((0.7, -0.4, 1.9)), Vector((1.7, 1.7, 1.7)))
    for obj in [o for o in bpy.context.scene.objects if o.parent is None]:
        obj.matrix_world = moved @ obj.matrix_world
    bpy.context.scene.gimp3d.reference = chart_cameras()[0]
    bpy.ops.gimp3d.remove_object()
    (chart,) = chart_cameras()
    assert bpy.context.scene.gimp3d.reference == chart and chart.name == "chart:1"
    assert len(bpy.data.cameras) == count
    made = Path(bpy.context.scene.gimp3d.last_job) / "report" / "charts"
    (camera,) = read_cameras(made / "transforms.json")
    point = np.array([0.1, -0.05, 0.0])
    (u, v), _ = camera.project(point)
    bpy.context.view_layer.update()
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y = camera.width, camera.height
    seen = world_to_camera_view(bpy.context.scene, chart, moved @ Vector(point))
    np.testing.assert_allclose([seen.x * camera.width, (1 - seen.y) * camera.height], [u, v], atol=0.05)
    pixels = np.array(chart[charts.PICTURE].pixels).reshape(camera.height, camera.width, 4)[::-1, :, :3]
    assert np.abs(pixels * 255 - read_image(made / "1.png")).max() < 1


def test_a_preview_has_the_removals_charts(splat: bpy.types.Object, tmp_path: Path) -> None:
    """Of the photos, which here show the floor under the splats with more contrast."""
    for camera in cameras():
        photo = 1.2 * render_bytes(scene(), camera).astype(float) - 25
        write_png(tmp_path / f"{camera.id}.png", np.clip(photo, 0, 255).astype(np.uint8))
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "transforms.json"))
    bpy.ops.gimp3d.look_through(step=3)
    bpy.ops.gimp3d.preview_masks()
    before = charts.save(chart_cameras()[0], tmp_path)
    pictures = [read_image(p) for p in before]
    bpy.ops.gimp3d.remove_object()
    made = Path(bpy.context.scene.gimp3d.last_job) / "report" / "charts"
    hole = read_image(made / "1.hole.png")
    np.testing.assert_array_equal(pictures[1], hole)
    np.testing.assert_array_equal(pictures[0][hole == 0], read_image(made / "1.png")[hole == 0])


def test_a_chart_whose_picture_was_deleted_is_one_line(splat: bpy.types.Object, tmp_path: Path) -> None:
    bpy.ops.gimp3d.preview_masks()
    bpy.ops.gimp3d.choose_reference(camera="chart:1")
    bpy.data.images.remove(bpy.data.images["3D-GIMP chart 1"])
    with pytest.raises(RuntimeError, match=r"gimp3d: error: .*Preview Mask makes it anew"):
        bpy.ops.gimp3d.export_reference(filepath=str(tmp_path / "chart.png"))
    assert not (tmp_path / "chart.png").exists()


def test_charts_that_are_no_longer_found_go(splat: bpy.types.Object) -> None:
    bpy.ops.gimp3d.preview_masks()
    assert chart_cameras()
    bpy.context.scene.gimp3d.preset = "paper"
    bpy.ops.gimp3d.preview_masks()
    assert not chart_cameras()

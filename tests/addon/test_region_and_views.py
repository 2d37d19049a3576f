"""Boxes fitted to the cursor, the selection and the view; views looked through; previews over them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix, Vector
from scenes import BLOCK, REGION, cameras, scene

from gimp3d.box import Box, in_region
from gimp3d.gaussians import Gaussians
from gimp3d.io.cameras import write_transforms
from gimp3d.io.images import write_png
from gimp3d_addon import bridge, steps
from gimp3d_addon.chosen import current_boxes
from gimp3d_addon.operators.base import select_only

FRAME = Matrix.LocRotScale(Vector((3, -2, 1)), Euler((0.7, -0.4, 1.9)), Vector((1.7, 1.7, 1.7)))


@pytest.fixture
def splat(import_scene: Callable[[Gaussians], bpy.types.Object], tmp_path: Path) -> bpy.types.Object:
    write_transforms(tmp_path / "transforms.json", cameras())
    return import_scene(scene())


def block_rows() -> np.ndarray:
    return (scene().means[:, 2] > 0.01) & (np.abs(scene().means[:, :2]) < BLOCK).all(1)


def region_of(splat: bpy.types.Object) -> list:
    bpy.context.view_layer.update()
    frame = bridge.splat_frame(splat)
    return [bridge.box_from_blender(b, frame) for b in current_boxes(bpy.context)]


def test_a_box_at_the_cursor(splat: bpy.types.Object) -> None:
    bpy.context.scene.cursor.location = (0.1, 0.2, 0.3)
    bpy.ops.gimp3d.add_roi(size=0.4)
    (box,) = region_of(splat)
    np.testing.assert_allclose(box.center, (0.1, 0.2, 0.3), atol=1e-6)
    np.testing.assert_allclose(box.size, 0.4, atol=1e-6)


@pytest.mark.parametrize("frame", [Matrix.Identity(4), FRAME])
def test_a_box_round_the_splats_selected_in_edit_mode(splat: bpy.types.Object, frame: Matrix) -> None:
    splat.matrix_world = frame
    rows = block_rows()
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="DESELECT")
    bpy.ops.object.mode_set(mode="OBJECT")
    splat.data.vertices.foreach_set("select", rows)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.gimp3d.add_roi(fit="SELECTION")
    assert bpy.context.mode == "OBJECT" and bpy.context.object == current_boxes(bpy.context)[0]
    (box,) = region_of(splat)
    assert box.contains(scene().means)[rows].all()
    extent = np.ptp(scene().means[rows], axis=0)
    np.testing.assert_allclose(box.size, 1.05 * extent, rtol=1e-3)


def test_a_box_round_selected_objects(splat: bpy.types.Object) -> None:
    for x in (-1.0, 2.0):
        empty = bpy.data.objects.new("marker", bpy.data.meshes.new("marker"))
        empty.data.from_pydata([(x, 0, 0), (x, 1, 1)], [], [])
        bpy.context.scene.collection.objects.link(empty)
        select_only(bpy.context, empty)
        empty.name = f"marker {x}"
    for obj in bpy.context.scene.objects:
        obj.select_set(True)
    bpy.ops.gimp3d.add_roi(fit="SELECTION")
    box = region_of(splat)[0]
    np.testing.assert_allclose(box.center, (0.5, 0.5, 0.5), atol=1e-6)
    np.testing.assert_allclose(box.size, (3.15, 1.05, 1.05), atol=1e-5)


def test_nothing_selected_is_said(splat: bpy.types.Object) -> None:
    bpy.ops.object.select_all(action="DESELECT")
    with pytest.raises(RuntimeError, match="nothing is selected"):
        bpy.ops.gimp3d.add_roi(fit="SELECTION")


@pytest.mark.parametrize("frame", [Matrix.Identity(4), FRAME])
def test_a_box_in_the_view_lies_on_what_the_camera_looks_at(splat: bpy.types.Object, frame: Matrix, tmp_path) -> None:
    splat.matrix_world = frame
    bpy.context.view_layer.update()
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "transforms.json"))
    bpy.ops.gimp3d.add_roi(fit="VIEW")
    region = region_of(splat)
    inside = in_region(region, scene().means)
    assert inside[block_rows()].mean() > 0.3
    assert np.linalg.norm(region[0].center - REGION[0].center) < BLOCK
    bpy.context.scene.camera.rotation_euler = (3.1, 0, 0)  # up into the sky
    with pytest.raises(RuntimeError, match="no splats in the middle"):
        bpy.ops.gimp3d.add_roi(fit="VIEW")


def test_several_boxes_count_together_and_are_forgotten_one_by_one(splat: bpy.types.Object) -> None:
    for x in (-1.0, 1.0):
        bpy.context.scene.cursor.location = (x, 0, 0)
        bpy.ops.gimp3d.add_roi(size=0.5)
    both = steps.splats_inside(splat, current_boxes(bpy.context))
    bpy.ops.gimp3d.forget_roi(index=0)
    one = steps.splats_inside(splat, current_boxes(bpy.context))
    assert both > one > 0 and len(bpy.data.objects) == 3
    bpy.ops.object.select_all(action="SELECT")
    bpy.ops.gimp3d.use_selected()
    assert steps.splats_inside(splat, current_boxes(bpy.context)) == both


@pytest.mark.parametrize(("up", "above"), [("FLOOR", (0, 0, 1)), ("Z", (0, -1, 0))])
def test_an_orbit_stands_round_the_floor_or_round_z(splat: bpy.types.Object, up: str, above: tuple) -> None:
    """The scene lies on its side: its floor's normal, the file's z, is not Blender's."""
    splat.matrix_world = Matrix.Rotation(np.radians(-90), 4, "X")
    bpy.context.view_layer.update()
    bpy.ops.gimp3d.add_roi()
    bpy.context.object.matrix_world = splat.matrix_world @ Matrix.LocRotScale(
        Vector(REGION[0].center), None, Vector(REGION[0].size)
    )
    bpy.ops.gimp3d.add_views(count=9, up=up)
    frame = bridge.splat_frame(splat)
    centres = [c.centre - REGION[0].center for c, _ in bridge.views_of(bpy.context, frame)]
    heights = np.array(centres) @ above / np.linalg.norm(centres, axis=1)
    np.testing.assert_allclose(np.sort(heights), np.sort(np.sin(np.radians([15, 35, 60] * 3))), atol=0.02)


def test_looking_through_the_views_one_after_the_other(splat: bpy.types.Object, tmp_path: Path) -> None:
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "transforms.json"))
    blender_scene = bpy.context.scene
    seen = []
    for _ in range(10):
        seen.append(blender_scene.camera.name)
        bpy.ops.gimp3d.look_through(step=1)
    assert seen[:9] == [f"orbit/{k:03d}" for k in range(9)] and seen[9] == seen[0]
    bpy.ops.gimp3d.look_through(camera="orbit/004")
    assert blender_scene.camera.name == "orbit/004"
    assert (blender_scene.render.resolution_x, blender_scene.render.resolution_y) == (120, 90)
    with pytest.raises(RuntimeError, match="no view is called"):
        bpy.ops.gimp3d.look_through(camera="elsewhere")


def test_photos_stand_behind_their_cameras(splat: bpy.types.Object, tmp_path: Path) -> None:
    write_png(tmp_path / "orbit" / "003.png", np.full((90, 120, 3), 77, np.uint8))
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "transforms.json"))
    with_photo = [o for o in bpy.data.objects if o.type == "CAMERA" and o.data.background_images]
    assert [o.name for o in with_photo] == ["orbit/003"]
    slot = with_photo[0].data.background_images[0]
    assert slot.display_depth == "BACK" and slot.image.filepath.endswith("003.png")
    assert with_photo[0].data.show_background_images


def test_previews_lie_over_the_camera_one_at_a_time(splat: bpy.types.Object, tmp_path: Path) -> None:
    write_png(tmp_path / "orbit" / "000.png", np.full((90, 120, 3), 77, np.uint8))
    bpy.ops.gimp3d.add_roi()
    bpy.context.object.location, bpy.context.object.scale = REGION[0].center, REGION[0].size
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "transforms.json"))
    slots = bpy.context.scene.camera.data.background_images
    for _ in range(2):
        bpy.ops.gimp3d.render_view()
        assert [s.image.name for s in slots] == ["000.png", "3D-GIMP view"]
        bpy.ops.gimp3d.preview_masks()
        assert [s.image.name for s in slots] == ["000.png", "3D-GIMP hole"]
    assert bpy.context.scene.gimp3d.hole.endswith("pixels in orbit/000")
    made = {i.name for i in bpy.data.images if i.name.startswith("3D-GIMP")}
    assert made == {f"3D-GIMP {title}" for title in ("view", "mask", "hole", "surface", "chart 1", "chart 1 hole")}
    bpy.ops.gimp3d.hide_previews()
    assert [s.image.name for s in slots] == ["000.png"]


def test_a_proposed_box_is_taken_with_one_button(splat: bpy.types.Object) -> None:
    splat.matrix_world = FRAME
    bpy.ops.gimp3d.add_roi()
    cube, settings = bpy.context.object, bpy.context.scene.gimp3d
    with pytest.raises(RuntimeError, match="no box is proposed"):
        bpy.ops.gimp3d.enlarge_roi()
    wanted = Box.make([0.1, 0, 0.3], [0.9, 0.62, 0.7], [0.9, 0.1, 0.2, 0.3])
    settings.proposed = json.dumps({"gaussians": 7, "box": wanted.to_json()})
    assert bpy.ops.gimp3d.enlarge_roi() == {"FINISHED"} and settings.proposed == ""
    bpy.context.view_layer.update()
    box = bridge.box_from_blender(cube, bridge.splat_frame(splat))
    assert np.allclose(box.corners(), wanted.corners(), atol=1e-4)

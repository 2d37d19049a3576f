"""What users do between import and Remove, and what must not go wrong with it."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector
from scenes import cameras

from gimp3d.cli import main
from gimp3d.errors import Gimp3dError
from gimp3d.gaussians import Gaussians
from gimp3d.io.cameras import read_cameras, write_transforms
from gimp3d.io.images import write_png
from gimp3d_addon import bridge, command, jobs
from gimp3d_addon.chosen import current_boxes, current_splat
from gimp3d_addon.operators.remove import SOURCE
from gimp3d_addon.worker import Worker

SIZE = (120, 90)


def select(obj: bpy.types.Object) -> None:
    bpy.ops.object.select_all(action="DESELECT")
    obj.select_set(True)
    bpy.context.view_layer.objects.active = obj


def delete(obj: bpy.types.Object) -> None:
    select(obj)
    bpy.ops.object.delete()


def view_ids() -> list[str]:
    return [c.id for c, _ in bridge.views_of(bpy.context, np.eye(4))]


def test_what_the_user_deleted_no_longer_counts(splat: bpy.types.Object) -> None:
    bpy.ops.gimp3d.choose_reference(camera="orbit/001")
    delete(bpy.data.objects["orbit/001"])
    assert "orbit/001" not in view_ids() and len(view_ids()) == 8
    delete(current_boxes(bpy.context)[0])
    assert current_boxes(bpy.context) == []
    delete(splat)
    assert current_splat(bpy.context) is None


def test_restore_is_offered_only_where_something_was_removed(splat: bpy.types.Object) -> None:
    assert not bpy.ops.gimp3d.restore.poll()
    bpy.ops.gimp3d.remove_object()
    splat.name = "renamed by the user"
    assert current_splat(bpy.context)[SOURCE] == splat and bpy.ops.gimp3d.restore.poll()
    bpy.ops.gimp3d.restore()
    assert current_splat(bpy.context) == splat and not bpy.ops.gimp3d.restore.poll()


def test_removals_are_restored_one_after_the_other(splat: bpy.types.Object) -> None:
    bpy.ops.gimp3d.remove_object()
    first = current_splat(bpy.context)
    bpy.ops.gimp3d.remove_object()
    bpy.ops.gimp3d.restore()
    assert current_splat(bpy.context) == first and splat.hide_get()
    bpy.ops.gimp3d.restore()
    assert current_splat(bpy.context) == splat and not splat.hide_get()


def test_cameras_imported_twice_are_different_views(splat: bpy.types.Object, tmp_path: Path) -> None:
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "transforms.json"))
    bpy.context.scene.gimp3d.views = "ALL"
    assert len(view_ids()) == len(set(view_ids())) == 18
    assert bpy.ops.gimp3d.remove_object() == {"FINISHED"}


def test_any_camera_name_makes_an_id_that_the_command_line_takes(splat: bpy.types.Object, tmp_path: Path) -> None:
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y = SIZE
    names = ["Camera", "Camera.001", "A: front/left", "..", "Kamera ö", "a.b", "a_b", ".", "x\\y"]
    for obj, name in zip(sorted(bpy.data.cameras, key=lambda c: c.name), names):
        owner = next(o for o in bpy.data.objects if o.data == obj)
        owner.name = name
        del owner[bridge.CAMERA]
    views = [c for c, _ in bridge.views_of(bpy.context, np.eye(4))]
    write_transforms(tmp_path / "ids.json", views)
    assert [c.id for c in read_cameras(tmp_path / "ids.json")] == [c.id for c in views]
    out = tmp_path / "out"
    arguments = ["render", tmp_path / "scene.ply", "--cameras", tmp_path / "ids.json", "--out", out]
    assert main([*map(str, arguments), "--progress", "none"]) == 0
    assert len(list(out.rglob("*.png"))) == len(names)  # none has overwritten another


def test_an_applied_transform_is_refused_as_boxes_would_miss(splat: bpy.types.Object) -> None:
    splat.rotation_euler = (1, 0, 0)
    select(splat)
    bpy.ops.object.transform_apply()
    with pytest.raises(RuntimeError, match="a transform was applied"):
        bpy.ops.gimp3d.remove_object()


def test_a_scene_in_an_excluded_collection_can_be_used(splat: bpy.types.Object) -> None:
    collection = bpy.data.collections.new("put away")
    bpy.context.scene.collection.children.link(collection)
    collection.objects.link(splat)
    bpy.context.scene.collection.objects.unlink(splat)
    bpy.context.view_layer.layer_collection.children["put away"].exclude = True
    assert bpy.ops.gimp3d.remove_object() == {"FINISHED"}
    assert splat.hide_render


def test_files_in_the_way_are_one_line(splat: bpy.types.Object, tmp_path: Path) -> None:
    (tmp_path / "gimp3d_jobs").write_text("a file, not a folder")
    with pytest.raises(RuntimeError, match=r"gimp3d: error: .*gimp3d_jobs") as caught:
        bpy.ops.gimp3d.remove_object()
    assert "Traceback" not in str(caught.value)


def test_previews_leave_no_folder_behind(splat: bpy.types.Object, tmp_path: Path) -> None:
    bpy.ops.gimp3d.render_view()
    bpy.ops.gimp3d.preview_masks()
    assert not (tmp_path / "gimp3d_jobs").exists()
    assert bpy.data.images["3D-GIMP view"].packed_file and bpy.data.images["3D-GIMP mask"].packed_file


def test_a_job_folder_runs_again_from_another_place(splat: bpy.types.Object, tmp_path: Path) -> None:
    bpy.ops.gimp3d.remove_object()
    (folder,) = (tmp_path / "gimp3d_jobs").iterdir()
    moved = folder.rename(tmp_path / "moved")
    before = (moved / "out.ply").read_bytes()
    (moved / "out.ply").unlink()
    assert main(["remove", "--job", str(moved), "--progress", "none"]) == 0
    assert (moved / "out.ply").read_bytes() == before


def test_a_reference_beside_an_animated_camera_is_a_view_too(splat: bpy.types.Object) -> None:
    camera_scene = bpy.context.scene
    moving = bpy.data.objects.new("moving", bpy.data.cameras.new("moving"))
    camera_scene.collection.objects.link(moving)
    camera_scene.camera, camera_scene.gimp3d.views = moving, "ANIMATED"
    camera_scene.frame_start, camera_scene.frame_end = 1, 3
    bpy.ops.gimp3d.choose_reference(camera="orbit/004")
    assert view_ids() == ["moving/0001", "moving/0002", "moving/0003", "orbit/004"]


def test_json_that_is_no_progress_line_is_passed_over() -> None:
    worker = Worker(["--version"])
    for line in ("5", '"text"', "[1]", "{}", "words"):
        worker._take(line)
    assert worker.wait() == {}


@pytest.mark.parametrize("fit", ["AUTO", "HORIZONTAL", "VERTICAL"])
@pytest.mark.parametrize("size", [(640, 360), (360, 640)])
@pytest.mark.parametrize("aspect", [(1, 1), (1, 1.5), (2, 1)])
def test_a_camera_is_exact_to_a_thousandth_pixel(fit: str, size: tuple[int, int], aspect: tuple[float, float]) -> None:
    """Against Blender's own mapping and against the lens formula, at a percentage that divides the size."""
    camera_scene, data = bpy.context.scene, bpy.data.cameras.new("c")
    obj = bpy.data.objects.new("c", data)
    camera_scene.collection.objects.link(obj)
    data.sensor_fit, data.lens, data.sensor_width, data.sensor_height = fit, 31.0, 30.0, 20.0
    data.shift_x, data.shift_y = 0.21, -0.13
    render = camera_scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = *size, 50
    render.pixel_aspect_x, render.pixel_aspect_y = aspect
    obj.location, obj.rotation_euler = (1, -4, 2), (1.1, 0.2, 0.3)
    bpy.context.view_layer.update()
    camera = bridge.camera_from_blender(obj, np.eye(4), camera_scene, bpy.context.evaluated_depsgraph_get())

    wide, high = size[0] * aspect[0], size[1] * aspect[1]  # in square pixels, as Blender fits the sensor
    along_width = fit == "HORIZONTAL" or (fit == "AUTO" and wide >= high)
    sensor = 20.0 if fit == "VERTICAL" else 30.0
    focal = 31.0 / sensor * (wide if along_width else high)  # in square pixels
    assert (camera.width, camera.height) == (size[0] // 2, size[1] // 2)
    assert camera.fx == pytest.approx(focal / aspect[0] / 2, rel=1e-6)
    assert camera.fy == pytest.approx(focal / aspect[1] / 2, rel=1e-6)
    for point in ((0, 0, 0), (0.3, -0.2, 0.4), (-0.5, 0.8, 0.1)):
        u, v, depth = world_to_camera_view(camera_scene, obj, Vector(point))
        pixel, z = camera.project(np.array(point, float))
        assert pixel == pytest.approx((u * camera.width, (1 - v) * camera.height), abs=1e-3)
        assert z == pytest.approx(depth, rel=1e-5)


def test_photos_go_with_the_job_and_imported_sizes_win(splat: bpy.types.Object, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    write_png(photos / "orbit" / "000.png", np.full((SIZE[1], SIZE[0], 3), 77, np.uint8))
    bpy.context.scene.render.resolution_x = 33
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "transforms.json"), images=str(photos))
    job = jobs.write_job(bpy.context, tmp_path / "job")
    views = read_cameras(tmp_path / "job" / "transforms.json", Path(job.images))
    assert Path(job.images).name == "photos" and {(c.width, c.height) for c in views} == {SIZE}
    assert [c.id for c in views if c.image.exists()] == ["orbit/000"]
    assert views[0].image.read_bytes() == (photos / "orbit" / "000.png").read_bytes()


def test_a_camera_that_was_moved_leaves_its_photo_behind(splat: bpy.types.Object, tmp_path: Path) -> None:
    write_png(tmp_path / "orbit" / "000.png", np.full((SIZE[1], SIZE[0], 3), 77, np.uint8))
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "transforms.json"))
    obj = bpy.context.scene.gimp3d.view_collection.objects["orbit/000.001"]

    def photo() -> Path | None:
        bpy.context.view_layer.update()
        return next(c for c, o in bridge.views_of(bpy.context, bridge.splat_frame(splat)) if o == obj).image

    assert photo() == tmp_path / "orbit" / "000.png"
    obj.location.x += 0.01
    assert photo() is None and jobs.write_job(bpy.context, tmp_path / "job").images == "none"
    obj.location.x -= 0.01
    assert photo() is not None
    splat.location.x = 1  # the cameras stay where they are, so they look elsewhere in the scene now
    assert photo() is None


def test_the_split_goes_through_blender(splat: bpy.types.Object, tmp_path: Path) -> None:
    views = [replace(c, split="test" if k % 2 else "train") for k, c in enumerate(cameras())]
    write_transforms(tmp_path / "split.json", views)
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "split.json"), split="all")
    assert [c.split for c, _ in bridge.views_of(bpy.context, np.eye(4))] == [c.split for c in views]


def test_a_box_can_be_added_to_an_empty_scene(few_gaussians: Gaussians, import_scene) -> None:
    import_scene(few_gaussians.take(np.arange(0)))
    assert bpy.ops.gimp3d.add_roi() == {"FINISHED"} and bpy.context.object.scale.x == 1


def test_a_python_without_the_libraries_is_named(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "bare")], check=True)
    python = tmp_path / "bare" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    with pytest.raises(Gimp3dError, match=r"bare.* has no numpy, scipy, numba, cv2; .*preferences"):
        Worker(["info", "scene.ply"], str(python)).wait()


def test_a_module_beside_the_file_is_not_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "numpy.py").write_text("raise SystemExit('a user's own file')")
    monkeypatch.chdir(tmp_path)
    assert Worker(["--version"]).wait() == {}


def test_blenders_command_gives_the_exit_codes(capfd: pytest.CaptureFixture[str]) -> None:
    assert command._run(["--version"]) == 0
    assert command._run(["info", "nowhere.ply"]) == 2
    assert capfd.readouterr().err.startswith("gimp3d: error: ")

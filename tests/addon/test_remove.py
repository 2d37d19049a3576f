"""The whole way in Blender: import, cube, cameras, Remove, export, restore."""

from __future__ import annotations

import json
import time
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix, Vector
from scenes import REGION, cameras, scene

from gimp3d.cli import main
from gimp3d.errors import Gimp3dError
from gimp3d.io.cameras import write_transforms
from gimp3d.io.ply import read_ply, write_gaussians
from gimp3d.pipeline import render_bytes
from gimp3d_addon import jobs, splats
from gimp3d_addon.operators import remove
from gimp3d_addon.worker import Worker


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_gaussians(tmp_path / "scene.ply", scene())
    write_transforms(tmp_path / "transforms.json", cameras())
    (tmp_path / "roi.json").write_text(json.dumps(REGION[0].to_json()))
    return tmp_path


def prepare(folder: Path, frame: Matrix | None = None) -> bpy.types.Object:
    """The block scene in Blender with its box and cameras, moved by `frame`."""
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "work.blend"), check_existing=False)
    bpy.ops.gimp3d.import_ply(filepath=str(folder / "scene.ply"))
    splat = bpy.context.object
    frame = frame or Matrix.Identity(4)
    splat.matrix_world = frame
    bpy.context.view_layer.update()
    bpy.ops.gimp3d.add_roi()
    box = bpy.context.object
    box.matrix_world = frame @ Matrix.LocRotScale(Vector(REGION[0].center), None, Vector(REGION[0].size))
    bpy.ops.gimp3d.import_cameras(filepath=str(folder / "transforms.json"))
    return splat


@pytest.mark.parametrize("online", [False, True])
def test_pictures_leave_the_machine_only_where_blender_may_go_online(
    online: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remove, "bpy", SimpleNamespace(app=SimpleNamespace(online_access=online)))
    monkeypatch.setattr(remove, "Worker", lambda arguments, *_, **__: arguments)
    arguments = remove.RunsRemoval.run(
        SimpleNamespace(folder=tmp_path, providers=lambda _: ()), bpy.context, "--resume"
    )
    assert ("--allow-network" in arguments) == online and "--resume" in arguments


def test_remove_makes_a_new_object_hides_the_source_and_restores(folder: Path) -> None:
    splat = prepare(folder)
    assert bpy.ops.gimp3d.remove_object() == {"FINISHED"}
    result = bpy.context.scene.gimp3d.splat
    assert result.name == f"{splat.name} removed" and splat.hide_get() and splat.hide_render
    assert (np.array(result.matrix_world) == np.array(splat.matrix_world)).all()
    assert Path(bpy.context.scene.gimp3d.last_report).is_file()
    assert 0 < bpy.context.scene.gimp3d.score < 1 and bpy.context.scene.gimp3d.verdict
    assert (folder / "gimp3d_jobs").is_dir()
    bpy.ops.gimp3d.export_ply(filepath=str(folder / "out.ply"))
    rows = {r.tobytes() for r in read_ply(folder / "scene.ply").table.rows}
    after = read_ply(folder / "out.ply").table.rows
    assert 0 < sum(r.tobytes() in rows for r in after) < len(rows)
    assert bpy.ops.gimp3d.restore() == {"FINISHED"}
    assert not splat.hide_get() and not splat.hide_render
    assert [o.name for o in bpy.data.objects if splats.is_splat(o)] == [splat.name]
    assert bpy.context.scene.gimp3d.splat == splat and not splat.hide_get()


def shell(folder: Path, out: str) -> bytes:
    """What the command makes of the folder's own files."""
    given = [str(folder / name) for name in ("scene.ply", "transforms.json", "roi.json", out)]
    options = ["--cameras", given[1], "--roi", given[2], "--out", given[3], "--images", "none", "--progress", "none"]
    assert main(["remove", given[0], *options]) == 0
    return Path(given[3]).read_bytes()


@pytest.mark.parametrize(
    "up", [pytest.param(up, marks=[pytest.mark.slow] * (up != "Y_UP")) for up in (None, *splats.UP_AXES)], ids=str
)
def test_blender_and_the_shell_give_the_same_bytes(folder: Path, up: str | None) -> None:
    """From the same numbers, also where the object stands upright in Blender and not in its file."""
    write_transforms(folder / "transforms.json", cameras()[::-1])  # views keep the file's order
    prepare(folder, splats.UP_AXES[up] if up else None)
    bpy.ops.gimp3d.remove_object()
    bpy.ops.gimp3d.export_ply(filepath=str(folder / "blender.ply"))
    (job,) = (folder / "gimp3d_jobs").iterdir()
    told = {"center": REGION[0].center.tolist(), "size": REGION[0].size.tolist(), "rotation_wxyz": [1, 0, 0, 0]}
    assert json.loads((job / "roi.json").read_text()) == [told]
    assert (folder / "blender.ply").read_bytes() == shell(folder, "shell.ply")
    (job / "out.ply").unlink()
    assert not (job / "stages").exists()  # nothing to go on from, and most of the folder's size
    assert main(["remove", "--job", str(job), "--progress", "none"]) == 0
    assert (job / "out.ply").read_bytes() == (folder / "shell.ply").read_bytes()


def test_a_rotated_and_scaled_splat_object_gives_the_same_rows_and_pixels(folder: Path) -> None:
    """Telea fills: of patches that are nearly alike, rounding may make the exemplar choose another."""
    prepare(folder)
    bpy.context.scene.gimp3d.inpaint = "telea"
    bpy.ops.gimp3d.remove_object()
    bpy.ops.gimp3d.export_ply(filepath=str(folder / "straight.ply"))
    bpy.ops.wm.read_homefile(use_empty=True)
    prepare(folder, Matrix.LocRotScale(Vector((3, -2, 1)), Euler((0.7, -0.4, 1.9)), Vector((1.7, 1.7, 1.7))))
    bpy.context.scene.gimp3d.inpaint = "telea"
    bpy.ops.gimp3d.remove_object()
    bpy.ops.gimp3d.export_ply(filepath=str(folder / "turned.ply"))
    same_picture(folder / "straight.ply", folder / "turned.ply")


def same_picture(a: Path, b: Path) -> None:
    """The same kept rows, and pixels within 1/255: all but one in a thousand.

    Two splats at nearly the same depth may be drawn in either order, and a last bit decides which.
    """
    rows = {r.tobytes() for r in read_ply(a.parent / "scene.ply").table.rows}
    kept = [[r.tobytes() for r in read_ply(p).table.rows if r.tobytes() in rows] for p in (a, b)]
    assert kept[0] == kept[1]
    for camera in cameras(3):
        first, second = (render_bytes(read_ply(p).gaussians, camera).astype(int) for p in (a, b))
        assert (np.abs(first - second) > 1).any(2).mean() < 1e-3


def test_orbit_views_alone_are_enough(folder: Path) -> None:
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "work.blend"), check_existing=False)
    bpy.ops.gimp3d.import_ply(filepath=str(folder / "scene.ply"))
    bpy.ops.gimp3d.add_roi()
    box = bpy.context.object
    box.location, box.scale = REGION[0].center, REGION[0].size
    bpy.ops.gimp3d.add_views(count=6, width=120, height=90)
    assert len(bpy.context.scene.gimp3d.view_collection.objects) == 6
    assert bpy.ops.gimp3d.remove_object() == {"FINISHED"}


def test_pictures_of_a_view_the_mask_and_the_reference(folder: Path) -> None:
    prepare(folder)
    assert bpy.ops.gimp3d.render_view() == {"FINISHED"}
    assert bpy.data.images["3D-GIMP view"].size[:] == (120, 90)
    assert bpy.ops.gimp3d.choose_reference(camera="orbit/001") == {"FINISHED"}
    assert bpy.ops.gimp3d.preview_masks() == {"FINISHED"}
    pixels = np.array(bpy.data.images["3D-GIMP mask"].pixels).reshape(90, 120, 4)
    assert 0.005 < pixels[..., 0].mean() < 0.5
    for name in ("3D-GIMP hole", "3D-GIMP surface"):
        assert bpy.data.images[name].size[:] == (120, 90)
    assert "3D-GIMP depth prior" not in bpy.data.images
    assert bpy.ops.gimp3d.export_reference(filepath=str(folder / "ref.png")) == {"FINISHED"}
    assert (folder / "ref.mask.png").is_file()
    assert bpy.ops.gimp3d.load_reference(filepath=str(folder / "ref.png")) == {"FINISHED"}
    assert bpy.ops.gimp3d.remove_object() == {"FINISHED"}


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda s: setattr(s, "scale", (1, 2, 1)), "scaled unevenly"),
        (lambda s: setattr(bpy.context.scene.gimp3d, "inpaint", "magic"), "unknown provider"),
        (lambda s: setattr(bpy.context.scene.gimp3d, "view_collection", None), "collection"),
    ],
)
def test_errors_are_the_command_lines_own_line_and_change_nothing(folder: Path, spoil, words: str) -> None:
    splat = prepare(folder)
    spoil(splat)
    with pytest.raises(RuntimeError, match=f"gimp3d: error: .*{words}"):
        bpy.ops.gimp3d.remove_object()
    assert not splat.hide_get() and [o for o in bpy.data.objects if splats.is_splat(o)] == [splat]


def test_without_a_scene_the_operators_say_what_is_missing() -> None:
    for name in (
        "remove_object",
        "add_roi",
        "add_views",
        "export_ply",
        "restore",
        "render_view",
        "preview_masks",
    ):
        assert not getattr(bpy.ops.gimp3d, name).poll()


def test_a_cancelled_worker_ends_at_once(folder: Path) -> None:
    prepare(folder)
    job = folder / "job"
    jobs.write_job(bpy.context, job)
    worker = Worker(["remove", "--job", str(job), "--progress", "json"])
    start = time.perf_counter()
    while worker.status == "starting" and time.perf_counter() < start + 60:
        worker.poll()
    start = time.perf_counter()
    worker.cancel()
    assert time.perf_counter() - start < 1
    while not worker.poll():
        assert time.perf_counter() - start < 5
    with pytest.raises(Gimp3dError):
        worker.result()
    assert not (job / "out.ply").exists()


def test_a_killed_worker_says_so() -> None:
    worker = Worker(["info", "nowhere.ply"])
    with pytest.raises(Gimp3dError, match="cannot read"):
        worker.wait()

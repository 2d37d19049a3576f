"""Jobs belong to one file, scene and object, and to one process at a time; they take no more room than they need."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest
from scenes import REGION, cameras, scene
from test_stopping import Window, begun, masks_done, splat_objects

from gimp3d.errors import BadInput
from gimp3d.gaussians import Gaussians
from gimp3d.io.cameras import write_transforms
from gimp3d.io.ply import write_gaussians
from gimp3d_addon import jobs, lock, splats
from gimp3d_addon.chosen import current_splat
from gimp3d_addon.operators.base import RunsChild
from gimp3d_addon.worker import Worker


def stopped(splat: bpy.types.Object) -> Path:
    """A job as a run leaves it that was ended from outside."""
    folder = jobs.new_job_folder(splat.name)
    jobs.write_job(bpy.context, folder)
    jobs.open_for(bpy.context, folder, splat)
    return folder


def another_file(path: Path, folder: Path) -> bpy.types.Object:
    """Another .blend beside the first, with a scene and an object of the same names."""
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(path), check_existing=False)
    bpy.ops.gimp3d.import_ply(filepath=str(folder / "scene.ply"))
    return bpy.context.object


def test_a_job_is_not_offered_to_another_file_in_the_folder(splat: bpy.types.Object, tmp_path: Path) -> None:
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work.blend"), check_existing=False)
    folder = stopped(splat)
    other = another_file(tmp_path / "demo.blend", tmp_path)
    assert other.name == splat_name(tmp_path) and jobs.jobs_folder() == folder.parent
    assert jobs.unfinished(bpy.context) is None and jobs.of_file(bpy.context) == []
    bpy.context.scene.gimp3d.last_job = str(folder)
    assert jobs.unfinished(bpy.context) is None
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "work.blend"))
    assert jobs.unfinished(bpy.context) == folder


def splat_name(folder: Path) -> str:
    return (folder / "scene.ply").stem


def test_a_copy_of_the_file_is_another_file(splat: bpy.types.Object, tmp_path: Path) -> None:
    stopped(splat)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "copy.blend"), check_existing=False)
    assert jobs.unfinished(bpy.context) is None


def test_a_job_from_before_the_first_save_stays_with_its_scene(
    tmp_path: Path, import_scene: Callable[[Gaussians], bpy.types.Object]
) -> None:
    write_transforms(tmp_path / "transforms.json", cameras())
    splat = import_scene(scene())
    bpy.ops.gimp3d.add_roi()
    bpy.context.object.location, bpy.context.object.scale = REGION[0].center, REGION[0].size
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "transforms.json"))
    folder = stopped(splat)
    assert tmp_path not in folder.parents and jobs.unfinished(bpy.context) == folder
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "first.blend"), check_existing=False)
    assert jobs.unfinished(bpy.context) == folder
    another_file(tmp_path / "other.blend", tmp_path)
    assert jobs.unfinished(bpy.context) is None
    bpy.ops.wm.read_homefile(use_empty=True)
    assert jobs.unfinished(bpy.context) is None


def test_a_stopped_job_is_not_offered_once_a_later_one_has_ended(splat: bpy.types.Object) -> None:
    first, second = stopped(splat), stopped(splat)
    assert jobs.unfinished(bpy.context) == second and first != second
    jobs.close(second)
    assert jobs.unfinished(bpy.context) is None


def test_a_job_stays_with_its_scene_within_a_file(splat: bpy.types.Object) -> None:
    folder, first = stopped(splat), bpy.context.scene
    copy = first.copy()
    copy.name = "another"
    bpy.context.window.scene = copy
    assert jobs.unfinished(bpy.context) is None
    bpy.context.window.scene = first
    assert jobs.unfinished(bpy.context) == folder


def test_the_result_goes_to_its_object_whatever_the_names(splat: bpy.types.Object, tmp_path: Path) -> None:
    """Today's `scene` may be another one than the job's. While the child lives, the job is offered to nobody."""
    offered: list[Path | None] = []

    def half_way(running: RunsChild) -> bool:
        if masks_done(running):
            offered.append(jobs.unfinished(bpy.context))
        return bool(offered)

    assert Window().remove(half_way) == {"CANCELLED"} and offered == [None]
    splat.name = "renamed"
    bpy.ops.gimp3d.import_ply(filepath=str(tmp_path / "scene.ply"))
    impostor = bpy.context.object
    assert impostor.name == "scene" and impostor[splats.ID] != splat[splats.ID]
    assert bpy.ops.gimp3d.resume() == {"FINISHED"}
    result = current_splat(bpy.context)
    assert result["gimp3d_source"] == splat and splat.hide_get() and not impostor.hide_get()
    assert result.name == "renamed removed"


def test_a_copied_object_gets_an_id_of_its_own_when_it_needs_one(splat: bpy.types.Object) -> None:
    folder = stopped(splat)
    copy = splat.copy()
    bpy.context.scene.collection.objects.link(copy)
    assert copy[splats.ID] == splat[splats.ID]
    assert jobs.source_in(bpy.context.scene, jobs.record_of(folder)) == splat
    jobs.identify(bpy.context.scene, copy)
    assert copy[splats.ID] != splat[splats.ID]


HOLD = "import runpy, sys; held = runpy.run_path(sys.argv[1])['hold'](sys.argv[2]); print('held', flush=True); input()"


def test_a_job_that_another_process_works_on_is_not_offered_and_not_deleted(splat: bpy.types.Object) -> None:
    folder = stopped(splat)
    other = subprocess.Popen(
        [sys.executable, "-c", HOLD, lock.__file__, str(folder / jobs.LOCK)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert other.stdout.readline() == "held\n"
        assert jobs.unfinished(bpy.context) is None
        with pytest.raises(BadInput, match="at work"):
            jobs.delete(jobs.record_of(folder))
        worker = Worker(["--version"], lock=folder / jobs.LOCK)
        with pytest.raises(Exception, match="another process is at work"):
            worker.wait()
    finally:
        other.kill()  # as a crash would
        other.communicate()
    assert jobs.unfinished(bpy.context) == folder
    assert Worker(["--version"], lock=folder / jobs.LOCK).wait() == {}


def test_a_script_with_an_empty_box_is_cancelled_and_nothing_is_made(splat: bpy.types.Object, tmp_path: Path) -> None:
    bpy.context.scene.gimp3d.rois[0].object.location = (0, 0, 99)
    bpy.context.view_layer.update()
    before = list(bpy.data.objects)
    assert bpy.ops.gimp3d.remove_object() == {"CANCELLED"}
    assert list(bpy.data.objects) == before and not splat.hide_get() and not (tmp_path / "gimp3d_jobs").exists()


def test_the_panel_is_drawn_anew_after_escape_and_after_an_error(splat: bpy.types.Object) -> None:
    running: list[bool] = []
    region = SimpleNamespace(type="UI", tag_redraw=lambda: running.append(RunsChild.running is not None))
    for until, fill in ((begun, "exemplar"), (lambda _: False, "magic")):
        window = Window()
        window.window.screen.areas = (SimpleNamespace(regions=(region,)),)
        bpy.context.scene.gimp3d.inpaint = fill
        assert window.remove(until) == {"CANCELLED"}
        assert running.pop() is False  # after it stopped, not only while it ran
    assert splat_objects() == [splat]


def test_jobs_share_a_scene_that_is_the_same_to_the_byte(splat: bpy.types.Object) -> None:
    first, second = stopped(splat), None
    second = jobs.new_job_folder(splat.name)
    jobs.write_job(bpy.context, second)
    jobs.share_scene(second)
    jobs.open_for(bpy.context, second, splat)
    assert (first / "scene.ply").samefile(second / "scene.ply")
    known = jobs.of_file(bpy.context)
    assert jobs.size(known) < sum(jobs.size([r]) for r in known) - (first / "scene.ply").stat().st_size / 2
    splat.data.vertices[0].select = True
    third = jobs.new_job_folder(splat.name)
    jobs.write_job(bpy.context, third)
    with (third / "scene.ply").open("r+b") as file:
        file.seek(-1, os.SEEK_END)
        file.write(b"\x01")
    jobs.share_scene(third)
    assert not (third / "scene.ply").samefile(first / "scene.ply")
    write_gaussians(second / "scene.ply", scene().take([0, 1, 2]))  # written anew: the other keeps its own
    assert (first / "scene.ply").stat().st_size > (second / "scene.ply").stat().st_size


def test_old_jobs_are_deleted_and_the_newest_stays(splat: bpy.types.Object, tmp_path: Path) -> None:
    folders = [stopped(splat) for _ in range(3)]
    assert bpy.ops.gimp3d.delete_jobs() == {"FINISHED"}
    assert [f.exists() for f in folders] == [False, False, True]
    strange = tmp_path / "gimp3d_jobs" / "mine"
    strange.mkdir()
    assert bpy.ops.gimp3d.delete_jobs(folder=str(strange)) == {"FINISHED"} and strange.exists()
    assert bpy.ops.gimp3d.delete_jobs(folder=str(folders[2])) == {"FINISHED"} and not folders[2].exists()
    assert jobs.of_file(bpy.context) == [] and strange.exists()


def test_jobs_of_files_that_are_gone_can_be_deleted(splat: bpy.types.Object, tmp_path: Path) -> None:
    folder = stopped(splat)
    another_file(tmp_path / "other.blend", tmp_path)
    assert folder not in [Path(r.folder) for r in jobs.of_lost_files()]
    (tmp_path / "work.blend").unlink()
    assert folder in [Path(r.folder) for r in jobs.of_lost_files()]
    kept = jobs.new_job_folder("mine")
    assert bpy.ops.gimp3d.delete_jobs(lost=True) == {"FINISHED"}
    assert not folder.exists() and kept.exists() and jobs.of_lost_files() == []


def test_two_blenders_never_take_the_same_folder(splat: bpy.types.Object) -> None:
    assert jobs.new_job_folder("a") != jobs.new_job_folder("a")

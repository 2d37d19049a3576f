"""A removal that is cancelled, killed or cut off by a crash changes nothing, says so, and can be gone on with."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from gimp3d.io.ply import read_ply
from gimp3d_addon import jobs, splats
from gimp3d_addon.chosen import current_splat
from gimp3d_addon.operators.base import RunsChild
from gimp3d_addon.operators.reference import GIMP3D_OT_export_reference, RunsReference
from gimp3d_addon.operators.remove import SOURCE, GIMP3D_OT_remove_object, RunsRemoval
from gimp3d_addon.worker import GIVE_WAY, Worker


class Window:
    """Stands in for a Blender window's event loop, which the bpy module has not: modal operators run by hand."""

    def __init__(self) -> None:
        self.status: list[str | None] = []
        self.reports: list[tuple[set[str], str]] = []
        self.window = SimpleNamespace(screen=SimpleNamespace(areas=()))
        self.window_manager = SimpleNamespace(
            event_timer_add=lambda *_, **__: "timer",
            event_timer_remove=lambda *_: None,
            modal_handler_add=lambda *_: True,
            windows=[self.window],
        )
        self.workspace = SimpleNamespace(status_text_set=self.status.append)

    def __getattr__(self, name: str) -> object:
        return getattr(bpy.context, name)

    def remove(self, until: Callable[[RunsChild], bool] = lambda _: False, event: str = "ESC") -> set[str]:
        """Presses Remove and lets it run to its end, or sends `event` once `until` is true."""

        class Pressed(RunsRemoval):
            bl_label = GIMP3D_OT_remove_object.bl_label
            start = GIMP3D_OT_remove_object.start

        return self.press(Pressed, until, event)

    def press(
        self, operator: type[RunsChild], until: Callable[[RunsChild], bool] = lambda _: False, event: str = "ESC"
    ) -> set[str]:
        """The same for any operator that runs a child."""
        pressed = operator()
        pressed.report = lambda kind, text: self.reports.append((kind, text))
        pressed.in_window = True  # what `invoke` sets; a file browser then calls `execute`
        assert pressed.execute(self) == {"RUNNING_MODAL"}
        longest = 0.0
        while True:
            sent = event if until(pressed) else "TIMER"
            start = time.perf_counter()
            answer = pressed.modal(self, SimpleNamespace(type=sent))
            if answer != {"PASS_THROUGH"}:
                self.last_tick = time.perf_counter() - start
                self.longest_tick = longest
                return answer
            longest = max(longest, time.perf_counter() - start)
            time.sleep(0.02)


def begun(running: RunsChild) -> bool:
    return running.worker.status != "starting"


def masks_done(running: RunsChild) -> bool:
    return running.worker.progress > 0.25


def splat_objects() -> list[bpy.types.Object]:
    return [o for o in bpy.data.objects if splats.is_splat(o)]


def test_a_run_in_the_window_never_blocks_and_ends_with_the_result(splat: bpy.types.Object) -> None:
    window = Window()
    assert window.remove() == {"FINISHED"}
    assert window.longest_tick < 0.5 and window.last_tick < 2
    assert current_splat(bpy.context)[SOURCE] == splat and splat.hide_get()
    told = [s for s in window.status if s]
    assert any("masks" in s and "left" in s for s in told) and window.status[-1] is None
    assert RunsChild.running is None
    assert bpy.context.scene.gimp3d.hole.endswith("views")


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such number")
def test_a_child_gives_way_to_blenders_window() -> None:
    """Else drawing waits for a core: up to 0.5 s with software OpenGL."""
    worker = Worker([], command=[sys.executable, "-c", "input()"])
    child, own = (os.getpriority(os.PRIO_PROCESS, pid) for pid in (worker._process.pid, 0))
    worker.cancel()
    assert child == min(own + GIVE_WAY, 19)  # the most there is


def test_escape_leaves_the_scene_as_it_was_within_a_second(splat: bpy.types.Object) -> None:
    window = Window()
    assert window.remove(begun) == {"CANCELLED"}
    assert window.last_tick < 1 and window.reports[-1] == ({"INFO"}, "cancelled; the scene is as it was")
    assert splat_objects() == [splat] and not splat.hide_get() and RunsChild.running is None


def test_the_cancel_button_ends_the_run_too(splat: bpy.types.Object) -> None:
    window = Window()

    def press(running: RunsChild) -> bool:
        if begun(running) and not running.worker.cancelled:
            assert bpy.ops.gimp3d.cancel() == {"FINISHED"}
        return False

    assert window.remove(press) == {"CANCELLED"}
    assert splat_objects() == [splat] and not bpy.ops.gimp3d.cancel.poll()


def test_a_stopped_run_goes_on_and_gives_what_an_unbroken_one_gives(splat: bpy.types.Object, tmp_path: Path) -> None:
    assert Window().remove() == {"FINISHED"}
    bpy.ops.gimp3d.export_ply(filepath=str(tmp_path / "unbroken.ply"))
    bpy.ops.gimp3d.restore()
    assert not bpy.ops.gimp3d.resume.poll()
    assert Window().remove(masks_done) == {"CANCELLED"}
    assert bpy.ops.gimp3d.resume.poll() and bpy.ops.gimp3d.resume() == {"FINISHED"}
    assert current_splat(bpy.context)[SOURCE] == splat and not bpy.ops.gimp3d.resume.poll()
    bpy.ops.gimp3d.export_ply(filepath=str(tmp_path / "resumed.ply"))
    assert (tmp_path / "resumed.ply").read_bytes() == (tmp_path / "unbroken.ply").read_bytes()


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_a_killed_child_is_said_and_can_be_resumed(splat: bpy.types.Object) -> None:
    window = Window()

    def kill(running: RunsChild) -> bool:
        if masks_done(running):
            os.kill(running.worker._process.pid, signal.SIGKILL)
        return False

    assert window.remove(kill) == {"CANCELLED"}
    kind, said = window.reports[-1]
    assert kind == {"ERROR"} and "signal 9" in said and "resumed" in said and "\n" not in said
    assert splat_objects() == [splat] and not splat.hide_get()
    assert bpy.ops.gimp3d.resume() == {"FINISHED"}


def test_after_a_crash_of_blender_itself_the_run_is_found_again(splat: bpy.types.Object, tmp_path: Path) -> None:
    """The file on disk is older than the run; the job's folder beside it is all there is."""
    blend = str(tmp_path / "work.blend")
    bpy.ops.wm.save_as_mainfile(filepath=blend, check_existing=False)
    assert Window().remove(masks_done) == {"CANCELLED"}
    bpy.ops.wm.open_mainfile(filepath=blend)
    assert bpy.context.scene.gimp3d.last_job == "" and bpy.ops.gimp3d.resume() == {"FINISHED"}
    assert current_splat(bpy.context)[SOURCE].name == "scene"


def test_the_result_comes_alone_where_its_source_is_lost(splat: bpy.types.Object, tmp_path: Path) -> None:
    for obj in bpy.data.objects:
        obj.location.x += 2
    assert Window().remove(masks_done) == {"CANCELLED"}
    bpy.data.objects.remove(splat)
    assert bpy.ops.gimp3d.resume() == {"FINISHED"}
    (result,) = splat_objects()
    assert result.matrix_world.translation.x == 2 and not bpy.ops.gimp3d.restore.poll()


def test_a_refused_run_is_not_offered_again(splat: bpy.types.Object) -> None:
    bpy.context.scene.gimp3d.inpaint = "magic"
    with pytest.raises(RuntimeError, match="unknown provider"):
        bpy.ops.gimp3d.remove_object()
    assert jobs.unfinished(bpy.context) is None


def test_a_chain_of_children_runs_in_the_window(splat: bpy.types.Object) -> None:
    """The reference is painted after two of them: the mask, then the picture."""
    delivered: list[bool] = []

    class Pressed(RunsReference):
        bl_label = "Paint in Blender"

        def deliver(self, context: object, picture: Path, mask: Path) -> None:
            delivered.append(picture.is_file() and mask.is_file())

    window = Window()
    assert window.press(Pressed) == {"FINISHED"} and delivered == [True]
    assert window.longest_tick < 0.5 and RunsChild.running is None


def test_the_reference_is_written_beside_a_free_window(splat: bpy.types.Object, tmp_path: Path) -> None:
    class Pressed(RunsReference):
        bl_label = GIMP3D_OT_export_reference.bl_label
        filepath = str(tmp_path / "ref.png")
        deliver = GIMP3D_OT_export_reference.deliver

    window = Window()
    assert window.press(Pressed) == {"FINISHED"} and window.longest_tick < 0.5
    assert (tmp_path / "ref.png").is_file() and (tmp_path / "ref.mask.png").is_file()


def test_opening_another_file_ends_the_run(splat: bpy.types.Object) -> None:
    running = Worker(["remove", "--job", str(_job(splat)), "--progress", "json"])

    class Pressed(RunsRemoval):
        worker, _timer = running, "timer"

    RunsChild.running = Pressed()
    Pressed().cancel(Window())  # one whose dialogue was cancelled: it runs nothing
    assert running._process.poll() is None and RunsChild.running is not None
    RunsChild.running.cancel(Window())
    assert running._process.poll() is not None and RunsChild.running is None


def _job(splat: bpy.types.Object) -> Path:
    folder = jobs.new_job_folder(splat.name)
    jobs.write_job(bpy.context, folder)
    return folder


def test_before_and_after(splat: bpy.types.Object) -> None:
    assert not bpy.ops.gimp3d.compare.poll()
    bpy.ops.gimp3d.remove_object()
    result = current_splat(bpy.context)
    seen = []
    for _ in range(2):
        bpy.ops.gimp3d.compare()
        seen.append((splat.hide_get(), result.hide_get(), current_splat(bpy.context) == result))
    assert seen == [(False, True, True), (True, False, True)]


def test_a_second_object_is_removed_from_the_result(splat: bpy.types.Object, tmp_path: Path) -> None:
    bpy.ops.gimp3d.remove_object()
    first = current_splat(bpy.context)
    bpy.ops.gimp3d.clear_rois()
    bpy.context.scene.cursor.location = (1.0, 1.0, 0.0)
    bpy.ops.gimp3d.add_roi(size=0.3)
    bpy.ops.gimp3d.remove_object()
    second = current_splat(bpy.context)
    assert second[SOURCE] == first and first.hide_get() and first[SOURCE] == splat
    assert second.name.startswith("scene removed") and second.name.count("removed") == 1
    means = np.array(splats.positions(second))
    assert len(means) and (np.abs(means[:, :2]) < 0.2).all(1).any()  # what the first run filled is kept


def test_undo_takes_a_removal_back_and_redo_brings_it_again(splat: bpy.types.Object) -> None:
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.gimp3d.remove_object()
    bpy.ops.ed.undo_push(message="Remove Object")
    name = splat.name
    count = splats.count(current_splat(bpy.context))
    bpy.ops.ed.undo()
    (source,) = splat_objects()
    assert source.name == name and not source.hide_get() and current_splat(bpy.context) == source
    bpy.ops.ed.redo()
    assert len(splat_objects()) == 2 and splats.count(current_splat(bpy.context)) == count
    assert bpy.ops.gimp3d.restore() == {"FINISHED"}


def test_saving_closing_and_reopening_keeps_everything(splat: bpy.types.Object, tmp_path: Path) -> None:
    bpy.ops.gimp3d.choose_reference(camera="orbit/001")
    bpy.context.scene.gimp3d.preset = "draft"
    bpy.ops.gimp3d.remove_object()
    bpy.ops.gimp3d.export_ply(filepath=str(tmp_path / "before.ply"))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work.blend"), check_existing=False)
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "work.blend"))
    settings = bpy.context.scene.gimp3d
    assert settings.preset == "draft" and settings.reference.name == "orbit/001" and len(settings.rois) == 1
    assert Path(settings.last_report).is_file() and current_splat(bpy.context)[SOURCE].name == "scene"
    bpy.ops.gimp3d.export_ply(filepath=str(tmp_path / "after.ply"))
    assert (tmp_path / "after.ply").read_bytes() == (tmp_path / "before.ply").read_bytes()
    bpy.ops.gimp3d.restore()
    restored = current_splat(bpy.context)
    assert restored.name == "scene" and not restored.hide_get()
    assert len(read_ply(tmp_path / "before.ply").gaussians) != splats.count(restored)
    assert bpy.ops.gimp3d.remove_object() == {"FINISHED"}

"""Remove, go on with a stopped run, compare, restore."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import bpy
from bpy.props import BoolProperty, IntProperty, StringProperty
from mathutils import Matrix

from gimp3d.errors import BadInput, Gimp3dError
from gimp3d.io.ply import read_ply
from gimp3d.progress import Clock, count_words

from .. import charts, jobs, splats, steps
from ..chosen import current_boxes, current_splat, present
from ..lock import is_held
from ..worker import Killed, Worker, duration
from .base import (
    BOX,
    FAILURES,
    SPLAT,
    AsksFirst,
    Edits,
    Need,
    ReportsErrors,
    RunsChild,
    light_words,
    link,
    python_of,
    redraw_panels,
)

SOURCE = "gimp3d_source"  # custom property of a result: the hidden object it came from


class RunsRemoval(AsksFirst):
    """Mixin: a removal in its job folder, and its result brought into the scene."""

    folder: Path

    def run(self, context: bpy.types.Context, *more: str) -> Worker:
        context.scene.gimp3d.last_job = str(self.folder)
        forecast = steps.forecast(context)
        self._told = forecast.seconds if forecast and not more else 0.0
        # the command line asks for it too: what is in the job was allowed by AsksFirst
        allowed = ("--allow-command",) if any(p.startswith("command:") for p in self.providers(context)) else ()
        network = ["--allow-network"] * bpy.app.online_access
        arguments = ["remove", "--job", str(self.folder), *more, *allowed, *network, "--progress", "json"]
        clock = Clock(forecast) if forecast else None
        return Worker(arguments, python_of(context), clock, lock=self.folder / jobs.LOCK)

    def collect(self, context: bpy.types.Context) -> None:
        try:
            summary = self.worker.result()
        except Killed:
            raise  # the job stays open: Resume goes on with it
        except Gimp3dError:
            if not is_held(self.folder / jobs.LOCK):  # else another Blender has taken it up, and goes on
                jobs.close(self.folder)
            raise
        result = bring_back(context, self.folder)
        jobs.close(self.folder)
        charts.show(context, self.folder / "report" / "charts", result)
        settings, seconds, counts = context.scene.gimp3d, summary["seconds_total"], summary["counts"]
        if self._told and counts["added"] and not self.worker.compiled:
            settings.pace = (settings.pace * seconds / self._told) ** 0.5  # half-way: a busy minute is not forever
        report = self.folder / "report" / "index.html"
        settings.last_report = str(report) if report.exists() else ""
        settings.proposed = json.dumps(summary["proposed"])
        settings.shadow_found = light_words(summary["shadow"], summary["reflection"])
        for warning in summary["warnings"]:
            self.report({"WARNING"}, warning)
        verdict = summary["verdict"] or {"score": 1.0, "words": []}
        settings.score, settings.verdict = verdict["score"], "\n".join(verdict["words"])
        settings.hole = f"{counts['hole_pixels']:,} pixels in {counts['views']} views"
        self.report({"INFO"}, f"{result.name}: {count_words(counts, 'splats')} in {duration(seconds)}")


class GIMP3D_OT_remove_object(RunsRemoval, bpy.types.Operator):
    """Remove what lies in the box and fill the hole; the result is a new object and the original is hidden"""

    bl_idname = "gimp3d.remove_object"
    bl_label = "Remove Object"
    bl_options = {"UNDO"}
    needs = (SPLAT, BOX)

    def start(self, context: bpy.types.Context) -> Worker:
        splat = current_splat(context)
        python_of(context)  # before anything is written
        self.folder = jobs.new_job_folder(splat.name)
        try:
            jobs.write_job(context, self.folder)
        except BaseException:
            shutil.rmtree(self.folder)
            raise
        jobs.share_scene(self.folder)
        jobs.open_for(context, self.folder, splat)
        return self.run(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """A box without splats is a slip, and waiting for a result that is the scene again helps nobody."""
        try:
            if steps.splats_inside(current_splat(context), current_boxes(context)) == 0:
                self.report({"WARNING"}, "the box holds no splat: nothing to remove")
                return {"CANCELLED"}
        except FAILURES as error:
            return self._failed(error)
        return super().execute(context)


class GIMP3D_OT_resume(RunsRemoval, bpy.types.Operator):
    """Go on with the removal that was cancelled or ended by a crash, from its last finished stage"""

    bl_idname = "gimp3d.resume"
    bl_label = "Resume"
    bl_options = {"UNDO"}
    needs = (
        Need(
            "No removal was stopped half-way",
            lambda context: RunsChild.running is None and jobs.unfinished(context) is not None,
        ),
    )

    def providers(self, context: bpy.types.Context) -> tuple[str, ...]:
        """The job's own, which may not be the scene's any more."""
        folder = jobs.unfinished(context)
        record = jobs.record_of(folder) if folder is not None else None
        return tuple(record.providers) if record is not None else ()

    def start(self, context: bpy.types.Context) -> Worker:
        folder = jobs.unfinished(context)
        if folder is None:
            raise BadInput("no removal was stopped half-way")
        self.folder = folder
        return self.run(context, "--resume")


def bring_back(context: bpy.types.Context, folder: Path) -> bpy.types.Object:
    """The finished PLY as a new object in the source's place; the source is hidden, not changed.

    Without the source (the file was never saved before a crash) the result comes alone.
    """
    record = jobs.record_of(folder)
    if record is None:
        raise BadInput(f"{folder} was not written on this machine")
    source = jobs.source_in(context.scene, record)
    file = read_ply(folder / "out.ply")
    name = source.name if source is not None else record.source_name
    title = name if source is not None and SOURCE in source else f"{name} removed"
    if source is None:
        result = splats.create_object(title, file, Matrix(record.matrix))
        link(context, result)
    else:
        result = splats.create_like(source, title, file)
        result[SOURCE] = source
        link(context, result, source.users_collection[0] if source.users_collection else None)
        _hide(context, source, True)
    context.scene.gimp3d.splat = result
    return result


def _hide(context: bpy.types.Context, obj: bpy.types.Object, hidden: bool) -> None:
    obj.hide_render = hidden
    if obj.name in context.view_layer.objects:  # an excluded collection's objects cannot be hidden, and need not be
        obj.hide_set(hidden)


def source_in(context: bpy.types.Context) -> bpy.types.Object | None:
    """The object that the current splat object was made from."""
    splat = current_splat(context)
    source = splat.get(SOURCE) if splat is not None else None
    return present(context.scene, source) if isinstance(source, bpy.types.Object) else None


RESULT = Need("Nothing was removed from this splat object", lambda context: source_in(context) is not None)


class GIMP3D_OT_compare(Edits, bpy.types.Operator):
    """Switch between the scene before and after the removal"""

    bl_idname = "gimp3d.compare"
    bl_label = "Before / After"
    needs = (RESULT,)

    def work(self, context: bpy.types.Context) -> None:
        result, source = current_splat(context), source_in(context)
        before = source.hide_render
        context.scene.gimp3d.splat = result
        _hide(context, source, not before)
        _hide(context, result, before)


class GIMP3D_OT_restore(Edits, bpy.types.Operator):
    """Show the original scene again and take the result away"""

    bl_idname = "gimp3d.restore"
    bl_label = "Restore"
    needs = (RESULT,)

    def work(self, context: bpy.types.Context) -> None:
        result, source = current_splat(context), source_in(context)
        _hide(context, source, False)
        context.scene.gimp3d.splat = source
        data = result.data
        bpy.data.objects.remove(result)
        if data.users == 0:
            bpy.data.batch_remove([data])


class GIMP3D_OT_delete_jobs(ReportsErrors, bpy.types.Operator):
    """Delete this file's job folders from the disk; results in the scene stay, but stopped runs cannot be resumed"""

    bl_idname = "gimp3d.delete_jobs"
    bl_label = "Delete Old Jobs"

    folder: StringProperty(name="Folder", description="Of one job; empty: all", options={"SKIP_SAVE"})
    lost: BoolProperty(
        name="Of Lost Files", description="Those whose .blend is gone, instead of this file's", options={"SKIP_SAVE"}
    )
    keep: IntProperty(name="Keep", default=1, min=0, description="How many of the newest stay", options={"SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_confirm(self, event)

    def work(self, context: bpy.types.Context) -> None:
        known = jobs.of_lost_files() if self.lost else jobs.of_file(context)
        if self.lost:
            chosen = known
        elif self.folder:
            chosen = [r for r in known if r.folder == self.folder]
        else:
            chosen = known[: len(known) - self.keep]
        before = jobs.size(known)
        for record in chosen:
            jobs.delete(record)
        freed = (before - jobs.size(known)) / 1e6
        self.report({"INFO"}, f"{len(chosen)} jobs deleted, {freed:,.0f} MB freed")
        redraw_panels(context)

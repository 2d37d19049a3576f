"""Remove, go on with a stopped run, compare, restore."""

from __future__ import annotations

import json
from pathlib import Path

import bpy
from mathutils import Matrix

from gimp3d.errors import BadInput, Gimp3dError
from gimp3d.forecast import Clock
from gimp3d.io.ply import read_ply

from .. import charts, jobs, splats, steps
from ..bridge import present
from ..worker import Killed, Worker, duration
from .base import RunsChild, current_boxes, current_splat, light_words, link, python_of

SOURCE = "gimp3d_source"  # custom property of a result: the hidden object it came from


class RunsRemoval(RunsChild):
    """Mixin: a removal in its job folder, and its result brought into the scene."""

    folder: Path

    def run(self, context: bpy.types.Context, *more: str) -> Worker:
        context.scene.gimp3d.last_job = str(self.folder)
        forecast = steps.forecast(context)
        self._told = forecast.seconds if forecast and not more else 0.0
        network = ["--allow-network"] * bpy.app.online_access
        arguments = ["remove", "--job", str(self.folder), *more, *network, "--progress", "json"]
        return Worker(arguments, python_of(context), Clock(forecast) if forecast else None)

    def collect(self, context: bpy.types.Context) -> None:
        try:
            summary = self.worker.result()
        except Killed:
            raise  # the job stays open: Resume goes on with it
        except Gimp3dError:
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
        self.report(
            {"INFO"}, f"{result.name}: {counts['removed']:,} splats removed, {counts['added']:,} added "
            f"in {duration(seconds)}",
        )  # fmt: skip


class GIMP3D_OT_remove_object(RunsRemoval, bpy.types.Operator):
    """Remove what lies in the box and fill the hole; the result is a new object and the original is hidden"""

    bl_idname = "gimp3d.remove_object"
    bl_label = "Remove Object"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if current_splat(context) is None:
            cls.poll_message_set("Step 1: import a splat scene")
            return False
        if not current_boxes(context):
            cls.poll_message_set("Step 2: put a box round the object")
            return False
        return True

    def start(self, context: bpy.types.Context) -> Worker:
        splat = current_splat(context)
        if splat is None:
            raise BadInput("no splat object; import a PLY first (3D-GIMP panel, step 1)")
        self.folder = jobs.new_job_folder(splat.name)
        jobs.write_job(context, self.folder)
        jobs.open_for(self.folder, splat)
        return self.run(context)


class GIMP3D_OT_resume(RunsRemoval, bpy.types.Operator):
    """Go on with the removal that was cancelled or ended by a crash, from its last finished stage"""

    bl_idname = "gimp3d.resume"
    bl_label = "Resume"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("No removal was stopped half-way")
        return RunsChild.running is None and jobs.unfinished(context) is not None

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
    name, matrix = jobs.source_of(folder)
    source = context.scene.objects.get(name)
    file = read_ply(folder / "out.ply")
    title = name if source is not None and SOURCE in source else f"{name} removed"
    if source is None:
        result = splats.create_object(title, file, Matrix(matrix))
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
    return present(context.scene, splat.get(SOURCE)) if splat is not None else None


class OnResult:
    """Mixin: for the object that a removal made."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Nothing was removed from this splat object")
        return source_in(context) is not None


class GIMP3D_OT_compare(OnResult, bpy.types.Operator):
    """Switch between the scene before and after the removal"""

    bl_idname = "gimp3d.compare"
    bl_label = "Before / After"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        result, source = current_splat(context), source_in(context)
        before = source.hide_render
        context.scene.gimp3d.splat = result
        _hide(context, source, not before)
        _hide(context, result, before)
        return {"FINISHED"}


class GIMP3D_OT_restore(OnResult, bpy.types.Operator):
    """Show the original scene again and take the result away"""

    bl_idname = "gimp3d.restore"
    bl_label = "Restore"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        result, source = current_splat(context), source_in(context)
        _hide(context, source, False)
        context.scene.gimp3d.splat = source
        data = result.data
        bpy.data.objects.remove(result)
        if data.users == 0:
            bpy.data.batch_remove([data])
        return {"FINISHED"}


CLASSES = (GIMP3D_OT_remove_object, GIMP3D_OT_resume, GIMP3D_OT_compare, GIMP3D_OT_restore)

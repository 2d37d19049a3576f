"""Remove and restore."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from gimp3d.errors import BadInput
from gimp3d.io.ply import read_ply

from .. import jobs, splats
from ..bridge import present
from ..worker import Worker
from .base import FAILURES, current_boxes, current_splat, link, one_line, python_of

SOURCE = "gimp3d_source"  # custom property of a result: the hidden object it came from
TICK = 0.1  # s between two looks at the child's progress


class GIMP3D_OT_remove_object(bpy.types.Operator):
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

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Run to the end (scripts, background)."""
        try:
            self._start(context)
            self._finish(context, self._worker.wait())
        except FAILURES as error:
            self.report({"ERROR"}, one_line(error))
            return {"CANCELLED"}
        return {"FINISHED"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Run beside Blender; Esc cancels."""
        if bpy.app.background:
            return self.execute(context)
        try:
            self._start(context)
        except FAILURES as error:
            self.report({"ERROR"}, one_line(error))
            return {"CANCELLED"}
        self._timer = context.window_manager.event_timer_add(TICK, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type == "ESC":
            self._worker.cancel()
            self._stop(context)
            self.report({"INFO"}, "cancelled; the scene is as it was")
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        ended = self._worker.poll()
        settings = context.scene.gimp3d
        settings.progress, settings.status = self._worker.progress, self._worker.status
        context.workspace.status_text_set(f"3D-GIMP: {self._worker.status} (Esc cancels)")
        for area in context.window.screen.areas:
            area.tag_redraw()
        if not ended:
            return {"RUNNING_MODAL"}
        self._stop(context)
        try:
            self._finish(context, self._worker.result())
        except FAILURES as error:
            self.report({"ERROR"}, one_line(error))
            return {"CANCELLED"}
        return {"FINISHED"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator: another file is opened, or the window closes."""
        self._worker.cancel()
        self._stop(context)

    def _start(self, context: bpy.types.Context) -> None:
        splat = current_splat(context)
        if splat is None:
            raise BadInput("no splat object; import a PLY first (3D-GIMP panel, step 1)")
        self._source = splat.name  # not the object: an undo meanwhile would make the reference invalid
        self._folder = jobs.new_job_folder(splat.name)
        jobs.write_job(context, self._folder)
        arguments = ["remove", "--job", str(self._folder), "--progress", "json"]
        self._worker = Worker(arguments, python_of(context))

    def _stop(self, context: bpy.types.Context) -> None:
        context.window_manager.event_timer_remove(self._timer)
        context.workspace.status_text_set(None)
        context.scene.gimp3d.progress, context.scene.gimp3d.status = 0.0, ""

    def _finish(self, context: bpy.types.Context, summary: dict[str, Any]) -> None:
        source, path = context.scene.objects.get(self._source), self._folder / "out.ply"
        if source is None:
            raise BadInput(f"{self._source} is no longer in the scene; the result lies in {path}")
        result = bring_back(context, source, path)
        report = self._folder / "report" / "index.html"
        context.scene.gimp3d.last_report = str(report) if report.exists() else ""
        for warning in summary.get("warnings", ()):
            self.report({"WARNING"}, warning)
        counts = summary.get("counts", {})
        self.report(
            {"INFO"},
            f"{result.name}: {counts.get('removed', 0)} Gaussians removed, {counts.get('added', 0)} added "
            f"in {summary.get('seconds_total', 0):.0f} s",
        )


def bring_back(context: bpy.types.Context, source: bpy.types.Object, path: Path) -> bpy.types.Object:
    """The finished PLY as a new object in the source's place; the source is hidden, not changed."""
    result = splats.create_object(f"{source.name} removed", read_ply(path), source.matrix_world.copy())
    result[SOURCE] = source
    link(context, result, source.users_collection[0] if source.users_collection else None)
    _hide(context, source, True)
    context.scene.gimp3d.splat = result
    return result


def _hide(context: bpy.types.Context, obj: bpy.types.Object, hidden: bool) -> None:
    obj.hide_render = hidden
    if obj.name in context.view_layer.objects:  # an excluded collection's objects cannot be hidden, and need not be
        obj.hide_set(hidden)


class GIMP3D_OT_restore(bpy.types.Operator):
    """Show the original scene again and take the result away"""

    bl_idname = "gimp3d.restore"
    bl_label = "Restore"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Nothing was removed from this splat object")
        splat = current_splat(context)
        return splat is not None and present(context.scene, splat.get(SOURCE)) is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        result = current_splat(context)
        source = result[SOURCE]
        _hide(context, source, False)
        context.scene.gimp3d.splat = source
        mesh = result.data
        bpy.data.objects.remove(result)
        if mesh.users == 0:
            bpy.data.meshes.remove(mesh)
        return {"FINISHED"}


CLASSES = (GIMP3D_OT_remove_object, GIMP3D_OT_restore)

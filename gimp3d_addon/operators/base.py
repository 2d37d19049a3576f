"""What every operator does with an error: one line to the user, CANCELLED to the caller (a RuntimeError in scripts)."""

from __future__ import annotations

import bpy

from gimp3d.errors import Gimp3dError

from .. import splats
from ..bridge import present
from ..properties import preferences

FAILURES = (Gimp3dError, OSError)  # what a user can act on; anything else is a bug and keeps its traceback


def one_line(error: Exception) -> str:
    """An error as the command line would say it."""
    text = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) else str(error)
    return f"gimp3d: error: {text}"


class ReportsErrors:
    """Mixin: `execute` runs `work` and reports a failure as one line."""

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            self.work(context)
        except FAILURES as error:
            self.report({"ERROR"}, one_line(error))
            return {"CANCELLED"}
        return {"FINISHED"}


def current_splat(context: bpy.types.Context) -> bpy.types.Object | None:
    """The chosen splat object, else the active one, else the only one."""
    settings = context.scene.gimp3d
    if splats.is_splat(present(context.scene, settings.splat)):
        return settings.splat
    if splats.is_splat(context.active_object):
        return context.active_object
    found = [o for o in context.scene.objects if splats.is_splat(o) and not o.hide_get()]
    return found[0] if len(found) == 1 else None


def current_boxes(context: bpy.types.Context) -> list[bpy.types.Object]:
    """The region's boxes: the listed ones, else the active mesh that is no splat."""
    listed = [r.object for r in context.scene.gimp3d.rois if present(context.scene, r.object)]
    active = context.active_object
    if not listed and active is not None and active.type == "MESH" and not splats.is_splat(active):
        return [active]
    return listed


def link(context: bpy.types.Context, obj: bpy.types.Object, collection: bpy.types.Collection | None = None) -> None:
    (collection or context.collection or context.scene.collection).objects.link(obj)


def python_of(context: bpy.types.Context) -> str:
    chosen = preferences(context)
    return bpy.path.abspath(chosen.python) if chosen and chosen.python else ""

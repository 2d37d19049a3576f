"""What the scene's settings choose, or stand for where nothing is chosen: the splat object and the boxes."""

from __future__ import annotations

import bpy

from . import splats


def present(scene: bpy.types.Scene, obj: bpy.types.Object | None) -> bpy.types.Object | None:
    """The object, unless the user has deleted it: a pointer to it keeps a deleted object in the file."""
    return obj if obj is not None and scene.objects.get(obj.name) == obj else None


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

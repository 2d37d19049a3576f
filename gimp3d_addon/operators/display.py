"""How splats look in Blender's own viewport and renders. Nothing here runs unless the user asks for it."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Vector

from gimp3d.errors import BadInput

from .. import bridge, splats
from ..chosen import current_splat
from ..native import is_native
from .base import CAMERA, SPLAT, Edits, Need

BOUNCES = 256  # transparent surfaces that a ray passes; with Blender's 8 crowded splats turn dark
MOST = 10  # percent of the splats, at either end of each axis, that need not be in view after an import
TRANSFORM = "Standard"  # splat colours are pictures' colours; AgX and Filmic would change them


def show_imported(context: bpy.types.Context, obj: bpy.types.Object) -> None:
    """Show a new scene in the 3D view that it was imported from, else in the first one."""
    views = [area.spaces.active for area in context.screen.areas if area.type == "VIEW_3D"]
    if context.space_data in views or views:
        show_in(context.space_data if context.space_data in views else views[0], obj)


def show_in(view: bpy.types.SpaceView3D, obj: bpy.types.Object) -> None:
    """Let a 3D view show a scene's colours, and all of it but what lies far off: scans have strays everywhere."""
    if view.shading.type in ("SOLID", "WIREFRAME"):
        view.shading.type = "MATERIAL"
    points = splats.positions(obj)
    if len(points) == 0:
        return
    low, high = np.percentile(points, [MOST, 100 - MOST], axis=0)
    middle, size = obj.matrix_world @ Vector((low + high) / 2), float(np.linalg.norm(high - low))
    size *= obj.matrix_world.median_scale
    view.region_3d.view_location, view.region_3d.view_distance = middle, max(size, 1e-6)
    view.clip_start, view.clip_end = min(view.clip_start, 1e-3 * size), max(view.clip_end, 100 * size)


class GIMP3D_OT_update_colours(Edits, bpy.types.Operator):
    """Colour the splats as they look from the active camera: shine and reflections depend on where one stands"""

    bl_idname = "gimp3d.update_colours"
    bl_label = "Colours from Camera"
    needs = (
        SPLAT,
        CAMERA,
        Need("Blender colours its own splats", lambda context: not is_native(current_splat(context))),
    )

    def work(self, context: bpy.types.Context) -> None:
        splat, camera = current_splat(context), context.scene.camera
        if splat.mode == "EDIT":
            raise BadInput("leave edit mode first")
        context.view_layer.update()
        place = np.array(camera.evaluated_get(context.evaluated_depsgraph_get()).matrix_world.translation)
        splats.show_colours_from(splat, (np.linalg.inv(bridge.splat_frame(splat)) @ [*place, 1.0])[:3])


def unfit_settings(scene: bpy.types.Scene) -> list[str]:
    """What in the render settings makes splats look wrong."""
    found = []
    if scene.render.engine == "CYCLES" and scene.cycles.transparent_max_bounces < BOUNCES:
        found.append(f"Transparent bounces {scene.cycles.transparent_max_bounces}: splats turn dark")
    if scene.view_settings.view_transform != TRANSFORM:
        found.append(f"View transform {scene.view_settings.view_transform}: colours are changed")
    return found


class GIMP3D_OT_prepare_render(Edits, bpy.types.Operator):
    """Let renders show the splats' true colours: 256 transparent bounces in Cycles, view transform Standard"""

    bl_idname = "gimp3d.prepare_render"
    bl_label = "Set Up Render"

    def work(self, context: bpy.types.Context) -> None:
        scene = context.scene
        scene.view_settings.view_transform = TRANSFORM
        if scene.render.engine == "CYCLES":
            scene.cycles.transparent_max_bounces = max(BOUNCES, scene.cycles.transparent_max_bounces)


class GIMP3D_OT_even_scale(Edits, bpy.types.Operator):
    """Give the splat object the same scale on all axes: splats cannot be stretched or mirrored"""

    bl_idname = "gimp3d.even_scale"
    bl_label = "Make Scale Even"
    needs = (SPLAT,)

    def work(self, context: bpy.types.Context) -> None:
        splat = current_splat(context)
        splat.scale = (max(1e-6, sum(map(abs, splat.scale)) / 3),) * 3
        context.view_layer.update()
        bridge.splat_frame(splat)  # a parent may still stretch it

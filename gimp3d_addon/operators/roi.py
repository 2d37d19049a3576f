"""The region of interest: cubes."""

from __future__ import annotations

import bpy
import numpy as np
from bpy.props import FloatProperty

from .base import ReportsErrors, current_splat, link


class GIMP3D_OT_add_roi(ReportsErrors, bpy.types.Operator):
    """Add a box for the object to remove, at the 3D cursor; move, rotate and scale it round the object"""

    bl_idname = "gimp3d.add_roi"
    bl_label = "Add Box"
    bl_options = {"REGISTER", "UNDO"}

    size: FloatProperty(name="Size", default=0.0, min=0.0, description="Edge length; 0: a fifth of the scene")

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Import a splat scene first")
        return current_splat(context) is not None

    def work(self, context: bpy.types.Context) -> None:
        splat = current_splat(context)
        mesh = bpy.data.meshes.new("Remove this")
        corners = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
        faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        mesh.from_pydata(corners, [], faces)
        box = bpy.data.objects.new("Remove this", mesh)
        box.display_type, box.hide_render = "WIRE", True
        box.location = context.scene.cursor.location
        box.scale = (self.size or self._fifth_of(splat),) * 3
        link(context, box)
        context.scene.gimp3d.rois.add().object = box
        context.scene.gimp3d.splat = splat
        for other in context.selected_objects:
            other.select_set(False)
        box.select_set(True)
        context.view_layer.objects.active = box

    @staticmethod
    def _fifth_of(splat: bpy.types.Object) -> float:
        """A fifth of where most splats lie: stray ones far off do not count."""
        mesh = splat.data
        points = np.empty(3 * len(mesh.vertices), np.float32)
        mesh.vertices.foreach_get("co", points)
        if len(points) == 0:
            return 1.0
        low, high = np.percentile(points.reshape(-1, 3), [10, 90], axis=0)
        return max(0.2 * float((high - low).max()) * splat.matrix_world.median_scale, 1e-6)


class GIMP3D_OT_clear_rois(ReportsErrors, bpy.types.Operator):
    """Forget the boxes (the objects stay); the active cube is the region then"""

    bl_idname = "gimp3d.clear_rois"
    bl_label = "Clear Boxes"
    bl_options = {"REGISTER", "UNDO"}

    def work(self, context: bpy.types.Context) -> None:
        context.scene.gimp3d.rois.clear()


CLASSES = (GIMP3D_OT_add_roi, GIMP3D_OT_clear_rois)

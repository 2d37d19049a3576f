"""The N-panel 3D-GIMP: four steps that say what is missing."""

from __future__ import annotations

from pathlib import Path

import bpy

from gimp3d.errors import BadInput

from . import bridge
from .operators.base import current_boxes, current_splat


class GIMP3D_PT_main(bpy.types.Panel):
    """Scene · Region · Views · Remove"""

    bl_idname = "GIMP3D_PT_main"
    bl_label = "3D-GIMP"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "3D-GIMP"

    def draw(self, context: bpy.types.Context) -> None:
        settings, layout = context.scene.gimp3d, self.layout
        splat, boxes = current_splat(context), current_boxes(context)
        self._scene(layout.box(), settings, splat)
        self._region(layout.box(), splat, boxes)
        self._views(layout.box(), context)
        self._remove(layout.box(), context)

    @staticmethod
    def _scene(box: bpy.types.UILayout, settings: bpy.types.PropertyGroup, splat: bpy.types.Object | None) -> None:
        box.label(text="1  Scene", icon="OUTLINER_OB_POINTCLOUD")
        box.prop(settings, "splat", text="")
        if splat is None:
            box.label(text="No splat scene yet", icon="INFO")
        else:
            box.label(text=f"{len(splat.data.vertices):,} splats")
        row = box.row(align=True)
        row.operator("gimp3d.import_ply", text="Import")
        row.operator("gimp3d.export_ply", text="Export")

    @staticmethod
    def _region(box: bpy.types.UILayout, splat: bpy.types.Object | None, boxes: list[bpy.types.Object]) -> None:
        box.label(text="2  Region", icon="MESH_CUBE")
        if boxes:
            box.label(text=", ".join(b.name for b in boxes))
        else:
            box.label(text="Put a box round the object", icon="INFO")
        row = box.row(align=True)
        row.operator("gimp3d.add_roi")
        row.operator("gimp3d.clear_rois", text="", icon="X")

    @staticmethod
    def _views(box: bpy.types.UILayout, context: bpy.types.Context) -> None:
        settings = context.scene.gimp3d
        box.label(text="3  Views", icon="CAMERA_DATA")
        box.prop(settings, "views", text="")
        if settings.views == "COLLECTION":
            box.prop(settings, "view_collection", text="")
        try:
            found = len(bridge.chosen_cameras(context.scene))
        except BadInput:
            found = 0
        if settings.views == "ANIMATED":
            scene = context.scene
            found = len(range(scene.frame_start, scene.frame_end + 1, scene.frame_step)) if scene.camera else 0
        box.label(text=f"{found} views" if found else "No camera yet", icon="NONE" if found else "INFO")
        row = box.row(align=True)
        row.operator("gimp3d.add_views", text="Orbit")
        row.operator("gimp3d.import_cameras", text="Import")

    @staticmethod
    def _remove(box: bpy.types.UILayout, context: bpy.types.Context) -> None:
        settings = context.scene.gimp3d
        box.label(text="4  Remove", icon="TRASH")
        box.prop(settings, "preset", text="")
        if settings.status:
            box.progress(factor=settings.progress, text=settings.status)
        box.operator("gimp3d.remove_object")
        row = box.row(align=True)
        row.operator("gimp3d.preview_masks")
        row.operator("gimp3d.restore")
        if settings.last_report:
            opened = box.operator("wm.url_open", text="Open Report", icon="URL")
            opened.url = Path(settings.last_report).as_uri()


class GIMP3D_PT_reference(bpy.types.Panel):
    """Who completes the picture, and from where"""

    bl_idname = "GIMP3D_PT_reference"
    bl_label = "Reference and Fill"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "3D-GIMP"
    bl_parent_id = "GIMP3D_PT_main"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        settings, layout = context.scene.gimp3d, self.layout
        layout.prop(settings, "reference")
        layout.operator("gimp3d.choose_reference")
        row = layout.row(align=True)
        row.operator("gimp3d.export_reference", text="Export")
        row.operator("gimp3d.load_reference", text="Load")
        layout.prop(settings, "reference_image")
        layout.prop(settings, "inpaint")
        layout.prop(settings, "depth_prior")
        layout.prop(settings, "seed")
        layout.operator("gimp3d.render_view")


CLASSES = (GIMP3D_PT_main, GIMP3D_PT_reference)

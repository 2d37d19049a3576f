"""Splat scenes in and out."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
from bpy.props import EnumProperty, StringProperty
from bpy_extras.io_utils import ExportHelper, ImportHelper

from gimp3d.io.formats import read_scene
from gimp3d.io.ply import write_ply

from .. import jobs, splats
from ..chosen import current_splat
from .base import SPLAT, Edits, ReportsErrors, link, select_only
from .display import show_imported

UP_ITEMS = (
    ("FILE", "As in the file", "Keep the file's axes"),
    ("Y_DOWN", "Y down → Z up", "Scenes with y pointing down, as most from COLMAP photos"),
    ("Y_UP", "Y up → Z up", "Scenes with y pointing up"),
)


class GIMP3D_OT_import_ply(Edits, bpy.types.Operator, ImportHelper):
    """Import a Gaussian splat scene; its numbers are kept exactly"""

    bl_idname = "gimp3d.import_ply"
    bl_label = "Import Splats"
    filename_ext = ".ply"

    filepath: StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE"})  # a dropped file must not be the next default
    filter_glob: StringProperty(default="*.ply;*.splat;*.spz;*.sog;meta.json", options={"HIDDEN"})
    up: EnumProperty(items=UP_ITEMS, name="Up", default="FILE", description="Goes into the object's matrix only")

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if not self.properties.is_property_set("filepath"):
            return ImportHelper.invoke(self, context, event)
        return context.window_manager.invoke_props_dialog(self, title=Path(self.filepath).name)  # dropped: ask for Up

    def work(self, context: bpy.types.Context) -> None:
        path = Path(bpy.path.abspath(self.filepath))
        file = read_scene(path)
        if file.table.before or file.table.after:
            self.report({"WARNING"}, "elements other than vertex are not kept")
        obj = splats.create_object(splats.default_name(path), file, splats.UP_AXES[self.up])
        link(context, obj)
        jobs.identify(context.scene, obj)
        select_only(context, obj)
        obj.select_set(False)  # still the active one; the outline of so many points would hide them
        context.scene.gimp3d.splat = obj
        if not bpy.app.background:
            show_imported(context, obj)
        self.report({"INFO"}, f"{len(file.gaussians):,} Gaussians, SH degree {file.gaussians.sh_degree}")


class GIMP3D_OT_export_ply(ReportsErrors, bpy.types.Operator, ExportHelper):
    """Export the splat object as the PLY it came from; deleted vertices are left out"""

    bl_idname = "gimp3d.export_ply"
    bl_label = "Export Splat PLY"
    needs = (SPLAT,)
    filename_ext = ".ply"

    filter_glob: StringProperty(default="*.ply", options={"HIDDEN"})

    def work(self, context: bpy.types.Context) -> None:
        active = context.active_object
        file = splats.read_object(active if splats.is_splat(active) else current_splat(context))
        write_ply(Path(bpy.path.abspath(self.filepath)), file, np.ones(len(file.gaussians), bool))


class GIMP3D_FH_splats(bpy.types.FileHandler):
    """Splat files dropped into the 3D view"""

    bl_idname = "GIMP3D_FH_splats"
    bl_label = "Gaussian Splats, 3D-GIMP"
    bl_import_operator = "gimp3d.import_ply"
    bl_file_extensions = ".ply;.splat;.spz;.sog"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"


def _menu_import(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    self.layout.operator(GIMP3D_OT_import_ply.bl_idname, text="Gaussian Splats, 3D-GIMP (.ply, .splat, .spz, .sog)")


def _menu_export(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    self.layout.operator(GIMP3D_OT_export_ply.bl_idname, text="Gaussian Splats, 3D-GIMP (.ply)")


def register() -> None:
    bpy.types.TOPBAR_MT_file_import.append(_menu_import)
    bpy.types.TOPBAR_MT_file_export.append(_menu_export)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_menu_import)
    bpy.types.TOPBAR_MT_file_export.remove(_menu_export)

"""The preferences: which Python runs the removal, what it has, and what was allowed on this machine."""

from __future__ import annotations

import bpy
from bpy.props import StringProperty

from . import trust
from .installation import PACKAGE
from .operators.environment import USES, GIMP3D_OT_check, verdict


def _make_absolute(preferences: GIMP3D_preferences, _: bpy.types.Context) -> None:
    """The file browser may give a path from the .blend's folder: another .blend would name another Python by it."""
    if preferences.python.startswith("//"):
        preferences.python = bpy.path.abspath(preferences.python)


class GIMP3D_preferences(bpy.types.AddonPreferences):
    """Which Python runs the removal."""

    bl_idname = PACKAGE

    python: StringProperty(
        name="Python",
        subtype="FILE_PATH",
        description="An interpreter with numba, scipy and OpenCV; empty: Blender's own with what the extension brings",
        update=_make_absolute,
    )

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.label(text="Remove runs in a Python of its own, so that Blender stays free.")
        layout.prop(self, "python")
        row = layout.row()
        row.operator("gimp3d.make_environment", icon="IMPORT")
        row.operator("gimp3d.check", icon="CHECKMARK")
        for name, version in GIMP3D_OT_check.found.items():
            there = bool(version) and not version.startswith("broken")
            words = (f"{name} {version or 'missing'}", USES.get(name, ""), verdict(name))
            icon = "CHECKMARK" if there else "INFO" if name in USES else "ERROR"
            layout.label(text=", ".join(w for w in words if w), icon=icon)
        for number, said in enumerate(trust.allowed()):
            row = layout.row()
            column = row.column(align=True)
            for line in said.splitlines():
                column.label(text=line, icon="BLANK1" if line != said.splitlines()[0] else "CHECKBOX_HLT")
            row.operator("gimp3d.forget_allowed", text="Ask Again").index = number

"""Named settings that the user keeps."""

from __future__ import annotations

import bpy
from bl_operators.presets import AddPresetBase


class GIMP3D_OT_add_preset(AddPresetBase, bpy.types.Operator):
    """Keep the preset, the fill and the seed under a name, or delete the chosen one"""

    bl_idname = "gimp3d.add_preset"
    bl_label = "Keep Removal Preset"
    preset_menu = "GIMP3D_PT_presets"
    preset_subdir = "gimp3d"
    preset_defines = ("settings = bpy.context.scene.gimp3d",)
    preset_values = ("settings.preset", "settings.inpaint", "settings.depth_prior", "settings.seed")

"""scene.gimp3d and the preferences."""

from __future__ import annotations

import bpy
from bpy.props import (
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from . import splats

PRESETS = (
    ("draft", "Draft", "One reference view; fastest"),
    ("balanced", "Balanced", "A few reference views where the first does not reach"),
    ("best", "Best", "As many reference views as help"),
    ("paper", "Paper", "The published method with its misprints mended"),
)
VIEWS = (
    ("ALL", "All cameras", "Every camera in the scene is a view"),
    ("COLLECTION", "Collection", "The cameras in one collection are the views"),
    ("ANIMATED", "Animated camera", "Every frame of the active camera is a view"),
)


class GIMP3D_PG_region(bpy.types.PropertyGroup):
    """One box of the region."""

    object: PointerProperty(type=bpy.types.Object, name="Box")


class GIMP3D_PG_settings(bpy.types.PropertyGroup):
    """What a removal needs, kept with the scene."""

    splat: PointerProperty(
        type=bpy.types.Object,
        name="Splat",
        description="The Gaussian splat object to remove something from",
        poll=lambda _, candidate: splats.is_splat(candidate),
    )
    rois: CollectionProperty(type=GIMP3D_PG_region, name="Boxes", description="The active cube if empty")
    views: EnumProperty(items=VIEWS, name="Views", default="ALL")
    view_collection: PointerProperty(type=bpy.types.Collection, name="Collection")
    reference: PointerProperty(
        type=bpy.types.Object,
        name="Reference",
        description="The view to complete first; empty: the program chooses",
        poll=lambda _, candidate: candidate.type == "CAMERA",
    )
    reference_image: StringProperty(
        name="Picture",
        description="The reference view without the object, painted in any tool",
        subtype="FILE_PATH",
    )
    preset: EnumProperty(items=PRESETS, name="Preset", default="balanced")
    inpaint: StringProperty(
        name="Fill",
        default="exemplar",
        description="What invents the never-seen part: exemplar, telea, ns, shiftmap, fsr, file:, onnx: or command:",
    )
    depth_prior: StringProperty(
        name="Surface",
        default="auto",
        description="How the hidden surface goes on: auto, harmonic, planar, file:PATH",
    )
    seed: IntProperty(name="Seed", default=0, min=0)
    progress: FloatProperty(min=0, max=1, options={"SKIP_SAVE"})
    status: StringProperty(options={"SKIP_SAVE"})
    last_report: StringProperty(name="Report", subtype="FILE_PATH")


class GIMP3D_preferences(bpy.types.AddonPreferences):
    """Which Python runs the removal."""

    bl_idname = __package__.rpartition(".")[0] or __package__  # the extension; in a checkout the add-on itself

    python: StringProperty(
        name="Python",
        subtype="FILE_PATH",
        description="An interpreter with numba, scipy and OpenCV; empty: Blender's own with the bundled wheels",
    )

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.prop(self, "python")


CLASSES = (GIMP3D_PG_region, GIMP3D_PG_settings, GIMP3D_preferences)


def preferences(context: bpy.types.Context) -> GIMP3D_preferences | None:
    """The add-on's preferences; None where it was registered from a checkout without being enabled."""
    addon = context.preferences.addons.get(GIMP3D_preferences.bl_idname)
    return addon.preferences if addon else None


def register() -> None:
    bpy.types.Scene.gimp3d = PointerProperty(type=GIMP3D_PG_settings)


def unregister() -> None:
    del bpy.types.Scene.gimp3d

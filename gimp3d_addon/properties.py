"""scene.gimp3d: what a removal needs, kept with the scene."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from . import splats, trust

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
SHADOWS = (
    ("auto", "Undo", "The object's shadow is found by the light that casts it, and undone"),
    ("off", "Leave", "Shadows stay as they are"),
    ("mask", "As painted", "The shadow is where it was painted (Paint Shadow)"),
)
INPAINT = ("exemplar", "shiftmap", "fsr", "telea", "ns")
SURFACES = ("auto", "harmonic", "planar")


class GIMP3D_PG_region(bpy.types.PropertyGroup):
    """One box of the region."""

    object: PointerProperty(type=bpy.types.Object, name="Box")


def _know_picture(settings: GIMP3D_PG_settings, _: bpy.types.Context) -> None:
    """Called when the user or a script chooses a picture, and not for what a .blend brings along."""
    if settings.reference_image:
        trust.know_photos([Path(bpy.path.abspath(settings.reference_image))])


class GIMP3D_PG_settings(bpy.types.PropertyGroup):
    """What a removal needs, kept with the scene."""

    id: StringProperty(name="ID", description="Tells this scene from others, for the jobs that belong to it")
    splat: PointerProperty(
        type=bpy.types.Object,
        name="Splat",
        description="The Gaussian splat object to remove something from",
        poll=lambda _, candidate: splats.is_splat(candidate),
    )
    rois: CollectionProperty(
        type=GIMP3D_PG_region, name="Boxes", description="Boxes round the object; the active cube if empty"
    )
    views: EnumProperty(
        items=VIEWS, name="Views", default="ALL", description="From where the scene is looked at and mended"
    )
    view_collection: PointerProperty(
        type=bpy.types.Collection, name="Collection", description="Its cameras are the views"
    )
    reference: PointerProperty(
        type=bpy.types.Object,
        name="Reference",
        description="The view or chart to complete first; empty: the program chooses",
        poll=lambda _, candidate: candidate.type == "CAMERA",
    )
    reference_image: StringProperty(
        name="Picture",
        description="The reference view without the object, painted in any tool",
        subtype="FILE_PATH",
        update=_know_picture,
    )
    grow: BoolProperty(name="Grow", default=False, description="Also remove what the box cut off of the object")
    shadow: EnumProperty(
        items=SHADOWS, name="Shadow", default="auto", description="What becomes of the object's shadow"
    )
    shadow_paint: PointerProperty(
        type=bpy.types.Image, name="Painted shadow", description="A view with its shadow painted over, in any colour"
    )
    shadow_camera: PointerProperty(type=bpy.types.Object, name="Camera", description="The view of the painted shadow")
    shadow_found: StringProperty(name="Light", description="The shadow and reflection that were found last")
    proposed: StringProperty(
        name="Proposed", description="What the box cut off, as the last preview or removal found it (JSON)"
    )
    preset: EnumProperty(
        items=PRESETS, name="Preset", default="balanced", description="How much work is spent on the hole"
    )
    reference_paint: PointerProperty(
        type=bpy.types.Image,
        name="Painted",
        description="The reference view without the object, painted in Blender's Image Editor",
    )
    inpaint: StringProperty(
        name="Fill",
        default="exemplar",
        description=(
            "What invents the part that no view shows: one of the list, or file:PATH, torchscript:big-lama.pt, "
            "onnx:PATH, http://127.0.0.1:8188 (ComfyUI), http://127.0.0.1:7860 (Automatic1111), gemini or command:CMD"
        ),
        search=lambda _, context, text: INPAINT,
        search_options={"SUGGESTION"},
    )
    depth_prior: StringProperty(
        name="Surface",
        default="auto",
        description=(
            "How the hidden surface goes on: one of the list, or file:PATH, onnx:PATH, torchscript:PATH or command:CMD"
        ),
        search=lambda _, context, text: SURFACES,
        search_options={"SUGGESTION"},
    )
    seed: IntProperty(name="Seed", default=0, min=0, description="Another number invents other details")
    pace: FloatProperty(
        name="Pace",
        default=1.0,
        min=0.01,
        description="The last run's time over its forecast: later forecasts are multiplied by it",
    )
    hole: StringProperty(name="Hole", description="Size of what was or will be filled, as last measured")
    score: FloatProperty(name="Score", description="How good the last removal probably is: 0 bad, 1 good")
    verdict: StringProperty(name="Verdict", description="What the score comes to, and what to do; one sentence a line")
    last_job: StringProperty(name="Job", subtype="FILE_PATH", description="Folder of the last removal")
    last_report: StringProperty(
        name="Report", subtype="FILE_PATH", description="What each stage of the last removal did, as a web page"
    )


def register() -> None:
    bpy.types.Scene.gimp3d = PointerProperty(type=GIMP3D_PG_settings)


def unregister() -> None:
    del bpy.types.Scene.gimp3d

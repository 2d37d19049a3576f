"""What each of the panel's steps has, what it lacks, and the button that mends it. Reads the scene, changes nothing."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import bpy
import numpy as np

from gimp3d.box import in_region
from gimp3d.errors import BadInput
from gimp3d.progress import Forecast, forecast_removal

from . import bridge, splats
from .chosen import current_boxes, current_splat, present

FEW_VIEWS = 3  # below it hardly anything behind the object is seen


@dataclass(frozen=True)
class Fix:
    """A button: an operator and what it is called with."""

    operator: str
    label: str
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Step:
    """One of the four steps: what is there, and what is missing if anything is."""

    facts: tuple[str, ...] = ()
    missing: str = ""
    fixes: tuple[Fix, ...] = ()
    warning: str = ""  # works, but the result will hardly be what is wanted; the fixes are for it too
    hint: str = ""  # works, but could be better


def scene_step(context: bpy.types.Context) -> Step:
    splat = current_splat(context)
    if splat is None:
        found = sum(splats.is_splat(o) for o in context.scene.objects)
        if found:
            return Step(missing=f"{found} splat objects: choose one above")
        return Step(missing="No splat scene yet", fixes=(Fix("gimp3d.import_ply", "Import Splats"),))
    try:
        bridge.splat_frame(splat)
    except BadInput as error:
        return Step(missing=str(error), fixes=(Fix("gimp3d.even_scale", "Make Scale Even"),))
    return Step(facts=(f"{splats.count(splat):,} splats", splats.kind(splat)))


def region_step(context: bpy.types.Context) -> Step:
    splat, boxes = current_splat(context), current_boxes(context)
    here = Fix("gimp3d.add_roi", "Add Box in View", {"fit": "VIEW"})
    if not boxes:
        return Step(missing="No box round the object yet", fixes=(here,) if splat else ())
    if splat is None:
        return Step(missing="Import the scene first")
    try:
        inside = splats_inside(splat, boxes)
    except BadInput as error:
        return Step(missing=str(error))
    if inside == 0:
        return Step(missing="The box holds no splat; move it", fixes=(here,))
    facts = (f"{inside:,} splats inside", f"{inside / splats.count(splat):.1%} of the scene")
    if not any(present(context.scene, r.object) for r in context.scene.gimp3d.rois):
        return Step(facts, warning=f"The active mesh, {boxes[0].name}, counts as the box", fixes=(here,))
    return Step(facts)


def views_step(context: bpy.types.Context) -> Step:
    if current_splat(context) is None:
        return Step(missing="Import the scene first")
    add = (Fix("gimp3d.add_views", "Orbit round the Box"), Fix("gimp3d.import_cameras", "Import Cameras"))
    boxes = current_boxes(context)
    try:
        found = bridge.view_sizes(context, boxes)
    except BadInput as error:
        return Step(missing=str(error), fixes=add)
    if not found:
        return Step(missing="No view yet", fixes=add)
    photos, strange = sum(v.photo for v in found), sum(v.strange_photo for v in found)
    seeing = sum(v.sees for v in found)
    counted = f"{len(found)} view{'s' if len(found) > 1 else ''}"
    if seeing < len(found):
        counted = f"{seeing} of {counted} see the box"
    facts = (counted, f"{photos} with photo" if photos else "drawn from the splats")
    hint = f"{strange} photos are not where you took photos from: import the cameras again" if strange else ""
    if seeing == 0:
        return Step(facts, missing="No view sees the box", fixes=add)
    if seeing < FEW_VIEWS:
        few = f"Only {seeing} view{'s' if seeing > 1 else ''}: much of what is behind the object will be invented"
        return Step(facts, warning=few, fixes=add, hint=hint)
    return Step(facts, hint=hint)


def forecast(context: bpy.types.Context) -> Forecast | None:
    """Of a removal as it is set up now; None while a step is open."""
    splat = current_splat(context)
    try:
        views = bridge.view_sizes(context)
    except BadInput:
        views = []
    if splat is None or not views:
        return None
    pixels = sum(v.width * v.height for v in views)
    return forecast_removal(splats.count(splat), len(views), pixels, context.scene.gimp3d.preset)


_inside: tuple[tuple[Any, ...], int] = ((), 0)  # what was counted last: a panel is drawn many times a second


def splats_inside(splat: bpy.types.Object, boxes: list[bpy.types.Object]) -> int:
    """How many splats have their centre in the boxes.

    Raises
    ------
    BadInput
        If a box or the splat's scale cannot be used.
    """
    global _inside
    frame = bridge.splat_frame(splat)
    region = [bridge.box_from_blender(b, frame) for b in boxes]
    numbers = tuple(tuple(b.center) + tuple(b.size) + tuple(b.rotation_wxyz) for b in region)
    key = (splat.data.as_pointer(), splats.count(splat), numbers)
    if _inside[0] != key:
        _inside = (key, int(np.count_nonzero(in_region(region, splats.positions(splat)))))
    return _inside[1]

"""The region of interest: cubes."""

from __future__ import annotations

import json

import bpy
import numpy as np
from bpy.props import EnumProperty, FloatProperty, IntProperty
from mathutils import Matrix, Quaternion, Vector

from gimp3d.box import Box
from gimp3d.errors import BadInput

from .. import bridge, splats
from ..chosen import current_boxes, current_splat
from .base import SPLAT, Edits, link, select_only

FITS = (
    ("CURSOR", "At the 3D Cursor", "A cube at the 3D cursor (Shift + right click places it)", "PIVOT_CURSOR", 0),
    ("SELECTION", "Round the Selection", "Round the splats selected in edit mode, else round the selected objects",
     "SELECT_SET", 1),
    ("VIEW", "In the View", "Where the middle of the view meets the splats, a third of the view high", "VIEW3D", 2),
)  # fmt: skip
MARGIN = 1.05  # of a box round a selection
VIEW_SHARE = 1 / 3  # of the view's height that a box in the view takes


class GIMP3D_OT_add_roi(Edits, bpy.types.Operator):
    """Add a box for the object to remove; move, rotate and scale it round the object. Several boxes count together"""

    bl_idname = "gimp3d.add_roi"
    bl_label = "Add Box"
    needs = (SPLAT,)

    fit: EnumProperty(items=FITS, name="Fit", default="CURSOR", description="Where the box is put and how large it is")
    size: FloatProperty(
        name="Size", default=0.0, min=0.0, description="Edge length; 0: fitted, or a fifth of the scene"
    )

    def work(self, context: bpy.types.Context) -> None:
        splat = current_splat(context)
        context.view_layer.update()
        matrix = self._placed(context, splat)
        if self.size:
            matrix = Matrix.LocRotScale(matrix.translation, matrix.to_quaternion(), (self.size,) * 3)
        mesh = bpy.data.meshes.new("Remove this")
        corners = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
        faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        mesh.from_pydata(corners, [], faces)
        box = bpy.data.objects.new("Remove this", mesh)
        box.display_type, box.hide_render = "WIRE", True
        box.show_in_front = True  # splats would hide it
        box.matrix_world = matrix
        link(context, box)
        context.scene.gimp3d.rois.add().object = box
        context.scene.gimp3d.splat = splat
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")  # so that the new box can be moved at once
        select_only(context, box)

    def _placed(self, context: bpy.types.Context, splat: bpy.types.Object) -> Matrix:
        if self.fit == "SELECTION":
            return round_selection(context, splat)
        if self.fit == "VIEW":
            return in_view(context, splat)
        return Matrix.LocRotScale(context.scene.cursor.location, None, (_fifth_of(splat),) * 3)


def round_selection(context: bpy.types.Context, splat: bpy.types.Object) -> Matrix:
    """A unit cube's matrix round the splats selected in edit mode, in the splat's axes, else round selected objects."""
    if splat.mode == "EDIT":
        splat.update_from_editmode()
        chosen = np.empty(len(splat.data.vertices), bool)
        splat.data.vertices.foreach_get("select", chosen)
        points, frame = splats.positions(splat)[chosen], splat.matrix_world
    else:
        objects = [o for o in context.selected_objects if not splats.is_splat(o)]
        corners = [o.matrix_world @ Vector(c) for o in objects for c in o.bound_box]
        points, frame = np.array([tuple(c) for c in corners]).reshape(-1, 3), Matrix.Identity(4)
    if len(points) == 0:
        raise BadInput("nothing is selected; select splats in edit mode, or objects that the box is to hold")
    low, high = points.min(0), points.max(0)
    size = np.maximum(MARGIN * (high - low), 1e-3 * max(1e-6, float((high - low).max())))
    return frame @ Matrix.LocRotScale(Vector((low + high) / 2), None, Vector(size))


def in_view(context: bpy.types.Context, splat: bpy.types.Object) -> Matrix:
    """A unit cube's matrix where the middle of the 3D view (else of the active camera) meets the splats."""
    to_clip = np.array(_projection(context), dtype=np.float64)
    points = splats.positions(splat)
    clip = np.c_[points, np.ones(len(points))] @ (to_clip @ np.array(splat.matrix_world)).T
    middle = (clip[:, 3] > 1e-9) & (np.abs(clip[:, :2]) < clip[:, 3:] * VIEW_SHARE / 2).all(1)
    if not middle.any():
        raise BadInput("no splats in the middle of the view; turn the view to the object")
    depth = np.quantile(clip[middle, 2] / clip[middle, 3], 0.25)  # in front of the background, behind stray ones

    def place(x: float, y: float) -> Vector:
        world = np.linalg.solve(to_clip, [x, y, depth, 1.0])
        return Vector(world[:3] / world[3])

    height = (place(0, VIEW_SHARE) - place(0, -VIEW_SHARE)).length
    return Matrix.LocRotScale(place(0, 0), None, (height,) * 3)


def _projection(context: bpy.types.Context) -> Matrix:
    """World to clip coordinates of the 3D view that the operator was called in, else of the active camera."""
    region = getattr(context, "region_data", None)
    if region is not None:
        return region.perspective_matrix
    camera, render = context.scene.camera, context.scene.render
    if camera is None:
        raise BadInput("there is no 3D view and no active camera to put the box in front of")
    depsgraph = context.evaluated_depsgraph_get()
    projection = camera.calc_matrix_camera(depsgraph, x=render.resolution_x, y=render.resolution_y)
    return projection @ camera.matrix_world.inverted()


def _fifth_of(splat: bpy.types.Object) -> float:
    """A fifth of where most splats lie: stray ones far off do not count."""
    points = splats.positions(splat)
    if len(points) == 0:
        return 1.0
    low, high = np.percentile(points, [10, 90], axis=0)
    return max(0.2 * float((high - low).max()) * splat.matrix_world.median_scale, 1e-6)


class GIMP3D_OT_use_selected(Edits, bpy.types.Operator):
    """Make the selected meshes boxes of the region; what counts is the box round each"""

    bl_idname = "gimp3d.use_selected"
    bl_label = "Use Selected as Boxes"

    def work(self, context: bpy.types.Context) -> None:
        rois = context.scene.gimp3d.rois
        listed = {r.object for r in rois}
        new = [o for o in context.selected_objects if o.type == "MESH" and not splats.is_splat(o) and o not in listed]
        if not new:
            raise BadInput("no mesh is selected that is not a box already")
        for obj in new:
            rois.add().object = obj


class GIMP3D_OT_forget_roi(Edits, bpy.types.Operator):
    """Take this box out of the region; the object stays"""

    bl_idname = "gimp3d.forget_roi"
    bl_label = "Forget Box"

    index: IntProperty(name="Index", min=0)

    def work(self, context: bpy.types.Context) -> None:
        context.scene.gimp3d.rois.remove(self.index)


class GIMP3D_OT_clear_rois(Edits, bpy.types.Operator):
    """Forget the boxes (the objects stay); the active cube is the region then"""

    bl_idname = "gimp3d.clear_rois"
    bl_label = "Clear Boxes"

    def work(self, context: bpy.types.Context) -> None:
        context.scene.gimp3d.rois.clear()


class GIMP3D_OT_enlarge_roi(Edits, bpy.types.Operator):
    """Enlarge the box to hold what it cut off of the object, as the last preview or removal found it"""

    bl_idname = "gimp3d.enlarge_roi"
    bl_label = "Enlarge Box"

    def work(self, context: bpy.types.Context) -> None:
        settings, splat, cubes = context.scene.gimp3d, current_splat(context), current_boxes(context)
        box = proposed(context)[1]
        if box is None or splat is None or not cubes:
            raise BadInput("no box is proposed; run Preview Mask or Remove Object first")
        frame = bridge.splat_frame(splat)
        # the one that was enlarged lies within it
        cut = min(cubes, key=lambda c: np.linalg.norm(bridge.box_from_blender(c, frame).center - box.center))
        corners = np.array([tuple(c) for c in cut.bound_box])
        low, size = corners.min(0), np.ptp(corners, axis=0)
        turn = Quaternion(box.rotation_wxyz.tolist())
        placed = Matrix.LocRotScale(Vector(box.center), turn, Vector(box.size))
        unit = Matrix.LocRotScale(Vector(low + size / 2), None, Vector(size))
        cut.matrix_world = Matrix(frame.tolist()) @ placed @ unit.inverted()
        settings.proposed = ""


def proposed(context: bpy.types.Context) -> tuple[int, Box | None]:
    """How many splats of the object the box cut off, and the box that would hold them; the file may hold anything."""
    try:
        found = json.loads(context.scene.gimp3d.proposed or "{}")
        return int(found.get("gaussians", 0)), Box.make(**found["box"]) if found.get("box") else None
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError, BadInput):
        return 0, None

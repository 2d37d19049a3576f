"""The views: scene cameras, imported ones, or an orbit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import bpy
from bpy.props import EnumProperty, FloatProperty, IntProperty, StringProperty
from bpy_extras.io_utils import ImportHelper
from mathutils import Matrix, Vector

from gimp3d.camera import Camera
from gimp3d.errors import BadInput
from gimp3d.io.cameras import read_cameras
from gimp3d.orbit import orbit_cameras

from .. import bridge
from .base import ReportsErrors, current_boxes, current_splat, link

COLLECTION = "3D-GIMP views"


def add_cameras(context: bpy.types.Context, cameras: Sequence[Camera], splat: bpy.types.Object) -> None:
    """Blender cameras in their own collection, which becomes the scene's views."""
    collection = bpy.data.collections.new(COLLECTION)
    context.scene.collection.children.link(collection)
    frame = Matrix(bridge.splat_frame(splat).tolist())
    for camera in cameras:
        link(context, bridge.camera_to_blender(camera, frame), collection)
    settings = context.scene.gimp3d
    settings.views, settings.view_collection, settings.splat = "COLLECTION", collection, splat
    if context.scene.camera is None and collection.objects:
        context.scene.camera = collection.objects[0]


class GIMP3D_OT_import_cameras(ReportsErrors, bpy.types.Operator, ImportHelper):
    """Import the cameras of the photos (transforms.json, cameras.json or a COLMAP model) in the splat's frame"""

    bl_idname = "gimp3d.import_cameras"
    bl_label = "Import Cameras"
    bl_options = {"REGISTER", "UNDO"}

    filter_glob: StringProperty(default="*.json;*.bin;*.txt", options={"HIDDEN"})
    images: StringProperty(name="Photos", subtype="DIR_PATH", description="Folder of the photos, if not beside")
    split: EnumProperty(
        items=(("train", "Training", ""), ("test", "Test", ""), ("all", "All", "")),
        name="Frames",
        default="train",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Import the splat scene first: cameras are placed in its frame")
        return current_splat(context) is not None

    def work(self, context: bpy.types.Context) -> None:
        path = Path(bpy.path.abspath(self.filepath))
        if path.suffix in (".bin", ".txt"):
            path = path.parent  # a COLMAP model is a folder; the file browser picks one of its files
        images = Path(bpy.path.abspath(self.images)) if self.images else None
        cameras = [c for c in read_cameras(path, images) if self.split in ("all", c.split)]
        if not cameras:
            raise BadInput(f"{path} holds no {self.split} frame")
        add_cameras(context, cameras, current_splat(context))
        self.report({"INFO"}, f"{len(cameras)} cameras")


class GIMP3D_OT_add_views(ReportsErrors, bpy.types.Operator):
    """Make cameras round the region, for a scene that has none"""

    bl_idname = "gimp3d.add_views"
    bl_label = "Add Orbit Views"
    bl_options = {"REGISTER", "UNDO"}

    count: IntProperty(name="Views", default=24, min=1, max=300)
    width: IntProperty(name="Width", default=960, min=16, max=8192)
    height: IntProperty(name="Height", default=540, min=16, max=8192)
    fov: FloatProperty(name="Field of view", default=50.0, min=5, max=120, description="Horizontal, degrees")

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Import a splat scene and add a box first")
        return current_splat(context) is not None and bool(current_boxes(context))

    def work(self, context: bpy.types.Context) -> None:
        splat = current_splat(context)
        context.view_layer.update()
        frame = bridge.splat_frame(splat)
        region = [bridge.box_from_blender(b, frame) for b in current_boxes(context)]
        up = Matrix(frame.tolist()).to_3x3().inverted() @ Vector((0, 0, 1))  # Blender's up in the splat's frame
        cameras = orbit_cameras(region, self.count, tuple(up), self.width, self.height, self.fov)
        add_cameras(context, cameras, splat)


CLASSES = (GIMP3D_OT_import_cameras, GIMP3D_OT_add_views)

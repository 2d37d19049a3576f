"""The views: scene cameras, imported ones, or an orbit; and looking through them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty
from bpy_extras.io_utils import ImportHelper
from mathutils import Matrix, Vector

from gimp3d.camera import Camera
from gimp3d.errors import BadInput
from gimp3d.io.cameras import read_cameras
from gimp3d.orbit import measured_up, orbit_cameras

from .. import backdrops, bridge, charts, splats, trust
from ..chosen import current_boxes, current_splat
from .base import BOX, SPLAT, Edits, Need, link

COLLECTION = "3D-GIMP views"
DISPLAY_SHARE = 0.1  # of the cameras' spread: their frames are drawn so large that they do not hide the scene


def add_cameras(
    context: bpy.types.Context, cameras: Sequence[Camera], splat: bpy.types.Object, backgrounds: bool = False
) -> None:
    """Blender cameras in their own collection, which becomes the scene's views."""
    collection = bpy.data.collections.new(COLLECTION)
    context.scene.collection.children.link(collection)
    frame = Matrix(bridge.splat_frame(splat).tolist())
    apart = np.std([c.centre for c in cameras], axis=0).max() * frame.median_scale
    for number, camera in enumerate(cameras):
        obj = bridge.camera_to_blender(camera, frame, number)
        if len(cameras) > 1:
            obj.data.display_size = max(1e-6, DISPLAY_SHARE * apart)
        link(context, obj, collection)
        photo = bridge.photo_of(obj)
        if backgrounds and photo is not None:
            backdrops.put_behind(obj, bpy.data.images.load(str(photo), check_existing=True))
    settings = context.scene.gimp3d
    settings.views, settings.view_collection, settings.splat = "COLLECTION", collection, splat
    if context.scene.camera is None and collection.objects:
        context.scene.camera = collection.objects[0]


class GIMP3D_OT_import_cameras(Edits, bpy.types.Operator, ImportHelper):
    """Import the cameras of the photos (transforms.json, cameras.json or a COLMAP model) in the splat's frame"""

    bl_idname = "gimp3d.import_cameras"
    bl_label = "Import Cameras"
    needs = (SPLAT,)  # cameras are placed in its frame

    filter_glob: StringProperty(default="*.json;*.bin;*.txt", options={"HIDDEN"})
    images: StringProperty(name="Photos", subtype="DIR_PATH", description="Folder of the photos, if not beside")
    split: EnumProperty(
        items=(
            ("train", "Training", "Frames that the scene was made from"),
            ("test", "Test", "Frames that were held back"),
            ("all", "All", "All frames"),
        ),
        name="Frames",
        default="train",
    )
    backgrounds: BoolProperty(
        name="Photos as Backgrounds", default=True, description="Show each photo behind its camera's view"
    )

    def work(self, context: bpy.types.Context) -> None:
        path = Path(bpy.path.abspath(self.filepath))
        if path.suffix in (".bin", ".txt"):
            path = path.parent  # a COLMAP model is a folder; the file browser picks one of its files
        images = Path(bpy.path.abspath(self.images)) if self.images else None
        cameras = [c for c in read_cameras(path, images) if self.split in ("all", c.split)]
        if not cameras:
            raise BadInput(f"{path} holds no {self.split} frame")
        trust.know_photos(c.image for c in cameras if c.image is not None and c.image.is_file())
        add_cameras(context, cameras, current_splat(context), self.backgrounds)
        self.report({"INFO"}, f"{len(cameras)} cameras")


class GIMP3D_OT_add_views(Edits, bpy.types.Operator):
    """Make cameras round the region, for a scene that has none; the splats alone are enough"""

    bl_idname = "gimp3d.add_views"
    bl_label = "Add Orbit Views"
    needs = (SPLAT, BOX)

    count: IntProperty(name="Views", default=24, min=1, max=300, description="Cameras on three rings round the box")
    width: IntProperty(name="Width", default=960, min=16, max=8192, description="Of each view's picture, pixels")
    height: IntProperty(name="Height", default=540, min=16, max=8192, description="Of each view's picture, pixels")
    fov: FloatProperty(name="Field of view", default=50.0, min=5, max=120, description="Horizontal, degrees")
    up: EnumProperty(
        items=(
            ("FLOOR", "From the Floor", "Away from the floor under the box, where one is found; else as Z"),
            ("Z", "Z", "Blender's Z, for scenes that stand upright"),
        ),
        name="Up",
        default="FLOOR",
        description="What the rings of cameras stand round",
    )

    def work(self, context: bpy.types.Context) -> None:
        splat = current_splat(context)
        context.view_layer.update()
        frame = bridge.splat_frame(splat)
        region = [bridge.box_from_blender(b, frame) for b in current_boxes(context)]
        floor = measured_up(splats.read_object(splat).gaussians, region) if self.up == "FLOOR" else None
        blenders = Matrix(frame.tolist()).to_3x3().inverted() @ Vector((0, 0, 1))  # in the splat's frame
        up = blenders if floor is None else floor
        cameras = orbit_cameras(region, self.count, tuple(up), self.width, self.height, self.fov)
        add_cameras(context, cameras, splat)


class GIMP3D_OT_look_through(Edits, bpy.types.Operator):
    """Look through the next view; it becomes the active camera, and the render size becomes the view's own"""

    bl_idname = "gimp3d.look_through"
    bl_label = "Look Through View"
    needs = (Need("Step 3: add views first", lambda context: context.scene.gimp3d.views != "ANIMATED"),)

    step: IntProperty(name="Step", default=0, description="How many views on from the active camera; may be negative")
    camera: StringProperty(name="Camera", description="Name of a camera object; empty: by step")

    def work(self, context: bpy.types.Context) -> None:
        scene = context.scene
        cameras = bridge.chosen_cameras(scene)
        if not cameras:
            raise BadInput("no view to look through; add views (3D-GIMP panel, step 3)")
        if self.camera:
            found = next((c for c in [*cameras, *charts.of_scene(scene)] if c.name == self.camera), None)
            if found is None:
                raise BadInput(f"no view is called {self.camera}")
        else:
            at = cameras.index(scene.camera) + self.step if scene.camera in cameras else 0
            found = cameras[at % len(cameras)]
        scene.camera = found
        scene.render.resolution_x, scene.render.resolution_y = bridge.own_size(found, scene)
        scene.render.resolution_percentage = 100
        view = getattr(context, "region_data", None)
        if view is not None:
            view.view_perspective = "CAMERA"

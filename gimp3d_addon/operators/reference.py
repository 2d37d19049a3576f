"""Pictures of a view: the true rendering, the mask, and the reference that another tool may paint."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import bpy
import numpy as np
from bpy.props import StringProperty
from bpy_extras.io_utils import ExportHelper, ImportHelper

from gimp3d.errors import BadInput
from gimp3d.io.cameras import write_transforms
from gimp3d.io.ply import write_ply
from gimp3d.job import RemovalJob

from .. import bridge, jobs, splats
from ..worker import Worker
from .base import ReportsErrors, current_boxes, current_splat, python_of


def _camera(context: bpy.types.Context) -> bpy.types.Object:
    found = bridge.present(context.scene, context.scene.gimp3d.reference) or context.scene.camera
    if found is None:
        raise BadInput("no camera; choose a reference view or set the scene's active camera")
    return found


def _passing_folder() -> tempfile.TemporaryDirectory[str]:
    """Not a job folder: what lies here is read into the .blend at once, and scenes are large."""
    return tempfile.TemporaryDirectory(prefix="gimp3d-")


def _prepared(context: bpy.types.Context, folder: Path) -> tuple[RemovalJob, str]:
    """The scene as it is as a job, and the ID of the reference (else active) camera in it."""
    camera = _camera(context)
    settings = context.scene.gimp3d
    chosen, settings.reference = settings.reference, camera  # the camera must be among the job's views
    try:
        job = jobs.write_job(context, folder, with_photos=False)
    finally:
        settings.reference = chosen
    if not job.reference:
        raise BadInput(f"camera {camera.name} is not among the views")
    return job, job.reference


def _run(context: bpy.types.Context, *arguments: str) -> None:
    Worker([*arguments, "--progress", "none"], python_of(context)).wait()


def _picture(path: Path, name: str) -> bpy.types.Image:
    if not path.exists():
        raise BadInput(f"{path.name} was not made")
    if name in bpy.data.images:
        bpy.data.images.remove(bpy.data.images[name])
    image = bpy.data.images.load(str(path))
    image.name = name
    image.pack()
    return image


def _stem(camera_id: str) -> str:
    folder, _, tail = camera_id.rpartition("/")
    stem = tail.rsplit(".", 1)[0] if "." in tail[1:] else tail
    return f"{folder}/{stem}" if folder else stem


class GIMP3D_OT_render_view(ReportsErrors, bpy.types.Operator):
    """Draw the splats as they really look from the active camera, into the image '3D-GIMP view'"""

    bl_idname = "gimp3d.render_view"
    bl_label = "Render View"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Import a splat scene and add a camera first")
        return current_splat(context) is not None and context.scene.camera is not None

    def work(self, context: bpy.types.Context) -> None:
        splat, camera = current_splat(context), context.scene.camera
        context.view_layer.update()
        frame = bridge.splat_frame(splat)
        view = bridge.camera_from_blender(camera, frame, context.scene, context.evaluated_depsgraph_get(), "view")
        file = splats.read_object(splat)
        with _passing_folder() as name:
            ply, cameras = Path(name, "scene.ply"), Path(name, "transforms.json")
            write_ply(ply, file, np.ones(len(file.gaussians), bool))
            write_transforms(cameras, [view])
            _run(context, "render", str(ply), "--cameras", str(cameras), "--out", name)
            _picture(Path(name, "view.png"), "3D-GIMP view")


PREVIEWS = {"mask": "3D-GIMP hole", "depth": "3D-GIMP surface", "fit": "3D-GIMP depth prior"}


class GIMP3D_OT_preview_masks(ReportsErrors, bpy.types.Operator):
    """Show what will be filled in the reference (or active) camera and on what surface, as images '3D-GIMP …'"""

    bl_idname = "gimp3d.preview_masks"
    bl_label = "Preview Mask"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Import a splat scene and put a box round the object first")
        return current_splat(context) is not None and bool(current_boxes(context))

    def work(self, context: bpy.types.Context) -> None:
        with _passing_folder() as name:
            folder = Path(name)
            job, camera = _prepared(context, folder)
            pictures = folder / "pictures"
            _picture(_mask(context, folder, job, camera, "--pictures", str(pictures)), "3D-GIMP mask")
            for kind, title in PREVIEWS.items():
                drawn = pictures / f"{_stem(camera)}.{kind}.png"
                if drawn.exists():
                    _picture(drawn, title)


def _mask(context: bpy.types.Context, folder: Path, job: RemovalJob, name: str, *more: str) -> Path:
    mode = "paper" if job.preset == "paper" else "need"
    _run(
        context, "masks", job.scene, "--cameras", job.cameras, "--roi", job.roi, "--out", str(folder / "masks"),
        "--frames", name, "--mode", mode, "--depth-prior", job.depth_prior, *more,
    )  # fmt: skip
    return folder / "masks" / f"{_stem(name)}.png"


class GIMP3D_OT_choose_reference(ReportsErrors, bpy.types.Operator):
    """Make the active camera (or camera object) the reference view; without one the program chooses"""

    bl_idname = "gimp3d.choose_reference"
    bl_label = "Use This Camera"
    bl_options = {"REGISTER", "UNDO"}

    camera: StringProperty(name="Camera", description="Name of a camera object; empty: the selected or active one")

    def work(self, context: bpy.types.Context) -> None:
        if self.camera:
            found = bpy.data.objects.get(self.camera)
        else:
            active = context.active_object
            found = active if active is not None and active.type == "CAMERA" else context.scene.camera
        if found is None or found.type != "CAMERA":
            raise BadInput(f"no camera {self.camera or 'is active'}")
        context.scene.gimp3d.reference = found


class GIMP3D_OT_export_reference(ReportsErrors, bpy.types.Operator, ExportHelper):
    """Write the reference view and, beside it, the mask of what to paint; edit it in any tool and load it back"""

    bl_idname = "gimp3d.export_reference"
    bl_label = "Export Reference"
    filename_ext = ".png"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Import a splat scene and put a box round the object first")
        return current_splat(context) is not None and bool(current_boxes(context))

    def work(self, context: bpy.types.Context) -> None:
        target = Path(bpy.path.abspath(self.filepath))
        mask = target.with_name(f"{target.stem}.mask.png")
        target.parent.mkdir(parents=True, exist_ok=True)
        with _passing_folder() as folder:
            job, name = _prepared(context, Path(folder))
            shutil.copyfile(_mask(context, Path(folder), job, name), mask)
            out = Path(folder, "render")
            _run(context, "render", job.scene, "--cameras", job.cameras, "--out", str(out), "--frames", name)
            shutil.copyfile(out / f"{_stem(name)}.png", target)
        context.scene.gimp3d.reference = _camera(context)
        self.report({"INFO"}, f"{target.name} and {mask.name} written")


class GIMP3D_OT_load_reference(ReportsErrors, bpy.types.Operator, ImportHelper):
    """Use a picture of the reference view without the object"""

    bl_idname = "gimp3d.load_reference"
    bl_label = "Load Reference"
    bl_options = {"REGISTER", "UNDO"}

    filter_glob: StringProperty(default="*.png;*.jpg;*.jpeg;*.tif;*.tiff;*.webp", options={"HIDDEN"})

    def work(self, context: bpy.types.Context) -> None:
        path = Path(bpy.path.abspath(self.filepath))
        if not path.is_file():
            raise BadInput(f"the picture {path} does not exist")
        context.scene.gimp3d.reference = _camera(context)
        context.scene.gimp3d.reference_image = str(path)


CLASSES = (
    GIMP3D_OT_render_view,
    GIMP3D_OT_preview_masks,
    GIMP3D_OT_choose_reference,
    GIMP3D_OT_export_reference,
    GIMP3D_OT_load_reference,
)

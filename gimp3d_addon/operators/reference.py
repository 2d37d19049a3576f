"""Pictures of a view: the true rendering, the mask, and the reference that another tool may paint."""

from __future__ import annotations

import json
import shutil
import tempfile
from pathlib import Path

import bpy
import numpy as np
from bpy.props import StringProperty
from bpy_extras.io_utils import ExportHelper, ImportHelper

from gimp3d.camera import output_name
from gimp3d.errors import BadInput
from gimp3d.io.cameras import write_transforms
from gimp3d.io.ply import write_ply
from gimp3d.job import RemovalJob

from .. import backdrops, bridge, charts, jobs, splats
from ..chosen import current_splat, present
from ..worker import Worker
from .base import BOX, CAMERA, FAILURES, SPLAT, AsksFirst, Edits, RunsChild, light_words, python_of

PREVIEWS = {"mask": "hole", "depth": "surface", "fit": "depth prior", "shadow": "shadow"}
VIEW = "view"  # ID of the one camera that is drawn


def _camera(context: bpy.types.Context) -> bpy.types.Object:
    found = present(context.scene, context.scene.gimp3d.reference) or context.scene.camera
    if found is None:
        raise BadInput("no camera; choose a reference view or set the scene's active camera")
    return found


def _view(context: bpy.types.Context) -> bpy.types.Object:
    """The same, but never a chart: the first view then."""
    found = _camera(context)
    if not bridge.is_chart(found):
        return found
    views = [context.scene.camera, *bridge.chosen_cameras(context.scene)]
    return next((v for v in views if v is not None and not bridge.is_chart(v)), found)


class RunsInPassing(RunsChild):
    """Mixin: a child in a folder that goes with it: what it makes is read into the .blend, and scenes are large."""

    _folder: tempfile.TemporaryDirectory[str] | None = None

    def new_folder(self) -> Path:
        self._folder = tempfile.TemporaryDirectory(prefix="gimp3d-")
        return Path(self._folder.name)

    def tidy(self) -> None:
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None


class Looks(AsksFirst, RunsInPassing):
    """Mixin: shows what would be filled, for which the surface is completed."""

    needs = (SPLAT, BOX)

    def providers(self, context: bpy.types.Context) -> tuple[str, ...]:
        return (context.scene.gimp3d.depth_prior,)


def _draw(context: bpy.types.Context, camera: bpy.types.Object, folder: Path) -> Worker:
    """Draws the splats as they really look from a camera into `folder`/view.png."""
    splat = current_splat(context)
    context.view_layer.update()
    frame = bridge.splat_frame(splat)
    view = bridge.camera_from_blender(camera, frame, context.scene, context.evaluated_depsgraph_get(), VIEW)
    file = splats.read_object(splat)
    ply, cameras = folder / "scene.ply", folder / "transforms.json"
    write_ply(ply, file, np.ones(len(file.gaussians), bool))
    write_transforms(cameras, [view])
    arguments = ["render", str(ply), "--cameras", str(cameras), "--out", str(folder), "--progress", "json"]
    return Worker(arguments, python_of(context))


def _look(context: bpy.types.Context, camera: bpy.types.Object, folder: Path) -> tuple[Worker, str]:
    """Draws what a removal would fill in a view, and on what surface; returns the view's ID too."""
    settings = context.scene.gimp3d
    chosen, settings.reference = settings.reference, camera  # the camera must be among the job's views
    try:
        job: RemovalJob = jobs.write_job(context, folder)
    finally:
        settings.reference = chosen
    if not job.reference:
        raise BadInput(f"camera {camera.name} is not among the views")
    mode = "paper" if job.preset == "paper" else "need"
    arguments = [
        "masks", job.scene, "--cameras", job.cameras, "--roi", job.roi, "--out", str(folder / "masks"),
        "--frames", job.reference, "--mode", mode, "--depth-prior", job.depth_prior,
        "--pictures", str(folder / "pictures"), "--progress", "json",
        *(("--images", job.images) if job.images else ()), *(("--grow",) if job.grow else ()),
        "--shadow", job.shadow, *(("--shadow-masks", job.shadow_masks) if job.shadow_masks else ()),
    ]  # fmt: skip
    return Worker(arguments, python_of(context)), output_name(job.reference)


class DrawsView(RunsInPassing):
    """Mixin: draws the splats as they really look from one camera; `take` gets the picture."""

    def start(self, context: bpy.types.Context) -> Worker:
        camera = self.camera(context)
        self._camera = camera.name
        return _draw(context, camera, self.new_folder())

    def collect(self, context: bpy.types.Context) -> None:
        self.worker.result()
        self.take(context, Path(self._folder.name, f"{VIEW}.png"))

    def camera(self, context: bpy.types.Context) -> bpy.types.Object:
        return context.scene.camera

    def take(self, context: bpy.types.Context, picture: Path) -> None:
        raise NotImplementedError


class GIMP3D_OT_render_view(DrawsView, bpy.types.Operator):
    """Draw the splats as they really look from the active camera: over its view and in the image '3D-GIMP view'"""

    bl_idname = "gimp3d.render_view"
    bl_label = "Show True Picture"
    bl_options = {"UNDO"}
    needs = (SPLAT, CAMERA)

    def take(self, context: bpy.types.Context, picture: Path) -> None:
        _show(context, self._camera, backdrops.load_picture(picture, VIEW))


def _show(context: bpy.types.Context, camera: str, image: bpy.types.Image) -> None:
    obj = context.scene.objects.get(camera)
    if obj is not None:
        backdrops.put_over(obj, image)
    backdrops.show_in_image_editor(context, image)


class GIMP3D_OT_preview_masks(Looks, bpy.types.Operator):
    """Show over the reference (else active) camera's view what will be filled; also as images '3D-GIMP …'"""

    bl_idname = "gimp3d.preview_masks"
    bl_label = "Preview Mask"
    bl_options = {"UNDO"}

    def start(self, context: bpy.types.Context) -> Worker:
        camera = _view(context)
        self._camera = camera.name
        worker, self._stem = _look(context, camera, self.new_folder())
        return worker

    def collect(self, context: bpy.types.Context) -> None:
        self.worker.result()
        folder = Path(self._folder.name)
        mask = backdrops.load_picture(folder / "masks" / f"{self._stem}.png", "mask")
        shown, pixels = mask, np.empty(4 * mask.size[0] * mask.size[1], np.float32)
        mask.pixels.foreach_get(pixels)
        context.scene.gimp3d.proposed = (folder / "pictures" / "proposed.json").read_text(encoding="utf-8")
        facts = json.loads((folder / "pictures" / "light.json").read_bytes())
        context.scene.gimp3d.shadow_found = light_words(facts["shadow"], facts["reflection"])
        context.scene.gimp3d.hole = f"{np.count_nonzero(pixels[::4] > 0.5):,} pixels in {self._camera}"
        for kind, title in PREVIEWS.items():
            drawn = folder / "pictures" / f"{self._stem}.{kind}.png"
            if drawn.exists():
                image = backdrops.load_picture(drawn, title)
                shown = image if kind == "mask" else shown
        _show(context, self._camera, shown)
        if bridge.is_view(context.scene, context.scene.objects.get(self._camera)):  # else a removal has other charts
            charts.show(context, folder / "pictures" / "charts", current_splat(context))


class GIMP3D_OT_hide_previews(Edits, bpy.types.Operator):
    """Take the previews and true pictures off all cameras; photos stay"""

    bl_idname = "gimp3d.hide_previews"
    bl_label = "Hide Previews"

    def work(self, context: bpy.types.Context) -> None:
        for obj in context.scene.objects:
            if obj.type == "CAMERA":
                backdrops.take_away(obj)


class GIMP3D_OT_choose_reference(Edits, bpy.types.Operator):
    """Make the active camera (or camera object) the reference view; without one the program chooses"""

    bl_idname = "gimp3d.choose_reference"
    bl_label = "Use This Camera"

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


class RunsReference(Looks):
    """Mixin: a child for the mask, then one for the picture of the reference view; `deliver` takes both files.

    A chart's are there already, and no child is needed.
    """

    _drawing = False

    def execute(self, context: bpy.types.Context) -> set[str]:
        chart = present(context.scene, context.scene.gimp3d.reference) or context.scene.camera
        if not bridge.is_chart(chart):
            return super().execute(context)
        try:
            self.deliver(context, *charts.save(chart, self.new_folder()))
        except FAILURES as error:
            return self._failed(error)
        context.scene.gimp3d.reference = chart
        self.tidy()
        return {"FINISHED"}

    def start(self, context: bpy.types.Context) -> Worker:
        camera = _camera(context)
        self._camera, folder = camera.name, self.new_folder()
        worker, self._stem = _look(context, camera, folder)
        return worker

    def collect(self, context: bpy.types.Context) -> Worker | None:
        self.worker.result()
        folder = Path(self._folder.name)
        camera = context.scene.objects.get(self._camera)
        if camera is None:
            raise BadInput(f"camera {self._camera} is no longer in the scene")
        if not self._drawing:
            self._drawing = True
            return _draw(context, camera, folder)
        context.scene.gimp3d.reference = camera
        self.deliver(context, folder / f"{VIEW}.png", folder / "masks" / f"{self._stem}.png")
        return None

    def deliver(self, context: bpy.types.Context, picture: Path, mask: Path) -> None:
        raise NotImplementedError


class GIMP3D_OT_export_reference(RunsReference, bpy.types.Operator, ExportHelper):
    """Write the reference view and, beside it, the mask of what to paint; edit it in any tool and load it back"""

    bl_idname = "gimp3d.export_reference"
    bl_label = "Export Reference"
    filename_ext = ".png"

    def ask(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return ExportHelper.invoke(self, context, event)

    def deliver(self, context: bpy.types.Context, picture: Path, mask: Path) -> None:
        target = Path(bpy.path.abspath(self.filepath))
        beside = target.with_name(f"{target.stem}.mask.png")
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(picture, target)
        shutil.copyfile(mask, beside)
        self.report({"INFO"}, f"{target.name} and {beside.name} written")


class GIMP3D_OT_paint_reference(RunsReference, bpy.types.Operator):
    """Put the reference view into the image '3D-GIMP reference', to be painted in the Image Editor; Remove uses it"""

    bl_idname = "gimp3d.paint_reference"
    bl_label = "Paint in Blender"
    bl_options = {"UNDO"}

    def deliver(self, context: bpy.types.Context, picture: Path, mask: Path) -> None:
        backdrops.load_picture(mask, "mask")
        image = backdrops.load_picture(picture, "reference")
        context.scene.gimp3d.reference_paint = image
        backdrops.show_in_image_editor(context, image)


class GIMP3D_OT_paint_shadow(DrawsView, bpy.types.Operator):
    """Put the view into the image '3D-GIMP shadow paint': paint over the shadow, in any colour, and it is undone"""

    bl_idname = "gimp3d.paint_shadow"
    bl_label = "Paint Shadow"
    bl_options = {"UNDO"}
    needs = (SPLAT,)

    def camera(self, context: bpy.types.Context) -> bpy.types.Object:
        camera = _view(context)
        if not bridge.is_view(context.scene, camera):
            raise BadInput(f"camera {camera.name} is not among the views")
        return camera

    def take(self, context: bpy.types.Context, picture: Path) -> None:
        settings = context.scene.gimp3d
        backdrops.load_picture(picture, jobs.SHADOW_BEFORE)
        image = backdrops.load_picture(picture, "shadow paint")
        settings.shadow, settings.shadow_paint = "mask", image
        settings.shadow_camera = context.scene.objects.get(self._camera)
        backdrops.show_in_image_editor(context, image)


class GIMP3D_OT_load_reference(Edits, bpy.types.Operator, ImportHelper):
    """Use a picture of the reference view without the object"""

    bl_idname = "gimp3d.load_reference"
    bl_label = "Load Reference"

    filter_glob: StringProperty(default="*.png;*.jpg;*.jpeg;*.tif;*.tiff;*.webp", options={"HIDDEN"})

    def work(self, context: bpy.types.Context) -> None:
        path = Path(bpy.path.abspath(self.filepath))
        if not path.is_file():
            raise BadInput(f"the picture {path} does not exist")
        settings = context.scene.gimp3d
        settings.reference, settings.reference_image, settings.reference_paint = _camera(context), str(path), None

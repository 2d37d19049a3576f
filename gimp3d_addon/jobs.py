"""Job folders made from the Blender scene: everything the core needs, in files that can be run anywhere."""

from __future__ import annotations

import json
import shutil
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from gimp3d.camera import Camera, output_name
from gimp3d.errors import BadInput
from gimp3d.io.cameras import write_transforms
from gimp3d.io.ply import write_ply
from gimp3d.job import RemovalJob, save_job, write_atomically

from . import backdrops, bridge, splats
from .operators.base import current_boxes, current_splat
from .properties import GIMP3D_preferences

SHADOW_BEFORE = "shadow before"  # the view as it was before its shadow was painted over
STATE = "blender.json"  # in a job's folder: what Blender wants back from it


def jobs_folder() -> Path:
    """Beside the saved .blend, else in the extension's user folder: never where it dies with Blender."""
    if bpy.data.filepath:
        return Path(bpy.data.filepath).parent / "gimp3d_jobs"
    package = GIMP3D_preferences.bl_idname
    if package.startswith("bl_ext."):
        return Path(bpy.utils.extension_path_user(package, path="jobs", create=True))
    return Path(bpy.utils.user_resource("DATAFILES", path="gimp3d/jobs", create=True))


def new_job_folder(name: str) -> Path:
    clean = "".join(c if c.isalnum() or c in "-_" else "_" for c in name) or "scene"
    root = jobs_folder()
    number = 1
    while (root / f"{clean}-{number:03d}").exists():
        number += 1
    return root / f"{clean}-{number:03d}"


def open_for(folder: Path, splat: bpy.types.Object) -> None:
    """Note in a job's folder which object it is about, and that its result is still to come."""
    _write_state(folder, {"source": splat.name, "matrix": [list(r) for r in splat.matrix_world], "open": True})


def close(folder: Path) -> None:
    """The job's result is in the scene, or there will be none."""
    _write_state(folder, {**_state(folder), "open": False})


def source_of(folder: Path) -> tuple[str, list[list[float]]]:
    """The name and the matrix of the object that a job is about."""
    state = _state(folder)
    return state["source"], state["matrix"]


def unfinished(context: bpy.types.Context) -> Path | None:
    """The last job of this scene, else the newest beside the file, if its result never came."""
    known = context.scene.gimp3d.last_job
    found = [Path(known)] if known else []
    with suppress(OSError):
        found += sorted(jobs_folder().iterdir(), key=lambda p: -p.stat().st_mtime)[:1]
    return next((f for f in found if _state(f).get("open")), None)


def _state(folder: Path) -> dict[str, Any]:
    try:
        return json.loads((folder / STATE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def _write_state(folder: Path, state: dict[str, Any]) -> None:
    write_atomically(folder / STATE, lambda f: f.write(json.dumps(state).encode()))


def write_job(context: bpy.types.Context, folder: Path) -> RemovalJob:
    """The scene, cameras, region, photos and settings as a job folder; returns the job with absolute paths.

    Raises
    ------
    BadInput
        If something is missing or cannot be used, with what to do.
    """
    settings = context.scene.gimp3d
    splat, boxes = current_splat(context), current_boxes(context)
    if splat is None:
        raise BadInput("no splat object; import a PLY first (3D-GIMP panel, step 1)")
    if not boxes:
        raise BadInput("no box round the object; add one (3D-GIMP panel, step 2)")
    context.view_layer.update()
    frame = bridge.splat_frame(splat)
    region = [bridge.box_from_blender(b, frame).to_json() for b in boxes]
    wanted = bridge.present(context.scene, settings.reference)
    reference = f"chart:{wanted[bridge.CHART]}" if bridge.is_chart(wanted) else ""
    views = list(bridge.views_of(context, frame))
    for camera, obj in views:
        if wanted is not None and obj == wanted and not reference:
            reference = camera.id
    painted = settings.reference_paint
    picture = bpy.path.abspath(settings.reference_image) if settings.reference_image and painted is None else ""
    if picture and not Path(picture).is_file():
        raise BadInput(f"the reference picture {picture} does not exist")
    if (picture or painted is not None) and not reference:
        raise BadInput("a reference picture needs its camera; choose the reference view")
    shaded = next((camera for camera, obj in views if obj == settings.shadow_camera), None)
    painted_shadow = settings.shadow == "mask"
    if painted_shadow and (shaded is None or settings.shadow_paint is None):
        raise BadInput("the shadow is to be as painted, but none is: press Paint Shadow, or choose Undo or Leave")
    file = splats.read_object(splat)
    folder.mkdir(parents=True, exist_ok=True)
    if painted_shadow:
        mask = backdrops.painted_over(settings.shadow_paint, SHADOW_BEFORE)
        backdrops.save_mask(mask, folder / "shadows" / f"{output_name(shaded.id)}.png")
    write_ply(folder / "scene.ply", file, np.ones(len(file.gaussians), bool))
    write_transforms(folder / "transforms.json", [_with_photo(c, folder) for c, _ in views])
    write_atomically(folder / "roi.json", lambda f: f.write(json.dumps(region, indent=1).encode()))
    if picture:
        shutil.copy2(picture, folder / f"reference{Path(picture).suffix}")
    if painted is not None:
        picture = str(folder / "reference.png")
        painted.save(filepath=picture, save_copy=True)
    job = RemovalJob(
        scene=str(folder / "scene.ply"),
        cameras=str(folder / "transforms.json"),
        roi=str(folder / "roi.json"),
        out=str(folder / "out.ply"),
        images=None if any(bridge.has_photo(obj) for _, obj in views) else "none",
        reference=reference or None,
        reference_image=str(folder / f"reference{Path(picture).suffix}") if picture else None,
        inpaint=settings.inpaint,
        depth_prior=settings.depth_prior,
        preset=settings.preset,
        report=str(folder / "report"),
        summary=str(folder / "summary.json"),
        seed=settings.seed,
        grow=settings.grow,
        shadow=settings.shadow,
        shadow_masks=str(folder / "shadows") if painted_shadow else None,
    )
    save_job(folder, job)
    return job


def _with_photo(camera: Camera, folder: Path) -> Camera:
    """The camera with its photo copied into the job, under an ID that names the file."""
    if camera.image is None or not camera.image.is_file():
        return camera
    name = camera.id if Path(camera.id).suffix else camera.id + camera.image.suffix
    target = folder / name
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy2(camera.image, target)
    return replace(camera, image=target)

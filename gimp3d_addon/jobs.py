"""Job folders made from the Blender scene: everything the core needs, in files that can be run anywhere."""

from __future__ import annotations

import filecmp
import hashlib
import json
import os
import shutil
import time
import uuid
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import count
from pathlib import Path

import bpy
import numpy as np

from gimp3d.camera import Camera, output_name
from gimp3d.errors import BadInput
from gimp3d.files import write_json
from gimp3d.io.cameras import write_transforms
from gimp3d.io.ply import write_ply
from gimp3d.job import RemovalJob, save_job

from . import backdrops, bridge, splats, trust
from .chosen import current_boxes, current_splat, present
from .installation import user_folder
from .lock import is_held
from .properties import GIMP3D_PG_settings

SHADOW_BEFORE = "shadow before"  # the view as it was before its shadow was painted over
LOCK = "lock"  # in a job's folder: held by the process that works on it
PHOTOS = "photos"  # in a job's folder


@dataclass(frozen=True)
class Record:
    """A job that this machine wrote. It is kept in Blender's user folder: a folder beside a .blend may be anybody's."""

    folder: str
    digest: str  # SHA-256 of its job.json: another one was not written here
    blend: str  # the file that it belongs to; empty: never saved then
    scene: str  # ID of the scene
    scene_name: str  # tells copies of a scene apart, which share the ID
    source: str  # ID of the splat object
    source_name: str
    matrix: tuple[tuple[float, ...], ...]  # the object's, for where it is lost
    started: float  # s since 1970
    providers: tuple[str, ...]  # the job's own: the scene may name others by now
    open: bool = True  # its result is still to come


def jobs_folder() -> Path:
    """Beside the saved .blend, else in the extension's user folder: never where it dies with Blender."""
    return Path(bpy.data.filepath).parent / "gimp3d_jobs" if bpy.data.filepath else user_folder("jobs")


def new_job_folder(name: str) -> Path:
    """A folder of its own, made now, so that another Blender takes another one."""
    clean = "".join(c if c.isalnum() or c in "-_" else "_" for c in name) or "scene"
    for number in count(1):
        folder = jobs_folder() / f"{clean}-{number:03d}"
        with suppress(FileExistsError):
            folder.mkdir(parents=True)
            return folder


def open_for(context: bpy.types.Context, folder: Path, splat: bpy.types.Object) -> None:
    """Note in this user's own record what a job, just written, belongs to, and that its result is still to come."""
    identify(context.scene, splat)
    settings, matrix = context.scene.gimp3d, tuple(tuple(row) for row in splat.matrix_world)
    owner = (bpy.data.filepath, settings.id, context.scene.name, splat[splats.ID], splat.name)
    providers = (settings.inpaint, settings.depth_prior)
    _write(Record(str(folder.resolve()), _digest(folder), *owner, matrix, time.time(), providers))


def close(folder: Path) -> None:
    """The job's result is in the scene, or there will be none: what it could be resumed from is of no more use."""
    shutil.rmtree(folder / "stages", ignore_errors=True)
    record = record_of(folder)
    if record is not None:
        _write(replace(record, open=False))


def identify(scene: bpy.types.Scene, splat: bpy.types.Object) -> None:
    """IDs of their own for the scene and the object; copies get new ones."""
    settings = scene.gimp3d
    if not settings.id or any(s != scene and s.gimp3d.id == settings.id for s in bpy.data.scenes):
        settings.id = uuid.uuid4().hex
    known = splat.get(splats.ID)
    if not known or any(o != splat and o.get(splats.ID) == known for o in bpy.data.objects):
        splat[splats.ID] = uuid.uuid4().hex


def source_in(scene: bpy.types.Scene, record: Record) -> bpy.types.Object | None:
    """The object that a job is about, if the scene still has it."""
    found = [o for o in scene.objects if splats.is_splat(o) and o.get(splats.ID) == record.source]
    return found[0] if len(found) == 1 else next((o for o in found if o.name == record.source_name), None)


def unfinished(context: bpy.types.Context) -> Path | None:
    """The last job of this scene in this file, if it was stopped and no process is at work on it."""
    last = next((r for r in reversed(of_file(context)) if _of_scene(context.scene, r)), None)
    if last is None or not last.open or not _is_unchanged(last) or is_held(Path(last.folder) / LOCK):
        return None
    return Path(last.folder)


def of_file(context: bpy.types.Context) -> list[Record]:
    """The jobs of the open file that are still there, oldest first; also those from before its first save."""
    ids = {s.gimp3d.id for s in bpy.data.scenes}
    mine = (r for r in _records() if r.scene in ids and r.blend in ("", bpy.data.filepath))
    return sorted((r for r in mine if Path(r.folder).is_dir()), key=lambda r: r.started)


def of_lost_files() -> list[Record]:
    """Jobs whose .blend is gone, or was never saved and is a day old: nobody else would ever delete them."""
    ids, yesterday = {s.gimp3d.id for s in bpy.data.scenes}, time.time() - 86400
    there = (r for r in _records() if r.scene not in ids and Path(r.folder).is_dir())
    return [r for r in there if (not Path(r.blend).exists() if r.blend else r.started < yesterday)]


def record_of(folder: Path) -> Record | None:
    """What is known of a job; None if this machine did not write it."""
    here = str(folder.resolve())
    return next((r for r in _records() if r.folder == here), None)


def is_first() -> bool:
    """Whether no job of this machine is known, so that its kernels may have to be compiled."""
    return not _records()


def is_own_report(path: Path) -> bool:
    """Whether a page is the report of a job that this machine wrote: the .blend names it, and may name anything."""
    return path.name == "index.html" and path.parent.name == "report" and record_of(path.parents[1]) is not None


def delete(record: Record) -> None:
    """Delete a job's folder. Files that other jobs share stay theirs.

    Raises
    ------
    BadInput
        If a process is at work on it, or the folder is no longer what this machine wrote.
    """
    folder = Path(record.folder)
    if is_held(folder / LOCK):
        raise BadInput(f"{folder} is at work; cancel it first")
    if not _is_unchanged(record):
        raise BadInput(f"{folder} holds another job than was written there; look at it, and delete it yourself")
    shutil.rmtree(folder)
    _path_of(folder).unlink(missing_ok=True)


def size(records: Iterable[Record]) -> int:
    """Bytes on the disk; what jobs share counts once."""
    found = {}
    for record in records:
        for folder, _, names in os.walk(record.folder):
            for name in names:
                with suppress(OSError):
                    status = os.lstat(os.path.join(folder, name))
                    found[status.st_dev, status.st_ino] = status.st_size
    return sum(found.values())


def _of_scene(scene: bpy.types.Scene, record: Record) -> bool:
    alike = [s for s in bpy.data.scenes if s.gimp3d.id == record.scene]
    return scene in alike and (len(alike) == 1 or scene.name == record.scene_name)


def _is_unchanged(record: Record) -> bool:
    try:
        return _digest(Path(record.folder)) == record.digest
    except OSError:
        return False


def _digest(folder: Path) -> str:
    return hashlib.sha256((folder / "job.json").read_bytes()).hexdigest()


def _path_of(folder: Path) -> Path:
    return user_folder("record") / f"{hashlib.sha256(str(folder).encode()).hexdigest()[:32]}.json"


def _write(record: Record) -> None:
    write_json(_path_of(Path(record.folder)), asdict(record))
    _last.clear()


_last: dict[str, tuple[int, list[Record]]] = {}  # a panel asks many times a second


def _records() -> list[Record]:
    """All that this machine wrote."""
    folder = user_folder("record")
    changed = folder.stat().st_mtime_ns
    if _last.get("", (0, []))[0] != changed:
        _last[""] = changed, list(_read_all(folder))
    return _last[""][1]


def _read_all(folder: Path) -> Iterator[Record]:
    for path in folder.glob("*.json"):
        with suppress(OSError, ValueError, TypeError):  # a damaged one is none
            yield Record(**json.loads(path.read_text(encoding="utf-8")))


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
    views = list(bridge.views_of(context, frame))
    reference = _reference_id(context.scene, views)
    picture = _reference_picture(settings, reference)
    shaded = _shaded_view(settings, views)
    file = splats.read_object(splat)
    folder.mkdir(parents=True, exist_ok=True)
    if shaded is not None:
        mask = backdrops.painted_over(settings.shadow_paint, SHADOW_BEFORE)
        backdrops.save_mask(mask, folder / "shadows" / f"{output_name(shaded.id)}.png")
    write_ply(folder / "scene.ply", file, np.ones(len(file.gaussians), bool))
    write_transforms(folder / "transforms.json", [_with_photo(c, folder / PHOTOS) for c, _ in views])
    write_json(folder / "roi.json", region)
    copied = folder / f"reference{picture.suffix or '.png'}"
    if settings.reference_paint is not None:
        settings.reference_paint.save(filepath=str(copied), save_copy=True)
    elif picture.name:
        shutil.copyfile(picture, copied)
    job = RemovalJob(
        *(str(folder / name) for name in ("scene.ply", "transforms.json", "roi.json", "out.ply")),
        images=str(folder / PHOTOS) if (folder / PHOTOS).is_dir() else "none",
        reference=reference or None,
        reference_image=str(copied) if picture.name or settings.reference_paint is not None else None,
        report=str(folder / "report"),
        summary=str(folder / "summary.json"),
        shadow_masks=str(folder / "shadows") if shaded is not None else None,
        **{name: getattr(settings, name) for name in ("inpaint", "depth_prior", "preset", "seed", "grow", "shadow")},
    )
    save_job(folder, job)
    return job


Views = list[tuple[Camera, bpy.types.Object]]


def _reference_id(scene: bpy.types.Scene, views: Views) -> str:
    """The chosen reference as the command line names it; empty: the program chooses."""
    wanted = present(scene, scene.gimp3d.reference)
    if bridge.is_chart(wanted):
        return f"chart:{wanted[bridge.CHART]}"
    found = [camera.id for camera, obj in views if wanted is not None and obj == wanted]
    return found[-1] if found else ""


def _reference_picture(settings: GIMP3D_PG_settings, reference: str) -> Path:
    """The file of the reference without the object; empty where there is none, or it was painted in Blender."""
    picture = Path()
    if settings.reference_image and settings.reference_paint is None:
        picture = Path(bpy.path.abspath(settings.reference_image))
        if not trust.is_known_photo(picture):
            raise BadInput(
                f"the reference picture {picture} does not exist, or this file brought it along; load it again"
            )
    if (picture.name or settings.reference_paint is not None) and not reference:
        raise BadInput("a reference picture needs its camera; choose the reference view")
    return picture


def _shaded_view(settings: GIMP3D_PG_settings, views: Views) -> Camera | None:
    """The view whose shadow was painted over, if that is to be undone."""
    if settings.shadow != "mask":
        return None
    shaded = next((camera for camera, obj in views if obj == settings.shadow_camera), None)
    if shaded is None or settings.shadow_paint is None:
        raise BadInput("the shadow is to be as painted, but none is: press Paint Shadow, or choose Undo or Leave")
    return shaded


def share_scene(folder: Path) -> None:
    """Let the job's scene be the same file as that of a job beside it, where they are alike to the byte."""
    scene, beside = folder / "scene.ply", (Path(r.folder) for r in _records())
    others = (b / name for b in beside if b.parent == folder.resolve().parent for name in ("scene.ply", "out.ply"))
    for other in others:
        with suppress(OSError):  # gone, or on another disk, or one without links
            if other.samefile(scene):
                return
            if other.stat().st_size == scene.stat().st_size and filecmp.cmp(other, scene, shallow=False):
                link = folder / ".scene.link"
                os.link(other, link)
                os.replace(link, scene)  # both write anew, never in place
                return


def _with_photo(camera: Camera, folder: Path) -> Camera:
    """The camera with its photo copied into a folder of the job's photos alone, under an ID that names the file."""
    if camera.image is None:
        return camera
    name = camera.id if Path(camera.id).suffix else camera.id + camera.image.suffix
    target = folder / name
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(camera.image, target)
    return replace(camera, image=target)

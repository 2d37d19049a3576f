"""Blender objects ↔ gimp3d types. The one place where Blender's axes, units and lenses become K and [R|t].

The core works in the splat object's local frame, which is the file's: cameras and boxes are brought there, splats never
move. A uniform scale of the object changes depths, not pictures.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath

import bpy
import numpy as np
from mathutils import Matrix, Vector

from gimp3d.box import Box, box_from_matrix
from gimp3d.camera import Camera, Distortion, output_name
from gimp3d.errors import BadInput
from gimp3d.io.cameras import make_camera, rigid

from . import trust
from .chosen import present

BLENDER_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # a camera's own axes: y up, z backward → y down, z forward
CAMERA = "gimp3d_camera"  # custom property of imported cameras: exact intrinsics, ID and photo as JSON
CHART = "gimp3d_chart"  # custom property of cameras that face a hidden surface: N of the reference chart:N
SENSOR = 36.0  # mm, of imported cameras
STRAIGHT = 1e-6  # from here on a turn is meant: Blender's own quarter turns are off by 4e-8


def splat_frame(obj: bpy.types.Object) -> np.ndarray:
    """The object's local→world matrix [4, 4].

    Raises
    ------
    BadInput
        If it mirrors, shears or scales unevenly: SH and covariances would have to change with it.
    """
    matrix = np.array(obj.matrix_world, dtype=np.float64)
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    if lengths.min() < 1e-12 or lengths.max() / lengths.min() > 1.0001:
        raise BadInput(f"{obj.name} is scaled unevenly; give it the same scale on all axes (Object > Clear > Scale)")
    axes = matrix[:3, :3] / lengths
    if np.abs(axes.T @ axes - np.eye(3)).max() > 1e-4 or np.linalg.det(axes) < 0:
        raise BadInput(f"{obj.name} is mirrored or sheared; clear its scale (Object > Clear > Scale)")
    if np.abs(axes - np.round(axes)).max() < STRAIGHT:
        matrix[:3, :3] = np.round(axes) * _typed(lengths)
    return matrix


def _typed(numbers: np.ndarray) -> np.ndarray:
    """float32 numbers as a user would write them: 0.1 for 0.10000000149, and 0 for what a quarter turn leaves of it."""
    there = np.abs(numbers) > 1e-7 * np.abs(numbers).max()
    return np.array([float(str(np.float32(n))) if t else 0.0 for n, t in zip(numbers, there)])


def camera_from_blender(
    obj: bpy.types.Object,
    frame: np.ndarray,  # [4, 4] local→world of the splat object
    scene: bpy.types.Scene,
    depsgraph: bpy.types.Depsgraph,
    name: str | None = None,
) -> Camera:
    """A Blender camera in the splat's frame, as the scene's render settings frame it.

    Sensor fit, shift, pixel aspect and resolution percentage come out of Blender's own projection matrix. A frame of an
    animated camera has a `name`. An imported camera keeps its exact intrinsics, and its photo while it stays in place.

    Raises
    ------
    BadInput
        If it is not a perspective camera.
    """
    _require_perspective(obj)
    pose = np.array(obj.evaluated_get(depsgraph).matrix_world, dtype=np.float64)
    local = np.linalg.inv(frame) @ pose
    u, _, vt = np.linalg.svd(local[:3, :3])
    rotation = u @ vt  # without the camera's and the splat's scale
    if np.linalg.det(rotation) < 0:
        raise BadInput(f"camera {obj.name} is mirrored; clear its scale")
    to_local = np.eye(4)
    to_local[:3, :3], to_local[:3, 3] = rotation, local[:3, 3]
    viewmat = np.linalg.inv(to_local @ BLENDER_TO_OPENCV)
    stored = imported(obj)
    if stored is not None:
        there = name is None and not _moved(viewmat, stored.viewmat, frame)
        return replace(
            stored,
            id=name or stored.id,
            viewmat=stored.viewmat if there else viewmat,  # to the last bit, which Blender's float32 does not keep
            image=photo_of(obj) if there else None,
        )
    render = scene.render
    width, height = render_size(scene)
    p = obj.calc_matrix_camera(
        depsgraph, x=width, y=height, scale_x=render.pixel_aspect_x, scale_y=render.pixel_aspect_y
    )
    fx, fy = width / 2 * p[0][0], height / 2 * p[1][1]
    cx, cy = width / 2 * (1 - p[0][2]), height / 2 * (1 + p[1][2])
    return Camera(name or safe_name(obj.name), width, height, fx, fy, cx, cy, viewmat)


def _require_perspective(obj: bpy.types.Object) -> None:
    if obj.data.type != "PERSP":
        raise BadInput(f"camera {obj.name} is {obj.data.type.lower()}; only perspective cameras can be views")


def render_size(scene: bpy.types.Scene) -> tuple[int, int]:
    """Width and height of the scene's renders, pixels."""
    render = scene.render
    share = render.resolution_percentage / 100
    return max(1, int(render.resolution_x * share)), max(1, int(render.resolution_y * share))


def own_size(obj: bpy.types.Object, scene: bpy.types.Scene) -> tuple[int, int]:
    """Width and height of a camera's picture: an imported one has its own."""
    stored = imported(obj)
    return render_size(scene) if stored is None else (stored.width, stored.height)


def imported(obj: bpy.types.Object) -> Camera | None:
    """The camera that an object was imported as; None for the user's own.

    Checked here once: the property came with the .blend, and may hold anything. Its photo may lie anywhere, see
    `photo_of`.

    Raises
    ------
    BadInput
        If it is damaged, or its ID leads out of the folders that files are named by it in.
    """
    return _stored(str(obj[CAMERA]), obj.name)[0] if CAMERA in obj else None


@lru_cache(maxsize=4096)  # a panel asks many times a second
def _stored(text: str, name: str) -> tuple[Camera, int]:
    """The camera that a property describes, and its place in the file."""
    where = f"camera {name}"
    try:
        stored = json.loads(text)
        viewmat = np.array(stored["viewmat"], np.float64)
        rigid(viewmat, where)  # a check: what is stored keeps its bits
        distortion = Distortion(*map(float, stored["distortion"] or ()))
        size = int(stored["width"]), int(stored["height"])
        lens = float(stored["fx"]), float(stored["fy"]), float(stored["cx"]), float(stored["cy"])
        split, image = str(stored["split"]), Path(stored["image"]) if stored["image"] else None
        return make_camera(where, stored["id"], viewmat, size, lens, distortion, split, image), int(stored["number"])
    except (TypeError, ValueError, KeyError, AttributeError, OverflowError, RecursionError):
        raise BadInput(f"{where}: what is kept of its import is damaged; import the cameras again") from None


def photo_of(obj: bpy.types.Object) -> Path | None:
    """The photo that a camera was imported with, if it lies where this user took photos from."""
    stored = imported(obj)
    found = stored is not None and stored.image is not None and trust.is_known_photo(stored.image)
    return stored.image if found else None


def is_chart(obj: bpy.types.Object | None) -> bool:
    """Whether a camera faces a chart: nothing can be seen from there but its picture, so it is no view."""
    return obj is not None and isinstance(obj.get(CHART), int)


def _moved(viewmat: np.ndarray, imported: np.ndarray, frame: np.ndarray) -> bool:
    """Whether a camera left the place where its photo was taken, by more than Blender's float32 does."""
    reach = np.linalg.norm(imported[:3, 3]) + np.linalg.norm(np.linalg.inv(frame)[:3, 3])
    step = (viewmat @ np.linalg.inv(imported)) - np.eye(4)
    return bool(np.abs(step[:3, :3]).max() > 1e-4 or np.linalg.norm(step[:3, 3]) > 1e-4 * reach)


def camera_to_blender(camera: Camera, frame: Matrix, number: int = 0) -> bpy.types.Object:
    """A Blender camera (not yet linked) that frames what `camera` does; its exact numbers travel with it.

    `number` is its place in the file: views keep the file's order.
    """
    data = bpy.data.cameras.new(camera.id)
    data.sensor_fit, data.sensor_width = "HORIZONTAL", SENSOR
    data.lens = camera.fx * SENSOR / camera.width
    data.shift_x = (camera.width / 2 - camera.cx) / camera.width
    data.shift_y = (camera.cy - camera.height / 2) / camera.width
    obj = bpy.data.objects.new(camera.id, data)
    local = Matrix((np.linalg.inv(camera.viewmat) @ BLENDER_TO_OPENCV).tolist())
    location, rotation, _ = (frame @ local).decompose()
    obj.matrix_world = Matrix.LocRotScale(location, rotation, None)
    kept = {name: getattr(camera, name) for name in ("id", "width", "height", "fx", "fy", "cx", "cy", "split")}
    kept |= {"number": number, "viewmat": camera.viewmat.tolist()}
    kept["distortion"] = camera.distortion.coefficients.tolist() if camera.distortion else None
    kept["image"] = str(camera.image.resolve()) if camera.image and camera.image.exists() else None
    obj[CAMERA] = json.dumps(kept)
    return obj


def box_from_blender(obj: bpy.types.Object, frame: np.ndarray) -> Box:
    """A cube (any mesh's bounds) in the splat's frame; any rotation, scale and parent.

    Its numbers are those that a user would write into a ROI file, so that both give the same bytes.

    Raises
    ------
    BadInput
        If it is flat or sheared.
    """
    corners = np.array([tuple(c) for c in obj.bound_box], dtype=np.float64)
    matrix = np.linalg.inv(frame) @ np.array(obj.matrix_world, dtype=np.float64)
    try:
        box = box_from_matrix(matrix, corners.min(0), corners.max(0))
    except BadInput as error:
        raise BadInput(f"{obj.name}: {error}") from None
    turn = np.round(box.axes)
    if np.abs(box.axes - turn).max() < STRAIGHT:  # by quarters: the same points without a turn
        box = Box.make(box.center, np.abs(turn) @ box.size)
    return Box.make(_typed(box.center), _typed(box.size), _typed(box.rotation_wxyz))


def views_of(context: bpy.types.Context, frame: np.ndarray) -> Iterator[tuple[Camera, bpy.types.Object]]:
    """The cameras that scene.gimp3d.views chooses, in the splat's frame, with the objects they come from.

    No two have the same ID or name their files alike, though the same file may have been imported twice.

    Raises
    ------
    BadInput
        If there is none, with what to do.
    """
    taken: set[str] = set()
    for camera, obj in _chosen_views(context, frame):
        path, number, name = PurePosixPath(camera.id), 1, camera.id
        while output_name(name) in taken:
            number += 1
            name = str(path.with_name(f"{path.stem}_{number}{path.suffix}"))
        taken.add(output_name(name))
        yield replace(camera, id=name), obj


def _chosen_views(context: bpy.types.Context, frame: np.ndarray) -> Iterator[tuple[Camera, bpy.types.Object]]:
    scene, settings = context.scene, context.scene.gimp3d
    if settings.views == "ANIMATED":
        yield from _frames(context, frame)
        chosen = [scene.camera]
    else:
        chosen = chosen_cameras(scene)
        if not chosen:
            raise BadInput("no camera to look from; add views (3D-GIMP panel, step 3)")
        depsgraph = context.evaluated_depsgraph_get()
        for obj in chosen:
            yield camera_from_blender(obj, frame, scene, depsgraph), obj
    reference = present(scene, settings.reference)
    if reference is not None and reference not in chosen and not is_chart(reference):
        yield camera_from_blender(reference, frame, scene, context.evaluated_depsgraph_get()), reference


@dataclass(frozen=True)
class ViewSize:
    """What a view costs."""

    width: int  # pixels
    height: int
    photo: bool  # imported with one that may be used, even if it has been moved away from it since
    strange_photo: bool  # with one where this user never took photos from, or that is gone
    sees: bool  # a part of the boxes may be in its picture; always so of an animation's frames


def view_sizes(context: bpy.types.Context, boxes: Iterable[bpy.types.Object] = ()) -> list[ViewSize]:
    """Of the views that `views_of` would give, without going through an animation's frames.

    Raises
    ------
    BadInput
        If a view cannot be used, with what to do.
    """
    scene, settings = context.scene, context.scene.gimp3d
    if settings.views == "ANIMATED":
        cameras = [scene.camera] if scene.camera and not is_chart(scene.camera) else []
        times = len(range(scene.frame_start, scene.frame_end + 1, scene.frame_step))
    else:
        cameras, times = chosen_cameras(scene), 1
    for obj in cameras:
        _require_perspective(obj)
    animated = settings.views == "ANIMATED"
    corners = [np.array([b.matrix_world @ Vector(c) for c in b.bound_box]) for b in boxes]
    found = []
    for obj in cameras:
        stored, photo = imported(obj), photo_of(obj)
        strange = stored is not None and stored.image is not None and photo is None
        sees = animated or not corners or any(_may_see(obj, scene, c) for c in corners)
        size = own_size(obj, scene)
        found.append(ViewSize(*size, photo is not None and not animated, strange and not animated, sees))
    return found * times


def _may_see(
    obj: bpy.types.Object,
    scene: bpy.types.Scene,
    corners: np.ndarray,  # [8, 3] of a box, world
) -> bool:
    """Whether a box is not wholly behind the camera, or beyond one side of its picture."""
    x, y, z = (corners @ np.array(obj.matrix_world.inverted().to_3x3()).T + obj.matrix_world.inverted().translation).T
    frame = [Vector(c) for c in obj.data.view_frame(scene=scene)]  # corners of the picture, z < 0
    left, right = (pick(c.x / -c.z for c in frame) for pick in (min, max))
    low, high = (pick(c.y / -c.z for c in frame) for pick in (min, max))
    stored, depth = imported(obj), -z
    if stored is not None:  # whose picture is not the scene's
        left, right = -stored.cx / stored.fx, (stored.width - stored.cx) / stored.fx
        low, high = (stored.cy - stored.height) / stored.fy, stored.cy / stored.fy
    beyond = (depth <= 0, x < left * depth, x > right * depth, y < low * depth, y > high * depth)
    return not any(side.all() for side in beyond)


def chosen_cameras(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Camera objects of the scene or of the chosen collection: imported ones in their file's order, others by name."""
    settings = scene.gimp3d
    if settings.views == "COLLECTION":
        if settings.view_collection is None:
            raise BadInput("choose the collection whose cameras are the views")
        pool: Iterable[bpy.types.Object] = (o for o in settings.view_collection.all_objects if present(scene, o))
    else:
        pool = scene.objects
    return sorted((o for o in pool if o.type == "CAMERA" and not is_chart(o)), key=lambda o: (_number(o), o.name))


def is_view(scene: bpy.types.Scene, camera: bpy.types.Object | None) -> bool:
    """Whether a camera is one of the chosen views, rather than the reference beside them."""
    return camera == scene.camera if scene.gimp3d.views == "ANIMATED" else camera in chosen_cameras(scene)


def _number(obj: bpy.types.Object) -> int:
    return _stored(str(obj[CAMERA]), obj.name)[1] if CAMERA in obj else 0


def _frames(context: bpy.types.Context, frame: np.ndarray) -> Iterator[tuple[Camera, bpy.types.Object]]:
    scene, obj = context.scene, context.scene.camera
    if obj is None or is_chart(obj):
        raise BadInput("the scene has no active camera whose frames could be the views")
    current = scene.frame_current, scene.frame_subframe
    try:
        for number in range(scene.frame_start, scene.frame_end + 1, scene.frame_step):
            scene.frame_set(number)
            depsgraph = context.evaluated_depsgraph_get()
            yield camera_from_blender(obj, frame, scene, depsgraph, f"{safe_name(obj.name)}/{number:04d}"), obj
    finally:
        scene.frame_set(current[0], subframe=current[1])


def safe_name(name: str) -> str:
    """An object's name as a camera ID: no path, and no dot, as "Camera.001" would lose its number as an extension."""
    return re.sub(r"[^\w\- ]", "_", name).strip() or "camera"

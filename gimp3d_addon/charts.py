"""Charts as cameras: the surfaces behind the object, each seen straight on, with its picture behind the view."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from gimp3d.errors import BadInput
from gimp3d.io.cameras import read_cameras

from . import backdrops, bridge, splats

COLLECTION = "3D-GIMP charts"
PICTURE, HOLE = "gimp3d_picture", "gimp3d_hole"  # custom properties of their cameras: images


def of_scene(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The charts' cameras in their order."""
    return sorted((o for o in scene.objects if bridge.is_chart(o)), key=lambda o: o[bridge.CHART])


def show(context: bpy.types.Context, folder: Path, splat: bpy.types.Object) -> None:
    """Cameras for the charts that a command wrote into `folder`, in place of the last ones.

    A camera that is the reference or the active one stays so under its number.
    """
    last = {o[bridge.CHART]: o for o in of_scene(context.scene)}
    found = read_cameras(folder / "transforms.json") if folder.is_dir() else ()
    collection = next((o.users_collection[0] for o in last.values()), None)
    if found and collection is None:
        collection = bpy.data.collections.new(COLLECTION)
        context.scene.collection.children.link(collection)
    frame = Matrix(bridge.splat_frame(splat).tolist())
    for number, camera in enumerate(found, 1):
        obj = bridge.camera_to_blender(replace(camera, id=f"chart:{number}"), frame)
        obj[bridge.CHART] = number
        obj[PICTURE] = backdrops.load_picture(folder / f"{number}.png", f"chart {number}")
        obj[HOLE] = backdrops.load_picture(folder / f"{number}.hole.png", f"chart {number} hole")
        backdrops.put_behind(obj, obj[PICTURE])
        # it stands far away, so that its view has hardly any perspective
        far = np.median(np.linalg.norm(splats.positions(splat) - camera.centre, axis=1)) * frame.median_scale
        obj.data.clip_end = max(obj.data.clip_end, 2 * far)
        if number in last:
            _replace(last.pop(number), obj)
        else:
            collection.objects.link(obj)
    for old in last.values():
        _replace(old, None)


def _replace(old: bpy.types.Object, new: bpy.types.Object | None) -> None:
    """Put a camera in the place of another one, wherever that is used, and take that away."""
    if new is not None:
        old.user_remap(new)
    name, data = old.name, old.data
    bpy.data.objects.remove(old)
    bpy.data.cameras.remove(data)
    if new is not None:
        new.name = name


def save(chart: bpy.types.Object, folder: Path) -> tuple[Path, Path]:
    """A chart's picture and the mask of its hole as files, byte for byte as they were written.

    Raises
    ------
    BadInput
        If the user has deleted one of the images.
    """
    paths = folder / "chart.png", folder / "chart.mask.png"
    for path, name in zip(paths, (PICTURE, HOLE)):
        if chart.get(name) is None:
            raise BadInput(f"the picture of {chart.name} was deleted; Preview Mask makes it anew")
        path.write_bytes(chart[name].packed_file.data)
    return paths

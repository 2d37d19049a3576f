"""Pictures over and behind a camera's view: previews, true renderings, photos."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np

from gimp3d.errors import BadInput

PAINTED = 1.5 / 255  # by which a pixel differs that was painted over
OURS = "3D-GIMP "  # images whose names begin so are ours to replace


def load_picture(path: Path, title: str) -> bpy.types.Image:
    """A file as the packed image '3D-GIMP title', in place of the last one of that title."""
    if not path.exists():
        raise BadInput(f"{path.name} was not made")
    image = bpy.data.images.get(OURS + title)
    if image is None:
        image = bpy.data.images.load(str(path))
        image.name = OURS + title
    else:
        if image.packed_file:
            image.unpack(method="REMOVE")
        image.source, image.filepath = "FILE", str(path)
        image.reload()
    image.pack()
    return image


def painted_over(image: bpy.types.Image, before: str) -> np.ndarray:
    """[H, W] bool, first row on top: where a picture differs from our image of that title, of the same size."""
    old = bpy.data.images.get(OURS + before)
    if old is None or tuple(old.size) != tuple(image.size):
        raise BadInput(f"{image.name}: what was painted over is gone; paint it again")
    new_pixels, old_pixels = (np.empty(4 * i.size[0] * i.size[1], np.float32) for i in (image, old))
    image.pixels.foreach_get(new_pixels)
    old.pixels.foreach_get(old_pixels)
    off = np.abs(new_pixels - old_pixels).reshape(image.size[1], image.size[0], 4)[::-1, :, :3].max(-1)
    return off > PAINTED


def save_mask(mask: np.ndarray, path: Path) -> None:
    """Write [H, W] bool, first row on top, as a black and white PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    image = bpy.data.images.new(OURS + "mask to save", mask.shape[1], mask.shape[0])
    pixels = np.repeat(mask[::-1, :, None].astype(np.float32), 4, axis=2)
    pixels[..., 3] = 1.0
    image.pixels.foreach_set(pixels.ravel())
    image.filepath_raw, image.file_format = str(path), "PNG"
    image.save()
    bpy.data.images.remove(image)


def put_over(camera: bpy.types.Object, image: bpy.types.Image) -> None:
    """Show a picture in front of what the camera sees, in place of our last one."""
    take_away(camera)
    _place(camera, image, "FRONT")


def put_behind(camera: bpy.types.Object, image: bpy.types.Image) -> None:
    """Show a photo, or a chart's picture, behind what the camera sees."""
    _place(camera, image, "BACK")


def take_away(camera: bpy.types.Object) -> bool:
    """Take our pictures off a camera; photos stay. Returns whether there was one."""
    slots = camera.data.background_images
    ours = [s for s in slots if s.display_depth == "FRONT" and (s.image is None or s.image.name.startswith(OURS))]
    for slot in ours:
        slots.remove(slot)
    camera.data.update_tag()  # the view goes on drawing them otherwise
    return bool(ours)


def show_in_image_editor(context: bpy.types.Context, image: bpy.types.Image) -> None:
    """In an Image Editor that is open; none is opened, as that would change the user's layout."""
    for area in context.screen.areas if context.screen else ():
        if area.type == "IMAGE_EDITOR":
            area.spaces.active.image = image
            return


def _place(camera: bpy.types.Object, image: bpy.types.Image, depth: str) -> None:
    slot = camera.data.background_images.new()
    slot.image, slot.display_depth, slot.alpha = image, depth, 1.0
    slot.frame_method = "STRETCH"  # the picture is the frame, also where the scene's resolution is another
    camera.data.show_background_images = True

"""Photos in and pictures out. 8-bit sRGB as it is; lens distortion ends here."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from ..camera import LARGEST_PICTURE, Camera
from ..errors import BadInput, refusing
from ..files import require_file, write_atomically
from ..memory import require_memory

PNG = b"\x89PNG\r\n\x1a\n"
DENSEST = 8 * 1032  # pixels that a byte of a PNG or JPEG can hold: deflate's most bytes, of one bit each
SMALLEST = 1 / 16  # of a camera's width: a photo of less is a thumbnail or a mistake
PIXEL = 16  # bytes that a picture takes while it is read, about: of 8 bits and three channels 9, with alpha 28
ASPECT_TOLERANCE = 1.5  # px by which a photo's size may differ from the scaled camera's, from rounding


def read_image(path: Path | str) -> np.ndarray:
    """A picture as [H, W, 3] uint8 RGB; 16 bit is reduced, grey repeated, alpha composited on black.

    Raises BadInput if it is missing or not a picture.
    """
    with refusing(f"cannot read the picture {path}", OSError):
        data = require_file(Path(path)).read_bytes()  # cv2.imread fails on non-ASCII names on Windows
    return decode_image(data, str(path))


def decode_image(data: bytes, name: str) -> np.ndarray:
    """A picture file's bytes, as `read_image` gives them; `name` is for messages."""
    picture = decoded(data, name)
    if picture.dtype == np.uint16:
        picture = (picture.astype(np.uint32) * 255 + 32767) // 65535
    elif picture.dtype != np.uint8:
        picture = np.clip(np.rint(np.nan_to_num(picture.astype(np.float32)) * 255), 0, 255)
    picture = np.atleast_3d(picture)
    channels = picture.shape[2]
    if channels == 4:
        picture = picture[..., :3].astype(np.uint32) * picture[..., 3:] // 255
    order = [2, 1, 0] if channels > 2 else [0, 0, 0]  # OpenCV's blue, green, red; or grey, with alpha left out
    return np.ascontiguousarray(picture[..., order].astype(np.uint8))


def decoded(data: bytes, name: str, way: int = cv2.IMREAD_UNCHANGED) -> np.ndarray:
    """A picture file's bytes as OpenCV gives them; no memory is taken for what they only claim.

    Raises BadInput if they are no picture, or one that claims more than they can hold.
    """
    if is_broken_png(data):
        raise BadInput(f"{name} is not a picture that can be read (a PNG that is cut off or damaged)")
    size = announced_pixels(data)
    # a PNG's and a JPEG's bytes limit what they hold, a WebP's do not
    if size > (LARGEST_PICTURE if data[8:12] == b"WEBP" else min(LARGEST_PICTURE, DENSEST * len(data))):
        raise BadInput(f"{name} claims {size:,} pixels, more than such a file can hold")
    require_memory(PIXEL * size, f"{name} with {size:,} pixels")
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), way) if len(data) else None
    except cv2.error:
        picture = None
    if picture is None:
        raise BadInput(f"{name} is not a picture that can be read")
    return picture


def announced_pixels(data: bytes) -> int:
    """How many pixels the header of a PNG, JPEG or WebP announces; 0 for other files, of which OpenCV has a limit."""
    if data.startswith(PNG) and len(data) >= 24:
        width, height = struct.unpack(">II", data[16:24])
        return width * height
    if data[:2] == b"\xff\xd8":
        return _jpeg_pixels(data)
    if data[8:12] != b"WEBP" or len(data) < 30:
        return 0
    if data[12:16] == b"VP8L":
        sizes = int.from_bytes(data[21:25], "little")
        return ((sizes & 0x3FFF) + 1) * ((sizes >> 14 & 0x3FFF) + 1)
    if data[12:16] == b"VP8X":
        return (int.from_bytes(data[24:27], "little") + 1) * (int.from_bytes(data[27:30], "little") + 1)
    return (int.from_bytes(data[26:28], "little") & 0x3FFF) * (int.from_bytes(data[28:30], "little") & 0x3FFF)


def is_broken_png(data: bytes) -> bool:
    """Whether a PNG's chunks do not lead from its header by its pixels to its end.

    OpenCV takes memory, hundreds of megabytes, for whatever length the next four bytes claim.
    """
    at, kinds = len(PNG), [b""]
    while data.startswith(PNG) and at < len(data) and kinds[-1] != b"IEND":
        kinds.append(data[at + 4 : at + 8])
        at += 12 + int.from_bytes(data[at : at + 4], "big")
    whole = kinds[1:2] == [b"IHDR"] and b"IDAT" in kinds and kinds[-1] == b"IEND" and at <= len(data)
    return data.startswith(PNG) and not whole


def _jpeg_pixels(data: bytes) -> int:
    """What the first frame header says, found as libjpeg finds it: segments are skipped, and whatever is no marker."""
    at = data.find(b"\xff", 2)
    while 0 <= at < len(data) - 8:
        marker = data[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            return height * width
        alone = marker in (0, 1) or 0xD0 <= marker <= 0xD8
        skipped = 1 if marker == 0xFF else 2 if alone else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        at = data.find(b"\xff", at + skipped)
    return 0


def read_mask(path: Path | str) -> np.ndarray:
    """A mask as [H, W] bool: true where the picture is brighter than half."""
    return read_image(path).max(-1) > 127


def write_png(
    path: Path | str,
    picture: np.ndarray,  # [H, W, 3] uint8 RGB, [H, W] uint8 or bool (as 0/255)
) -> None:
    """Write a PNG atomically."""
    data = encode_png(picture)
    write_atomically(Path(path), lambda f: f.write(data))


def encode_png(picture: np.ndarray) -> bytes:
    """A picture as `write_png` writes it."""
    if picture.dtype == bool:
        picture = picture.astype(np.uint8) * 255
    ok, data = cv2.imencode(".png", picture[..., ::-1] if picture.ndim == 3 else picture)
    if not ok:
        raise BadInput(f"cannot encode a picture of {'×'.join(map(str, picture.shape))} as PNG")
    return data.tobytes()


def load_view(camera: Camera) -> tuple[np.ndarray, Camera]:
    """A camera's photo [H, W, 3] uint8, resampled to the camera's size and undistorted, and its pinhole camera.

    Raises
    ------
    BadInput
        If the photo is missing, unreadable or of another aspect ratio than the camera.

    Examples
    --------
    >>> photo, pinhole = load_view(read_cameras("transforms.json")[0])
    >>> photo.shape, pinhole.distortion
    ((45, 60, 3), None)
    """
    if camera.image is None:
        raise BadInput(f"camera {camera.id} has no photo")
    photo = read_image(camera.image)
    height, width = photo.shape[:2]
    factor, has = width / camera.width, f"{camera.image} has {width}×{height} pixels"
    if factor < SMALLEST:
        raise BadInput(f"{has}, far fewer than its camera's {camera.width}×{camera.height}")
    if abs(height - factor * camera.height) > max(ASPECT_TOLERANCE, ASPECT_TOLERANCE * factor):
        raise BadInput(f"{has}, which are not its camera's {camera.width}×{camera.height}")
    if (width, height) != (camera.width, camera.height):
        way = cv2.INTER_AREA if factor > 1 else cv2.INTER_LINEAR
        photo = cv2.resize(photo, (camera.width, camera.height), interpolation=way)
    if camera.distortion is not None:
        at_integers = camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]  # OpenCV's pixel centres are whole numbers
        photo = cv2.undistort(photo, at_integers, camera.distortion.coefficients)
    return photo, replace(camera, distortion=None)

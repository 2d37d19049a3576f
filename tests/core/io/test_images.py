"""Pictures that claim more than they hold take neither time nor memory."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

import gimp3d.io.images
from gimp3d.errors import BadInput
from gimp3d.io.images import read_image, write_png

LARGE = 11_000  # px; its square is less than a camera's picture may have


def png(*chunks: bytes) -> bytes:
    body = b"".join(struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in chunks)
    return b"\x89PNG\r\n\x1a\n" + body


def header(side: int) -> bytes:
    return struct.pack(">4sIIBBBBB", b"IHDR", side, side, 8, 6, 0, 0, 0)


def small(kind: str) -> bytes:
    return cv2.imencode(kind, np.zeros((16, 16, 3), np.uint8))[1].tobytes()


def large_jpg(side: int) -> bytes:
    data = small(".jpg")
    at = data.index(b"\xff\xc0") + 5
    return data[:at] + struct.pack(">HH", side, side) + data[at + 4 :]


PIXELS = b"IDAT" + zlib.compress(bytes(1000))
SOUND = small(".png")
DISHONEST = {
    "a billion pixels": png(header(32_000), PIXELS, b"IEND"),
    "more pixels than bytes can hold": png(header(LARGE), PIXELS, b"IEND"),
    "the same in a JPEG": large_jpg(LARGE),
    "a chunk longer than the file": SOUND[:33] + b"\x0f" + SOUND[34:],
    "no pixels, then a length": png(header(8), b"IEND") + b"\x0f" * 60,
    "no header": png(PIXELS, b"IEND") + b"\x0f" * 60,
}


@pytest.mark.parametrize("what", DISHONEST)
def test_a_picture_that_claims_more_than_it_holds_is_refused_unread(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """OpenCV takes the memory, and up to seconds, before it sees that there is nothing: found by make fuzz."""
    monkeypatch.setattr(gimp3d.io.images.cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    (tmp_path / "p").write_bytes(DISHONEST[what])
    with pytest.raises(BadInput, match=r"not a picture|more than such a file can hold"):
        read_image(tmp_path / "p")


def test_a_picture_larger_than_memory_is_refused_unread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_png(tmp_path / "p.png", np.zeros((100, 100, 3), np.uint8))
    monkeypatch.setattr(gimp3d.memory, "free_memory", lambda: 100 * 100)
    with pytest.raises(MemoryError, match="10,000 pixels takes"):
        read_image(tmp_path / "p.png")


KINDS = (".png", ".jpg", ".webp", ".bmp", ".tif")
SHAPES = [(1, 1, 3), (3, 1500, 3), (900, 1200, 3), (64, 64), (64, 64, 4)]
PLAIN = [(k, s) for k in KINDS for s in SHAPES if (k, s[2:]) != (".jpg", (4,))]  # a JPEG has no alpha


@pytest.mark.parametrize(("kind", "shape"), PLAIN)
def test_plain_pictures_of_one_colour_pass(kind: str, shape: tuple[int, ...], tmp_path: Path) -> None:
    """They hold the most pixels in a byte."""
    (tmp_path / f"p{kind}").write_bytes(cv2.imencode(kind, np.full(shape, 255, np.uint8))[1].tobytes())
    assert (read_image(tmp_path / f"p{kind}") >= 254).all()


def test_a_jpeg_is_measured_by_its_own_header_and_not_by_what_lies_in_its_metadata(tmp_path: Path) -> None:
    thumbnail = large_jpg(LARGE)
    metadata = b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 2) + thumbnail
    data = small(".jpg")
    (tmp_path / "p.jpg").write_bytes(data[:2] + metadata + b"\xff" + data[2:])  # markers may be filled up by FF
    assert read_image(tmp_path / "p.jpg").shape == (16, 16, 3)

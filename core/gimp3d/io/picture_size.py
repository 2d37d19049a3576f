"""How large a picture says it is, before memory is taken for it."""

from __future__ import annotations

import struct

LARGEST_SIDE, LARGEST_PICTURE = (1 << 16) - 1, 1 << 27  # pixels
PNG = b"\x89PNG\r\n\x1a\n"
DENSEST = 8 * 1032  # pixels that a byte of a PNG or JPEG can hold: deflate's most bytes, of one bit each


def most_pixels(data: bytes) -> int:
    """The most pixels that a picture file can hold: its bytes' number limits a PNG and a JPEG, no WebP."""
    return LARGEST_PICTURE if data[8:12] == b"WEBP" else min(LARGEST_PICTURE, DENSEST * len(data))


def announced_pixels(data: bytes) -> int:
    """How many pixels the header of a PNG, JPEG or WebP announces; 0 for other files, of which OpenCV has a limit."""
    if data.startswith(PNG) and len(data) >= 24:
        width, height = struct.unpack(">II", data[16:24])
        return width * height
    if data[:2] == b"\xff\xd8":
        return _jpeg_pixels(data)
    if data[8:12] == b"WEBP" and len(data) >= 30:
        return _webp_pixels(data)
    return 0


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


def _webp_pixels(data: bytes) -> int:
    if data[12:16] == b"VP8L":
        sizes = int.from_bytes(data[21:25], "little")
        return ((sizes & 0x3FFF) + 1) * ((sizes >> 14 & 0x3FFF) + 1)
    if data[12:16] == b"VP8X":
        return (int.from_bytes(data[24:27], "little") + 1) * (int.from_bytes(data[27:30], "little") + 1)
    return (int.from_bytes(data[26:28], "little") & 0x3FFF) * (int.from_bytes(data[28:30], "little") & 0x3FFF)

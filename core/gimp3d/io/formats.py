"""Splat files other than plain PLY: PlayCanvas compressed PLY, .splat, .spz and .sog, each read into a `SplatFile`.

All of them are lossy: what is read here is what their own viewers draw, in Inria's layout and axes. Told apart by
content, so a wrong suffix does no harm.
"""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np

from ..errors import BadInput, refusing
from ..files import require_file
from ..gaussians import SH_C0, Gaussians
from ..memory import GAUSSIAN, require_memory
from ..schema import checked, parse_json
from .ply import TYPES, SplatFile, file_of, header_of, read_ply

SPLAT_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
SPZ_MAGIC = b"NGSP"
DAMAGE = (zipfile.BadZipFile, zlib.error, EOFError, KeyError, ValueError, NotImplementedError, RuntimeError)
SOG_DAMAGE = (KeyError, ValueError, TypeError, IndexError, AttributeError, OverflowError)
SPZ_HEADER = 16  # bytes
LARGEST_META = 16 << 20  # bytes of a SOG's meta.json; codebooks have 256 entries
LARGEST_PACKED = 1 << 31  # bytes of a SOG's picture
LARGEST_PALETTE = 1 << 24  # pixels of a SOG's SH palette
CHUNK_ROWS = 256  # Gaussians that share a chunk's bounds in a compressed PLY
SQRT_HALF = np.sqrt(0.5)
# Signs of SH coefficients 1 … 15 under a half turn about x: spz has y up and z back, Inria's files y down and z ahead
HALF_TURN_SH = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)


def read_scene(path: Path | str) -> SplatFile:
    """Read a splat scene of any kind: PLY (plain or compressed), .splat, .spz, .sog or an unpacked SOG folder.

    Raises BadInput if the file is missing, damaged or of no known kind, saying which.
    """
    path = Path(path)
    with refusing(f"{path} is damaged", *DAMAGE), refusing(f"cannot read {path}", OSError):
        if path.is_dir() or path.name == "meta.json":
            folder = path if path.is_dir() else path.parent
            return file_of(_from_sog(lambda name: require_file(folder / Path(name).name).open("rb"), path))
        with require_file(path).open("rb") as f:
            start = f.read(4)
        if start[:3] == b"ply":
            compressed = any(e.name == "chunk" for e in header_of(path)[1])
            return file_of(_from_compressed_ply(path)) if compressed else read_ply(path)
        if start == SPZ_MAGIC or start[:2] == b"\x1f\x8b":
            return file_of(_from_spz(path))
        if start == b"PK\x03\x04":
            with zipfile.ZipFile(path) as archive:
                return file_of(_from_sog(archive.open, path))
        if path.suffix.lower() == ".splat":
            return file_of(_from_splat(path))
    raise BadInput(f"{path} is not a PLY, nor a .splat, .spz or .sog scene")


def _from_splat(path: Path) -> Gaussians:
    """antimatter15's .splat: 32 bytes per Gaussian, no SH."""
    data = path.read_bytes()
    if len(data) % SPLAT_ROW.itemsize:
        raise BadInput(f"{path} is truncated: {len(data)} bytes are no whole number of 32-byte rows")
    rows = np.frombuffer(data, SPLAT_ROW)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(rows["scale"])
    quats, colour = (rows["quat"].astype(np.float32) - 128) / 128, rows["rgba"] / 255
    return _gaussians(path, rows["mean"], log_scales, quats, colour[:, 3], (colour[:, :3] - 0.5) / SH_C0)


def _from_compressed_ply(path: Path) -> Gaussians:
    """PlayCanvas: 256 Gaussians share bounds, values have 8 to 11 bits in them."""
    _, elements, offset = header_of(path)
    data, tables = path.read_bytes(), {}
    for element in elements:
        kind = np.dtype([(n, "<" + TYPES[t]) for n, t in element.properties.items() if t != "list"])
        if offset + element.count * kind.itemsize > len(data):
            raise BadInput(f"{path} is truncated: element {element.name} is not whole")
        tables[element.name] = np.frombuffer(data, kind, element.count, offset)
        offset += element.count * kind.itemsize
    vertex, bounds = tables["vertex"], tables["chunk"]
    if len(bounds) * CHUNK_ROWS < len(vertex):
        raise BadInput(f"{path}: {len(bounds)} chunks are too few for {len(vertex)} Gaussians")
    chunk = np.arange(len(vertex)) // CHUNK_ROWS

    def between(unit: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
        low, high = (np.stack([bounds[f"{end}_{n}"] for n in names], 1)[chunk] for end in ("min", "max"))
        return low + unit * (high - low)

    means = between(_unpack(vertex["packed_position"], 11, 10, 11), ("x", "y", "z"))
    log_scales = between(_unpack(vertex["packed_scale"], 11, 10, 11), ("scale_x", "scale_y", "scale_z"))
    rgba = _unpack(vertex["packed_color"], 8, 8, 8, 8)
    rgb = between(rgba[:, :3], ("r", "g", "b")) if "min_r" in (bounds.dtype.names or ()) else rgba[:, :3]
    packed = vertex["packed_rotation"]
    quats = _smallest_three((_unpack(packed, 10, 10, 10) - 0.5) * 2 * SQRT_HALF, (packed >> 30).astype(int))
    rest, higher = tables.get("sh"), None
    if rest is not None and rest.dtype.names:
        steps = np.stack([rest[f"f_rest_{k}"] for k in range(len(rest.dtype.names))], 1)
        higher = (steps * np.float32(8 / 255) - 4).reshape(len(vertex), 3, -1).transpose(0, 2, 1)
    return _gaussians(path, means, log_scales, quats, rgba[:, 3], (rgb - 0.5) / SH_C0, higher)


def _from_spz(path: Path) -> Gaussians:
    """Niantic's .spz, versions 1 to 4 (4: zstd streams instead of one gzip)."""
    data = path.read_bytes()
    packed = data[:4] != SPZ_MAGIC
    body = _inflated(data, SPZ_HEADER) if packed else data[:SPZ_HEADER]
    if len(body) < SPZ_HEADER or body[:4] != SPZ_MAGIC:
        raise BadInput(f"{path} is a gzip file, but no .spz scene")
    version, n, sh_degree, fraction_bits, flags = struct.unpack("<IIBBB", body[4:15])
    if not 1 <= version <= 4 or sh_degree > 3 or (version == 4) == packed or fraction_bits > 24:
        raise BadInput(f"{path}: .spz version {version} with SH degree {sh_degree} is not known")
    count = (sh_degree + 1) ** 2 - 1
    widths = (6 if version == 1 else 9, 1, 3, 3, 4 if version >= 3 else 3, 3 * count)  # bytes of each property
    require_memory(n * (sum(widths) + GAUSSIAN), f"{path} with {n} Gaussians")
    size = SPZ_HEADER + n * sum(widths)  # what its count needs; whatever else is packed there is not unpacked
    body = _inflated(data, size + 1) if packed else _unpacked_spz_4(data, size, path)
    if len(body) < size:
        raise BadInput(f"{path} is truncated")
    parts = np.split(np.frombuffer(body, np.uint8)[SPZ_HEADER:size], n * np.cumsum(widths[:-1]))
    position, alpha, colour, scale, rotation, sh = (p.reshape(n, w) for p, w in zip(parts, widths))
    if version == 1:
        means = position.view("<f2").astype(np.float64)
    else:
        low, middle, high = position.reshape(n, 3, 3).astype(np.int32).transpose(2, 0, 1)
        fixed = low | middle << 8 | high << 16
        means = np.where(fixed & 0x800000, fixed - (1 << 24), fixed) / (1 << fraction_bits)
    if version >= 3:  # three components of 9 bits and a sign, in the order w, z, y, x from the lowest
        words = rotation.view("<u4")
        fields = words >> np.array([0, 10, 20], np.uint32) & 1023
        small = (fields & 511) / 511 * SQRT_HALF * np.where(fields >> 9, -1, 1)
        quats = _smallest_three(small, 3 - (words[:, 0] >> 30).astype(int))[:, [0, 3, 2, 1]]
    else:
        xyz = rotation / 127.5 - 1
        quats = np.concatenate([np.sqrt(np.maximum(0, 1 - (xyz**2).sum(1, keepdims=True))), xyz], 1)
    higher = ((sh.reshape(n, count, 3).astype(np.float32) - 128) / 128) * HALF_TURN_SH[:count, None]
    means, quats, dc = means * [1, -1, -1], quats * [1, 1, -1, -1], (colour / 255 - 0.5) / 0.15
    return _gaussians(path, means, scale / 16 - 10, quats, alpha[:, 0] / 255, dc, higher, bool(flags & 1))


def _inflated(data: bytes, size: int) -> bytes:
    """The first bytes of what a gzip file holds, of all its members; if it holds less, its checksums are right."""
    body = b""
    while data and len(body) < size:
        member = zlib.decompressobj(zlib.MAX_WBITS | 16)
        body += member.decompress(data, size - len(body))
        if not member.eof and len(body) < size:
            raise EOFError("it ends too early")
        data = member.unused_data.lstrip(b"\0")
    return body


def _unpacked_spz_4(data: bytes, size: int, path: Path) -> bytes:
    """The body that the streams of version 4 make up, of so many bytes."""
    with refusing(f"{path}: .spz version 4 needs the package zstandard; pip install zstandard", ImportError):
        import zstandard
    table = int.from_bytes(data[16:20], "little")  # of the streams, whose number is the header's last byte
    offset = table + 16 * data[15]
    if len(data) < max(20, offset):
        raise BadInput(f"{path} is truncated")
    body = bytearray(data[:SPZ_HEADER])
    for packed, unpacked in struct.iter_unpack("<QQ", data[table:offset]):
        if len(body) + unpacked > size:
            raise BadInput(f"{path} is damaged: a stream of {unpacked} bytes is more than its Gaussians need")
        with refusing(f"{path} is damaged", zstandard.ZstdError, MemoryError):
            # as a stream, as a frame's own word for its size may be a lie
            stream = zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(data[offset : offset + packed])
            body += stream.read(unpacked)
        offset += packed
    return bytes(body)


def _from_sog(opened: Callable[[str], IO[bytes]], path: Path) -> Gaussians:
    """PlayCanvas SOG, versions 1 and 2: attributes as lossless WebP pictures, described by meta.json."""

    def read(name: str, most: int) -> bytes:
        with opened(name) as file:
            return file.read(most)

    where = f"{path}: meta.json"
    with refusing(f"{where} or a picture of the SOG scene is damaged", *SOG_DAMAGE):
        document = parse_json(read("meta.json", LARGEST_META + 1), where, LARGEST_META)
        meta: dict[str, Any] = checked(dict[str, Any], document, where)
        version = int(meta.get("version", 1))
        n = int(meta["count"] if version >= 2 else meta["means"]["shape"][0])
        if n < 0:
            raise ValueError(f"a count of {n}")
        require_memory(n * GAUSSIAN, f"{path} with {n} Gaussians")

        def picture(part: str, file: int, most: int) -> np.ndarray:
            return _webp(read(checked(str, meta[part]["files"][file], where), LARGEST_PACKED), path, most)

        def pixels(part: str, file: int = 0) -> np.ndarray:
            found = picture(part, file, 4 * n + (1 << 16)).reshape(-1, 4)
            if len(found) < n:
                raise ValueError(f"{n} Gaussians in a picture of {len(found)} pixels")
            return found[:n]

        def decoded(part: str, values: np.ndarray) -> np.ndarray:
            if "codebook" in meta[part]:
                return np.array(checked(list[float], meta[part]["codebook"], where))[values]
            low, high = np.array(meta[part]["mins"], np.float64), np.array(meta[part]["maxs"], np.float64)
            return low + values / 255 * (high - low)

        low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
        fine, coarse = (pixels("means", k)[:, :3].astype(np.float64) for k in (0, 1))
        logs = low + (fine + 256 * coarse) / 65535 * (high - low)
        means = np.sign(logs) * np.expm1(np.abs(logs))
        log_scales = decoded("scales", pixels("scales")[:, :3])
        colour = pixels("sh0")
        if version >= 2:
            dc, opacity = decoded("sh0", colour[:, :3]), colour[:, 3] / 255
        else:
            rgba = decoded("sh0", colour)
            dc, opacity = rgba[:, :3], 1 / (1 + np.exp(-rgba[:, 3]))
        packed = pixels("quats")
        quats = _smallest_three((packed[:, :3] / 255 - 0.5) * 2 * SQRT_HALF, packed[:, 3].astype(int) - 252)
        higher = None
        if "shN" in meta:
            entries = picture("shN", 0, LARGEST_PALETTE)
            count = entries.shape[1] // 64
            palette = decoded("shN", entries[..., :3].reshape(-1, count, 3))
            labels = pixels("shN", 1).astype(int)
            higher = palette[labels[:, 0] + 256 * labels[:, 1]]
    return _gaussians(path, means, log_scales, quats, opacity, dc, higher)


def _webp(data: bytes, path: Path, most: int) -> np.ndarray:
    """A picture [H, W, 4] uint8, RGBA, of at most so many pixels."""
    with refusing(f"{path}: .sog needs OpenCV; convert the scene with gimp3d convert", ImportError):
        import cv2

        from .images import announced_pixels, decoded
    if announced_pixels(data) > most:
        raise BadInput(f"{path}: a picture of the SOG scene is far larger than its count needs")
    picture = decoded(data, f"{path}: a part of the SOG scene")
    if picture.ndim != 3 or picture.dtype != np.uint8 or picture.shape[2] not in (3, 4):
        raise BadInput(f"{path}: a picture of the SOG scene is of another kind")
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGBA if picture.shape[2] == 3 else cv2.COLOR_BGRA2RGBA)


def _unpack(packed: np.ndarray, *bits: int) -> np.ndarray:
    """Bit fields, the last one in the lowest bits, as numbers in [0, 1], [N, fields]."""
    return np.stack([(packed >> sum(bits[k + 1 :]) & ((1 << b) - 1)) / ((1 << b) - 1) for k, b in enumerate(bits)], 1)


def _smallest_three(small: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Quaternions [N, 4] from their three smaller components [N, 3] in order and the number of the largest."""
    if len(largest) and not 0 <= largest.min() <= largest.max() <= 3:
        raise ValueError("a quaternion names no largest component")
    quats = np.empty((len(small), 4))
    for k in range(4):
        rows = largest == k
        quats[rows] = np.insert(small[rows], k, np.sqrt(np.maximum(0, 1 - (small[rows] ** 2).sum(1))), axis=1)
    return quats


def _gaussians(
    path: Path,
    means: np.ndarray,
    log_scales: np.ndarray,
    quats: np.ndarray,
    opacity: np.ndarray,  # [N] in steps of 1/255
    dc: np.ndarray,  # [N, 3]
    higher: np.ndarray | None = None,  # [N, K, 3]
    antialiased: bool = False,
) -> Gaussians:
    # 0 and 255 stand for what was rounded to them; their logits would be infinite.
    alpha = np.clip(opacity, 0.25 / 255, 1 - 0.25 / 255)
    with refusing(f"{path}: its parts do not fit together", ValueError):
        sh = dc[:, None] if higher is None or not higher.size else np.concatenate([dc[:, None], higher], 1)
        if sh.shape[1] not in (1, 4, 9, 16):
            raise BadInput(f"{path}: {sh.shape[1] - 1} SH coefficients per colour; 0, 3, 8 or 15 expected")
        return Gaussians(
            means=np.ascontiguousarray(means, np.float32),
            log_scales=np.maximum(log_scales, np.log(1e-30)).astype(np.float32),  # some formats can say 0
            quats=np.ascontiguousarray(quats, np.float32),
            opacity_logits=np.log(alpha / (1 - alpha)).astype(np.float32),
            sh=sh.astype(np.float32),
            antialiased=antialiased,
        )

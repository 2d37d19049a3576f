"""Every reader of what comes from outside, as a function of bytes; what it starts from, and how that is changed.

A reader takes anything or raises what it documents. Used by tests/fuzz and by tools/fuzz.py.
"""

from __future__ import annotations

import atexit
import gzip
import io
import json
import math
import os
import random
import shutil
import sys
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TESTS), str(TESTS / "core" / "io")]

from onnx_files import model, pixelwise
from test_formats import WRITERS, sog_files, some

from gimp3d.box import read_region
from gimp3d.camera import Camera
from gimp3d.errors import BadInput, Gimp3dError
from gimp3d.io.cameras import camera_id, read_cameras
from gimp3d.io.formats import _from_sog, read_scene
from gimp3d.io.images import load_view, read_image
from gimp3d.io.ply import header_of, write_gaussians
from gimp3d.job import RemovalJob, StageStore, load_job, save_job
from gimp3d.presets import job_settings
from gimp3d.priors import servers
from gimp3d.priors.monodepth import _from_file
from gimp3d.priors.networks import read_onnx
from gimp3d.priors.servers import _Automatic, _Comfy, _said, _Server, _workflow
from gimp3d.schema import checked, parse_json

EXPECTED = (Gimp3dError, MemoryError)  # MemoryError: refused before it was taken, see gimp3d.memory
NASTY: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2, 0.5, -0.0, 1e-320, 1e308, -1e308, 10**400, 1 << 31, 1 << 63, 65535),
    *(math.nan, math.inf, -math.inf, "", "0", "\ud800", "..", "../x", "/etc/passwd", "a" * 300, "\0", "C:\\x"),
    *([], {}, [[]], [None], {"": None}, [1, 2, 3], [[1, 0, 0, 0]] * 4, [0] * 16, "nan", "OPENCV_FISHEYE"),
)
SEPARATOR = b"\n====\n"  # of files that are read together
TOKENS = (b"0", b"-1", b"nan", b"1e999", b"\0", b"\xff" * 4, b"\xff" * 8, b"\x7f\xff\xff\xff", b"\n", b" ", b"9" * 30)


@dataclass(frozen=True)
class Reader:
    """A way into the program."""

    name: str
    read: Callable[[bytes], object]
    seeds: Callable[[], list[bytes]]
    is_json: bool = False
    needs_files: bool = True

    def check(self, data: bytes) -> bool:
        """Whether the reader took it; anything but a documented refusal is raised."""
        try:
            self.read(data)
        except EXPECTED as error:
            if "\n" in str(error):
                raise AssertionError(f"not one line: {error}") from error
            str(error).encode()  # can be printed
            return False
        return True


@cache
def place() -> Path:
    in_memory = "TMPDIR" not in os.environ and Path("/dev/shm").is_dir()
    folder = tempfile.mkdtemp(prefix="gimp3d-fuzz-", dir="/dev/shm" if in_memory else None)
    atexit.register(shutil.rmtree, folder, True)
    return Path(folder)


def in_file(name: str, read: Callable[[Path], object]) -> Callable[[bytes], object]:
    def written(data: bytes) -> object:
        path = place() / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(data)
        return read(path)

    return written


def file_seeds(write: Callable[[Path], object], name: str = "seed") -> Callable[[], list[bytes]]:
    def seeds() -> list[bytes]:
        path = place() / "seeds" / name
        path.parent.mkdir(exist_ok=True)
        write(path)
        return [path.read_bytes()]

    return seeds


def dumped(*documents: Any) -> Callable[[], list[bytes]]:
    return lambda: [json.dumps(d).encode() for d in documents]


POSE = np.eye(4).tolist()
FRAME = {"file_path": "a.png", "transform_matrix": POSE, "w": 8, "h": 6, "fl_x": 9.0, "cx": 4, "k1": 0.1}
FRAMES = [{**FRAME, "split": "test"}, {**FRAME, "file_path": "b"}]
TRANSFORMS = {"camera_model": "OPENCV", "camera_angle_x": 0.8, "w": 8, "h": 6, "frames": FRAMES}
PLACED = {"rotation": np.eye(3).tolist(), "position": [0, 0, 1]}
INRIA = [{"img_name": "a", **PLACED, "fx": 5, "fy": 5, "width": 9, "height": 9}]
COLMAP_TEXTS = b"1 PINHOLE 8 6 5 5 4 3", b"1 1 0 0 0 0 0 0 1 a.png\n\n"
BOX = {"center": [0, 0, 0], "size": [1, 1, 1], "rotation_wxyz": [1, 0, 0, 0]}
WORKFLOW = {"1": {"class_type": "LoadImage", "inputs": {"image": "{image}", "mask": "{mask}", "seed": "{seed}"}}}
COMFY = {
    "comfy": True, "upload": {"name": "a.png", "subfolder": "b", "type": "input"}, "/prompt": {"prompt_id": "p"},
    "object_info": {"CheckpointLoaderSimple": {"input": {"required": {"ckpt_name": [["inpaint.ckpt"], {}]}}}},
    "history": {"p": {"status": {"status_str": "success", "messages": [["execution_success", {}]]},
                      "outputs": {"9": {"images": [{"filename": "a.png", "subfolder": "", "type": "output"}]}}}},
    "queue": {"queue_running": [[1, "p", {}]]}, "view": "a picture",
}  # fmt: skip
AUTOMATIC = {"img2img": {"images": ["data:image/png;base64,AAAA"]}, "progress": {"progress": 0.5}}
REFUSED = {"error": {"message": "m", "details": "d"}, "detail": "d", "errors": "e",
           "node_errors": {"1": {"class_type": "c", "errors": [{"message": "m", "details": "d"}]}}}  # fmt: skip
SETTINGS = {"extra_references": "2", "seed.opacity": "0.9", "refine.steps": "0", "depth.scale_factor": "none"}


def read_json_cameras(data: bytes) -> object:
    return in_file("c.json", read_cameras)(data)


def read_colmap(kind: str) -> Callable[[bytes], object]:
    """Data hold both files: what comes before the first separator is cameras."""

    def read(data: bytes) -> object:
        head, _, tail = data.partition(SEPARATOR)
        folder = place() / f"colmap_{kind}"
        folder.mkdir(exist_ok=True)
        (folder / f"cameras.{kind}").write_bytes(head)
        (folder / f"images.{kind}").write_bytes(tail)
        return read_cameras(folder)

    return read


def colmap_seeds() -> list[bytes]:
    import struct

    lens = struct.pack("<Q", 1) + struct.pack("<iiQQ", 1, 1, 8, 6) + struct.pack("<4d", 5, 5, 4, 3)
    pose = struct.pack("<Q", 1) + struct.pack("<i7di", 1, 1, 0, 0, 0, 0, 0, 1, 1) + b"a.png\0" + struct.pack("<Q", 0)
    return [lens + SEPARATOR + pose]


def read_sog(data: bytes) -> object:
    """A description alone, with good pictures."""
    files = sog_seed()
    return _from_sog(lambda name: io.BytesIO(data if name == "meta.json" else files[name]), Path("x.sog"))


@cache
def sog_seed() -> dict[str, bytes]:
    return sog_files(some(20))


def sog_descriptions() -> list[bytes]:
    """Version 2 with codebooks of few digits, which take less time, and version 1 with ranges in their place."""
    meta = json.loads(sog_seed()["meta.json"])
    channels = {"scales": 3, "sh0": 4, "shN": 3}
    books = {part: {**meta[part], "codebook": list(range(256))} for part in channels}
    ranges = {k: {"mins": [-1] * n, "maxs": [1] * n, "files": meta[k]["files"]} for k, n in channels.items()}
    first = {"version": 1, "means": {**meta["means"], "shape": [meta["count"], 3]}}
    return dumped({**meta, **books}, {**meta, **ranges, **first})()


def read_sog_parts(data: bytes) -> object:
    """All of a SOG's files, as no archive's checksums guard them."""
    files = dict(zip(sog_seed(), data.split(SEPARATOR)))
    return _from_sog(lambda name: io.BytesIO(files[name]), Path("x.sog"))


def spz_inside(name: str) -> Reader:
    """What gzip's checksum guards."""
    read, seeds = in_file(name, read_scene), scene_seed(name)
    return Reader(
        f"{name} inside", lambda data: read(gzip.compress(data, 1)), lambda: [gzip.decompress(s) for s in seeds()]
    )


def with_checksums(png: bytes) -> bytes:
    """A PNG whose chunks have the checksums that they should have."""
    mended, at = bytearray(png), 8
    while at + 12 <= len(png):
        size = int.from_bytes(png[at : at + 4], "big")
        mended[at + 8 + size : at + 12 + size] = zlib.crc32(png[at + 4 : at + 8 + size]).to_bytes(4, "big")
        at += 12 + size
    return bytes(mended)


def read_settings(data: bytes) -> object:
    document = checked(dict[str, str], parse_json(data, "settings"), "settings")
    return job_settings(RemovalJob("s", "c", "r", "o.ply", set=document))


def read_photo(path: Path) -> object:
    return load_view(Camera("p", 8, 6, 5, 5, 4, 3, np.eye(4), image=path)), read_image(path)


def picture(kind: str) -> Callable[[], list[bytes]]:
    noise = np.random.default_rng(0).integers(0, 255, (6, 8, 3), dtype=np.uint8)
    return lambda: [cv2.imencode(kind, noise)[1].tobytes()]


class Answers(_Server):
    """A server that says the same to every question of a kind, until it has been asked often."""

    def __init__(self, document: Any) -> None:
        self.option, self.url, self.seconds = "x", "http://localhost:1", 1.0
        self.document, self.left = document, 9

    def ask(self, path: str, *_: Any, **__: Any) -> bytes:
        self.left -= 1
        if not self.left:
            raise BadInput("asked too often")
        return json.dumps(next((a for kind, a in self.document.items() if kind in path), None)).encode()


def read_answers(data: bytes) -> object:
    """What ComfyUI and A1111 say, whoever they are."""
    servers.POLL = 0.0
    document = checked(dict[str, Any], parse_json(data, "x"), "x")
    if "error" in document:
        return _said(data)
    values = {"prompt": "", "negative": "", "seed": 0, "strength": 1, "checkpoint": ""}
    painting = (
        _Comfy(Answers(document), _workflow(servers.SHIPPED, "x"))
        if document.pop("comfy", False)
        else _Automatic(Answers(document))
    )
    assert painting.doing
    return painting.paint(np.zeros((8, 8, 3), np.uint8), np.ones((8, 8), bool), values)


def read_depth(name: str) -> Callable[[bytes], object]:
    return in_file(name, lambda path: _from_file(path, "depth", 6, 8))


def depth_seeds() -> list[bytes]:
    depth = np.linspace(1, 2, 48, dtype=np.float32).reshape(6, 8)
    arrays = depth, depth.astype(">f8")
    return [file_seeds(partial(np.save, arr=array), "d.npy")()[0] for array in arrays]


def onnx_seed() -> list[bytes]:
    node = pixelwise("image", "y", np.eye(3))
    return [model([node], {"image": (1, 3, "h", "w")}, (1, 3, "h", "w"))]


def stage_seed(path: Path) -> None:
    StageStore(path.parent, "key", True).save(path.name, (np.arange(6.0), Camera("a", 4, 3, 5, 5, 2, 1, np.eye(4))))
    path.with_suffix(".npz").rename(path)


def scene_seed(name: str) -> Callable[[], list[bytes]]:
    return file_seeds(lambda p: WRITERS[name](p, some(20)), name)


def read_header(data: bytes) -> object:
    return in_file("h.ply", header_of)(b"ply\n" + data + b"\nend_header\n")


def ply_header() -> list[bytes]:
    return [file_seeds(lambda p: write_gaussians(p, some(2)), "h.ply")()[0].partition(b"\nend_header")[0][4:]]


def job_seed(path: Path) -> None:
    save_job(path.parent, RemovalJob(*(str(path.parent / n) for n in "abcd"), set=SETTINGS))
    (path.parent / "job.json").rename(path)


READERS = {
    r.name: r
    for r in (
        Reader("json", lambda d: parse_json(d, "x"), dumped(TRANSFORMS, INRIA, BOX), needs_files=False),
        Reader("ids", lambda d: camera_id(d.decode("utf-8", "surrogatepass"), "x") if ok(d) else None,
               lambda: [b"images/a.png", "ä/ü".encode()], needs_files=False),
        Reader("settings", read_settings, dumped(SETTINGS), True, False),
        Reader("ply header", read_header, ply_header),
        Reader("sog description", read_sog, sog_descriptions, True, False),
        Reader("server", read_answers, dumped(COMFY, AUTOMATIC, REFUSED), True, False),
        Reader("workflow", in_file("w.json", lambda p: _workflow(p, "x")), dumped(WORKFLOW), True),
        Reader("depth npy", read_depth("d.npy"), depth_seeds),
        Reader("depth picture", read_depth("d.png"), picture(".png")),
        Reader("onnx", in_file("m.onnx", lambda p: read_onnx("x", p)), onnx_seed),
        Reader("transforms", read_json_cameras, dumped(TRANSFORMS), True),
        Reader("inria", read_json_cameras, dumped(INRIA), True),
        Reader("colmap bin", read_colmap("bin"), colmap_seeds),
        Reader("colmap txt", read_colmap("txt"), lambda: [SEPARATOR.join(COLMAP_TEXTS)]),
        Reader("roi", in_file("r.json", read_region), dumped(BOX, [BOX, BOX]), True),
        Reader("job", in_file("job.json", lambda p: load_job(p.parent)), file_seeds(job_seed), True),
        Reader("stage", in_file("stage.npz", lambda p: StageStore(p.parent, "key", True).load("stage")),
               file_seeds(stage_seed)),
        Reader("photo png", in_file("p.png", read_photo), picture(".png")),
        Reader("photo png inside", lambda d: in_file("p.png", read_photo)(with_checksums(d)), picture(".png")),
        Reader("photo jpg", in_file("p.jpg", read_photo), picture(".jpg")),
        Reader("ply", in_file("s.ply", read_scene), file_seeds(lambda p: write_gaussians(p, some(20)), "s.ply")),
        *(Reader(name, in_file(name, read_scene), scene_seed(name)) for name in WRITERS),
        *(spz_inside(name) for name in ("1.spz", "2.spz", "3.spz")),
        Reader("sog parts", read_sog_parts, lambda: [SEPARATOR.join(sog_seed().values())]),
    )
}  # fmt: skip


def ok(data: bytes) -> bool:
    """Whether the bytes are a text at all."""
    try:
        data.decode("utf-8", "surrogatepass")
    except UnicodeDecodeError:
        return False
    return True


def mutated(data: bytes, rng: random.Random, is_json: bool) -> bytes:
    """The data with a few changes: of values where they are JSON, else (and sometimes there too) of bytes."""
    if is_json and rng.random() < 0.8:
        try:
            document = json.loads(data)
        except (ValueError, RecursionError):
            document = None
        if isinstance(document, dict | list):
            for _ in range(rng.choice((1, 1, 1, 2, 5))):
                document = _with_another_value(document, rng)
            return json.dumps(document).encode()
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4, 16))):
        at = rng.randrange(len(changed) + 1)
        match rng.randrange(6):
            case 0:
                changed[at : at + 1] = bytes([rng.randrange(256)])
            case 1:
                changed[at : at + rng.choice((1, 4, 8))] = b""
            case 2:
                changed[at:at] = rng.choice(TOKENS)
            case 3:
                token = rng.choice(TOKENS)
                changed[at : at + len(token)] = token
            case 4:
                other = rng.randrange(len(changed) + 1)
                changed[at : at + 16] = changed[other : other + 16]
            case 5:
                if rng.random() < 0.2:
                    del changed[at:]
                elif at < len(changed):
                    changed[at] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _with_another_value(node: Any, rng: random.Random) -> Any:
    if isinstance(node, dict | list) and node and rng.random() < 0.85:
        keys = list(node) if isinstance(node, dict) else range(len(node))
        key = rng.choice(keys)
        copy = dict(node) if isinstance(node, dict) else list(node)
        if rng.random() < 0.1:
            del copy[key]
        else:
            copy[key] = _with_another_value(node[key], rng)
        return copy
    return rng.choice(NASTY)


def case(reader: Reader, seeds: list[bytes], number: int) -> bytes:
    """The case of this number: always the same."""
    rng = random.Random(f"{reader.name} {number}")
    return mutated(rng.choice(seeds), rng, reader.is_json)

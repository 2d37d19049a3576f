"""Camera files: nerfstudio transforms.json, COLMAP models, Inria's cameras.json. The one border of their conventions.

Everything behind it is OpenCV: x right, y down, z forward, world→camera, pixel centres at +0.5.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from ..camera import LARGEST_PICTURE, LARGEST_SIDE, Camera, Distortion, output_name
from ..errors import BadInput, refusing
from ..files import require_file, write_json
from ..gaussians import quats_to_matrices
from ..schema import Between, checked, read_json, shown

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # the camera's own axes: y up, z backward → y down, z forward
NARROWEST, WIDEST = 1e4, 1e-3  # focal lengths over the picture's width: views of a hundredth and of 179.9 degrees
LONGEST_NAME = 200  # bytes of each part of an ID: file systems allow 255, and our own endings come behind it
LONGEST_ID = 1000
LensAngle = Annotated[float, Between(1e-4, math.pi - 1e-4)]  # radians
REFUSED = {  # camera models that have no pinhole picture
    "fisheye": ".*FISHEYE|FOV",
    "panoramic": "EQUIRECTANGULAR|SPHERICAL|PANORAMIC|(VR180|OMNIDIRECTIONALSTEREO)_[LR]",
    "orthographic": "ORTHOGRAPHIC|ORTHOPHOTO",
}
PHOTOS = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
COLMAP_MODELS = {  # in the order of their numbers in cameras.bin; each one's parameters as _Entry names them, ? unread
    "SIMPLE_PINHOLE": "fl_x cx cy",
    "PINHOLE": "fl_x fl_y cx cy",
    "SIMPLE_RADIAL": "fl_x cx cy k1",
    "RADIAL": "fl_x cx cy k1 k2",
    "OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "? ? ? ? ? ? ? ?",
    "FULL_OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "FOV": "? ? ? ? ?",
    "SIMPLE_RADIAL_FISHEYE": "? ? ? ?",
    "RADIAL_FISHEYE": "? ? ? ? ?",
    "THIN_PRISM_FISHEYE": "? ? ? ? ? ? ? ? ? ? ? ?",
}
COLMAP_DAMAGE = (struct.error, ValueError, IndexError, KeyError, OverflowError)
ColmapLens = tuple[str, int, int, list[float]]  # model, width, height, parameters
Pose = tuple[str, int, list[float], list[float]]  # name, number of the lens, quaternion wxyz, translation


def read_cameras(
    path: Path | str,
    images: Path | None = None,  # folder of the photos; default: beside the camera file
) -> tuple[Camera, ...]:
    """Read a nerfstudio transforms.json, an Inria cameras.json or a COLMAP folder, told apart by content.

    In the file's order: OpenCV axes, world→camera, pixel centres at integer + ½, focal lengths in pixels.

    Raises
    ------
    BadInput
        If the file is missing, of another kind, empty, or a camera is of a kind that cannot be used.

    Examples
    --------
    >>> camera = read_cameras("transforms.json")[0]
    >>> camera.width, camera.height, camera.viewmat.shape
    (60, 45, (4, 4))
    """
    path = Path(path)
    if path.is_dir():
        cameras = tuple(sorted(_read_colmap(path, images), key=lambda c: c.id))
    else:
        document = read_json(path, "cameras")
        if isinstance(document, dict) and isinstance(document.get("frames"), list):
            cameras = tuple(_read_transforms(path, document, images or path.parent))
        elif isinstance(document, list) and document and isinstance(document[0], dict) and "rotation" in document[0]:
            cameras = tuple(_read_inria(path, document, images or path.parent))
        else:
            raise BadInput(f"{path} holds no cameras: a transforms.json, cameras.json or COLMAP folder expected")
    if not cameras:
        raise BadInput(f"{path} holds no camera")
    names: dict[str, Camera] = {}
    for c in cameras:
        other = names.setdefault(output_name(c.id), c)
        if other is not c:
            both = f"IDs, {other.id} and {c.id}, whose pictures would have one name"
            raise BadInput(f"{path}: two cameras have {f'the ID {c.id}' if other.id == c.id else both}")
    return cameras


def write_transforms(path: Path | str, cameras: Sequence[Camera]) -> None:
    """Write a nerfstudio transforms.json with exact intrinsics per frame. Written atomically.

    Beside nerfstudio's pose it holds the view matrix, as inverting twice does not give every last bit back.
    """
    frames = []
    for c in cameras:
        lens = {"w": c.width, "h": c.height, "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy}
        pose = (np.linalg.inv(c.viewmat) @ OPENGL_TO_OPENCV).tolist()
        frame = {"file_path": c.id, "split": c.split, **lens, **asdict(c.distortion or Distortion())}
        frames.append({**frame, "transform_matrix": pose, "world_to_camera": c.viewmat.tolist()})
    write_json(Path(path), {"camera_model": "OPENCV", "frames": frames})


def camera_id(name: Any, where: str) -> str:
    """A camera's name as a safe relative path: `./` dropped; what leads out or no file can be called is refused."""
    if not isinstance(name, str) or not name.strip():
        raise BadInput(f"{where}: a camera has no name")
    parts = [p for p in name.replace("\\", "/").split("/") if p != "."]
    if ".." in parts or name.startswith(("/", "\\")) or re.match(r"^[A-Za-z]:", name):
        raise BadInput(f"{where}: the camera name {shown(name)} leads out of the output folder")
    checked(str, name, f"{where}: the camera's name")
    if not all(p.strip() for p in parts) or any(ord(c) < 32 or ord(c) == 127 for c in name):
        raise BadInput(f"{where}: no file can have the camera's name {shown(name)}")
    if len(name.encode()) > LONGEST_ID or any(len(p.encode()) > LONGEST_NAME for p in parts):
        raise BadInput(f"{where}: the camera name {shown(name)} is longer than a file's can be")
    return "/".join(parts)


def rigid(
    matrix: Any,  # [4, 4] or [3, 4], camera→world or world→camera
    where: str,
) -> np.ndarray:
    """A pose [4, 4] with its rotation orthonormal; a uniform scale is taken off.

    Raises BadInput if it is not a finite 4×4 matrix, or it mirrors, shears or flattens.
    """
    m = _numbers(matrix)
    if m.shape == (3, 4):
        m = np.vstack([m, [0, 0, 0, 1]])
    if m.shape != (4, 4) or not np.isfinite(m).all():
        raise BadInput(f"{where}: the pose is not a finite 4×4 matrix")
    largest = float(np.abs(m[:3, :3]).max())
    if np.abs(m).max() > 1e150 or largest < 1e-150:
        raise BadInput(f"{where}: the pose's numbers make no sense")
    s = np.linalg.svd(m[:3, :3] / largest, compute_uv=False)
    if s[2] < 1e-9 or s[0] / s[2] > 1.001:
        raise BadInput(f"{where}: the pose is sheared or flat; only rotation, translation and uniform scale are poses")
    if np.linalg.det(m[:3, :3]) < 0:
        raise BadInput(f"{where}: the pose mirrors the scene")
    return np.block([[_nearest_rotation(m[:3, :3]), m[:3, 3:]], [np.zeros((1, 3)), np.ones((1, 1))]])


def _numbers(value: Any) -> np.ndarray:
    """A value from a file as float64; without elements if it is no array of numbers."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError, RecursionError):
        return np.zeros(0)


def _nearest_rotation(linear: np.ndarray) -> np.ndarray:
    """The rotation in a rotation with uniform scale [3, 3]: Newton's iteration X ← (X + X⁻ᵀ) / 2 (Higham 1986).

    In products and sums of single numbers, as LAPACK's last bits differ between NumPys and Blender has its own.
    """
    x = linear / np.sqrt((linear**2).sum() / 3)
    for _ in range(6):  # quadratic from 1e-3 on
        cofactors = np.cross(x[[1, 2, 0]], x[[2, 0, 1]])
        x = (x + cofactors / (x[0] * cofactors[0]).sum()) / 2
    return x


def _inverted(pose: np.ndarray) -> np.ndarray:
    """A rigid pose [4, 4] the other way round, to the same bits with every NumPy."""
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = pose[:3, :3].T, -(pose[:3, :3] * pose[:3, 3:]).sum(0)
    return inverse


def make_camera(
    where: str,
    name: Any,
    viewmat: np.ndarray,
    size: tuple[int, int],
    intrinsics: tuple[float, float, float, float],  # fx, fy, cx, cy
    distortion: Distortion,
    split: str,
    image: Path | None,
) -> Camera:
    """A checked Camera; raises BadInput if a size, focal length or principal point makes no sense."""
    (width, height), (fx, fy, cx, cy) = size, intrinsics
    if not 0 < width <= LARGEST_SIDE or not 0 < height <= LARGEST_SIDE or width * height > LARGEST_PICTURE:
        raise BadInput(f"{where}: an image of {shown(width)}×{shown(height)} pixels makes no sense")
    if not all(map(math.isfinite, (fx, fy, cx, cy))) or fx <= 0 or fy <= 0:
        raise BadInput(f"{where}: focal lengths must be positive, got {fx} and {fy}")
    if not all(WIDEST * width <= f <= NARROWEST * width for f in (fx, fy)) or max(abs(cx), abs(cy)) > NARROWEST * width:
        raise BadInput(
            f"{where}: no lens has focal lengths {fx:g} and {fy:g} and centre {cx:g}, {cy:g} ({width} px wide)"
        )
    if not np.isfinite(distortion.coefficients).all():
        raise BadInput(f"{where}: the distortion coefficients are not finite")
    bent = distortion if distortion.coefficients.any() else None
    return Camera(camera_id(name, where), width, height, fx, fy, cx, cy, viewmat, split, image, bent)


def refuse_model(model: str, where: str) -> None:
    """Raise BadInput if a camera model is one of those that have no pinhole picture."""
    for kind, names in REFUSED.items():
        if re.fullmatch(names, model, re.IGNORECASE):
            raise BadInput(f"{where}: {kind} cameras ({model}) are not supported; undistort the photos to a pinhole")


@dataclass(frozen=True)
class _Entry(Distortion):
    """A camera as its file tells it, in nerfstudio's names; of a transforms.json with what that says of all frames."""

    file_path: Any = None
    transform_matrix: list[list[float]] | None = None
    world_to_camera: Any = None  # our own; counts only where transform_matrix says the same
    w: int | None = None
    h: int | None = None
    fl_x: float | None = None
    fl_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    camera_angle_x: Any = None  # checked where it is used
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    camera_model: str = "OPENCV"
    is_fisheye: bool = False
    split: Literal["train", "test"] = "train"


def _camera(entry: _Entry, where: str, viewmat: np.ndarray, photos: Path) -> Camera:
    """The camera that an entry tells of, with what it leaves out: a lens looks straight ahead, a photo has the size."""
    name = camera_id(entry.file_path, where)
    photo = _photo(photos, name)
    width, height, fx = entry.w, entry.h, entry.fl_x
    if width is None or height is None:
        from .images import read_image  # needs OpenCV, which files that name their size do without

        if not photo.exists():
            raise BadInput(f"{where}: no image size (w, h) and no photo {photo} to take it from")
        height, width = read_image(photo).shape[:2]
    if fx is None and entry.camera_angle_x is not None:
        angle = checked(LensAngle, entry.camera_angle_x, f"{where}: camera_angle_x")
        fx = 0.5 * width / math.tan(0.5 * angle)
    if fx is None:
        raise BadInput(f"{where}: no focal length (fl_x or camera_angle_x)")
    fy = fx if entry.fl_y is None else entry.fl_y
    cx, cy = width / 2 if entry.cx is None else entry.cx, height / 2 if entry.cy is None else entry.cy
    if extra := [k for k in ("k4", "k5", "k6") if getattr(entry, k)]:
        raise BadInput(f"{where}: distortion coefficients {', '.join(extra)} are not supported; undistort first")
    distortion = Distortion(entry.k1, entry.k2, entry.p1, entry.p2, entry.k3)
    return make_camera(where, name, viewmat, (width, height), (fx, fy, cx, cy), distortion, entry.split, photo)


def _read_transforms(path: Path, document: dict[str, Any], photos: Path) -> Iterator[Camera]:
    of_all = {key: v for key, v in document.items() if key != "frames"}
    for k, given in enumerate(document["frames"]):
        where = f"{path}, frame {k}"
        if not isinstance(given, dict) or given.get("transform_matrix") is None:
            raise BadInput(f"{where}: no transform_matrix")
        entry: _Entry = checked(_Entry, {**of_all, **given}, where, extra=True)
        refuse_model("FISHEYE" if entry.is_fisheye else entry.camera_model, where)
        viewmat = _inverted(rigid(entry.transform_matrix, where) @ OPENGL_TO_OPENCV)
        exact = _numbers(entry.world_to_camera)
        if exact.shape == (4, 4) and np.abs(exact - viewmat).max() <= 1e-12 * (1 + np.abs(viewmat).max()):
            viewmat = exact  # as `write_transforms` told it; another program has not changed the pose since
        yield _camera(entry, where, viewmat, photos)


def _photo(folder: Path, name: str) -> Path:
    """The photo of a camera; names without an extension (Inria's, the original NeRF's) take the file that is there."""
    path = folder / name
    if not path.exists() and not path.parent.is_dir() and (folder / path.name).exists():
        return folder / path.name  # --images names the very folder that the camera's name begins with
    if path.suffix.lower() in PHOTOS or path.exists():
        return path
    candidates = [path.with_name(path.name + e) for e in (*PHOTOS, *(e.upper() for e in PHOTOS))]
    return next((c for c in candidates if c.exists()), candidates[0])


@dataclass(frozen=True)
class _InriaEntry:
    """A camera of Inria's cameras.json."""

    img_name: Any
    rotation: list[list[float]]
    position: list[float]
    fx: float
    fy: float
    width: int
    height: int


def _read_inria(path: Path, document: list[Any], photos: Path) -> Iterator[Camera]:
    for k, given in enumerate(document):
        where = f"{path}, camera {k}"
        entry: _InriaEntry = checked(_InriaEntry, given, where, extra=True)
        rotation, position = _numbers(entry.rotation), _numbers(entry.position)
        if rotation.shape != (3, 3) or position.shape != (3,):
            raise BadInput(f"{where}: rotation must be 3×3 and position 3 numbers")
        viewmat = _inverted(rigid(np.column_stack([rotation, position]), where))
        told = _Entry(file_path=entry.img_name, w=entry.width, h=entry.height, fl_x=entry.fx, fl_y=entry.fy)
        yield _camera(told, where, viewmat, photos)


def _read_colmap(folder: Path, images: Path | None) -> Iterator[Camera]:
    places = (folder, folder / "sparse" / "0", folder / "sparse", folder / "0")
    models = ((p / f"cameras{e}", p / f"images{e}") for p in places for e in (".bin", ".txt"))
    found = next((m for m in models if m[0].exists() and m[1].exists()), None)
    if found is None:
        raise BadInput(f"{folder} holds no COLMAP model (cameras and images, .bin or .txt)")
    model, binary = found[0].parent, found[0].suffix == ".bin"
    read_lenses, read_poses = (_lenses_bin, _poses_bin) if binary else (_lenses_txt, _poses_txt)
    damaged = refusing(f"the COLMAP model in {model} is damaged", *COLMAP_DAMAGE)
    with damaged, refusing(f"cannot read the COLMAP model in {model}", OSError):
        lenses, poses = read_lenses(found[0]), read_poses(found[1])
    near = (place / "images" for place in (folder, folder.parent, folder.parent.parent))
    photos = images or next((f for f in near if f.is_dir()), folder)
    for number, (given, lens, quat, translation) in enumerate(poses):
        name = camera_id(given, f"{model}, image {number}")
        where = f"{model}, image {name}"
        if lens not in lenses:
            raise BadInput(f"{where}: its camera {lens} is not in the model")
        kind, width, height, parameters = lenses[lens]
        refuse_model(kind, where)
        names = COLMAP_MODELS.get(kind, "?").split()
        if "?" in names:
            raise BadInput(f"{where}: the camera model {kind} is not supported; undistort the photos to a pinhole")
        if len(parameters) < len(names):
            raise BadInput(f"{where}: the camera model {kind} has too few parameters")
        if not np.isfinite([*quat, *translation]).all() or np.linalg.norm(quat) < 1e-9:
            raise BadInput(f"{where}: the pose is not finite")
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = quats_to_matrices(np.array([quat]))[0], translation
        told: dict[str, Any] = {"file_path": name, "w": width, "h": height, **dict(zip(names, parameters))}
        yield _camera(_Entry(**told), where, viewmat, photos)


def _data_lines(path: Path) -> list[str]:
    lines = require_file(path).read_text(encoding="utf-8").split("\n")
    return [line.rstrip("\r") for line in lines if not line.startswith("#")]


def _lenses_txt(path: Path) -> dict[int, ColmapLens]:
    rows = [line.split() for line in _data_lines(path) if line.strip()]
    return {int(r[0]): (r[1], int(r[2]), int(r[3]), [float(v) for v in r[4:]]) for r in rows}


def _poses_txt(path: Path) -> list[Pose]:
    lines = iter(_data_lines(path))
    images = ((line.strip(), next(lines, None)) for line in lines if line.strip())  # and its 2D points, maybe empty
    words = (image.split(" ", 9) for image, _ in images)  # the name comes last and may hold spaces
    return [(w[9], int(w[8]), [float(v) for v in w[1:5]], [float(v) for v in w[5:8]]) for w in words]


def _lenses_bin(path: Path) -> dict[int, ColmapLens]:
    data = require_file(path).read_bytes()
    (count,), at, found = struct.unpack_from("<Q", data), 8, {}
    for _ in range(count):
        number, kind, width, height = struct.unpack_from("<iiQQ", data, at)
        if not 0 <= kind < len(COLMAP_MODELS):
            raise ValueError(f"unknown camera model {kind}")
        model, names = list(COLMAP_MODELS.items())[kind]
        parameters = struct.unpack_from(f"<{len(names.split())}d", data, at + 24)
        at += 24 + 8 * len(parameters)
        found[number] = (model, width, height, list(parameters))
    return found


def _poses_bin(path: Path) -> list[Pose]:
    data = require_file(path).read_bytes()
    (count,), at, poses = struct.unpack_from("<Q", data), 8, []
    for _ in range(count):
        *pose, lens = struct.unpack_from("<7di", data, at + 4)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end].decode("utf-8")
        (points,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * points
        if at > len(data):
            raise ValueError("images.bin is truncated")
        poses.append((name, lens, pose[:4], pose[4:]))
    return poses

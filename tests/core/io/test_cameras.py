"""Camera files: the same camera from every format, and clear refusals."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from gimp3d.camera import Camera, Distortion
from gimp3d.errors import BadInput
from gimp3d.gaussians import matrices_to_quats
from gimp3d.io.cameras import read_cameras, write_transforms
from gimp3d.io.images import load_view, read_image, write_png


def colmap(folder: Path, cameras: tuple[Camera, ...], binary: bool) -> None:
    """A COLMAP model of one OPENCV or PINHOLE lens per image, written with struct and plain text."""
    folder.mkdir(parents=True, exist_ok=True)
    lenses, poses = [], []
    for k, c in enumerate(cameras, 1):
        d = c.distortion
        p = [c.fx, c.fy, c.cx, c.cy, *([d.k1, d.k2, d.p1, d.p2] if d else [])]
        lenses.append((k, ("PINHOLE", 1) if not d else ("OPENCV", 4), c.width, c.height, p))
        poses.append((k, matrices_to_quats(c.R[None])[0], c.t, c.id))
    if not binary:
        lines = [f"{k} {m[0]} {w} {h} " + " ".join(map(repr, map(float, p))) for k, m, w, h, p in lenses]
        (folder / "cameras.txt").write_text("# a comment\n" + "\n".join(lines) + "\n")
        text = ""
        for k, q, t, name in poses:
            text += f"{k} " + " ".join(repr(float(v)) for v in (*q, *t)) + f" {k} {name}\n\n"
        (folder / "images.txt").write_text("# a comment\n" + text)
        return
    data = struct.pack("<Q", len(lenses))
    for k, m, w, h, p in lenses:
        data += struct.pack("<iiQQ", k, m[1], w, h) + struct.pack(f"<{len(p)}d", *p)
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(poses))
    for k, q, t, name in poses:
        data += struct.pack("<i7di", k, *q, *t, k) + name.encode() + b"\0"
        data += struct.pack("<Q", 2) + struct.pack("<ddqddq", 1, 2, -1, 3, 4, 7)  # two points to skip
    (folder / "images.bin").write_bytes(data)


@pytest.fixture
def views(block_cameras: tuple[Camera, ...]) -> tuple[Camera, ...]:
    moved = []
    for k, c in enumerate(block_cameras):
        moved.append(Camera(f"images/a photo {k}.png", c.width, c.height, 100.5, 101.25, 60.25, 44.5, c.viewmat))
    return tuple(moved)


def test_every_format_gives_the_same_camera_and_pixels(views: tuple[Camera, ...], tmp_path: Path) -> None:
    write_transforms(tmp_path / "transforms.json", views)
    colmap(tmp_path / "text", views, binary=False)
    colmap(tmp_path / "binary" / "sparse" / "0", views, binary=True)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3))
    for path in (tmp_path / "transforms.json", tmp_path / "text", tmp_path / "binary"):
        for expected, got in zip(views, read_cameras(path)):
            assert got.id == expected.id and (got.width, got.height) == (120, 90)
            np.testing.assert_allclose(got.viewmat, expected.viewmat, atol=1e-9)
            np.testing.assert_allclose(got.K, expected.K, atol=1e-9)
            np.testing.assert_allclose(got.project(points)[0], expected.project(points)[0], atol=1e-6)


def test_inria_cameras_agree_where_the_principal_point_is_central(views: tuple[Camera, ...], tmp_path: Path) -> None:
    entries = []
    for k, c in enumerate(views):
        entry = {"id": k, "img_name": c.id, "width": 120, "height": 90, "fx": c.fx, "fy": c.fy}
        entries.append({**entry, "position": c.centre.tolist(), "rotation": c.R.T.tolist()})
    (tmp_path / "cameras.json").write_text(json.dumps(entries))
    for expected, got in zip(views, read_cameras(tmp_path / "cameras.json")):
        np.testing.assert_allclose(got.viewmat, expected.viewmat, atol=1e-9)
        assert (got.cx, got.cy) == (60, 45)


@pytest.mark.parametrize("extension", [".png", ".jpg", ".JPG"])
def test_names_without_an_extension_find_their_photo(extension: str, views: tuple[Camera, ...], tmp_path: Path) -> None:
    bare = [
        Camera("a.b/photo 1", *[getattr(views[0], f) for f in ("width", "height", "fx", "fy", "cx", "cy", "viewmat")])
    ]
    write_transforms(tmp_path / "t.json", bare)
    (tmp_path / "a.b").mkdir()
    (tmp_path / "a.b" / f"photo 1{extension}").touch()
    assert read_cameras(tmp_path / "t.json")[0].image == tmp_path / "a.b" / f"photo 1{extension}"


def test_the_photo_folder_may_be_the_one_that_names_begin_with(views: tuple[Camera, ...], tmp_path: Path) -> None:
    write_transforms(tmp_path / "t.json", views)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "a photo 0.png").touch()
    found = read_cameras(tmp_path / "t.json", tmp_path / "elsewhere")
    assert found[0].image == tmp_path / "elsewhere" / "a photo 0.png"


def test_transforms_are_opengl_axes(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = [0, 0, 5]  # at z = 5, looking down −z, y up
    frame = {"file_path": "./a.png", "transform_matrix": pose.tolist()}
    (tmp_path / "t.json").write_text(json.dumps({"w": 100, "h": 80, "fl_x": 50, "frames": [frame]}))
    (camera,) = read_cameras(tmp_path / "t.json")
    assert camera.id == "a.png" and camera.fy == 50 and (camera.cx, camera.cy) == (50, 40)
    (u, v), z = camera.project(np.array([1.0, 1.0, 0.0]))
    assert (u, v, z) == pytest.approx((60, 30, 5))  # right of and above the centre


def test_frames_override_the_shared_intrinsics_and_carry_their_split(tmp_path: Path) -> None:
    frames = [
        {"file_path": "a", "transform_matrix": np.eye(4).tolist()},
        {"file_path": "b", "transform_matrix": (2 * np.eye(4)).tolist(), "fl_x": 70, "w": 64, "split": "test"},
    ]
    document = {"camera_angle_x": 2 * np.arctan(1), "w": 100, "h": 80, "frames": frames}
    (tmp_path / "t.json").write_text(json.dumps(document))
    a, b = read_cameras(tmp_path / "t.json")
    assert (a.fx, a.width, a.split) == (pytest.approx(50), 100, "train")
    assert (b.fx, b.width, b.split) == (70, 64, "test")
    np.testing.assert_allclose(b.R @ b.R.T, np.eye(3), atol=1e-12)  # the scale is stripped


def test_photos_are_undistorted_to_the_same_pinhole(tmp_path: Path) -> None:
    lens = Distortion(k1=0.12, k2=-0.05, p1=0.002, p2=-0.001)
    camera = Camera("p.png", 240, 180, 200, 205, 118, 92, np.eye(4), image=tmp_path / "p.png", distortion=lens)
    at_integers = camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    photo = np.zeros((180, 240, 3), np.uint8)
    points = np.array([[x, y, 4.0] for x in (-1.6, 0.1, 1.5) for y in (-1.2, 0.2, 1.1)])
    seen, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), at_integers, lens.coefficients)
    y, x = np.mgrid[:180, :240]
    for u, v in seen[:, 0]:
        photo = np.maximum(photo, (255 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / 8))[..., None].astype(np.uint8))
    write_png(tmp_path / "p.png", photo)
    image, pinhole = load_view(camera)
    assert pinhole.distortion is None
    for u, v in camera.project(points)[0]:
        r, c = int(v), int(u)
        patch = image[max(r - 6, 0) : r + 7, max(c - 6, 0) : c + 7, 0].astype(float)
        dy, dx = np.mgrid[: patch.shape[0], : patch.shape[1]]
        at = (
            (dx * patch).sum() / patch.sum() + max(c - 6, 0) + 0.5,
            (dy * patch).sum() / patch.sum() + max(r - 6, 0) + 0.5,
        )
        assert at == pytest.approx((u, v), abs=0.1)


def test_a_photo_of_another_size_is_resampled_and_of_another_shape_refused(tmp_path: Path) -> None:
    camera = Camera("p.png", 60, 40, 50, 50, 30, 20, np.eye(4), image=tmp_path / "p.png")
    write_png(tmp_path / "p.png", np.full((80, 120, 3), 7, np.uint8))
    assert load_view(camera)[0].shape == (40, 60, 3)
    write_png(tmp_path / "p.png", np.full((60, 60, 3), 7, np.uint8))
    with pytest.raises(BadInput, match="60×60"):
        load_view(camera)


def test_pictures_of_every_kind_become_rgb(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    cases = {
        "grey": (rng.integers(0, 255, (5, 6), dtype=np.uint8), lambda p: p[..., None].repeat(3, -1)),
        "alpha": (
            np.dstack([np.full((5, 6, 3), 200, np.uint8), np.full((5, 6), 51, np.uint8)]),
            lambda p: p[..., :3] // 5,
        ),
        "deep": (np.full((5, 6, 3), 65535, np.uint16), lambda p: np.full((5, 6, 3), 255, np.uint8)),
    }
    for name, (picture, expected) in cases.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), picture)
        np.testing.assert_array_equal(read_image(tmp_path / f"{name}.png"), expected(picture), err_msg=name)
    (tmp_path / "no.png").write_text("hello")
    with pytest.raises(BadInput, match="not a picture"):
        read_image(tmp_path / "no.png")


POSE = np.eye(4).tolist()
MIRROR = np.diag([-1.0, 1, 1, 1]).tolist()
SHEAR = np.array([[1, 1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]).tolist()
REFUSALS = {
    "no frames": ({"frames": []}, "no camera"),
    "no focal": ({"frames": [{"file_path": "a", "transform_matrix": POSE}]}, "no focal length"),
    "no pose": ({"fl_x": 5, "frames": [{"file_path": "a"}]}, "no transform_matrix"),
    "mirrored": ({"fl_x": 5, "frames": [{"file_path": "a", "transform_matrix": MIRROR}]}, "mirrors"),
    "sheared": ({"fl_x": 5, "frames": [{"file_path": "a", "transform_matrix": SHEAR}]}, "sheared"),
    "NaN": ({"fl_x": 5, "frames": [{"file_path": "a", "transform_matrix": [[float("nan")] * 4] * 4}]}, "finite"),
    "zero focal": ({"fl_x": 0, "frames": [{"file_path": "a", "transform_matrix": POSE}]}, "positive"),
    "zero size": ({"fl_x": 5, "w": 0, "frames": [{"file_path": "a", "transform_matrix": POSE}]}, "makes no sense"),
    "same ID twice": ({"fl_x": 5, "frames": [{"file_path": "a", "transform_matrix": POSE}] * 2}, "ID a"),
    "no name": ({"fl_x": 5, "frames": [{"transform_matrix": POSE}]}, "no name"),
    "absolute name": ({"fl_x": 5, "frames": [{"file_path": "/etc/x", "transform_matrix": POSE}]}, "leads out"),
    "fisheye": (
        {"fl_x": 5, "camera_model": "OPENCV_FISHEYE", "frames": [{"file_path": "a", "transform_matrix": POSE}]},
        "fisheye",
    ),
    "k4": ({"fl_x": 5, "k4": 0.1, "frames": [{"file_path": "a", "transform_matrix": POSE}]}, "k4"),
    "width of another type": ({"fl_x": 5, "w": [10], "frames": [{"file_path": "a", "transform_matrix": POSE}]}, ": w:"),
    "no angle": ({"camera_angle_x": 0, "frames": [{"file_path": "a", "transform_matrix": POSE}]}, "camera_angle_x"),
    "null angle": ({"camera_angle_x": None, "frames": [{"file_path": "a", "transform_matrix": POSE}]}, "no focal"),
    "endless angle": (
        {"camera_angle_x": float("inf"), "frames": [{"file_path": "a", "transform_matrix": POSE}]},
        "camera_angle_x",
    ),
    "a lens of a million pixels": ({"fl_x": 1e7, "frames": [{"file_path": "a", "transform_matrix": POSE}]}, "no lens"),
    "400 digits": ({"fl_x": 10**400, "frames": [{"file_path": "a", "transform_matrix": POSE}]}, "fl_x: a finite"),
    "400 digits in a pose": ({"fl_x": 5, "frames": [{"file_path": "a", "transform_matrix": [[10**400]]}]}, "finite"),
    "huge pose": (
        {"fl_x": 5, "frames": [{"file_path": "a", "transform_matrix": (1e200 * np.eye(4)).tolist()}]},
        "sense",
    ),
    "too many pixels": (
        {"fl_x": 5e4, "w": 65535, "h": 65535, "frames": [{"file_path": "a", "transform_matrix": POSE}]},
        "makes no sense",
    ),
    "frames of another type": ({"fl_x": 5, "frames": [5, None]}, "no transform_matrix"),
    "300 letters": ({"fl_x": 5, "frames": [{"file_path": "a" * 300, "transform_matrix": POSE}]}, "longer than"),
    "lone surrogate": ({"fl_x": 5, "frames": [{"file_path": "\ud800", "transform_matrix": POSE}]}, "no text"),
    "line break": ({"fl_x": 5, "frames": [{"file_path": "a\nb", "transform_matrix": POSE}]}, "no file can"),
    "one output name": (
        {"fl_x": 5, "frames": [{"file_path": n, "transform_matrix": POSE} for n in ("a.png", "a.jpg")]},
        "one name",
    ),
    "bad split": ({"fl_x": 5, "split": "x", "frames": [{"file_path": "a", "transform_matrix": POSE}]}, "split"),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_bad_camera_files_are_refused_in_one_line(name: str, tmp_path: Path) -> None:
    document, words = REFUSALS[name]
    (tmp_path / "t.json").write_text(json.dumps({"w": 10, "h": 10, **document}))
    with pytest.raises(BadInput, match=words) as caught:
        read_cameras(tmp_path / "t.json")
    assert "\n" not in str(caught.value)


ENTRY = {
    "img_name": "a",
    "rotation": np.eye(3).tolist(),
    "position": [0, 0, 0],
    "fx": 5,
    "fy": 5,
    "width": 9,
    "height": 9,
}


@pytest.mark.parametrize(
    "entry", [None, 5, "x", [], {**ENTRY, "width": None}, {**ENTRY, "fx": "5"}, {**ENTRY, "rotation": "1"}]
)
def test_bad_entries_of_inrias_file_are_refused(entry: object, tmp_path: Path) -> None:
    (tmp_path / "c.json").write_text(json.dumps([ENTRY, entry]))
    with pytest.raises(BadInput, match="camera 1"):
        read_cameras(tmp_path / "c.json")


def test_a_photo_of_one_pixel_is_refused(tmp_path: Path) -> None:
    camera = Camera("p.png", 60, 40, 50, 50, 30, 20, np.eye(4), image=tmp_path / "p.png")
    write_png(tmp_path / "p.png", np.zeros((1, 1, 3), np.uint8))
    with pytest.raises(BadInput, match="far fewer"):
        load_view(camera)


@pytest.mark.parametrize("cut", [4, 30, 70])
def test_truncated_colmap_models_are_refused(cut: int, views: tuple[Camera, ...], tmp_path: Path) -> None:
    colmap(tmp_path, views, binary=True)
    for name in ("cameras.bin", "images.bin"):
        whole = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(whole[:cut])
        with pytest.raises(BadInput, match="damaged"):
            read_cameras(tmp_path)
        (tmp_path / name).write_bytes(whole)


def test_real_cameras_agree_between_formats(shared_data: Path) -> None:
    kitchen = shared_data / "real" / "kitchen_480"
    by_name = {c.id.rsplit("/")[-1]: c for c in read_cameras(kitchen / "sparse")}
    for camera in read_cameras(kitchen / "transforms.json"):
        other = by_name[camera.id.rsplit("/")[-1]]
        np.testing.assert_allclose(camera.viewmat, other.viewmat, atol=1e-6)
        np.testing.assert_allclose(camera.K, other.K, atol=1e-6)


@pytest.mark.parametrize("reach", [1.0, 1e6])
def test_a_written_pose_is_read_to_the_last_bit(reach: float, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    views = []
    for k in range(20):
        viewmat = np.eye(4)
        viewmat[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        viewmat[:3, :3] *= np.linalg.det(viewmat[:3, :3])
        viewmat[:3, 3] = reach * rng.normal(size=3)
        views.append(Camera(f"{k}", 64, 48, 50.0, 50.0, 32.0, 24.0, viewmat))
    write_transforms(tmp_path / "t.json", views)
    back = read_cameras(tmp_path / "t.json")
    assert all((a.viewmat == b.viewmat).all() for a, b in zip(views, back))


def test_a_pose_that_another_program_changed_counts(views: tuple[Camera, ...], tmp_path: Path) -> None:
    write_transforms(tmp_path / "t.json", views)
    document = json.loads((tmp_path / "t.json").read_text())
    pose = np.array(document["frames"][0]["transform_matrix"])
    pose[0, 3] += 1e-6
    document["frames"][0]["transform_matrix"] = pose.tolist()
    document["frames"][1]["world_to_camera"] = "nonsense"
    (tmp_path / "t.json").write_text(json.dumps(document))
    back = read_cameras(tmp_path / "t.json")
    assert back[0].centre[0] == pytest.approx(views[0].centre[0] + 1e-6, abs=1e-12)
    assert np.allclose(back[1].viewmat, views[1].viewmat, atol=1e-12)


def test_a_colmap_name_that_no_file_can_have_is_said_in_one_line(views: tuple[Camera, ...], tmp_path: Path) -> None:
    """Found by make fuzz."""
    colmap(tmp_path, views, binary=True)
    whole = (tmp_path / "images.bin").read_bytes()
    name = views[0].id.encode()
    (tmp_path / "images.bin").write_bytes(whole.replace(name, b"\n" + name[1:]))
    with pytest.raises(BadInput, match="no file can") as caught:
        read_cameras(tmp_path)
    assert "\n" not in str(caught.value)

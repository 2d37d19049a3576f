"""Other splat formats: what an independent writer packed is read back, damaged files are refused in one line."""

from __future__ import annotations

import gzip
import json
import struct
import sys
import tracemalloc
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given
from hypothesis import strategies as st
from property_tests import examples
from scipy.spatial import cKDTree

from gimp3d.camera import Camera
from gimp3d.errors import BadInput
from gimp3d.gaussians import SH_C0, Gaussians, quats_to_matrices
from gimp3d.io.formats import read_scene
from gimp3d.io.ply import write_gaussians
from gimp3d.orbit import look_at
from gimp3d.raster import render

QUICK = examples(25, suppress_health_check=[HealthCheck.function_scoped_fixture])
HALF_TURN = np.diag([1.0, -1.0, -1.0])


def some(count: int = 300, degree: int = 2, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    return Gaussians(
        means=rng.uniform(-3, 3, (count, 3)).astype(np.float32),
        log_scales=rng.uniform(-6, -1, (count, 3)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        opacity_logits=rng.uniform(-3, 3, count).astype(np.float32),
        sh=np.concatenate(
            [rng.uniform(-1, 1, (count, 1, 3)), rng.uniform(-0.4, 0.4, (count, (degree + 1) ** 2 - 1, 3))], 1
        ).astype(np.float32),
    )


def to_byte(unit: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(unit * 255), 0, 255).astype(np.uint8)


def write_splat(path: Path, g: Gaussians) -> None:
    rows = np.zeros(len(g), [("p", "<f4", 3), ("s", "<f4", 3), ("c", "u1", 4), ("q", "u1", 4)])
    rows["p"], rows["s"] = g.means, g.scales
    rows["c"] = to_byte(np.concatenate([0.5 + SH_C0 * g.sh[:, 0], g.opacity[:, None]], 1))
    rows["q"] = np.clip(np.rint(g.quats * 128 + 128), 0, 255)
    path.write_bytes(rows.tobytes())


def pack(unit: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Numbers in [0, 1] as bit fields of one integer, the first in the highest bits."""
    out = np.zeros(len(unit), np.uint32)
    for k, b in enumerate(bits):
        out = out << np.uint32(b) | np.rint(unit[:, k] * ((1 << b) - 1)).astype(np.uint32)
    return out


def smallest_three(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(three components in [0, 1], number of the largest)."""
    largest = np.abs(quats).argmax(1)
    signed = quats * np.sign(np.take_along_axis(quats, largest[:, None], 1))
    small = np.stack([np.delete(q, k) for q, k in zip(signed, largest)])
    return small / np.sqrt(2) + 0.5, largest


def write_compressed_ply(path: Path, g: Gaussians) -> None:
    names = ["x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b"]
    values = np.concatenate([g.means, g.log_scales, 0.5 + SH_C0 * g.sh[:, 0]], 1).astype(np.float32)
    chunks = [values[k : k + 256] for k in range(0, len(values), 256)]
    low, high = np.array([c.min(0) for c in chunks]), np.array([c.max(0) for c in chunks])
    unit = np.concatenate([(c - a) / np.maximum(b - a, 1e-9) for c, a, b in zip(chunks, low, high)])
    bounds = np.stack([(low if end == "min" else high)[:, names.index(n)] for n in names for end in ("min", "max")], 1)
    small, largest = smallest_three(g.quats.astype(float))
    vertex = np.stack(
        [
            pack(unit[:, :3], (11, 10, 11)),
            largest.astype(np.uint32) << 30 | pack(small, (10, 10, 10)),
            pack(unit[:, 3:6], (11, 10, 11)),
            pack(np.concatenate([unit[:, 6:], g.opacity[:, None]], 1), (8, 8, 8, 8)),
        ],
        1,
    )
    rest = g.sh[:, 1:].transpose(0, 2, 1).reshape(len(g), -1)
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {len(chunks)}"]
    lines += [f"property float {end}_{n}" for n in names for end in ("min", "max")]
    lines += [f"element vertex {len(g)}"]
    lines += [f"property uint packed_{n}" for n in ("position", "rotation", "scale", "color")]
    lines += [f"element sh {len(g)}"] + [f"property uchar f_rest_{k}" for k in range(rest.shape[1])]
    body = bounds.astype("<f4").tobytes() + vertex.astype("<u4").tobytes() + to_byte((rest + 4) / 8).tobytes()
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + body)


def turned(g: Gaussians) -> Gaussians:
    """The same scene with y and z pointing the other way (what .spz stores)."""
    signs = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)[: g.sh.shape[1]]
    return replace(g, means=g.means * np.float32([1, -1, -1]), quats=g.quats * np.float32([1, 1, -1, -1]),
                   sh=g.sh * signs[:, None])  # fmt: skip


def spz_body(g: Gaussians, version: int) -> list[bytes]:
    g = turned(g)
    fixed = np.rint(g.means.astype(float) * 4096).astype(np.int32)
    positions = np.stack([fixed & 255, fixed >> 8 & 255, fixed >> 16 & 255], -1).astype(np.uint8)
    if version == 1:
        positions = g.means.astype("<f2")
    header = b"NGSP" + struct.pack("<IIBBBB", version, len(g), g.sh_degree, 12, 0, 0)
    wxyz = g.quats * np.sign(g.quats[:, :1])
    quats = to_byte((wxyz[:, 1:] + 1) / 2).tobytes()
    if version >= 3:
        xyzw = np.roll(g.quats.astype(float), -1, axis=1)
        largest = np.abs(xyzw).argmax(1)
        xyzw *= np.sign(np.take_along_axis(xyzw, largest[:, None], 1))
        packed = largest.astype(np.uint32)
        for k in range(4):
            size = (
                np.rint(np.abs(xyzw[:, k]) * np.sqrt(2) * 511).astype(np.uint32)
                | (xyzw[:, k] < 0).astype(np.uint32) << 9
            )
            packed = np.where(largest == k, packed, packed << np.uint32(10) | np.minimum(size, 1023))
        quats = packed.astype("<u4").tobytes()
    return [
        header,
        positions.tobytes(),
        to_byte(g.opacity).tobytes(),
        to_byte(g.sh[:, 0] * 0.15 + 0.5).tobytes(),
        np.clip(np.rint((g.log_scales + 10) * 16), 0, 255).astype(np.uint8).tobytes(),
        quats,
        np.clip(np.rint(g.sh[:, 1:] * 128 + 128), 0, 255).astype(np.uint8).tobytes(),
    ]


def write_spz(path: Path, g: Gaussians, version: int) -> None:
    header, *streams = spz_body(g, version)
    if version < 4:
        path.write_bytes(gzip.compress(header + b"".join(streams)))
        return
    streams = [s for s in streams if s]
    packed = [zstandard.ZstdCompressor().compress(s) for s in streams]
    head = header[:15] + bytes([len(streams)]) + struct.pack("<I", 32) + bytes(12)
    table = b"".join(struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams))
    path.write_bytes(head + table + b"".join(packed))


def webp(values: np.ndarray, width: int) -> bytes:
    """Rows of RGBA as a lossless picture."""
    height = -(-len(values) // width)
    picture = np.full((height * width, 4), 255, np.uint8)
    picture[: len(values), : values.shape[1]] = values
    ok, data = cv2.imencode(
        ".webp", cv2.cvtColor(picture.reshape(height, width, 4), cv2.COLOR_RGBA2BGRA), [cv2.IMWRITE_WEBP_QUALITY, 101]
    )
    assert ok
    return data.tobytes()


def codes(values: np.ndarray) -> tuple[np.ndarray, list[float]]:
    """Numbers of the nearest of 256 equally spaced code words, and the words."""
    book = np.linspace(values.min(), values.max(), 256)
    return np.rint((values - book[0]) / (book[-1] - book[0]) * 255).astype(np.uint8), book.tolist()


def sog_files(g: Gaussians) -> dict[str, bytes]:
    logs = np.sign(g.means) * np.log1p(np.abs(g.means))
    low, high = logs.min(0), logs.max(0)
    steps = np.rint((logs - low) / (high - low) * 65535).astype(int)
    scales, scale_book = codes(g.log_scales)
    dc, dc_book = codes(g.sh[:, 0])
    small, largest = smallest_three(g.quats.astype(float))
    count = g.sh.shape[1] - 1
    rest, rest_book = codes(g.sh[:, 1:])
    palette = np.zeros((-(-len(g) // 64) * 64, count, 3), np.uint8)
    palette[: len(g)] = rest
    labels = np.arange(len(g))
    meta = {
        "version": 2,
        "count": len(g),
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_book, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": dc_book, "files": ["sh0.webp"]},
        "shN": {"bands": 2, "codebook": rest_book, "files": ["shN_centroids.webp", "shN_labels.webp"]},
    }
    return {
        "meta.json": json.dumps(meta).encode(),
        "means_l.webp": webp((steps & 255).astype(np.uint8), 20),
        "means_u.webp": webp((steps >> 8).astype(np.uint8), 20),
        "scales.webp": webp(scales, 20),
        "quats.webp": webp(np.concatenate([to_byte(small), (largest + 252)[:, None].astype(np.uint8)], 1), 20),
        "sh0.webp": webp(np.concatenate([dc, to_byte(g.opacity)[:, None]], 1), 20),
        "shN_centroids.webp": webp(palette.reshape(-1, 3), 64 * count),
        "shN_labels.webp": webp(np.stack([labels & 255, labels >> 8], 1).astype(np.uint8), 20),
    }


def write_sog(path: Path, g: Gaussians) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in sog_files(g).items():
            archive.writestr(name, data)


WRITERS = {
    "a.splat": write_splat,
    "a.compressed.ply": write_compressed_ply,
    "1.spz": lambda p, g: write_spz(p, g, 1),
    "2.spz": lambda p, g: write_spz(p, g, 2),
    "3.spz": lambda p, g: write_spz(p, g, 3),
    "4.spz": lambda p, g: write_spz(p, g, 4),
    "a.sog": write_sog,
}


def assert_same(read: Gaussians, written: Gaussians, steps: dict[str, float]) -> None:
    """Within the format's own steps; a rotation by what it does to the covariance."""
    np.testing.assert_allclose(read.means, written.means, atol=steps["means"])
    np.testing.assert_allclose(read.opacity, written.opacity, atol=0.6 / 255)
    np.testing.assert_allclose(read.sh[:, 0], written.sh[:, 0], atol=steps["dc"])
    np.testing.assert_allclose(read.log_scales, written.log_scales, atol=steps["scales"])
    sure = np.abs(written.quats[:, 0]) >= steps.get("least_w", 0)  # a small w drowns in the rounding of the others
    a, b = (quats_to_matrices(g.quats[sure].astype(float)) for g in (read, written))
    np.testing.assert_allclose(a @ a.transpose(0, 2, 1), b @ b.transpose(0, 2, 1), atol=1e-6)
    squash = np.array([4.0, 1.0, 0.25])
    np.testing.assert_allclose(
        (a * squash) @ a.transpose(0, 2, 1), (b * squash) @ b.transpose(0, 2, 1), atol=steps["quats"]
    )
    if read.sh.shape[1] > 1:
        np.testing.assert_allclose(read.sh[:, 1:], written.sh[:, 1:], atol=steps["sh"])


STEPS = {
    "a.splat": {"means": 0, "dc": 0.6 / 255 / SH_C0, "scales": 1e-6, "quats": 0.1},
    "a.compressed.ply": {"means": 4e-3, "dc": 5e-3, "scales": 5e-3, "quats": 0.02, "sh": 4.1 / 255},
    "1.spz": {"means": 2e-3, "dc": 0.6 / 255 / 0.15, "scales": 1 / 31, "quats": 0.2, "least_w": 0.3, "sh": 1 / 250},
    "2.spz": {"means": 2e-4, "dc": 0.6 / 255 / 0.15, "scales": 1 / 31, "quats": 0.2, "least_w": 0.3, "sh": 1 / 250},
    "3.spz": {"means": 2e-4, "dc": 0.6 / 255 / 0.15, "scales": 1 / 31, "quats": 0.02, "sh": 1 / 250},
    "4.spz": {"means": 2e-4, "dc": 0.6 / 255 / 0.15, "scales": 1 / 31, "quats": 0.02, "sh": 1 / 250},
    "a.sog": {"means": 3e-4, "dc": 5e-3, "scales": 0.012, "quats": 0.06, "sh": 2e-3},
}


@pytest.mark.parametrize("name", WRITERS)
def test_what_was_written_is_read(tmp_path: Path, name: str) -> None:
    scene = some()
    WRITERS[name](tmp_path / name, scene)
    read = read_scene(tmp_path / name)
    assert read.gaussians.sh_degree == (0 if name == "a.splat" else 2)
    assert read.gaussians.usable.all()
    assert_same(read.gaussians, scene, STEPS[name])
    # and it goes on as a plain PLY
    write_gaussians(tmp_path / "plain.ply", read.gaussians)
    again = read_scene(tmp_path / "plain.ply")
    np.testing.assert_array_equal(again.gaussians.sh, read.gaussians.sh)
    np.testing.assert_array_equal(again.table.rows, read.table.rows)


def test_an_unpacked_sog_is_read_by_its_folder_and_by_its_description(tmp_path: Path) -> None:
    scene = some()
    for name, data in sog_files(scene).items():
        (tmp_path / name).write_bytes(data)
    for path in (tmp_path, tmp_path / "meta.json"):
        assert_same(read_scene(path).gaussians, scene, STEPS["a.sog"])


@QUICK
@given(name=st.sampled_from(sorted(WRITERS)), cut=st.floats(0, 0.999), seed=st.integers(0, 5))
def test_a_truncated_file_is_refused(tmp_path: Path, name: str, cut: float, seed: int) -> None:
    path = tmp_path / name
    WRITERS[name](path, some(40, seed=seed))
    data = path.read_bytes()
    path.write_bytes(data[: int(cut * len(data))])
    try:
        read = read_scene(path)
    except BadInput as error:
        assert str(path) in str(error) and "\n" not in str(error)
    else:  # only .splat has no header: whole rows are a shorter scene
        assert name == "a.splat" and len(read.gaussians) < 40


@QUICK
@given(name=st.sampled_from(sorted(WRITERS)), place=st.floats(0, 0.999), value=st.integers(0, 255))
def test_a_damaged_byte_is_a_scene_or_one_clear_line(tmp_path: Path, name: str, place: float, value: int) -> None:
    path = tmp_path / name
    WRITERS[name](path, some(40))
    data = bytearray(path.read_bytes())
    data[int(place * len(data))] = value
    path.write_bytes(data)
    try:
        read_scene(path)
    except BadInput as error:
        assert "\n" not in str(error)


def test_a_property_that_comes_twice_is_said(tmp_path: Path) -> None:
    for name, twice in (("a.compressed.ply", (b"min_scale_x", b"max_scale_x")), ("a.ply", (b"scale_0", b"scale_1"))):
        path = tmp_path / name
        if name in WRITERS:
            WRITERS[name](path, some(40))
        else:
            write_gaussians(path, some(40))
        path.write_bytes(path.read_bytes().replace(*twice, 1))
        with pytest.raises(BadInput, match=r"more than once|twice") as error:
            read_scene(path)
        assert "\n" not in str(error.value)


@pytest.fixture
def little_memory() -> Iterator[None]:
    """No more than 100 MB beyond what is taken already may be taken inside."""
    import resource

    limit, taken = resource.getrlimit(resource.RLIMIT_AS), Path("/proc/self/statm").read_text().split()[0]
    resource.setrlimit(resource.RLIMIT_AS, (int(taken) * resource.getpagesize() + (100 << 20), limit[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, limit)


def gzipped_zeros(path: Path, start: bytes, size: int) -> None:
    """`start` and then zeros, packed without ever lying in memory as a whole."""
    packer = zlib.compressobj(1, zlib.DEFLATED, 31)
    with path.open("wb") as file:
        file.write(packer.compress(start))
        for _ in range(size >> 20):
            file.write(packer.compress(bytes(1 << 20)))
        file.write(packer.flush())


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the limit is Linux's")
@pytest.mark.usefixtures("little_memory")
def test_a_file_takes_no_more_memory_than_its_count_needs(tmp_path: Path) -> None:
    def header(count: int) -> bytes:
        return b"NGSP" + struct.pack("<IIBBBB", 2, count, 0, 12, 0, 0)

    gzipped_zeros(tmp_path / "few.spz", header(2), 128 << 20)  # the rest is never unpacked
    assert len(read_scene(tmp_path / "few.spz").gaussians) == 2
    gzipped_zeros(tmp_path / "many.spz", header(16 << 20), 128 << 20)
    with pytest.raises(MemoryError, match="16777216 Gaussians"):
        read_scene(tmp_path / "many.spz")
    whole = zipfile.ZipFile(tmp_path / "meta.sog", "w", zipfile.ZIP_DEFLATED)
    with whole as archive, archive.open("meta.json", "w") as meta:
        for _ in range(20):
            meta.write(b" " * (1 << 20))
    with pytest.raises(BadInput, match="larger than 16 MiB"):
        read_scene(tmp_path / "meta.sog")


def test_a_zstd_frame_that_lies_about_its_size_is_refused(tmp_path: Path) -> None:
    header, *streams = spz_body(some(10), 4)
    packed = [bytearray(zstandard.ZstdCompressor(level=1).compress(s)) for s in streams if s]
    head = header[:15] + bytes([len(packed)]) + struct.pack("<I", 32) + bytes(12)
    for claimed in (1 << 40, 10**5):
        table = b"".join(struct.pack("<QQ", len(p), claimed) for p in packed)
        (tmp_path / "a.spz").write_bytes(head + table + b"".join(packed))
        with pytest.raises(BadInput, match="more than its Gaussians need"):
            read_scene(tmp_path / "a.spz")
    lies = zstandard.ZstdCompressor().compress(bytes(1 << 26))  # 64 MB in a frame of which the table tells 90 bytes
    table = b"".join(struct.pack("<QQ", len(lies), len(s)) for s in streams if s)
    (tmp_path / "a.spz").write_bytes(head + table + lies * len(packed))
    tracemalloc.start()
    with suppress(BadInput):
        read_scene(tmp_path / "a.spz")
    assert tracemalloc.get_traced_memory()[1] < 16 << 20
    tracemalloc.stop()


SOG_DAMAGE = {
    "no mapping": [],
    "count beyond its pixels": {"count": 10_000},
    "negative count": {"count": -1},
    "text for a count": {"count": "x"},
    "no files": {"means": {"mins": [0, 0, 0], "maxs": [1, 1, 1], "files": []}},
    "a file of another type": {"quats": {"files": [5]}},
    "numbers for files": {"quats": 5},
    "a codebook of lists": {"count": 0, "sh0": {"codebook": [[]], "files": ["sh0.webp"]}},
    "nothing for limits": {"means": {"mins": None, "maxs": {}, "files": ["means_l.webp", "means_u.webp"]}},
}


@pytest.mark.parametrize("case", SOG_DAMAGE)
def test_a_description_that_makes_no_sense_is_refused(case: str, tmp_path: Path) -> None:
    files, change = sog_files(some(10)), SOG_DAMAGE[case]
    meta = json.loads(files["meta.json"])
    files["meta.json"] = json.dumps({**meta, **change} if isinstance(change, dict) else change).encode()
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    with pytest.raises((BadInput, MemoryError), match=r"meta\.json|picture"):
        read_scene(tmp_path)


def test_an_archive_with_a_name_that_is_no_text_is_refused(tmp_path: Path) -> None:
    """Found by make fuzz."""
    files = {**sog_files(some(10)), "ä.txt": b""}
    with zipfile.ZipFile(tmp_path / "a.sog", "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    whole = (tmp_path / "a.sog").read_bytes()
    (tmp_path / "a.sog").write_bytes(whole.replace("ä".encode(), b"\xab\xab"))
    with pytest.raises(BadInput, match="damaged"):
        read_scene(tmp_path / "a.sog")


def test_a_picture_far_larger_than_the_count_needs_is_refused(tmp_path: Path) -> None:
    files = sog_files(some(10))
    files["quats.webp"] = cv2.imencode(".webp", np.zeros((4000, 4000, 4), np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 101])[
        1
    ].tobytes()
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    with pytest.raises(BadInput, match="far larger"):
        read_scene(tmp_path)


def test_a_part_that_claims_more_than_it_holds_is_not_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = sog_files(some(10))
    sound = cv2.imencode(".png", np.zeros((2, 20, 4), np.uint8))[1].tobytes()
    for name, data in {**files, "means_l.webp": sound[:33] + b"\x0f" + sound[34:]}.items():
        (tmp_path / name).write_bytes(data)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    with pytest.raises(BadInput, match="not a picture"):
        read_scene(tmp_path)


def test_what_is_no_scene_is_said(tmp_path: Path) -> None:
    for name, data, words in [
        ("a.txt", b"hello there", "not a PLY, nor"),
        ("b.spz", gzip.compress(b"hello"), "no .spz"),
        ("c.sog", b"PK\x03\x04nonsense", "damaged"),
        ("d.splat", b"x" * 33, "truncated"),
        ("missing.splat", None, "cannot read"),
    ]:
        if data is not None:
            (tmp_path / name).write_bytes(data)
        with pytest.raises(BadInput, match=words):
            read_scene(tmp_path / name)
    (tmp_path / "folder").mkdir()
    with pytest.raises(BadInput, match="cannot read"):
        read_scene(tmp_path / "folder")


def test_real_files_of_two_kinds_agree(shared_data: Path) -> None:
    folder = shared_data / "real" / "playcanvas"
    a, b = read_scene(folder / "biker.compressed.ply").gaussians, read_scene(folder / "biker.spz").gaussians
    assert len(a) == len(b) == 152_746
    distance, nearest = cKDTree(a.means).query(b.means)
    assert distance.max() < 3e-4
    a = a.take(nearest)
    assert np.median(np.abs((a.quats * b.quats).sum(1))) > 0.999
    assert np.abs(a.opacity - b.opacity).mean() < 1 / 255 and np.abs(a.log_scales - b.log_scales).mean() < 1 / 32


def test_a_real_sog_is_the_scene_it_was_made_into(shared_data: Path) -> None:
    folder = shared_data / "real" / "playbot"
    a, b = read_scene(folder / "scene.ply").gaussians, read_scene(folder / "sog").gaussians
    np.testing.assert_allclose(a.means, b.means, atol=1e-6)
    np.testing.assert_allclose(a.sh, b.sh, atol=1e-6)
    np.testing.assert_allclose(a.log_scales, b.log_scales, atol=1e-6)


def test_a_half_turn_changes_nothing_but_the_frame() -> None:
    scene = some(60, degree=3)
    viewmat = look_at(np.array([1.0, -7.0, 2.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    camera = Camera("c", 60, 40, 50.0, 50.0, 30.0, 20.0, viewmat)
    back = np.eye(4)
    back[:3, :3] = HALF_TURN
    same = render(turned(scene), replace(camera, viewmat=viewmat @ back)).rgb
    np.testing.assert_allclose(render(scene, camera).rgb, same, atol=2e-3)

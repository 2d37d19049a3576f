"""PLY files: read by name, written back byte for byte, refused in one clear line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import plyfile
import pytest
from hypothesis import HealthCheck, given
from hypothesis import strategies as st
from property_tests import examples

from gimp3d.errors import BadInput
from gimp3d.gaussians import Gaussians
from gimp3d.io.ply import read_ply, write_gaussians, write_ply

XYZ, NORMALS, DC = ["x", "y", "z"], ["nx", "ny", "nz"], ["f_dc_0", "f_dc_1", "f_dc_2"]
SCALE, ROT = ["scale_0", "scale_1", "scale_2"], ["rot_0", "rot_1", "rot_2", "rot_3"]
LAYOUTS = {
    "inria": [*XYZ, *NORMALS, *DC, *(f"f_rest_{k}" for k in range(45)), "opacity", *SCALE, *ROT],
    "gsplat, no normals, degree 0": [*XYZ, *DC, "opacity", *SCALE, *ROT],
    "brush order, degree 1": [*XYZ, *SCALE, "opacity", *ROT, *DC, *(f"f_rest_{k}" for k in range(9))],
    "2DGS, degree 2": [*XYZ, *NORMALS, *DC, *(f"f_rest_{k}" for k in range(24)), "opacity", *SCALE[:2], *ROT],
    "extras in front": ["label", *XYZ, *DC, "opacity", *SCALE, *ROT, "semantic_7"],
}
FORMATS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
QUICK = examples(60, suppress_health_check=[HealthCheck.function_scoped_fixture])


def make(
    path: Path, names: Sequence[str], form: str = "binary_little_endian", rows: int = 20, kind: str = "float"
) -> np.ndarray:
    """Write a PLY with plain NumPy; returns its values."""
    order = FORMATS[form]
    dtype = np.dtype([(n, order + ("f8" if kind == "double" else "f4")) for n in names])
    table = np.zeros(rows, dtype)
    rng = np.random.default_rng(len(names))
    for n in names:
        table[n] = rng.normal(size=rows)
    header = ["ply", f"format {form} 1.0", "comment Vertical axis: y", f"element vertex {rows}"]
    header += [f"property {kind} {n}" for n in names] + ["end_header", ""]
    body = table.tobytes()
    if form == "ascii":
        body = "".join(" ".join(repr(float(v)) for v in r) + "\n" for r in table.tolist()).encode()
    path.write_bytes("\n".join(header).encode() + body)
    return table


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_writing_everything_back_gives_the_same_bytes(layout: str, form: str, tmp_path: Path) -> None:
    make(tmp_path / "in.ply", LAYOUTS[layout], form)
    file = read_ply(tmp_path / "in.ply")
    write_ply(tmp_path / "out.ply", file, np.ones(20, bool))
    assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "in.ply").read_bytes()


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_kept_rows_stay_and_new_rows_read_back(layout: str, form: str, tmp_path: Path) -> None:
    names = LAYOUTS[layout]
    make(tmp_path / "in.ply", names, form)
    file = read_ply(tmp_path / "in.ply")
    keep = np.arange(20) % 3 > 0
    write_ply(tmp_path / "out.ply", file, keep, file.gaussians.take(~keep))
    out = read_ply(tmp_path / "out.ply")
    assert list(out.table.properties.items()) == list(file.table.properties.items())
    assert out.table.comments == ("Vertical axis: y",)
    assert list(out.table.rows[: keep.sum()]) == list(file.table.rows[keep])
    for name in ("means", "log_scales", "quats", "opacity_logits", "sh"):
        np.testing.assert_array_equal(
            getattr(out.gaussians, name)[keep.sum() :], getattr(file.gaussians, name)[~keep], err_msg=name
        )
    oracle = plyfile.PlyData.read(tmp_path / "out.ply")["vertex"].data  # an independent reader agrees
    np.testing.assert_allclose(oracle["opacity"], out.gaussians.opacity_logits, rtol=1e-6)
    for extra in {"nx", "label", "semantic_7"} & set(names):
        assert (oracle[extra][keep.sum() :] == 0).all()


def test_sh_is_channel_major_in_the_file(tmp_path: Path) -> None:
    table = make(tmp_path / "in.ply", LAYOUTS["inria"])
    sh = read_ply(tmp_path / "in.ply").gaussians.sh
    assert sh.shape == (20, 16, 3)
    for k in range(15):
        for c in range(3):
            np.testing.assert_array_equal(sh[:, 1 + k, c], table[f"f_rest_{15 * c + k}"])


def test_doubles_are_used_as_floats_and_kept_as_doubles(tmp_path: Path) -> None:
    table = make(tmp_path / "in.ply", LAYOUTS["inria"], kind="double")
    file = read_ply(tmp_path / "in.ply")
    np.testing.assert_array_equal(file.gaussians.means[:, 0], table["x"].astype(np.float32))
    write_ply(tmp_path / "out.ply", file, np.ones(20, bool))
    assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "in.ply").read_bytes()


@QUICK
@given(order=st.permutations([*XYZ, *DC, *SCALE, *ROT, "opacity", *(f"f_rest_{k}" for k in range(9)), "extra"]))
def test_properties_are_found_by_name_in_any_order(order: list[str], tmp_path: Path) -> None:
    table = make(tmp_path / "in.ply", order)
    g = read_ply(tmp_path / "in.ply").gaussians
    np.testing.assert_array_equal(g.means, np.stack([table[n] for n in XYZ], -1))
    np.testing.assert_array_equal(g.quats, np.stack([table[n] for n in ROT], -1))
    np.testing.assert_array_equal(g.sh[:, 2, 1], table["f_rest_4"])


@QUICK
@given(data=st.data())
def test_damaged_files_give_bad_input_or_a_scene_and_nothing_else(data: st.DataObject, tmp_path: Path) -> None:
    path = tmp_path / "in.ply"
    make(path, LAYOUTS["gsplat, no normals, degree 0"], data.draw(st.sampled_from(list(FORMATS))), rows=3)
    content = bytearray(path.read_bytes())
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content)))]
    for _ in range(data.draw(st.integers(0, 4))):
        if content:
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(content))
    try:
        file = read_ply(path)
    except BadInput as error:
        assert "\n" not in str(error)
    else:
        assert len(file.gaussians) == len(file.table.rows)


def test_other_elements_are_kept(tmp_path: Path) -> None:
    make(tmp_path / "in.ply", LAYOUTS["gsplat, no normals, degree 0"])
    content = (tmp_path / "in.ply").read_bytes()
    content = content.replace(b"end_header", b"element camera 1\nproperty float fov\nend_header") + b"\0\0\x80?"
    (tmp_path / "in.ply").write_bytes(content)
    file = read_ply(tmp_path / "in.ply")
    write_ply(tmp_path / "out.ply", file, np.ones(20, bool))
    assert (tmp_path / "out.ply").read_bytes() == content


@pytest.mark.parametrize("comment", ["SplatRenderMode: mip", "antialiased 1"])
def test_antialiased_scenes_are_recognised(comment: str, block_scene: Gaussians, tmp_path: Path) -> None:
    write_gaussians(tmp_path / "in.ply", block_scene.take(np.arange(5)), [comment])
    assert read_ply(tmp_path / "in.ply").gaussians.antialiased
    write_gaussians(tmp_path / "in.ply", block_scene.take(np.arange(5)), ["antialiased 0"])
    assert not read_ply(tmp_path / "in.ply").gaussians.antialiased


def test_no_vertices_is_a_scene(block_scene: Gaussians, tmp_path: Path) -> None:
    write_gaussians(tmp_path / "empty.ply", block_scene.take(np.zeros(0, int)))
    assert len(read_ply(tmp_path / "empty.ply").gaussians) == 0


def test_a_new_gaussian_that_is_not_finite_is_never_written(block_scene: Gaussians, tmp_path: Path) -> None:
    write_gaussians(tmp_path / "in.ply", block_scene.take(np.arange(3)))
    file = read_ply(tmp_path / "in.ply")
    bad = block_scene.take(np.arange(1))
    bad.means[0, 0] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        write_ply(tmp_path / "out.ply", file, np.ones(3, bool), bad)
    assert not (tmp_path / "out.ply").exists()
    bad.means[0, 0] = 0


SPOILED = {
    "rgb only": (b"f_dc_", b"red f_dx_", "makes no sense|no property f_dc_0"),
    "missing opacity": (b"property float opacity\n", b"property float other\n", "no property opacity"),
    "missing rotation": (b"property float rot_3\n", b"property float other\n", "no property rot_3"),
    "four scales": (
        b"property float opacity",
        b"property float scale_3\nproperty float opacity",
        "found 4 scales|truncated",
    ),
    "odd SH count": (b"property float opacity", b"property float f_rest_0\nproperty float opacity", "f_rest|truncated"),
    "twice": (b"property float y\n", b"property float x\n", "occurs twice"),
    "list": (b"property float opacity", b"property list uchar int opacity", "list property"),
    "unknown type": (b"property float opacity", b"property quad opacity", "makes no sense"),
    "negative count": (b"vertex 20", b"vertex -20", "makes no sense"),
    "no format": (b"format binary_little_endian 1.0\n", b"", "names no format"),
    "no vertices element": (b"element vertex", b"element thing", "one vertex element"),
}


@pytest.mark.parametrize("name", SPOILED)
def test_spoiled_headers_are_refused_by_name(name: str, tmp_path: Path) -> None:
    old, new, words = SPOILED[name]
    make(tmp_path / "in.ply", LAYOUTS["gsplat, no normals, degree 0"])
    content = (tmp_path / "in.ply").read_bytes()
    (tmp_path / "in.ply").write_bytes(content.replace(old, new))
    with pytest.raises(BadInput, match=words) as caught:
        read_ply(tmp_path / "in.ply")
    assert "\n" not in str(caught.value)


def test_real_scenes_round_trip(shared_data: Path, tmp_path: Path) -> None:
    for path in (shared_data / "real" / "playbot" / "scene.ply", shared_data / "withwithout" / "desk" / "scene.ply"):
        file = read_ply(path)
        write_ply(tmp_path / "out.ply", file, np.ones(len(file.gaussians), bool))
        assert (tmp_path / "out.ply").read_bytes() == path.read_bytes()
    with pytest.raises(BadInput, match="compressed"):
        read_ply(shared_data / "real" / "playcanvas" / "biker.compressed.ply")


@pytest.mark.parametrize(
    "body", ["0 1 2 3 4 5 6 7\n8 9 10 11 12 13 14 15 16 17 18 19 20 21 22 23 24 25 26 27\n", "0\n" * 2]
)
def test_ascii_rows_that_are_cut_across_lines_are_refused(body: str, tmp_path: Path) -> None:
    names = [*XYZ, *DC, "opacity", *SCALE, *ROT]
    header = ["ply", "format ascii 1.0", "element vertex 2", *(f"property float {n}" for n in names), "end_header", ""]
    (tmp_path / "cut.ply").write_text("\n".join(header) + body)
    with pytest.raises(BadInput, match="rows of 14 numbers"):
        read_ply(tmp_path / "cut.ply")


@pytest.mark.parametrize("keep", [np.ones(3, bool), np.ones((20, 1), bool), np.ones(20), np.arange(20)], ids=str)
def test_only_a_bool_per_row_says_what_is_kept(keep: np.ndarray, tmp_path: Path) -> None:
    make(tmp_path / "in.ply", LAYOUTS["inria"])
    with pytest.raises(ValueError, match="keep: 20 bools"):
        write_ply(tmp_path / "out.ply", read_ply(tmp_path / "in.ply"), keep)
    assert not (tmp_path / "out.ply").exists()

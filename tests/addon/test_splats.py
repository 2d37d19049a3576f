"""Splat objects: what goes in comes out, byte for byte."""

from __future__ import annotations

from pathlib import Path

import bmesh
import bpy
import numpy as np
import pytest
from gimp3d_addon import splats
from scenes import scene

from gimp3d.gaussians import SH_C0, Gaussians
from gimp3d.io.ply import read_ply, write_gaussians


def random_gaussians(count: int, degree: int, scales: int = 3) -> Gaussians:
    rng = np.random.default_rng(degree)
    return Gaussians(
        means=rng.normal(size=(count, 3)).astype(np.float32),
        log_scales=rng.normal(-3, 1, (count, scales)).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        opacity_logits=rng.normal(size=count).astype(np.float32),
        sh=rng.normal(size=(count, (degree + 1) ** 2, 3)).astype(np.float32),
    )


@pytest.mark.parametrize(("degree", "scales"), [(0, 3), (1, 3), (2, 3), (3, 3), (3, 2)])
def test_import_then_export_gives_the_same_bytes(degree: int, scales: int, tmp_path: Path) -> None:
    source, copy = tmp_path / "in.ply", tmp_path / "out.ply"
    write_gaussians(source, random_gaussians(500, degree, scales), ["Vertical axis: y"])
    assert bpy.ops.gimp3d.import_ply(filepath=str(source), up="Y_DOWN") == {"FINISHED"}
    assert bpy.ops.gimp3d.export_ply(filepath=str(copy)) == {"FINISHED"}
    assert copy.read_bytes() == source.read_bytes()


def test_doubles_integers_nan_and_infinities_survive(tmp_path: Path) -> None:
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    names += [f"scale_{k}" for k in range(3)] + [f"rot_{k}" for k in range(4)]
    kinds = [(n, "<f8" if n in "xyz" else "<f4") for n in names] + [("label", "u1"), ("id", "<i4")]
    rng = np.random.default_rng(0)
    rows = np.zeros(50, kinds)
    for name, _ in kinds:
        rows[name] = rng.normal(size=50) * 40 if name not in ("label", "id") else rng.integers(0, 200, 50)
    rows["opacity"][0], rows["rot_0"][1], rows["x"][2] = np.inf, np.nan, np.pi
    types = {"<f8": "double", "<f4": "float", "u1": "uchar", "<i4": "int"}
    header = "ply\nformat binary_little_endian 1.0\ncomment kept\nelement vertex 50\n"
    header += "".join(f"property {types[t]} {n}\n" for n, t in kinds) + "end_header\n"
    (tmp_path / "in.ply").write_bytes(header.encode() + rows.tobytes())
    bpy.ops.gimp3d.import_ply(filepath=str(tmp_path / "in.ply"))
    bpy.ops.gimp3d.export_ply(filepath=str(tmp_path / "out.ply"))
    assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "in.ply").read_bytes()


def test_deleted_vertices_are_left_out_of_the_export(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "in.ply", random_gaussians(100, 1))
    bpy.ops.gimp3d.import_ply(filepath=str(tmp_path / "in.ply"))
    mesh = bpy.context.object.data
    edit = bmesh.new()
    edit.from_mesh(mesh)
    edit.verts.ensure_lookup_table()
    bmesh.ops.delete(edit, geom=edit.verts[:30], context="VERTS")
    edit.to_mesh(mesh)
    edit.free()
    bpy.ops.gimp3d.export_ply(filepath=str(tmp_path / "out.ply"))
    before, after = read_ply(tmp_path / "in.ply"), read_ply(tmp_path / "out.ply")
    assert (after.table.rows == before.table.rows[30:]).all()


def test_a_saved_file_keeps_everything(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "in.ply", random_gaussians(100, 3))
    bpy.ops.gimp3d.import_ply(filepath=str(tmp_path / "in.ply"))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"), check_existing=False)
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))
    bpy.ops.gimp3d.export_ply(filepath=str(tmp_path / "out.ply"))
    assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "in.ply").read_bytes()


def test_every_splat_is_an_instance_of_its_size_and_linear_colour(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "in.ply", scene())
    bpy.ops.gimp3d.import_ply(filepath=str(tmp_path / "in.ply"))
    obj = bpy.context.object
    depsgraph = bpy.context.evaluated_depsgraph_get()
    instances = [np.array(i.matrix_world) for i in depsgraph.object_instances if i.is_instance]
    assert len(instances) == len(scene())
    size = np.linalg.norm(instances[0][:3, :3], axis=0)
    assert np.allclose(size, splats.EXTENT * scene().scales[0], rtol=1e-4)
    colour = np.empty(4 * len(scene()), np.float32)
    obj.data.attributes["color"].data.foreach_get("color", colour)
    encoded = 0.5 + SH_C0 * scene().sh[0, 0]
    assert np.allclose(colour[:3], ((encoded + 0.055) / 1.055) ** 2.4, atol=1e-3)


def test_import_changes_no_render_setting_and_two_objects_share_nodes(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "in.ply", random_gaussians(10, 0))
    render = bpy.context.scene.render
    before = (render.engine, render.resolution_x, bpy.context.scene.view_settings.view_transform)
    for _ in range(2):
        bpy.ops.gimp3d.import_ply(filepath=str(tmp_path / "in.ply"))
    assert (render.engine, render.resolution_x, bpy.context.scene.view_settings.view_transform) == before
    assert [g.name for g in bpy.data.node_groups] == [splats.GROUP]
    assert [m.name for m in bpy.data.materials] == [splats.MATERIAL]


def test_a_file_that_is_no_scene_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "mesh.ply").write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n")
    with pytest.raises(RuntimeError, match="gimp3d: error: .*not a Gaussian scene"):
        bpy.ops.gimp3d.import_ply(filepath=str(tmp_path / "mesh.ply"))
    assert len(bpy.data.objects) == 0

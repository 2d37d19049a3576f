"""A scene goes into Blender and comes out again with every byte it had; nothing else in the file changes."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import bmesh
import bpy
import numpy as np
import pytest

from gimp3d.gaussians import SH_C0, Gaussians
from gimp3d.io.images import read_image
from gimp3d.io.ply import read_ply, write_gaussians
from gimp3d_addon import jobs, splats
from gimp3d_addon.operators.display import show_in
from gimp3d_addon.operators.remove import bring_back

XYZ = ["x", "y", "z"]
NORMALS = ["nx", "ny", "nz"]
DC = [f"f_dc_{k}" for k in range(3)]
ROT = [f"rot_{k}" for k in range(4)]
SCALE = [f"scale_{k}" for k in range(3)]
NUMPY = {"float": "f4", "double": "f8", "uchar": "u1", "short": "i2", "uint": "u4", "int": "i4"}


def rest(count: int) -> list[str]:
    return [f"f_rest_{k}" for k in range(count)]


def ply_bytes(
    properties: Sequence[tuple[str, str]],  # (type, name)
    rows: int = 40,
    form: str = "binary_little_endian",
    comments: Sequence[str] = (),
    line_end: str = "\n",
    extra_element: bool = False,
) -> bytes:
    """A PLY of random finite numbers, with the odd values that real files hold."""
    rng = np.random.default_rng(5)
    order = ">" if form.endswith("big_endian") else "<"
    table = np.zeros(rows, [(name, order + NUMPY[kind]) for kind, name in properties])
    for kind, name in properties:
        table[name] = rng.normal(size=rows) if kind in ("float", "double") else rng.integers(0, 120, rows)
    table["opacity"][:3] = [np.inf, -np.inf, 40.0]
    table["x"][3:6] = [np.nan, np.inf, -0.0]
    table["rot_0"][6], table["rot_1"][6], table["rot_2"][6], table["rot_3"][6] = 0, 0, 0, 0
    table["f_dc_0"][7] = 1e-42  # denormal
    header = ["ply", f"format {form} 1.0", *(f"comment {c}" for c in comments), f"element vertex {rows}"]
    header += [f"property {kind} {name}" for kind, name in properties]
    header += ["element face 2", "property list uchar int vertex_indices"] if extra_element else []
    body = table.tobytes()
    if form == "ascii":
        body = b"".join(" ".join(repr(v) for v in row).encode() + line_end.encode() for row in table.tolist())
    faces = b"\x03\0\0\0\0\1\0\0\0\2\0\0\0" * 2 if extra_element else b""
    return line_end.join([*header, "end_header", ""]).encode() + body + faces


def floats(*names: str) -> list[tuple[str, str]]:
    return [("float", n) for n in names]


INRIA = floats(*XYZ, *NORMALS, *DC, *rest(45), "opacity", *SCALE, *ROT)
LAYOUTS = {
    "3DGS degree 0": ply_bytes(floats(*XYZ, *NORMALS, *DC, "opacity", *SCALE, *ROT)),
    "3DGS degree 1": ply_bytes(floats(*XYZ, *DC, *rest(9), "opacity", *SCALE, *ROT)),
    "3DGS degree 2": ply_bytes(floats(*XYZ, *DC, *rest(24), "opacity", *SCALE, *ROT)),
    "3DGS degree 3": ply_bytes(INRIA),
    "2DGS": ply_bytes(floats(*XYZ, *NORMALS, *DC, *rest(45), "opacity", *SCALE[:2], *ROT)),
    "Brush": ply_bytes(
        floats(*XYZ, *SCALE, "opacity", *ROT, *DC, *rest(9)),
        comments=("Exported from Brush", "Vertical axis: y", "SplatRenderMode: mip"),
    ),
    "doubles and extras": ply_bytes(
        [
            *(("double", n) for n in XYZ), ("uchar", "label"), *floats(*DC, "opacity"), ("short", "tile"),
            *floats(*SCALE, *ROT), ("uint", "row"), ("double", "time"), ("int", "signed"),
        ]
    ),
    "big endian": ply_bytes(
        [*floats(*XYZ, *DC, "opacity", *SCALE, *ROT), ("double", "time")], form="binary_big_endian"
    ),
    "CRLF": ply_bytes(floats(*XYZ, *DC, "opacity", *SCALE, *ROT), line_end="\r\n", comments=("made elsewhere",)),
    "no Gaussians": ply_bytes(floats(*XYZ, *DC, "opacity", *SCALE, *ROT), rows=40).split(b"end_header\n")[0].replace(
        b"vertex 40", b"vertex 0"
    )
    + b"end_header\n",
}  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS)
def test_untouched_export_is_byte_identical(layout: str, tmp_path: Path) -> None:
    (tmp_path / "in.ply").write_bytes(LAYOUTS[layout])
    bpy.ops.gimp3d.import_ply(filepath=str(tmp_path / "in.ply"), up="Y_DOWN")
    bpy.ops.gimp3d.export_ply(filepath=str(tmp_path / "out.ply"))
    assert (tmp_path / "out.ply").read_bytes() == LAYOUTS[layout]


def test_ascii_export_has_the_same_values(tmp_path: Path) -> None:
    (tmp_path / "in.ply").write_bytes(ply_bytes(INRIA, form="ascii", comments=("text",)))
    bpy.ops.gimp3d.import_ply(filepath=str(tmp_path / "in.ply"))
    bpy.ops.gimp3d.export_ply(filepath=str(tmp_path / "out.ply"))
    before, after = read_ply(tmp_path / "in.ply"), read_ply(tmp_path / "out.ply")
    assert after.table.format == "ascii" and after.table.header == before.table.header
    for field in ("means", "log_scales", "quats", "opacity_logits", "sh"):
        np.testing.assert_array_equal(getattr(after.gaussians, field), getattr(before.gaussians, field))


def test_export_after_saving_and_loading_is_byte_identical(tmp_path: Path) -> None:
    source = LAYOUTS["doubles and extras"]
    (tmp_path / "in.ply").write_bytes(source)
    bpy.ops.gimp3d.import_ply(filepath=str(tmp_path / "in.ply"))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"), compress=True)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))
    bpy.ops.gimp3d.export_ply(filepath=str(tmp_path / "out.ply"))
    assert (tmp_path / "out.ply").read_bytes() == source


def test_vertices_deleted_in_edit_mode_are_absent(tmp_path: Path) -> None:
    (tmp_path / "in.ply").write_bytes(LAYOUTS["3DGS degree 3"])
    bpy.ops.gimp3d.import_ply(filepath=str(tmp_path / "in.ply"))
    bpy.ops.object.mode_set(mode="EDIT")
    edited = bmesh.from_edit_mesh(bpy.context.active_object.data)
    edited.verts.ensure_lookup_table()
    bmesh.ops.delete(edited, geom=[edited.verts[k] for k in range(10, 20)], context="VERTS")
    bmesh.update_edit_mesh(bpy.context.active_object.data)
    bpy.ops.gimp3d.export_ply(filepath=str(tmp_path / "out.ply"))  # still in edit mode, as a user would
    before, after = read_ply(tmp_path / "in.ply").table, read_ply(tmp_path / "out.ply").table
    kept = np.r_[0:10, 20 : len(before.rows)]
    assert after.rows.tobytes() == before.rows[kept].tobytes()


def test_other_elements_are_dropped_and_the_file_stays_whole(tmp_path: Path) -> None:
    properties = floats(*XYZ, *DC, "opacity", *SCALE, *ROT)
    (tmp_path / "in.ply").write_bytes(ply_bytes(properties, extra_element=True))
    bpy.ops.gimp3d.import_ply(filepath=str(tmp_path / "in.ply"))
    bpy.ops.gimp3d.export_ply(filepath=str(tmp_path / "out.ply"))
    assert (tmp_path / "out.ply").read_bytes() == ply_bytes(properties)


@pytest.mark.parametrize(("up", "expected"), [("FILE", (0, 0, 1)), ("Y_DOWN", (0, -1, 0)), ("Y_UP", (0, 1, 0))])
def test_the_up_axis_goes_into_the_matrix_only(
    up: str, expected: tuple[float, float, float], few_gaussians: Gaussians, tmp_path: Path
) -> None:
    write_gaussians(tmp_path / "in.ply", few_gaussians)
    bpy.ops.gimp3d.import_ply(filepath=str(tmp_path / "in.ply"), up=up)
    splat = bpy.context.scene.gimp3d.splat
    bpy.context.view_layer.update()
    np.testing.assert_allclose(np.array(splat.matrix_world)[:3, :3] @ expected, (0, 0, 1), atol=1e-6)
    stored = np.empty(150, np.float32)
    splat.data.attributes["position"].data.foreach_get("vector", stored)
    np.testing.assert_array_equal(stored.reshape(-1, 3), few_gaussians.means)


def test_display_attributes_hold_activated_values(few_gaussians: Gaussians, import_scene) -> None:
    mesh = import_scene(few_gaussians).data

    def column(name: str, key: str, width: int) -> np.ndarray:
        values = np.empty(50 * width, np.float32)
        mesh.attributes[name].data.foreach_get(key, values)
        return values.reshape(50, width)

    np.testing.assert_allclose(column("scale", "vector", 3), few_gaussians.scales, rtol=1e-6)
    np.testing.assert_allclose(column("opacity", "value", 1)[:, 0], few_gaussians.opacity, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(column("rotation", "value", 4), axis=1), 1, rtol=1e-6)
    encoded = np.clip(0.5 + SH_C0 * few_gaussians.sh[:, 0], 0, 1)
    linear = column("splat_color", "color", 4)[:, :3]
    back = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(back, encoded, atol=1e-4)


def test_import_leaves_the_scene_settings_alone(few_gaussians: Gaussians, import_scene) -> None:
    def settings() -> dict[str, object]:
        scene = bpy.context.scene
        found = {"engine": scene.render.engine, "world": scene.world, "camera": scene.camera}
        for group in (scene.render, scene.view_settings, scene.unit_settings, scene.cycles, scene.eevee):
            for prop in group.bl_rna.properties:
                if prop.type in ("BOOLEAN", "INT", "FLOAT", "ENUM", "STRING") and not getattr(prop, "is_array", False):
                    found[f"{group.bl_rna.identifier}.{prop.identifier}"] = getattr(group, prop.identifier)
        return found

    before = settings()
    import_scene(few_gaussians)
    assert settings() == before


def test_node_group_and_material_are_shared(few_gaussians: Gaussians, import_scene) -> None:
    first, second = import_scene(few_gaussians), import_scene(few_gaussians)
    assert first.modifiers[0].node_group == second.modifiers[0].node_group
    assert first.data.materials[0] == second.data.materials[0]
    assert len(bpy.data.node_groups) == 1 and len(bpy.data.materials) == 2  # ellipsoids, points


def test_every_usable_splat_is_one_instance(few_gaussians: Gaussians, import_scene) -> None:
    splat = import_scene(few_gaussians)
    sizes = [
        max(i.matrix_world.to_scale())
        for i in bpy.context.evaluated_depsgraph_get().object_instances
        if i.is_instance and i.parent.original == splat
    ]
    np.testing.assert_allclose(np.sort(sizes), np.sort(3 * few_gaussians.scales.max(1)), rtol=1e-4)


def test_a_large_scene_is_shown_as_points(few_gaussians: Gaussians, import_scene) -> None:
    import_scene(few_gaussians.take(np.arange(200_001) % 50))
    assert not any(
        i.is_instance and i.object.type == "MESH" for i in bpy.context.evaluated_depsgraph_get().object_instances
    )


def test_points_in_the_viewport_render_as_splats(few_gaussians: Gaussians, import_scene, tmp_path: Path) -> None:
    splat = import_scene(few_gaussians)
    blender_scene, obj = bpy.context.scene, bpy.data.objects.new("c", bpy.data.cameras.new("c"))
    blender_scene.collection.objects.link(obj)
    obj.location, blender_scene.camera = (0, 0, 8), obj
    render = blender_scene.render
    render.engine, render.resolution_x, render.resolution_y = "CYCLES", 32, 24
    blender_scene.cycles.samples, blender_scene.cycles.use_denoising = 4, False
    pictures = []
    for as_points in (False, True):
        splats.set_display(splat, "As Points", as_points)
        render.filepath = str(tmp_path / f"{as_points}.png")
        bpy.ops.render.render(write_still=True)
        pictures.append(read_image(render.filepath))
    assert pictures[0].max() > 20 and (pictures[0] == pictures[1]).all()


@pytest.mark.slow
def test_a_million_splats_come_and_go_in_two_seconds_each(few_gaussians: Gaussians, tmp_path: Path) -> None:
    """Processor time, the better of two: the first touches memory that the machine has yet to hand out."""
    write_gaussians(tmp_path / "big.ply", few_gaussians.take(np.arange(1_000_000) % 50))
    spent: dict[str, list[float]] = {}

    def timed(name: str, work: Callable[..., object], *given: object, **named: object) -> None:
        start = time.process_time()
        work(*given, **named)
        spent.setdefault(name, []).append(time.process_time() - start)

    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work.blend"), check_existing=False)
    for _ in range(2):
        timed("import", bpy.ops.gimp3d.import_ply, filepath=str(tmp_path / "big.ply"))
        timed("export", bpy.ops.gimp3d.export_ply, filepath=str(tmp_path / "out.ply"))
        splat, job = bpy.context.object, jobs.new_job_folder("million")
        bpy.ops.gimp3d.add_roi(size=0.2)
        bpy.ops.gimp3d.add_views(count=3, width=64, height=48)
        timed("hand over", jobs.write_job, bpy.context, job)
        jobs.open_for(bpy.context, job, splat)
        shutil.copyfile(tmp_path / "big.ply", job / "out.ply")
        timed("take back", bring_back, bpy.context, job)
        assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "big.ply").read_bytes()
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "work.blend"))
    assert all(min(times) < 2 for times in spent.values()), spent


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n", "f_dc_0"),
        (b"solid thing\n", "not a PLY"),
        (None, "cannot read"),
    ],
)
def test_a_file_that_is_no_scene_is_refused_in_one_line(content: bytes | None, said: str, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "in.ply").write_bytes(content)
    with pytest.raises(RuntimeError, match=said) as caught:
        bpy.ops.gimp3d.import_ply(filepath=str(tmp_path / "in.ply"))
    assert "gimp3d: error: " in str(caught.value) and "Traceback" not in str(caught.value)
    assert not bpy.data.meshes and bpy.context.scene.gimp3d.splat is None


def test_points_are_capped_and_faint_splats_are_not_shown_as_points() -> None:
    """A scan has a few giants, and haze that hides everything where it is drawn opaque."""
    rng = np.random.default_rng(1)
    scales = rng.uniform(0.5, 1, (1000, 3)) * 0.01
    scales[:20] = 5.0  # giants
    scales[20:40, 0] = 5.0  # needles
    opacity = np.full(1000, 0.9)
    opacity[500:700] = 0.01
    usable = np.arange(1000) != 999
    radii = splats.point_radii(scales, opacity, usable)
    assert (radii[500:700] == 0).all() and radii[999] == 0 and radii.max() < 0.02
    assert (radii[:500] > 0).all() and radii.dtype == np.float32
    assert len(splats.point_radii(scales[:0], opacity[:0], usable[:0])) == 0


def test_a_large_scene_is_shown_as_points_of_its_radii(few_gaussians: Gaussians, tmp_path: Path) -> None:
    logits = few_gaussians.opacity_logits.copy()
    logits[:7] = -9  # haze
    rows = np.arange(splats.MANY + 1) % 50
    write_gaussians(tmp_path / "big.ply", replace(few_gaussians, opacity_logits=logits).take(rows))
    bpy.ops.gimp3d.import_ply(filepath=str(tmp_path / "big.ply"))
    splat = bpy.context.object
    assert not splat.select_get()  # an outline round so many points would hide them
    evaluated = splat.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry()
    radii = np.empty(len(splat.data.vertices), np.float32)
    splat.data.attributes[splats.RADIUS].data.foreach_get("value", radii)
    cloud = evaluated.pointcloud
    drawn = np.empty(len(cloud.points), np.float32)
    cloud.attributes["radius"].data.foreach_get("value", drawn)
    assert (np.sort(drawn) == np.sort(radii[radii > 0])).all() and 0 < len(drawn) < len(radii)


def test_an_imported_scene_is_framed_with_its_colours(few_gaussians: Gaussians, import_scene) -> None:
    """Without its strays, which a scan has everywhere."""
    far = few_gaussians.means.copy()
    far[0] = 1e4
    splat = import_scene(replace(few_gaussians, means=far))
    splat.location, splat.scale = (5, 0, 0), (2, 2, 2)
    bpy.context.view_layer.update()
    region = SimpleNamespace(view_location=None, view_distance=None)
    view = SimpleNamespace(shading=SimpleNamespace(type="SOLID"), region_3d=region, clip_start=0.1, clip_end=100.0)
    show_in(view, splat)
    assert view.shading.type == "MATERIAL" and 2 < region.view_distance < 20
    assert np.linalg.norm(np.array(region.view_location) - (5, 0, 0)) < 2 and view.clip_end > region.view_distance

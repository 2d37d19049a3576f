"""A Gaussian scene as a Blender object: mesh vertices, named attributes, instances on points, a falloff material.

Every PLY property is kept losslessly in its own attribute, so that an export gives the file's bytes back; the
attributes `scale`, `rotation`, `opacity` and `splat_color` hold activated values for drawing.
"""

from __future__ import annotations

import json
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import bpy
import numpy as np
from mathutils import Matrix

from gimp3d.errors import BadInput
from gimp3d.gaussians import SH_C0, Gaussians, sh_basis
from gimp3d.io.ply import PlyTable, SplatFile, ascii_rows, file_of, gaussians_of, row_blocks, values
from gimp3d.srgb import decoded

from .native import attribute_values, is_native, read_native, write_native
from .shading import COLOUR, GROUP, RADIUS, node_group, splat_material

T = TypeVar("T")
TABLE = "gimp3d_ply"  # custom property of the mesh: header and format as JSON
ID = "gimp3d_id"  # custom property of the object: the jobs that are about it know it by this
RAW = "ply:"  # prefix of the attributes that hold the file's numbers
DISPLAY = ("As Points", "Fraction")  # inputs of the node group
FAINT = 0.05  # opacity below which a splat is not shown as a point: points hide what lies behind them
WIDE = 1.5  # standard deviations that a point covers
LARGEST = 0.9  # quantile of the radii that no point exceeds: a few giants would hide the scene
MANY = 20_000  # from here on splats are shown as points unless the user asks otherwise: ellipsoids take minutes
UP_AXES = {
    "FILE": Matrix.Identity(4),
    "Y_DOWN": Matrix.Rotation(np.radians(-90), 4, "X"),  # COLMAP's usual scenes: (x, y, z) → (x, z, −y)
    "Y_UP": Matrix.Rotation(np.radians(90), 4, "X"),
}


def is_splat(candidate: bpy.types.Object | None) -> bool:
    """Whether an object was made by `create_object`, or is one of Blender's own splat objects."""
    ours = candidate is not None and candidate.type == "MESH" and TABLE in candidate.data
    return ours or is_native(candidate)


def count(obj: bpy.types.Object) -> int:
    """How many splats an object has."""
    return len(obj.data.vertices) if obj.type == "MESH" else len(obj.data.attributes["position"].data)


def kind(obj: bpy.types.Object) -> str:
    """What an object holds, for the panel."""
    if is_native(obj):
        return "Blender's own splats"
    names = [name for name, _ in json.loads(obj.data[TABLE])["properties"]]
    degree = round((1 + sum(n.startswith("f_rest_") for n in names) / 3) ** 0.5) - 1
    return f"{'3DGS' if 'scale_2' in names else '2DGS'}, SH degree {degree}"


def positions(obj: bpy.types.Object) -> np.ndarray:
    """The splats' centres in the object's frame, [N, 3] float32."""
    return attribute_values(obj.data, "position") if obj.type != "MESH" else _vertices(obj.data)


def _vertices(mesh: bpy.types.Mesh) -> np.ndarray:
    points = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", points)
    return points.reshape(-1, 3)


def create_object(name: str, file: SplatFile, matrix: Matrix) -> bpy.types.Object:
    """A new object (not yet linked) that shows the scene and can be exported byte for byte."""
    mesh = bpy.data.meshes.new(name)
    records = values(file.table)
    gaussians = file.gaussians
    mesh.vertices.add(len(gaussians))
    usable = gaussians.usable
    mesh.vertices.foreach_set("co", np.where(usable[:, None], gaussians.means, 0).ravel())
    for field, column in zip(file.table.properties, _columns(records)):
        _store_raw(mesh, field, column)
    _store_display(mesh, gaussians, usable)
    table = file.table
    kept = {"header": _vertex_header(table.header), "line_end": table.line_end, "format": table.format}
    mesh[TABLE] = json.dumps({**kept, "properties": list(table.properties.items())})
    mesh.materials.append(splat_material())
    obj = bpy.data.objects.new(name, mesh)
    obj.matrix_world, obj[ID] = matrix, uuid.uuid4().hex
    modifier = obj.modifiers.new(GROUP, "NODES")
    modifier.node_group = node_group()
    set_display(obj, "As Points", len(gaussians) > MANY)
    return obj


def create_like(source: bpy.types.Object, name: str, file: SplatFile) -> bpy.types.Object:
    """A new object (not yet linked) in the source's place and of its kind, shown as the source is."""
    if is_native(source) and hasattr(source.data, "resize"):  # Blender ≥ 5.2
        data = source.data.copy()
        data.resize(len(file.gaussians))
        write_native(data, file.gaussians)
        result = bpy.data.objects.new(name, data)
        result.matrix_world = source.matrix_world.copy()
        return result
    result = create_object(name, file, source.matrix_world.copy())
    for name in DISPLAY if display_input(source, "Fraction") else ():
        struct, prop = display_input(source, name)
        set_display(result, name, struct.path_resolve(prop))
    return result


def display_input(obj: bpy.types.Object, name: str) -> tuple[Any, str] | None:
    """Where a display input lies, as UILayout.prop takes it; None if the user removed the modifier."""
    group = bpy.data.node_groups.get(GROUP)  # not made here: a panel that is being drawn must change nothing
    modifier = next((m for m in obj.modifiers if m.type == "NODES" and m.node_group == group), None)
    if group is None or modifier is None:
        return None
    key = next(s.identifier for s in group.interface.items_tree if s.name == name)
    if hasattr(modifier, "properties"):  # Blender ≥ 5.2
        return getattr(modifier.properties.inputs, key), "value"
    return modifier, f'["{key}"]'


def set_display(obj: bpy.types.Object, name: str, value: bool | float) -> None:
    struct, prop = display_input(obj, name)
    if prop == "value":
        struct.value = value
    else:
        struct[prop[2:-2]] = value
    obj.update_tag()


def show_colours_from(obj: bpy.types.Object, eye: np.ndarray) -> None:
    """Bake the SH colours as seen from a point in the object's frame: a material can read too few attributes for SH."""
    gaussians = read_object(obj).gaussians
    encoded = np.empty((len(gaussians), 3), np.float32)
    for rows in row_blocks(len(gaussians)):
        towards = gaussians.means[rows] - np.asarray(eye, np.float32)
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
        basis = sh_basis(towards, gaussians.sh_degree)
        encoded[rows] = 0.5 + np.einsum("nk,nkc->nc", basis, gaussians.sh[rows])
    colours = _shown_colours(encoded)
    colours[~gaussians.usable] = 0
    obj.data.attributes[COLOUR].data.foreach_set("color", colours.ravel())
    obj.data.update_tag()


def _shown_colours(encoded: np.ndarray) -> np.ndarray:
    """Gamma-encoded colours as Blender's linear ones with alpha, [N, 4] float32."""
    linear = decoded(np.clip(encoded, 0, 1))
    return np.concatenate([linear, np.ones((len(linear), 1))], axis=1).astype(np.float32)


def read_object(obj: bpy.types.Object) -> SplatFile:
    """The file that an object came from, without the vertices that were deleted since."""
    if is_native(obj):
        return file_of(read_native(obj.data))
    if obj.mode == "EDIT":  # there the mesh shows no attributes; a copy of it does
        obj.update_from_editmode()
        copy = obj.data.copy()
        try:
            return _read_mesh(copy)
        finally:
            bpy.data.meshes.remove(copy)
    return _read_mesh(obj.data)


def _read_mesh(mesh: bpy.types.Mesh) -> SplatFile:
    stored = json.loads(mesh[TABLE])
    properties = dict(stored["properties"])
    header = tuple(stored["header"])
    empty = PlyTable(header, stored["line_end"], stored["format"], properties, np.zeros(0, "V1"))
    records = np.empty(len(mesh.vertices), empty.dtype)
    for group in _groups(tuple(properties)):
        columns = [_load_raw(mesh, field, empty.dtype[field].newbyteorder("=")) for field in group]
        for rows in row_blocks(len(records)):
            for field, column in zip(group, columns):
                records[field][rows] = column[rows]
    if stored["format"] == "ascii":
        rows = np.empty(len(records), object)
        rows[:] = ascii_rows(records)
    else:
        rows = records.view(f"V{records.dtype.itemsize}") if len(records) else np.zeros(0, f"V{records.dtype.itemsize}")
    table = PlyTable(header, stored["line_end"], stored["format"], properties, rows)
    file = SplatFile(gaussians_of(table, mesh.name), table)
    _refuse_moved(mesh, file.gaussians)
    return file


def _refuse_moved(mesh: bpy.types.Mesh, gaussians: Gaussians) -> None:
    """After Apply Transform the mesh is no longer in the file's frame, and cameras and boxes would miss it."""
    if not np.array_equal(_vertices(mesh), np.where(gaussians.usable[:, None], gaussians.means, 0)):
        raise BadInput(f"{mesh.name}: vertices were moved, or a transform was applied; undo that and move the object")


def _vertex_header(header: Sequence[str]) -> list[str]:
    """The header without elements other than vertex: their rows are not kept, so it must not announce them."""
    kept, element = [], ""
    for line in header:
        words = line.split()
        if words[0] == "element":
            element = words[1]
        if words[0] not in ("element", "property") or element == "vertex":
            kept.append(line)
    return kept


def _columns(records: np.ndarray) -> Iterator[np.ndarray]:
    """Each field of records [N] as an array of its own."""
    for group in _groups(records.dtype.names or ()):
        columns = [np.empty(len(records), records.dtype[name]) for name in group]
        for rows in row_blocks(len(records)):
            for name, column in zip(group, columns):
                column[rows] = records[name][rows]
        yield from columns


def _groups(fields: Sequence[T]) -> Iterator[Sequence[T]]:
    """As many fields as share a cache line: memory is read once for all of them, and little of it is needed."""
    return (fields[k : k + 16] for k in range(0, len(fields), 16))


def _words(kind: np.dtype) -> int:
    return -(-kind.itemsize // 4)


def _store_raw(mesh: bpy.types.Mesh, field: str, column: np.ndarray) -> None:
    """float32 as FLOAT; any other type as INT words of its bytes, as Blender has no doubles."""
    if column.dtype == np.float32:
        _attribute(mesh, RAW + field, "FLOAT", "value", column)
        return
    words = np.zeros((len(column), 4 * _words(column.dtype)), np.uint8)
    words[:, : column.dtype.itemsize] = np.ascontiguousarray(column).view(np.uint8).reshape(len(column), -1)
    for k, word in enumerate(words.view(np.int32).T):
        _attribute(mesh, f"{RAW}{field}#{k}", "INT", "value", word)


def _load_raw(mesh: bpy.types.Mesh, field: str, kind: np.dtype) -> np.ndarray:
    names = [RAW + field] if kind == np.float32 else [f"{RAW}{field}#{k}" for k in range(_words(kind))]
    if any(n not in mesh.attributes for n in names):
        raise BadInput(f"{mesh.name} has lost its attribute {names[0]}; import the PLY again")
    columns = np.empty((len(mesh.vertices), len(names)), np.float32 if kind == np.float32 else np.int32)
    for k, name in enumerate(names):
        column = np.empty(len(mesh.vertices), columns.dtype)
        mesh.attributes[name].data.foreach_get("value", column)
        if kind == np.float32:
            return column
        columns[:, k] = column
    return np.ascontiguousarray(columns.view(np.uint8)[:, : kind.itemsize]).view(kind)[:, 0]


def _store_display(mesh: bpy.types.Mesh, gaussians: Gaussians, usable: np.ndarray) -> None:
    scales = gaussians.scales
    if gaussians.is_surfels:
        scales = np.concatenate([scales, 1e-3 * scales.min(1, keepdims=True)], axis=1)
    norms = np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    quats = gaussians.quats / np.where(norms > 0, norms, 1)
    hide = ~usable
    for name, kind, key, array in (
        ("scale", "FLOAT_VECTOR", "vector", scales),
        ("rotation", "QUATERNION", "value", quats),
        ("opacity", "FLOAT", "value", gaussians.opacity),
        (COLOUR, "FLOAT_COLOR", "color", _shown_colours(0.5 + SH_C0 * gaussians.sh[:, 0])),
        (RADIUS, "FLOAT", "value", point_radii(scales, gaussians.opacity, usable)),
    ):
        clean = np.array(array, np.float32)
        clean[hide] = 0
        _attribute(mesh, name, kind, key, clean)


def point_radii(
    scales: np.ndarray,  # [N, 3] standard deviations
    opacity: np.ndarray,  # [N]
    usable: np.ndarray,  # [N] bool
) -> np.ndarray:
    """How large each splat is as a point, [N] float32: by its middle axis, a disc's and not a needle's length."""
    radii = WIDE * np.median(scales, axis=1)
    shown = usable & (opacity >= FAINT)
    if shown.any():
        radii = np.minimum(radii, np.quantile(radii[shown], LARGEST))
    return np.where(shown, radii, 0).astype(np.float32)


def _attribute(mesh: bpy.types.Mesh, name: str, kind: str, key: str, array: np.ndarray) -> None:
    attribute = mesh.attributes.new(name, kind, "POINT")
    attribute.data.foreach_set(key, np.ascontiguousarray(array).ravel())


def default_name(path: Path) -> str:
    return path.stem or "splats"

"""Splat objects as Blender 5.3 has them, told by their attributes: here on meshes and on point clouds that carry them.

Blender 5.3 itself was not at hand; these are the attributes that its importer is said to write.
"""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest
from scenes import REGION, cameras, scene

from gimp3d.gaussians import Gaussians
from gimp3d.io.cameras import write_transforms
from gimp3d.io.ply import read_ply
from gimp3d_addon import native, splats
from gimp3d_addon.chosen import current_splat


def native_object(gaussians: Gaussians, as_points: bool, first_sh: int = 1) -> bpy.types.Object:
    """An object with the attributes that Blender 5.3 gives splats."""
    mesh = bpy.data.meshes.new("splats")
    mesh.vertices.add(len(gaussians))
    attributes = [("scale", "FLOAT_VECTOR"), ("rotation", "QUATERNION"), (native.BASE, "FLOAT_COLOR")]
    attributes += [(f"radiance:sh_{first_sh + k}", "FLOAT_VECTOR") for k in range(gaussians.sh.shape[1] - 1)]
    for name, kind in attributes:
        mesh.attributes.new(name, kind, "POINT")
    native.write_native(mesh, gaussians)
    obj = bpy.data.objects.new("splats", mesh)
    bpy.context.scene.collection.objects.link(obj)
    bpy.context.view_layer.objects.active = obj
    obj.select_set(True)
    if as_points:
        bpy.ops.object.convert(target="POINTCLOUD")
    return bpy.context.view_layer.objects.active


@pytest.mark.parametrize("as_points", [False, True])
@pytest.mark.parametrize("first_sh", [0, 1])
def test_native_splats_are_read_to_rounding(few_gaussians: Gaussians, as_points: bool, first_sh: int) -> None:
    obj = native_object(few_gaussians, as_points, first_sh)
    assert obj.type == ("POINTCLOUD" if as_points else "MESH")
    assert splats.is_splat(obj) and splats.count(obj) == 50
    back = splats.read_object(obj).gaussians
    np.testing.assert_array_equal(back.means, few_gaussians.means)
    np.testing.assert_array_equal(back.sh, few_gaussians.sh)
    np.testing.assert_allclose(back.log_scales, few_gaussians.log_scales, atol=1e-5)
    np.testing.assert_allclose(back.opacity, few_gaussians.opacity, atol=1e-6)
    unit = few_gaussians.quats / np.linalg.norm(few_gaussians.quats, axis=1, keepdims=True)
    np.testing.assert_allclose(back.quats, unit, atol=1e-6)


def test_saturated_opacities_survive(few_gaussians: Gaussians) -> None:
    few_gaussians = few_gaussians.take(np.arange(3))
    few_gaussians.opacity_logits[:] = [np.inf, -np.inf, 40]
    back = splats.read_object(native_object(few_gaussians, True)).gaussians
    np.testing.assert_array_equal(back.opacity, few_gaussians.opacity)


def test_an_object_is_removed_from_native_splats(tmp_path: Path) -> None:
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work.blend"), check_existing=False)
    source = native_object(scene(), True)
    assert current_splat(bpy.context) == source
    bpy.ops.gimp3d.add_roi()
    bpy.context.object.location, bpy.context.object.scale = REGION[0].center, REGION[0].size
    write_transforms(tmp_path / "t.json", cameras())
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "t.json"))
    assert bpy.ops.gimp3d.remove_object() == {"FINISHED"}
    result = current_splat(bpy.context)
    assert result != source and source.hide_get()
    assert splats.is_native(result) == hasattr(source.data, "resize")  # point clouds can be sized from Blender 5.2 on
    bpy.ops.gimp3d.export_ply(filepath=str(tmp_path / "out.ply"))
    after = read_ply(tmp_path / "out.ply").gaussians
    assert splats.count(result) == len(after) != len(scene())
    kept = {m.tobytes() for m in scene().means}
    assert 0 < sum(m.tobytes() in kept for m in after.means) < len(scene())

"""What Blender draws is what the core draws: axes, half pixels, falloff, colours, opacity."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix, Vector
from scenes import cameras, scene

from gimp3d.gaussians import Gaussians
from gimp3d.io.cameras import write_transforms
from gimp3d.io.images import read_image
from gimp3d.pipeline import render_bytes
from gimp3d_addon import bridge, splats
from gimp3d_addon.operators.display import unfit_settings

FRAME = Matrix.LocRotScale(Vector((3, -2, 1)), Euler((0.7, -0.4, 1.9)), Vector((1.7, 1.7, 1.7)))


def cycles(path: Path, samples: int = 16) -> np.ndarray:
    """Blender's own picture from the active camera on black, [H, W, 3] int."""
    blender_scene, render = bpy.context.scene, bpy.context.scene.render
    render.engine, render.threads_mode, render.threads = "CYCLES", "FIXED", 2
    blender_scene.cycles.samples, blender_scene.cycles.use_denoising = samples, False
    bpy.ops.gimp3d.prepare_render()
    render.film_transparent, render.image_settings.color_mode = True, "RGB"  # black behind the splats
    render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    return read_image(path).astype(int)


def likeness(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


@pytest.mark.parametrize("frame", [Matrix.Identity(4), FRAME])
def test_blender_renders_what_the_core_renders(
    import_scene: Callable[[Gaussians], bpy.types.Object], frame: Matrix, tmp_path: Path
) -> None:
    """Through the imported camera, and best at no offset: a pixel's shift or a flipped axis would show."""
    import_scene(scene()).matrix_world = frame
    write_transforms(tmp_path / "t.json", cameras())
    bpy.context.view_layer.update()
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "t.json"))
    bpy.ops.gimp3d.look_through(camera="orbit/004")
    drawn = cycles(tmp_path / "cycles.png")
    true = render_bytes(scene(), cameras()[4]).astype(int)
    assert drawn.shape == true.shape and likeness(drawn, true) > 0.98 and np.abs(drawn - true).mean() < 6
    moved = [likeness(np.roll(drawn, step, axis), true) for axis in (0, 1) for step in (-1, 1)]
    assert likeness(drawn, true) > max(moved)


def test_colours_are_baked_as_the_active_camera_sees_them(import_scene, few_gaussians: Gaussians, tmp_path) -> None:
    """One big opaque splat with SH of degree 3: its centre pixel in the core's picture is its colour in Blender."""
    one = few_gaussians.take(np.array([0]))
    one.means[:], one.log_scales[:], one.opacity_logits[:] = 0, -1, 30
    one.sh[:] *= 0.3
    splat = import_scene(one)
    write_transforms(tmp_path / "t.json", cameras())
    splat.matrix_world = FRAME
    bpy.context.view_layer.update()
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "t.json"))
    seen = []
    for camera in cameras()[:3]:
        bpy.ops.gimp3d.look_through(camera=camera.id)
        assert bpy.ops.gimp3d.update_colours() == {"FINISHED"}
        linear = np.array(splat.data.attributes[splats.COLOUR].data[0].color[:3])
        encoded = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
        u, v = camera.project(np.zeros(3))[0].astype(int)
        np.testing.assert_allclose(encoded, render_bytes(one, camera)[v, u] / 255, atol=0.012)
        seen.append(encoded)
    assert np.ptp(seen, axis=0).max() > 0.02  # it does change from view to view
    bpy.ops.gimp3d.export_ply(filepath=str(tmp_path / "out.ply"))
    assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "scene.ply").read_bytes()


def test_render_settings_change_only_when_asked(import_scene, few_gaussians: Gaussians) -> None:
    blender_scene = bpy.context.scene
    blender_scene.render.engine = "CYCLES"
    before = blender_scene.cycles.transparent_max_bounces, blender_scene.view_settings.view_transform
    import_scene(few_gaussians)
    assert (blender_scene.cycles.transparent_max_bounces, blender_scene.view_settings.view_transform) == before
    assert len(unfit_settings(blender_scene)) == 2
    bpy.ops.gimp3d.prepare_render()
    assert unfit_settings(blender_scene) == [] and blender_scene.render.engine == "CYCLES"


def test_the_share_of_splats_shown(import_scene, few_gaussians: Gaussians) -> None:
    splat = import_scene(few_gaussians.take(np.arange(2000) % 50))
    shown = []
    for fraction in (0.0, 0.25, 1.0):
        splats.set_display(splat, "Fraction", fraction)
        instances = bpy.context.evaluated_depsgraph_get().object_instances
        shown.append(sum(i.is_instance for i in instances))
    assert shown[0] == 0 and 400 < shown[1] < 600 and shown[2] == 2000


def test_what_a_result_is_shown_as_is_what_its_source_was(import_scene, few_gaussians: Gaussians) -> None:
    source = import_scene(few_gaussians)
    splats.set_display(source, "As Points", True)
    splats.set_display(source, "Fraction", 0.5)
    copy = splats.create_like(source, "copy", splats.read_object(source))
    found = [splats.display_input(copy, name) for name in splats.DISPLAY]
    assert [struct.path_resolve(prop) for struct, prop in found] == [True, 0.5]


def test_the_true_picture_is_the_cores(import_scene, tmp_path: Path) -> None:
    import_scene(scene())
    write_transforms(tmp_path / "t.json", cameras())
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "t.json"))
    bpy.ops.gimp3d.render_view()
    image = bpy.data.images["3D-GIMP view"]
    pixels = np.array(image.pixels).reshape(90, 120, 4)[::-1, :, :3] * 255
    active = next(c for c in cameras() if c.id == bpy.context.scene.camera.name)
    assert np.abs(np.rint(pixels) - render_bytes(scene(), active)).max() <= 1
    assert bridge.own_size(bpy.context.scene.camera, bpy.context.scene) == (120, 90)

"""The reference view: painted in Blender or elsewhere, it is what the removal shows there."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest
from scenes import cameras, scene

from gimp3d.io.images import read_image, write_png
from gimp3d.io.ply import read_ply
from gimp3d.job import load_job
from gimp3d.pipeline import render_bytes
from gimp3d.priors.inpaint import PROVIDERS
from gimp3d_addon import properties

GREEN = (20, 200, 40)


@pytest.fixture
def splat(splat: bpy.types.Object) -> bpy.types.Object:
    """The block scene, looked at through a camera."""
    bpy.ops.gimp3d.look_through(camera="orbit/002")
    return splat


def share_of_green(folder: Path, mask: np.ndarray) -> float:
    """How much of the hole the result shows green in the reference view."""
    bpy.ops.gimp3d.export_ply(filepath=str(folder / "out.ply"))
    picture = render_bytes(read_ply(folder / "out.ply").gaussians, cameras()[2]).astype(int)
    green = (picture[..., 1] > picture[..., 0] + 60) & (picture[..., 1] > picture[..., 2] + 60)
    return float(green[mask].mean())


def test_a_picture_painted_in_blender_is_what_the_result_shows(splat: bpy.types.Object, tmp_path: Path) -> None:
    assert bpy.ops.gimp3d.paint_reference() == {"FINISHED"}
    image, settings = bpy.data.images["3D-GIMP reference"], bpy.context.scene.gimp3d
    assert settings.reference_paint == image and settings.reference.name == "orbit/002"
    mask = np.array(bpy.data.images["3D-GIMP mask"].pixels).reshape(90, 120, 4)[::-1, :, 0] > 0.5
    pixels = np.array(image.pixels).reshape(90, 120, 4)
    pixels[::-1][mask] = [*(c / 255 for c in GREEN), 1]
    image.pixels.foreach_set(pixels.astype(np.float32).ravel())
    image.update()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work.blend"), check_existing=False)
    assert bpy.ops.gimp3d.remove_object() == {"FINISHED"}
    given = read_image(next((tmp_path / "gimp3d_jobs").iterdir()) / "reference.png").astype(int)
    assert np.abs(given[mask] - GREEN).max() <= 1
    assert share_of_green(tmp_path, mask) > 0.8


def test_a_picture_painted_elsewhere(splat: bpy.types.Object, tmp_path: Path) -> None:
    bpy.ops.gimp3d.export_reference(filepath=str(tmp_path / "ref.png"))
    mask = read_image(tmp_path / "ref.mask.png")[..., 0] > 127
    picture = read_image(tmp_path / "ref.png")
    assert np.abs(picture.astype(int) - render_bytes(scene(), cameras()[2])).max() <= 1
    painted = np.where(mask[..., None], np.array(GREEN, np.uint8), picture)
    write_png(tmp_path / "painted.png", painted)
    bpy.ops.gimp3d.load_reference(filepath=str(tmp_path / "painted.png"))
    bpy.ops.gimp3d.remove_object()
    assert share_of_green(tmp_path, mask) > 0.8


def test_a_painted_chart_is_what_the_result_shows(splat: bpy.types.Object, tmp_path: Path) -> None:
    bpy.ops.gimp3d.preview_masks()
    mask = np.array(bpy.data.images["3D-GIMP mask"].pixels).reshape(90, 120, 4)[::-1, :, 0] > 0.5
    bpy.ops.gimp3d.choose_reference(camera="chart:1")
    assert bpy.ops.gimp3d.export_reference(filepath=str(tmp_path / "chart.png")) == {"FINISHED"}
    hole = read_image(tmp_path / "chart.mask.png")[..., 0] > 127
    painted = np.where(hole[..., None], np.array(GREEN, np.uint8), read_image(tmp_path / "chart.png"))
    write_png(tmp_path / "painted.png", painted)
    bpy.ops.gimp3d.load_reference(filepath=str(tmp_path / "painted.png"))
    bpy.ops.gimp3d.remove_object()
    job = load_job(next((tmp_path / "gimp3d_jobs").iterdir()))
    assert job.reference == "chart:1" and read_image(Path(job.reference_image)).shape == painted.shape
    assert share_of_green(tmp_path, mask) > 0.8
    assert bpy.context.scene.gimp3d.reference.name == "chart:1"
    bpy.ops.gimp3d.export_reference(filepath=str(tmp_path / "again.png"))  # as completed now
    assert (np.abs(read_image(tmp_path / "again.png").astype(int) - GREEN)[hole].max(-1) < 10).mean() > 0.9


def test_a_chart_is_painted_in_blender(splat: bpy.types.Object) -> None:
    bpy.ops.gimp3d.preview_masks()
    bpy.ops.gimp3d.choose_reference(camera="chart:1")
    assert bpy.ops.gimp3d.paint_reference() == {"FINISHED"}
    settings, chart = bpy.context.scene.gimp3d, bpy.data.images["3D-GIMP chart 1"]
    assert settings.reference_paint == bpy.data.images["3D-GIMP reference"]
    assert settings.reference_paint.size[:] == bpy.data.images["3D-GIMP mask"].size[:] == chart.size[:]


def test_the_last_picture_given_counts(splat: bpy.types.Object, tmp_path: Path) -> None:
    bpy.ops.gimp3d.paint_reference()
    bpy.ops.gimp3d.export_reference(filepath=str(tmp_path / "ref.png"))
    bpy.ops.gimp3d.load_reference(filepath=str(tmp_path / "ref.png"))
    settings = bpy.context.scene.gimp3d
    assert settings.reference_paint is None and settings.reference_image.endswith("ref.png")


def test_the_providers_that_are_offered_are_those_that_there_are() -> None:
    assert set(properties.INPAINT) == set(PROVIDERS)


@pytest.mark.slow
@pytest.mark.parametrize("provider", properties.INPAINT)
def test_every_provider_that_is_offered_exists(splat: bpy.types.Object, provider: str) -> None:
    bpy.context.scene.gimp3d.inpaint, bpy.context.scene.gimp3d.preset = provider, "draft"
    assert bpy.ops.gimp3d.remove_object() == {"FINISHED"}


def test_a_shadow_painted_over_is_the_removals_shadow(splat: bpy.types.Object, tmp_path: Path) -> None:
    settings = bpy.context.scene.gimp3d
    assert bpy.ops.gimp3d.paint_shadow() == {"FINISHED"}
    assert settings.shadow == "mask" and settings.shadow_camera.name == "orbit/002"
    image = settings.shadow_paint
    pixels = np.array(image.pixels).reshape(90, 120, 4)
    pixels[10:20, 30:50, :3] = GREEN[1] / 255
    image.pixels.foreach_set(pixels.astype(np.float32).ravel())
    image.update()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work.blend"), check_existing=False)
    assert bpy.ops.gimp3d.remove_object() == {"FINISHED"}
    job = load_job(next((tmp_path / "gimp3d_jobs").iterdir()))
    assert job.shadow == "mask"
    mask = read_image(next(Path(job.shadow_masks).rglob("*.png")))[..., 0] > 127
    assert mask[70:80, 30:50].mean() > 0.95 and mask.sum() < 1.1 * 200  # Blender counts rows from below


def test_a_shadow_that_was_never_painted_is_asked_for(splat: bpy.types.Object) -> None:
    bpy.context.scene.gimp3d.shadow = "mask"
    with pytest.raises(RuntimeError, match="Paint Shadow"):
        bpy.ops.gimp3d.remove_object()
    bpy.context.scene.gimp3d.shadow = "off"
    assert bpy.ops.gimp3d.preview_masks() == {"FINISHED"}
    assert bpy.context.scene.gimp3d.shadow_found == ""

"""The panel at every stage of the work: it names what is missing and offers the button that mends it."""

from __future__ import annotations

import inspect
import json
import re
import time
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Quaternion
from scenes import REGION, cameras, scene

from gimp3d.gaussians import Gaussians
from gimp3d.io.cameras import write_transforms
from gimp3d.io.ply import write_gaussians
from gimp3d.progress import Clock, forecast_removal
from gimp3d_addon import bridge, classes_of, jobs, panels, steps
from gimp3d_addon.operators.base import RunsChild
from gimp3d_addon.worker import Worker, duration

STEPS = (steps.scene_step, steps.region_step, steps.views_step)


class RecordingLayout:
    """Stands in for UILayout in background: checks that every property, operator and option exists."""

    def __init__(self, log: list[str]) -> None:
        self.log = log

    def prop(self, data, name: str, **_: object) -> None:
        assert name in data.bl_rna.properties or data.path_resolve(name) is not None, name
        self.log.append(name)

    def operator(self, name: str, text: str = "", **_: object) -> Options:
        module, operator = name.split(".")
        self.log += [name, text]
        return Options(getattr(getattr(bpy.ops, module), operator).get_rna_type())

    def label(self, text: str = "", icon: str = "NONE", **_: object) -> None:
        assert icon in bpy.types.UILayout.bl_rna.functions["label"].parameters["icon"].enum_items
        self.log.append(text)

    def progress(self, factor: float = 0.0, text: str = "", **_: object) -> None:
        assert 0 <= factor <= 1
        self.log.append(text)

    def row(self, **_: object) -> RecordingLayout:
        return RecordingLayout(self.log)

    column = row


class Options:
    """Stands in for the operator's properties that a button sets."""

    def __init__(self, rna: bpy.types.Struct) -> None:
        object.__setattr__(self, "rna", rna)

    def __setattr__(self, name: str, value: object) -> None:
        prop = self.rna.properties[name]
        assert prop.type != "ENUM" or value in prop.enum_items


def drawn() -> list[str]:
    """Every text, property and operator of the tab."""
    log: list[str] = []
    for cls in classes_of(panels):
        if issubclass(cls, bpy.types.Panel) and cls is not panels.GIMP3D_PT_presets:  # that menu is Blender's own
            Drawable(cls, log).draw()
    return log


class Drawable:
    """Calls a panel's functions on a stand-in: bpy's classes cannot be made from Python."""

    def __init__(self, cls: type, log: list[str]) -> None:
        self.cls, self.layout = cls, RecordingLayout(log)

    def __getattr__(self, name: str) -> object:
        found = inspect.getattr_static(self.cls, name)
        return found.__get__(self, self.cls) if hasattr(found, "__get__") else found

    def draw(self) -> None:
        self.cls.draw(self, bpy.context)


@pytest.fixture
def splat(import_scene: Callable[[Gaussians], bpy.types.Object], tmp_path: Path) -> bpy.types.Object:
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work.blend"), check_existing=False)
    write_transforms(tmp_path / "transforms.json", cameras())
    return import_scene(scene())


def add_box() -> bpy.types.Object:
    bpy.ops.gimp3d.add_roi()
    box = bpy.context.object
    box.location, box.scale = REGION[0].center, REGION[0].size
    bpy.context.view_layer.update()
    return box


def test_every_step_names_what_is_missing_and_offers_the_button(splat: bpy.types.Object, tmp_path: Path) -> None:
    bpy.data.objects.remove(splat)
    log = drawn()
    assert "No splat scene yet" in log and "gimp3d.import_ply" in log and "gimp3d.export_ply" not in log
    assert "Step 1 first: No splat scene yet" in log
    bpy.ops.gimp3d.import_ply(filepath=str(tmp_path / "scene.ply"))
    log = drawn()
    assert f"{len(scene()):,} splats · 3DGS, SH degree 0" in log and "No box round the object yet" in log
    box = add_box()
    log = drawn()
    inside = sum(REGION[0].contains(scene().means))
    assert any(line.startswith(f"{inside:,} splats inside") for line in log) and "No view yet" in log
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "transforms.json"))
    log = drawn()
    assert "9 views · drawn from the splats" in log
    assert any(line.startswith("about ") and "GB" in line for line in log)
    assert not [line for line in log if "first:" in line]
    box.location.z = 50
    bpy.context.view_layer.update()
    assert "The box holds no splat; move it" in drawn()


def test_the_count_follows_the_box(splat: bpy.types.Object) -> None:
    box = add_box()
    assert steps.splats_inside(splat, [box]) == sum(REGION[0].contains(scene().means))
    box.location.x = 99
    bpy.context.view_layer.update()
    assert steps.splats_inside(splat, [box]) == 0
    splat.location.x = 99 - REGION[0].center[0]
    bpy.context.view_layer.update()
    assert steps.splats_inside(splat, [box]) == sum(REGION[0].contains(scene().means))


def test_an_uneven_scale_is_named_and_mended(splat: bpy.types.Object) -> None:
    splat.scale = (1, 2, 1)
    bpy.context.view_layer.update()
    assert "scaled unevenly" in " ".join(drawn()) and "gimp3d.even_scale" in drawn()
    bpy.ops.gimp3d.even_scale()
    assert "gimp3d.even_scale" not in drawn()


def test_a_view_that_cannot_be_used_is_named(splat: bpy.types.Object, tmp_path: Path) -> None:
    add_box()
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "transforms.json"))
    bpy.data.cameras["orbit/002"].type = "ORTHO"
    assert "orbit/002 is ortho" in " ".join(drawn())


def test_drawing_changes_nothing(splat: bpy.types.Object) -> None:
    """Blender forbids it, and says so in the user's face: here the user has removed what shows the splats."""
    bpy.data.node_groups.remove(bpy.data.node_groups[0])
    before = len(bpy.data.node_groups), len(bpy.data.materials)
    assert "gimp3d.update_colours" in drawn()
    assert (len(bpy.data.node_groups), len(bpy.data.materials)) == before


def test_while_it_runs_there_is_a_bar_and_a_cancel_button(splat: bpy.types.Object) -> None:
    class Running(RunsChild):
        bl_label = "Remove Object"

    running = Running()
    running.worker = Worker(["--version"])
    running.worker.join()
    RunsChild.running = running
    try:
        log = drawn()
    finally:
        RunsChild.running = None
    assert "Remove Object" in log and "gimp3d.cancel" in log and "gimp3d.remove_object" not in log


def test_every_property_and_operator_explains_itself(splat: bpy.types.Object) -> None:
    operators = dir(bpy.ops.gimp3d)
    assert len(operators) > 20
    for name in operators:
        rna = getattr(bpy.ops.gimp3d, name).get_rna_type()
        assert len(rna.description) > 10, name
        own = [p for p in rna.properties if p.identifier in ("fit", "size", "count", "fov", "step", "camera", "up")]
        assert all(p.description for p in own), name
    for prop in bpy.context.scene.gimp3d.bl_rna.properties:
        assert prop.name and (prop.description or prop.identifier in ("name", "rna_type")), prop.identifier


@pytest.mark.parametrize(("seconds", "words"), [(0.2, "1 s"), (75, "75 s"), (200, "3 min"), (7200, "2.0 h")])
def test_times_are_said_in_the_right_size(seconds: float, words: str) -> None:
    assert duration(seconds) == words


def test_what_a_new_file_holds_ticks_no_step(tmp_path: Path) -> None:
    """Blender starts with a camera and a cube."""
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    assert [bool(step(bpy.context).missing) for step in STEPS] == [True] * 3
    write_gaussians(tmp_path / "scene.ply", scene())
    bpy.ops.gimp3d.import_ply(filepath=str(tmp_path / "scene.ply"))
    assert steps.region_step(bpy.context).missing and steps.views_step(bpy.context).warning
    bpy.context.view_layer.objects.active = bpy.data.objects["Cube"]
    assert "The active mesh, Cube" in steps.region_step(bpy.context).warning
    log = drawn()
    assert "The active mesh, Cube, counts" in " ".join(log) and "Only 1 view: much" in " ".join(log)
    below = log[log.index("grow") - 12 : log.index("grow")]  # beside the button, with the way out
    assert "gimp3d.add_views" in below and "gimp3d.add_roi" in below


def test_views_that_look_away_from_the_box_do_not_count(splat: bpy.types.Object, tmp_path: Path) -> None:
    add_box()
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "transforms.json"))
    views = list(bpy.context.scene.gimp3d.view_collection.objects)
    for k, obj in enumerate(views):
        obj.rotation_mode = "QUATERNION"
        if k >= 2:
            obj.rotation_quaternion = obj.rotation_quaternion @ Quaternion((0, 1, 0), np.pi)
    bpy.context.view_layer.update()
    step = steps.views_step(bpy.context)
    assert step.facts[0] == "2 of 9 views see the box" and step.warning.startswith("Only 2 views")
    assert step.fixes[0].operator == "gimp3d.add_views"
    for obj in views[:2]:
        obj.location = (0, 0, 50)
        obj.rotation_quaternion = (0, 1, 0, 0)  # up
    bpy.context.view_layer.update()
    assert steps.views_step(bpy.context).missing == "No view sees the box"
    bpy.ops.gimp3d.add_views(count=6)
    assert steps.views_step(bpy.context) == steps.Step(("6 views", "drawn from the splats"))


def test_the_users_own_camera_sees_what_its_picture_shows(splat: bpy.types.Object) -> None:
    """Against Blender's own mapping, for boxes all round it."""
    camera = bpy.data.objects.new("own", bpy.data.cameras.new("own"))
    bpy.context.scene.collection.objects.link(camera)
    camera.location, camera.rotation_euler = (0.3, -2, 0.7), (1.2, 0.1, 0.2)
    camera.data.shift_x = 0.2
    box = add_box()
    box.scale = (1e-3,) * 3
    told = []
    for place in np.random.default_rng(0).uniform(-3, 3, (60, 3)):
        box.location = place
        bpy.context.view_layer.update()
        u, v, depth = world_to_camera_view(bpy.context.scene, camera, box.matrix_world.translation)
        expected = depth > 0 and 0 < u < 1 and 0 < v < 1
        told.append((bridge.view_sizes(bpy.context, [box])[0].sees, expected))
    assert all(a == b for a, b in told) and {b for _, b in told} == {True, False}


def test_a_first_run_counts_down_and_says_why_it_takes_long() -> None:
    """The kernels are compiled in whatever stage needs them, so this run's own speed says nothing."""
    clock = Clock(forecast_removal(10_000, 9, 9 * 120 * 90))
    worker = Worker(["--version"], clock=clock)
    worker.join()
    worker._take(json.dumps({"stage": "compile", "done": 0, "total": 1}))
    lefts = []
    for passed, stage in enumerate(["read", "masks", "surfaces", "light", "charts", "propagate", "seed", "verdict"]):
        worker._started = time.monotonic() - 15 * passed
        worker._take(json.dumps({"stage": stage, "done": 1, "total": 1}))
        lefts.append(seconds_in(worker.words()))
    assert lefts == sorted(lefts, reverse=True) and lefts[0] > 30 and "first run only" in worker.words()


def seconds_in(words: str) -> float:
    number, unit = re.search(r"about (\d+) (s|min) left", words).groups()
    return float(number) * (60 if unit == "min" else 1)


def test_the_panel_lists_this_files_jobs_with_their_sizes(splat: bpy.types.Object, tmp_path: Path) -> None:
    assert "None of this file" in drawn()
    add_box()
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "transforms.json"))
    folder = jobs.new_job_folder("scene")
    jobs.write_job(bpy.context, folder)
    jobs.open_for(bpy.context, folder, splat)
    log = drawn()
    size = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) / 1e6
    assert f"1 jobs · {size:,.0f} MB" in log and "gimp3d.delete_jobs" in log
    assert any(line.startswith("scene-001 · ") and line.endswith("stopped") for line in log)


def test_what_the_file_proposes_may_be_anything(splat: bpy.types.Object) -> None:
    add_box()
    for proposed in (
        "[]",
        "5",
        "{",
        '{"gaussians": "many"}',
        '{"box": 5}',
        '{"box": {"center": 1}}',
        "null",
        '{"box": []}',
    ):
        bpy.context.scene.gimp3d.proposed = proposed
        assert drawn()
        with pytest.raises(RuntimeError, match="no box is proposed"):
            bpy.ops.gimp3d.enlarge_roi()


def test_charts_are_offered_to_look_at(splat: bpy.types.Object, tmp_path: Path) -> None:
    add_box()
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "transforms.json"))
    assert "Look at chart:1" not in drawn()
    bpy.ops.gimp3d.preview_masks()
    assert "Look at chart:1" in drawn()

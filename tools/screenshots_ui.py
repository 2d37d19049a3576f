"""Runs inside a real Blender with its window: goes through a removal and asks for a picture of each step.

Started by tools/screenshots.py, which takes the pictures; a step waits until its own is taken.
"""

from __future__ import annotations

import importlib
import json
import os
import time
import traceback
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import bpy
from mathutils import Matrix

SHARE = Path(os.environ["GIMP3D_SHARE"])
EXTENSION = "bl_ext.user_default.gimp3d"
PATIENCE = 240  # s for a removal


def steps() -> Iterator[str]:
    """Yields the name of each picture to be taken, or "key-" and a key to press; "" only lets the window draw."""
    view = yield from with_the_add_on()
    yield from until_the_preview(view)
    yield from through_a_removal(view)


def with_the_add_on() -> Generator[str, None, dict[str, Any]]:
    """Install it; returns what operators of the 3D view are run in."""
    bpy.ops.extensions.package_install_files(
        filepath=str(SHARE / "gimp3d.zip"), repo="user_default", enable_on_install=True, overwrite=True
    )
    preferences = bpy.context.preferences
    preferences.addons[EXTENSION].preferences.python = os.environ["GIMP3D_PYTHON"]
    bpy.ops.object.select_all(action="SELECT")
    bpy.ops.object.delete()
    bpy.ops.wm.save_as_mainfile(filepath=str(SHARE / "work.blend"))
    area = next(a for a in bpy.context.window.screen.areas if a.type == "VIEW_3D")
    space = area.spaces.active
    space.show_region_ui, space.shading.type, space.overlay.show_floor = True, "MATERIAL", False
    region = next(r for r in area.regions if r.type == "WINDOW")
    ui = next(r for r in area.regions if r.type == "UI")
    yield ""
    ui.active_panel_category = "3D-GIMP"
    yield "1-empty"
    return {"window": bpy.context.window, "area": area, "region": region}


def until_the_preview(view: dict[str, Any]) -> Iterator[str]:
    """A scene, a region, cameras, and what is to be filled."""
    with bpy.context.temp_override(**view):
        bpy.ops.gimp3d.import_ply(filepath=str(SHARE / "scene.ply"))
    bpy.context.scene.view_settings.view_transform = "Standard"
    bpy.context.scene.eevee.taa_samples = 1  # drawing on and on, which takes seconds here, is not what is measured
    importlib.import_module(f"{EXTENSION}.gimp3d_addon.splats").set_display(bpy.context.object, "As Points", True)
    frames = json.loads((SHARE / "transforms.json").read_text())["frames"]
    view["area"].spaces.active.region_3d.view_matrix = Matrix(frames[0]["transform_matrix"]).inverted()
    yield ""
    yield "2-imported"

    box_json = json.loads((SHARE / "roi.json").read_text())
    with bpy.context.temp_override(**view):
        bpy.ops.gimp3d.add_roi()
        box = bpy.context.scene.gimp3d.rois[0].object
        box.location, box.scale = box_json["center"], box_json["size"]
    yield ""
    yield "3-region"

    with bpy.context.temp_override(**view):
        bpy.ops.gimp3d.import_cameras(filepath=str(SHARE / "transforms.json"))
        bpy.ops.gimp3d.look_through(step=0)
        bpy.ops.gimp3d.preview_masks("INVOKE_DEFAULT")
    yield from until(lambda: "3D-GIMP hole" in bpy.data.images)
    yield ""
    yield "4-preview"


def through_a_removal(view: dict[str, Any]) -> Iterator[str]:
    """One that is cancelled, one that is not, its result, and the preferences."""
    splats = importlib.import_module(f"{EXTENSION}.gimp3d_addon.splats")
    base = importlib.import_module(f"{EXTENSION}.gimp3d_addon.operators.base")
    with bpy.context.temp_override(**view):
        bpy.ops.gimp3d.hide_previews()
        bpy.ops.gimp3d.remove_object("INVOKE_DEFAULT")
    yield from until(lambda: base.RunsChild.running.worker.progress > 0)
    yield "key-Escape"
    start = time.monotonic()
    yield from until(lambda: base.RunsChild.running is None)
    print(f"screenshots: Escape cancelled within {time.monotonic() - start + 0.25:.2f} s", flush=True)
    assert [o.name for o in bpy.data.objects if splats.is_splat(o)] == ["scene"]

    with bpy.context.temp_override(**view):
        bpy.ops.gimp3d.remove_object("INVOKE_DEFAULT")
    start, pictured = time.monotonic(), False
    late.clear()
    while not bpy.context.scene.gimp3d.last_report and time.monotonic() - start < PATIENCE:
        if not pictured and time.monotonic() - start > 8:
            pictured = True
            yield "5-running"
        yield ""
    took = (
        f"{time.monotonic() - start:.0f} s; Blender's timer was late by {sorted(late)[len(late) // 2]:.2f} s (median)"
    )
    print(f"screenshots: removed in {took}, {max(late):.2f} s (most)", flush=True)
    with bpy.context.temp_override(**view):
        bpy.ops.gimp3d.export_ply(filepath=str(SHARE / "out.ply"))
        bpy.ops.gimp3d.render_view("INVOKE_DEFAULT")
    yield from until(lambda: "3D-GIMP view" in bpy.data.images)
    yield ""
    yield "6-result"

    bpy.context.window.screen.areas[-1].tag_redraw()
    with bpy.context.temp_override(**view):
        bpy.ops.gimp3d.hide_previews()
        bpy.ops.gimp3d.check()
        bpy.ops.screen.userpref_show("INVOKE_DEFAULT")
    bpy.context.preferences.active_section = "ADDONS"
    bpy.context.window_manager.addon_search = "3D-GIMP"
    with bpy.context.temp_override(**view):
        bpy.ops.preferences.addon_expand(module=EXTENSION)
    yield ""
    yield "7-preferences"


def until(done) -> Iterator[str]:  # type: ignore[no-untyped-def]
    """Lets the window run on until something has come."""
    start = time.monotonic()
    while not done():
        if time.monotonic() - start > PATIENCE:
            raise TimeoutError
        yield ""


running = steps()
waiting: list[Path] = []
late: list[float] = []  # s that each timer call came after its time: how long Blender was busy
due = [time.monotonic()]


def timed(seconds: float) -> float:
    due[0] = time.monotonic() + seconds
    return seconds


def tick() -> float | None:
    """Blender's timer: one step, or wait for the picture of the last one."""
    late.append(max(0.0, time.monotonic() - due[0]))
    if waiting and waiting[0].exists():
        return timed(0.25)
    waiting.clear()
    try:
        name = next(running)
    except StopIteration:
        (SHARE / "finished").write_text("well")
        return None
    except Exception:  # whatever it is, the driver must hear of it
        (SHARE / "finished").write_text(traceback.format_exc())
        return None
    if name:
        waiting.append(SHARE / f"{name}.ready")
        waiting[0].write_text("")
    return timed(0.25)


bpy.context.preferences.view.show_splash = False
bpy.context.preferences.view.ui_scale = 1.15
bpy.app.timers.register(tick, first_interval=5)

"""Runs inside a real Blender with its window: makes it ready for the mouse of tools/by_mouse.py, then only watches.

Draws the labels that are to be clicked, as Blender draws them, and tells every quarter second how things stand.
"""

from __future__ import annotations

import importlib
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

import blf
import bpy
import gpu
import numpy as np
from mathutils import Matrix

SHARE = Path(os.environ["GIMP3D_SHARE"])
EXTENSION = "bl_ext.user_default.gimp3d"
TEXT = 11  # points of Blender's buttons
TICK = 0.1  # s


def make_ready() -> Iterator[None]:
    bpy.ops.extensions.package_install_files(
        filepath=str(SHARE / "gimp3d.zip"), repo="user_default", enable_on_install=True, overwrite=True
    )
    preferences = bpy.context.preferences
    preferences.addons[EXTENSION].preferences.python = os.environ["GIMP3D_PYTHON"]
    bpy.ops.wm.save_userpref()  # the script that comes after finds the extension enabled
    importlib.import_module(f"{EXTENSION}.gimp3d_addon.splats").MANY = 0  # points: ellipsoids take seconds to draw here
    preferences.view.filebrowser_display_type = "SCREEN"
    bpy.ops.object.select_all(action="SELECT")
    bpy.ops.object.delete()
    bpy.context.scene.view_settings.view_transform = "Standard"
    bpy.context.scene.eevee.taa_samples = 1  # drawing on and on takes seconds here
    bpy.ops.wm.save_as_mainfile(filepath=str(SHARE / "work.blend"))
    area = next(a for a in bpy.context.window.screen.areas if a.type == "VIEW_3D")
    space = area.spaces.active
    space.show_region_ui, space.shading.type, space.overlay.show_floor = True, "MATERIAL", False
    tabs = next(r for r in area.regions if r.type == "UI")
    for _ in range(3):  # the tab is there once the region has been drawn with it
        yield
        tabs.active_panel_category = "3D-GIMP"
        tabs.tag_redraw()
    for number, label in enumerate(json.loads((SHARE / "labels.json").read_text())):
        np.save(SHARE / f"label-{number}.npy", drawn(label))
    yield


def drawn(label: str) -> np.ndarray:
    """A label as Blender's buttons show it, [H, W] uint8, white on black."""
    blf.size(0, TEXT * bpy.context.preferences.system.ui_scale)
    width, height = (int(extent) + 6 for extent in blf.dimensions(0, label))
    offscreen = gpu.types.GPUOffScreen(width, height)
    with offscreen.bind(), gpu.matrix.push_pop(), gpu.matrix.push_pop_projection():
        buffer = gpu.state.active_framebuffer_get()
        buffer.clear(color=(0, 0, 0, 1))
        gpu.matrix.load_matrix(Matrix.Identity(4))
        scale = Matrix.Diagonal((2 / width, 2 / height, 1, 1))
        gpu.matrix.load_projection_matrix(Matrix.Translation((-1, -1, 0)) @ scale)
        blf.color(0, 1, 1, 1, 1)
        blf.position(0, 2, 4, 0)
        blf.draw(0, label)
        pixels = buffer.read_color(0, 0, width, height, 4, 0, "UBYTE")
    offscreen.free()
    return np.array(pixels.to_list(), np.uint8).reshape(height, width, 4)[::-1, :, 0]


def drop() -> None:
    """What Blender calls when a file is let go over the 3D view; the mouse of X cannot bring one."""
    bpy.ops.wm.drop_import_file("INVOKE_DEFAULT", directory=f"{SHARE}/", files=[{"name": "scene.ply"}])


def export_reference() -> None:
    """The button of a sub-panel that is closed; the file browser comes."""
    bpy.ops.gimp3d.export_reference("INVOKE_DEFAULT")


def answer(asked: Path) -> None:
    """Do what the driver asks for by a file of that name, as from the 3D view."""
    if asked.exists():
        asked.unlink()
        area = next(a for a in bpy.context.window.screen.areas if a.type == "VIEW_3D")
        region = next(r for r in area.regions if r.type == "WINDOW")
        with bpy.context.temp_override(area=area, region=region):
            {"drop": drop, "export_reference": export_reference}[asked.name]()


def tell(lateness: float) -> None:
    base = importlib.import_module(f"{EXTENSION}.gimp3d_addon.operators.base")
    splats = importlib.import_module(f"{EXTENSION}.gimp3d_addon.splats")
    running = base.RunsChild.running is not None
    if running and was_running.pop():
        late.append(round(lateness, 3))
    elif running:  # just begun: the scene was handed over
        late.clear()
    was_running[:] = [running]
    state = {
        "splats": sum(splats.is_splat(o) for o in bpy.data.objects),
        "boxes": [[*r.object.location, *r.object.scale] for r in bpy.context.scene.gimp3d.rois],
        "cameras": sum(o.type == "CAMERA" for o in bpy.context.scene.objects),
        "running": running,
        "late": late,
    }
    (SHARE / "state.new").write_text(json.dumps(state))
    (SHARE / "state.new").rename(SHARE / "state.json")


readying = make_ready()
late: list[float] = []  # s that each timer call of the last run came after its time: how long Blender was busy
was_running = [False]
due = [time.monotonic()]


def tick() -> float:
    lateness = max(0.0, time.monotonic() - due[0])
    try:
        next(readying)
        wait = 2.0
    except StopIteration:
        answer(SHARE / "drop")
        answer(SHARE / "export_reference")
        tell(lateness)
        wait = TICK
    due[0] = time.monotonic() + wait
    return wait


bpy.context.preferences.view.show_splash = False
bpy.context.preferences.view.ui_scale = 1.15
bpy.app.timers.register(tick, first_interval=5)

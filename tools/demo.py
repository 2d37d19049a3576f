"""The demo: in Blender (the bpy module) import the made scene, put a box round the vase, add cameras, press Remove.

Writes build/demo/demo.blend, before and after pictures and the report. Run by `make demo`.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SCENE = ROOT / "assets" / "demo"
os.environ["BLENDER_USER_RESOURCES"] = tempfile.mkdtemp(prefix="gimp3d-demo-")  # the user's own Blender stays as it is
sys.path.insert(0, str(ROOT))

import bpy
import cv2
import numpy as np

import gimp3d_addon
from gimp3d.io.cameras import read_cameras
from gimp3d.io.images import write_png
from gimp3d.io.ply import read_ply
from gimp3d.pipeline import render_bytes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "demo")
    out = parser.parse_args().out.resolve()
    start = time.perf_counter()
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    bpy.ops.wm.read_homefile(use_empty=True)
    gimp3d_addon.register()
    try:
        remove_the_vase(out)
    finally:
        gimp3d_addon.unregister()
    pictures(out)
    shown = out.relative_to(ROOT) if out.is_relative_to(ROOT) else out
    print(f"done in {time.perf_counter() - start:.0f} s. Look at:")
    for name, what in (
        ("before_after.png", "before and after"),
        ("report/index.html", "the report: what each stage did"),
        ("demo.blend", "the scene in Blender, with the result beside the hidden original"),
        ("out.ply", "the scene without the vase"),
    ):
        print(f"  {shown / name}  {what}")


def remove_the_vase(out: Path) -> None:
    """What an artist does, by script."""
    blend = str(out / "demo.blend")
    bpy.ops.wm.save_as_mainfile(filepath=blend, check_existing=False)
    say("importing the scene")
    bpy.ops.gimp3d.import_ply(filepath=str(SCENE / "scene.ply"))
    bpy.ops.gimp3d.add_roi()
    box, region = bpy.context.object, json.loads((SCENE / "roi.json").read_text())
    box.location, box.scale = region["center"], region["size"]
    bpy.ops.gimp3d.import_cameras(filepath=str(SCENE / "transforms.json"))
    say("removing the vase (the first run compiles the kernels, about a minute)")
    bpy.ops.gimp3d.remove_object()
    bpy.ops.gimp3d.export_ply(filepath=str(out / "out.ply"))
    report = Path(bpy.context.scene.gimp3d.last_report).parent
    shutil.copytree(report, out / "report")
    bpy.context.scene.gimp3d.last_report = str(out / "report" / "index.html")
    bpy.ops.wm.save_as_mainfile(filepath=blend, check_existing=False)


def pictures(out: Path) -> None:
    """The views that the removal never saw, before and after."""
    say("drawing before and after")
    scenes = [read_ply(p).gaussians for p in (SCENE / "scene.ply", out / "out.ply")]
    rows = []
    for camera in (c for c in read_cameras(SCENE / "transforms.json") if c.split == "test"):
        pair = [render_bytes(g, camera.scaled(2)) for g in scenes]
        rows.append(cv2.resize(np.hstack(pair), None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA))
        name = Path(camera.id).stem
        write_png(out / f"before_{name}.png", pair[0])
        write_png(out / f"after_{name}.png", pair[1])
    write_png(out / "before_after.png", np.vstack(rows[:2]))


def say(text: str) -> None:
    print(f"demo: {text}", flush=True)


if __name__ == "__main__":
    main()

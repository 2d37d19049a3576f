"""A removal by mouse in a real Blender, by a script in it and by the command: the same bytes (`make by-mouse`).

Every button is found on the screen by its label and clicked with xdotool; the box gets its place from the keyboard, as
an artist who knows its numbers would give it. Needs root on a Debian machine and shared/tools/real-blender.

    python tools/by_mouse.py [--suite trixie] [--root DIR] [--case demo] [--case playbot] [--out build/by_mouse]
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from real_blender import PYTHON, ROOT, SUITES, RealBlender, save_jpeg

LABELS = (
    *("Import Splats", "scene.ply", "Cursor", "Import Cameras", "transforms.json", "Orbit round the Box"),
    *("Remove Object", "Export", "Export Splat PLY", "Import PLY", "OK", "Export Reference", "Restore"),
)
ALIKE = 0.8  # correlation from which on a label is found
PATIENCE = 60  # s for a click to show, and for a label to come
RUN_PATIENCE = 500  # s for a removal
VIEW = ("500", "600")  # a place in the 3D view, pixels
SCRIPT = """
import json, sys
import bpy
bpy.ops.gimp3d.import_ply(filepath="/share/scene.ply")
bpy.ops.gimp3d.add_roi()
box, region = bpy.context.object, json.load(open("/share/roi.json"))
box.location, box.scale = region["center"], region["size"]
if {orbit}:
    bpy.ops.gimp3d.add_views()
else:
    bpy.ops.gimp3d.import_cameras(filepath="/share/transforms.json")
bpy.ops.gimp3d.remove_object()
bpy.ops.gimp3d.export_ply(filepath="/share/script.ply")
"""


@dataclass(frozen=True)
class Case:
    """A scene and its box."""

    folder: Path
    cameras: bool  # a file of them; else the views are an orbit
    dropped: bool  # the scene is dropped into the 3D view; else chosen in the file browser


CASES = {
    "demo": Case(ROOT / "assets" / "demo", cameras=True, dropped=False),
    "playbot": Case(ROOT.parent / "shared" / "data" / "real" / "playbot", cameras=False, dropped=True),
}


class Mouse:
    """A user at the screen of a real Blender."""

    def __init__(self, blender: RealBlender, out: Path) -> None:
        self.blender, self.out, self._shots = blender, out, 0

    def click(self, label: str, until: Callable[[dict[str, Any]], bool] | str, then: Sequence[str] = ()) -> None:
        """Click on a label, and press a key there; again if nothing comes of it. `until`: a state or another label."""
        done = (lambda: self._find(until) is not None) if isinstance(until, str) else (lambda: until(self.state()))
        start = time.monotonic()
        while not done():
            self._settle()
            place = self._find(label)
            if place is not None:
                at = ("mousemove", *map(str, place), "sleep", "0.5", "click", "1", "sleep", "0.5")
                self._xdotool(*at, *(("key", *then) if then else ()))
            elif time.monotonic() - start > PATIENCE:
                self.shot("lost")
                sys.exit(f"by_mouse: nothing on the screen reads {label!r}; see {self.out}")
            self._wait(done, PATIENCE / 2)
            self._xdotool("mousemove", *VIEW)  # a tooltip may hide what is looked for
        self.shot(label)

    def see(self, label: str) -> None:
        if not self._wait(lambda: self._find(label) is not None, PATIENCE):
            self.shot("lost")
            sys.exit(f"by_mouse: nothing on the screen reads {label!r}; see {self.out}")
        self.shot(label)

    def type(self, *keys: str) -> None:
        """Press keys over the 3D view; a number is typed digit by digit."""
        self._xdotool("mousemove", *VIEW, "sleep", "0.3")
        for key in keys:
            number = [{"-": "minus", ".": "period"}.get(c, c) for c in key] if key[-1].isdigit() else [key]
            self._xdotool("key", "--delay", "60", *number, "sleep", "0.3")

    def wait(self, done: Callable[[dict[str, Any]], bool], seconds: float) -> None:
        if not self._wait(lambda: done(self.state()), seconds):
            self.shot("stuck")
            sys.exit(f"by_mouse: Blender does not go on; it is at {self.state()}")

    def state(self) -> dict[str, Any]:
        """How things stand in Blender."""
        return json.loads((self.blender.share / "state.json").read_text())

    def shot(self, name: str) -> None:
        self._shots += 1
        self._settle()
        clean = "".join(c if c.isalnum() else "_" for c in name)
        save_jpeg(self.out / f"{self._shots:02d}-{clean}.jpg", self.blender.picture())

    def _settle(self) -> None:
        """Wait until Blender's timer has come in time for two seconds: what was to be drawn anew is on the screen."""
        start = quiet = time.monotonic()
        while time.monotonic() - quiet < 2 and time.monotonic() - start < PATIENCE:
            time.sleep(0.2)
            if time.time() - (self.blender.share / "state.json").stat().st_mtime > 0.6:
                quiet = time.monotonic()

    def _find(self, label: str) -> tuple[int, int] | None:
        """The middle of a label on the screen, the uppermost one."""
        text = np.load(self.blender.share / f"label-{LABELS.index(label)}.npy")
        rows, columns = np.nonzero(text > 40)
        text = np.ascontiguousarray(text[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1])
        screen = cv2.cvtColor(self.blender.picture(), cv2.COLOR_BGR2GRAY)
        found = np.argwhere(cv2.matchTemplate(screen, text, cv2.TM_CCOEFF_NORMED) > ALIKE)  # sorted from above
        return (int(found[0][1]) + text.shape[1] // 2, int(found[0][0]) + text.shape[0] // 2) if len(found) else None

    def _xdotool(self, *arguments: str) -> None:
        self.blender.run("xdotool", *arguments)

    @staticmethod
    def _wait(done: Callable[[], bool], seconds: float) -> bool:
        start = time.monotonic()
        while not done():
            if time.monotonic() - start > seconds:
                return False
            time.sleep(0.5)
        return True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--suite", default="trixie", choices=SUITES, help="Debian's: 4.3 or 5.2")
    parser.add_argument("--root", type=Path, help="where the chroot is or will be")
    parser.add_argument("--case", action="append", choices=CASES, help="default: all whose data are here")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "by_mouse")
    given = parser.parse_args()
    blender = RealBlender(given.suite, given.root)
    for name in given.case or [n for n, c in CASES.items() if c.folder.exists()]:
        compare(blender, CASES[name], given.out / name)


def compare(blender: RealBlender, case: Case, out: Path) -> None:
    """The three ways; ends with a word if they differ."""
    names = ("scene.ply", "roi.json", *(["transforms.json"] if case.cameras else []))
    blender.put(*(case.folder / n for n in names), ROOT / "tools" / "by_mouse_ui.py")
    (blender.share / "labels.json").write_text(json.dumps(LABELS))
    (blender.share / "script.py").write_text(SCRIPT.format(orbit=not case.cameras))
    with blender.window("by_mouse_ui.py"):
        late = by_mouse(Mouse(blender, out), case)
    blender.run("blender", "-b", "--python-exit-code", "1", "--python", "/share/script.py")
    by_command(blender, case)
    made = {name: (blender.share / f"{name}.ply").read_bytes() for name in ("work", "script", "command")}
    same = len(set(made.values())) == 1
    print(
        f"by_mouse: {out.name}: by mouse, by script and by command {'the same' if same else 'DIFFERENT'} "
        f"{len(made['work']):,} bytes; during the run Blender's timer was late by {np.median(late):.2f} s (median), "
        f"{max(late):.2f} s (most)",
        flush=True,
    )
    if not same:
        sys.exit("by_mouse: the bytes differ")


def by_mouse(mouse: Mouse, case: Case) -> Sequence[float]:
    """Import, box, views, Remove, export; returns by how many seconds Blender's timer was late during the run."""
    while not (mouse.blender.share / "state.json").exists():
        time.sleep(0.5)
    region = json.loads((case.folder / "roi.json").read_text())
    if case.dropped:
        mouse.type()  # nothing: a menu opens where the mouse is, and closes when it leaves
        (mouse.blender.share / "drop").touch()
        mouse.see("Import PLY")  # Blender's own importer takes the file too, so a menu asks
        mouse.type("s")  # the letter underlined in Import Splats, which the panel's button reads as well
        mouse.click("OK", lambda s: s["splats"] == 1)
    else:
        mouse.click("Import Splats", "scene.ply")
        mouse.click("scene.ply", lambda s: s["splats"] == 1, then=["Return"])
    mouse.type("Home")
    mouse.click("Cursor", lambda s: len(s["boxes"]) == 1)
    x, y, z = (str(v) for v in region["center"])
    mouse.type("g", x, "Tab", y, "Tab", z, "Return", "alt+s")
    for axis, size in zip("xyz", region["size"]):
        mouse.type("s", axis, str(size), "Return")
    mouse.wait(lambda s: np.allclose(s["boxes"][0], [*region["center"], *region["size"]]), PATIENCE)
    mouse.shot("box")
    if case.cameras:
        mouse.click("Import Cameras", "transforms.json")
        mouse.click("transforms.json", lambda s: s["cameras"] > 0, then=["Return"])
    else:
        mouse.click("Orbit round the Box", lambda s: s["cameras"] > 0)
    mouse.click("Remove Object", lambda s: s["running"] or s["splats"] == 2)
    late = run(mouse)
    mouse.wait(lambda s: s["splats"] == 2, PATIENCE)
    mouse.shot("removed")
    mouse.click("Export", "Export Splat PLY")
    exported = mouse.blender.share / "work.ply"
    mouse.click("Export Splat PLY", lambda _: exported.exists())
    mouse.click("Restore", lambda s: s["splats"] == 1)
    export_reference(mouse)
    return late


def export_reference(mouse: Mouse) -> None:
    """The file browser's button leaves Blender free while the picture is drawn."""
    (mouse.blender.share / "export_reference").touch()
    mouse.click("Export Reference", lambda s: s["running"])
    late = run(mouse)
    made = [mouse.blender.share / name for name in ("work.png", "work.mask.png")]
    if not all(m.exists() for m in made):
        sys.exit("by_mouse: the reference picture and its mask were not written")
    print(f"by_mouse: while the reference was drawn Blender's timer was late by {max(late):.2f} s (most)", flush=True)


def run(mouse: Mouse) -> Sequence[float]:
    """Wait for a child's end; returns by how many seconds Blender's timer was late meanwhile."""
    mouse.wait(lambda s: not s["running"], RUN_PATIENCE)
    return mouse.state()["late"] or [0.0]


def by_command(blender: RealBlender, case: Case) -> None:
    """The same with `gimp3d` alone, in the Python that Blender's child has."""
    core = next((blender.share / "user").rglob("site-packages/gimp3d")).parent
    program = ("env", f"PYTHONPATH=/{core.relative_to(blender.root)}", PYTHON, "-m", "gimp3d")
    if not case.cameras:
        orbit = ("orbit", "/share/scene.ply", "--roi", "/share/roi.json", "--out", "/share/transforms.json")
        blender.run(*program, *orbit)
    given = ("remove", "/share/scene.ply", "--cameras", "/share/transforms.json", "--roi", "/share/roi.json")
    blender.run(*program, *given, "--images", "none", "--out", "/share/command.ply", "--progress", "none")


if __name__ == "__main__":
    try:
        main()
    except subprocess.CalledProcessError as error:
        sys.exit(f"by_mouse: {' '.join(error.cmd[3:])} ended with {error.returncode}")

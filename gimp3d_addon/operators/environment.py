"""The Python that runs removals: made on request, and checked."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path
from typing import ClassVar

import bpy

from gimp3d.errors import BadInput

from ..installation import preferences, user_folder
from ..worker import Worker, core_folder, own_python
from .base import Need, RunsChild, python_of, redraw_panels

LOCK = Path(__file__).resolve().parents[1] / "wheels.txt"  # versions and SHA-256 of the files that are installed
SIZE = "about 190 MB to download, 650 MB on disk"  # on Linux: tools/lock_wheels.py --size measures it
INSTALLED = "gimp3d-installed.json"  # in the environment: pip's report of what it installed
MAKE = """
import json, os, subprocess, sys, venv
folder, python, lock, installed = sys.argv[1:]
say = lambda done, what: print(json.dumps({"stage": what, "done": done, "total": 2}), flush=True)
say(0, "making the environment")
venv.create(folder, with_pip=True, clear=True)
say(1, "installing the libraries")
pip = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
pinned = ["--require-hashes", "--no-deps", "--only-binary=:all:", "--requirement", lock]
sys.exit(subprocess.run([*pip, *pinned, "--report", os.path.join(folder, installed)]).returncode)
"""
CHECK = """
import importlib, json, os, sys
sys.path[:] = [*filter(None, sys.path), sys.argv.pop(1)]
found = {"python": sys.version.split()[0]}
for name in ("numpy", "scipy", "numba", "llvmlite", "cv2", "zstandard"):
    try:
        found[name] = importlib.import_module(name).__version__
    except Exception as error:
        found[name] = "" if isinstance(error, ModuleNotFoundError) else f"broken ({error})"
files = {}
try:
    with open(os.path.join(sys.prefix, sys.argv[1]), encoding="utf-8") as report:
        for f in json.load(report)["install"]:
            files[f["metadata"]["name"].lower()] = f["download_info"]["archive_info"]["hashes"]["sha256"]
except (OSError, ValueError, KeyError, TypeError):
    pass
print(json.dumps({"stage": "done", "summary": {"found": found, "files": files}}))
"""
NEEDED = ("numpy", "scipy", "numba", "cv2")
USES = {"zstandard": "for newer .spz files"}
PACKAGES = {"cv2": "opencv-contrib-python-headless"}  # modules that are called otherwise than their package
PIN = re.compile(r'^([\w-]+)==(\S+)(?: ; python_version (<|>=) "3\.(\d+)")?', re.MULTILINE)


def pins(python: str) -> dict[str, str]:
    """The version of each package that was tested, for a Python such as 3.11.9."""
    minor = int(python.split(".")[1])
    return {
        name: version
        for name, version, relation, bound in PIN.findall(LOCK.read_text(encoding="utf-8"))
        if not relation or (minor < int(bound)) == (relation == "<")
    }


def environment_folder() -> Path:
    """Where the button puts the environment: the extension's user folder, which updates leave alone."""
    return user_folder("environment")


def environment_python(folder: Path) -> Path:
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


class GIMP3D_OT_make_environment(RunsChild, bpy.types.Operator):
    """Make a Python environment with the libraries that Remove needs, and use it; asks before it downloads"""

    bl_idname = "gimp3d.make_environment"
    bl_label = "Make Environment"
    needs = (
        Need("Enable the extension first", lambda context: preferences(context) is not None),
        Need("Wait until what is running has ended", lambda _: RunsChild.running is None),
    )

    def ask(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_props_dialog(self, width=420, confirm_text="Download and Install")

    def draw(self, context: bpy.types.Context) -> None:
        python = ".".join(map(str, sys.version_info[:3]))
        column = self.layout.column(align=True)
        for name, version in pins(python).items():
            column.label(text=f"{name} {version}", icon="IMPORT")
        self.layout.label(text=f"from PyPI: {SIZE}. Only files whose SHA-256 is known are installed.")
        self.layout.label(text=str(environment_folder()))

    def start(self, context: bpy.types.Context) -> Worker:
        if not bpy.app.online_access:
            raise BadInput("Blender is set to stay offline; allow it in Preferences › System › Network")
        folder = environment_folder()
        self._python = environment_python(folder)
        return Worker([], command=[own_python(), "-c", MAKE, str(folder), str(self._python), str(LOCK), INSTALLED])

    def collect(self, context: bpy.types.Context) -> None:
        self.worker.result()
        preferences(context).python, GIMP3D_OT_check.found = str(self._python), {}
        self.report({"INFO"}, f"Remove now runs in {self._python}")


class GIMP3D_OT_check(RunsChild, bpy.types.Operator):
    """Say what the chosen Python has, what is missing, and whether it is what was tested"""

    bl_idname = "gimp3d.check"
    bl_label = "Check"

    found: ClassVar[dict[str, str]] = {}  # versions, of the last check, for the preferences
    verified: ClassVar[set[str]] = set()  # packages whose file had a known SHA-256 when it was installed

    def start(self, context: bpy.types.Context) -> Worker:
        return Worker(
            [], command=[python_of(context) or own_python(), "-X", "utf8", "-c", CHECK, core_folder(), INSTALLED]
        )

    def collect(self, context: bpy.types.Context) -> None:
        result, known = self.worker.result(), LOCK.read_text(encoding="utf-8")
        GIMP3D_OT_check.found = found = dict(result["found"])
        GIMP3D_OT_check.verified = {name for name, digest in result["files"].items() if f"sha256:{digest}" in known}
        redraw_panels(context)
        missing = [name for name in NEEDED if not found[name] or found[name].startswith("broken")]
        if missing:
            raise BadInput(f"the Python for Remove lacks {', '.join(missing)}; make an environment or choose another")
        others = [name for name in found if found[name] and "tested with" in verdict(name)]
        said = f"other versions than were tested: {', '.join(others)}" if others else "as tested"
        checked = (
            f"; {len(self.verified)} files' SHA-256 were checked when they were installed" if self.verified else ""
        )
        self.report({"INFO"}, f"all is there, {said}{checked}: " + json.dumps(found))


def verdict(name: str) -> str:
    """What the last check found out about a module, in words."""
    package, version = PACKAGES.get(name, name), GIMP3D_OT_check.found[name]
    tested = pins(GIMP3D_OT_check.found["python"]).get(package)
    if tested is None or not version or version.startswith("broken"):
        return ""
    if package in GIMP3D_OT_check.verified:
        return "the tested file, its SHA-256 checked when it was installed"
    # OpenCV's module does not say the last part of its package's version
    return "the tested version" if tested == version or tested.startswith(f"{version}.") else f"tested with {tested}"

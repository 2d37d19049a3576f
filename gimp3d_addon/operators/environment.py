"""The Python that runs removals: made on request, and checked."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import ClassVar

import bpy

from gimp3d.errors import BadInput

from ..properties import preferences, user_folder
from ..worker import Worker, core_folder, own_python
from .base import RunsChild, python_of

LIBRARIES = (  # as in pyproject.toml, which is not in the zip
    "numpy>=1.26,<3",
    "scipy>=1.11,<2",
    "numba>=0.61,<1",
    "opencv-contrib-python-headless>=4.8,<6",
    "zstandard>=0.22,<1",
)
SIZE = "about 190 MB to download, 650 MB on disk"  # on Linux: scripts/environment_size.py measures it
MAKE = """
import json, subprocess, sys, venv
folder, python, *libraries = sys.argv[1:]
say = lambda done, what: print(json.dumps({"stage": what, "done": done, "total": 2}), flush=True)
say(0, "making the environment")
venv.create(folder, with_pip=True, clear=True)
say(1, "installing the libraries")
pip = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
sys.exit(subprocess.run([*pip, *libraries]).returncode)
"""
CHECK = """
import importlib, json, sys
sys.path[:] = [*filter(None, sys.path), sys.argv.pop(1)]
found = {"python": sys.version.split()[0]}
for name in ("numpy", "scipy", "numba", "cv2", "zstandard"):
    try:
        found[name] = importlib.import_module(name).__version__
    except Exception as error:
        found[name] = "" if isinstance(error, ModuleNotFoundError) else f"broken ({error})"
print(json.dumps({"stage": "done", "summary": found}))
"""
NEEDED = ("numpy", "scipy", "numba", "cv2")
USES = {"zstandard": "for newer .spz files"}


def environment_folder() -> Path:
    """Where the button puts the environment: the extension's user folder, which updates leave alone."""
    return user_folder("environment")


def environment_python(folder: Path) -> Path:
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


class GIMP3D_OT_make_environment(RunsChild, bpy.types.Operator):
    """Make a Python environment with the libraries that Remove needs, and use it; asks before it downloads"""

    bl_idname = "gimp3d.make_environment"
    bl_label = "Make Environment"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Enable the extension first")
        return preferences(context) is not None and RunsChild.running is None

    def ask(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_props_dialog(self, width=420, confirm_text="Download and Install")

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.label(text=f"Downloads {', '.join(library.split('>')[0] for library in LIBRARIES)}")
        self.layout.label(text=f"from PyPI: {SIZE}.")
        self.layout.label(text=str(environment_folder()))

    def start(self, context: bpy.types.Context) -> Worker:
        if not bpy.app.online_access:
            raise BadInput("Blender is set to stay offline; allow it in Preferences › System › Network")
        folder = environment_folder()
        self._python = environment_python(folder)
        return Worker([], command=[own_python(), "-c", MAKE, str(folder), str(self._python), *LIBRARIES])

    def collect(self, context: bpy.types.Context) -> None:
        self.worker.result()
        preferences(context).python = str(self._python)
        self.report({"INFO"}, f"Remove now runs in {self._python}")


class GIMP3D_OT_check(RunsChild, bpy.types.Operator):
    """Say what the chosen Python has and what is missing"""

    bl_idname = "gimp3d.check"
    bl_label = "Check"

    found: ClassVar[dict[str, str]] = {}  # of the last check, for the preferences

    def start(self, context: bpy.types.Context) -> Worker:
        return Worker([], command=[python_of(context) or own_python(), "-X", "utf8", "-c", CHECK, core_folder()])

    def collect(self, context: bpy.types.Context) -> None:
        GIMP3D_OT_check.found = dict(self.worker.result())
        missing = [name for name in NEEDED if not self.found[name] or self.found[name].startswith("broken")]
        if missing:
            raise BadInput(f"the Python for Remove lacks {', '.join(missing)}; make an environment or choose another")
        self.report({"INFO"}, "all is there: " + json.dumps(self.found))


CLASSES = (GIMP3D_OT_make_environment, GIMP3D_OT_check)

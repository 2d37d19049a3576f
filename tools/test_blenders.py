"""Run the add-on's tests under the other Blenders that the extension is for (`make test-blenders`).

4.5 LTS goes into a virtual environment of this Python; 5.2 needs Python 3.13 and goes into the Debian chroot of
shared/tools/real-blender (root; skipped with a word where that tool is not). 5.0.1 is what `make test` runs.

    python tools/test_blenders.py [--root build/blender-trixie]
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tomllib
from pathlib import Path

from real_blender import ROOT, TOOL, run

SOURCES = (
    *("core", "gimp3d_addon", "tests", "assets", "docs", "tools"),
    *("pyproject.toml", "constraints.txt", "README.md", "LICENSE"),
)
TESTS = ("-m", "pytest", "tests/addon", "-m", "not slow", "--ignore", "tests/addon/test_extension.py")
OLD, NEW = "4.5.15", "5.2.3"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, default=ROOT / "build" / "blender-trixie", help="the chroot")
    root = parser.parse_args().root.resolve()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    libraries = [*project["dependencies"], "pytest>=8,<10", "hypothesis>=6.100,<7"]

    python = ROOT / "build" / f"bpy-{OLD}" / "bin" / "python"
    if not python.exists():
        run(sys.executable, "-m", "venv", python.parents[1])
        run(python, "-m", "pip", "install", "--quiet", f"bpy=={OLD}", *libraries)
    print(f"test_blenders: Blender {OLD}", flush=True)
    run("env", "-C", ROOT, f"PYTHONPATH={ROOT / 'core'}", python, *TESTS)

    if not TOOL.exists() or os.geteuid() != 0:
        print(f"test_blenders: Blender {NEW} skipped: it needs {TOOL.name} and root")
        return
    if not (root / "usr" / "bin" / "blender").exists():
        run(TOOL, "setup", "trixie", root)
    if not (root / "root" / "bpy" / "bin" / "python").exists():
        run(TOOL, "run", root, "python3", "-m", "venv", "/root/bpy")
        run(TOOL, "run", root, "/root/bpy/bin/pip", "install", "--quiet", f"bpy=={NEW}", *libraries)
    inside = root / "root" / "checkout"
    shutil.rmtree(inside, ignore_errors=True)
    for name in SOURCES:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy2
        inside.mkdir(exist_ok=True)
        copy(ROOT / name, inside / name)
    print(f"test_blenders: Blender {NEW}", flush=True)
    environment = ("env", "-C", "/root/checkout", "PYTHONPATH=/root/checkout/core")
    run(TOOL, "run", root, *environment, "/root/bpy/bin/python", *TESTS)


if __name__ == "__main__":
    main()

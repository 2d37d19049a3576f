"""A real Blender with its window, on a virtual screen in a Debian chroot: what the scripts that use one share.

Needs root on a Debian machine and shared/tools/real-blender, which sets the chroot up (2–4 minutes, 2 GB).
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
import numpy as np
from build_extension import LOCK

ROOT = Path(__file__).resolve().parents[1]
TOOL = Path(os.environ.get("REAL_BLENDER", ROOT.parent / "shared" / "tools" / "real-blender"))
SIZE = (1500, 1060)  # of the virtual screen
SUITES = {"trixie": ":77", "sid": ":78"}  # Blender 4.3 and 5.2 LTS, and the virtual screen of each
PYTHON = "/root/gimp/bin/python"  # inside: runs removals, as no wheel of the extension fits Debian's own


class RealBlender:
    """The chroot of a Debian suite; its folder `share` is /share inside."""

    def __init__(self, suite: str = "trixie", root: Path | None = None) -> None:
        if not TOOL.exists() or os.geteuid() != 0:
            sys.exit(f"{Path(sys.argv[0]).stem}: a real Blender needs root and {TOOL}; REAL_BLENDER names another tool")
        self.display = SUITES[suite]
        self.root = (root or ROOT / "build" / f"blender-{suite}").resolve()
        self.share = self.root / "share"
        if not (self.root / "usr" / "bin" / "blender").exists():
            run(TOOL, "setup", suite, self.root)
        if not (self.root / PYTHON[1:]).exists():
            self.run("python3", "-m", "venv", str(Path(PYTHON).parents[1]))
            shutil.copy2(LOCK, self.root / "root")
            pinned = ("--require-hashes", "--no-deps", "--only-binary=:all:", "-r", f"/root/{LOCK.name}")
            self.run(PYTHON, "-m", "pip", "install", "-q", *pinned)

    def inside(self, *command: str) -> list[str]:
        """The command line that runs a command inside, on the virtual screen."""
        screen = (f"DISPLAY={self.display}", "LIBGL_ALWAYS_SOFTWARE=1")
        ours = ("GIMP3D_SHARE=/share", f"GIMP3D_PYTHON={PYTHON}", "BLENDER_USER_RESOURCES=/share/user")
        return [str(TOOL), "run", str(self.root), "env", *screen, *ours, *command]

    def run(self, *command: str) -> None:
        run(*self.inside(*command))

    def put(self, *files: Path) -> None:
        """Empty the shared folder; put the extension, built now without wheels, and files into it."""
        shutil.rmtree(self.share, ignore_errors=True)
        self.share.mkdir()
        build = (sys.executable, ROOT / "tools" / "build_extension.py", "--platform", "here")
        run(*build, "--without-compiled-wheels")
        newest = max((ROOT / "dist").glob("*-light.zip"), key=lambda p: p.stat().st_mtime)
        shutil.copy2(newest, self.share / "gimp3d.zip")
        for file in files:
            shutil.copy2(file, self.share)

    @contextmanager
    def window(self, script: str) -> Iterator[subprocess.Popen[bytes]]:
        """Blender's process, with its window open and a script of the shared folder running; ended at the end."""
        width, height = map(str, SIZE)
        xvfb = self.inside("Xvfb", self.display, "-screen", "0", f"{width}x{height}x24", "+extension", "GLX")
        blender = self.inside("blender", "--window-geometry", "0", "0", width, height, "--no-window-focus")
        with (self.share / "blender.log").open("w") as log:
            screen = subprocess.Popen(xvfb, stdout=log, stderr=log, start_new_session=True)
            time.sleep(2)
            command = [*blender, "--python", f"/share/{script}"]
            window = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
        try:
            yield window
        finally:
            for process in (window, screen):  # with what runs inside of the chroot
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGTERM)

    def picture(self) -> np.ndarray:
        """The screen as it is now, [H, W, 3] uint8, OpenCV's BGR."""
        self.run("import", "-window", "root", "/share/screen.png")
        return cv2.imread(str(self.share / "screen.png"))


def run(*command: object) -> None:
    subprocess.run([str(c) for c in command], check=True)


def save_jpeg(path: Path, picture: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, 85])

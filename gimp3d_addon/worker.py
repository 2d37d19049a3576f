"""Runs the core in a child process: start, progress, cancel, collect.

A child, because Blender versions carry different Pythons, a crash or an out-of-memory kill must not take unsaved work
along, and Cancel must be immediate.
"""

from __future__ import annotations

import json
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import gimp3d
from gimp3d.errors import BadInput, Gimp3dError
from gimp3d.progress import Clock

# The core's folder comes last on the path: a chosen Python uses its own NumPy, numba and OpenCV. The folder that
# Blender was started in comes off it, as a user's numpy.py there must not be imported. A job is locked for as long as
# the child lives, as it may outlive Blender.
BOOT = """
import importlib.util, runpy, sys
sys.path[:] = [*filter(None, sys.path), sys.argv.pop(1)]
hold, lock = runpy.run_path(sys.argv.pop(1))["hold"], sys.argv.pop(1)
held = hold(lock, patience=2.0) if lock else True
if held is None:
    print("gimp3d: error: another process is at work on this job; wait for it, or end it", file=sys.stderr)
    sys.exit(2)
missing = [m for m in ("numpy", "scipy", "numba", "cv2") if importlib.util.find_spec(m) is None]
if missing:
    print(
        f"gimp3d: error: {sys.executable} has no {', '.join(missing)}; in the preferences of 3D-GIMP, choose a Python "
        "that has numba, scipy and opencv-contrib-python-headless",
        file=sys.stderr,
    )
    sys.exit(2)
from gimp3d.cli import entry_point
entry_point()
"""


def child_command(arguments: Sequence[str], python: str = "", lock: Path | None = None) -> list[str]:
    """The command line that runs `gimp3d arguments` in a chosen Python, or in Blender's own, while it holds a lock."""
    locking = (str(Path(__file__).with_name("lock.py")), str(lock or ""))
    return [python or own_python(), "-X", "utf8", "-c", BOOT, core_folder(), *locking, *arguments]


def core_folder() -> str:
    """What goes onto a child's path, so that it finds the core."""
    return str(Path(gimp3d.__file__).resolve().parents[1])


def own_python() -> str:
    """Blender's own interpreter; in some builds `sys.executable` is Blender itself."""
    if Path(sys.executable).name.lower().startswith("python"):
        return sys.executable
    found = shutil.which(f"python{sys.version_info[0]}.{sys.version_info[1]}", path=str(Path(sys.prefix) / "bin"))
    if found is None:
        raise BadInput("Blender's own Python was not found; choose one in the preferences of 3D-GIMP")
    return found


# s that the kernels take on a first run: the demo's takes 68 s of processor time, and 13 s from then on. That run's
# speed says nothing of what is left
COMPILING = 55.0
GIVE_WAY = 10  # how much nicer than Blender a child is, so that drawing does not wait for a core


class Killed(Gimp3dError):
    """The child was ended from outside, so what it was doing can be gone on with."""


class Worker:
    """One `gimp3d` command (or any other) in a child process; `poll` takes its progress, `cancel` ends it at once."""

    def __init__(
        self,
        arguments: Sequence[str],
        python: str = "",
        clock: Clock | None = None,  # of a removal: turns stages into one bar and the time left
        command: Sequence[str] | None = None,  # instead of gimp3d
        lock: Path | None = None,  # held while the child lives
    ) -> None:
        command = command or child_command(arguments, python, lock)
        self._errors = tempfile.TemporaryFile("w+", encoding="utf-8")  # noqa: SIM115, lives as long as the child
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                text=True,
                encoding="utf-8",
                creationflags=getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0),  # Windows'
            )
        except OSError as error:
            raise BadInput(
                f"cannot start {command[0]} ({error.strerror}); choose a Python in the preferences"
            ) from None
        if hasattr(os, "setpriority"):
            with suppress(OSError):  # it may have ended already
                os.setpriority(os.PRIO_PROCESS, self._process.pid, os.getpriority(os.PRIO_PROCESS, 0) + GIVE_WAY)
        self._lines: queue.Queue[str] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self._clock, self._started = clock, time.monotonic()
        self.progress = 0.0
        self.status = "starting"
        self.cancelled = False
        self.compiled = False  # the first run on a machine: its time says nothing of the next one's
        self.summary: dict[str, Any] | None = None
        self._error = ""

    def poll(self) -> bool:
        """Take what the child said; true once it has ended."""
        ended = not self._reader.is_alive()
        while not self._lines.empty():  # nobody else takes them
            self._take(self._lines.get())
        return ended and self._process.poll() is not None

    def join(self) -> None:
        """Wait for the end, however it comes."""
        self._reader.join()
        self._process.wait()
        self.poll()

    def wait(self) -> dict[str, Any]:
        """Run to the end; returns the summary ({} for commands without one), raises like `result`."""
        self.join()
        return self.result()

    def cancel(self) -> None:
        """End the child now; its finished stages stay in the job folder."""
        self.cancelled = True
        self._process.terminate()
        try:
            self._process.wait(timeout=0.8)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def result(self) -> dict[str, Any]:
        """The summary of an ended command.

        Raises
        ------
        Gimp3dError
            With the command line's own one line, if it failed.
        """
        code = self._process.returncode
        if code == 0:
            return self.summary or {}
        self._errors.seek(0)
        said = self._errors.read().strip().splitlines()
        line = self._error or next((s for s in reversed(said) if s.strip()), "")
        if not self._error and (code < 0 or not line):
            cause = f"signal {-code}" if code < 0 else f"code {code}"
            raise Killed(f"the work was ended from outside ({cause}; out of memory?); a removal can be resumed")
        raise Gimp3dError(line.removeprefix("gimp3d: error: "))

    def words(self, pace: float = 1.0) -> str:
        """What to show: the stage and, of a removal, the time left."""
        if self._clock is None or self.summary is not None:
            return self.status
        if self.compiled:
            left = (1 - self._clock.fraction) * (self._clock.forecast.seconds * pace + COMPILING)
            return f"{self.status} · about {duration(left)} left (compiling: first run only)"
        if self._clock.fraction == 0:  # whether it has to compile is said after reading
            return self.status
        left = self._clock.seconds_left(time.monotonic() - self._started, pace)
        return f"{self.status} · about {duration(left)} left"

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.put(line)

    def _take(self, line: str) -> None:
        try:
            said = json.loads(line)
        except ValueError:
            said = None
        if not isinstance(said, dict):
            return  # something a library printed
        if said.get("stage") == "done":
            self.summary, self.progress, self.status = said.get("summary"), 1.0, "done"
        elif said.get("stage") == "error":
            self._error = said["message"]
        elif "done" in said:
            self.progress = said["done"] / max(1, said["total"])
            self.status = said["stage"] if said["total"] == 1 else f"{said['stage']} {said['done']}/{said['total']}"
            self.compiled = self.compiled or said["stage"] == "compile"
            if self._clock is not None:
                self._clock.take(said["stage"], said["done"], said["total"])
                self.progress = self._clock.fraction


def duration(seconds: float) -> str:
    """A time in words of the right size."""
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    if seconds < 5400:
        return f"{round(seconds / 60)} min"
    return f"{seconds / 3600:.1f} h" if seconds < 2 * 86400 else f"{seconds / 86400:.0f} days"

"""Runs the core in a child process: start, progress, cancel, collect.

A child, because Blender versions carry different Pythons, a crash or an out-of-memory kill must not take unsaved work
along, and Cancel must be immediate.
"""

from __future__ import annotations

import json
import queue
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gimp3d
from gimp3d.errors import BadInput, Gimp3dError

# The core's folder comes last on the path: a chosen Python uses its own NumPy, numba and OpenCV. The folder that
# Blender was started in comes off it, as a user's numpy.py there must not be imported.
BOOT = """
import importlib.util, sys
sys.path[:] = [*filter(None, sys.path), sys.argv.pop(1)]
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


def child_command(arguments: Sequence[str], python: str = "") -> list[str]:
    """The command line that runs `gimp3d arguments` in a chosen Python, or in Blender's own."""
    folder = Path(gimp3d.__file__).resolve().parents[1]
    return [python or sys.executable, "-X", "utf8", "-c", BOOT, str(folder), *arguments]


class Worker:
    """One `gimp3d` command in a child process; `poll` takes its progress, `cancel` ends it at once."""

    def __init__(self, arguments: Sequence[str], python: str = "") -> None:
        command = child_command(arguments, python)
        self._errors = tempfile.TemporaryFile("w+", encoding="utf-8")  # noqa: SIM115, lives as long as the child
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                text=True,
                encoding="utf-8",
            )
        except OSError as error:
            raise BadInput(
                f"cannot start {command[0]} ({error.strerror}); choose a Python in the preferences"
            ) from None
        self._lines: queue.Queue[str] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self.progress = 0.0
        self.status = "starting"
        self.summary: dict[str, Any] | None = None
        self._error = ""

    def poll(self) -> bool:
        """Take what the child said; true once it has ended."""
        ended = not self._reader.is_alive()
        while True:
            try:
                self._take(self._lines.get_nowait())
            except queue.Empty:
                break
        return ended and self._process.poll() is not None

    def wait(self, tell: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
        """Run to the end; returns the summary ({} for commands without one), raises like `result`."""
        self._reader.join()
        self._process.wait()
        self.poll()
        tell(self.status)
        return self.result()

    def cancel(self) -> None:
        """End the child now; its finished stages stay in the job folder."""
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
        if code < 0 and not self._error:
            line = f"the removal was ended by signal {-code} (out of memory?); it can be resumed from its job folder"
        raise Gimp3dError(line.removeprefix("gimp3d: error: ") or f"the removal ended with code {code}")

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
            self.status = f"{said['stage']} {said['done']}/{said['total']} {said.get('message', '')}".strip()

"""Programs of the user's that paint or look: pictures in files, no shell, no input, ended with the run."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from ..errors import BadInput
from ..io.images import read_image, write_png
from .appearance import Painter
from .calls import Call, waited

GRACE = 0.3  # s that a program gets to end itself; Blender's Cancel ends this one after 0.8 s
LINE = 4096  # characters of a line that are read at once


def painter(command: str, call: Call) -> Painter:
    """A program that makes of {image} and {mask} (255 = fill) the picture {out}.

    Raises
    ------
    BadInput
        If the command line cannot be understood.
    """
    words = split(command, call.option, ("{image}", "{mask}", "{out}"), ("{out}",))

    def paint(image: np.ndarray, mask: np.ndarray, seed: int, call: Call) -> np.ndarray:
        with tempfile.TemporaryDirectory(prefix="gimp3d-", ignore_cleanup_errors=True) as folder:
            paths = {name: Path(folder) / f"{name}.png" for name in ("image", "mask", "out")}
            write_png(paths["image"], image)
            write_png(paths["mask"], mask)
            run(words, {f"{{{name}}}": path for name, path in paths.items()}, call)
            if not paths["out"].exists():
                raise BadInput(f"{call.option} command: {words[0]} wrote no {{out}} picture")
            return read_image(paths["out"])

    return Painter(words[0], paint, f"the picture that {words[0]} wrote", whole=True)


def split(command: str, option: str, names: Sequence[str], needed: Sequence[str]) -> list[str]:
    """The words of a command line, one of the `needed` among them."""
    if not any(name in command for name in needed):
        raise BadInput(
            f"{option} command: {command!r} does not say where {' or '.join(needed)} goes; use {' '.join(names)}"
        )
    try:
        return shlex.split(command)
    except ValueError as error:
        raise BadInput(f"{option} command: cannot read {command!r} ({error})") from None


def run(words: Sequence[str], paths: dict[str, Path], call: Call) -> None:
    """Run a program with these names replaced in its words; its last line, whatever it goes to, is its progress.

    Raises
    ------
    BadInput
        If it cannot be started, fails, or takes too long. Then, and if the run is cancelled, it and what it started
        are ended.
    """
    who, said = words[0], [""]
    filled = list(words)
    for name, path in paths.items():
        filled = [word.replace(name, str(path)) for word in filled]
    try:
        process = subprocess.Popen(
            filled,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=os.name == "posix",  # so that its own children can be ended with it
        )
    except OSError as error:
        raise BadInput(f"{call.option} command: cannot start {who} ({error.strerror})") from None
    except ValueError as error:  # a zero byte
        raise BadInput(f"{call.option} command: cannot start {who} ({error})") from None

    def listen() -> int:
        assert process.stdout is not None
        for line in iter(lambda: process.stdout.readline(LINE), ""):  # type: ignore[union-attr]
            said[0] = " ".join(line.split())[:200] or said[0]
        return process.wait()

    code = waited(who, listen, call, lambda: f"says: {said[0]}" if said[0] else "works", lambda: _end(process))
    if code != 0:
        raise BadInput(f"{call.option} command: {who} ended with {code}: {said[0] or 'no message'}")


def _end(process: subprocess.Popen[str]) -> None:
    """End a program and what it started; first politely, where the system knows how."""
    if os.name != "posix":
        subprocess.run(["taskkill", "/F", "/T", "/PID", str(process.pid)], capture_output=True, check=False)
        return
    for how in (signal.SIGTERM, signal.SIGKILL):
        with suppress(OSError):
            os.killpg(process.pid, how)
        with suppress(subprocess.TimeoutExpired):
            process.wait(GRACE)

"""Programs of the user's that paint or look: pictures in files, no shell, no input, ended with the run."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from ..errors import BadInput
from ..io.images import read_image, write_png
from .appearance import Painter
from .calls import Call, one_line, waited

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
        return asked(words, {"image": image, "mask": mask}, ("out.png",), "wrote no {out} picture", call, read_image)

    return Painter(words[0], paint, f"the picture that {words[0]} wrote", whole=True)


def asked(
    words: Sequence[str],
    given: Mapping[str, np.ndarray],  # the picture that {name} stands for
    answers: Sequence[str],  # names of the files that it may write, each {name} without the ending; the first counts
    missing: str,  # what it did wrong if it wrote none of them
    call: Call,
    read: Callable[[Path], np.ndarray],
) -> np.ndarray:
    """What a program makes of pictures; raises as `run` and `read` do."""
    with tempfile.TemporaryDirectory(prefix="gimp3d-", ignore_cleanup_errors=True) as folder:
        paths = {f"{{{Path(name).stem}}}": Path(folder) / name for name in (*(f"{n}.png" for n in given), *answers)}
        for name, picture in given.items():
            write_png(paths[f"{{{name}}}"], picture)
        run(words, paths, call)
        for name in answers:
            if (Path(folder) / name).exists():
                return read(Path(folder) / name)
    raise BadInput(f"{call.option} command: {words[0]} {missing}")


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
    who, said, filled = words[0], [""], list(words)
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
    except (OSError, ValueError) as error:  # ValueError: a zero byte
        reason = getattr(error, "strerror", None) or error
        raise BadInput(f"{call.option} command: cannot start {who} ({reason})") from None

    def listen() -> int:
        assert process.stdout is not None
        for line in iter(lambda: process.stdout.readline(LINE), ""):  # type: ignore[union-attr]
            said[0] = one_line(line, 200) or said[0]
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

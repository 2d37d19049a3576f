"""How painters and other work outside this program are asked and waited for: progress, time limit, cancel, leave.

Programs of the user's among them, that paint or look: pictures in files, no shell, no input, ended with the run.
"""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..errors import BadInput, one_line, refusing
from ..io.images import read_image, write_png
from ..progress import Progress, silent

R = TypeVar("R")
TICK = 0.1  # s between two looks whether it is done, or whether the user wants to stop
TELL = 1.0  # s between two words of progress
GRACE = 0.3  # s that a program gets to end itself; Blender's Cancel ends this one after 0.8 s
LINE = 4096  # characters of a line that are read at once


@dataclass(frozen=True)
class Call:
    """What whoever is asked may do and how it reports itself."""

    option: str = "--inpaint"  # by which it was given, for messages
    stage: str = "appearance"  # that waits for it
    progress: Progress = silent
    seconds: float = 600.0  # after which it is given up
    allow_network: bool = False  # whether pictures may leave this machine
    prompt: str = ""  # what the user wants to be seen there, for those who read
    strength: float = 1.0  # share of what stands in the mask that may change: 1 = it means nothing, paint it anew

    def tell(self, words: str) -> None:
        self.progress(self.stage, 0, 1, words)


# (picture [h, w, 3] uint8, mask [h, w] bool: what is to be painted, seed, call) → the picture painted, [H, W, 3] uint8
Paint = Callable[[np.ndarray, np.ndarray, int, Call], np.ndarray]


@dataclass(frozen=True)
class Painter:
    """Who paints pictures outside this program: a network, another program, a server."""

    who: str  # for messages
    paint: Paint  # its answer is of about the picture's shape, in any size; it need not respect the mask
    answer: str  # what its picture is called in messages
    whole: bool = False  # it is given the whole view, not the hole's surroundings
    notice: str = ""  # what is sent where and what that costs, said before anything is done


def waited(
    who: str,
    work: Callable[[], R],
    call: Call,
    words: Callable[[], str] = lambda: "works",  # what it is doing, asked for every second
    stop: Callable[[], None] = lambda: None,  # ends the work; called once if it is not waited for any longer
) -> R:
    """What `work` returns or raises; it runs in a thread of its own, so that Cancel need not wait for its end.

    A thread cannot be ended: what `stop` does not end goes on unseen until the program ends.
    Raises BadInput if it takes longer than `call.seconds`.
    """
    future: Future[R] = Future()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    start = told = time.monotonic()
    threading.Thread(target=run, name=f"gimp3d waits for {who}", daemon=True).start()
    try:
        while not wait([future], TICK).done:
            now = time.monotonic()
            if now - start > call.seconds:
                raise BadInput(
                    f"{call.option}: {who} was not done after {call.seconds:g} s and is stopped; allow it more time "
                    "with --set painter_seconds=…"
                )
            if now - told >= TELL:
                told = now
                call.tell(f"{who} {words()}, {now - start:.0f} s")
    except BaseException:
        stop()
        raise
    return future.result()


def command_painter(command: str, call: Call) -> Painter:
    """A program that makes of {image} and {mask} (255 = fill) the picture {out}; raises as `split_command` does."""
    words = split_command(command, call.option, ("{image}", "{mask}", "{out}"), ("{out}",))

    def paint(image: np.ndarray, mask: np.ndarray, seed: int, call: Call) -> np.ndarray:
        given, wrong = {"image": image, "mask": mask}, "wrote no {out} picture"
        return ask_command(words, given, ("out.png",), wrong, call, read_image)

    return Painter(words[0], paint, f"the picture that {words[0]} wrote", whole=True)


def split_command(command: str, option: str, names: Sequence[str], needed: Sequence[str]) -> list[str]:
    """The words of a command line, one of the `needed` among them; raises BadInput if it cannot be understood."""
    if not any(name in command for name in needed):
        raise BadInput(
            f"{option} command: {command!r} does not say where {' or '.join(needed)} goes; use {' '.join(names)}"
        )
    with refusing(f"{option} command: cannot read {command!r}", ValueError):
        return shlex.split(command)


def ask_command(
    words: Sequence[str],
    given: Mapping[str, np.ndarray],  # the picture that {name} stands for
    answers: Sequence[str],  # names of the files that it may write, each {name} without the ending; the first counts
    missing: str,  # what it did wrong if it wrote none of them
    call: Call,
    read: Callable[[Path], np.ndarray],
) -> np.ndarray:
    """What a program makes of pictures, by `read`; its last line, whatever that goes to, is its progress.

    Raises BadInput if it cannot be started, fails, takes too long, or answers nothing. Then, and if the run is
    cancelled, it and what it started are ended.
    """
    who, said, filled = words[0], [""], list(words)
    with tempfile.TemporaryDirectory(prefix="gimp3d-", ignore_cleanup_errors=True) as folder:
        for name in (*(f"{n}.png" for n in given), *answers):
            filled = [word.replace(f"{{{Path(name).stem}}}", str(Path(folder) / name)) for word in filled]
        for name, picture in given.items():
            write_png(Path(folder) / f"{name}.png", picture)
        with refusing(f"{call.option} command: cannot start {who}", OSError, ValueError):  # ValueError: a zero byte
            process = subprocess.Popen(
                filled,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                start_new_session=os.name == "posix",  # so that its own children can be ended with it
            )

        def listen() -> int:
            for line in iter(lambda: process.stdout.readline(LINE), ""):  # type: ignore[union-attr]
                said[0] = one_line(line, 200) or said[0]
            return process.wait()

        code = waited(who, listen, call, lambda: f"says: {said[0]}" if said[0] else "works", lambda: _end(process))
        if code != 0:
            raise BadInput(f"{call.option} command: {who} ended with {code}: {said[0] or 'no message'}")
        for name in answers:
            if (Path(folder) / name).exists():
                return read(Path(folder) / name)
    raise BadInput(f"{call.option} command: {who} {missing}")


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

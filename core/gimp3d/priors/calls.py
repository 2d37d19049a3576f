"""How work outside this program is asked for and waited for: progress, time limit, cancel, and what it may do."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from dataclasses import dataclass
from typing import TypeVar

from ..errors import BadInput
from ..progress import Progress, silent

R = TypeVar("R")
TICK = 0.1  # s between two looks whether it is done, or whether the user wants to stop
TELL = 1.0  # s between two words of progress


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


def one_line(text: object, most: int = 300) -> str:
    """What somebody outside says, for an error's line."""
    return " ".join(str(text).split())[:most]


def waited(
    who: str,
    work: Callable[[], R],
    call: Call,
    words: Callable[[], str] = lambda: "works",  # what it is doing, asked for every second
    stop: Callable[[], None] = lambda: None,  # ends the work; called once if it is not waited for any longer
) -> R:
    """What `work` returns or raises; it runs in a thread of its own, so that Cancel need not wait for its end.

    A thread cannot be ended: what `stop` does not end goes on unseen until the program ends.

    Raises
    ------
    BadInput
        If it takes longer than `call.seconds`.
    """
    future: Future[R] = Future()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    thread = threading.Thread(target=run, name=f"gimp3d waits for {who}", daemon=True)
    start = told = time.monotonic()
    thread.start()
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

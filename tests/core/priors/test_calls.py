"""Waiting for others: their answer or error, a time limit, and Cancel at once."""

import threading
import time

import pytest

from gimp3d.errors import BadInput, Cancelled
from gimp3d.priors.calls import Call, waited


def test_the_answer_or_the_error_is_handed_on() -> None:
    assert waited("somebody", lambda: 7, Call()) == 7
    with pytest.raises(ZeroDivisionError):
        waited("somebody", lambda: 1 // 0, Call())


def test_who_takes_too_long_is_stopped() -> None:
    ended = threading.Event()
    start = time.monotonic()
    with pytest.raises(BadInput, match=r"--depth-prior: somebody was not done after 0\.2 s and is stopped"):
        waited("somebody", lambda: ended.wait(20), Call("--depth-prior", seconds=0.2), stop=ended.set)
    assert ended.is_set() and time.monotonic() - start < 2


def test_progress_is_told_often_and_may_cancel() -> None:
    ended, told = threading.Event(), []

    def progress(stage: str, done: int, total: int, message: str = "") -> None:
        told.append((stage, done, total, message))
        raise Cancelled("stop")

    start = time.monotonic()
    with pytest.raises(Cancelled):
        waited("somebody", lambda: ended.wait(20), Call(stage="depth 2", progress=progress), lambda: "looks", ended.set)
    assert ended.is_set() and time.monotonic() - start < 3
    assert told == [("depth 2", 0, 1, "somebody looks, 0 s")]

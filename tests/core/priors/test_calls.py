"""Waiting for others: their answer or error, a time limit, and Cancel at once.

Programs of the user's: pictures in files, no shell, no input; ended when they take too long or nobody waits.
"""

import os
import sys
import threading
import time
from pathlib import Path

import pytest
from pictures import badly_drawn, disc, holed, refuse, scenery

from gimp3d.errors import BadInput, Cancelled
from gimp3d.io.images import write_png
from gimp3d.priors.calls import Call, waited
from gimp3d.priors.inpaint import inpaint_reference


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


# Programs


def script(folder: Path, body: str) -> str:
    """A command that runs a Python script with {image} {mask} {out}."""
    path = folder / "fill.py"
    path.write_text(f"import sys, shutil\nimage, mask, out = sys.argv[1:]\n{body}\n", encoding="utf-8")
    return f"command:'{sys.executable}' '{path}' {{image}} {{mask}} {{out}}"


def test_a_command_fills_the_hole(tmp_path: Path) -> None:
    picture, hole = scenery(), disc()
    body = (
        "import cv2\n"
        "picture, where = cv2.imread(image), cv2.imread(mask, 0)\n"
        "assert set(where.ravel()) == {0, 255}\n"
        "picture[where > 0] = (30, 20, 10)\n"
        "cv2.imwrite(out, picture)"
    )
    done = inpaint_reference(script(tmp_path, body), picture, hole)
    assert (done.image[hole] == (10, 20, 30)).all()
    assert (done.image[~hole] == picture[~hole]).all()


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("print('no model', file=sys.stderr); sys.exit(3)", "ended with 3: no model"),
        ("pass", "wrote no"),
        ("open(out, 'w').write('text')", "not a picture"),
        ("import cv2; cv2.imwrite(out, cv2.imread(image)[:50])", "not the shape of the view"),
    ],
)
def test_a_command_that_fails_is_reported(tmp_path: Path, body: str, message: str) -> None:
    refuse(message, script(tmp_path, body), scenery(), disc())


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("command:no-such-program-here {image} {mask} {out}", "cannot start no-such-program-here"),
        ("command:true {image}", "does not say where"),
        ("command:fill 'unbalanced {out}", "cannot read"),
    ],
)
def test_a_command_that_cannot_run_is_refused(spec: str, message: str) -> None:
    refuse(message, spec, scenery(), disc())


def test_a_command_sees_no_shell(tmp_path: Path) -> None:
    body = "import cv2; cv2.imwrite(out, cv2.imread(image))"
    spec = script(tmp_path, body).replace("{out}", f"{{out}} ; touch {tmp_path / 'escaped'}")
    refuse("ended with 1", spec, scenery(), disc())
    assert not (tmp_path / "escaped").exists()


def test_a_command_may_be_warned_about(tmp_path: Path) -> None:
    """A warning comes through a provider to whoever asked it."""
    picture, hole = scenery(240, 320), disc(240, 320, 40)
    path = tmp_path / "photo.png"
    write_png(path, picture)
    body = f"shutil.copy({str(path)!r}, out)"
    done = inpaint_reference(script(tmp_path, body), holed(badly_drawn(picture), hole), hole)
    assert len(done.warnings) == 1 and "matches the view poorly" in done.warnings[0]


def test_a_command_has_no_input_and_its_words_are_progress(tmp_path: Path) -> None:
    said: list[str] = []

    def note(stage: str, done: int, total: int, message: str = "") -> None:
        said.append(f"{stage}: {message}")

    body = (
        "import time\n"
        "assert sys.stdin.read() == ''\n"
        "print('step 3 of 9', end='\\rstep 4', flush=True)\n"
        "time.sleep(0.6)\n"
        "shutil.copy(image, out)"
    )
    inpaint_reference(script(tmp_path, body), scenery(), disc(), call=Call(stage="appearance 2", progress=note))
    assert any(w.startswith("appearance 2: ") and "says: step 3 of 9, 0 s" in w for w in said)


LINGERS = (  # starts a program of its own, writes down both, and waits; the test kills what is left if it must
    "import os, subprocess, time\n"
    "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
    "open({pids!r}, 'w').write(f'{{os.getpid()}} {{child.pid}}')\n"
    "time.sleep(60)"
)


def gone(pid: int) -> bool:
    """Whether a process has ended (a zombie that nobody waits for has)."""
    try:
        os.kill(pid, 0)
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (ProcessLookupError, FileNotFoundError):
        return True


def all_gone(pids: Path) -> bool:
    deadline = time.monotonic() + 3
    while time.monotonic() < deadline:
        if all(gone(int(pid)) for pid in pids.read_text().split()):
            return True
        time.sleep(0.02)
    return False


@pytest.mark.skipif(os.name != "posix", reason="looks at processes as POSIX shows them")
def test_a_command_that_takes_too_long_is_ended_with_what_it_started(tmp_path: Path) -> None:
    pids = tmp_path / "pids"
    start = time.monotonic()
    spec = script(tmp_path, LINGERS.format(pids=str(pids)))
    refuse("was not done after 1.2 s and is stopped; .*painter_seconds", spec, scenery(), disc(), Call(seconds=1.2))
    assert time.monotonic() - start < 4
    assert all_gone(pids)


@pytest.mark.skipif(os.name != "posix", reason="looks at processes as POSIX shows them")
@pytest.mark.parametrize("how", [Cancelled, KeyboardInterrupt])
def test_a_cancelled_command_is_ended_with_what_it_started(tmp_path: Path, how: type[BaseException]) -> None:
    pids = tmp_path / "pids"

    def cancel(stage: str, done: int, total: int, message: str = "") -> None:
        if pids.exists() and len(pids.read_text().split()) == 2:
            raise how

    with pytest.raises(how):
        spec = script(tmp_path, LINGERS.format(pids=str(pids)))
        inpaint_reference(spec, scenery(), disc(), call=Call(progress=cancel))
    assert all_gone(pids)

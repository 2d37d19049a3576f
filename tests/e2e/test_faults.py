"""Whatever goes wrong: one line, the right exit code, and the world as it was."""

from __future__ import annotations

import json
import os
import shutil
import signal
import stat
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scenes import REGION, cameras, scene

from gimp3d import commands
from gimp3d.cli import main
from gimp3d.errors import Terminated
from gimp3d.files import UNFINISHED, user_state_folder
from gimp3d.io.cameras import write_transforms
from gimp3d.io.ply import write_gaussians
from gimp3d.pipeline import RemovalResult

posix = pytest.mark.skipif(os.name != "posix", reason="a matter of POSIX systems")

MOMENTS = 12  # at which a run is stopped, from its start to its end
KILLS = 6  # of a removal that is then gone on with

# Stands for the work: nothing is removed, so a command takes as long as reading and writing do
QUICK = (
    "import sys, os, time, signal\n"
    "import gimp3d.cli as cli, gimp3d.commands as commands, numpy as np\n"
    "from gimp3d.pipeline import RemovalResult\n"
    "def work(scene, *rest):\n"
    "    {work}\n"
    "    return RemovalResult(np.ones(len(scene), bool), None)\n"
    "commands.remove_object = work\n"
    "sys.argv[0] = 'gimp3d'\n"
    "cli.entry_point()\n"
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    write_gaussians(folder / "scene.ply", scene())
    write_transforms(folder / "cameras.json", cameras(3))
    (folder / "roi.json").write_text(json.dumps(REGION[0].to_json()))
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    return shutil.copytree(made, tmp_path / "f")


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A removal that has nothing to do, and views that need not be drawn."""
    monkeypatch.setattr(commands, "remove_object", lambda g, *_: RemovalResult(np.ones(len(g), bool), None))
    monkeypatch.setattr(commands, "render_bytes", lambda g, c, *_: np.zeros((c.height, c.width, 3), np.uint8))


def options(folder: Path, *more: object) -> list[str]:
    files = ["remove", folder / "scene.ply", "--cameras", folder / "cameras.json", "--roi", folder / "roi.json"]
    return [*map(str, files), "--images", "none", "--progress", "none", *map(str, more)]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1 and said[0].startswith("gimp3d: error: "), said
    return said[0]


def start(folder: Path, *more: object, work: str = "pass", **how: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", QUICK.format(work=work), *options(folder, *more)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, **how)  # type: ignore[call-overload]


# ---------------------------------------------------------------------------------------------------- before the work


@pytest.mark.usefixtures("at_once")
@pytest.mark.parametrize("option", ["--out", "--report", "--summary", "--views-out", "--job"])
def test_targets_are_tried_before_the_work(
    option: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def too_late(*_: object) -> RemovalResult:
        raise AssertionError("the work had begun")

    monkeypatch.setattr(commands, "remove_object", too_late)
    (folder / "file").write_text("in the way")
    before = contents(folder)
    targets = {"--out": folder / "out.ply", option: folder / "file" / "x.ply"}
    assert main(options(folder, *[w for pair in targets.items() for w in pair])) == 2
    assert "cannot" in one_line(capsys)
    assert contents(folder) == before


@pytest.mark.usefixtures("at_once")
@pytest.mark.parametrize("fails", ["write_charts", "write_removal_report", "write_ply"])
def test_a_failure_while_writing_leaves_out_as_it_was(
    fails: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    (folder / "out.ply").write_bytes(b"precious")
    monkeypatch.setattr(commands, fails, full)
    more = ["--out", folder / "out.ply", "--views-out", folder / "v", "--report", folder / "r"]
    assert main(options(folder, *more)) != 0
    one_line(capsys)
    assert (folder / "out.ply").read_bytes() == b"precious"


# ---------------------------------------------------------------------------------------------- interrupted and killed


@pytest.mark.usefixtures("at_once")
@pytest.mark.parametrize(
    ("stop", "code"), [(KeyboardInterrupt(), 130), (Terminated(15), 143), (Terminated(1), 129)], ids=str
)
def test_stopped_before_out_is_written(
    stop: BaseException, code: int, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(*_: object) -> None:
        raise stop

    monkeypatch.setattr(commands, "remove_object", stopped)
    before = contents(folder)
    assert main(options(folder, "--out", folder / "out.ply")) == code
    assert "nothing was changed" in one_line(capsys)
    assert contents(folder) == before


@pytest.mark.usefixtures("at_once")
def test_stopped_after_out_was_written_it_says_so(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write = commands.write_ply

    def written_and_stopped(*given: object) -> None:
        write(*given)  # type: ignore[arg-type]
        raise KeyboardInterrupt

    monkeypatch.setattr(commands, "write_ply", written_and_stopped)
    assert main(options(folder, "--out", folder / "out.ply")) == 0
    assert "after" in capsys.readouterr().err and (folder / "out.ply").read_bytes()[:3] == b"ply"


@posix
@pytest.mark.parametrize(
    ("name", "code"), [("SIGTERM", 143), ("SIGINT", 130), pytest.param("SIGHUP", 129, marks=pytest.mark.slow)]
)
def test_a_signal_ends_the_program_with_its_code(name: str, code: int, folder: Path) -> None:
    (folder / "out.ply").write_bytes(b"precious")
    before = contents(folder)
    work = "print('at work', flush=True); time.sleep(60)"
    number = getattr(signal, name)
    # a shell's background jobs ignore SIGINT, and what they start does too
    heard = partial(signal.signal, number, signal.SIG_DFL)
    with start(folder, "--out", folder / "out.ply", work=work, stdout=subprocess.PIPE, preexec_fn=heard) as running:
        assert running.stdout and running.stdout.readline()
        running.send_signal(number)
        said = running.communicate(timeout=20)[1]
    assert running.returncode == code and said.count("\n") == 1 and "nothing was changed" in said, said
    assert contents(folder) == before


@posix
@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGINT", "SIGKILL"])
def test_a_signal_at_any_moment_leaves_out_whole(name: str, folder: Path) -> None:
    (folder / "out.ply").write_bytes(b"precious")
    legal = {0, 128 + getattr(signal, name), -getattr(signal, name)}  # 0: it was done, negative: Python not yet up
    begun = time.monotonic()
    start(folder, "--out", folder / "out.ply").communicate()
    lasts = time.monotonic() - begun
    for delay in np.linspace(0, 1.1 * lasts, MOMENTS):
        (folder / "out.ply").write_bytes(b"precious")
        with start(folder, "--out", folder / "out.ply") as running:
            time.sleep(delay)
            running.send_signal(getattr(signal, name))
            running.communicate(timeout=30)
        assert running.returncode in legal
        done = (folder / "out.ply").read_bytes()
        assert done == b"precious" if running.returncode else done[:3] == b"ply"
        left = [p for p in folder.iterdir() if p.name.endswith(UNFINISHED)]
        assert not left or name == "SIGKILL"
    assert main(options(folder, "--out", folder / "out.ply", "--preset", "none")) == 2
    start(folder, "--out", folder / "out.ply").communicate()
    assert not [p for p in folder.iterdir() if p.name.endswith(UNFINISHED)]


@pytest.mark.slow
def test_a_killed_removal_goes_on_to_the_same_bytes(folder: Path) -> None:
    def command(name: str, *more: str) -> list[str]:
        job = ["--job", str(folder / name), "--out", str(folder / name / "out.ply"), "--preset", "draft"]
        return [sys.executable, "-m", "gimp3d", *options(folder, *job), *more]

    for name in ("cold", "whole"):  # the first may have to compile
        begun = time.monotonic()
        subprocess.run(command(name), check=True)
        lasts = time.monotonic() - begun
    expected = (folder / "whole" / "out.ply").read_bytes()
    for k in range(KILLS):
        name = f"killed{k}"
        with subprocess.Popen(command(name)) as running:
            time.sleep((k + 0.5) / KILLS * lasts)
            running.kill()
        out = folder / name / "out.ply"
        assert not out.exists() or out.read_bytes() == expected
        subprocess.run(command(name, "--resume"), check=True)
        assert out.read_bytes() == expected
        assert not list((folder / name).rglob(f".*{UNFINISHED}"))


@posix
@pytest.mark.usefixtures("at_once")
def test_what_a_killed_run_left_of_a_variant_is_swept(folder: Path) -> None:
    """Variants' stages lie in folders of their own."""
    stages = folder / "job" / "stages"
    (stages / "2").mkdir(parents=True)
    with subprocess.Popen(["true"]) as dead:
        dead.wait()
    left = [place / f".seed.npz.x.{dead.pid}{UNFINISHED}" for place in (stages, stages / "2")]
    for path in left:
        path.write_bytes(b"half")
    assert main(options(folder, "--job", folder / "job", "--out", folder / "out.ply")) == 0
    assert not any(path.exists() for path in left)


# -------------------------------------------------------------------------------------------------- nobody who listens


STREAMS = [
    ">&- 2>&- <&-",
    ">/dev/full 2>/dev/full",
    *(pytest.param(words, marks=pytest.mark.slow) for words in (">&-", "2>&-", ">/dev/full", "2>/dev/full")),
]


@posix
@pytest.mark.parametrize("streams", STREAMS)
def test_closed_and_full_streams_change_nothing(streams: str, folder: Path) -> None:
    command = [sys.executable, "-c", QUICK.format(work="pass"), *options(folder, "--out", folder / "out.ply")]
    command += ["--progress", "json" if "full" in streams else "bar"]
    done = subprocess.run(["sh", "-c", f'"$@" {streams}', "sh", *command], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (folder / "out.ply").read_bytes() == (folder / "scene.ply").read_bytes()
    bad = subprocess.run(["sh", "-c", f'"$@" {streams}', "sh", *command[:3], "fill"], capture_output=True)
    assert bad.returncode == 2


@posix
def test_a_reader_who_leaves_does_not_stop_the_run(folder: Path) -> None:
    read, write = os.pipe()
    os.close(read)
    with start(folder, "--out", folder / "out.ply", "--progress", "json", stdout=write) as running:
        os.close(write)
        running.communicate(timeout=30)
    assert running.returncode == 0 and (folder / "out.ply").exists()


# -------------------------------------------------------------------------------------------------------- last resort


@pytest.mark.usefixtures("at_once")
def test_what_nobody_foresaw_is_one_line_and_a_log(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("two\nlines")

    monkeypatch.setattr(commands, "remove_object", broken)
    before = contents(folder)
    assert main(options(folder, "--out", folder / "out.ply")) == 1
    said = one_line(capsys)
    assert "ZeroDivisionError: two lines" in said
    log = Path(said.rsplit(", ", 1)[1])
    assert log.parent == user_state_folder() / "logs" and "Traceback" in log.read_text()
    assert contents(folder) == before


def test_without_a_place_for_the_log_it_is_still_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(commands, "scene_info", broken)
    (folder / "file").write_text("")
    monkeypatch.setenv("GIMP3D_STATE", str(folder / "file"))
    assert main(["info", str(folder / "scene.ply")]) == 1
    assert "log could not be written" in one_line(capsys)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the limit is Linux's")
def test_too_little_memory_is_one_line(folder: Path) -> None:
    command = [sys.executable, "-m", "gimp3d", *options(folder, "--out", folder / "out.ply")]
    done = subprocess.run(["sh", "-c", 'ulimit -v 700000; "$@"', "sh", *command], capture_output=True, text=True)
    assert done.returncode == 3 and done.stderr.startswith("gimp3d: error: out of memory: ")
    assert done.stderr.count("\n") == 1 and not (folder / "out.ply").exists()


@pytest.mark.usefixtures("at_once")
def test_views_that_no_memory_can_hold_are_refused_before_they_are_read(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("gimp3d.memory.free_memory", lambda: 10 << 20)
    monkeypatch.setattr("gimp3d.cli.require_base_memory", lambda: None)
    write_transforms(folder / "cameras.json", cameras(3, 1000, 1000))
    assert main(options(folder, "--out", folder / "out.ply")) == 3
    assert "3 views takes about" in one_line(capsys)


# ------------------------------------------------------------------------------------------------------ odd places


@posix
@pytest.mark.usefixtures("at_once")
def test_devices_and_links_as_targets(folder: Path) -> None:
    (folder / "real.ply").write_bytes(b"old")
    (folder / "real.ply").chmod(0o600)
    (folder / "link.ply").symlink_to("real.ply")
    assert main(options(folder, "--out", folder / "link.ply", "--summary", os.devnull)) == 0
    assert (folder / "link.ply").is_symlink() and stat.S_IMODE((folder / "real.ply").stat().st_mode) == 0o600
    assert (folder / "real.ply").read_bytes() == (folder / "scene.ply").read_bytes()
    assert main(options(folder, "--out", os.devnull)) == 0
    assert stat.S_ISCHR(os.stat(os.devnull).st_mode)


@posix
@pytest.mark.usefixtures("at_once")
@pytest.mark.parametrize("option", ["SCENE", "--cameras", "--roi"])
def test_a_pipe_as_input_is_refused(option: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo(folder / "pipe")
    arguments = options(folder, "--out", folder / "out.ply")
    arguments[1 if option == "SCENE" else arguments.index(option) + 1] = str(folder / "pipe")
    assert main(arguments) == 2
    assert "pipe" in one_line(capsys)

"""Files are written whole or not at all, and nothing but files is replaced."""

from __future__ import annotations

import os
import stat
import threading
from pathlib import Path

import pytest

from gimp3d.errors import BadInput
from gimp3d.files import UNFINISHED, require_file, sweep, try_target, write_atomically
from gimp3d.io.cameras import read_cameras
from gimp3d.io.formats import read_scene
from gimp3d.io.images import read_image
from gimp3d.job import load_job

posix = pytest.mark.skipif(os.name != "posix", reason="a matter of POSIX file systems")


def write(path: Path, data: bytes = b"new") -> None:
    write_atomically(path, lambda f: f.write(data))


@posix
def test_permissions_and_links_of_what_is_replaced_are_kept(tmp_path: Path) -> None:
    target = tmp_path / "real"
    target.write_bytes(b"old")
    target.chmod(0o640)
    (tmp_path / "link").symlink_to("real")
    write(tmp_path / "link")
    assert (tmp_path / "link").is_symlink() and target.read_bytes() == b"new"
    assert stat.S_IMODE(target.stat().st_mode) == 0o640
    (tmp_path / "dangling").symlink_to("later")
    write(tmp_path / "dangling")
    assert (tmp_path / "later").read_bytes() == b"new" and (tmp_path / "dangling").is_symlink()


@posix
def test_devices_and_pipes_are_written_to_and_never_replaced(tmp_path: Path) -> None:
    pipe, got = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: got.append(pipe.read_bytes()))
    reader.start()
    write(pipe, b"x" * 200_000)
    reader.join(10)
    assert got == [b"x" * 200_000] and stat.S_ISFIFO(pipe.stat().st_mode)
    write(Path(os.devnull))
    assert stat.S_ISCHR(os.stat(os.devnull).st_mode)
    with pytest.raises(BadInput, match="cannot write /dev/full"):
        write(Path("/dev/full"))
    assert [p.name for p in tmp_path.iterdir()] == ["pipe"]


@posix
@pytest.mark.parametrize("read", [read_scene, read_cameras, read_image, lambda p: load_job(p.parent)])
def test_a_pipe_is_refused_as_input_instead_of_waited_for(read, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    os.mkfifo(tmp_path / "job.json")
    with pytest.raises(BadInput, match=r"pipe|not a file"):
        read(tmp_path / "job.json")
    with pytest.raises(BadInput):
        require_file(Path(os.devnull))


def test_targets_are_tried_without_leaving_a_trace(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    (tmp_path / "folder").mkdir()
    for good in (tmp_path / "new" / "deep" / "x", tmp_path / "file"):
        try_target(good)
    try_target(tmp_path / "other", is_folder=True)
    for bad in (tmp_path / "file" / "x", tmp_path / "folder", tmp_path / ("n" * 300), Path("nul\0")):
        with pytest.raises(BadInput, match="cannot write"):
            try_target(bad)
    with pytest.raises(BadInput, match="cannot write"):
        try_target(tmp_path / "file", is_folder=True)
    assert {p.name for p in tmp_path.iterdir()} == {"file", "folder"}


@posix
def test_what_killed_runs_left_is_swept_and_what_lives_stays(tmp_path: Path) -> None:
    dead = os.fork()
    if dead == 0:
        os._exit(0)
    os.waitpid(dead, 0)
    names = [f".out.ply.abc.{dead}{UNFINISHED}", f".out.ply.abc.{os.getppid()}{UNFINISHED}", ".other", "out.ply"]
    for name in names:
        (tmp_path / name).write_bytes(b"")
    sweep([tmp_path, tmp_path / "missing"])
    assert {p.name for p in tmp_path.iterdir()} == set(names[1:])


def test_a_name_of_many_letters_can_be_written(tmp_path: Path) -> None:
    name = "ä" * 120  # 240 bytes
    write(tmp_path / name)
    assert [p.name for p in tmp_path.iterdir()] == [name]

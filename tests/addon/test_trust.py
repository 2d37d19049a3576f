"""A .blend, and the folders beside it, may come from anybody: they run nothing, and write nowhere they should not."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from gimp3d.errors import BadInput
from gimp3d.io.cameras import read_cameras
from gimp3d.io.images import write_png
from gimp3d.job import RemovalJob, load_job, save_job
from gimp3d_addon import bridge, jobs, steps, trust
from gimp3d_addon.installation import user_folder
from gimp3d_addon.operators import base
from gimp3d_addon.operators.base import AsksFirst, RunsChild
from gimp3d_addon.operators.remove import RunsRemoval

SIZE = (120, 90)


@pytest.fixture(autouse=True)
def nothing_allowed_yet() -> Iterator[None]:
    yield
    for name in (trust.ALLOWED, trust.PHOTO_FOLDERS):
        (user_folder("trusted") / name).unlink(missing_ok=True)


@pytest.fixture
def command(tmp_path: Path) -> tuple[str, Path]:
    """A provider that leaves a trace when it is run, and the trace."""
    trace = tmp_path / "trace"
    code = f"open({str(trace)!r}, 'w')"
    return f'command:"{sys.executable}" -c "{code}" {{image}} {{mask}} {{out}}', trace


def spoil(obj: bpy.types.Object, **changes: object) -> None:
    """Change what is kept of a camera's import, as somebody who writes a .blend can."""
    obj[bridge.CAMERA] = json.dumps({**json.loads(obj[bridge.CAMERA]), **changes})


def a_view() -> bpy.types.Object:
    return bridge.chosen_cameras(bpy.context.scene)[0]


def files_below(folder: Path) -> set[Path]:
    return {p for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("name", ["../../../../ESCAPED.png", "/tmp/ESCAPED.png", "a/../../x.png", "C:/x.png", "", 5])
def test_an_id_that_leads_out_of_the_job_is_refused_before_anything_is_written(
    splat: bpy.types.Object, tmp_path: Path, name: object
) -> None:
    write_png(tmp_path / "payload.png", np.zeros((SIZE[1], SIZE[0], 3), np.uint8))
    trust.know_photos([tmp_path / "payload.png"])
    spoil(a_view(), id=name, image=str(tmp_path / "payload.png"))
    before = files_below(tmp_path)
    with pytest.raises(RuntimeError, match=r"gimp3d: error: .*camera"):
        bpy.ops.gimp3d.remove_object()
    with pytest.raises(BadInput):
        jobs.write_job(bpy.context, tmp_path / "job")
    assert files_below(tmp_path) == before and not list((tmp_path / "gimp3d_jobs").iterdir())


@pytest.mark.parametrize("name", ["scene.ply", "job.json", "transforms.json", "report/index.html", "stages/masks.npz"])
def test_a_photo_never_takes_the_place_of_a_jobs_own_file(splat: bpy.types.Object, tmp_path: Path, name: str) -> None:
    photo = tmp_path / "photos" / "a.png"
    write_png(photo, np.full((SIZE[1], SIZE[0], 3), 77, np.uint8))
    trust.know_photos([photo])
    spoil(a_view(), id=name, image=str(photo))
    jobs.write_job(bpy.context, tmp_path / "job")
    assert [p for p in files_below(tmp_path / "job") if p.read_bytes() == photo.read_bytes()] == [
        tmp_path / "job" / "photos" / name
    ]


def test_photos_are_copied_only_from_where_the_user_took_some(splat: bpy.types.Object, tmp_path: Path) -> None:
    """Else a job's folder, which may be shared, could be made to hold any of the user's files."""
    inside, outside = tmp_path / "photos" / "000.png", tmp_path / "private" / "diary.png"
    for path in (inside, outside):
        write_png(path, np.full((SIZE[1], SIZE[0], 3), 77, np.uint8))
    (tmp_path / "photos" / "secret.txt").write_text("secret")
    (tmp_path / "photos" / "link.png").symlink_to(outside)
    trust.know_photos([inside])
    for image, taken in (
        (inside, True),
        (outside, False),
        (tmp_path / "photos" / "link.png", False),
        (tmp_path / "photos" / "secret.txt", False),
        (tmp_path / "photos" / "none.png", False),
    ):
        spoil(a_view(), image=str(image))
        job = jobs.write_job(bpy.context, tmp_path / f"job-{image.name}")
        assert ((tmp_path / f"job-{image.name}" / "photos").exists(), job.images != "none") == (taken, taken), image
    assert "1 photo" in steps.views_step(bpy.context).hint


@pytest.mark.parametrize(
    "stored",
    ["", "[]", "5", "null", "{", '{"id": "a"}', "[" * 100_000, 7, {"id": "a"}, [1.0, 2.0]],
    ids=lambda s: str(s)[:12],
)
def test_damaged_camera_data_is_one_line_and_the_panel_says_it(splat: bpy.types.Object, stored: object) -> None:
    a_view()[bridge.CAMERA] = stored
    with pytest.raises(RuntimeError, match=r"gimp3d: error: camera orbit/000: .*import the cameras again"):
        bpy.ops.gimp3d.remove_object()
    assert "orbit/000" in steps.views_step(bpy.context).missing


@pytest.mark.parametrize(
    "change",
    [
        {"width": "wide"},
        {"height": 0},
        {"fx": float("nan")},
        {"fy": None},
        {"viewmat": [[1, 2], [3, 4]]},
        {"viewmat": np.full((4, 4), float("nan")).tolist()},
        {"distortion": [1]},
        {"distortion": "k"},
        {"number": "first"},
        {"number": 1e400},
        {"image": 5},
    ],
    ids=str,
)
def test_numbers_of_a_camera_that_make_no_sense_are_one_line(splat: bpy.types.Object, change: dict) -> None:
    if change == {"distortion": [1]}:
        change = {"distortion": [1] * 9}
    spoil(a_view(), **change)
    with pytest.raises(RuntimeError, match="gimp3d: error: camera orbit/000"):
        bpy.ops.gimp3d.remove_object()


def test_views_that_would_name_their_files_alike_are_told_apart(splat: bpy.types.Object) -> None:
    first, second = bridge.chosen_cameras(bpy.context.scene)[:2]
    spoil(first, id="a.png")
    spoil(second, id="a.jpg")
    names = [c.id for c, _ in bridge.views_of(bpy.context, bridge.splat_frame(splat))]
    assert names[:2] == ["a.png", "a_2.jpg"]


@pytest.mark.parametrize("setting", ["inpaint", "depth_prior"])
def test_a_command_of_the_file_is_refused_without_a_window(
    splat: bpy.types.Object, tmp_path: Path, command: tuple[str, Path], setting: str
) -> None:
    setattr(bpy.context.scene.gimp3d, setting, command[0])
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work.blend"), check_existing=False)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "work.blend"), use_scripts=False)
    operators = [bpy.ops.gimp3d.remove_object, *([bpy.ops.gimp3d.preview_masks] if setting == "depth_prior" else [])]
    for operator in operators:
        with pytest.raises(RuntimeError, match=r"gimp3d: error: nobody has allowed this .*trace"):
            operator()
    assert not command[1].exists() and not (tmp_path / "gimp3d_jobs").exists()


@pytest.mark.parametrize("name", ["onnx", "torchscript", "file", "http", "gemini", "anything"])
def test_models_files_and_addresses_of_the_file_are_refused_too(splat: bpy.types.Object, name: str) -> None:
    bpy.context.scene.gimp3d.inpaint = f"{name}:somewhere"
    with pytest.raises(RuntimeError, match=f"nobody has allowed this on this machine: {name}:somewhere"):
        bpy.ops.gimp3d.remove_object()


class Caught(Exception):
    """In place of a child: what it would have been started with."""


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The command lines that removals would start."""
    found: list[list[str]] = []

    def take(arguments: list[str], *_: object, **__: object) -> None:
        found.append(list(arguments))
        raise BadInput("caught")

    monkeypatch.setattr("gimp3d_addon.operators.remove.Worker", take)
    return found


def test_a_script_may_allow_a_command_which_the_command_line_is_told(
    splat: bpy.types.Object, command: tuple[str, Path], started: list[list[str]]
) -> None:
    bpy.context.scene.gimp3d.inpaint = command[0]
    with pytest.raises(RuntimeError, match="caught"):
        bpy.ops.gimp3d.remove_object(allow_command=True)
    assert "--allow-command" in started[0] and trust.allowed() == []
    with pytest.raises(RuntimeError, match="nobody has allowed"):  # the next call must say it again
        bpy.ops.gimp3d.remove_object()
    bpy.context.scene.gimp3d.inpaint = "telea"
    with pytest.raises(RuntimeError, match="caught"):
        bpy.ops.gimp3d.remove_object()
    assert "--allow-command" not in started[1]


class Dialog:
    """Stands in for the window: what a dialogue shows is kept, and answered by calling `execute` or not."""

    def __init__(self, operator: type[AsksFirst]) -> None:
        self.asked, self.errors, self.lines = 0, [], []
        self.operator = operator()
        self.operator.report = lambda kind, text: self.errors.append(text)
        self.operator.allow_command = False
        self.operator.layout = SimpleNamespace(column=lambda **_: self)
        self.window_manager = SimpleNamespace(invoke_props_dialog=self._ask)

    def __getattr__(self, name: str) -> object:
        return getattr(bpy.context, name)

    def _ask(self, operator: AsksFirst, **_: object) -> set[str]:
        self.asked += 1
        operator.draw(self)
        return {"RUNNING_MODAL"}

    def label(self, text: str, **_: object) -> None:
        self.lines.append(text)

    def separator(self) -> None:
        pass


@pytest.fixture
def window(monkeypatch: pytest.MonkeyPatch) -> Callable[[], Dialog]:
    """Makes a press on Remove in a window that is there."""
    monkeypatch.setattr(base.bpy, "app", SimpleNamespace(background=False))

    class Pressed(RunsRemoval):
        bl_label = "Remove Object"

        def start(self, context: object) -> None:
            raise BadInput("started")

    return lambda: Dialog(Pressed)


def test_the_window_shows_a_command_in_full_and_asks_once_on_a_machine(
    splat: bpy.types.Object, window: Callable[[], Dialog]
) -> None:
    long = "command:" + " ".join(f"word{k}" for k in range(60)) + " ; rm -rf / {out}"
    bpy.context.scene.gimp3d.inpaint = long
    pressed = window()
    assert pressed.operator.ask(pressed, None) == {"RUNNING_MODAL"}
    assert long in "".join(pressed.lines) and str(Path.cwd()) in "".join(pressed.lines)
    assert trust.allowed() == []  # shown is not allowed
    pressed.operator.execute(pressed)
    assert "started" in pressed.errors[-1]
    again = window()
    again.operator.ask(again, None)
    assert again.asked == 0 and "started" in again.errors[-1]
    bpy.context.scene.gimp3d.inpaint = long + "x"
    other = window()
    other.operator.ask(other, None)
    assert other.asked == 1 and not other.errors
    trust.forget(trust.in_full(long))
    assert trust.unconfirmed([long])


def test_what_cannot_be_shown_cannot_be_allowed(splat: bpy.types.Object, window: Callable[[], Dialog]) -> None:
    """Neither by its length nor by characters that turn the line round or break it."""
    bpy.context.scene.gimp3d.inpaint = "command:harmless " + " " * 5000 + "rm -rf / {out}"
    pressed = window()
    assert pressed.operator.ask(pressed, None) == {"CANCELLED"} and pressed.asked == 0
    assert "too long to be shown" in pressed.errors[-1] and trust.allowed() == []
    bpy.context.scene.gimp3d.inpaint = "command:a \u202e b {out}"
    pressed = window()
    pressed.operator.ask(pressed, None)
    assert "command:a \\u202e b {out}" in pressed.lines


def test_what_was_allowed_is_in_the_users_folder_and_not_in_the_blend(
    splat: bpy.types.Object, tmp_path: Path, command: tuple[str, Path]
) -> None:
    trust.allow([trust.in_full(command[0])])
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work.blend"), check_existing=False, compress=False)
    assert b"in the folder" not in (tmp_path / "work.blend").read_bytes()
    assert (user_folder("trusted") / trust.ALLOWED).is_file()


def test_a_model_that_was_exchanged_is_asked_about_again(tmp_path: Path) -> None:
    model = tmp_path / "model.onnx"
    model.write_bytes(b"one")
    spec = f"onnx:{model},512x512"
    trust.allow(trust.unconfirmed([spec, "exemplar"]))
    assert trust.unconfirmed([spec, "exemplar", "auto"]) == []
    model.write_bytes(b"two")
    (said,) = trust.unconfirmed([spec])
    assert str(model) in said and "SHA-256" in said


def test_the_same_command_from_another_folder_is_asked_about_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`command:python paint.py` is another program there."""
    trust.allow(trust.unconfirmed(["command:python paint.py {out}"]))
    monkeypatch.chdir(tmp_path)
    assert trust.unconfirmed(["command:python paint.py {out}"])


def planted(folder: Path, command: str) -> Path:
    """A job folder beside a .blend, as somebody else may send it."""
    job = folder / "gimp3d_jobs" / "x"
    paths = {name: str(job / name) for name in ("scene", "cameras", "roi")}
    save_job(job, RemovalJob(**paths, out=str(job / "out.ply"), inpaint=command))
    (job / "blender.json").write_text(json.dumps({"source": "scene", "matrix": np.eye(4).tolist(), "open": True}))
    return job


def test_a_planted_job_is_not_offered(splat: bpy.types.Object, tmp_path: Path, command: tuple[str, Path]) -> None:
    job = planted(tmp_path, command[0])
    bpy.context.scene.gimp3d.last_job = str(job)
    assert jobs.unfinished(bpy.context) is None and not bpy.ops.gimp3d.resume.poll()
    assert jobs.of_file(bpy.context) == [] and not command[1].exists()


def begin(splat: bpy.types.Object) -> Path:
    """A job that this machine wrote and did not finish."""
    folder = jobs.new_job_folder(splat.name)
    jobs.write_job(bpy.context, folder)
    jobs.open_for(bpy.context, folder, splat)
    return folder


def test_a_job_that_was_exchanged_is_not_offered(splat: bpy.types.Object, command: tuple[str, Path]) -> None:
    folder = begin(splat)
    assert jobs.unfinished(bpy.context) == folder
    document = json.loads((folder / "job.json").read_text())
    (folder / "job.json").write_text(json.dumps({**document, "inpaint": command[0]}))
    assert jobs.unfinished(bpy.context) is None
    with pytest.raises(BadInput, match="another job"):
        jobs.delete(jobs.of_file(bpy.context)[0])
    assert folder.is_dir()


def test_a_moved_job_stays_where_it_was_put(splat: bpy.types.Object) -> None:
    begin(splat).rename(jobs.jobs_folder() / "elsewhere")
    assert jobs.unfinished(bpy.context) is None


def test_a_resumed_jobs_command_must_be_allowed_too(splat: bpy.types.Object, command: tuple[str, Path]) -> None:
    bpy.context.scene.gimp3d.inpaint = command[0]
    folder = begin(splat)
    bpy.context.scene.gimp3d.inpaint = "telea"
    assert json.loads((folder / "job.json").read_text())["inpaint"] == command[0]
    with pytest.raises(RuntimeError, match="nobody has allowed"):
        bpy.ops.gimp3d.resume()
    assert not command[1].exists() and jobs.unfinished(bpy.context) == folder


def test_only_reports_of_jobs_that_were_written_here_are_opened(splat: bpy.types.Object, tmp_path: Path) -> None:
    """The path came with the .blend, and Windows runs a program that it is told to open."""
    own = begin(splat) / "report" / "index.html"
    assert jobs.is_own_report(own)
    for strange in (
        planted(tmp_path, "telea") / "report" / "index.html",
        own.with_name("evil.exe"),
        own.parents[1] / "index.html",
        Path("index.html"),
    ):
        assert not jobs.is_own_report(strange), strange


@pytest.mark.parametrize("python", ["//env/bin/python", "env/bin/python", "python3"])
def test_the_python_is_not_looked_for_beside_the_file(
    splat: bpy.types.Object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, python: str
) -> None:
    monkeypatch.setattr(base, "preferences", lambda _: SimpleNamespace(python=python))
    with pytest.raises(RuntimeError, match="must be a full path"):
        bpy.ops.gimp3d.remove_object()
    assert not (tmp_path / "gimp3d_jobs").exists() and RunsChild.running is None


def test_a_job_that_cannot_be_written_leaves_no_folder(splat: bpy.types.Object, tmp_path: Path) -> None:
    bpy.context.scene.gimp3d.reference_image = str(tmp_path / "none.png")
    with pytest.raises(RuntimeError, match="does not exist"):
        bpy.ops.gimp3d.remove_object()
    assert not list((tmp_path / "gimp3d_jobs").iterdir())


def test_a_reference_picture_that_the_file_brought_along_is_not_copied(splat: bpy.types.Object, tmp_path: Path) -> None:
    """One that was chosen on this machine is, also from a saved file."""
    picture = tmp_path / "pictures" / "clean.png"
    write_png(picture, np.full((SIZE[1], SIZE[0], 3), 77, np.uint8))
    bpy.ops.gimp3d.load_reference(filepath=str(picture))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work.blend"), check_existing=False)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "work.blend"))
    assert jobs.write_job(bpy.context, tmp_path / "job").reference_image.endswith("reference.png")
    (user_folder("trusted") / trust.PHOTO_FOLDERS).unlink()  # as on another machine
    with pytest.raises(BadInput, match="brought it along; load it again"):
        jobs.write_job(bpy.context, tmp_path / "job2")
    assert not (tmp_path / "job2").exists()


def test_the_photos_of_a_job_move_with_it(splat: bpy.types.Object, tmp_path: Path) -> None:
    write_png(tmp_path / "orbit" / "000.png", np.full((SIZE[1], SIZE[0], 3), 77, np.uint8))
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "transforms.json"))
    jobs.write_job(bpy.context, tmp_path / "job")
    shutil.move(tmp_path / "job", tmp_path / "moved")
    job = load_job(tmp_path / "moved")
    views = read_cameras(Path(job.cameras), Path(job.images))
    assert [c.image.exists() for c in views] == [True] + [False] * 8

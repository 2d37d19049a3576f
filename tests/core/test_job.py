"""Job folders: they move, resume, and never leave a half-written file."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from gimp3d.camera import Camera
from gimp3d.errors import BadInput
from gimp3d.job import RemovalJob, StageStore, load_job, save_job, write_atomically


def test_paths_inside_the_folder_move_with_it(tmp_path: Path) -> None:
    outside = tmp_path / "photos"
    job = RemovalJob(
        scene=str(tmp_path / "job" / "scene.ply"),
        cameras=str(tmp_path / "job" / "t.json"),
        roi=str(tmp_path / "job" / "roi.json"),
        out=str(tmp_path / "job" / "out.ply"),
        images=str(outside),
        extra_masks=str(tmp_path / "job" / "shadows"),
        set={"seed.opacity": "0.9"},
    )
    save_job(tmp_path / "job", job)
    (tmp_path / "job").rename(tmp_path / "moved")
    loaded = load_job(tmp_path / "moved")
    assert loaded.scene == str(tmp_path / "moved" / "scene.ply") and loaded.images == str(outside)
    assert loaded.extra_masks == str(tmp_path / "moved" / "shadows")
    assert loaded.set == {"seed.opacity": "0.9"} and loaded.report is None


def test_none_for_images_stays_a_word(tmp_path: Path) -> None:
    save_job(tmp_path, RemovalJob("a", "b", "c", "d", images="none"))
    assert load_job(tmp_path).images == "none"


WRONG_TYPES = [
    {"scene": 5},
    {"set": ["a"]},
    {"set": {"a": 1}},
    {"seed": -1},
    {"seed": "0"},
    {"threads": 0},
    {"grow": "no"},
]
DAMAGED = ["{", "[]", '{"version": 99}', '{"version": 1}', '{"version": 1, "what": 2}', "[" * 100_000]
FILES = {"version": 1, "scene": "a", "cameras": "b", "roi": "c", "out": "d"}


@pytest.mark.parametrize("text", [*DAMAGED, *(json.dumps({**FILES, **wrong}) for wrong in WRONG_TYPES)])
def test_damaged_jobs_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "job.json").write_text(text)
    with pytest.raises(BadInput, match="job"):
        load_job(tmp_path)


LEADING_OUT = {
    "photos": ({"images": "/photos"}, {"images": "/mine"}),
    "scene": ({"scene": "/home/scene.ply"}, {"scene": "/mine.ply"}),
    "climbing": ({"out": "../../out.ply"}, {"out": "/mine.ply"}),
    "report": ({"report": "/var/www"}, {"report": "/mine"}),
    "model": ({"inpaint": "onnx:/models/x.onnx"}, {"inpaint": "onnx:/mine.onnx"}),
    "prior": ({"depth_prior": "file:depth.npy"}, {"depth_prior": "auto"}),
    "host": ({"inpaint": "http://elsewhere"}, {"inpaint": "exemplar"}),
}


@pytest.mark.parametrize("case", LEADING_OUT)
def test_a_job_from_elsewhere_reaches_out_only_where_the_user_says_so(case: str, tmp_path: Path) -> None:
    named, again = LEADING_OUT[case]
    (tmp_path / "job.json").write_text(json.dumps({**FILES, **named}))
    with pytest.raises(BadInput, match=r"leads out|names --") as caught:
        load_job(tmp_path)
    (field,) = again
    assert ("SCENE" if field == "scene" else f"--{field.replace('_', '-')}") in str(caught.value)
    assert getattr(load_job(tmp_path, again), field) == again[field]


LINKS = ("stages", "stages/masks.npz", "summary.json", "report/charts", "views/images", "out.ply", "scene.ply")


@pytest.mark.parametrize("name", LINKS)
@pytest.mark.parametrize("own", [False, True])
def test_links_in_a_job_do_not_lead_elsewhere(own: bool, name: str, tmp_path: Path) -> None:
    """Of an own job, those count that would be written through."""
    folder = tmp_path / "job"
    job = RemovalJob("scene.ply", "b", "c", "out.ply", report="report", views_out="views").resolved(folder)
    save_job(folder, job)
    (folder / "inside").symlink_to("job.json")
    load_job(folder)
    if not own:
        (folder / "job.json").write_text((folder / "job.json").read_text() + " ")
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).symlink_to(tmp_path / "precious")
    if own and name == "scene.ply":
        assert load_job(folder) == job
        return
    with pytest.raises(BadInput, match="link that leads out"):
        load_job(folder)


def test_a_command_of_a_job_needs_its_own_word_even_in_an_own_job(tmp_path: Path) -> None:
    for field in ("inpaint", "depth_prior"):
        save_job(tmp_path, replace(RemovalJob("a", "b", "c", "d"), **{field: "command:rm {out}"}))
        with pytest.raises(BadInput, match=r"'rm \{out\}'.*--allow-command"):
            load_job(tmp_path)
        assert getattr(load_job(tmp_path, allow_command=True), field) == "command:rm {out}"
        assert getattr(load_job(tmp_path, {field: "auto"}), field) == "auto"


def test_no_job_is_this_users_own_because_it_looks_like_one(tmp_path: Path) -> None:
    """Only the very file that was written: nobody else knows its mark."""
    job = RemovalJob(*(str(tmp_path / "job" / n) for n in "abcd"), images=str(tmp_path / "photos"))
    save_job(tmp_path / "job", job)
    load_job(tmp_path / "job")
    document = json.loads((tmp_path / "job" / "job.json").read_text())
    for forged in ({**document, "mark": "0" * 32}, {**document, "images": str(tmp_path / "others")}):
        (tmp_path / "job" / "job.json").write_text(json.dumps(forged, indent=1))
        with pytest.raises(BadInput, match="not written by you"):
            load_job(tmp_path / "job")


def test_a_failing_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "f").write_text("old")

    def fail(file) -> None:
        file.write(b"half")
        raise RuntimeError

    with pytest.raises(RuntimeError):
        write_atomically(tmp_path / "f", fail)
    assert [p.name for p in tmp_path.iterdir()] == ["f"] and (tmp_path / "f").read_text() == "old"


@dataclass(frozen=True)
class Result:
    array: np.ndarray
    camera: Camera
    several: tuple[np.ndarray, ...]
    words: str
    nothing: None = None


def test_stage_results_come_back_and_only_for_the_same_key(tmp_path: Path) -> None:
    camera = Camera("a", 4, 3, 5.5, 6, 2, 1, np.eye(4), image=Path("x/y.png"))
    result = Result(np.arange(6).reshape(2, 3), camera, (np.zeros(2, bool), np.ones(1, np.float32)), "ä")
    StageStore(tmp_path, "key", resume=True).save("some stage", result)
    back = StageStore(tmp_path, "key", resume=True).load("some stage")
    assert isinstance(back, Result) and back.words == "ä" and back.camera.image == Path("x/y.png")
    np.testing.assert_array_equal(back.array, result.array)
    assert back.several[0].dtype == bool and back.camera.viewmat.dtype == np.float64
    assert StageStore(tmp_path, "other", resume=True).load("some stage") is None
    assert StageStore(tmp_path, "key", resume=False).load("some stage") is None
    other = StageStore(tmp_path, "key", resume=True, settings={"margin": 3})
    assert other.load("some stage") is None
    other.save("some stage", result)
    assert other.load("some stage") is not None


HARM: dict[str, Callable[[Path], object]] = {
    "empty": lambda p: p.write_bytes(b""),
    "text": lambda p: p.write_bytes(b"damaged"),
    "foreign": lambda p: np.savez(p, x=np.zeros(3)),
    "no document": lambda p: np.savez(p, document=np.frombuffer(b"[]", np.uint8)),
    "a pickle": lambda p: np.savez(p, document=np.array([{}], object)),
    "half": lambda p: p.write_bytes(p.read_bytes()[:200]),
    "a folder": lambda p: (p.unlink(), p.mkdir()),
    "other numbers": lambda p: np.savez(p, **{**np.load(p), "a0": np.zeros((2, 3))}),
}


@pytest.mark.parametrize("harm", HARM)
def test_a_stage_file_that_is_none_is_no_stage(harm: str, tmp_path: Path) -> None:
    store = StageStore(tmp_path, "key", resume=True)
    store.save("stage", (np.arange(6.0).reshape(2, 3), 5))
    assert store.load("stage") is not None
    HARM[harm](tmp_path / "stage.npz")
    assert store.load("stage") is None


def test_stages_of_somebody_else_are_no_stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Kernels trust the shapes of what stages hand on, so nobody else may choose them."""
    monkeypatch.setenv("GIMP3D_STATE", str(tmp_path / "somebody"))
    StageStore(tmp_path / "job", "key", resume=True).save("stage", np.full(3, 10**6))
    assert StageStore(tmp_path / "job", "key", resume=True).load("stage") is not None
    monkeypatch.setenv("GIMP3D_STATE", str(tmp_path / "me"))
    assert StageStore(tmp_path / "job", "key", resume=True).load("stage") is None
    if os.name == "posix":
        assert (tmp_path / "me" / "secret").stat().st_mode & 0o077 == 0


def test_where_no_secret_can_be_kept_stages_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("GIMP3D_STATE", str(tmp_path / "file" / "state"))
    store = StageStore(tmp_path, "key", resume=True)
    store.save("stage", 5)
    assert store.load("stage") == 5
    assert StageStore(tmp_path, "key", resume=True).load("stage") is None


@dataclass(frozen=True)
class Kind:
    old: int


def test_a_result_of_which_the_program_no_longer_knows_the_fields_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = StageStore(tmp_path, "key", resume=True)
    store.save("stage", Kind(1))
    assert store.load("stage") == Kind(1)
    monkeypatch.setattr(sys.modules[__name__], "Kind", Result)
    assert store.load("stage") is None
    monkeypatch.delattr(sys.modules[__name__], "Kind")
    assert store.load("stage") is None

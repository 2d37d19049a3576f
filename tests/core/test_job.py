"""Job folders: they move, resume, and never leave a half-written file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from gimp3d.camera import Camera
from gimp3d.errors import BadInput
from gimp3d.job import RemovalJob, load_job, save_job, write_atomically
from gimp3d.store import StageStore


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


@pytest.mark.parametrize("text", ["{", "[]", '{"version": 99}', '{"version": 1}', '{"version": 1, "what": 2}'])
def test_damaged_jobs_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "job.json").write_text(text)
    with pytest.raises(BadInput, match="job"):
        load_job(tmp_path)


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
    kinds = (Result, Camera)
    StageStore(tmp_path, "key", kinds, resume=True).save("some stage", result)
    back = StageStore(tmp_path, "key", kinds, resume=True).load("some stage")
    assert isinstance(back, Result) and back.words == "ä" and back.camera.image == Path("x/y.png")
    np.testing.assert_array_equal(back.array, result.array)
    assert back.several[0].dtype == bool and back.camera.viewmat.dtype == np.float64
    assert StageStore(tmp_path, "other", kinds, resume=True).load("some stage") is None
    assert StageStore(tmp_path, "key", kinds, resume=False).load("some stage") is None
    (tmp_path / "some-stage.npz").write_bytes(b"damaged")
    assert StageStore(tmp_path, "key", kinds, resume=True).load("some stage") is None


def test_a_result_of_which_the_program_no_longer_knows_the_fields_is_made_again(tmp_path: Path) -> None:
    @dataclass(frozen=True)
    class Kind:
        old: int

    StageStore(tmp_path, "key", (Kind,), resume=True).save("stage", Kind(1))

    @dataclass(frozen=True)
    class Newer:
        new: int

    Newer.__name__ = "Kind"
    assert StageStore(tmp_path, "key", (Newer,), resume=True).load("stage") is None
    assert StageStore(tmp_path, "key", (), resume=True).load("stage") is None

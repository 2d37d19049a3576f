"""A folder from somebody else: nothing of it runs, and nothing is written elsewhere."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from scenes import REGION, cameras, scene

from gimp3d import commands
from gimp3d.cli import main
from gimp3d.io.cameras import write_transforms
from gimp3d.io.ply import write_gaussians
from gimp3d.pipeline import RemovalResult

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder as somebody else would send it; the work itself takes no time."""
    folder = tmp_path / "from elsewhere"
    folder.mkdir()
    write_gaussians(folder / "scene.ply", scene())
    write_transforms(folder / "cameras.json", cameras(2))
    (folder / "roi.json").write_text(json.dumps(REGION[0].to_json()))
    monkeypatch.setattr(commands, "render_bytes", lambda g, c, *_: np.zeros((c.height, c.width, 3), np.uint8))

    def work(g: object, views: object, region: object, settings: commands.RemovalSettings, *_: object) -> RemovalResult:
        for provider in (settings.inpaint, settings.depth_prior, settings.refine_views):
            if provider.startswith("command:"):
                words = shlex.split(provider.removeprefix("command:"))
                Path(words[1]).touch()  # as the command would
        return RemovalResult(np.ones(len(scene()), bool), None)

    monkeypatch.setattr(commands, "remove_object", work)
    return folder


def plant(job: Path, **fields: object) -> None:
    files = {"scene": "scene.ply", "cameras": "cameras.json", "roi": "roi.json", "out": "out.ply", "images": "none"}
    (job / "job.json").write_text(json.dumps({"version": 1, **files, **fields}))


def run(job: Path, *more: object) -> int:
    return main(["remove", "--job", str(job), "--progress", "none", *map(str, more)])


def test_a_folder_that_reaches_nowhere_runs(job: Path) -> None:
    plant(job)
    assert run(job) == 0 and (job / "out.ply").exists()


@pytest.mark.parametrize("name", ["inpaint", "depth_prior", "refine_views"])
@pytest.mark.parametrize("as_setting", [False, True])
def test_a_planted_job_runs_nothing(
    name: str, as_setting: bool, job: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = {name: f"command:touch '{tmp_path / 'ran'}' {{image}} {{out}}"}
    plant(job, **({"set": command} if as_setting else command))
    assert run(job) == 2
    said = capsys.readouterr().err
    assert "touch" in said and "--allow-command" in said and said.count("\n") == 1
    assert not (tmp_path / "ran").exists() and not (job / "out.ply").exists()
    assert run(job, "--allow-command") == 0 and (tmp_path / "ran").exists()


@pytest.mark.parametrize("name", ["inpaint", "depth_prior", "refine_views"])
@pytest.mark.parametrize("as_setting", [False, True])
def test_a_planted_job_names_no_model_or_host(
    name: str, as_setting: bool, job: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plant(job, **({"set": {name: "http://127.0.0.1:9"}} if as_setting else {name: "http://127.0.0.1:9"}))
    assert run(job) == 2
    assert "not written by you" in capsys.readouterr().err


@pytest.mark.parametrize("field", ["out", "report", "summary", "views_out"])
@pytest.mark.parametrize("how", ["absolute", "climbing"])
def test_a_planted_job_writes_nowhere_else(
    field: str, how: str, job: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "elsewhere.ply"
    plant(job, **{field: str(target) if how == "absolute" else "../elsewhere.ply"})
    before = set(tmp_path.rglob("*"))
    assert run(job) == 2
    option = f"--{field.replace('_', '-')}"
    assert option in capsys.readouterr().err and set(tmp_path.rglob("*")) == before
    assert run(job, option, target) == 0 and (target.exists() or field == "views_out")  # there are no views here


def test_every_threat_has_a_test_that_exists() -> None:
    page = (ROOT / "docs" / "security.md").read_text(encoding="utf-8")
    table = page.partition("## Threats")[2].partition("## How")[0]
    rows = [line for line in table.splitlines() if line.startswith("|")][2:]
    assert len(rows) > 10
    for row in rows:
        named = re.findall(r"`((?:tests/[\w/.]+|…)(?:::\w+)?)`", row.rsplit("|", 2)[1])
        assert named, row
        path = ""
        for name in named:
            file, _, test = name.partition("::")
            path = path if file == "…" else file
            assert (ROOT / path).is_file(), name
            assert not test or f"def {test}(" in (ROOT / path).read_text(encoding="utf-8"), name

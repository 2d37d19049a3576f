"""The benchmarks of new Gaussians run, and what they write can be read."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from gimp3d.io.cameras import read_cameras
from gimp3d.io.ply import read_ply
from gimp3d.raster import render

ROOT = Path(__file__).resolve().parents[3]


def run(name: str, *arguments: str) -> str:
    command = [sys.executable, "-m", f"benchmarks.{name}", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.mark.slow
def test_balanced_beats_draft_and_both_need_less_than_half_a_gaussian_per_pixel(
    shared_data: Path, tmp_path: Path
) -> None:
    run("pareto", str(shared_data / "withwithout"), "--quick", "--out", str(tmp_path))
    rows = {r["method"]: r for r in json.loads((tmp_path / "pareto.json").read_text())["rows"]}
    assert rows["balanced"]["psnr unseen"] > rows["draft"]["psnr unseen"]
    assert rows["draft"]["psnr mask"] > rows["telea"]["psnr mask"] + 6
    assert 0 < rows["draft"]["share"] < 0.6 and 0 < rows["balanced"]["share"] < 0.6
    assert rows["balanced"]["seconds"] > rows["draft"]["seconds"] > 0
    assert "| desk | balanced |" in (tmp_path / "pareto.md").read_text()
    ElementTree.fromstring((tmp_path / "pareto.svg").read_text())


@pytest.mark.slow
def test_the_large_scene_looks_like_the_one_it_is_made_of(shared_data: Path, tmp_path: Path) -> None:
    scene = shared_data / "withwithout" / "desk"
    options = ("--split", "2", "--views", "12", "--scale", "1", "--preset", "draft")
    said = run("large", str(scene), *options, "--out", str(tmp_path))
    assert "Peak memory" in said and "| seed |" in said
    before, after = read_ply(scene / "scene.ply").gaussians, read_ply(tmp_path / "scene.ply").gaussians
    assert len(after) == 2 * before.usable.sum()
    camera = read_cameras(tmp_path / "transforms.json")[0]
    wrong = render(before, camera).rgb - render(after, camera).rgb
    assert np.abs(wrong).mean() < 0.06

"""What a removal holds of every view at once: hundreds of large ones must fit."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from scenes import REGION, cameras, scene

from gimp3d.io.cameras import write_transforms
from gimp3d.io.ply import write_gaussians

WIDTH, HEIGHT = 960, 540
FEW, MANY = 8, 48  # views
MOST = 30.0  # bytes for each pixel of each view


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="the system does not tell a process's peak memory")
def test_a_views_pixel_costs_few_bytes(tmp_path: Path) -> None:
    """Measured as the peaks' difference between many views and few; the photo and the filled view are six of them."""
    (tmp_path / "roi.json").write_text(json.dumps(REGION[0].to_json()))
    write_gaussians(tmp_path / "scene.ply", scene())

    def peak(views: int) -> float:
        write_transforms(tmp_path / "transforms.json", cameras(views, WIDTH, HEIGHT))
        command = [sys.executable, "-m", "gimp3d", "remove", "scene.ply", "--cameras", "transforms.json"]
        command += ["--roi", "roi.json", "--out", "out.ply", "--images", "none", "--preset", "draft"]
        command += ["--summary", "summary.json", "--threads", "2", "--quiet"]
        subprocess.run(command, cwd=tmp_path, check=True)
        summary = json.loads((tmp_path / "summary.json").read_text())
        assert summary["counts"]["views"] == views and summary["counts"]["added"] > 0
        return summary["peak_memory_mb"] * 2**20

    peak(2)  # compiling takes memory too
    assert (peak(MANY) - peak(FEW)) / ((MANY - FEW) * WIDTH * HEIGHT) < MOST

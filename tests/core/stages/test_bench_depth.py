"""The benchmark of depth completion runs, and what it writes can be read."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.slow
def test_a_measured_scale_beats_the_papers_and_a_prior_with_the_sign_as_printed(
    shared_data: Path, tmp_path: Path
) -> None:
    command = [
        sys.executable,
        "-m",
        "benchmarks.depth",
        str(shared_data / "withwithout"),
        "--quick",
        "--scenes",
        "desk",
    ]
    done = subprocess.run([*command, "--out", str(tmp_path)], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "depth.json").read_text())["scenes"]
    errors = {r["way"]: r["hole"]["median"] for r in rows}
    assert errors["membrane, bias 5 %"] < errors["s_f = 0.1, bias 5 %"] < errors["sign as printed, bias 5 %"]
    assert errors["guided, true"] <= errors["harmonic"] and errors["auto"] < errors["harmonic"]
    assert "| ring |" in (tmp_path / "depth.md").read_text()

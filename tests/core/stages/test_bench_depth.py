"""The benchmark of depth completion runs, and what it writes can be read."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.slow
def test_the_benchmark_runs_and_its_targets_hold_on_a_few_cases(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "scripts" / "bench_depth.py"), "--quick", "--out", str(tmp_path)]
    done = subprocess.run([*command, "--data", str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "depth.json").read_text())
    assert len(found["scale"]) == 15 and len(found["places"]) == 8 and found["scenes"] == []
    ways = {k: np.mean([r["membrane"][k] for r in found["scale"]]) for k in found["scale"][0]["membrane"]}
    assert ways["best"] <= ways["measured"] < ways["none"] < ways["as printed"]
    assert "| relief |" in (tmp_path / "depth.md").read_text()

"""The benchmark of propagation runs, and what it writes can be read."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.slow
def test_the_benchmark_runs_and_its_targets_hold_on_the_made_room(tmp_path: Path) -> None:
    script = [sys.executable, str(ROOT / "scripts" / "bench_propagate.py"), str(tmp_path / "none"), "--quick"]
    done = subprocess.run([*script, "--out", str(tmp_path)], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "propagate.json").read_text())
    assert found["scores"] == [] and all(found[k] for k in ("memory", "speed", "blend", "room"))
    assert all(r["largest_grey_levels"] < 0.5 and r["changed_outside"] == 0 for r in found["blend"])
    assert all(r["peak_mib"] < r["kept_mib"] + 120 for r in found["memory"])

    def mean(method: str) -> float:
        return float(np.mean([r["psnr"] for r in found["room"] if r["method"] == method and r["view"] in (2, 3, 4)]))

    warp, mapped = mean("warp, blend fitted to photo"), mean("+ retargeting")
    assert mapped > warp + 3 and mapped > mean("paper: + other views") + 3
    assert "| + mapping |" in (tmp_path / "propagate.md").read_text()
    ElementTree.fromstring((tmp_path / "propagate.svg").read_text())


@pytest.mark.slow
def test_mapping_beats_the_warp_where_that_fails_and_costs_nothing_elsewhere(shared_data: Path, tmp_path: Path) -> None:
    script = [sys.executable, str(ROOT / "scripts" / "bench_propagate.py"), str(shared_data / "withwithout"), "--quick"]
    done = subprocess.run([*script, "--out", str(tmp_path)], capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "propagate.json").read_text())
    by = {(r["view"], r["method"]): r["painted"]["psnr"] for r in found["scores"]}
    views = {view for view, _ in by}
    gains = [by[v, "+ retargeting"] - by[v, "warp, blend fitted to photo"] for v in views]
    assert len(gains) == 5 and min(gains) > -0.1 and max(gains) > 1.0

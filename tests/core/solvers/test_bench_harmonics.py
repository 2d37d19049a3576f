"""The benchmark of the SH fit runs, and what it writes can be read."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.slow
def test_the_quick_benchmark_writes_results_and_tables(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks.harmonics", "--quick", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    results = json.loads((tmp_path / "harmonics.json").read_text())
    errors = {(r["rule"], r["views"], r["cone"], r["material"]): r for r in results["accuracy"]}
    assert len(errors) == len(results["accuracy"]) == 6 * 2 * 2 * 3
    means = {rule: sum(r["inside"] for r in results["accuracy"] if r["rule"] == rule) for rule, *_ in errors}
    assert means["gimp3d"] < means["leave-one-out"] < means["constant"] < means["paper"]
    words = (tmp_path / "harmonics.md").read_text()
    assert "| leave-one-out |" in words and "## Stability: two near-equal views" in words

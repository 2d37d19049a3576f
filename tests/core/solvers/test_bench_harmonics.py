"""The benchmark of the SH fit runs, and what it writes can be read."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.slow
def test_the_quick_benchmark_writes_results_tables_and_charts(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    script = [sys.executable, str(ROOT / "scripts" / "bench_harmonics.py"), "--quick", "--out", str(tmp_path)]
    done = subprocess.run(script, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    results = json.loads((tmp_path / "harmonics.json").read_text())
    assert {(r["views"], r["degree"]) for r in results["speed"]} == {(v, d) for v in (10, 30) for d in (1, 2, 3)}
    for row in results["speed"]:
        assert row["difference"] < 1e-4  # ours and torch's do the same
        assert min(t["cpu_ms"] for t in row["times"].values()) > 0
    errors = {(r["rule"], r["views"], r["cone"], r["material"]): r for r in results["accuracy"]}
    assert len(errors) == len(results["accuracy"]) == 6 * 2 * 2 * 3
    means = {rule: sum(r["inside"] for r in results["accuracy"] if r["rule"] == rule) for rule, *_ in errors}
    assert means["gimp3d"] < means["leave-one-out"] < means["constant"] < means["paper"]
    assert "| 1 | 30 | 3 |" in (tmp_path / "harmonics.md").read_text()
    for name, words in (("harmonics", "torch Cholesky"), ("harmonics_stability", "Two near-equal views")):
        chart = ElementTree.parse(tmp_path / f"{name}.svg").getroot()
        assert words in {t.text for t in chart.iter("{http://www.w3.org/2000/svg}text")}

"""The rasteriser's benchmark runs, and what it writes can be read."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).resolve().parents[3]
SECTIONS = {
    "quick", "machine", "memory", "first_call", "peak_gflops_per_core", "speed", "blends", "region",
    "torch",
}  # fmt: skip
TIMES = ("_ms", "_s", "_mib", "_ratio")


def measured(value: Any, name: str = "") -> list[float]:
    """All times, rates, sizes and ratios in the results."""
    if isinstance(value, dict):
        return [x for key, inner in value.items() for x in measured(inner, key)]
    if isinstance(value, list):
        return [x for inner in value for x in measured(inner, name)]
    return [value] if name.endswith(TIMES) else []


@pytest.mark.slow
def test_the_quick_benchmark_writes_results_table_and_chart(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks.raster", "--quick", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    results = json.loads((tmp_path / "raster.json").read_text())
    assert set(results) == SECTIONS
    assert all(results[name] for name in SECTIONS - {"torch"})  # it need not be there
    assert {(r["kind"], r["threads"]) for r in results["speed"]} == {("3d", 1), ("3d", 4), ("surfels", 4)}
    assert {r["depths"] for r in results["region"]} == {"slab", "all"}
    times = measured(results)
    assert len(times) > 50 and min(times) > 0
    assert 0 < results["blends"][0]["forward"]["share_of_peak"] < 1
    assert "| 3d | 20,000 | 480×270 | 1 |" in (tmp_path / "raster.md").read_text()
    chart = ElementTree.parse(tmp_path / "raster_speed.svg").getroot()
    assert chart.tag.endswith("svg")
    words = {t.text for t in chart.iter("{http://www.w3.org/2000/svg}text")}
    assert {"480×270", "wall time, ms (log)", "20k"} <= words

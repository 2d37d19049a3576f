"""How much a removal depends on its reference, and that the measure of it is right."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from benchmarks.references import FILLED, GIVEN, draw, means, report, sigma, sigma_by_view

ROOT = Path(__file__).resolve().parents[2]


def row(reference: str, views: dict[str, float], preset: str = "balanced", kind: str = GIVEN) -> dict[str, Any]:
    scores = {name: {"mask": value, "unseen": value - 2} for name, value in views.items()}
    return {"scene": "desk", "kind": kind, "preset": preset, "reference": reference, "views": scores, "score": 0.8}


def test_easy_and_hard_views_are_no_spread_of_the_references() -> None:
    usual = {"a": 40.0, "b": 30.0, "c": 35.0}  # each reference is as good; it only leaves itself out
    rows = [row(left_out, {n: v for n, v in usual.items() if n != left_out}) for left_out in usual]
    assert means(rows, "mask") == [32.5, 37.5, 35.0]
    assert sigma(means(rows, "mask")) == pytest.approx(2.5)
    assert sigma_by_view(rows, "mask") == pytest.approx(0)


def test_a_worse_reference_is_spread_either_way() -> None:
    rows = [row(r, {"a": 40.0 + shift, "b": 30.0 + shift}) for r, shift in (("x", 0.0), ("y", 1.0), ("z", -1.0))]
    assert sigma(means(rows, "unseen")) == pytest.approx(1)
    assert sigma_by_view(rows, "unseen") == pytest.approx(1)
    assert math.isnan(sigma([3.0]))


def test_tables_and_chart_show_references_that_were_refused(tmp_path: Path) -> None:
    refused = {k: v for k, v in row("c", {}, "paper", FILLED).items() if k not in ("views", "score")} | {
        "refused": "sees no hole"
    }
    rows = [row("a", {"x": 30.0}), row("b", {"x": 32.0}), row("a", {"x": 20.0}, "paper", FILLED), refused]
    results = {"machine": {"cpu": "any", "cores": 4, "load_at_start": [0.0]}, "steps": 0, "references": rows}
    words = report(results)
    assert "| desk | balanced | 2 | 0 | 31.00 ± 1.41 |" in words
    assert "| 1.41 (2) |" in words
    assert "| desk | paper | 1 | 1 | 20.00 ± nan |" in words and "| sees no hole |" in words
    draw(results, tmp_path / "chart.svg")
    drawn = ElementTree.parse(tmp_path / "chart.svg").getroot()
    assert "1.41" in {t.text for t in drawn.iter("{http://www.w3.org/2000/svg}text")}


@pytest.mark.parametrize("name", ["references", "stability"])
def test_without_scenes_the_benchmark_says_so_in_one_line(tmp_path: Path, name: str) -> None:
    out = str(tmp_path / "out")
    command = [sys.executable, "-m", f"benchmarks.{name}", str(tmp_path), "--quick", "--out", out]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1 and "has no truth/" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_two_true_pictures_give_nearly_the_same_removal(shared_data: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks.references", str(shared_data / "withwithout"), "--quick"]
    done = subprocess.run(
        [*command, "--steps", "0", "--out", str(tmp_path)], cwd=ROOT, capture_output=True, text=True, timeout=500
    )
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "references.json").read_text())["references"]
    assert len(rows) == 8 and not [r for r in rows if "refused" in r]
    assert {r["kind"] for r in rows} == {GIVEN, FILLED}
    ours, papers = ([r for r in rows if r["kind"] == GIVEN and r["preset"] == p] for p in ("balanced", "paper"))
    assert all(len(r["views"]) == 5 and r["reference"] not in r["views"] for r in (*ours, *papers))
    assert sigma(means(ours, "mask")) < min(0.8, sigma(means(papers, "mask")))
    ElementTree.parse(tmp_path / "references.svg")

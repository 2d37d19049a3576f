"""The benchmarks of fields and fills run, and what they write can be read; other programs may be missing."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from gimp3d.io.images import write_png

ROOT = Path(__file__).resolve().parents[3]
NAMES = ("astronaut", "brick", "chelsea", "coffee", "grass", "gravel", "motorcycle", "rocket")


def run(name: str, folder: Path, picture: str) -> tuple[dict[str, Any], str]:
    """On made pictures that lie where photographs would."""
    for seed, photograph in enumerate(NAMES):
        random = np.random.default_rng(seed)
        layers = [cv2.GaussianBlur(random.normal(size=(512, 512, 3)), (0, 0), s) * s for s in (0.7, 2, 6)]
        write_png(
            folder / "photographs" / f"{photograph}.png", np.clip(128 + 60 * sum(layers), 0, 255).astype(np.uint8)
        )
    command = [sys.executable, "-m", f"benchmarks.{name}", "--quick", "--others", "/none/python", "--out", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=400, check=False)
    assert done.returncode == 0, done.stderr
    ElementTree.fromstring((folder / picture).read_text())
    return json.loads((folder / f"{name}.json").read_text()), (folder / f"{name}.md").read_text()


@pytest.mark.slow
def test_fields_are_nearer_to_the_exact_ones_at_equal_time(tmp_path: Path) -> None:
    found, words = run("nnf", tmp_path, "nnf.svg")
    assert all(r["excess"] > -1e-6 for r in found["rows"])
    default = next(r for r in found["summary"][0]["ratios"] if r["effort"].startswith("grid 2, 4 sweeps"))
    assert default["classic PatchMatch"] > 2.5 and default["pyramid PatchMatch"] > 2.5
    assert "| pyramid PatchMatch |" in words


@pytest.mark.slow
def test_fills_are_scored_without_the_programs_that_are_missing(tmp_path: Path) -> None:
    found, words = run("fill", tmp_path, "inpaint.svg")
    assert {r["method"] for r in found["pictures"]} >= {"gimp3d exemplar", "cv2 Telea", "xphoto FSR fast"}
    assert "Left out: PyPatchMatch, radius 2 (/none/python: No such file or directory)" in words
    assert (tmp_path / "sheet_512.png").exists()


def test_without_photographs_the_benchmarks_say_what_is_missing(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks.nnf", "--others", "/none/python", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert done.stderr.strip().splitlines() == [
        "no photographs: /none/python needs scikit-image and imageio (/none/python: No such file or directory)"
    ]

"""The benchmark of fills runs, and what it writes can be read; other programs may be missing."""

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


def run(folder: Path) -> tuple[dict[str, Any], str]:
    """On made pictures that lie where photographs would."""
    for seed, photograph in enumerate(NAMES):
        random = np.random.default_rng(seed)
        layers = [cv2.GaussianBlur(random.normal(size=(512, 512, 3)), (0, 0), s) * s for s in (0.7, 2, 6)]
        write_png(
            folder / "photographs" / f"{photograph}.png", np.clip(128 + 60 * sum(layers), 0, 255).astype(np.uint8)
        )
    command = [sys.executable, "-m", "benchmarks.fill", "--quick", "--others", "/none/python", "--out", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=400, check=False)
    assert done.returncode == 0, done.stderr
    ElementTree.fromstring((folder / "inpaint.svg").read_text())
    return json.loads((folder / "fill.json").read_text()), (folder / "fill.md").read_text()


@pytest.mark.slow
def test_fills_are_scored_without_the_programs_that_are_missing(tmp_path: Path) -> None:
    found, words = run(tmp_path)
    assert {r["method"] for r in found["pictures"]} >= {"gimp3d exemplar", "cv2 Telea", "xphoto FSR fast"}
    assert "Left out: PyPatchMatch, radius 2 (/none/python: No such file or directory)" in words
    assert (tmp_path / "sheet_512.png").exists()


def test_without_photographs_the_benchmark_says_what_is_missing(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks.fill", "--others", "/none/python", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert done.stderr.strip().splitlines() == [
        "no photographs: /none/python needs scikit-image and imageio (/none/python: No such file or directory)"
    ]

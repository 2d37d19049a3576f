"""Measures the constants of core/gimp3d/progress.py on this machine and writes them there.

The demo scene, also with its Gaussians split and its pictures enlarged, is removed with several presets, each run in a
process of its own with compiled kernels; what a stage took is fitted by non-negative least squares.

    python -m tools.calibrate_forecast [--write] [--check SCENE_FOLDER PRESET] …
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls

from benchmarks.large import split
from gimp3d import progress
from gimp3d.io.cameras import read_cameras, write_transforms
from gimp3d.io.ply import read_ply, write_gaussians
from gimp3d.progress import CHARTED, ON_VIEWS, STAGES, STEPS, forecast_removal

ROOT = Path(__file__).resolve().parents[1]
DEMO = ROOT / "assets" / "demo"
RUNS = (  # parts of each Gaussian, scale of the pictures, preset
    *((1, 1.0, "draft"), (1, 2.0, "draft"), (4, 1.0, "draft"), (2, 1.5, "balanced"), (1, 1.0, "balanced")),
    *((1, 1.0, "best"), (3, 2.0, "best"), (1, 1.0, "paper"), (2, 1.5, "paper")),
)


@dataclass(frozen=True)
class Run:
    """What a removal was given and what it took."""

    preset: str
    millions: float  # of Gaussians
    views: int
    megapixels: float  # of all views
    stages: dict[str, float]  # s
    memory_mb: float

    @property
    def seconds(self) -> float:
        return sum(self.stages.values())

    def of_stage(self, name: str) -> float:
        return self.stages.get(name, 0.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", action="store_true", help="put the constants into progress.py")
    parser.add_argument("--check", nargs=2, action="append", default=[], metavar=("FOLDER", "PRESET"))
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="gimp3d-calibrate-") as folder:
        work = Path(folder)
        made = {(p, s): variant(work / f"{p}x{s}", p, s) for p, s, _ in RUNS}
        measure(made[1, 1.0], "balanced", work)  # compiles
        runs = [measure(made[p, s], preset, work) for p, s, preset in RUNS]
        constants = fitted(runs)
        for name, value in constants.items():
            print(f"{name} = {value!r}")
            setattr(progress, name, value)
        if given.write:
            write(Path(progress.__file__), constants)
        for run in (*runs, *(measure(Path(f), preset, work) for f, preset in given.check)):
            told = forecast_removal(round(1e6 * run.millions), run.views, round(1e6 * run.megapixels), run.preset)
            print(
                f"{run.preset}, {1e6 * run.millions:,.0f} Gaussians, {run.views} views, {run.megapixels:.1f} Mpx: "
                f"told {told.seconds:.1f} s, took {run.seconds:.1f} s ({told.seconds / run.seconds:.2f}×); "
                f"told {told.memory_mb:.0f} MB, took {run.memory_mb:.0f} MB ({told.memory_mb / run.memory_mb:.2f}×)"
            )


def variant(folder: Path, parts: int, scale: float) -> Path:
    """The demo scene with more Gaussians and larger pictures."""
    folder.mkdir(exist_ok=True)
    gaussians = read_ply(DEMO / "scene.ply").gaussians
    write_gaussians(folder / "scene.ply", split(gaussians, parts) if parts > 1 else gaussians)
    write_transforms(folder / "transforms.json", [c.scaled(scale) for c in read_cameras(DEMO / "transforms.json")])
    (folder / "roi.json").write_bytes((DEMO / "roi.json").read_bytes())
    return folder


def measure(folder: Path, preset: str, work: Path) -> Run:
    summary = work / "summary.json"
    given = ["--cameras", folder / "transforms.json", "--roi", folder / "roi.json", "--out", work / "out.ply"]
    command = [sys.executable, "-m", "gimp3d", "remove", folder / "scene.ply", *given, "--preset", preset]
    subprocess.run(
        [*map(str, command), "--summary", str(summary), "--report", str(work / "report"), "--quiet"], check=True
    )
    said: dict[str, Any] = json.loads(summary.read_text())
    stages = {s["name"]: s["seconds"] for s in said["stages"]}
    stages["read"] = max(0.0, said["seconds_total"] - sum(stages.values()))
    cameras = [c for c in read_cameras(folder / "transforms.json") if c.split == "train"]
    pixels = sum(c.width * c.height for c in cameras)
    counts = said["counts"]
    return Run(preset, counts["gaussians_in"] / 1e6, len(cameras), pixels / 1e6, stages, said["peak_memory_mb"])


def fitted(runs: list[Run]) -> dict[str, Any]:
    """The constants that progress.py names, each stage's own."""
    stages = {}
    for name in (*STAGES, "recolour"):
        had = [r for r in runs if name in r.stages and (r.preset in CHARTED or name in ON_VIEWS)]
        stages[name] = fit([[1.0, r.megapixels, r.millions * r.views] for r in had], [r.of_stage(name) for r in had])
    constants: dict[str, Any] = {"RECOLOUR": stages.pop("recolour"), "STAGES": stages}
    for name, charted in (("STEP", True), ("PAPER_STEP", False)):
        had = [r for r in runs if STEPS.get(r.preset, 0) and (r.preset in CHARTED) == charted]
        steps = [[STEPS[r.preset] * x for x in (1.0, r.megapixels / r.views)] for r in had]
        constants[name] = fit(steps, [r.of_stage("refine") for r in had], 5)
    constants["MEMORY_MB"] = fit([[1.0, r.megapixels, r.millions] for r in runs], [r.memory_mb for r in runs], 0)
    return constants


def fit(features: list[list[float]], measured: list[float], decimals: int = 3) -> tuple[float, ...]:
    """Non-negative coefficients; each run's relative error counts alike. None where no run had the stage."""
    if not measured:
        return (0.0, 0.0, 0.0)
    weights = 1 / np.maximum(measured, 0.05)
    solution, _ = nnls(np.array(features) * weights[:, None], np.array(measured) * weights)
    return tuple(round(float(v), decimals) for v in solution)


def write(path: Path, constants: dict[str, Any]) -> None:
    text = path.read_text(encoding="utf-8")
    for name, value in constants.items():
        if isinstance(value, dict):
            inner = "".join(f'    "{k}": {v!r},\n' for k, v in value.items())
            new = f"{name} = {{\n{inner}}}"
            text, count = re.subn(rf"^{name} = \{{\n.*?^\}}", new, text, flags=re.MULTILINE | re.DOTALL)
        else:
            text, count = re.subn(rf"^{name} = \(.*\)", f"{name} = {value!r}", text, flags=re.MULTILINE)
        assert count == 1, name
    path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()

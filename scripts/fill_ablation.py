"""What each rule of the built-in fill is worth: one at a time is taken out, on pictures with structure and on charts.

    python scripts/fill_ablation.py [DATA] [--scenes a,b] [--out build/fill_ablation]

Charts are those of draft removals of DATA's scenes; their truth is what the test photos, taken without the object, show
there (the median). Writes OUT/table.md. Run by `make bench-fill-rules`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import cv2
import numpy as np
from bench_fill import SCENES
from bench_raster import ROOT, machine, say, write
from bench_real import folder_of
from raster_report import table
from real_scenes import Scene, read_scene
from structured import edge_error, structured

from gimp3d.box import read_region
from gimp3d.errors import BadInput
from gimp3d.evaluate.metrics import psnr
from gimp3d.geometry import disparity_of
from gimp3d.io.formats import read_scene as read_splat
from gimp3d.io.images import load_view, read_image
from gimp3d.pipeline import PRESETS, View, remove_object
from gimp3d.solvers import exemplar
from gimp3d.solvers.exemplar import ExemplarSettings, complete_picture
from gimp3d.solvers.surface import tangent_planes
from gimp3d.stages.charts import Chart


class Task(NamedTuple):
    """A picture whose hole is to be filled, and what is really there."""

    image: np.ndarray  # [H, W, 3] uint8
    hole: np.ndarray  # [H, W] bool
    unknown: np.ndarray  # [H, W] bool
    truth: np.ndarray  # [H, W, 3] uint8
    surface: Any = None


def nothing_regular(*_: object) -> tuple[()]:
    return ()


NO_MOTIONS = (exemplar, "find_motions", nothing_regular)
RULES: dict[str, tuple[Sequence[tuple[Any, str, Any]], dict[str, Any]]] = {
    "as it is": ((), {}),
    "nothing is taken for regular": ((NO_MOTIONS,), {}),
    "… and patches of 5 px": ((NO_MOTIONS,), {"patch": 5, "thickness": 8.0}),
    "… and of 9 px": ((NO_MOTIONS,), {"patch": 9}),
    "… and of 17 px": ((NO_MOTIONS,), {"patch": 17}),
    "… and whole patches vote in the end": ((NO_MOTIONS, (exemplar, "OWN", 99)), {}),
    "… and only their middle pixel": ((NO_MOTIONS, (exemplar, "OWN", 0)), {}),
    "… and no texture features": ((NO_MOTIONS,), {"texture": 0.0}),
    "… and sources far away are as good": ((NO_MOTIONS,), {"locality": 0.0}),
    "… and patches far from the rim are trusted as well": ((NO_MOTIONS,), {"rim_trust": 1.0}),
    "… and one round on the coarsest level": ((NO_MOTIONS,), {"coarse_rounds": 1}),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("data", nargs="?", type=Path, default=ROOT.parent / "shared" / "data" / "withwithout")
    parser.add_argument("--scenes", default=",".join(SCENES), help="folders of DATA, or none of them: ''")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "fill_ablation")
    given = parser.parse_args()
    made = [Task(p, h, np.zeros_like(h), p) for p, h in structured().values()]
    try:
        names = [name for name in given.scenes.split(",") if name]
        charts = [task for name in names for task in charts_of(read_scene(folder_of(given.data, name)))]
    except BadInput as error:
        print(f"fill_ablation: error: {error}", file=sys.stderr)
        return error.exit_code
    rows = []
    for words, (changes, settings) in RULES.items():
        with ExitStack() as stack:
            for where, name, value in changes:
                stack.enter_context(mock.patch.object(where, name, value))
            found = [[scored(task, ExemplarSettings(**settings)) for task in tasks] for tasks in (made, charts)]
        cells = [f"{np.mean([s[0] for s in found[0]]):.1f}", f"{np.nanmean([s[1] for s in found[0]]):.2f}"]
        rows.append([words, *cells, f"{np.mean([s[0] for s in found[1]]):.2f}" if charts else "–"])
        say(" ".join(rows[-1]))
    head = ["", f"{len(made)} pictures, dB", "edges off by, px", f"{len(charts)} charts, dB"]
    write(given.out / "table.md", f"{machine()['cpu']}\n\n{table(head, rows)}\n")
    return 0


def scored(task: Task, settings: ExemplarSettings) -> tuple[float, float]:
    """PSNR in the hole, and how far edges lie from the truth's there."""
    filled = complete_picture(task.image, task.hole, settings, task.surface, task.unknown).image
    return psnr(filled, task.truth, task.hole), edge_error(filled, task.truth, task.hole)


def charts_of(scene: Scene) -> list[Task]:
    folder = scene.folder
    views = [View(camera, photo) for photo, camera in (load_view(c) for c in scene.train)]
    splats, region = read_splat(folder / "scene.ply").gaussians, read_region(folder / "roi.json")
    charts = remove_object(splats, views, region, PRESETS["draft"]).charts
    say(f"{scene.name}: {len(charts)} charts")
    return [as_task(chart, scene) for chart in charts if chart.hole.any()]


def as_task(chart: Chart, scene: Scene) -> Task:
    points = chart.camera.unproject(chart.camera.pixel_centres(), chart.depth.astype(np.float64)).reshape(-1, 3)
    shown = []
    for camera in scene.test:
        uv, z = camera.project(points)
        framed = (z > 0) & (uv >= 0).all(1) & (uv < [camera.width, camera.height]).all(1)
        x, y = (uv.astype(np.float32) - 0.5).T.reshape(2, *chart.hole.shape)
        sample = cv2.remap(read_image(scene.folder / camera.id), x, y, cv2.INTER_LINEAR).astype(np.float32)
        shown.append(np.where(framed.reshape(*chart.hole.shape, 1), sample, np.nan))
    counted = np.isfinite(shown).any((0, -1))
    truth = np.nan_to_num(np.nanmedian(np.where(counted[..., None], shown, 0), 0)).astype(np.uint8)
    surface = None if chart.kind == "plane" else tangent_planes(disparity_of(chart.depth), chart.camera.K)
    return Task(chart.image, chart.hole, ~chart.known & ~chart.hole, truth, surface)


if __name__ == "__main__":
    sys.exit(main())

"""What the docs show works: public functions' examples, the library's page, and where the architecture page points."""

from __future__ import annotations

import doctest
import importlib.util
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import REGION, cameras, scene

from gimp3d.box import Box
from gimp3d.commands import render_views, run_removal, scene_info
from gimp3d.evaluate import psnr
from gimp3d.frame import frame_of
from gimp3d.io.cameras import read_cameras, write_transforms
from gimp3d.io.images import load_view, write_png
from gimp3d.io.ply import read_ply, write_gaussians, write_ply
from gimp3d.job import RemovalJob
from gimp3d.orbit import orbit_cameras
from gimp3d.pipeline import PRESETS, View, remove_object, render_bytes
from gimp3d.raster import (
    PictureGradients,
    backward,
    contributions,
    drawing,
    footprint,
    pixel_region,
    render,
    surface_depth,
    trace,
)

ROOT = Path(__file__).resolve().parents[2]
NAMES = {"np": np, "Path": Path, "Box": Box, "PRESETS": PRESETS, "View": View, "RemovalJob": RemovalJob}
PUBLIC: tuple[Any, ...] = (
    *(read_ply, write_ply, read_cameras, load_view, Box.make, orbit_cameras),
    *(render, drawing, footprint, contributions, surface_depth, trace, backward, pixel_region),
    *(remove_object, run_removal, render_views, scene_info, frame_of, psnr),
)
BLOCKS = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(encoding="utf-8"), re.DOTALL)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small scene as files: scene.ply, transforms.json with its photos, roi.json."""
    folder, gaussians = tmp_path_factory.mktemp("docs"), scene()
    write_gaussians(folder / "scene.ply", gaussians)
    views = [replace(c, id=f"{k}.png") for k, c in enumerate(cameras(3, 60, 45))]
    for camera in views:
        write_png(folder / camera.id, render_bytes(gaussians, camera))
    write_transforms(folder / "transforms.json", views)
    (folder / "roi.json").write_text(json.dumps(REGION[0].to_json()))
    return folder


@pytest.fixture(autouse=True)
def in_their_folder(files: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(files)
    yield


@pytest.mark.parametrize("function", PUBLIC, ids=lambda f: f.__qualname__)
def test_a_public_functions_example_runs(function: Any) -> None:
    names = {f.__name__: f for f in PUBLIC if f.__name__ != "make"}
    globs = {**names, **NAMES, "PictureGradients": PictureGradients}
    (example,) = doctest.DocTestFinder(recurse=False).find(function, function.__qualname__, globs=globs)
    said: list[str] = []
    failed, tried = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example, out=said.append)
    assert tried >= 1 and not failed, "".join(said)


def test_the_librarys_page_runs(files: Path) -> None:
    gaussians = scene()
    camera = replace(cameras(3, 60, 45)[0], id="0.png")
    upper = gaussians.means[:, 2] > 0.1
    names: dict[str, Any] = {
        "gaussians": gaussians, "camera": camera, "photo": np.zeros((45, 60, 3), np.float32),
        "frozen": gaussians.take(~upper), "active": gaussians.take(upper), "mask": np.ones((45, 60), bool),
    }  # fmt: skip
    for block in BLOCKS:
        if "autograd" in block:
            if importlib.util.find_spec("torch") is None:
                continue
            torch = importlib.import_module("torch")
            parts = ("means", "log_scales", "quats", "opacity_logits", "sh")
            names |= {p: torch.tensor(getattr(gaussians, p), requires_grad=True) for p in parts}
            names["photo"] = torch.zeros(45, 60, 3)
        exec(compile(block, "docs/python.md", "exec"), names)
        names["photo"] = np.zeros((45, 60, 3), np.float32)
    assert (files / "out.ply").is_file()


def places() -> list[tuple[str, str]]:
    """File and name of every row of a table of docs/architecture.md that says where something is."""
    text, found = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8"), []
    for row in (line for line in text.splitlines() if line.startswith("|")):
        path = ""
        for span in re.findall(r"`([^`]+)`", row):
            if re.fullmatch(r"[\w/]+\.py", span):
                path = span
                found.append((path, ""))
            elif path and re.fullmatch(r"[A-Za-z_]\w*", span):
                found.append((path, span))
    return found


def test_what_the_architecture_page_names_is_there() -> None:
    assert len(places()) > 20
    missing = []
    for path, name in places():
        file = next((f for f in (ROOT / path, ROOT / "core" / "gimp3d" / path) if f.is_file()), None)
        if file is None or not re.search(rf"\b{name}\b", file.read_text(encoding="utf-8")):
            missing.append(f"{path} {name}")
    assert not missing

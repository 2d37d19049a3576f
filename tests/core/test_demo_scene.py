"""The committed demo scene: what the script makes, small, and shaped as a removal needs it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from gimp3d.box import in_region, read_region
from gimp3d.gaussians import Gaussians
from gimp3d.io.cameras import read_cameras
from gimp3d.io.ply import read_ply
from gimp3d.raster import render

ROOT = Path(__file__).resolve().parents[2]
DEMO = ROOT / "assets" / "demo"
VASE, FOOT = np.array([0.05, -0.05]), 0.105  # m, where it stands and its foot's radius


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the script makes: the demo's files and truth.ply."""
    folder = tmp_path_factory.mktemp("demo")
    script = [sys.executable, str(ROOT / "tools" / "make_demo_scene.py")]
    subprocess.run([*script, "--folder", str(folder)], check=True)
    subprocess.run([*script, "--without-object", str(folder / "truth.ply")], check=True)
    return folder


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return read_ply(DEMO / "scene.ply").gaussians


def same_row(a: Gaussians, b: Gaussians) -> np.ndarray:
    """[len(a)] bool: rows of `a` whose position is also in `b`."""
    positions = {m.tobytes() for m in b.means}
    return np.array([m.tobytes() in positions for m in a.means])


def test_the_script_makes_the_committed_files(made: Path, scene: Gaussians) -> None:
    again = read_ply(made / "scene.ply").gaussians
    for name in ("means", "log_scales", "quats", "opacity_logits", "sh"):
        np.testing.assert_allclose(getattr(again, name), getattr(scene, name), atol=1e-5)
    assert (made / "roi.json").read_text() == (DEMO / "roi.json").read_text()
    cameras = [read_cameras(folder / "transforms.json") for folder in (made, DEMO)]
    for a, b in zip(*cameras, strict=True):
        assert (a.id, a.split) == (b.id, b.split)
        np.testing.assert_allclose(a.viewmat, b.viewmat, atol=1e-9)
    assert sum(f.stat().st_size for f in DEMO.iterdir()) < 5e6


def test_the_object_lies_in_the_box_and_the_box_cuts_into_the_floor(made: Path, scene: Gaussians) -> None:
    region = read_region(DEMO / "roi.json")
    vase = scene.take(~same_row(scene, read_ply(made / "truth.ply").gaussians))
    assert len(vase) > 1000 and in_region(region, vase.means).all()
    assert region[0].corners()[:, 2].min() < 0


def test_nothing_lies_under_the_object_but_in_the_truth(made: Path, scene: Gaussians) -> None:
    truth = read_ply(made / "truth.ply").gaussians
    floor, true_floor = (g.means[np.abs(g.means[:, 2]) < 0.0045] for g in (scene, truth))  # the rug is 4 mm thick
    assert np.linalg.norm(floor[:, :2] - VASE, axis=1).min() > FOOT - 0.005  # the vase's lowest ring is 2 mm inside
    assert np.linalg.norm(true_floor[:, :2] - VASE, axis=1).min() < 0.01


def test_all_views_see_the_object_from_above_the_floor_and_no_hole_in_it(scene: Gaussians) -> None:
    cameras = read_cameras(DEMO / "transforms.json")
    assert {c.split for c in cameras} == {"train", "test"} and sum(c.split == "train" for c in cameras) == 24
    for camera in cameras:
        assert camera.centre[2] > 0.3
        half = camera.scaled(0.5)
        uv, _ = half.project(np.array([[*VASE, z] for z in np.linspace(0.03, 0.25, 5)]))
        cols, rows = uv.astype(int).T
        assert (cols >= 0).all() and (cols < half.width).all() and (rows >= 0).all() and (rows < half.height).all()
        alpha = render(scene, half).alpha
        assert alpha[rows.min() : rows.max() + 1, cols.min() - 25 : cols.max() + 26].min() > 0.95

"""bpy in an isolated user folder, with the add-on registered from the checkout."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

os.environ["BLENDER_USER_RESOURCES"] = tempfile.mkdtemp(prefix="gimp3d-blender-")  # before bpy is imported
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

try:
    import bpy
except ModuleNotFoundError:  # a skip from here would end the whole run
    collect_ignore_glob = ["test_*.py"]

    def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
        terminalreporter.write_line("tests/addon: skipped, bpy is not installed (make setup installs it)")
else:
    import gimp3d_addon

from scenes import REGION, cameras, scene

from gimp3d.gaussians import Gaussians
from gimp3d.io.cameras import write_transforms
from gimp3d.io.ply import write_gaussians


@pytest.fixture(scope="session", autouse=True)
def registered() -> Iterator[None]:
    """Unregistered at the end: bpy 4.5 hangs at exit while an operator class is registered."""
    gimp3d_addon.register()
    yield
    gimp3d_addon.unregister()


@pytest.fixture(autouse=True)
def empty_blender() -> Iterator[None]:
    """Every test starts and ends with an empty scene."""
    bpy.ops.wm.read_homefile(use_empty=True)
    yield
    bpy.ops.wm.read_homefile(use_empty=True)


@pytest.fixture(scope="session")
def few_gaussians() -> Gaussians:
    """50 random Gaussians of SH degree 3."""
    rng = np.random.default_rng(3)
    return Gaussians(
        means=rng.normal(size=(50, 3)).astype(np.float32),
        log_scales=rng.normal(-3, 1, (50, 3)).astype(np.float32),
        quats=rng.normal(size=(50, 4)).astype(np.float32),
        opacity_logits=rng.normal(size=50).astype(np.float32),
        sh=rng.normal(size=(50, 16, 3)).astype(np.float32),
    )


@pytest.fixture
def import_scene(tmp_path: Path) -> Callable[[Gaussians], bpy.types.Object]:
    """Writes Gaussians to a PLY and imports it; returns the object."""

    def load(gaussians: Gaussians) -> bpy.types.Object:
        write_gaussians(tmp_path / "scene.ply", gaussians)
        bpy.ops.gimp3d.import_ply(filepath=str(tmp_path / "scene.ply"))
        return bpy.context.object

    return load


@pytest.fixture
def splat(import_scene: Callable[[Gaussians], bpy.types.Object], tmp_path: Path) -> bpy.types.Object:
    """The block scene in a saved file, with its box and its cameras: ready to press Remove."""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work.blend"), check_existing=False)
    obj = import_scene(scene())
    bpy.ops.gimp3d.add_roi()
    bpy.context.object.location, bpy.context.object.scale = REGION[0].center, REGION[0].size
    write_transforms(tmp_path / "transforms.json", cameras())
    bpy.ops.gimp3d.import_cameras(filepath=str(tmp_path / "transforms.json"))
    return obj

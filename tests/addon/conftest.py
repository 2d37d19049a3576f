"""bpy in an isolated user folder, with the add-on registered from the checkout."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

os.environ["BLENDER_USER_RESOURCES"] = tempfile.mkdtemp(prefix="gimp3d-blender-")  # before bpy is imported
bpy = pytest.importorskip("bpy", reason="the bpy module is not installed (make setup installs it)")
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import gimp3d_addon


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

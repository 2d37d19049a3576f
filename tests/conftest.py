"""Fixtures shared by all tests, and the examples that property tests try: HYPOTHESIS_PROFILE=thorough for more."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings

os.environ["GIMP3D_STATE"] = tempfile.mkdtemp(prefix="gimp3d-state-")  # records and logs of the tests are nobody's

sys.path.insert(0, str(Path(__file__).parent))  # tests/scenes.py
sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks
sys.path.append(str(Path(__file__).parents[1] / "tools"))

from property_tests import register_profiles
from scenes import REGION, cameras, scene

from gimp3d.box import Region
from gimp3d.camera import Camera
from gimp3d.gaussians import Gaussians

register_profiles()
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def block_scene() -> Gaussians:
    return scene()


@pytest.fixture(scope="session")
def block_region() -> Region:
    return REGION


@pytest.fixture(scope="session")
def block_cameras() -> tuple[Camera, ...]:
    return cameras()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The measured scenes, where they lie beside the checkout."""
    if not SHARED.is_dir():
        pytest.skip("the data folder ../shared/data is not here")
    return SHARED

"""The Python that runs removals: what the check says, when the button refuses, and what a dropped file does."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest

from gimp3d_addon.operators import base, environment
from gimp3d_addon.operators.environment import GIMP3D_OT_check, GIMP3D_OT_make_environment
from gimp3d_addon.operators.io import GIMP3D_FH_splats


@pytest.fixture
def preferences(monkeypatch: pytest.MonkeyPatch) -> Iterator[SimpleNamespace]:
    """Stands in for the preferences of the enabled extension."""
    chosen = SimpleNamespace(python="")
    for module in (base, environment):
        monkeypatch.setattr(module, "preferences", lambda _: chosen)
    yield chosen
    GIMP3D_OT_check.found = {}


def test_the_check_names_what_is_there(preferences: SimpleNamespace) -> None:
    assert bpy.ops.gimp3d.check() == {"FINISHED"}
    assert GIMP3D_OT_check.found["python"].startswith("3.") and GIMP3D_OT_check.found["numba"]


def test_the_check_names_what_is_missing(preferences: SimpleNamespace, tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "bare")], check=True)
    preferences.python = str(environment.environment_python(tmp_path / "bare"))
    with pytest.raises(RuntimeError, match="lacks numpy, scipy, numba, cv2"):
        bpy.ops.gimp3d.check()
    assert GIMP3D_OT_check.found["numba"] == ""


def test_a_python_that_is_none_is_one_line(preferences: SimpleNamespace, tmp_path: Path) -> None:
    preferences.python = str(tmp_path / "nothing")
    with pytest.raises(RuntimeError, match=r"gimp3d: error: cannot start .*nothing"):
        bpy.ops.gimp3d.check()


def test_offline_nothing_is_downloaded(preferences: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> None:
    offline = SimpleNamespace(app=SimpleNamespace(online_access=False, background=True))
    monkeypatch.setattr(environment, "bpy", offline)
    with pytest.raises(RuntimeError, match="set to stay offline"):
        bpy.ops.gimp3d.make_environment()


def test_the_environment_is_made_and_used(
    preferences: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With nothing to install: the network is no part of the tests."""
    app = SimpleNamespace(online_access=True, background=True)
    monkeypatch.setattr(environment, "bpy", SimpleNamespace(app=app))
    monkeypatch.setattr(environment, "environment_folder", lambda: tmp_path / "env")
    monkeypatch.setattr(environment, "LIBRARIES", ("pip",))
    assert bpy.ops.gimp3d.make_environment() == {"FINISHED"}
    assert Path(preferences.python).exists() and str(tmp_path / "env") in preferences.python
    assert environment.environment_python(tmp_path / "env") == Path(preferences.python)


def test_a_download_that_fails_is_said_and_changes_nothing(
    preferences: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = SimpleNamespace(online_access=True, background=True)
    monkeypatch.setattr(environment, "bpy", SimpleNamespace(app=app))
    monkeypatch.setattr(environment, "environment_folder", lambda: tmp_path / "env")
    monkeypatch.setattr(environment, "LIBRARIES", (str(tmp_path / "no such folder"),))
    with pytest.raises(RuntimeError, match="gimp3d: error: "):
        bpy.ops.gimp3d.make_environment()
    assert preferences.python == ""


def test_the_button_installs_what_the_library_declares() -> None:
    project = tomllib.loads((Path(__file__).resolve().parents[2] / "pyproject.toml").read_text())["project"]
    assert list(environment.LIBRARIES) == project["dependencies"]


def test_the_dialogue_names_the_sizes() -> None:
    said: list[str] = []
    layout = SimpleNamespace(label=lambda text: said.append(text), prop=lambda *_: None)
    GIMP3D_OT_make_environment.draw(SimpleNamespace(layout=layout), bpy.context)
    assert any("MB" in line for line in said) and any("numba" in line for line in said)


def test_dropped_splats_are_taken_in_the_3d_view_only() -> None:
    assert set(GIMP3D_FH_splats.bl_file_extensions.split(";")) == {".ply", ".splat", ".spz", ".sog"}
    for kind, expected in (("VIEW_3D", True), ("TEXT_EDITOR", False)):
        assert GIMP3D_FH_splats.poll_drop(SimpleNamespace(area=SimpleNamespace(type=kind))) is expected

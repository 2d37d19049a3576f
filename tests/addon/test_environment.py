"""The Python that runs removals: what the check says, when the button refuses, and what a dropped file does."""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest
from packaging.requirements import Requirement

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
    GIMP3D_OT_check.found, GIMP3D_OT_check.verified = {}, set()


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


def test_the_environment_is_made_and_used_and_a_file_with_another_hash_is_not_installed(
    preferences: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A wheel of the right name and version, from wherever pip may look, is not enough. No network is needed."""
    wheel = made_wheel(tmp_path)
    app = SimpleNamespace(online_access=True, background=True)
    monkeypatch.setattr(environment, "bpy", SimpleNamespace(app=app))
    monkeypatch.setattr(environment, "environment_folder", lambda: tmp_path / "env")
    lock = tmp_path / "lock.txt"
    monkeypatch.setattr(environment, "LOCK", lock)
    lines = f"--no-index\n--find-links {tmp_path}\ntiny==1.0 --hash=sha256:"
    lock.write_text(lines + "0" * 64 + "\n")
    with pytest.raises(RuntimeError, match="gimp3d: error: "):
        bpy.ops.gimp3d.make_environment()
    assert preferences.python == ""
    digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
    lock.write_text(lines + digest + "\n")
    assert bpy.ops.gimp3d.make_environment() == {"FINISHED"}
    assert environment.environment_python(tmp_path / "env") == Path(preferences.python)
    report = json.loads((tmp_path / "env" / environment.INSTALLED).read_text())
    assert report["install"][0]["download_info"]["archive_info"]["hashes"]["sha256"] == digest
    with pytest.raises(RuntimeError, match="lacks numpy"):
        bpy.ops.gimp3d.check()
    assert GIMP3D_OT_check.verified == {"tiny"}


def made_wheel(folder: Path) -> Path:
    """The smallest wheel that pip installs."""
    path, info = folder / "tiny-1.0-py3-none-any.whl", "tiny-1.0.dist-info"
    with zipfile.ZipFile(path, "w") as wheel:
        wheel.writestr(f"{info}/METADATA", "Metadata-Version: 2.1\nName: tiny\nVersion: 1.0\n")
        wheel.writestr(
            f"{info}/WHEEL", "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        )
        wheel.writestr(f"{info}/RECORD", "")
    return path


@pytest.mark.parametrize("python", ["3.11.7", "3.12.1", "3.13.0", "3.14.2"])
def test_the_pins_are_what_was_tested_and_what_the_library_declares(python: str) -> None:
    root = Path(__file__).resolve().parents[2]
    pins = environment.pins(python)
    declared = [Requirement(d) for d in tomllib.loads((root / "pyproject.toml").read_text())["project"]["dependencies"]]
    assert {d.name for d in declared} | {"llvmlite"} == set(pins)
    assert all(pins[d.name] in d.specifier for d in declared)
    tested = dict(re.findall(r"^([\w-]+)==(\S+)$", (root / "constraints.txt").read_text(), re.MULTILINE))
    newer = {"numpy"} if python >= "3.13" else set()  # no file of the tested one fits there
    assert {name for name in pins if pins[name] != tested[name]} == newer


def test_every_pin_has_the_hashes_of_its_files() -> None:
    text = environment.LOCK.read_text().replace("\\\n", "")
    entries = [line for line in text.splitlines() if not line.startswith("#")]
    assert len(entries) == 7 and all(re.fullmatch(r"[^#]+?( +--hash=sha256:[0-9a-f]{64})+", e) for e in entries)


def test_the_check_says_whether_it_is_what_was_tested(preferences: SimpleNamespace) -> None:
    bpy.ops.gimp3d.check()
    pins = environment.pins(GIMP3D_OT_check.found["python"])
    for name, version in GIMP3D_OT_check.found.items():
        if name != "python":
            pin = pins[environment.PACKAGES.get(name, name)]
            said = "the tested version" if pin.startswith(version) else f"tested with {pin}"
            assert environment.verdict(name) == said
    GIMP3D_OT_check.found["scipy"], GIMP3D_OT_check.verified = "0.1", {"numba"}
    assert environment.verdict("scipy").startswith("tested with ") and "SHA-256" in environment.verdict("numba")


def test_the_dialogue_names_the_sizes() -> None:
    said: list[str] = []
    layout = SimpleNamespace(label=lambda text, **_: said.append(text), prop=lambda *_: None)
    layout.column = lambda **_: layout
    GIMP3D_OT_make_environment.draw(SimpleNamespace(layout=layout), bpy.context)
    assert any("MB" in line for line in said) and any("numba" in line for line in said)


def test_dropped_splats_are_taken_in_the_3d_view_only() -> None:
    assert set(GIMP3D_FH_splats.bl_file_extensions.split(";")) == {".ply", ".splat", ".spz", ".sog"}
    for kind, expected in (("VIEW_3D", True), ("TEXT_EDITOR", False)):
        assert GIMP3D_FH_splats.poll_drop(SimpleNamespace(area=SimpleNamespace(type=kind))) is expected

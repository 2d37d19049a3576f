"""The zip that users install: built by Blender's builder, installed and enabled from the zip, and run there."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import build_extension
import numpy as np
import pytest
from scenes import REGION, scene

from gimp3d.io.ply import read_ply, write_gaussians

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = """
import json, os, sys
import bpy
zip_path, folder = sys.argv[1:]
bpy.ops.extensions.package_install_files(
    filepath=zip_path, repo="user_default", enable_on_install=True, overwrite=True)
assert "bl_ext.user_default.gimp3d" in bpy.context.preferences.addons
import gimp3d
print("core from", gimp3d.__file__)
bpy.ops.wm.read_homefile(use_empty=True)
bpy.ops.wm.save_as_mainfile(filepath=folder + "/work.blend", check_existing=False)
bpy.ops.gimp3d.import_ply(filepath=folder + "/scene.ply")
bpy.ops.gimp3d.add_roi()
region = json.load(open(folder + "/roi.json"))
bpy.context.object.location, bpy.context.object.scale = region["center"], region["size"]
bpy.ops.gimp3d.add_views(count=6, width=120, height=90)
assert bpy.ops.gimp3d.remove_object() == {"FINISHED"}
bpy.ops.gimp3d.export_ply(filepath=folder + "/out.ply")
bpy.ops.preferences.addon_disable(module="bl_ext.user_default.gimp3d")
assert not hasattr(bpy.context.scene, "gimp3d")
print("done")
"""


def install_and_run(zip_path: Path, folder: Path, python: Path, environment: dict[str, str]) -> str:
    write_gaussians(folder / "scene.ply", scene())
    (folder / "roi.json").write_text(json.dumps(REGION[0].to_json()))
    (folder / "script.py").write_text(SCRIPT)
    done = subprocess.run(
        [str(python), str(folder / "script.py"), str(zip_path), str(folder)],
        env={**os.environ, "BLENDER_USER_RESOURCES": str(folder / "user"), **environment},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0 and "done" in done.stdout, done.stdout + done.stderr
    rows = {r.tobytes() for r in read_ply(folder / "scene.ply").table.rows}
    out = read_ply(folder / "out.ply").table.rows
    kept = np.array([r.tobytes() in rows for r in out])
    assert kept.any() and not kept.all()
    return done.stdout


def build(*arguments: str) -> Path:
    command = [sys.executable, str(ROOT / "tools" / "build_extension.py"), "--platform", "here", *arguments]
    subprocess.run(command, check=True)
    return max((ROOT / "dist").glob("gimp3d-*.zip"), key=lambda p: p.stat().st_mtime)


ALONE = """
import sys
for name in ("numba", "llvmlite", "scipy", "cv2", "zstandard", "torch"):
    sys.modules[name] = None  # as in a Blender where no wheel fits
import bpy
import gimp3d_addon
gimp3d_addon.register()
bpy.ops.wm.read_homefile(use_empty=True)
bpy.ops.gimp3d.import_ply(filepath=sys.argv[1])
bpy.ops.gimp3d.add_roi()
bpy.ops.gimp3d.add_views(count=6)
bpy.ops.gimp3d.update_colours()
bpy.ops.gimp3d.export_ply(filepath=sys.argv[2])
gimp3d_addon.unregister()
"""


def test_blenders_own_process_needs_numpy_alone(tmp_path: Path) -> None:
    """Debian's Blenders have Pythons that no wheel fits: everything but the child runs without compiled libraries."""
    write_gaussians(tmp_path / "in.ply", scene())
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "user"), "PYTHONPATH": str(ROOT / "core")}
    command = [sys.executable, "-c", ALONE, str(tmp_path / "in.ply"), str(tmp_path / "out.ply")]
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "in.ply").read_bytes()


def test_the_light_zip_installs_enables_and_removes(tmp_path: Path) -> None:
    zip_path = build("--without-compiled-wheels")
    names = zipfile.ZipFile(zip_path).namelist()
    assert {"blender_manifest.toml", "__init__.py", "gimp3d_addon/bridge.py"} <= set(names)
    assert not [n for n in names if "numpy" in n or "__pycache__" in n or "tests" in n]
    install_and_run(zip_path, tmp_path, Path(sys.executable), {})


def test_the_zip_bundles_pinned_files_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    downloads: list[tuple[tuple[str, ...], str]] = []

    def pip(*arguments: str) -> None:
        if arguments[0] == "download":
            wanted = Path(arguments[arguments.index("--requirement") + 1]).read_text()
            downloads.append((arguments, wanted))

    monkeypatch.setattr(build_extension, "pip", pip)
    build_extension.collect_wheels(tmp_path / "wheels", "linux-x64")
    assert len(downloads) == len(build_extension.PYTHONS)
    for arguments, wanted in downloads:
        assert {"--require-hashes", "--no-deps", "--only-binary=:all:"} <= set(arguments)
        assert not set(arguments) & set(build_extension.BUNDLED)  # none beside those of the list
        entries = wanted.splitlines()
        assert {e.partition("==")[0] for e in entries} == set(build_extension.BUNDLED)
        assert all("--hash=sha256:" in e for e in entries)


def test_both_zips_are_built_by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    """The light one for Blenders with a Python that no wheel fits: the full one cannot be installed there."""
    built: list[tuple[str, bool]] = []
    monkeypatch.setattr(build_extension, "build", lambda tag, compiled: built.append((tag, compiled)))
    monkeypatch.setattr(sys, "argv", ["build_extension"])
    build_extension.main()
    assert set(built) == {(tag, compiled) for tag in build_extension.PLATFORMS for compiled in (False, True)}


@pytest.mark.slow
def test_the_full_zip_carries_all_that_the_core_needs(tmp_path: Path) -> None:
    """In an environment with only bpy and its own requirements, as a fresh Blender: the wheels come from the zip."""
    zip_path = build()
    with zipfile.ZipFile(zip_path) as found:
        wheels = [n for n in found.namelist() if n.endswith(".whl") and "gimp3d" not in n]
        digests = [hashlib.sha256(found.read(n)).hexdigest() for n in wheels]
    assert wheels and all(f"sha256:{d}" in build_extension.LOCK.read_text() for d in digests)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "env")], check=True)
    python = tmp_path / "env" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    site = Path(np.__file__).resolve().parents[1]
    bare = tmp_path / "bare"
    bare.mkdir()
    for name in (
        "bpy",
        "numpy",
        "numpy.libs",
        "requests",
        "urllib3",
        "certifi",
        "idna",
        "charset_normalizer",
        "zstandard",
        "cython",
    ):
        if (site / name).exists():
            (bare / name).symlink_to(site / name)
    environment = {"PYTHONPATH": str(bare), "GIMP3D_CACHE": str(tmp_path / "cache")}
    said = install_and_run(zip_path, tmp_path, python, environment)
    assert str(tmp_path / "user") in said.split("core from", 1)[1].splitlines()[0]

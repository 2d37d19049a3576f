"""Build the Blender extension: dist/gimp3d-<version>-<platform>.zip with the core and its compiled wheels inside.

Stages the manifest, the add-on and the wheels, and lets Blender's own builder make and validate the zips: two for each
platform. The full one has wheels for both Pythons that Blender carries; Blender installs those that fit. The light one
has none, for a Blender with another Python, whose user presses Make Environment or chooses a Python. NumPy is never
bundled, as Blender brings its own. pip compares every bundled file with its SHA-256 in gimp3d_addon/wheels.txt.

    python tools/build_extension.py [--platform linux-x64] … [--without-compiled-wheels]
"""

from __future__ import annotations

import argparse
import importlib.util
import platform
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DIST = ROOT / "dist"
LOCK = ROOT / "gimp3d_addon" / "wheels.txt"  # written by lock_wheels.py
BUNDLED = ("numba", "llvmlite", "scipy", "opencv-contrib-python-headless")
PYTHONS = ("3.11", "3.13")  # Blender 4.2 to 5.0, and from 5.1 on
PLATFORMS = {  # Blender's name → the tags that wheels for it may have
    "linux-x64": ("manylinux2014_x86_64", "manylinux_2_27_x86_64", "manylinux_2_28_x86_64"),
    "windows-x64": ("win_amd64",),
    "macos-arm64": ("macosx_11_0_arm64", "macosx_12_0_arm64", "macosx_13_0_arm64", "macosx_14_0_arm64"),
}
HERE = {("Linux", "x86_64"): "linux-x64", ("Windows", "AMD64"): "windows-x64", ("Darwin", "arm64"): "macos-arm64"}
ENTRY = '''"""3D-GIMP, installed as a Blender extension."""

from .gimp3d_addon import register, unregister

__all__ = ["register", "unregister"]
'''


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--platform", action="append", choices=(*PLATFORMS, "here"), help="default: all of them")
    parser.add_argument("--without-compiled-wheels", action="store_true", help="the light zips only")
    given = parser.parse_args()
    here = HERE.get((platform.system(), platform.machine()), "")
    chosen = [here if p == "here" else p for p in given.platform or PLATFORMS]
    if "" in chosen:
        sys.exit(f"build_extension: Blender has no extension platform for {platform.system()} {platform.machine()}")
    DIST.mkdir(exist_ok=True)
    for tag in chosen:
        build(tag, compiled=False)
        if not given.without_compiled_wheels:
            build(tag, compiled=True)


def build(tag: str, compiled: bool) -> None:
    """Stage, build and validate one platform's zip."""
    with tempfile.TemporaryDirectory(prefix="gimp3d-stage-") as folder:
        stage = Path(folder)
        shutil.copytree(ROOT / "gimp3d_addon", stage / "gimp3d_addon", ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy2(ROOT / "LICENSE", stage)
        (stage / "__init__.py").write_text(ENTRY)
        wheels = collect_wheels(stage / "wheels", tag if compiled else "")
        for wheel in sorted(wheels, key=lambda w: -w.stat().st_size):
            print(f"{wheel.stat().st_size / 2**20:8.1f} MiB  {wheel.name}")
        version = write_manifest(stage / "blender_manifest.toml", wheels, tag)
        target = DIST / f"gimp3d-{version}-{tag}{'' if compiled else '-light'}.zip"
        blender("build", "--source-dir", str(stage), "--output-filepath", str(target))
    blender("validate", str(target))
    print(f"{target.stat().st_size / 2**20:8.1f} MiB  {target.relative_to(ROOT)}", flush=True)


def collect_wheels(folder: Path, tag: str) -> list[Path]:
    """Our own wheel and, for a platform, the compiled ones for both Pythons, in the tested versions."""
    folder.mkdir()
    source = folder.parent / "source"  # a copy, so that the build leaves nothing in the checkout
    shutil.copytree(ROOT / "core", source / "core", ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy2(ROOT / name, source)
    pip("wheel", "--no-deps", "--wheel-dir", str(folder), str(source))
    shutil.rmtree(source)
    bundled = folder.parent / "bundled.txt"
    bundled.write_text(locked(BUNDLED))
    for python in PYTHONS if tag else ():
        tags = [option for name in PLATFORMS[tag] for option in ("--platform", name)]
        pinned = ["--require-hashes", "--requirement", str(bundled), "--python-version", python, *tags]
        pip("download", "--only-binary=:all:", "--no-deps", *pinned, "--dest", str(folder))
    bundled.unlink()
    return sorted(folder.glob("*.whl"))


def locked(names: Sequence[str]) -> str:
    """The part of wheels.txt that is about some libraries, with the hashes of their files."""
    entries = LOCK.read_text(encoding="utf-8").replace("\\\n", "").splitlines()
    return "".join(f"{entry}\n" for entry in entries if entry.partition("==")[0] in names)


def write_manifest(path: Path, wheels: list[Path], tag: str) -> str:
    """The manifest with this build's wheels and platform; returns the version."""
    text = (ROOT / "blender_manifest.toml").read_text()
    names = "".join(f'    "./wheels/{w.name}",\n' for w in wheels)
    head, _, tail = text.partition("\n[permissions]")
    path.write_text(f'{head}\nplatforms = ["{tag}"]\nwheels = [\n{names}]\n\n[permissions]{tail}')
    return str(tomllib.loads(path.read_text())["version"])


def blender(*arguments: str) -> None:
    """Run Blender's extension command-line tool, which the bpy module carries."""
    found = importlib.util.find_spec("bpy")
    if found is None or found.origin is None:
        sys.exit("build_extension: the bpy module is missing; run make setup")
    tool = next(Path(found.origin).parent.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py"))
    done = subprocess.run([sys.executable, str(tool), *arguments], capture_output=True, text=True)
    if done.returncode or "warning" in done.stdout.lower():
        sys.exit(f"build_extension: Blender's own tool says\n{done.stdout}{done.stderr}")


def pip(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", *arguments], check=True)


if __name__ == "__main__":
    main()

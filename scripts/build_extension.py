"""Build the Blender extension: dist/gimp3d-<version>-<platform>.zip with the core and its compiled wheels inside.

Stages the manifest, the add-on and the wheels, and lets Blender's own builder make and validate the zip. NumPy is never
bundled: Blender brings its own. By default for this machine's platform and Python.

    python scripts/build_extension.py [--without-compiled-wheels]
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
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DIST = ROOT / "dist"
BUNDLED = ("numba", "llvmlite", "scipy", "opencv-contrib-python-headless")
TAGS = {
    ("Linux", "x86_64"): "linux-x64",
    ("Linux", "aarch64"): "linux-arm64",
    ("Windows", "AMD64"): "windows-x64",
    ("Darwin", "arm64"): "macos-arm64",
}
ENTRY = '''"""3D-GIMP, installed as a Blender extension."""

from .gimp3d_addon import register, unregister

__all__ = ["register", "unregister"]
'''


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--without-compiled-wheels", action="store_true", help="small zip; needs a chosen Python")
    given = parser.parse_args()
    tag = TAGS.get((platform.system(), platform.machine()))
    if tag is None:
        sys.exit(f"build_extension: Blender has no extension platform for {platform.system()} {platform.machine()}")
    DIST.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="gimp3d-stage-") as folder:
        stage = Path(folder)
        shutil.copytree(ROOT / "gimp3d_addon", stage / "gimp3d_addon", ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy2(ROOT / "LICENSE", stage)
        (stage / "__init__.py").write_text(ENTRY)
        wheels = collect_wheels(stage / "wheels", compiled=not given.without_compiled_wheels)
        for wheel in sorted(wheels, key=lambda w: -w.stat().st_size):
            print(f"{wheel.stat().st_size / 2**20:8.1f} MiB  {wheel.name}")
        version = write_manifest(stage / "blender_manifest.toml", wheels, tag)
        light = "-light" if given.without_compiled_wheels else ""
        target = DIST / f"gimp3d-{version}-{tag}{light}.zip"
        blender("build", "--source-dir", str(stage), "--output-filepath", str(target))
    blender("validate", str(target))
    print(f"{target.stat().st_size / 2**20:8.1f} MiB  {target.relative_to(ROOT)}")


def collect_wheels(folder: Path, compiled: bool) -> list[Path]:
    """Our own wheel and, on request, the compiled ones for this platform and Python, in the tested versions."""
    folder.mkdir()
    source = folder.parent / "source"  # a copy, so that the build leaves nothing in the checkout
    shutil.copytree(ROOT / "core", source / "core", ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy2(ROOT / name, source)
    pip("wheel", "--no-deps", "--wheel-dir", str(folder), str(source))
    shutil.rmtree(source)
    if compiled:
        constraints = ["--constraint", str(ROOT / "constraints.txt")]
        pip("download", "--only-binary=:all:", "--no-deps", *constraints, "--dest", str(folder), *BUNDLED)
    return sorted(folder.glob("*.whl"))


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
    subprocess.run([sys.executable, str(tool), *arguments], check=True, stdout=subprocess.DEVNULL)


def pip(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", *arguments], check=True)


if __name__ == "__main__":
    main()

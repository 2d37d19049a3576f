"""What the button Make Environment downloads and puts on the disk, measured (environment.SIZE, docs/blender.md).

Does what the button does, for this Python and platform, in a folder that goes with it.

    python scripts/environment_size.py
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from build_extension import LOCK


def main() -> None:
    with tempfile.TemporaryDirectory(prefix="gimp3d-environment-") as folder:
        wheels, environment = Path(folder, "wheels"), Path(folder, "environment")
        subprocess.run([sys.executable, "-m", "venv", str(environment)], check=True)
        python = next(p for p in environment.glob("*/python*") if p.is_file())
        pip = [str(python), "-m", "pip", "--quiet", "--disable-pip-version-check"]
        pinned = ["--require-hashes", "--no-deps", "--only-binary=:all:", "--requirement", str(LOCK)]
        subprocess.run([*pip, "download", "--dest", str(wheels), *pinned], check=True)
        subprocess.run([*pip, "install", "--no-index", "--no-deps", *map(str, wheels.iterdir())], check=True)
        print(f"{size(wheels) / 1e6:.0f} MB downloaded, {size(environment) / 1e6:.0f} MB on the disk")


def size(folder: Path) -> int:
    """Bytes of all files below a folder, links not followed."""
    return sum(p.lstat().st_size for p in folder.rglob("*") if not p.is_dir())


if __name__ == "__main__":
    main()

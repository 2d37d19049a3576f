"""What the button Make Environment downloads and puts on the disk, measured (environment.SIZES, docs/blender.md).

Does what the button does, for this Python and platform, in a folder that goes with it.

    python scripts/environment_size.py
"""

from __future__ import annotations

import ast
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

SOURCE = Path(__file__).resolve().parents[1] / "gimp3d_addon" / "operators" / "environment.py"


def main() -> None:
    said = constants(SOURCE)
    steps = (("libraries", [], said["LIBRARIES"]), ("PyTorch", ["--index-url", said["TORCH_INDEX"]], [said["TORCH"]]))
    with tempfile.TemporaryDirectory(prefix="gimp3d-environment-") as folder:
        wheels, environment, downloaded = Path(folder, "wheels"), Path(folder, "environment"), 0
        subprocess.run([sys.executable, "-m", "venv", str(environment)], check=True)
        python = next(p for p in environment.glob("*/python*") if p.is_file())
        pip = [str(python), "-m", "pip", "--quiet", "--disable-pip-version-check"]
        for name, options, wanted in steps:
            subprocess.run([*pip, "download", "--dest", str(wheels / name), *options, *wanted], check=True)
            downloaded += size(wheels / name)
            files = [str(p) for p in (wheels / name).iterdir()]
            subprocess.run([*pip, "install", "--no-index", "--no-deps", *files], check=True)
            print(f"with {name}: {downloaded / 1e6:.0f} MB downloaded, {size(environment) / 1e6:.0f} MB on the disk")


def constants(path: Path) -> dict[str, Any]:
    """The literal constants of a module that cannot be imported without Blender."""
    namespace: dict[str, Any] = {}
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign):
            with suppress(ValueError):
                namespace[ast.unparse(node.targets[0])] = ast.literal_eval(node.value)
    return namespace


def size(folder: Path) -> int:
    """Bytes of all files below a folder, links not followed."""
    return sum(p.lstat().st_size for p in folder.rglob("*") if not p.is_dir())


if __name__ == "__main__":
    main()

"""What the button Make Environment downloads and puts on the disk, measured (environment.SIZE, docs/blender.md).

Does what the button does, for this Python and platform, in a folder that goes with it.

    python scripts/environment_size.py
"""

from __future__ import annotations

import ast
import subprocess
import sys
import tempfile
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[1] / "gimp3d_addon" / "operators" / "environment.py"


def main() -> None:
    wanted = libraries(SOURCE)
    with tempfile.TemporaryDirectory(prefix="gimp3d-environment-") as folder:
        wheels, environment = Path(folder, "wheels"), Path(folder, "environment")
        subprocess.run([sys.executable, "-m", "venv", str(environment)], check=True)
        python = next(p for p in environment.glob("*/python*") if p.is_file())
        pip = [str(python), "-m", "pip", "--quiet", "--disable-pip-version-check"]
        subprocess.run([*pip, "download", "--dest", str(wheels), *wanted], check=True)
        subprocess.run([*pip, "install", "--no-index", "--no-deps", *map(str, wheels.iterdir())], check=True)
        print(f"{size(wheels) / 1e6:.0f} MB downloaded, {size(environment) / 1e6:.0f} MB on the disk")


def libraries(path: Path) -> tuple[str, ...]:
    """The constant LIBRARIES of a module that cannot be imported without Blender."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "LIBRARIES":
            return ast.literal_eval(node.value)
    raise SystemExit(f"environment_size: {path} has no LIBRARIES")


def size(folder: Path) -> int:
    """Bytes of all files below a folder, links not followed."""
    return sum(p.lstat().st_size for p in folder.rglob("*") if not p.is_dir())


if __name__ == "__main__":
    main()

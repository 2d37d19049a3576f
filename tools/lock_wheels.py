"""Write gimp3d_addon/wheels.txt: every library that a Blender may install, with its version and its files' SHA-256.

What the extension bundles and what the button Make Environment downloads are these files and no others: pip compares
the hashes. The versions are those that the tests passed with (constraints.txt); newer Pythons need a newer NumPy. Asks
PyPI for what it has of each version, and downloads no file. With --size it measures instead what the button downloads
and puts on the disk of this machine (environment.SIZE, docs/blender.md), in a folder that goes with it.

    python tools/lock_wheels.py [--size]
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from build_extension import BUNDLED, LOCK, PLATFORMS, ROOT

LIBRARIES = (*BUNDLED, "numpy", "zstandard")
PYTHONS = ("3.11", "3.12", "3.13", "3.14")  # of Blender 4.2 to 5.2, from blender.org and from Linux distributions
NEWER_NUMPY = "2.3.5"  # has files for Python 3.13 and 3.14, which constraints.txt's has not
OLD_PYTHONS = ("3.11", "3.12")
HEAD = """\
# Written by tools/lock_wheels.py: the only files that the extension bundles or its button downloads.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", action="store_true", help="measure an environment")
    measure() if parser.parse_args().size else lock()


def measure() -> None:
    with tempfile.TemporaryDirectory(prefix="gimp3d-environment-") as folder:
        wheels, environment = Path(folder, "wheels"), Path(folder, "environment")
        subprocess.run([sys.executable, "-m", "venv", str(environment)], check=True)
        python = next(p for p in environment.glob("*/python*") if p.is_file())
        pip = [str(python), "-m", "pip", "--quiet", "--disable-pip-version-check"]
        pinned = ["--require-hashes", "--no-deps", "--only-binary=:all:", "--requirement", str(LOCK)]
        subprocess.run([*pip, "download", "--dest", str(wheels), *pinned], check=True)
        subprocess.run([*pip, "install", "--no-index", "--no-deps", *map(str, wheels.iterdir())], check=True)
        sizes = [sum(p.lstat().st_size for p in f.rglob("*") if not p.is_dir()) for f in (wheels, environment)]
        print(f"{sizes[0] / 1e6:.0f} MB downloaded, {sizes[1] / 1e6:.0f} MB on the disk")


def lock() -> None:
    versions = dict(re.findall(r"^([\w-]+)==(\S+)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE))
    hashes: dict[tuple[str, str, str], set[str]] = {}  # of name, version, marker
    for python in PYTHONS:
        numpy = versions["numpy"] if python in OLD_PYTHONS else NEWER_NUMPY
        wanted = [f"{name}=={numpy if name == 'numpy' else versions[name]}" for name in LIBRARIES]
        for tags in PLATFORMS.values():
            for name, version, digest in files_of(wanted, python, tags):
                old = "<" if python in OLD_PYTHONS else ">="
                marker = f' ; python_version {old} "{PYTHONS[len(OLD_PYTHONS)]}"' if name == "numpy" else ""
                hashes.setdefault((name, version, marker), set()).add(digest)
    lines = [
        " \\\n    ".join([f"{name}=={version}{marker}", *(f"--hash=sha256:{digest}" for digest in sorted(found))])
        for (name, version, marker), found in sorted(hashes.items())
    ]
    LOCK.write_text(HEAD + "\n".join(lines) + "\n", encoding="utf-8")
    print(f"{LOCK.relative_to(ROOT)}: {len(lines)} libraries, {sum(map(len, hashes.values()))} files")


def files_of(wanted: list[str], python: str, tags: tuple[str, ...]) -> list[tuple[str, str, str]]:
    """Name, version and SHA-256 of the file of each library for one Python on one platform."""
    with tempfile.TemporaryDirectory(prefix="gimp3d-lock-") as folder:
        report = Path(folder, "report.json")
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed", "--no-deps"]
        place = ["--only-binary=:all:", "--target", folder, "--python-version", python]
        options = [option for tag in tags for option in ("--platform", tag)]
        subprocess.run([*pip, *place, *options, "--report", str(report), *wanted], check=True)
        found = json.loads(report.read_text())["install"]
    archives = [(f["metadata"], f["download_info"]["archive_info"]) for f in found]
    return [(m["name"].lower(), m["version"], a["hashes"]["sha256"]) for m, a in archives]


if __name__ == "__main__":
    main()

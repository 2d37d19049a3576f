"""Screenshots for the user guide, from a real Blender with its window on a virtual screen (`make screenshots`).

Needs root on a Debian machine and shared/tools/real-blender, which sets up Blender in a chroot (2–4 minutes, 2 GB).

    python scripts/screenshots.py [--suite trixie] [--root build/blender-trixie] [--out docs/pictures]
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import cv2

ROOT = Path(__file__).resolve().parents[1]
TOOL = ROOT.parent / "shared" / "tools" / "real-blender"
DISPLAY, SIZE = ":77", "1500x1060"
LIBRARIES = ("numpy", "scipy", "numba", "opencv-contrib-python-headless")
PATIENCE = 900  # s for the whole session


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--suite", default="trixie", help="Debian's: trixie has Blender 4.3, sid has 5.2")
    parser.add_argument("--root", type=Path, help="where the chroot is or will be")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "pictures")
    given = parser.parse_args()
    tool = Path(os.environ.get("REAL_BLENDER", TOOL))
    if not tool.exists():
        sys.exit(f"screenshots: {tool} is not here; set REAL_BLENDER to the tool that sets up a real Blender")
    root = (given.root or ROOT / "build" / f"blender-{given.suite}").resolve()
    if not (root / "usr" / "bin" / "blender").exists():
        run(tool, "setup", given.suite, str(root))
    if not (root / "root" / "gimp" / "bin" / "python").exists():
        run(tool, "run", str(root), "python3", "-m", "venv", "/root/gimp")
        run(tool, "run", str(root), "/root/gimp/bin/pip", "install", "-q", *LIBRARIES)
    session(tool, root, given.out)


def session(tool: Path, root: Path, out: Path) -> None:
    """Go through a removal in the window and keep each picture that it asks for."""
    share = root / "share"
    shutil.rmtree(share, ignore_errors=True)
    share.mkdir()
    build = [sys.executable, str(ROOT / "scripts" / "build_extension.py"), "--platform", "here"]
    run(*build, "--without-compiled-wheels")
    newest = max((ROOT / "dist").glob("*-light.zip"), key=lambda p: p.stat().st_mtime)
    shutil.copy2(newest, share / "gimp3d.zip")
    for name in ("scene.ply", "roi.json", "transforms.json"):
        shutil.copy2(ROOT / "assets" / "demo" / name, share)
    shutil.copy2(ROOT / "scripts" / "screenshots_ui.py", share)
    inside = [str(tool), "run", str(root), "env", f"DISPLAY={DISPLAY}", "LIBGL_ALWAYS_SOFTWARE=1"]
    inside += ["GIMP3D_SHARE=/share", "GIMP3D_PYTHON=/root/gimp/bin/python", "BLENDER_USER_RESOURCES=/share/user"]
    xvfb = [*inside, "Xvfb", DISPLAY, "-screen", "0", f"{SIZE}x24", "+extension", "GLX"]
    screen = subprocess.Popen(xvfb, start_new_session=True)
    time.sleep(2)
    width, height = SIZE.split("x")
    blender = ["blender", "--window-geometry", "0", "0", width, height, "--no-window-focus"]
    with (share / "blender.log").open("w") as log:
        window = subprocess.Popen(
            [*inside, *blender, "--python", "/share/screenshots_ui.py"], stdout=log, stderr=log, start_new_session=True
        )
    out.mkdir(parents=True, exist_ok=True)
    start, finished = time.monotonic(), share / "finished"
    try:
        while not finished.exists():
            if window.poll() is not None or time.monotonic() - start > PATIENCE:
                sys.exit(f"screenshots: Blender ended or is stuck; see {share / 'blender.log'}")
            for ready in share.glob("key-*.ready"):
                run(*inside, "xdotool", "mousemove", "500", "600", "key", ready.stem.removeprefix("key-"))
                ready.unlink()
            for ready in share.glob("[0-9]*.ready"):
                time.sleep(6)  # llvmpipe takes its time to draw
                run(*inside, "import", "-window", "root", f"/share/{ready.stem}.png")
                picture = cv2.imread(str(share / f"{ready.stem}.png"))
                cv2.imwrite(str(out / f"{ready.stem}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 85])
                print(f"screenshots: {ready.stem}", flush=True)
                ready.unlink()
            time.sleep(0.2)
    finally:
        for process in (window, screen):  # with what runs inside of the chroot
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)
    print("".join(line for line in (share / "blender.log").open() if line.startswith("screenshots:")), end="")
    if finished.read_text() != "well":
        sys.exit(f"screenshots: {finished.read_text()}")


def run(*command: object) -> None:
    subprocess.run([str(c) for c in command], check=True)


if __name__ == "__main__":
    main()

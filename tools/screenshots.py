"""Screenshots for the user guide, from a real Blender with its window on a virtual screen (`make screenshots`).

Needs root on a Debian machine and shared/tools/real-blender, which sets up Blender in a chroot (2–4 minutes, 2 GB).

    python tools/screenshots.py [--suite trixie] [--root build/blender-trixie] [--out docs/pictures]
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from real_blender import ROOT, SUITES, RealBlender, save_jpeg

PATIENCE = 900  # s for the whole session
DEMO = tuple(ROOT / "assets" / "demo" / name for name in ("scene.ply", "roi.json", "transforms.json"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--suite", default="trixie", choices=SUITES, help="Debian's: 4.3 or 5.2")
    parser.add_argument("--root", type=Path, help="where the chroot is or will be")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "pictures")
    given = parser.parse_args()
    session(RealBlender(given.suite, given.root), given.out)


def session(blender: RealBlender, out: Path) -> None:
    """Go through a removal in the window and keep each picture that it asks for."""
    blender.put(*DEMO, ROOT / "tools" / "screenshots_ui.py")
    share, finished = blender.share, blender.share / "finished"
    start = time.monotonic()
    with blender.window("screenshots_ui.py") as window:
        while not finished.exists():
            if window.poll() is not None or time.monotonic() - start > PATIENCE:
                sys.exit(f"screenshots: Blender ended or is stuck; see {share / 'blender.log'}")
            for ready in share.glob("key-*.ready"):
                blender.run("xdotool", "mousemove", "500", "600", "key", ready.stem.removeprefix("key-"))
                ready.unlink()
            for ready in share.glob("[0-9]*.ready"):
                time.sleep(6)  # llvmpipe takes its time to draw
                save_jpeg(out / f"{ready.stem}.jpg", blender.picture())
                print(f"screenshots: {ready.stem}", flush=True)
                ready.unlink()
            time.sleep(0.2)
    print("".join(line for line in (share / "blender.log").open() if line.startswith("screenshots:")), end="")
    if finished.read_text() != "well":
        sys.exit(f"screenshots: {finished.read_text()}")


if __name__ == "__main__":
    main()

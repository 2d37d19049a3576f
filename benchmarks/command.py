"""What every benchmark's command shares: its options, how it ends, and what it writes."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gimp3d.errors import BadInput
from gimp3d.files import write_atomically

ROOT = Path(__file__).resolve().parents[1]
ASSETS = ROOT / "assets"
DATA = ROOT.parent / "shared" / "data" / "withwithout"


def parser_of(words: str, name: str, data: bool = False, quick: str = "", scenes: str = "") -> argparse.ArgumentParser:
    """The options that benchmarks share: --out, and where wanted the folder of scenes, --scenes and --quick."""
    parser = argparse.ArgumentParser(prog=f"benchmarks.{name}", description=(words or "").split("\n\n")[0])
    if data:
        parser.add_argument("data", nargs="?", type=Path, default=DATA, help="scenes with and without the object")
    if scenes:
        parser.add_argument("--scenes", default=scenes, help="folders of DATA, separated by commas")
    if quick:
        parser.add_argument("--quick", action="store_true", help=quick)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / f"bench_{name}")
    return parser


def told_in_one_line(main: Callable[[], int | None]) -> None:
    """Run a benchmark; what it cannot read is one line and the program's exit code."""
    try:
        sys.exit(main() or 0)
    except BadInput as error:
        print(f"{Path(sys.argv[0]).stem}: error: {error}", file=sys.stderr)
        sys.exit(error.exit_code)


def say(words: str) -> None:
    print(words, flush=True)


def write(path: Path, words: str) -> None:
    write_atomically(path, lambda file: file.write(words.encode()))
    say(f"wrote {path}")


def write_results(out: Path, name: str, results: Any, markdown: str) -> None:
    """`name`.json with all that was measured, and `name`.md with its tables."""
    write(out / f"{name}.json", json.dumps(results, indent=1))
    write(out / f"{name}.md", markdown)


def kept(path: Path, key: str, work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What `work` gives, measured once: finished cells lie in a JSON file by key, so a stopped run goes on."""
    cells: dict[str, dict[str, Any]] = json.loads(path.read_text()) if path.exists() else {}
    if key not in cells:
        cells[key] = work()
        write_atomically(path, lambda file: file.write(json.dumps(cells, indent=1).encode()))
    return cells[key]

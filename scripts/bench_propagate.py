"""Measures how the reference is carried into the other views: time by views and size, memory, how exact the blend is,
what each step is worth on scenes rendered with and without the object, and how well painted views agree.

Writes OUT/propagate.json, OUT/propagate.md, OUT/pictures/*.png and a chart. Run by `make bench-propagate`.

    python scripts/bench_propagate.py [DATA] [--quick] [--out build/bench_propagate] [--chart FILE.svg]
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench_raster import ROOT, machine, say, write
from propagate_ablation import made_room, measure, read_case
from propagate_cost import Size, exactness, memory, room, speed
from propagate_report import draw_chart, markdown

from gimp3d.errors import BadInput

SMALL, HALF_HD, FULL_HD, FOUR_K = (480, 270), (960, 540), (1920, 1080), (3840, 2160)
SCENES = ("desk", "corner", "gloss", "rocks")


@dataclass(frozen=True)
class Plan:
    """What is measured."""

    speed: tuple[tuple[int, Size], ...]  # the first size is that of the chart's panel over views
    memory: tuple[tuple[int, Size], ...]
    blend: tuple[tuple[Size, int], ...]
    room: Size
    scenes: tuple[str, ...]


FULL = Plan(
    speed=(
        *((n, HALF_HD) for n in (10, 25, 50, 100, 200)),
        (40, SMALL),
        (24, FULL_HD),
        (8, FOUR_K),
    ),
    memory=((10, FULL_HD), (75, FULL_HD), (300, FULL_HD)),
    blend=((HALF_HD, 6),),
    room=HALF_HD,
    scenes=SCENES,
)
QUICK = Plan(
    speed=((6, SMALL), (12, SMALL), (4, HALF_HD)),
    memory=((4, SMALL), (24, SMALL)),
    blend=((SMALL, 2),),
    room=SMALL,
    scenes=("desk",),
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", nargs="?", type=Path, default=ROOT.parent / "shared" / "data" / "withwithout")
    parser.add_argument("--quick", action="store_true", help="small pictures and one scene only")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench_propagate")
    parser.add_argument("--chart", type=Path, help="default: assets/propagate.svg, or OUT/propagate.svg if --quick")
    given = parser.parse_args()
    plan = QUICK if given.quick else FULL
    chart = given.chart or (given.out if given.quick else ROOT / "assets") / "propagate.svg"
    results: dict[str, Any] = {"quick": given.quick, "machine": machine()}
    # Memory first, while this process is small: a child's peak begins with that of the process that started it.
    results["memory"] = memory(plan.memory)
    results["speed"] = speed(plan.speed)
    results["blend"] = [exactness(*case) for case in plan.blend]
    results["room"] = made_room(plan.room)
    room.cache_clear()
    results |= {"scores": [], "consistency": [], "rules": []}
    try:
        for name in plan.scenes if given.data.is_dir() else ():
            found = measure(read_case(given.data / name), given.out / "pictures")
            results["scores"] += found["scores"]
            results["consistency"] += found["consistency"]
            results["rules"].append(found["rules"])
    except BadInput as error:
        print(f"bench_propagate: error: {error}", file=sys.stderr)
        return error.exit_code
    if not results["scores"]:
        say(f"{given.data} is not here: no scores against the truth")
    write(given.out / "propagate.json", json.dumps(results, indent=1))
    write(given.out / "propagate.md", markdown(results))
    write(chart, draw_chart(results))
    return 0


if __name__ == "__main__":
    sys.exit(main())

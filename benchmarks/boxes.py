"""The same removals in boxes that different users would draw: what a score of one box is worth.

Scenes are developed with one box each, so what comes by chance there is kept: rims that differ by a texel, planes and
fills on the verge of others. The boxes here are moved by up to 1.5 % of their edges and are up to 3 % larger. Writes
OUT/boxes.md; finished cells lie in OUT/cells.json, so a stopped run goes on. Run by `make bench-boxes`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from gimp3d.errors import BadInput, IllPosed
from gimp3d.pipeline import PRESETS

from .command import kept, parser_of, say, told_in_one_line, write
from .scenes import BUILT_IN, GIVEN, MADE, MASKS, REAL, Scene, filled, mean_psnrs, read_scenes, redrawn, removal
from .tables import Row, Section, markdown
from .timing import about, machine

BOXES = 6  # drawn by others, beside the scene's own


def main() -> None:
    parser = parser_of(__doc__, "boxes", data=True, quick="one made scene, one box", scenes=",".join((*MADE, *REAL)))
    parser.add_argument("--preset", default="balanced", choices=PRESETS)
    parser.add_argument("--picture", nargs="*", default=[BUILT_IN], choices=[GIVEN, BUILT_IN])
    parser.add_argument("--boxes", type=int, default=BOXES, help="how many beside the scene's own")
    given = parser.parse_args()
    scenes = read_scenes(given.data, "desk" if given.quick else given.scenes, needs_truth=True)
    numbers = range(2 if given.quick else given.boxes + 1)
    rows: dict[tuple[str, str], list[Row]] = {}
    for scene in scenes:
        for picture in given.picture:
            found = rows.setdefault((scene.name, picture), [])
            for number in numbers:
                key = f"{scene.name} | {given.preset} | {picture} | {number}"
                cell = kept(
                    given.out / "cells.json", key, lambda s=scene, p=picture, n=number: measured(s, given.preset, p, n)
                )
                found.append(cell)
                say(f"{key:48}" + (cell.get("refused") or f"{cell['mask']:8.2f}{cell['unseen']:8.2f}"))
            words = markdown("Boxes of other users", about(machine()), sections(rows, given.preset))
            write(given.out / "boxes.md", words)


def measured(scene: Scene, preset: str, picture: str, number: int) -> Row:
    """PSNR in the mask and where no view looks, in a box of another user; or why there are none."""
    reference = scene.test[0] if picture == GIVEN else None
    true_picture = scene.truth(reference) if reference else None
    try:
        region = redrawn(scene.region, number)
        result = removal(scene, PRESETS[preset], reference, true_picture, region=region)
    except (BadInput, IllPosed) as error:
        return {"refused": str(error)}
    return dict(mean_psnrs(scene, filled(scene.gaussians, result), scene.test[1:]))


def sections(rows: dict[tuple[str, str], list[Row]], preset: str) -> Iterator[Section]:
    lines = []
    for (scene, picture), cells in rows.items():
        line, done = [scene, picture], [c for c in cells[1:] if "refused" not in c]
        for mask in MASKS:
            own, others = cells[0].get(mask, float("nan")), [c[mask] for c in done]
            line += [f"{own:.2f}"] + ([f"{f(others):.2f}" for f in (np.mean, np.std, np.min)] if others else ["–"] * 3)
        lines.append([*line, f"{len(done)} of {len(cells) - 1}"])
    head: Sequence[str] = [f"{m}: {w}" for m in MASKS for w in ("its own box", "others, mean", "σ", "worst")]
    yield Section(
        f"Preset {preset}",
        "PSNR of the test views but the first, dB, in what the object hides (mask) and in what no training view sees "
        "(unseen).",
        ["scene", "picture", *head, "boxes done"],
        lines,
    )


if __name__ == "__main__":
    told_in_one_line(main)

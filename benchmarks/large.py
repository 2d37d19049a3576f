"""A whole removal on a large scene: where time and memory go.

The scene is made: every Gaussian is split, cameras are set between the given ones, pictures are larger and drawn from
the scene itself. The removal runs in a process of its own. Writes OUT/large.md. Run by `make bench-large`.
"""

from __future__ import annotations

import json
import resource
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gimp3d.camera import Camera
from gimp3d.errors import BadInput
from gimp3d.gaussians import Gaussians, matrices_to_quats, quats_to_matrices
from gimp3d.io.cameras import write_transforms
from gimp3d.io.ply import write_gaussians

from .command import DATA, parser_of, say, told_in_one_line, write
from .scenes import gimp3d, read_scene, remove_words
from .tables import Section, markdown
from .timing import Watch, about, machine

SHRINK = 0.5  # of the parts' standard deviations; what is lost is spread between their centres


def split(gaussians: Gaussians, parts: int, seed: int = 0) -> Gaussians:
    """Each Gaussian as `parts` smaller ones that lie as its own mass does."""
    rng = np.random.default_rng(seed)
    many = gaussians.take(np.repeat(np.flatnonzero(gaussians.usable), parts))
    spread = many.scales * np.sqrt(1 - SHRINK**2) * rng.standard_normal(many.scales.shape)
    spread = np.pad(spread, ((0, 0), (0, 3 - spread.shape[1])))
    moved = many.means + np.einsum("nij,nj->ni", quats_to_matrices(many.quats.astype(np.float64)), spread)
    return replace(many, means=moved.astype(np.float32), log_scales=many.log_scales + np.float32(np.log(SHRINK)))


def between(cameras: Sequence[Camera], count: int) -> list[Camera]:
    """`count` cameras on the way from each to the next: centres and axes are mixed, axes made orthogonal again."""
    found = []
    for k, at in enumerate(np.linspace(0, len(cameras) - 1, count)):
        first, share = cameras[int(at)], at - int(at)
        second = cameras[min(int(at) + 1, len(cameras) - 1)]
        u, _, vt = np.linalg.svd((1 - share) * first.R + share * second.R)
        turn = matrices_to_quats((u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt)[None])
        viewmat = np.eye(4)
        viewmat[:3, :3] = quats_to_matrices(turn)[0]
        viewmat[:3, 3] = -viewmat[:3, :3] @ ((1 - share) * first.centre + share * second.centre)
        found.append(replace(first, id=f"made/{k:04d}.png", viewmat=viewmat))
    return found


def main() -> None:
    parser = parser_of(__doc__, "large")
    parser.add_argument("scene", nargs="?", type=Path, default=DATA / "desk")
    parser.add_argument("--split", type=int, default=10)
    parser.add_argument("--views", type=int, default=200)
    parser.add_argument("--scale", type=float, default=2.0, help="of the pictures' size")
    parser.add_argument("--preset", default="balanced")
    given = parser.parse_args()
    scene = read_scene(given.scene)
    given.out.mkdir(parents=True, exist_ok=True)
    count = len(made := split(scene.gaussians, given.split))
    write_gaussians(given.out / "scene.ply", made)
    del made
    cameras = [c.scaled(given.scale) for c in between(scene.train, given.views)]
    write_transforms(given.out / "transforms.json", cameras)
    shutil.copy(given.scene / "roi.json", given.out / "roi.json")
    words = remove_words(read_scene(given.out), given.out / "out.ply")
    words += ["--summary", str(given.out / "summary.json"), "--images", "none", "--preset", given.preset]
    watch = Watch()
    if message := gimp3d(words):
        raise BadInput(message)
    wall = watch.lap()[0] / 1e3
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu, summary = used.ru_utime + used.ru_stime, json.loads((given.out / "summary.json").read_text())
    rows = [[s["name"], f"{s['seconds']:.1f}"] for s in summary["stages"]]
    rest = summary["seconds_total"] - sum(s["seconds"] for s in summary["stages"])
    rows += [["reading, drawing the views, writing", f"{rest:.1f}"], ["**all**", f"{summary['seconds_total']:.1f}"]]
    told = f"Wall {wall:.1f} s, CPU {cpu:.1f} s ({used.ru_stime / cpu:.0%} in the system), CPU/wall {cpu / wall:.2f}. "
    told += f"Peak memory {summary['peak_memory_mb']:.0f} MB."
    title = f"{count} Gaussians, {given.views} views, preset {given.preset}"
    report = markdown(title, about(machine()), [Section("Stages", told, ["stage", "seconds"], rows)])
    write(given.out / "large.md", report)
    say(report)


if __name__ == "__main__":
    told_in_one_line(main)

"""A whole removal on a large scene: where time and memory go.

    python scripts/bench_large.py ../shared/data/withwithout/desk [--split 10] [--views 200] [--preset balanced]

The scene is made: every Gaussian is split, cameras are set between the given ones, pictures are larger and drawn from
the scene itself. The removal runs in a process of its own.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from gimp3d.camera import Camera
from gimp3d.gaussians import Gaussians, matrices_to_quats, quats_to_matrices
from gimp3d.io.cameras import read_cameras, write_transforms
from gimp3d.io.ply import read_ply, write_gaussians

SHRINK = 0.5  # of the parts' standard deviations; what is lost is spread between their centres


def split(gaussians: Gaussians, parts: int, seed: int = 0) -> Gaussians:
    """Each Gaussian as `parts` smaller ones that lie as its own mass does."""
    rng = np.random.default_rng(seed)
    many = gaussians.take(np.repeat(np.flatnonzero(gaussians.usable), parts))
    spread = many.scales * np.sqrt(1 - SHRINK**2) * rng.standard_normal(many.scales.shape)
    spread = np.pad(spread, ((0, 0), (0, 3 - spread.shape[1])))
    moved = many.means + np.einsum("nij,nj->ni", quats_to_matrices(many.quats.astype(np.float64)), spread)
    return replace(many, means=moved.astype(np.float32), log_scales=many.log_scales + np.float32(np.log(SHRINK)))


def between(cameras: list[Camera], count: int) -> list[Camera]:
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
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="folder with scene.ply, transforms.json and roi.json")
    parser.add_argument("--split", type=int, default=10)
    parser.add_argument("--views", type=int, default=200)
    parser.add_argument("--scale", type=float, default=2.0, help="of the pictures' size")
    parser.add_argument("--preset", default="balanced")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--out", type=Path, default=Path("build/bench_large"))
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    large = split(read_ply(given.scene / "scene.ply").gaussians, given.split)
    write_gaussians(given.out / "scene.ply", large)
    trained = [c for c in read_cameras(given.scene / "transforms.json") if c.split == "train"]
    write_transforms(given.out / "transforms.json", [c.scaled(given.scale) for c in between(trained, given.views)])
    shutil.copy(given.scene / "roi.json", given.out / "roi.json")
    files = [str(given.out / name) for name in ("scene.ply", "transforms.json", "roi.json", "out.ply", "summary.json")]
    options = ("--cameras", "--roi", "--out", "--summary")
    command = [sys.executable, "-m", "gimp3d", "remove", files[0]]
    command += [word for pair in zip(options, files[1:]) for word in pair]
    command += ["--images", "none", "--preset", given.preset, "--progress", "none", "--quiet"]
    if given.threads:
        command += ["--threads", str(given.threads)]
    start = time.perf_counter()
    subprocess.run(command, check=True)
    wall, used = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = used.ru_utime + used.ru_stime
    summary = json.loads((given.out / "summary.json").read_text())
    lines = [
        f"{len(large)} Gaussians, {given.views} views, preset {given.preset}",
        "",
        "| stage | seconds |",
        "|---|---:|",
    ]
    lines += [f"| {s['name']} | {s['seconds']:.1f} |" for s in summary["stages"]]
    rest = summary["seconds_total"] - sum(s["seconds"] for s in summary["stages"])
    lines += [f"| reading, drawing the views, writing | {rest:.1f} |", f"| **all** | {summary['seconds_total']:.1f} |"]
    lines += [
        "",
        f"Wall {wall:.1f} s, CPU {cpu:.1f} s ({used.ru_stime / cpu:.0%} in the system), CPU/wall {cpu / wall:.2f}",
    ]
    lines += [f"Peak memory {summary['peak_memory_mb']:.0f} MB"]
    (given.out / "large.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()

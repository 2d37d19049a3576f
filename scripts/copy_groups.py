"""A sketch, measured: groups of the scene's own Gaussians, copied along the mapping field, instead of new ones.

    python scripts/copy_groups.py [DATA] [--scenes rocks] [--out build/copy_groups]

The paper names this as future work. A segment is a connected part of the hole whose sources lie together; the rigid
motion that takes the sources' points on the surface to the segment's (Kabsch 1976) takes their Gaussians along, with
their spherical harmonics. The first reference's hole alone is filled. Seeds' colours are
settled, copies' are not.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from bench_refine import SCENES, Scene, SharedStages, load_scene, scores
from raster_report import table

from gimp3d.camera import Camera
from gimp3d.gaussians import Gaussians, matrices_to_quats, quats_to_matrices
from gimp3d.pipeline import PRESETS, remove_object, render_bytes
from gimp3d.solvers.harmonics import rotate_sh

LEAST = 20  # px of a segment
APART = 1  # px by which neighbours' offsets may differ in a segment
NEAR = 0.02  # of the depth: a Gaussian so near to the surface belongs to it
CROOKED = 0.7  # RMS of what a motion leaves, by the segment's radius, above which it is not rigid


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", nargs="?", type=Path, default=Path("../shared/data/withwithout"))
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--coherence", type=float, default=PRESETS["draft"].mapping.patchmatch.coherence)
    parser.add_argument("--out", type=Path, default=Path("build/copy_groups"))
    given = parser.parse_args()
    rows = [row for name in given.scenes.split(",") for row in measured(load_scene(given.data / name), given.coherence)]
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "copy_groups.json").write_text(json.dumps(rows, indent=1))
    head = list(rows[0])
    print(table(head, [[f"{r[k]:.2f}" if isinstance(r[k], float) else r[k] for k in head] for r in rows]))


def measured(scene: Scene, coherence: float) -> Iterator[dict[str, Any]]:
    mapping = PRESETS["draft"].mapping
    mapping = replace(mapping, patchmatch=replace(mapping.patchmatch, coherence=coherence))
    settings = replace(PRESETS["draft"], extra_references=0, mapping=mapping)
    shared = SharedStages()
    result = remove_object(
        scene.gaussians, scene.views, scene.region, settings, scene.reference.id, scene.picture, store=shared
    )
    kept, seeds = scene.gaussians.take(result.keep), result.added
    assert seeds is not None
    masks, completed, field = (shared.kept[name][0] for name in ("masks", "depth", "mapping"))
    view = next(v for v in masks.views if v.camera.id == scene.reference.id)
    depth = np.where(view.target, completed.depth, view.depth_after).astype(np.float64)
    copies, there, count = copied(kept, view.camera, depth, field.rows, field.cols)
    rest = seeds.take(~there.ravel()[np.maximum(shown_at(seeds, view.camera, depth, 1.0), 0)])
    ways = {"seeds": seeds, "seeds, segments left open": rest, "copies, seeds elsewhere": rest.extended(copies)}
    for name, new in ways.items():
        drawn = [render_bytes(kept.extended(new), t[0]) for t in scene.tests]
        found = scores(drawn, scene)
        row = {
            "scene": scene.name,
            "way": name,
            "added": len(new),
            "copied": len(new) - len(rest) if "copies" in name else 0,
        }
        row |= {"segments": count, "share of the hole": float(there.sum() / view.target.sum())}
        yield row | {k: found[k] for k in ("psnr mask", "psnr unseen", "flip unseen")}


def copied(
    scene: Gaussians,  # without the object
    camera: Camera,
    depth: np.ndarray,  # [H, W] of the completed reference
    rows: np.ndarray,  # [H, W] sources, -1 where there is none
    cols: np.ndarray,
) -> tuple[Gaussians, np.ndarray, int]:
    """The copies, which pixels they are for [H, W] bool, and the number of segments."""
    pixel = shown_at(scene, camera, depth, NEAR)
    points = camera.unproject(camera.pixel_centres(), depth).reshape(-1, 3)
    done, parts, count = np.zeros(depth.shape, bool), [scene.take(np.zeros(0, int))], 0
    for there in segments(rows, cols):
        sources = rows[there] * depth.shape[1] + cols[there]
        motion = rigid(points[sources], points[np.flatnonzero(there)])
        if motion is None:
            continue
        group = scene.take(np.isin(pixel, sources))
        parts.append(moved(group, *motion))
        done |= there
        count += 1
    whole = parts[0]
    for part in parts[1:]:
        whole = whole.extended(part)
    return whole, done, count


def shown_at(gaussians: Gaussians, camera: Camera, depth: np.ndarray, near: float) -> np.ndarray:
    """[N] the pixel, row after row, that shows each Gaussian if it lies near the surface; -1 where none does."""
    h, w = depth.shape
    uv, z = camera.project(gaussians.means.astype(np.float64))
    inside = gaussians.usable & (z > 0) & (uv >= 0).all(1) & (uv < [w, h]).all(1)
    pixel = np.full(len(z), -1)
    pixel[inside] = uv[inside, 1].astype(int) * w + uv[inside, 0].astype(int)
    surface = depth.ravel()[pixel]
    return np.where(inside & (np.abs(z - surface) <= near * surface), pixel, -1)


def segments(rows: np.ndarray, cols: np.ndarray) -> Iterator[np.ndarray]:
    """[H, W] bool each: connected pixels whose sources lie together."""
    y, x = np.indices(rows.shape)
    left = rows >= 0
    offsets = np.where(left[..., None], np.stack([rows - y, cols - x, 0 * x], -1), -9999).astype(np.float32)
    while left.any():
        start = np.unravel_index(np.argmax(left), left.shape)
        mask = np.pad((~left).astype(np.uint8), 1)
        flags = 4 | cv2.FLOODFILL_MASK_ONLY | (2 << 8)
        cv2.floodFill(offsets, mask, start[::-1], 0, (APART,) * 3, (APART,) * 3, flags)
        there = mask[1:-1, 1:-1] == 2
        left &= ~there
        if there.sum() >= LEAST:
            yield there


def rigid(sources: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Rotation and shift that take the sources [N, 3] to the targets (Kabsch 1976); None if too much is left over."""
    middle, there = sources.mean(0), targets.mean(0)
    u, _, v = np.linalg.svd((sources - middle).T @ (targets - there))
    turn = (u @ np.diag([1, 1, np.sign(np.linalg.det(u @ v))]) @ v).T
    left = targets - there - (sources - middle) @ turn.T
    radius = np.sqrt(((targets - there) ** 2).sum(1).mean())
    if not np.sqrt((left**2).sum(1).mean()) < CROOKED * radius:
        return None
    return turn, there - turn @ middle


def moved(group: Gaussians, turn: np.ndarray, shift: np.ndarray) -> Gaussians:
    """The Gaussians moved rigidly, with what they show in each direction."""
    return replace(
        group,
        means=(group.means @ turn.T + shift).astype(np.float32),
        quats=matrices_to_quats(turn @ quats_to_matrices(group.quats.astype(np.float64))).astype(np.float32),
        sh=rotate_sh(group.sh, turn),
    )


if __name__ == "__main__":
    main()

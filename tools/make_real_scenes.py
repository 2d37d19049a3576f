"""A made object drawn into a real scan's photos, with the truth: the photos as they were.

    python -m tools.make_real_scenes SCAN VIEW X Y [--thing pot] [--size 0.15] [--name NAME] [--out build/made]

SCAN is a folder as `gimp3d bench` reads it: scene.ply, transforms.json with the photos, and roi.json round a thing on
the surface that the object is to stand on. It stands where pixel X, Y of the photo VIEW shows that surface, SIZE times
as high as it is far from there. Light falls on it, but it casts no shadow; what the scan's splats draw before it hides
it, unless the photo looks as that surface does. (Look at the photos: depths of rough scans hide badly, so a place that
nothing stands before is best.) Every fifth photo that shows it is a test view. The splats are the scan's, less those
that no other photo shows, with points of the object among them, and learn from the new photos: about four minutes on
2 cores. All benchmarks take the folder.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import bpy
import cv2
import mathutils
import numpy as np
from bpy.types import Object

from benchmarks.scenes import Scene, read_scene, removal
from gimp3d.box import Box
from gimp3d.camera import Camera
from gimp3d.errors import BadInput
from gimp3d.gaussians import Gaussians, matrices_to_quats
from gimp3d.geometry import dilated
from gimp3d.io.cameras import write_transforms
from gimp3d.io.images import write_png
from gimp3d.io.ply import write_gaussians
from gimp3d.pipeline import View
from gimp3d.presets import PRESETS
from gimp3d.raster import render
from gimp3d.stages.charts.plane import Plane, first_hits, pictured
from gimp3d.stages.ground import look_at
from gimp3d.stages.lifting import ALIKE, PATCH
from gimp3d.stages.occluder import support_first
from gimp3d.stages.witness import Witness
from tools.make_scenes import FAR, ROOT, Studio, lit, paint, shown_by_any, solid, splats_of, taught

EVERY = 5  # photos, of which one is a test view
LEAST = 300  # px that it shows of the object
STEPS, POINTS = 1200, 400  # of training, and of the object in each photo
BEFORE, HIGH = 0.95, 0.12  # of the object's z, and of its size above the surface: what hides it is nearer and higher
ROUGH = 0.03  # relative z within which a photo shows what is behind the object: splats of scans scatter
NOISE = 1.0  # grey levels, of the object's pixels
WIDE = 2.0  # of its box: the surface round that is looked at, as it is seen behind the object
MARGIN = 0.08  # of its size, of the box round it


def pot() -> list[Object]:
    """All objects are about 1 high and stand on z = 0."""
    clay, leaves = paint("Noise", 6.0, "#a45a38", "#c47a50"), paint("Noise", 10.0, "#2e4a24", "#5f8a3c")
    return [
        solid("cylinder", (0, 0, 0.25), (0.55, 0.55, 0.5), clay),
        solid("uv_sphere", (0, 0, 0.68), (0.72, 0.72, 0.64), leaves),
    ]


def vase() -> list[Object]:
    glaze = paint("Wave", 4.0, "#20646a", "#e0c070", rough=0.4)
    return [
        solid("uv_sphere", (0, 0, 0.36), (0.62, 0.62, 0.72), glaze),
        solid("cylinder", (0, 0, 0.82), (0.22, 0.22, 0.34), glaze),
    ]


def box() -> list[Object]:
    pattern = paint("Voronoi", 5.0, "#b03a48", "#f0e4c8", "#2f4f6f")
    return [solid("cube", (0, 0, 0.4), (0.7, 0.6, 0.8), pattern, turn=0.4)]


THINGS: dict[str, Callable[[], list[Object]]] = {f.__name__: f for f in (pot, vase, box)}


@dataclass(frozen=True)
class Place:
    """Where the object stands."""

    at: np.ndarray  # [3]
    axes: np.ndarray  # [3, 3], columns are its x, y and up in the scene
    size: float  # scene units


def support(scene: Scene) -> Plane:
    """The surface that a thing in the scan's own boxes stands on: as photos tell it, not as splats are drawn."""
    result = removal(scene, PRESETS["draft"])
    if not result.charts:
        raise BadInput(f"{scene.folder}: no surface is found at its boxes to put an object on")
    return support_first([c.plane for c in result.charts], scene.gaussians.take(~result.keep))[0]


def place_on(plane: Plane, camera: Camera, pixel: tuple[float, float], size: float) -> Place:
    """Where a pixel shows a plane, for an object so many times as high as it is far."""
    ray = camera.unproject(np.array([pixel]), np.ones(1))[0] - camera.centre
    z = float((plane.origin - camera.centre) @ plane.normal / (ray @ plane.normal))
    if not 0 < z < np.inf:
        raise BadInput(f"{camera.id}: pixel {pixel} does not show the surface")
    return Place(camera.centre + z * ray, np.stack([plane.right, plane.down, plane.normal], 1), size * z)


def put_up(thing: list[Object], place: Place) -> Box:
    """Move the object to its place, under the lamp; the box round it, which reaches a little into the surface."""
    bpy.context.view_layer.update()
    corners = np.concatenate([[one.matrix_world @ v.co for v in one.data.vertices] for one in thing])
    low, high = corners.min(0) - MARGIN, corners.max(0) + MARGIN
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = place.size * place.axes, place.at
    for one in thing:
        one.matrix_world = mathutils.Matrix(pose.tolist()) @ one.matrix_world
    for lamp in (o for o in bpy.context.scene.objects if o.type == "LIGHT"):
        lamp.matrix_world = mathutils.Matrix(place.axes.tolist()).to_4x4() @ lamp.matrix_world
    centre = place.at + place.size * place.axes @ ((low + high) / 2)
    return Box.make(centre, place.size * (high - low), matrices_to_quats(place.axes[None])[0])


def may_show(views: Sequence[View], depths: Sequence[np.ndarray], plane: Plane, box: Box) -> list[np.ndarray]:
    """[H, W] bool of each view: where it meets the plane round the box, unless it looks otherwise than most of them
    show that there. Depths of rough scans, as they are drawn [H, W], lie far before such surface."""
    no = np.zeros(depths[0].shape, bool)
    witnesses = [Witness(v.camera, v.image, no, no, no, z.astype(np.float32)) for v, z in zip(views, depths)]
    grounds = look_at([plane], witnesses, (box,))[:1]

    def of(view: View) -> np.ndarray:
        hits = first_hits(grounds, view.camera, ~no)
        expected, known, _ = pictured(grounds, hits)
        off = cv2.blur(cv2.absdiff(expected, view.image).max(-1).astype(np.float32), (PATCH, PATCH))
        return (hits.chart >= 0) & ~(known & (off > ALIKE))

    return [of(view) for view in views] if grounds else [no] * len(views)


def cut_out(
    studio: Studio, camera: Camera, place: Place, behind: np.ndarray, surface: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The object in a view, [H, W, 4] in grey levels and opacity, and its z [H, W]; not where what is drawn `behind`
    [H, W], z, is before it and no `surface` [H, W] bool."""
    path = Path(tempfile.mkdtemp(prefix="gimp3d-object-")) / "object.png"
    studio.photo(camera, path, True, alone=True)
    shown = cv2.cvtColor(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), cv2.COLOR_BGRA2RGBA).astype(np.float64)
    z = studio.depth(camera, True)
    height = (camera.unproject(camera.pixel_centres(), behind) - place.at) @ place.axes[:, 2]
    hidden = (behind > 0) & (behind < BEFORE * z) & (height > HIGH * place.size)
    hidden &= ~surface
    hidden = cv2.morphologyEx(hidden.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3))) > 0  # rough depths have specks
    shown[..., 3] = np.where(hidden, 0, shown[..., 3] / 255)
    return shown, np.where(shown[..., 3] > 0.95, z, FAR)


def without_hidden(splats: Gaussians, cameras: list[Camera], hides: list[np.ndarray], place: Place) -> Gaussians:
    """What at least two photos show past the object of the splats round it."""
    seen, means = np.zeros(len(splats), int), splats.means.astype(np.float64)
    for camera, mask in zip(cameras, hides):
        uv, z = camera.project(means)
        framed = np.flatnonzero((z > 0) & (uv >= 0).all(1) & (uv < mask.shape[::-1]).all(1))
        col, row = uv[framed].astype(int).T
        seen[framed[~mask[row, col]]] += 1
    return splats.take((seen > 1) | (np.linalg.norm(means - place.at, axis=1) > 3 * place.size))


def make(scan: Scene, view: str, pixel: tuple[float, float], thing: str, size: float, folder: Path) -> None:
    """A scene's folder, whole."""
    views = {v.camera.id: v for v in scan.views}
    if view not in views:
        raise BadInput(f"{scan.folder} has no photo {view}: {', '.join(views)}")
    plane = support(scan)
    place = place_on(plane, views[view].camera, pixel, size)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    lit(0.9, 1.2, 8.0)
    parts = THINGS[thing]()
    region, studio = put_up(parts, place), Studio(parts)
    cameras, photos = [v.camera for v in scan.views], [v.image for v in scan.views]
    behind = [render(scan.gaussians, c, passes=frozenset({"depth"})).median_depth.astype(float) for c in cameras]
    round_it = Box(region.center, WIDE * region.size, region.rotation_wxyz)
    surfaces = may_show(scan.views, behind, plane, round_it)
    shown, depths = zip(*(cut_out(studio, c, place, z, s) for c, z, s in zip(cameras, behind, surfaces)))
    hides = [dilated(s[..., 3] > 0.02, 1) for s in shown]  # what it covers in part, too
    rng = np.random.default_rng(0)

    def with_object(k: int) -> np.ndarray:
        alpha = shown[k][..., 3:]
        mixed = photos[k] * (1 - alpha) + (shown[k][..., :3] + rng.normal(0, NOISE, photos[k].shape)) * alpha
        return np.clip(np.rint(mixed), 0, 255).astype(np.uint8)

    pictures, showing = (
        [with_object(k) for k in range(len(photos))],
        [k for k, h in enumerate(hides) if h.sum() > LEAST],
    )
    tests = showing[EVERY // 2 :: EVERY]
    if len(tests) < 2:
        raise BadInput(f"{len(showing)} photos show the object there: {2 * EVERY} are needed")
    train = [k for k in range(len(photos)) if k not in tests]
    others, saved = [(cameras[k], behind[k], hides[k]) for k in train], []
    for k, camera in enumerate(cameras):
        test = k in tests
        name = f"test/{tests.index(k):03d}.png" if test else f"images/{k:03d}.png"
        part = folder / "truth" / Path(name).with_suffix("")
        for path in (part, folder / name, folder / "images" / "x"):
            path.parent.mkdir(parents=True, exist_ok=True)
        points = camera.unproject(camera.pixel_centres(), behind[k]).reshape(-1, 3)
        write_png(part.with_suffix(".mask.png"), hides[k])
        unseen = hides[k] & ~shown_by_any(points, others, ROUGH).reshape(hides[k].shape)
        write_png(part.with_suffix(".unseen.png"), unseen)
        write_png(folder / name, photos[k] if test else pictures[k])
        if test:
            write_png(folder / "images" / f"with_test_{tests.index(k):03d}.png", pictures[k])
        saved.append(replace(camera, id=name, image=None, split="test" if test else "train"))
    learning = [cameras[k] for k in train], [pictures[k] for k in train]
    covered = max(1.0, float(np.mean([(depths[k] < FAR).mean() for k in train])))
    count = min(photos[0][..., 0].size, int(POINTS / covered)) * len(train)
    points = splats_of(*learning, [depths[k] for k in train], count, scan.gaussians.sh_degree)
    start = without_hidden(scan.gaussians, learning[0], [hides[k] for k in train], place).extended(points)
    write_gaussians(folder / "scene.ply", taught(start, *learning, STEPS), [f"made: {thing} in {scan.name}"])
    write_transforms(folder / "transforms.json", sorted(saved, key=lambda c: c.id))
    (folder / "roi.json").write_text(json.dumps(region.to_json(), indent=1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("scan", type=Path)
    parser.add_argument("view", help="a photo's name in transforms.json")
    parser.add_argument("x", type=float)
    parser.add_argument("y", type=float)
    parser.add_argument("--thing", choices=THINGS, default="pot")
    parser.add_argument("--size", type=float, default=0.15, help="its height over its distance from the view")
    parser.add_argument("--name", help="of the new scene; as the scan's and the thing's if none is given")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "made")
    given = parser.parse_args()
    name = given.name or f"{given.scan.name}_{given.thing}"
    try:
        scan = read_scene(given.scan)
        make(scan, given.view, (given.x, given.y), given.thing, given.size, given.out.resolve() / name)
    except BadInput as error:
        parser.error(str(error))
    print(f"made {name}", flush=True)


if __name__ == "__main__":
    main()

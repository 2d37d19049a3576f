"""Make the demo's scene: a room corner with a rug, books and balls, and a vase to remove. Deterministic, no training.

Writes assets/demo/scene.ply, transforms.json and roi.json. As in real scans, there are no splats on the rug under the
vase, where no camera looks. With --without-object the true scene goes to the given file, to compare with.

    python tools/make_demo_scene.py [--folder assets/demo] [--without-object FILE.ply]
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from functools import reduce
from pathlib import Path

import numpy as np

from gimp3d.box import Box
from gimp3d.camera import Camera
from gimp3d.gaussians import SH_C0, Gaussians, matrices_to_quats
from gimp3d.io.cameras import write_transforms
from gimp3d.io.ply import write_gaussians
from gimp3d.orbit import look_at

ROOM = 1.5  # m, half the floor's side
WALL = 1.3  # m, height
RUG = 0.62  # m, radius
VASE = np.array([0.05, -0.05, 0.0])  # where it stands
FOOT = 0.105  # m, radius of its foot
REGION = Box.make([VASE[0], VASE[1], 0.2], [0.44, 0.44, 0.44])  # cuts 2 cm into the floor, as users' boxes do
LIGHT = np.array([0.45, -0.5, 0.74])
SIZE, FOV, VIEWS, TESTS = (480, 270), 55.0, 24, 4


def noise(x: np.ndarray, y: np.ndarray, seed: int) -> np.ndarray:
    """Smooth value noise in [0, 1]: three octaves of random waves."""
    rng = np.random.default_rng(seed)
    total = np.zeros_like(x)
    for octave in range(3):
        for _ in range(4):
            angle, phase = rng.uniform(0, 2 * np.pi, 2)
            scale = 4.0 * 2**octave * rng.uniform(0.7, 1.4)
            total += np.sin(scale * (np.cos(angle) * x + np.sin(angle) * y) + phase) / 2**octave
    return np.clip(0.5 + total / 10, 0, 1)


def mix(a: tuple[float, ...], b: tuple[float, ...], t: np.ndarray) -> np.ndarray:
    """Colours [N, 3] between a and b."""
    return np.array(a) * (1 - t[:, None]) + np.array(b) * t[:, None]


def wood(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Planks along x with grain and dark joints."""
    plank = np.floor(y / 0.18)
    shift = np.sin(plank * 12.9898) * 3
    grain = noise(0.35 * x + shift, 3.2 * y + plank, 1)
    colour = mix((0.46, 0.29, 0.17), (0.72, 0.52, 0.34), 0.25 + 0.7 * grain)
    joint = (np.abs(y / 0.18 - np.round(y / 0.18)) < 0.035) | (np.abs((x + shift) % 1.1 - 0.55) < 0.006)
    return np.where(joint[:, None], 0.45 * colour, colour)


def rug(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Rings and petals, so that a wrong fill shows."""
    radius, angle = np.hypot(x, y) / RUG, np.arctan2(y, x)
    ring = 0.5 + 0.5 * np.sin(26 * radius + 1.2 * np.cos(8 * angle))
    colour = mix((0.62, 0.14, 0.16), (0.93, 0.84, 0.66), np.clip(3 * ring - 1, 0, 1))
    blue = np.clip(8 * (np.abs(radius - 0.62) < 0.1) * (np.cos(16 * angle) * 0.5 + 0.5) - 3, 0, 1)
    colour = colour * (1 - blue[:, None]) + np.array([0.16, 0.27, 0.45]) * blue[:, None]
    return colour * (0.9 + 0.2 * noise(9 * x, 9 * y, 2))[:, None]


def splat(points: np.ndarray, normals: np.ndarray, colours: np.ndarray, step: float) -> Gaussians:
    """Thin discs on a surface, lit by one lamp and the sky."""
    n = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    lit = 0.62 + 0.45 * np.clip(n @ (LIGHT / np.linalg.norm(LIGHT)), 0, 1)
    colours = colours * lit[:, None]
    helper = np.where(np.abs(n[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    a = np.cross(helper, n)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    frames = np.stack([a, np.cross(n, a), n], axis=-1)
    scales = np.tile(np.log([0.62 * step, 0.62 * step, 0.06 * step]), (len(points), 1))
    return Gaussians(
        means=points.astype(np.float32),
        log_scales=scales.astype(np.float32),
        quats=matrices_to_quats(frames).astype(np.float32),
        opacity_logits=np.full(len(points), 3.9, np.float32),
        sh=((np.clip(colours, 0, 1) - 0.5) / SH_C0)[:, None].astype(np.float32),
    )


def grid(
    low: float, high: float, step: float, other: tuple[float, float] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Centres of square cells, as two flat arrays."""
    second = other or (low, high)
    a, b = np.arange(low + step / 2, high, step), np.arange(second[0] + step / 2, second[1], step)
    x, y = np.meshgrid(a, b)
    return x.ravel(), y.ravel()


def floor(under_the_vase: bool) -> Gaussians:
    """Planks outside, the finer rug inside."""
    x, y = grid(-ROOM, ROOM, 0.022)
    outside = np.hypot(x, y) > RUG - 0.01
    x, y = x[outside], y[outside]
    shadow = ambient(x, y)[:, None]
    up = np.tile([0, 0, 1.0], (len(x), 1))
    planks = splat(np.stack([x, y, 0 * x], -1), up, wood(x, y) * shadow, 0.022)
    x, y = grid(-RUG, RUG, 0.0098)
    inside = np.hypot(x, y) < RUG
    if not under_the_vase:
        inside &= np.hypot(x - VASE[0], y - VASE[1]) > FOOT
    x, y = x[inside], y[inside]
    up = np.tile([0, 0, 1.0], (len(x), 1))
    return planks.extended(splat(np.stack([x, y, 0 * x + 0.004], -1), up, rug(x, y) * ambient(x, y)[:, None], 0.0098))


def ambient(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Darker towards the walls and under the other things (the vase casts no shadow)."""
    light = 1 - 0.3 * np.exp(-(ROOM - x) / 0.2) - 0.3 * np.exp(-(ROOM - y) / 0.2)
    for cx, cy, reach in ((0.78, 0.5, 0.22), (-0.62, 0.75, 0.2), (0.75, -0.55, 0.2), (-0.75, -0.45, 0.25)):
        light *= 1 - 0.35 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * reach**2) * 1.4)
    return light


def walls() -> Gaussians:
    """Two walls behind: painted below, patterned paper above."""
    u, v = grid(-ROOM, ROOM, 0.03, (0.0, WALL))
    paper = mix((0.80, 0.83, 0.78), (0.67, 0.74, 0.71), np.clip(4 * (np.sin(18 * u) * np.sin(18 * v)) - 1, 0, 1))
    panel = mix((0.36, 0.47, 0.47), (0.42, 0.53, 0.52), noise(3 * u, 3 * v, 3))
    edge = np.abs(v - 0.46) < 0.025
    colour = np.where(v[:, None] < 0.46, panel, paper)
    colour = np.where(edge[:, None], [0.93, 0.91, 0.86], colour) * (1 - 0.3 * np.exp(-v / 0.15))[:, None]
    back = splat(np.stack([u, 0 * u + ROOM, v], -1), np.tile([0, -1.0, 0], (len(u), 1)), colour, 0.03)
    side = splat(np.stack([0 * u + ROOM, u, v], -1), np.tile([-1.0, 0, 0], (len(u), 1)), colour * 0.93, 0.03)
    return back.extended(side)


def ball(
    centre: tuple[float, float, float], radius: float, colours: tuple[tuple[float, ...], tuple[float, ...]]
) -> Gaussians:
    """A striped ball, Fibonacci points."""
    count = int(4 * math.pi * radius**2 / 0.0135**2)
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    n = np.stack([r * np.cos(angle), r * np.sin(angle), z], -1)
    stripes = np.clip(4 * np.sin(9 * (n[:, 2] + 0.35 * n[:, 0])) + 0.5, 0, 1)
    return splat(np.array(centre) + radius * n, n, mix(*colours, stripes), 0.0145)


def cuboid(
    centre: tuple[float, float, float], size: tuple[float, float, float], turn: float, colour: tuple[float, ...]
) -> Gaussians:
    """A book: five faces, pages on the long side."""
    c, s = math.cos(turn), math.sin(turn)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    parts = []
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1), (2, 1)):
        a, b = (k for k in range(3) if k != axis)
        u, v = grid(-size[a] / 2, size[a] / 2, 0.013, (-size[b] / 2, size[b] / 2))
        local = np.zeros((len(u), 3))
        local[:, a], local[:, b], local[:, axis] = u, v, sign * size[axis] / 2
        normal = np.zeros(3)
        normal[axis] = sign
        pages = axis != 2 and not (axis == 1 and sign == -1)
        paint = (
            mix((0.9, 0.87, 0.78), (0.78, 0.74, 0.64), 0.5 + 0.5 * np.sin(400 * v))
            if pages
            else np.tile(colour, (len(u), 1))
        )
        normals = np.tile(rotation @ normal, (len(u), 1))
        parts.append(splat(np.array(centre) + local @ rotation.T, normals, paint, 0.014))
    return reduce(Gaussians.extended, parts)


def vase() -> Gaussians:
    """A surface of revolution with a glazed pattern: the thing to remove."""
    height = np.linspace(0, 0.36, 400)
    radius = (
        0.105
        + 0.06 * np.sin(np.pi * np.clip(height / 0.27, 0, 1)) ** 1.3
        - 0.06 * np.exp(-(((height - 0.31) / 0.045) ** 2))
    )
    slope = np.gradient(radius, height)
    points, normals, colours = [], [], []
    travelled = np.concatenate([[0], np.cumsum(np.hypot(np.diff(height), np.diff(radius)))])
    for level in np.arange(0.004, travelled[-1], 0.0115):
        h, r, d = (np.interp(level, travelled, a) for a in (height, radius, slope))
        count = max(12, int(2 * math.pi * r / 0.0115))
        angle = 2 * np.pi * (np.arange(count) + 0.5 * (len(points) % 2)) / count
        points.append(np.stack([r * np.cos(angle), r * np.sin(angle), np.full(count, h)], -1))
        normals.append(np.stack([np.cos(angle), np.sin(angle), np.full(count, -d)], -1))
        swirl = np.clip(3 * np.sin(5 * angle + 22 * h) + 0.5, 0, 1)
        band = ((h > 0.05) & (h < 0.27)) * swirl
        colours.append(mix((0.10, 0.47, 0.50), (0.96, 0.70, 0.22), band))
    return splat(np.concatenate(points) + VASE, np.concatenate(normals), np.concatenate(colours), 0.0125)


def scene(with_object: bool) -> Gaussians:
    """The room with the vase (and nothing under it), or the whole room without."""
    things = [
        floor(under_the_vase=not with_object),
        walls(),
        ball((0.78, 0.5, 0.16), 0.16, ((0.85, 0.32, 0.20), (0.97, 0.88, 0.70))),
        ball((-0.62, 0.75, 0.11), 0.11, ((0.20, 0.38, 0.62), (0.90, 0.90, 0.88))),
        cuboid((0.75, -0.55, 0.03), (0.34, 0.25, 0.06), 0.4, (0.20, 0.42, 0.33)),
        cuboid((0.76, -0.54, 0.085), (0.28, 0.21, 0.05), 0.9, (0.72, 0.22, 0.22)),
        cuboid((-0.75, -0.45, 0.09), (0.16, 0.36, 0.18), -0.5, (0.83, 0.63, 0.26)),
    ]
    return reduce(Gaussians.extended, [*things, vase()] if with_object else things)


def cameras() -> tuple[Camera, ...]:
    """Training views from three heights on the open sides of the room, and test views between them."""
    focal = 0.5 * SIZE[0] / math.tan(math.radians(FOV) / 2)
    found = []
    for k in range(VIEWS + TESTS):
        test = k >= VIEWS
        turn = (k - VIEWS + 0.5) / TESTS if test else k / (VIEWS - 1)
        angle = math.radians(-172 + 164 * turn)  # the walls are at +x and +y
        height, distance = ((0.75, 1.5), (1.15, 1.45), (1.6, 1.2))[k % 3]
        eye = np.array([distance * math.cos(angle), distance * math.sin(angle), height])
        if test:
            eye = eye * [1.05, 1.05, 0.93]
        pose = look_at(eye, np.array([0.05, 0.05, 0.12]), np.array([0, 0, 1.0]))
        name = f"test/{k - VIEWS:03d}.png" if test else f"train/{k:03d}.png"
        w, h = SIZE
        found.append(Camera(name, w, h, focal, focal, w / 2, h / 2, pose, "test" if test else "train"))
    return tuple(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, default=Path(__file__).resolve().parents[1] / "assets" / "demo")
    parser.add_argument("--without-object", type=Path, metavar="FILE.ply")
    given = parser.parse_args()
    note = ["made by tools/make_demo_scene.py"]
    if given.without_object:
        write_gaussians(given.without_object, scene(with_object=False), note)
        return
    write_gaussians(given.folder / "scene.ply", scene(with_object=True), note)
    write_transforms(given.folder / "transforms.json", [replace(c, image=None) for c in cameras()])
    (given.folder / "roi.json").write_text(json.dumps(REGION.to_json(), indent=1))


if __name__ == "__main__":
    main()

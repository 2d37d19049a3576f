"""Scenes with and without an object, rendered by Cycles and trained: places where removals may fail, with the truth.

    python tools/make_scenes.py [NAME …] [--out build/made]

Each takes about six minutes on 2 cores, is the same every time (but for rare single grey levels, as Cycles rounds) and
a folder as `gimp3d bench` reads it: training photos with the object, test views without, masks of what the object hides
and of what no training view sees of that, and splats that were trained on the photos from what their depths show. All
benchmarks take the folder as DATA.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

os.environ["BLENDER_USER_RESOURCES"] = tempfile.mkdtemp(prefix="gimp3d-scenes-")  # the user's own Blender stays

import bpy
import cv2
import mathutils
import numpy as np
from bpy.types import Material, Object
from scipy.spatial import cKDTree

from gimp3d.box import Box
from gimp3d.camera import Camera
from gimp3d.gaussians import SH_C0, Gaussians
from gimp3d.geometry import sees
from gimp3d.io.cameras import write_transforms
from gimp3d.io.images import read_image, write_png
from gimp3d.io.ply import write_gaussians
from gimp3d.orbit import look_at
from gimp3d.stages.refine import Observation, RefineSettings, refine_gaussians

ROOT = Path(__file__).resolve().parents[1]
SIZE, FOCAL = (480, 270), 426.7
TRAIN, TEST = 36, 6
SAMPLES = 32  # rays per pixel
POINTS, STEPS, DEGREE = 60_000, 2_500, 1  # of the splats: how many, how long they are trained, of their colours
FAR = 60.0  # m, where nothing is


@dataclass(frozen=True)
class Made:
    """What is built, and from where it is seen."""

    thing: list[Object]  # what is removed
    region: Box
    target: tuple[float, float, float]
    distance: float
    elevations: tuple[float, float]  # degrees, from the lowest to the highest of three rows of views
    azimuths: tuple[float, float]  # degrees
    casts: bool = False  # shadows and bounced light, as things do in life


# ------------------------------------------------------------------------------------------------------------ building


def paint(
    kind: str, scale: float, *colours: str, stretch: tuple[float, ...] = (1, 1, 1), rough: float = 0.8
) -> Material:
    """A material: a texture node's value, in metres times `scale`, to colours '#rrggbb' at even steps."""
    material = bpy.data.materials.new(kind)
    nodes, links = material.node_tree.nodes, material.node_tree.links
    shader = nodes["Principled BSDF"]
    shader.inputs["Roughness"].default_value = rough
    place, mapping = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeMapping")
    mapping.inputs["Scale"].default_value = [scale * s for s in stretch]
    links.new(place.outputs["Object"], mapping.inputs["Vector"])
    if kind == "plain":
        shader.inputs["Base Color"].default_value = rgba(colours[0])
        return material
    texture = nodes.new(f"ShaderNodeTex{kind}")
    links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
    if kind == "Brick":
        for name, colour in zip(("Color1", "Color2", "Mortar"), colours):
            texture.inputs[name].default_value = rgba(colour)
        texture.inputs["Scale"].default_value, texture.inputs["Mortar Size"].default_value = 1.0, 0.02
        texture.inputs["Brick Width"].default_value, texture.inputs["Row Height"].default_value = 0.5, 0.25
        colour = texture.outputs["Color"]
    else:
        texture.inputs["Scale"].default_value = 1.0
        if kind == "Wave":
            texture.inputs["Distortion"].default_value, texture.inputs["Detail"].default_value = 3.0, 3.0
        if kind == "Noise":
            texture.inputs["Detail"].default_value = 6.0
        ramp = nodes.new("ShaderNodeValToRGB")
        steps = ramp.color_ramp.elements
        low, high = (0.3, 0.7) if kind == "Noise" else (0.0, 1.0)
        while len(steps) < len(colours):
            steps.new(0.5)
        for k, (step, value) in enumerate(zip(steps, colours)):
            step.position, step.color = low + (high - low) * k / (len(colours) - 1), rgba(value)
        links.new(texture.outputs["Distance" if kind == "Voronoi" else 0], ramp.inputs["Fac"])
        colour = ramp.outputs["Color"]
    links.new(colour, shader.inputs["Base Color"])
    return material


def rgba(colour: str) -> tuple[float, ...]:
    """'#rrggbb' in sRGB as Blender's linear RGBA."""
    values = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    return (*np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4), 1.0)


def solid(
    shape: str, at: Iterable[float], size: Iterable[float], material: Material, turn: float = 0.0, tilt: float = 0.0
) -> Object:
    """A cube, cylinder, ball (uv_sphere) or cone, `size` its edges; textures are in metres."""
    unit = {"cube": {"size": 1.0}, "cone": {"radius1": 0.5, "depth": 1.0}}.get(shape, {"radius": 0.5})
    getattr(bpy.ops.mesh, f"primitive_{shape}_add")(**unit)
    made = bpy.context.object
    if shape == "cylinder":
        made.scale = (1, 1, 0.5)
        bpy.ops.object.transform_apply(scale=True)
    made.scale = tuple(size)
    bpy.ops.object.transform_apply(scale=True)
    made.location, made.rotation_euler = tuple(at), (tilt, 0, turn)
    if shape != "cube":
        bpy.ops.object.shade_smooth()
    made.data.materials.append(material)
    return made


def lit(sky: float, sun: float, angle: float = 3.0) -> None:
    """Light from all sides, and a lamp high on the left."""
    world = bpy.data.worlds.new("sky")
    bpy.context.scene.world = world
    world.node_tree.nodes["Background"].inputs["Color"].default_value = rgba("#cfdbe8")
    world.node_tree.nodes["Background"].inputs["Strength"].default_value = sky
    lamp = bpy.data.lights.new("sun", "SUN")
    lamp.energy, lamp.angle = sun, math.radians(angle)
    held = bpy.data.objects.new("sun", lamp)
    held.rotation_euler = (math.radians(35), math.radians(-25), 0)
    bpy.context.collection.objects.link(held)


def wood(light: str = "#b98a5a", dark: str = "#6d4526") -> Material:
    """Wavy planks along x."""
    return paint("Wave", 5.0, dark, light, dark, light, stretch=(0.25, 2.0, 1.0))


def shelf() -> Made:
    """A vase on a board before a row of books."""
    lit(0.9, 1.5)
    solid("cube", (0, 0, -0.03), (2.4, 0.9, 0.06), wood())
    solid("cube", (0, 0.47, 0.5), (2.4, 0.04, 1.1), paint("Noise", 4.0, "#8a8f86", "#a9aea2"))
    rng = np.random.default_rng(3)
    colours = ["#8c2f2b", "#2d5a63", "#c9a24b", "#3f4a2e", "#7a4a7d", "#d8cfb8", "#274060", "#a3542c"]
    x = -1.15
    while x < 1.1:
        thick, high, deep = rng.uniform(0.05, 0.13), rng.uniform(0.38, 0.62), rng.uniform(0.26, 0.34)
        cover = paint("Noise", 30.0, *rng.choice(colours, 2, replace=False)) if rng.random() < 0.3 else None
        cover = cover or paint("plain", 1.0, str(rng.choice(colours)))
        book = (x + thick / 2, 0.44 - deep / 2, high / 2)
        solid("cube", book, (thick, deep, high), cover)
        if rng.random() < 0.6:
            band = paint("plain", 1.0, "#e2c779")
            solid("cube", (book[0], 0.44 - deep - 0.001, 0.75 * high), (thick, 0.004, 0.05), band)
        x += thick + 0.004
    glaze = paint("Wave", 9.0, "#20646a", "#e0c070", rough=0.3)
    body = solid("uv_sphere", (0.02, -0.08, 0.17), (0.3, 0.3, 0.34), glaze)
    neck = solid("cylinder", (0.02, -0.08, 0.38), (0.1, 0.1, 0.14), glaze)
    region = Box.make([0.02, -0.08, 0.215], [0.36, 0.36, 0.49])
    return Made([body, neck], region, (0.02, 0.05, 0.2), 1.7, (14, 42), (-145, -35))


def brick() -> Made:
    """A barrel on paving before a brick wall with a window, whose sill it touches in the picture."""
    lit(0.9, 2.0)
    paving = paint("Brick", 2.0, "#8d8a84", "#a39d92", "#5f5b55")
    solid("cube", (0, 0, -0.05), (7, 5, 0.1), paving)
    bricks = paint("Brick", 2.2, "#8f4a35", "#a86248", "#c9c0b2")
    solid("cube", (0, 1.55, 1.25), (7, 2.5, 0.1), bricks, tilt=math.pi / 2)
    solid("cube", (0.75, 1.48, 1.15), (0.9, 0.08, 0.9), paint("plain", 1.0, "#2c3a46", rough=0.3))
    frame = paint("plain", 1.0, "#e6e2d6")
    for at, size in (
        ((0.75, 1.47, 1.62), (1.04, 0.1, 0.07)),
        ((0.26, 1.47, 1.15), (0.07, 0.1, 0.9)),
        ((1.24, 1.47, 1.15), (0.07, 0.1, 0.9)),
        ((0.75, 1.47, 1.15), (0.05, 0.1, 0.9)),
        ((0.75, 1.43, 0.67), (1.16, 0.2, 0.07)),
    ):
        solid("cube", at, size, frame)
    staves = paint("Wave", 14.0, "#4a2f1c", "#8a5a32", stretch=(1, 1, 0.1))
    parts = [solid("cylinder", (0.35, 0.85, 0.4), (0.62, 0.62, 0.8), staves)]
    hoop = paint("plain", 1.0, "#33363a", rough=0.4)
    parts += [solid("cylinder", (0.35, 0.85, z), (0.645, 0.645, 0.05), hoop) for z in (0.12, 0.4, 0.68)]
    region = Box.make([0.35, 0.85, 0.41], [0.74, 0.74, 0.9])
    return Made(parts, region, (0.35, 1.0, 0.45), 3.4, (12, 45), (-150, -30))


def stairs() -> Made:
    """A lantern across two of four steps."""
    lit(1.0, 1.5)
    stone = paint("Noise", 9.0, "#77736b", "#a49d90", "#c0b8a8")
    for k in range(4):
        solid("cube", (0, 0.35 * k + 1.0, 0.18 * k - 0.41), (4, 2.0, 1.0), stone)
    solid("cube", (0, -1.2, -0.05), (6, 2.4, 0.1), paint("Brick", 3.0, "#7c7468", "#8c8478", "#54504a"))
    iron = paint("plain", 1.0, "#24282b", rough=0.4)
    glass = paint("Wave", 20.0, "#e0b95a", "#c98a34", rough=0.2)
    parts = [
        solid("cube", (0.1, 0.36, 0.205), (0.34, 0.3, 0.05), iron),
        solid("cube", (0.1, 0.36, 0.38), (0.24, 0.24, 0.3), glass),
        solid("cone", (0.1, 0.36, 0.6), (0.4, 0.4, 0.16), iron),
    ]
    region = Box.make([0.1, 0.36, 0.42], [0.46, 0.46, 0.56])
    return Made(parts, region, (0.1, 0.3, 0.3), 2.2, (18, 55), (-150, -30))


def edge() -> Made:
    """A box at a table's end, the floor 0.9 m below."""
    lit(1.0, 1.2)
    solid("cube", (0, 0, -0.95), (8, 8, 0.1), paint("Checker", 1.6, "#c9c4b8", "#6f7f86"))
    solid("cube", (-0.6, 0, -0.03), (1.6, 1.0, 0.06), wood("#caa06c", "#7d5330"))
    for x, y in ((-1.3, -0.4), (-1.3, 0.4), (0.1, -0.4), (0.1, 0.4)):
        solid("cube", (x, y, -0.48), (0.08, 0.08, 0.84), wood())
    pattern = paint("Voronoi", 9.0, "#b03a48", "#f0e4c8", "#2f4f6f")
    box = solid("cube", (0.02, -0.05, 0.14), (0.3, 0.26, 0.28), pattern, turn=0.4)
    region = Box.make([0.02, -0.05, 0.135], [0.42, 0.42, 0.33])
    return Made([box], region, (0.02, -0.05, 0.05), 1.8, (20, 60), (-180, 140))


def rug() -> Made:
    """A pot on a patterned rug, with its shadow."""
    lit(0.7, 2.2, 12.0)
    solid("cube", (0, 0, -0.05), (6, 6, 0.1), wood("#9a7350", "#5e3f28"))
    for size, colours in (
        ((1.7, 1.1), "#7a2430 #7a2430"),
        ((1.5, 0.9), "#c9b184 #8a6a48"),
        ((1.36, 0.76), "#7a2430 #9c4038"),
    ):
        solid("cube", (0, 0, 0.004 * (2.2 - size[0]) * 5), (*size, 0.012), paint("Noise", 60.0, *colours.split()))
    for x in np.linspace(-0.5, 0.5, 5):
        for y in (-0.2, 0.2):
            solid("cylinder", (x, y, 0.0225), (0.14, 0.14, 0.006), paint("Noise", 50.0, "#2f4f6f", "#27405a"))
            solid("cylinder", (x, y, 0.0265), (0.06, 0.06, 0.004), paint("plain", 1.0, "#d8c08a"))
    clay = paint("Noise", 6.0, "#a45a38", "#c47a50")
    parts = [
        solid("cylinder", (0.1, 0.05, 0.14), (0.26, 0.26, 0.24), clay),
        solid("uv_sphere", (0.1, 0.05, 0.36), (0.36, 0.36, 0.3), paint("Noise", 14.0, "#2e4a24", "#5f8a3c")),
    ]
    region = Box.make([0.1, 0.05, 0.265], [0.44, 0.44, 0.53])
    return Made(parts, region, (0.1, 0.05, 0.15), 2.1, (20, 58), (-180, 140), casts=True)


def cabinet() -> Made:
    """A cabinet that touches the wall, on planks, with a skirting board behind."""
    lit(1.0, 1.0)
    solid(
        "cube", (0, 0, -0.05), (6, 5, 0.1), paint("Wave", 3.0, "#8a6038", "#a87b4c", "#96703f", stretch=(0.2, 3.0, 1))
    )
    solid("cube", (0, 1.05, 1.2), (6, 0.1, 2.4), paint("Checker", 6.0, "#cdd6cf", "#bcc9c2"))
    solid("cube", (0, 0.985, 0.06), (6, 0.03, 0.12), paint("plain", 1.0, "#efece4"))
    body = solid("cube", (0, 0.72, 0.42), (0.7, 0.44, 0.8), wood("#54402e", "#33261b"))
    knobs = [
        solid("uv_sphere", (x, 0.49, 0.45), (0.05, 0.05, 0.05), paint("plain", 1.0, "#d0b060")) for x in (-0.1, 0.1)
    ]
    region = Box.make([0, 0.71, 0.42], [0.78, 0.54, 0.88])
    return Made([body, *knobs], region, (0, 0.7, 0.4), 2.9, (12, 45), (-150, -30))


def tiles() -> Made:
    """A clock on a wall of speckled tiles."""
    lit(1.0, 1.0)
    solid("cube", (0, 1.05, 0.8), (5, 0.1, 3.2), paint("Noise", 45.0, "#5d6a70", "#93a0a2", "#d6d8d0"))
    joint = paint("plain", 1.0, "#d9d4c8")
    for k in range(-6, 7):
        solid("cube", (0.4 * k, 0.999, 0.8), (0.014, 0.006, 3.2), joint)
        if -3 < k < 5:
            solid("cube", (0, 0.999, 0.4 * k + 0.5), (5, 0.006, 0.014), joint)
    solid("cube", (0, 0, -0.85), (6, 4, 0.1), wood())
    parts = [
        solid("cylinder", (0.05, 0.93, 0.95), (0.6, 0.6, 0.14), paint("plain", 1.0, "#b02a2a"), tilt=math.pi / 2),
        solid("cylinder", (0.05, 0.86, 0.95), (0.5, 0.5, 0.02), paint("plain", 1.0, "#f2ede0"), tilt=math.pi / 2),
        solid("cube", (0.05, 0.84, 1.02), (0.03, 0.02, 0.2), paint("plain", 1.0, "#202020")),
    ]
    region = Box.make([0.05, 0.93, 0.95], [0.7, 0.22, 0.7])
    return Made(parts, region, (0.05, 0.95, 0.9), 2.4, (0, 38), (-140, -40))


def dome() -> Made:
    """A cube on a large ball."""
    lit(1.0, 1.5)
    solid("cube", (0, 0, -0.65), (8, 8, 0.1), paint("Checker", 1.2, "#b8b09c", "#8f9a86"))
    solid("uv_sphere", (0, 0, -0.2), (1.2, 1.2, 0.8), paint("Noise", 8.0, "#3f6a74", "#d0b884", "#7c8f5c"))
    cube = solid(
        "cube", (0.05, -0.02, 0.28), (0.24, 0.24, 0.24), paint("Voronoi", 12.0, "#c04a38", "#f2e6cc"), turn=0.5
    )
    region = Box.make([0.05, -0.02, 0.28], [0.38, 0.38, 0.28])
    return Made([cube], region, (0.05, 0, 0.15), 2.0, (20, 60), (-180, 140))


def statue() -> Made:
    """A statue on a plinth whose top is hardly larger than the box."""
    lit(1.0, 1.5)
    solid("cube", (0, 0, -0.05), (9, 9, 0.1), paint("Brick", 2.0, "#a89c86", "#b8ac98", "#7c7466"))
    solid("cylinder", (0, 0, 0.25), (0.9, 0.9, 0.5), paint("Noise", 12.0, "#8d8d88", "#b8b6ae", "#6f6f6c"))
    for k in range(7):
        at = (2.6 * math.cos(0.9 * k + 0.4), 2.6 * math.sin(0.9 * k + 0.4), 0.5)
        solid("uv_sphere", at, (0.9, 0.9, 1.0), paint("Noise", 9.0, "#27401f", "#4f7a35"))
    bronze = paint("Noise", 5.0, "#5a4a2c", "#8a7440", rough=0.3)
    parts = [
        solid("cone", (0, 0, 0.86), (0.5, 0.5, 0.72), bronze),
        solid("uv_sphere", (0, 0, 1.2), (0.28, 0.28, 0.34), bronze),
        solid("cube", (0.2, 0, 0.95), (0.5, 0.08, 0.08), bronze, turn=0.6),
    ]
    return Made(parts, Box.make([0.05, 0, 0.95], [0.9, 0.7, 0.92]), (0, 0, 0.6), 3.2, (12, 45), (-180, 140))


def blanket() -> Made:
    """A basket on the corner of a checked blanket, which lies 1 cm above grass."""
    lit(1.0, 1.5)
    solid("cube", (0, 0, -0.05), (8, 8, 0.1), paint("Noise", 40.0, "#33511f", "#5b7d33", "#88a050"))
    solid("cube", (0.35, 0.3, 0.004), (1.4, 1.0, 0.012), paint("Checker", 14.0, "#b03038", "#efe9dc"), turn=0.35)
    wicker = paint("Wave", 25.0, "#7a5230", "#b58a54", stretch=(1, 1, 3))
    parts = [
        solid("cube", (-0.12, -0.12, 0.13), (0.42, 0.3, 0.22), wicker, turn=0.2),
        solid("cylinder", (-0.12, -0.12, 0.3), (0.05, 0.05, 0.16), wicker),
    ]
    region = Box.make([-0.12, -0.12, 0.185], [0.56, 0.46, 0.42])
    return Made(parts, region, (-0.1, -0.1, 0.1), 2.0, (22, 58), (-180, 140))


def kerb() -> Made:
    """A van at a kerb, in hard sun: its shadow falls over the kerb and across two levels."""
    lit(0.6, 3.0, 1.5)
    solid("cube", (0, -1.5, -0.05), (8, 3, 0.1), paint("Noise", 30.0, "#3c3d40", "#55565a"))
    solid("cube", (0, 1.5, 0.03), (8, 3, 0.1), paint("Brick", 3.0, "#8f8a82", "#a29c92", "#6a665f"))
    solid("cube", (0, 0.06, 0.045), (8, 0.14, 0.13), paint("plain", 1.0, "#b9b5ac"))
    solid("cube", (0, -0.9, 0.001), (8, 0.12, 0.004), paint("plain", 1.0, "#e8e4d8"))
    rubber = paint("plain", 1.0, "#202124", rough=0.6)
    parts = [
        solid("cube", (0, -0.55, 0.28), (0.9, 0.5, 0.26), paint("plain", 1.0, "#d8a020", rough=0.3)),
        solid("cube", (0, -0.55, 0.5), (0.5, 0.44, 0.22), paint("plain", 1.0, "#2c3a46", rough=0.2)),
    ]
    wheels = [(x, y, 0.1) for x in (-0.28, 0.28) for y in (-0.78, -0.32)]
    parts += [solid("cylinder", at, (0.2, 0.2, 0.08), rubber, tilt=math.pi / 2) for at in wheels]
    region = Box.make([0, -0.55, 0.3], [1.0, 0.64, 0.64])
    return Made(parts, region, (0, -0.5, 0.15), 3.0, (18, 52), (-180, 140), casts=True)


def crowd() -> Made:
    """A shaker among six things that nearly touch it."""
    lit(1.0, 1.2)
    solid("cube", (0, 0, -0.03), (2.2, 1.4, 0.06), wood("#d0b890", "#a88a60"))
    solid("cube", (0, 0, -0.9), (8, 8, 0.1), paint("Checker", 2.0, "#777777", "#999999"))
    rng = np.random.default_rng(5)
    colours = "#b03a48", "#2f4f6f", "#d8c08a", "#4a7a54", "#7a4a7d", "#c97f3a"
    for k, (angle, colour) in enumerate(zip(np.linspace(0, 2 * math.pi, 7), colours)):
        high = rng.uniform(0.12, 0.3)
        at = (0.26 * math.cos(angle), 0.26 * math.sin(angle), high / 2)
        shape = ("cylinder", "cube", "cone")[k % 3]
        solid(shape, at, (0.16, 0.16, high), paint("Voronoi", 14.0, colour, "#efe9dc"), turn=angle)
    parts = [
        solid("cylinder", (0, 0, 0.14), (0.16, 0.16, 0.28), paint("Wave", 20.0, "#e0d8c8", "#303840")),
        solid("uv_sphere", (0, 0, 0.31), (0.14, 0.14, 0.12), paint("plain", 1.0, "#c03030", rough=0.3)),
    ]
    return Made(parts, Box.make([0, 0, 0.185], [0.22, 0.22, 0.41]), (0, 0, 0.12), 1.7, (20, 55), (-180, 140))


SCENES: dict[str, Callable[[], Made]] = {
    f.__name__: f for f in (shelf, brick, stairs, edge, rug, cabinet, tiles, dome, statue, blanket, kerb, crowd)
}

# ----------------------------------------------------------------------------------------------------------- rendering


def cameras(made: Made) -> list[Camera]:
    """Training views on three rows, and test views between them; the first of those is the protocol's reference."""
    found = []
    low, high = made.elevations
    for k in range(TRAIN + TEST):
        test, turn = k >= TRAIN, k / (TRAIN - 1)
        if test:
            turn = (k - TRAIN + 0.5) / TEST
        rise = math.radians(low + (high - low) * ((0.3, 0.7)[k % 2] if test else (k % 3) / 2))
        azimuth = math.radians(made.azimuths[0] + (made.azimuths[1] - made.azimuths[0]) * turn)
        away = np.array([math.cos(rise) * math.cos(azimuth), math.cos(rise) * math.sin(azimuth), math.sin(rise)])
        pose = look_at(made.target + made.distance * away, np.array(made.target), np.array([0, 0, 1.0]))
        name = f"test/{k - TRAIN:03d}.png" if test else f"images/{k:03d}.png"
        found.append(Camera(name, *SIZE, FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2, pose, "test" if test else "train"))
    return found


class Studio:
    """Cycles, set up for photos or for depths."""

    def __init__(self, thing: list[Object], casts: bool = False) -> None:
        self.thing, self.folder = thing, Path(tempfile.mkdtemp(prefix="gimp3d-depth-"))
        scene = self.scene = bpy.context.scene
        scene.render.engine, scene.cycles.seed = "CYCLES", 1
        scene.render.use_persistent_data = True
        scene.render.resolution_percentage = 100
        scene.cycles.use_denoising = True
        scene.cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
        scene.view_settings.view_transform = "Standard"
        lens = bpy.data.cameras.new("camera")
        lens.sensor_fit, lens.sensor_width = "HORIZONTAL", 36.0
        self.camera = scene.camera = bpy.data.objects.new("camera", lens)
        bpy.context.collection.objects.link(self.camera)
        for one in thing if not casts else ():
            one.visible_shadow = one.visible_diffuse = one.visible_glossy = one.visible_transmission = False
        self.z = bpy.data.materials.new("z")
        nodes, links = self.z.node_tree.nodes, self.z.node_tree.links
        seen, glow = nodes.new("ShaderNodeCameraData"), nodes.new("ShaderNodeEmission")
        links.new(seen.outputs["View Z Depth"], glow.inputs["Color"])
        links.new(glow.outputs["Emission"], nodes["Material Output"].inputs["Surface"])

    def photo(self, camera: Camera, path: Path, with_object: bool, alone: bool = False) -> None:
        """A picture, as PNG; with nothing behind it, transparent, if it is to be the object alone."""
        self._set(depth=False, clear=alone)
        self._shoot(camera, path, with_object)

    def depth(self, camera: Camera, with_object: bool) -> np.ndarray:
        """[H, W] z-depth at pixel centres, FAR where nothing is."""
        self._set(depth=True, clear=True)
        path = self.folder / "z.exr"
        self._shoot(camera, path, with_object)
        picture = bpy.data.images.load(str(path))
        values = np.empty(4 * camera.width * camera.height, np.float32)
        picture.pixels.foreach_get(values)
        bpy.data.images.remove(picture)
        red, _, _, alpha = np.moveaxis(values.reshape(camera.height, camera.width, 4)[::-1], -1, 0)
        return np.where(alpha > 0.5, red, FAR)

    def _set(self, depth: bool, clear: bool) -> None:
        render = self.scene.render
        bpy.context.view_layer.material_override = self.z if depth else None
        self.scene.cycles.samples = 1 if depth else SAMPLES
        self.scene.cycles.use_denoising = not depth
        render.filter_size = 0.01 if depth else 1.5
        render.film_transparent = clear
        render.image_settings.file_format = "OPEN_EXR" if depth else "PNG"
        render.image_settings.color_mode = "RGBA" if clear else "RGB"
        render.image_settings.color_depth = "32" if depth else "8"

    def _shoot(self, camera: Camera, path: Path, with_object: bool) -> None:
        for one in self.thing:
            one.hide_render = not with_object
        render, lens, wide = self.scene.render, self.camera.data, camera.width
        render.resolution_x, render.resolution_y = wide, camera.height
        lens.lens = 36.0 * camera.fx / wide
        lens.shift_x, lens.shift_y = (wide / 2 - camera.cx) / wide, (camera.cy - camera.height / 2) / wide
        pose = np.linalg.inv(camera.viewmat) @ np.diag([1.0, -1, -1, 1])
        self.camera.matrix_world = mathutils.Matrix(pose.tolist())
        render.filepath = str(path)
        bpy.ops.render.render(write_still=True)


def shown_by_any(
    points: np.ndarray, views: list[tuple[Camera, np.ndarray, np.ndarray]], tolerance: float = 0.01
) -> np.ndarray:
    """[N] bool: points [N, 3] that a view sees past the object: camera, depth without it, and where it is [H, W]."""
    return np.any([sees(camera, np.where(mask, 0, depth), points, tolerance) for camera, depth, mask in views], axis=0)


def make(name: str, folder: Path) -> None:
    """A scene's folder, whole."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    made = SCENES[name]()
    studio, views = Studio(made.thing, made.casts), cameras(made)
    train = [c for c in views if c.split == "train"]
    kernel = np.ones((3, 3), np.uint8)  # what it covers in part, too
    bare = {c.id: studio.depth(c, False) for c in views}
    full = {c.id: studio.depth(c, True) for c in views}
    hides = {i: cv2.dilate((full[i] < bare[i] * (1 - 1e-4)).astype(np.uint8), kernel) > 0 for i in bare}
    others = [(c, bare[c.id], hides[c.id]) for c in train]
    for camera in views:
        part = folder / "truth" / Path(camera.id).with_suffix("")
        part.parent.mkdir(parents=True, exist_ok=True)
        mask, z = hides[camera.id], bare[camera.id]
        points = camera.unproject(camera.pixel_centres(), z).reshape(-1, 3)
        seen = shown_by_any(points, others).reshape(mask.shape)
        write_png(part.with_suffix(".mask.png"), mask)
        write_png(part.with_suffix(".unseen.png"), mask & ~seen & (z < FAR))
        test = camera.split == "test"
        if test:
            np.save(part.with_suffix(".depth.npy"), z.astype(np.float16))
            studio.photo(camera, folder / "images" / f"with_test_{Path(camera.id).stem}.png", True)
        studio.photo(camera, folder / camera.id, not test)
    photos = [read_image(folder / c.id) for c in train]
    write_gaussians(folder / "scene.ply", trained(train, photos, [full[c.id] for c in train]), [f"made: {name}"])
    write_transforms(folder / "transforms.json", [replace(c, image=None) for c in views])
    (folder / "roi.json").write_text(json.dumps(made.region.to_json(), indent=1))


def trained(train: list[Camera], photos: list[np.ndarray], depths: list[np.ndarray]) -> Gaussians:
    """Splats of the photos, from points that their depths show."""
    return taught(splats_of(train, photos, depths, POINTS, DEGREE), train, photos, STEPS)


def splats_of(
    cameras: list[Camera], photos: list[np.ndarray], depths: list[np.ndarray], count: int, degree: int
) -> Gaussians:
    """Round splats at about so many points that depths [H, W] show, in the photos' colours; FAR shows nothing."""
    rng = np.random.default_rng(0)
    means, colours = [], []
    for camera, photo, depth in zip(cameras, photos, depths):
        at = rng.choice(depth.size, count // len(cameras), replace=False)
        at = at[depth.ravel()[at] < FAR]
        means.append(camera.unproject(camera.pixel_centres().reshape(-1, 2)[at], depth.ravel()[at]))
        colours.append(photo.reshape(-1, 3)[at] / 255)
    points, colour = np.concatenate(means).astype(np.float32), np.concatenate(colours)
    near, _ = cKDTree(points).query(points, k=4)
    sh = np.zeros((len(points), (degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (colour - 0.5) / SH_C0
    sizes = np.log(np.clip(near[:, 1:].mean(1), 1e-4, None)).astype(np.float32)
    quats = np.tile(np.float32([1, 0, 0, 0]), (len(points), 1))
    return Gaussians(points, np.tile(sizes[:, None], (1, 3)), quats, np.full(len(points), 1.0, np.float32), sh)


def taught(start: Gaussians, cameras: list[Camera], photos: list[np.ndarray], steps: int) -> Gaussians:
    """Splats as photos teach them: 3DGS's loss and Adam, no densification."""
    whole = np.ones(photos[0].shape[:2], bool)
    shown = [Observation(c, p, whole, whole.astype(np.float32)) for c, p in zip(cameras, photos)]
    for k in range(4, len(shown) + len(shown) // 8, 8):
        shown.insert(k, shown[k])  # refinement learns from all but every eighth view: those are there twice
    settings = RefineSettings(steps=steps, views=len(shown), check=max(1, steps // 5), patience=steps)
    return refine_gaussians(start.take(np.arange(0)), start, shown, settings, margin=0, progress=told).gaussians


def told(_: str, done: int, of: int, words: str) -> None:
    print(f"  trained {done} of {of} steps: {words}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(SCENES)}; all if none is given")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "made")
    given = parser.parse_args()
    if unknown := set(given.names) - set(SCENES):
        parser.error(f"no scene is called {', '.join(sorted(unknown))}: {', '.join(SCENES)}")
    for name in given.names or SCENES:
        make(name, given.out.resolve() / name)
        print(f"made {name}", flush=True)


if __name__ == "__main__":
    main()

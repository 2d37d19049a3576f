"""A room that is computed, not rendered: a floor of two materials, one of them glossy, a post, and a ball to remove.

Every view's picture, depth and what lies behind the ball are exact, at any resolution.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gimp3d.camera import Camera
from gimp3d.stages.mapping import MappingSettings, mapping_field, source_visibility
from gimp3d.stages.propagate import Reference, ViewToPaint

BALL, POST = 0.325, 0.05  # radii
BALL_HEIGHT = 0.05  # of its centre: it is half sunk, so that views from all sides have much of the floor in common
POST_AT, POST_HEIGHT = np.array([0.6, 0.0]), 0.7
DISTANCE, ELEVATION = 3.1, np.radians(50)
LIGHT = np.array([0.5, 0.2, 0.84])
GLOSS, SHARPNESS = 110.0, 6.0  # grey levels at the highlight's centre; exponent of its lobe
NOISE = 0.0003  # of depths, relative, one standard deviation: splats' surfaces are not smooth
FOCAL = 1.15  # over the width: the ball covers 8 % of the picture


@dataclass(frozen=True)
class Shot:
    """A view with and without the ball."""

    view: ViewToPaint
    truth: np.ndarray  # [H, W, 3] uint8, without the ball


def camera_at(turn: float, width: int, height: int) -> Camera:
    """A camera on a circle round the ball, `turn` in radians."""
    level = np.array([np.cos(turn), np.sin(turn), 0.0])
    centre = DISTANCE * (np.cos(ELEVATION) * level + np.sin(ELEVATION) * np.array([0, 0, 1.0]))
    forward = np.array([0, 0, 0.1]) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [right, np.cross(forward, right), forward]
    viewmat[:3, 3] = -viewmat[:3, :3] @ centre
    focal = FOCAL * width
    return Camera(f"turn_{turn:.4f}", width, height, focal, focal, width / 2, height / 2, viewmat)


def shoot(turn: float, width: int, height: int, gain: float = 1.0) -> Shot:
    """The view at `turn`; `gain` is its exposure."""
    camera = camera_at(turn, width, height)
    rays = camera.unproject(camera.pixel_centres(), np.ones((height, width))) - camera.centre
    floor = _to_floor(camera.centre, rays)
    post, post_shade = _to_post(camera.centre, rays)
    ball = _to_ball(camera.centre, rays)
    behind = np.minimum(floor, post)
    ground = camera.centre + rays * np.where(np.isfinite(floor), floor, 1.0)[..., None]
    colours = np.where(
        (post < floor)[..., None],
        post_shade[..., None] * np.array([205, 170, 90.0]),
        np.where(np.isfinite(floor)[..., None], _floor_colours(ground, rays), [150, 170, 200.0]),
    )
    truth = np.clip(np.rint(gain * colours), 0, 255).astype(np.uint8)
    hidden = ball < behind
    up = np.clip((camera.centre[2] + rays[..., 2] * ball - BALL_HEIGHT) / BALL, -1, 1)
    red = np.where(hidden, 120 + 80 * np.where(np.isfinite(up), up, 0), 0)[..., None] * np.array([1, 0.25, 0.2])
    photo = np.where(hidden[..., None], np.clip(gain * red, 0, 255), truth).astype(np.uint8)
    noise = 1 + NOISE * np.random.default_rng(int(1e4 * turn)).normal(size=floor.shape)
    new, before = (
        (np.where(np.isfinite(d), d, 0) * noise).astype(np.float32) for d in (behind, np.minimum(ball, behind))
    )
    base = np.where(hidden[..., None], 0, photo).astype(np.uint8)
    return Shot(ViewToPaint(camera, photo, base, hidden, hidden & (new > 0), before, new), truth)


def reference_of(shot: Shot, others: list[Shot]) -> Reference:
    """The true picture of a view as the completed reference, with its mapping field."""
    view = shot.view
    source = ~view.silhouette & (view.depth_new > 0)
    visibility = source_visibility(
        view.camera, view.depth_new, [(o.view.camera, o.view.depth_before, o.view.silhouette) for o in others]
    )
    field = mapping_field(shot.truth, view.target, source, visibility, MappingSettings())
    return Reference(view.camera, shot.truth, view.depth_new, view.target, source, field.rows, field.cols)


def loaders(shots: list[Shot], count: int) -> list[Callable[[], ViewToPaint]]:
    """`count` views that come into memory when they are asked for: copies of the shots, over and over."""

    def load(k: int) -> ViewToPaint:
        view = shots[k % len(shots)].view
        arrays = {
            name: getattr(view, name).copy()
            for name in ("image", "base", "silhouette", "target", "depth_before", "depth_new")
        }
        return ViewToPaint(replace(view.camera, id=f"{k:04d}"), **arrays)

    return [lambda k=k: load(k) for k in range(count)]  # type: ignore[misc]


def _to_floor(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """z-depth of the floor z = 0 within 4 units of the ball, inf elsewhere; rays have z-depth 1."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = -origin[2] / rays[..., 2]
        away = np.linalg.norm((origin + rays * t[..., None])[..., :2], axis=-1)
    return np.where((t > 0) & (away < 4), t, np.inf)


def _to_post(origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """z-depth and shade of an upright cylinder."""
    offset = origin[:2] - POST_AT
    a = (rays[..., :2] ** 2).sum(-1)
    b = (rays[..., :2] * offset).sum(-1)
    root = b * b - a * (offset @ offset - POST**2)
    with np.errstate(invalid="ignore"):
        t = (-b - np.sqrt(root)) / a
        height = origin[2] + rays[..., 2] * t
        shade = 0.6 + 0.4 * (offset[0] + rays[..., 0] * t) / POST
    return np.where((root > 0) & (t > 0) & (height > 0) & (height < POST_HEIGHT), t, np.inf), np.nan_to_num(shade)


def _to_ball(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    offset = origin - [0, 0, BALL_HEIGHT]
    a = (rays**2).sum(-1)
    b = (rays * offset).sum(-1)
    root = b * b - a * (offset @ offset - BALL**2)
    with np.errstate(invalid="ignore"):
        return np.where(root > 0, (-b - np.sqrt(root)) / a, np.inf)


def _floor_colours(points: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Matte light stone with glossy dark veins, [H, W, 3] grey levels."""
    x, y = points[..., 0], points[..., 1]
    vein = np.sin(7 * x + 2.2 * np.sin(3 * y)) * np.sin(6 * y + 1.7 * np.sin(4 * x + 1))
    dark = 1 / (1 + np.exp(-12 * (vein - 0.15)))
    grain = 8 * np.sin(41 * x + 3 * np.sin(17 * y)) * np.sin(37 * y)
    stone = np.array([196, 184, 166.0]) + grain[..., None]
    ore = np.array([66, 72, 84.0]) + 0.5 * grain[..., None]
    towards = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    mirrored = towards * [1, 1, -1]
    lobe = np.clip(mirrored @ (LIGHT / np.linalg.norm(LIGHT)), 0, 1) ** SHARPNESS
    return stone * (1 - dark[..., None]) + (ore + GLOSS * lobe[..., None]) * dark[..., None]

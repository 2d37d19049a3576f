"""The object's reflection in the surface that it stands on: what its mirror image adds to the light in photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from scipy.optimize import nnls

from ..box import Region
from ..camera import Camera
from ..compute.threads import parallel_map
from ..gaussians import Gaussians
from ..geometry import colours_at
from ..raster import render
from ..srgb import decoded, linear
from .charts.plane import Plane, extent
from .ground import Ground
from .light_search import EARNS, FITS, places_elsewhere
from .occluder import standing
from .witness import Says, Witness, ask, spread

MOST_VIEWS = 24
SEVERAL = 3  # photos that must show a place before they can be compared
ROUNDS = 8  # of reweighting
LEAST_NOISE = 0.003  # of linear light
MIRRORED = 0.3  # alpha of the mirror image from which it has to explain how photos differ
VISIBLE = 0.004  # of linear light: about one grey level


@dataclass(frozen=True)
class Reflection:
    """How a plane mirrors the object: the light of its image, and what it gives back where that is not.

    Both are of the same strength on all of the plane and from every side.
    """

    grounds: tuple[Ground, ...]  # first that which mirrors; the others may stand before it
    gaussians: Gaussians  # the object
    image: np.ndarray  # [3] share of the object's light that comes back, per channel
    elsewhere: np.ndarray  # [3] linear light that comes back beside its image
    explained: float  # share of what differs between photos, where the image is, that it explains
    confidence: float  # that share, less what chance explains
    reason: str

    def added(self, camera: Camera) -> np.ndarray:
        """[H, W, 3] float32 linear light that the mirror image adds to a view of the bare plane, or takes from it."""
        alpha, light = mirror_image(self.gaussians, self.grounds[0].plane, camera)
        return (light * self.image - alpha[..., None] * self.elsewhere).astype(np.float32)

    def facts(self) -> dict[str, Any]:
        """For the summary."""
        return {
            "found": True,
            "strength": [round(float(x), 3) for x in self.image],
            "elsewhere": [round(float(x), 3) for x in self.elsewhere],
            "explained": round(self.explained, 3),
            "confidence": round(self.confidence, 3),
        }


def mirror_image(gaussians: Gaussians, plane: Plane, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Alpha [H, W] and linear light times alpha [H, W, 3] of Gaussians seen in a plane mirror.

    A mirrored camera sees them from the other side of the plane, left and right exchanged.
    """
    across = 2 * (plane.normal @ plane.origin) * plane.normal
    exchanged = np.diag([-1.0, 1.0, 1.0])
    viewmat = np.eye(4)
    viewmat[:3, :3] = exchanged @ camera.R @ (np.eye(3) - 2 * np.outer(plane.normal, plane.normal))
    viewmat[:3, 3] = exchanged @ (camera.R @ across + camera.t)
    other = replace(camera, viewmat=viewmat, cx=camera.width - camera.cx)
    drawn = render(gaussians, other, passes=frozenset({"rgb"}))
    alpha, rgb = drawn.alpha[:, ::-1], drawn.rgb[:, ::-1]
    colour = np.clip(rgb / np.maximum(alpha, 1e-3)[..., None], 0, 1)
    return np.ascontiguousarray(alpha), decoded(colour).astype(np.float32) * alpha[..., None]


def _sampled(
    points: np.ndarray, witness: Witness, texel: float, gaussians: Gaussians, plane: Plane
) -> tuple[np.ndarray, ...]:
    """A photo [T, 3], and the mirror image's alpha [T] and light [T, 3], at points; pictures are as fine as texels."""
    uv, z = witness.camera.project(points)
    away = float(np.median(z))
    pixels = texel * witness.camera.fx / away if away > 0 else 1.0
    camera = witness.camera.scaled(1 / max(1.0, pixels))
    photo = cv2.resize(linear(witness.photo), (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    size = camera.width / witness.camera.width, camera.height / witness.camera.height
    at = np.nan_to_num(uv, nan=-1e4) * size
    return tuple(colours_at(p.astype(np.float32), at) for p in (photo, *mirror_image(gaussians, plane, camera)))


def _without_slopes(values: np.ndarray, seen: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Values [V, T, C] of views, less what changes evenly across each: of a sheen every view has more on its own side.

    `seen` is [V, T] bool, `places` on the plane are [T, 2].
    """
    slopes, left = np.column_stack([np.ones(len(places)), places]), values.astype(np.float64)
    for of_view, shown in zip(left, seen):
        if shown.any():
            of_view -= slopes @ np.linalg.lstsq(slopes[shown], of_view[shown], rcond=None)[0]
    return left


def _fitted(
    seen: np.ndarray, places: np.ndarray, photo: np.ndarray, alpha: np.ndarray, light: np.ndarray
) -> tuple[np.ndarray, float, float]:
    """How a mirror image explains differences between photos: strengths [2, 3] of `image` and `elsewhere`, see
    Reflection; by how much it lowers the squared differences, in units of noise; and what share of them, where it is
    and noise left out.

    V views show T texels at places [T, 2] of the plane where `seen` [V, T] bool, linear light: photos [V, T, 3], the
    mirror image's alpha [V, T] and its light times alpha [V, T, 3].
    """
    found, gain, explained, uneven = np.zeros((2, 3)), 0.0, 0.0, 0.0
    there = seen & (alpha > MIRRORED)
    if not seen.any():  # few views, or none of one place
        return found, 0.0, 0.0
    values = _without_slopes(np.concatenate([photo, light, -alpha[..., None]], axis=2), seen, places)
    for channel in range(3):
        weight = seen.astype(np.float64)
        for _ in range(ROUNDS):
            shown, bright, dark = (
                v - (weight * v).sum(0) / np.maximum(weight.sum(0), 1e-9)
                for v in (values[..., channel], values[..., 3 + channel], values[..., 6])
            )
            bends = np.array([[(weight * a * b).sum() for b in (bright, dark)] for a in (bright, dark)])
            slopes = np.array([(weight * a * shown).sum() for a in (bright, dark)])
            # of a plain object both are alike: the smaller strengths, then
            root = np.linalg.cholesky(bends + (1e-3 * np.trace(bends) + 1e-12) * np.eye(2))
            strength = nnls(root.T, np.linalg.solve(root, slopes))[0]
            left = shown - strength[0] * bright - strength[1] * dark
            noise = max(1.4826 * float(np.median(np.abs(left[seen]))), LEAST_NOISE)
            weight = seen / np.sqrt(1 + (left / noise) ** 2)
        found[:, channel] = strength
        squares = weight * np.stack([shown, left]) ** 2 / noise**2
        gain += float(squares[0].sum() - squares[1].sum())
        explained += float((squares[0] - squares[1])[there].sum())
        # where photos hardly differ there is nothing to explain
        uneven += max(float((squares[0] - weight)[there].sum()), float(weight[there].sum()))
    return found, gain, float(np.clip(explained / uneven, 0, 1)) if uneven > 0 else 0.0


def find_reflection(
    gone: Gaussians, plane: Plane, grounds: Sequence[Ground], witnesses: Sequence[Witness], region: Region
) -> Reflection | str:
    """The reflection of what is gone, in the plane that it stood on, that explains how photos of the same places
    differ; or why there is none.

    Whatever does not change with the view – texture, shadow – drops out of differences between photos of a place. A
    reflection must explain most of them where the mirror image is, and clearly more than that of the object elsewhere.
    """
    grounds, object_ = sorted(grounds, key=lambda g: g.plane is not plane), standing(gone, plane, extent(region))
    if not grounds or grounds[0].plane is not plane or not len(object_):
        return "no reflection found: photos do not show the surface that the object stands on"
    ground = grounds[0]
    used = spread(witnesses, MOST_VIEWS)
    known = np.zeros_like(ground.known)
    known[::2, ::2] = ground.known[::2, ::2]
    points = ground.points()[known]
    texel = 2 * float(np.median(ground.depth)) / ground.camera.fx
    seen = ask(used, points, ground.tolerance) == Says.SEEN
    several = seen.sum(0) >= SEVERAL

    def fit(gaussians: Gaussians) -> tuple[np.ndarray, float, float]:
        parts = parallel_map(lambda w: _sampled(points, w, texel, gaussians, plane), used)
        samples = (np.array([p[k] for p in parts])[:, several] for k in range(3))
        return _fitted(seen[:, several], plane.local(points[several])[:, :2], *samples)

    strength, gain, share = fit(object_)
    words = f"the mirror image explains {share:.0%} of how photos differ where it is"
    if share < FITS:
        return f"no reflection found: {words}"
    width = np.ptp(plane.local(object_.means.astype(np.float64))[:, :2], axis=0).max()
    moves = [x * plane.right + y * plane.down for x, y in places_elsewhere(float(width))]
    chance = max(fit(replace(object_, means=(object_.means + m).astype(np.float32)))[1] for m in moves)
    over = gain / max(chance, 1e-9)
    words += f", {over:.1f} times what it does elsewhere"
    if over < EARNS:
        return f"no reflection found: {words}"
    return Reflection(tuple(grounds), object_, strength[0], strength[1], share, share * (1 - 1 / over), words)

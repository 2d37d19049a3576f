"""Filling a hole in a picture with the picture's own texture, without learned weights.

Patches and colours are found in turns, from coarse to fine (Wexler 2007; Newson 2014 and 2017, whose texture
features keep a hole in a detailed texture from being filled with flat patches).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numba import float32

from ..jit import kernel
from ..threads import run_ranges
from .patch_index import index_patches
from .patches import lay_out
from .patchmatch import NearestNeighbourField, PatchMatchSettings, patch_centres, refined, upsampled

MOST_PEEL_SOURCES = 4096  # patches of the coarsest level that the first guess looks at
VOTE_ROWS = 8  # rows per piece of work


@dataclass(frozen=True)
class ExemplarSettings:
    """Lengths in pixels."""

    patch: int = 5  # side, odd
    texture: float = 5.0  # weight of squared texture features beside squared colours (Newson 2017: 50)
    smallest: int = 24  # no level is smaller
    coarse_rounds: int = 12  # of matching and voting on the coarsest level
    fewer_rounds: int = 3  # by which every finer level has fewer
    fine_rounds: int = 2  # at least
    sweeps: int = 2  # of PatchMatch per round
    rim_trust: float = 1.3  # by which a patch's say falls with every pixel from the known rim (Wexler 2007)
    settled: float = 0.3  # grey levels; a round that changes less ends its level
    grid: int = 2  # spacing of the sources that the tree of patches holds
    reach: int = 4  # of the random search round the best source
    locality: float = 0.002  # cost of a source one image width away from the hole, (11 grey levels)²
    seed: int = 0


@dataclass(frozen=True)
class Completion:
    """A picture with its hole filled."""

    image: np.ndarray  # [H, W, 3] uint8, outside the hole bit for bit the input
    misfit: float  # RMS grey levels between pixels and their own patches' sources; NaN where none could be copied


def complete_picture(
    image: np.ndarray,  # [H, W, 3] uint8
    hole: np.ndarray,  # [H, W] bool, not all of it
    settings: ExemplarSettings = ExemplarSettings(),
) -> Completion:
    """Fill the hole so that every patch of it resembles one outside."""
    radius = settings.patch // 2
    levels = _pyramid(image, hole, radius, settings)
    while radius > 0 and not patch_centres(~levels[-1][1], radius).any():
        radius -= 1
    coarse, open_ = levels[-1]
    current = _peeled(coarse, open_, radius)
    field: NearestNeighbourField | None = None
    for number, (known, open_) in enumerate(reversed(levels)):
        touching = cv2.dilate(open_.astype(np.uint8), np.ones((2 * radius + 1,) * 2, np.uint8)) > 0
        if field is not None:
            size = (open_.shape[1], open_.shape[0])
            grown = _resized(current, size, cv2.INTER_LINEAR)
            field = upsampled(field, touching)
            current = _voted(np.where(open_[..., None], grown, known), open_, field, settings, 0.0)
        rounds = max(settings.fine_rounds, settings.coarse_rounds - settings.fewer_rounds * number)
        current, field = _settled(current, open_, touching, field, radius, rounds, settings)
    assert field is not None
    filled = np.clip(np.rint(current[..., :3] * 255), 0, 255).astype(np.uint8)
    return Completion(np.where(hole[..., None], filled, image), _misfit(current, hole, field))


def _misfit(current: np.ndarray, hole: np.ndarray, field: NearestNeighbourField) -> float:
    inside = hole & field.found
    difference = (current[inside] - current[field.rows[inside], field.cols[inside]])[:, :3]
    return 255 * float(np.sqrt(np.mean(difference**2))) if inside.any() else float("nan")


def _pyramid(
    image: np.ndarray, hole: np.ndarray, radius: int, settings: ExemplarSettings
) -> list[tuple[np.ndarray, np.ndarray]]:
    """(channels [h, w, 5], hole) from fine to coarse, until the hole is about as thin as a patch."""
    count, thickness = 1, _thickness(hole)
    while min(hole.shape) > settings.smallest * 2**count and thickness > radius * 2 ** (count - 1):
        count += 1
    colours = image.astype(np.float32) / 255
    levels = [(np.dstack([colours, _texture(colours, hole, 2 ** (count - 1), settings.texture)]), hole)]
    while len(levels) < count and levels[-1][1].any():
        levels.append(_halved(*levels[-1]))
    return [level for level in levels if level[1].any()]


def _texture(colours: np.ndarray, hole: np.ndarray, window: int, weight: float) -> np.ndarray:
    """[H, W, 2] float32: mean absolute slope of luminance along x and y over a window, known pixels only."""
    grey = colours.mean(-1)
    size = (2 * window + 1, 2 * window + 1)
    features = []
    for axis in (1, 0):
        slope = np.abs(grey - np.roll(grey, 1, axis))
        valid = (~hole & ~np.roll(hole, 1, axis)).astype(np.float32)
        valid[(slice(None), 0) if axis else 0] = 0
        features.append(cv2.blur(slope * valid, size) / np.maximum(cv2.blur(valid, size), 1e-6))
    return np.float32(np.sqrt(weight)) * np.dstack(features)


def _halved(channels: np.ndarray, hole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Half the resolution; hole pixels do not mix into their neighbours."""
    size = ((hole.shape[1] + 1) // 2, (hole.shape[0] + 1) // 2)
    known = (~hole).astype(np.float32)
    total = _resized(channels * known[..., None], size, cv2.INTER_AREA)
    share = cv2.resize(known, size, interpolation=cv2.INTER_AREA)
    return total / np.maximum(share, 1e-6)[..., None], share < 0.5


def _resized(channels: np.ndarray, size: tuple[int, int], way: int) -> np.ndarray:
    parts = channels[..., :3], channels[..., 3:]  # OpenCV takes at most four
    return np.dstack([cv2.resize(part, size, interpolation=way) for part in parts])


def _thickness(hole: np.ndarray) -> float:
    return float(cv2.distanceTransform(hole.astype(np.uint8), cv2.DIST_L2, 5).max())


def _peeled(channels: np.ndarray, hole: np.ndarray, radius: int) -> np.ndarray:
    """The hole filled inwards, ring by ring, each pixel from the patch that best continues the known."""
    current, open_ = channels.copy(), hole.copy()
    centres = np.argwhere(patch_centres(~hole, radius)).astype(np.int32)
    if len(centres) == 0:  # not even one known pixel to copy
        return current
    centres = centres[:: -(-len(centres) // MOST_PEEL_SOURCES)]
    while open_.any():
        ring = open_ & (cv2.dilate((~open_).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
        filled = current.copy()
        _fill_ring(np.argwhere(ring), centres, current, open_, radius, filled)
        current, open_ = filled, open_ & ~ring
    return current


def _settled(
    current: np.ndarray,
    hole: np.ndarray,
    touching: np.ndarray,  # [H, W] bool, centres of the patches that the hole changes
    field: NearestNeighbourField | None,
    radius: int,
    rounds: int,
    settings: ExemplarSettings,
) -> tuple[np.ndarray, NearestNeighbourField]:
    """Match the patches, let them vote for the hole's colours, and again until little changes."""
    allowed = patch_centres(~hole, radius)
    away = cv2.distanceTransform((~hole).astype(np.uint8), cv2.DIST_L2, 5)
    penalty = np.float32(settings.locality / hole.shape[1]) * away
    index = index_patches(lay_out(current, radius), allowed, settings.grid) if allowed.any() else None
    matching = PatchMatchSettings(coherence=0.0, tree_sweeps=1, sweeps=settings.sweeps, reach=settings.reach)
    for number in range(rounds):
        matching = replace(matching, seed=settings.seed + 31 * number)
        field = refined(field, lay_out(current, radius), touching, allowed, matching, penalty, index)
        sharpness = 1.0 / max(float(np.percentile(field.cost[touching], 75)), 255.0**-2)
        voted = _voted(current, hole, field, settings, sharpness)
        change = 255 * float(np.abs(voted - current)[hole][:, :3].mean())
        current = voted
        if change < settings.settled:
            break
    assert field is not None
    return current, field


def _voted(
    current: np.ndarray,
    hole: np.ndarray,
    field: NearestNeighbourField,
    settings: ExemplarSettings,
    sharpness: float,
) -> np.ndarray:
    """What the overlapping patches say each hole pixel looks like, weighted by how well they fit."""
    distance = cv2.distanceTransform(hole.astype(np.uint8), cv2.DIST_L2, 5)
    trust = (settings.rim_trust ** -np.minimum(distance, 40)).astype(np.float32)
    voted = current.copy()
    fitting = field.rows, field.cols, field.cost, trust, np.float32(sharpness), field.radius
    run_ranges(_vote_rows, len(hole), current, hole, *fitting, voted, chunk=VOTE_ROWS)
    return voted


@kernel
def _fill_ring(ring, centres, known, open_, radius, out):
    """Each ring pixel takes its value from the source patch that differs least where its own is known."""
    h, w, channels = known.shape
    for k in range(len(ring)):
        y, x = ring[k]
        best, best_v, best_u = float32(1e30), 0, 0
        for s in range(len(centres)):
            v, u = centres[s]
            total = float32(0)
            for dy in range(-radius, radius + 1):
                for dx in range(-radius, radius + 1):
                    a, b = y + dy, x + dx
                    if a < 0 or b < 0 or a >= h or b >= w or open_[a, b]:
                        continue
                    for c in range(channels):
                        d = known[a, b, c] - known[v + dy, u + dx, c]
                        total += d * d
                if total >= best:
                    break
            if total < best:
                best, best_v, best_u = total, v, u
        out[y, x] = known[best_v, best_u]


@kernel
def _vote_rows(lo, hi, current, hole, rows, cols, cost, trust, sharpness, radius, voted):
    h, w, channels = current.shape
    colour = np.empty(channels, np.float32)
    for y in range(lo, hi):
        for x in range(w):
            if not hole[y, x]:
                continue
            total = float32(0)
            colour[:] = 0
            for dy in range(-radius, radius + 1):
                for dx in range(-radius, radius + 1):
                    a, b = y + dy, x + dx
                    if a < 0 or b < 0 or a >= h or b >= w or rows[a, b] < 0:
                        continue
                    v, u = rows[a, b] - dy, cols[a, b] - dx
                    if v < 0 or u < 0 or v >= h or u >= w:  # an upsampled field may point past the edge
                        continue
                    weight = trust[a, b] * np.exp(-cost[a, b] * sharpness) + float32(1e-12)
                    total += weight
                    for c in range(channels):
                        colour[c] += weight * current[v, u, c]
            if total > 0:
                for c in range(channels):
                    voted[y, x, c] = colour[c] / total

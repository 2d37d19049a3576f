"""Filling a hole in a picture with the picture's own texture, without learned weights.

Patches and colours are found in turns, from coarse to fine (Wexler 2007; Newson 2014 and 2017, whose texture
features keep a hole in a detailed texture from being filled with flat patches).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..jit import kernel
from ..threads import run_ranges
from .greedy import fill_inwards
from .patch_index import index_patches
from .patches import lay_out, repainting
from .patchmatch import NearestNeighbourField, PatchMatchSettings, patch_centres, refined, upsampled
from .surface import Surface, coarser, supports, warps, whole_patches

VOTE_PIXELS = 1024  # per piece of work
NO_SUPPORT, NO_WARP = np.empty((0, 0), np.uint8), np.empty((0, 0), np.float32)
LEAST_SAY = 1e-12  # of a patch that fits badly
FURTHEST_TRUST = 400.0  # px from the rim beyond which trust falls no further: 5^-400 is a float64 still


@dataclass(frozen=True)
class ExemplarSettings:
    """Lengths in pixels."""

    patch: int = 5  # side, odd
    texture: float = 20.0  # weight of squared texture features beside squared colours (Newson 2017: 50)
    thickness: float = 8.0  # of the hole on the coarsest level, in half patches, at most; larger structures continue
    smallest: int = 24  # no level is smaller
    coarse_rounds: int = 6  # of matching and voting on the coarsest level
    fewer_rounds: int = 3  # by which every finer level has fewer, down to one
    sweeps: int = 2  # of PatchMatch per round
    rim_trust: float = 5.0  # by which a patch's say falls with every pixel from the known rim (Wexler 2007)
    settled: float = 0.3  # grey levels; a round that changes less ends its level
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
    surface: Surface | None = None,  # what the picture shows
) -> Completion:
    """Fill the hole so that every patch of it resembles one outside.

    With a surface patches are compared and copied along its tangent planes, and what lies on another surface
    than the patch's centre, such as something that stands in front, is not compared.
    """
    if not hole.any():
        return Completion(image.copy(), 0.0)
    radius = settings.patch // 2
    if surface is not None:  # what is filled is mixed with nothing
        surface = surface._replace(clear=surface.clear | hole)
    levels = _pyramid(image, hole, radius, settings)
    while radius > 0 and not patch_centres(~levels[-1][1], radius).any():
        radius -= 1
    if levels[-1][1].all():
        return Completion(image.copy(), float("nan"))
    field: NearestNeighbourField | None = None
    for number, (channels, open_) in enumerate(reversed(levels)):
        rounds = max(1, settings.coarse_rounds - settings.fewer_rounds * number)
        there = None if surface is None else coarser(surface, len(levels) - 1 - number, open_.shape)
        colours, field = _level(channels, open_, there, field, radius, rounds, settings)
    assert field is not None
    filled = image.copy()
    filled[hole] = np.clip(np.rint(colours[:, :3] * 255), 0, 255)
    sources = image[field.rows[hole], field.cols[hole]]
    misfit = 255 * float(np.sqrt(np.mean((colours[:, :3] - sources / 255) ** 2)))
    return Completion(filled, misfit)


def _level(
    channels: np.ndarray,  # [h, w, 5], see _pyramid
    hole: np.ndarray,  # [h, w] bool
    surface: Surface | None,
    field: NearestNeighbourField | None,  # of the coarser level
    radius: int,
    rounds: int,
    settings: ExemplarSettings,
) -> tuple[np.ndarray, NearestNeighbourField]:
    """The hole's channels [N, 5] and the field of one level.

    Patches are matched, then vote for the hole's colours, and again until little changes. A field from the
    coarser level votes first: averaging what it copies is sharper than enlarging the coarser colours.
    """
    touching = cv2.dilate(hole.astype(np.uint8), np.ones((2 * radius + 1,) * 2, np.uint8)) > 0
    allowed = patch_centres(~hole, radius)
    usable = ~hole if surface is None else ~hole & surface.clear
    if surface is not None and (whole := whole_patches(surface, allowed, radius)).any():
        allowed = whole
    away = cv2.distanceTransform((~hole).astype(np.uint8), cv2.DIST_L2, 5)
    penalty = np.float32(settings.locality / hole.shape[1]) * away
    inwards = cv2.distanceTransform(hole.astype(np.uint8), cv2.DIST_L2, 5)[touching]
    trust = settings.rim_trust ** -np.minimum(inwards.astype(np.float64), FURTHEST_TRUST)
    matching = PatchMatchSettings(
        coherence=0.0, sweeps=settings.sweeps, tree_sweeps=1, reach=settings.reach, seed=settings.seed
    )
    index = None
    patches, guides = lay_out(np.ascontiguousarray(channels[..., :3]), radius), channels[..., 3:].copy()
    if field is None:
        rows, cols = fill_inwards(channels, hole, allowed, radius, surface, usable)
        colours = channels[rows[hole], cols[hole]]
        field = NearestNeighbourField(rows, cols, np.zeros(hole.shape, np.float32), radius)
        if surface is None:
            index = index_patches(patches, allowed, 2)
        else:
            matching = replace(matching, reach=max(hole.shape))
    else:
        field = upsampled(field, touching)
        kept = field.found
        kept[kept] = allowed[field.rows[kept], field.cols[kept]]
        field = replace(field, rows=np.where(kept, field.rows, -1))
        colours = _voted(channels, hole, field, touching, trust, radius, surface)
    repaint = repainting(hole, radius)
    for number in range(rounds):
        repaint(patches, colours[:, :3])
        guides[hole] = colours[:, 3:]
        matching = replace(matching, seed=settings.seed + 31 * number)
        field = refined(field, patches, touching, allowed, matching, penalty, index, guides, surface, usable)
        costs = field.cost[touching]
        sharpness = 1.0 / max(float(np.percentile(costs, 75)), 255.0**-2)
        voted = _voted(
            channels, hole, field, touching, trust * np.maximum(np.exp(-costs * sharpness), LEAST_SAY), radius, surface
        )
        change = 255 * float(np.abs(voted - colours)[:, :3].mean())
        colours = voted
        if change < settings.settled:
            break
    assert field is not None
    return colours, field


def _pyramid(
    image: np.ndarray, hole: np.ndarray, radius: int, settings: ExemplarSettings
) -> list[tuple[np.ndarray, np.ndarray]]:
    """(channels [h, w, 5]: colours and texture features, hole) from fine to coarse."""
    thickness = float(cv2.distanceTransform(hole.astype(np.uint8), cv2.DIST_L2, 5).max())
    count = 1
    while min(hole.shape) > settings.smallest * 2**count and thickness > settings.thickness * radius * 2 ** (count - 1):
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
    parts = (channels * known[..., None])[..., :3], (channels * known[..., None])[..., 3:]  # OpenCV takes four at most
    total = np.dstack([cv2.resize(part, size, interpolation=cv2.INTER_AREA) for part in parts])
    share = cv2.resize(known, size, interpolation=cv2.INTER_AREA)
    return total / np.maximum(share, 1e-6)[..., None], share < 0.5


def _voted(
    channels: np.ndarray,
    hole: np.ndarray,
    field: NearestNeighbourField,
    touching: np.ndarray,
    say: np.ndarray,  # [touching pixels] float64 > 0, of each patch
    radius: int,
    surface: Surface | None,
) -> np.ndarray:
    """What the overlapping patches say each hole pixel looks like, [N, 5]."""
    weights = np.zeros(hole.shape)
    weights[touching] = say
    places = np.argwhere(hole)
    voted = np.empty((len(places), channels.shape[2]), np.float32)
    number, support, warp = np.zeros(hole.shape, np.int32), NO_SUPPORT, NO_WARP
    if surface is not None:
        number[touching] = np.arange(len(say))
        support = supports(surface, np.argwhere(touching), radius)
        warp = warps(surface, touching, field.rows, field.cols)
    votes = np.ascontiguousarray(channels), places, field.rows, field.cols, weights, radius
    run_ranges(_vote, len(places), *votes, ~hole, surface is not None, number, support, warp, voted, chunk=VOTE_PIXELS)
    return voted


@kernel
def _vote(
    lo, hi, channels, places, rows, cols, weights, radius, usable, slanted, number, support, warp, voted
):  # fmt: skip
    h, w, count = channels.shape
    sums = np.zeros(count)
    side = 2 * radius + 1
    for k in range(lo, hi):
        y, x = places[k]
        total = 0.0
        for a in range(max(0, y - radius), min(h, y + radius + 1)):
            for b in range(max(0, x - radius), min(w, x + radius + 1)):
                if rows[a, b] < 0:
                    continue
                if not slanted:
                    v, u = rows[a, b] + y - a, cols[a, b] + x - b
                    total += weights[a, b]
                    for c in range(count):
                        sums[c] += weights[a, b] * channels[v, u, c]
                    continue
                n = number[a, b]
                if support[n, (y - a + radius) * side + x - b + radius] == 0:
                    continue
                fu = cols[a, b] + warp[n, 0] * (x - b) + warp[n, 1] * (y - a)
                fv = rows[a, b] + warp[n, 2] * (x - b) + warp[n, 3] * (y - a)
                if not (0 <= fu <= w - 1 and 0 <= fv <= h - 1):
                    continue
                v, u = min(int(fv), h - 2), min(int(fu), w - 2)
                if not (usable[v, u] and usable[v, u + 1] and usable[v + 1, u] and usable[v + 1, u + 1]):
                    continue
                s, t = fv - v, fu - u
                total += weights[a, b]
                for c in range(count):
                    top = (1 - t) * channels[v, u, c] + t * channels[v, u + 1, c]
                    bottom = (1 - t) * channels[v + 1, u, c] + t * channels[v + 1, u + 1, c]
                    sums[c] += weights[a, b] * ((1 - s) * top + s * bottom)
        if total == 0.0:
            for c in range(count):
                sums[c] = channels[y, x, c]
            total = 1.0
        for c in range(count):
            voted[k, c] = sums[c] / total
            sums[c] = 0.0

"""Filling a hole in a picture with the picture's own texture, without learned weights.

Patches and colours are found in turns, from coarse to fine (Wexler 2007; Newson 2014 and 2017, whose texture
features keep a hole in a detailed texture from being filled with flat patches). In the end every pixel is copied from
one place: an average of what disagrees is smooth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from ..compute.jit import kernel
from ..compute.threads import run_ranges
from ..geometry import bounds, dilated
from .edges import Edge, find_edges, guide_of
from .grain import with_grain
from .kriging import Expected, expect
from .patches import index_patches, lay_out
from .patchmatch import NearestNeighbourField, PatchMatchSettings, nearest_allowed, patch_centres, refined, upsampled
from .poisson import solve_poisson
from .regularity import continue_regularly, find_motions
from .shift_map import fill_inwards, shift_map

PATCH = 13  # px, side of patches: smaller ones lose what is regular, such as tiles
TEXTURE = 20.0  # weight of squared texture features beside squared colours (Newson 2017: 50)
THICKNESS = 4.0  # of the hole on the coarsest level, in half patches, at most; larger structures continue
SMALLEST = 24  # px; no level is smaller
COARSE_ROUNDS = 3  # of matching and voting on the coarsest level; finer ones have one
SWEEPS = 2  # of PatchMatch per round
RIM_TRUST = 1.5  # by which a patch's say falls with every pixel from the known rim (Wexler 2007)
FURTHEST_TRUST = 400.0  # px from the rim beyond which trust falls no further: 5^-400 is a float64 still
SETTLED = 0.3  # grey levels; a round that changes less ends its level
LOCALITY = 0.002  # cost of a source one image width away from the hole, (11 grey levels)²
VOTE_PIXELS = 1024  # per piece of work
COPIED = 0.5  # of the filled picture's gradients is as copied, the rest as patches vote: more is sharper, and noisier
MOSAICS = 8  # rounds that match what is copied: what is like votes, which are smooth, is smooth as well
TREE_GRID = 2  # px between the sources that the coarsest level's tree holds
DISAGREEMENT = 40 / 255  # difference between a rim pixel and what patches say of it from which it is no boundary
SCREENING = 0.01  # weight of the voted colours beside their gradients
SELECTIVE = 8.0  # a patch that only a quarter fits worse than votes by e^-8: higher is sharper, and noisier
EXPECTED = 1.0  # weight of expected colours beside a patch's misfit, where they are as sure
LEAST_SAY = 1e-12  # of a patch that fits badly
EDGE = 0.15  # difference in colour that counts as much as being on an edge, or beside it, or not
GUIDE = np.array([EDGE, EDGE, *[1] * 6], np.float32)  # what differences of guide_of count: an edge's colours as others


def complete_picture(
    image: np.ndarray,  # [H, W, 3] uint8
    hole: np.ndarray,  # [H, W] bool, not all of it
    patch: int = PATCH,  # px, odd
    seed: int = 0,
    unknown: np.ndarray | None = None,  # [H, W] bool, neither to be filled nor to be copied
) -> tuple[np.ndarray, float]:
    """Fill the hole: by motions that explain what is round it, else so that every patch of it resembles one outside.

    Edges that the hole cuts are continued: patches on them are copied from patches on edges. What is unknown
    near the hole is filled with it, and thrown away: so it has no say in what the hole is like.

    Returns the picture [H, W, 3] uint8, outside the hole bit for bit the input, and its misfit: RMS grey levels between
    pixels and their own patches' sources; NaN where none could be copied.
    """
    if not hole.any():
        return image.copy(), 0.0
    asked, given = hole, image
    if unknown is None or (unknown | hole).all():
        unknown = np.zeros(hole.shape, bool)
    known = ~(hole | unknown)
    rows, cols = nearest_allowed(known)
    image = np.where(known[..., None], image, image[rows, cols])  # what stood there means nothing
    motions = find_motions(image, hole, known)
    image, regular = continue_regularly(image, hole, known, motions)
    if (regular == hole).all():
        return np.where(hole[..., None], image, given), max(m.misfit for m in motions)
    # where photos disagree a little, what they show tells edges all the same
    edges = find_edges(given, asked, ~asked & given.any(-1), known)
    done = _by_patches(image, hole & ~regular, unknown, edges, patch, seed)
    if done is None:
        return given.copy(), float("nan")
    level, field, colours = done
    hole = level.hole
    sources = image[field.rows[hole], field.cols[hole]]
    misfit = 255 * float(np.sqrt(np.mean((colours[:, :3] - sources / 255) ** 2)))
    picture = level.channels[..., :3].copy()
    picture[hole] = _blended(level, field, colours)
    filled = image.copy()
    filled[hole] = np.clip(np.rint(255 * with_grain(picture, hole, level.usable, field)), 0, 255)
    filled[~asked] = given[~asked]  # what was filled besides
    return filled, misfit


@dataclass(frozen=True)
class _Level:
    """A level of the pyramid and what does not change while it is filled."""

    channels: np.ndarray  # [h, w, 5] float32: colours and texture features
    hole: np.ndarray  # [h, w] bool
    edges: np.ndarray  # [h, w, 8] float32, see guide_of: known in the hole as well
    expected: Expected  # smooth colours, known in the hole as well
    touching: np.ndarray  # [h, w] bool, centres of the patches that the hole changes
    usable: np.ndarray  # [h, w] bool, pixels to copy
    allowed: np.ndarray  # [h, w] bool, centres of patches to copy
    trust: np.ndarray  # [touching pixels] float64 > 0, how well founded each of those patches is
    radius: int


def _by_patches(
    image: np.ndarray, hole: np.ndarray, unknown: np.ndarray, edges: tuple[Edge, ...], patch: int, seed: int
) -> tuple[_Level, NearestNeighbourField, np.ndarray] | None:
    """The finest level, its field and the hole's colours, level by level; None if there is nothing to copy."""
    radius = patch // 2
    hole = hole | (unknown & dilated(hole, radius))
    unknown = unknown & ~hole
    levels = _pyramid(image, hole, radius)
    while radius > 0 and not patch_centres(~levels[-1][1], radius).any():
        radius -= 1
    if levels[-1][1].all():
        return None
    field: NearestNeighbourField | None = None
    expected = expect(image / np.float32(255), hole, ~(hole | unknown), edges)
    for finer, (channels, open_) in reversed([*enumerate(levels)]):
        barred = cv2.resize(unknown.astype(np.float32), open_.shape[::-1], interpolation=cv2.INTER_AREA) > 0
        smooth = expected.sized(open_.shape, radius | 1)  # half a patch: single pixels' would leave no texture
        guide = GUIDE * guide_of(edges, open_.shape, 2**finer, max(radius, 1))
        usable = ~open_ & ~barred
        if not patch_centres(usable, radius).any():
            usable = ~open_
        allowed, touching = patch_centres(usable, radius), dilated(open_, radius)
        inwards = cv2.distanceTransform(open_.astype(np.uint8), cv2.DIST_L2, 5)[touching].astype(np.float64)
        trust = RIM_TRUST ** -np.minimum(inwards, FURTHEST_TRUST)
        level = _Level(channels, open_, guide, smooth, touching, usable, allowed, trust, radius)
        colours, field = _filled(level, field, 0 if finer else MOSAICS, seed)
    assert field is not None
    return level, field, colours


def _filled(
    level: _Level, coarser: NearestNeighbourField | None, mosaics: int, seed: int
) -> tuple[np.ndarray, NearestNeighbourField]:
    """The hole's channels [N, 5] and the field of one level.

    Patches are matched, then vote for the hole's colours, and again until little changes. A field from the
    coarser level votes first: averaging what it copies is sharper than enlarging the coarser colours.
    """
    hole, allowed, radius = level.hole, level.allowed, level.radius
    shown, index = level.channels.copy(), None
    doubt = float(np.median(level.expected.variance[hole]))
    away = cv2.distanceTransform((~hole).astype(np.uint8), cv2.DIST_L2, 5)
    penalty = np.float32(LOCALITY / hole.shape[1]) * away
    if coarser is None:
        rounds, usual = COARSE_ROUNDS, 0.0  # cost of patches that were found; not known at first
        rows, cols = fill_inwards(level.channels, hole, allowed, radius, level.edges[..., 0] / EDGE)
        colours = level.channels[rows[hole], cols[hole]]
        field = NearestNeighbourField(rows, cols, np.zeros(hole.shape, np.float32))
        index = index_patches(lay_out(shown[..., :3].copy(), radius), allowed, TREE_GRID)
    else:
        rounds, usual = 1, float(np.median(coarser.cost[coarser.found]))
        field = upsampled(coarser, level.touching, allowed)
        colours = _voted(level, field, level.channels[hole])

    def matched(colours: np.ndarray, number: int) -> np.ndarray:
        nonlocal field, usual
        shown[hole] = colours
        patches = lay_out(shown[..., :3].copy(), radius)
        heed = np.float32(math.sqrt(EXPECTED * usual / max(usual + doubt, 1e-9) / 3))
        guided = np.dstack([shown[..., 3:], level.edges, heed * level.expected.colours])
        matching = PatchMatchSettings(coherence=0.0, sweeps=SWEEPS, seed=seed + 31 * number)
        field = refined(field, patches, level.touching, allowed, matching, penalty, guided, index, tree_sweeps=1)
        usual = float(np.median(field.cost[level.touching]))
        return _voted(level, field, colours)

    for number in range(rounds):
        voted = matched(colours, number)
        change = 255 * float(np.abs(voted - colours)[:, :3].mean())
        colours = voted
        if change < SETTLED:
            break
    for number in range(rounds, rounds + mosaics):
        shown[hole] = colours
        field = shift_map(shown[..., :3].copy(), hole, level.usable, field)
        there = field.found[hole]
        copied = np.where(there[:, None], level.channels[field.rows[hole], field.cols[hole]], colours)
        colours = matched(copied, number)
    return colours, field


def _blended(level: _Level, field: NearestNeighbourField, colours: np.ndarray) -> np.ndarray:
    """The hole's colours [N, 3] without seams: the gradients of what is copied, fixed at the rim.

    Poisson's equation (Darabi 2012), drawn a little to the colours voted for. Patches vote for gradients as well;
    what the two pixels are copied from has its say. Rim pixels that the patches do not agree with at all, such as
    remains of what was removed, do not spread.
    """
    picture, box = level.channels[..., :3].copy(), bounds(level.hole, 1)
    picture[level.hole] = colours[:, :3]
    sources = shift_map(picture, level.hole, level.usable, field)
    hole, picture, corner = level.hole[box], picture[box], np.array([b.start for b in box])
    rim = dilated(hole, 1) & ~hole & level.usable[box]
    said = _voted(level, field, picture[rim], np.argwhere(rim) + corner)
    rim[rim] = np.abs(said - picture[rim]).max(1) < DISAGREEMENT
    slopes = []
    for dy, dx in ((0, 1), (1, 0)):
        inner = np.ones_like(hole)
        inner[len(hole) - dy :], inner[:, hole.shape[1] - dx :] = False, False
        slope = np.where(inner[..., None], np.roll(picture, (-dy, -dx), (0, 1)) - picture, np.float32(0))
        # pixels whose step to the right or down begins or ends in the hole
        across = inner & (hole | np.roll(hole, (-dy, -dx), (0, 1)))
        places = np.argwhere(across) + corner
        voted = _voted(level, field, slope[across], places, (dy, dx))
        slope[across] = voted + COPIED * (_copied_steps(level, sources, places, (dy, dx)) - voted)
        slopes.append(slope)
    drawn = np.where(hole, SCREENING, 0.0)
    return solve_poisson(hole, rim, picture, _picture_of(*slopes), weight=drawn, anchor=picture).values[hole]


def _copied_steps(
    level: _Level, sources: NearestNeighbourField, places: np.ndarray, step: tuple[int, int]
) -> np.ndarray:
    """[N, 3]: differences to the next pixel where places [N, 2] are copied from, and where those next to them are."""
    picture, sides = level.channels[..., :3], []
    for back in (np.zeros(2, int), np.array(step)):
        y, x = (places + back).T
        found = sources.found[y, x, None]
        source = np.where(found, np.stack([sources.rows[y, x], sources.cols[y, x]], 1), places + back) - back
        after = source + step
        inside = (source >= 0).all(1) & (after < picture.shape[:2]).all(1)
        source, after = (np.where(inside[:, None], s, places) for s in (source, after))
        sides.append(picture[after[:, 0], after[:, 1]] - picture[source[:, 0], source[:, 1]])
    return np.asarray((sides[0] + sides[1]) / 2)


def _picture_of(along_x: np.ndarray, along_y: np.ndarray) -> np.ndarray:
    """[h, w, 3]: a picture whose Laplacian is the divergence of these differences to the right and down (DCT).

    There are none from the last column and row.
    """
    import scipy.fft  # takes a twentieth of a second, which removals that fill no picture need not wait for

    h, w, _ = along_x.shape
    divergence = along_x - np.roll(along_x, 1, 1) + along_y - np.roll(along_y, 1, 0)
    waves = scipy.fft.dctn(divergence, axes=(0, 1))
    eigenvalues = 2 * (np.cos(np.pi * np.arange(h) / h)[:, None] + np.cos(np.pi * np.arange(w) / w)) - 4
    eigenvalues[0, 0] = 1.0
    return scipy.fft.idctn(waves / eigenvalues[..., None], axes=(0, 1))


def _pyramid(image: np.ndarray, hole: np.ndarray, radius: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """(channels [h, w, 5]: colours and texture features, hole) from fine to coarse."""
    thickness = float(cv2.distanceTransform(hole.astype(np.uint8), cv2.DIST_L2, 5).max())
    count = 1
    while min(hole.shape) > SMALLEST * 2**count and thickness > THICKNESS * radius * 2 ** (count - 1):
        count += 1
    colours = image.astype(np.float32) / 255
    levels = [(np.dstack([colours, _texture(colours, hole, 2 ** (count - 1))]), hole)]
    while len(levels) < count and levels[-1][1].any():
        levels.append(_halved(*levels[-1]))
    return [level for level in levels if level[1].any()]


def _texture(colours: np.ndarray, hole: np.ndarray, window: int) -> np.ndarray:
    """[H, W, 2] float32: mean absolute slope of luminance along x and y over a window, known pixels only."""
    grey = colours.mean(-1)
    size = (2 * window + 1, 2 * window + 1)
    features = []
    for axis in (1, 0):
        slope = np.abs(grey - np.roll(grey, 1, axis))
        valid = (~hole & ~np.roll(hole, 1, axis)).astype(np.float32)
        valid[(slice(None), 0) if axis else 0] = 0
        features.append(cv2.blur(slope * valid, size) / np.maximum(cv2.blur(valid, size), 1e-6))
    return np.float32(np.sqrt(TEXTURE)) * np.dstack(features)


def _halved(channels: np.ndarray, hole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Half the resolution; hole pixels do not mix into their neighbours."""
    size = ((hole.shape[1] + 1) // 2, (hole.shape[0] + 1) // 2)
    known = (~hole).astype(np.float32)
    planes = *np.dsplit(channels * known[..., None], [3]), known  # OpenCV takes four channels at most
    *total, share = (cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p in planes)
    return np.dstack(total) / np.maximum(share, 1e-6)[..., None], share < 0.5


def _voted(
    level: _Level,
    field: NearestNeighbourField,
    otherwise: np.ndarray,  # [N, C], where nothing is voted for
    places: np.ndarray | None = None,  # [N, 2] rows and columns; None: the hole's
    step: tuple[int, int] = (0, 0),  # vote for differences of the pixels so far down and to the right instead
) -> np.ndarray:
    """What the overlapping patches say each pixel looks like, [N, C] float32; those that fit badly have little say."""
    places = np.argwhere(level.hole) if places is None else places
    costs, weights = field.cost[level.touching], np.zeros(level.hole.shape)
    poor = max(float(np.percentile(costs, 75)), 255.0**-2)
    say = level.trust * np.maximum(np.exp(-SELECTIVE * costs / poor), LEAST_SAY)
    weights[level.touching] = np.where(field.found[level.touching], say, 0.0)
    voted = otherwise.astype(np.float32)
    parts = level.channels, places, *step, field.rows, field.cols, weights, level.radius
    run_ranges(_vote, len(places), *parts, voted, chunk=VOTE_PIXELS)
    return voted


@kernel
def _vote(lo, hi, channels, places, dy, dx, rows, cols, weights, radius, voted):
    h, w, _ = channels.shape
    count, differs = voted.shape[1], dy + dx > 0
    sums = np.empty(count)
    for k in range(lo, hi):
        y, x = places[k]
        total = 0.0
        sums[:] = 0.0
        for a in range(max(0, y + dy - radius), min(h, y + radius + 1)):
            for b in range(max(0, x + dx - radius), min(w, x + radius + 1)):
                weight = weights[a, b]
                if weight > 0.0:
                    v, u = rows[a, b] + y - a, cols[a, b] + x - b
                    total += weight
                    for c in range(count):
                        value = channels[v + dy, u + dx, c]
                        if differs:
                            value -= channels[v, u, c]
                        sums[c] += weight * value
        if total > 0.0:
            for c in range(count):
                voted[k, c] = sums[c] / total

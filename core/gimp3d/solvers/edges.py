"""Edges that a hole cuts: each is told on both sides of it, and runs straight on in between.

One that is told on one side only runs on until it meets another, of the same line, curve or corner, or what is not
known.

What is large is continued before what is small (structure propagation: Sun, Yuan, Jia and Shum 2005).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from ..compute.threads import parallel_map
from ..geometry import bounds, dilated
from .regularity import pattern_search, turn_of

SIDE = 192  # px: pictures are shrunk to this to look for edges
ANGLE = 2.0  # degrees between directions that are tried
REACH, LEAST = 40, 12  # known px on either side of the hole that tell an edge: at most, at least
SOON = 24  # or so many, of one that is told on one side only and not so far: it may end soon, as at a corner
FURTHEST = 120  # px from the hole, where they lie at most
TELLS = 4.0  # times the noise that a step of mean colours must be on both sides
HALF_TELLS = 8.0  # where it is told on one side only: among all lines noise alone comes to 7
FIRM = 0.5  # share of what the best line there tells that both sides must tell it: a streak ends at a plate's rim
STEEP = 4.0  # grey levels that it must be
CLUMPED = 4.0  # by which textures' noise exceeds that of independent pixels, squared
ROWS = np.array([-6, -5, -4, -2, -1, 1, 2, 4, 5, 6])  # px across an edge
FAR_ABOVE, ABOVE, BELOW, FAR_BELOW = slice(0, 3), slice(3, 5), slice(5, 7), slice(7, 10)
SHARP = 0.5  # share of the step between what is further from it that it must be: else it is a slope
BLOCK = 8  # known px along it: its length is told by so many at a time …
CLOSEST = 3  # … and it must reach through the blocks next to the hole
STEADY = 0.5  # share of the usual step that it is in each, and by which two edges' may differ that are one
CLOSE = 4  # px beyond the hole, with the colours on both sides of an edge, that tell that it runs on to there …
BEYOND = 12  # … and half of which others tell that it ended: further off it may have ended where nothing is known
APART = 6  # px between edges where they run into the hole
LEAST_HOLE, LEAST_CUT = 64, 6  # pixels of a part of the hole, and px of an edge in it, that are worth it
MOST = 8  # edges of a part of the hole
BOTH, BEFORE, AFTER = range(3)  # the sides of the hole on which an edge is told
TURN = math.radians(30)  # by which an edge turns at least at a corner, and by which less than straight back
ROUND = 0.25  # share of a circle's bend beside the hole that tells it: corners show hardly any
BOWS = np.linspace(-0.01, 0.01, 17)  # 1/px, by which an edge may bend
PIECES = 6  # straight ones of a curve


@dataclass(frozen=True)
class Edge:
    """A straight line through a hole."""

    origin: np.ndarray  # [2] (x, y) px, where the hole's middle is nearest
    along: np.ndarray  # [2] unit
    ends: tuple[float, float]  # px along it, between which it is seen or runs through the hole
    step: np.ndarray  # [3] grey levels by which colours change across it, from left to right of `along`
    mean: np.ndarray  # [3] grey levels, of what lies to its left and right


def find_edges(image: np.ndarray, hole: np.ndarray, known: np.ndarray, sure: np.ndarray) -> tuple[Edge, ...]:
    """The edges that run into each part of a picture's hole on one side and go on, alike, on the other.

    The picture is [H, W, 3] uint8; hole, what it shows, `known`, and what it shows well, `sure`, are [H, W] bool: only
    the latter tells that an edge ends.
    """
    count, labels, parts, _ = cv2.connectedComponentsWithStats(hole.astype(np.uint8), connectivity=8)
    found: list[Edge] = []
    for part in range(1, count):
        if parts[part, cv2.CC_STAT_AREA] >= LEAST_HOLE:
            found += _of_part(image, labels == part, known, sure & known)
    return tuple(found)


def _of_part(image: np.ndarray, hole: np.ndarray, known: np.ndarray, sure: np.ndarray) -> list[Edge]:
    near = bounds(hole, FURTHEST)
    corner = np.array([near[1].start, near[0].start])
    picture, hole, known, sure = image[near].astype(np.float32), hole[near], known[near], sure[near]
    scale = min(1.0, SIDE / max(hole.shape))
    size = tuple(max(1, round(n * scale)) for n in hole.shape[::-1])
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    there = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
    open_ = cv2.resize(hole.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
    angles = np.arange(0, 180, ANGLE)
    told = np.array(parallel_map(lambda a: _steps(small, there, open_, a, scale), angles))  # [angles, sides, rows]
    alone = told.copy()
    told[:, BEFORE:][alone[:, BEFORE:] < HALF_TELLS] = 0
    axes = np.array([turn_of(-angle) for angle in angles])  # [angles, 2 (along, across), 2]
    offsets = np.arange(told.shape[2]) - (told.shape[2] - 1) / 2
    middle, number = (np.array(size) - 1) / 2, np.arange(len(angles))
    places = np.argwhere(open_)[:, ::-1] - middle

    def through(place: np.ndarray, inwards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which lines [angles, rows] run into the hole there, and on which side [angles]."""
        beside = np.abs(offsets - (axes[:, 1] @ place)[:, None]) <= max(1.5, APART * scale)
        return beside, np.where(axes[:, 0] @ inwards > 0, BEFORE, AFTER)

    found: list[Edge | _Half] = []
    for tried in range(2 * MOST):
        sides = slice(BOTH, BOTH + 1) if tried < MOST and told[:, BOTH].any() else slice(BEFORE, AFTER + 1)
        k, side, row = (int(n) for n in np.unravel_index(told[:, sides].argmax(), told[:, sides].shape))
        side += sides.start
        if told[k, side, row] <= 0:
            break
        along, across = axes[k]
        cut = (places @ along)[np.abs(places @ across - offsets[row]) <= 1]
        ways = (cut.min(), along), (cut.max(), -along)
        ends = [through(offsets[row] * across + t * along, way) for t, way in (ways, ways[:1], ways[1:])[side]]
        tells = alone[k, BEFORE:, max(0, row - 1) : row + 2].max(1)
        firm = all(own >= FIRM * alone[number, here][beside].max() for own, (beside, here) in zip(tells, ends))
        edges: Sequence[Edge | _Half] = []
        if cut.max() - cut.min() >= LEAST_CUT * scale and (side != BOTH or firm):
            place = ((offsets[row] * across + middle) + 0.5) / scale - 0.5
            settled = partial(_settled, picture, (known, sure), hole, angles[k], place)
            edge = settled(side)
            edges = [edge] if edge is not None else _bent(settled) if side == BOTH else []
        found += edges
        for beside, here in ends:
            told[:, BOTH][beside] = 0
            if edges or side != BOTH:
                told[number, here] = np.where(beside, 0, told[number, here])
    whole = [edge for edge in found if isinstance(edge, Edge)]
    halves = _joined([half for half in found if isinstance(half, _Half)], hole)
    return [replace(edge, origin=edge.origin + corner) for edge in [*whole, *halves]]


@dataclass(frozen=True)
class _Half:
    """An edge that is told on one side of the hole only."""

    edge: Edge
    inwards: int  # 1 or -1: it runs into the hole along itself or against that
    enters: float  # px along it, where it runs into the hole
    leaves: float  # and out of it, or ends beyond
    goes_on: bool  # what is known beyond the hole does not tell that it ends
    bow: float  # 1/px, by which it bends to its right where it is told, on its way into the hole

    @property
    def way(self) -> np.ndarray:
        """[2] unit, into the hole."""
        return self.inwards * self.edge.along

    @property
    def entry(self) -> np.ndarray:
        """[2] px, where it runs into the hole."""
        return self.edge.origin + self.enters * self.edge.along

    def faces(self, other: _Half) -> bool:
        """Whether the other one runs into the hole where this one leaves it, as exactly as its direction is told."""
        apart = other.entry - self.entry
        far = apart @ self.way
        return bool(far > 0 and abs(_cross(apart, self.way)) <= ROWS[BELOW].max() + far * math.radians(ANGLE))

    def until(self, far: float) -> Edge:
        """As far as so many px behind where it runs into the hole."""
        t, (first, last) = self.enters + self.inwards * far, self.edge.ends
        return replace(self.edge, ends=(first, t) if self.inwards > 0 else (t, last))


_Meeting = tuple[float, list[Edge]]  # px of the way past where two edges meet, and both as far as there


def _joined(halves: Sequence[_Half], hole: np.ndarray) -> list[Edge]:
    """Pairs as far as where they meet: at corners in the hole or next to it and on curves, else in the middle of
    straight lines, nearest first; others as far as what is not known.
    """
    meetings, place = [], dilated(hole, CLOSE)
    for (k, one), (j, other) in itertools.combinations(enumerate(halves), 2):
        straight = _straight(one, other)
        meeting = _turning(one, other, place) if straight is None else straight
        if meeting is not None:
            meetings.append((straight is not None, *meeting, {k, j}))
    found: list[Edge] = []
    joined: set[int] = set()
    for *_, edges, pair in sorted(meetings, key=lambda m: m[:2]):
        if not joined & pair:
            joined |= pair
            found += edges
    rest = [half for k, half in enumerate(halves) if k not in joined and half.goes_on]
    through = [abs(half.leaves - half.enters) for half in rest]
    return found + [half.until(far) for half, far in zip(rest, through) if far >= LEAST]


def _turning(one: _Half, other: _Half, place: np.ndarray) -> _Meeting | None:
    """One edge that turns where two lines meet in `place`, [H, W] bool: on a curve if it bends beside the hole as the
    circle does that joins them, or turns so little that this need not show and does not bend back; else at a corner.
    """
    into, out, apart = one.way, -other.way, other.entry - one.entry
    turn = math.atan2(_cross(into, out), into @ out)
    if turn == 0 or abs(turn) > math.pi - TURN or not _alike(*_ways(one, other)):
        return None
    ways = _cross(apart, out) / math.sin(turn), _cross(into, apart) / math.sin(turn)
    meeting = one.entry + ways[0] * into
    x, y = np.rint(meeting).astype(int)
    if min(ways) < 0 or not (0 <= y < place.shape[0] and 0 <= x < place.shape[1] and place[y, x]):
        return None
    bends, little = (one.bow - other.bow) / 2 / (2 * math.tan(turn / 2) / (sum(ways) + SOON)), abs(turn) < TURN
    if bends >= (-ROUND if little else ROUND):
        return sum(ways), _curve(one, other, meeting)
    return None if little else (sum(ways), [half.until(far) for half, far in zip((one, other), ways)])


def _curve(one: _Half, other: _Half, meeting: np.ndarray) -> list[Edge]:
    """Two edges as far as where they are told, and the parabola between that touches both, in straight pieces."""
    ends = [half.entry - SOON / 2 * half.way for half in (one, other)]
    at = np.linspace(0, 1, PIECES + 1)[:, None]
    line = (1 - at) ** 2 * ends[0] + 2 * at * (1 - at) * meeting + at**2 * ends[1]
    pieces, steps = [half.until(-SOON / 2) for half in (one, other)], _ways(one, other)
    for k, (start, end) in enumerate(itertools.pairwise(line)):
        far, share = float(np.linalg.norm(end - start)), (k + 0.5) / PIECES
        step, mean = ((1 - share) * a + share * b for a, b in (steps, (one.edge.mean, other.edge.mean)))
        pieces.append(Edge(start, (end - start) / far, (0.0, far), step, mean))
    return pieces


def _straight(one: _Half, other: _Half) -> _Meeting | None:
    """Two that run towards each other on one line, as far as the middle between them.

    Grain and light change beside a border, its line does not. Where colours only change sides another edge crosses it.
    """
    there, back = _ways(one, other)
    if not (one.faces(other) and other.faces(one)) or _alike(there, -back):
        return None
    middle = (one.entry + other.entry) / 2
    edges = [half.until(float((middle - half.entry) @ half.way)) for half in (one, other)]
    return float(np.linalg.norm(one.entry - other.entry)), edges


def _bent(settled: Callable[[int, float], Edge | _Half | None]) -> list[Edge]:
    """An edge that no one straight line follows on both sides: each side's own, as far as the middle between them."""
    halves = [half for side in (BEFORE, AFTER) if isinstance(half := settled(side, TELLS), _Half)]
    meeting = _straight(*halves) if len(halves) == 2 else None
    return meeting[1] if meeting is not None else []


def _cross(a: np.ndarray, b: np.ndarray) -> float:
    """Positive if b [2] lies to the right of a [2]."""
    return float(a[0] * b[1] - a[1] * b[0])


def _ways(one: _Half, other: _Half) -> tuple[np.ndarray, np.ndarray]:
    """[3] each: steps from left to right of the way into the hole along one, and out of it along the other."""
    return one.inwards * one.edge.step, -other.inwards * other.edge.step


def _alike(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two edges' steps [3] are one."""
    return bool(np.linalg.norm(a - b) <= STEADY * max(np.linalg.norm(a), np.linalg.norm(b)))


def _steps(picture: np.ndarray, known: np.ndarray, hole: np.ndarray, angle: float, scale: float) -> np.ndarray:
    """[3, rows] of the picture turned by the angle: times of its noise that colours change there, by side."""
    h, w = hole.shape
    along, across = turn_of(-angle)
    side = math.ceil(math.hypot(h, w)) | 1
    middle = np.array([w - 1, h - 1]) / 2 - (side - 1) / 2 * (along + across)
    matrix = np.column_stack([along, across, middle])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    turned = cv2.warpAffine(picture, matrix, (side, side), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    shown = cv2.warpAffine(known.astype(np.float32), matrix, (side, side), flags=flags) > 0.999
    open_ = cv2.warpAffine(hole.astype(np.float32), matrix, (side, side), flags=flags) > 0.5
    rows = np.flatnonzero(open_.any(1))
    if not len(rows):
        return np.zeros((3, side))
    open_, shown, turned = open_[rows], shown[rows], turned[rows].astype(np.float64)
    weight = shown[..., None].astype(np.float64)
    sums = np.concatenate([weight, turned * weight, turned**2 * weight], axis=-1).cumsum(1)
    sums = np.concatenate([np.zeros_like(sums[:, :1]), sums], axis=1)  # [rows, side + 1, 7]
    number = np.arange(len(rows))
    begins, ends = open_.argmax(1), side - open_[:, ::-1].argmax(1)
    counts, furthest, pairs = sums[..., 0], round(FURTHEST * scale), []
    for reach in (REACH * scale, SOON * scale):
        first = (counts < (counts[number, begins] - reach)[:, None]).sum(1)
        last = (counts <= (counts[number, ends] + reach)[:, None]).sum(1) - 1
        whole = np.zeros((2, side, 7))  # of the two sides
        whole[0, rows] = sums[number, begins] - sums[number, np.maximum(first, begins - furthest)]
        whole[1, rows] = sums[number, np.minimum(last, ends + furthest)] - sums[number, ends]
        pairs.append(np.stack([np.roll(whole, k, 1) + np.roll(whole, 2 * k, 1) for k in (1, -1)], 1))
    least = 2 * LEAST * scale
    far, soon = (np.array([_told(told[k : k + 1], least) for k in (0, 1)]) for told in pairs)
    return np.concatenate([_told(pairs[0], least)[None], np.where(far >= HALF_TELLS, far, soon)])


def _told(sums: np.ndarray, least: float) -> np.ndarray:
    """[N]: steps between two rows above and two below, 0 for none.

    `sums` are [sides, 2 (above, below), N, 7]: pixels, colours, their squares; there are at least so many pixels.
    """
    pixels = sums[..., :1]
    with np.errstate(divide="ignore", invalid="ignore"):
        means = sums[..., 1:4] / pixels
        spread = np.maximum((sums[..., 4:] / pixels - means**2).sum(-1), 1.0)
        noise = (CLUMPED * spread / pixels[..., 0]).sum(1, dtype=np.float64)
        steps = means[:, 1] - means[:, 0]
        size = np.linalg.norm(steps, axis=-1)
        told = np.where(size >= STEEP, size / np.sqrt(noise), 0).min(0)
        alike = np.linalg.norm(steps[0] - steps[-1], axis=-1) <= STEADY * size.max(0)
    return np.where((pixels >= least).all((0, 1, 3)) & alike & (told >= TELLS), told, 0.0)


def _settled(
    picture: np.ndarray,
    shown: tuple[np.ndarray, np.ndarray],  # [H, W] bool: what may tell an edge, and what may tell that it ends
    hole: np.ndarray,
    angle: float,
    place: np.ndarray,
    side: int,
    least: float = HALF_TELLS,  # by which it must be told on one side
) -> Edge | _Half | None:
    """The edge at full resolution: turned and shifted to where it is told best."""
    rows, cols = np.nonzero(hole)
    pixels = np.stack([cols, rows], 1).astype(np.float64)
    known, sure = (a.astype(np.float32) for a in shown)
    outset = turn_of(-angle)[0]
    heart = place + ((pixels - place) @ outset).mean() * outset
    tells = [side in (BOTH, number) for number in (BEFORE, AFTER)]

    def at(values: np.ndarray, reach: int) -> tuple[float, Edge | _Half | None]:
        along, across = turn_of(-angle - values[0])
        return line(heart + values[1] * across, along, reach)

    def line(origin: np.ndarray, along: np.ndarray, reach: int, bow: float = 0.0) -> tuple[float, Edge | _Half | None]:
        across = np.array([-along[1], along[0]])
        cut = ((pixels - origin) @ along)[np.abs((pixels - origin) @ across) <= 2]
        if not len(cut):
            return 0.0, None
        ways = [start + step * np.arange(FURTHEST) for start, step in ((cut.min() - 1, -1), (cut.max() + 1, 1))]
        lines = []  # what lies beside it on either side of the hole
        for t, tell in zip(ways, tells):
            bows = bow / 2 * ((t - t[reach // 2]) ** 2 - reach**2 / 12)
            grid = origin + t[None, :, None] * along + (ROWS[:, None, None] + bows[:, None]) * across
            x, y = np.ascontiguousarray(grid.transpose(2, 0, 1), np.float32)
            shows = cv2.remap(known if tell else sure, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
            colours = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            lines.append(np.dstack([np.ones_like(shows), colours, colours**2]) * (shows[..., None] > 0.999))

        near = [line * (line[..., :1].cumsum(1) <= reach) for line in lines]
        telling = [line for line, tell in zip(near, tells) if tell]
        pairs = np.array([[line[rows].sum((0, 1)) for rows in (ABOVE, BELOW)] for line in telling])
        told, means = float(_told(pairs[:, :, None], 2 * LEAST)[0]), pairs[..., 1:4] / np.maximum(pairs[..., :1], 1)
        if not all(_is_edge(line, border=side != BOTH) for line in telling):
            return told, None
        lengths = [_length(line, _step(by)) if tell else 0 for line, by, tell in zip(lines, near, tells)]
        first, last = (float(t[n]) for t, n in zip(ways, lengths))
        edge = Edge(origin, along, (first, last), np.diff(means, axis=1).mean((0, 1)), means.mean((0, 1)))
        if side == BOTH:
            return told, edge
        inwards, beyond = (1, near[1]) if side == BEFORE else (-1, near[0])
        enters, leaves = (float(t) for t in (cut.min(), cut.max())[::inwards])
        seen = _goes_on(beyond[:, :CLOSE], telling[0])
        leaves += inwards * CLOSE * seen
        return told, _Half(edge, inwards, enters, leaves, bool(seen or _unknown(beyond)), 0.0)

    for reach in (REACH, SOON)[: 1 + (side != BOTH)]:
        told, found = pattern_search(partial(at, reach=reach), np.eye(2))
        if found is not None and told >= (TELLS if side == BOTH else least):
            if isinstance(found, _Half):
                bow = max(BOWS, key=lambda bow: line(found.edge.origin, found.edge.along, reach, bow)[0])
                return replace(found, bow=found.inwards * bow)
            return found
    return None


def _mean(sums: np.ndarray) -> np.ndarray:
    total = sums[..., :4].sum((0, 1))
    return total[1:] / max(total[0], 1)


def _step(sums: np.ndarray, above: slice = ABOVE, below: slice = BELOW) -> np.ndarray:
    """[3]: by how much mean colours change across a line; sums [ROWS, N, 7] beside it."""
    return _mean(sums[below]) - _mean(sums[above])


def _is_edge(sums: np.ndarray, border: bool) -> bool:
    """Whether colours step at once, and all along a line near the hole: further off it may end, as at a corner.

    As a border, it must part two regions: a thin line, or one of a texture's, has the same colours further off again.
    """
    pixels = sums[..., 0].sum(0).cumsum()
    block = (CLOSEST * pixels / max(1, min(pixels[-1], CLOSEST * BLOCK * len(ROWS)))).astype(int)
    whole = _step(sums)
    size = max(float(np.linalg.norm(whole)), 1e-9)
    near = np.array([_step(sums[:, block == k]) for k in range(CLOSEST)]) @ whole / size
    far = _step(sums, FAR_ABOVE, FAR_BELOW) @ whole
    parts = not border or far >= STEADY * (whole @ whole)
    return bool(parts and size**2 >= SHARP * far and near.min() >= STEADY * np.median(near))


def _unknown(beyond: np.ndarray) -> bool:
    """Whether too little is known beside an edge's line right beyond the hole to tell that it ended."""
    return bool(min(beyond[rows, :BEYOND, 0].sum() for rows in (ABOVE, BELOW)) < BEYOND)


def _goes_on(beyond: np.ndarray, told_by: np.ndarray) -> bool:
    """Whether what lies beyond the hole has the colours of both sides of an edge: a corner may follow soon."""
    far = STEADY * float(np.linalg.norm(_step(told_by)))
    return all(
        beyond[rows, :, 0].any() and np.linalg.norm(_mean(beyond[rows]) - _mean(told_by[rows])) < far
        for rows in (ABOVE, BELOW)
    )


def _length(sums: np.ndarray, whole: np.ndarray) -> int:
    """How many px along a line colours step like that; where they are unknown, they may."""
    last = 0
    for end in range(BLOCK, sums.shape[1] + 1, BLOCK):
        block = sums[:, end - BLOCK : end]
        if block[ABOVE, :, 0].any() and block[BELOW, :, 0].any():
            if _step(block) @ whole < STEADY * (whole @ whole):
                break
            last = end - 1
    return last


def guide_of(edges: Sequence[Edge], shape: tuple[int, ...], shrunk: float, width: float) -> np.ndarray:
    """[h, w, 8] float32 in [-1, 1]: how near to an edge a pixel lies, on which side, the edge's step and mean colour.

    Of the picture that the edges were found in, so many times shrunk. Two pixels of the same guide lie at the same
    distance from edges of a kind; it is 0 far from one (`width` is σ, px), and past its ends.
    """
    h, w = shape
    x, y = (np.arange(n, dtype=np.float32) for n in (w, h))
    guide, nearest = np.zeros((h, w, 8), np.float32), np.full((h, w), np.inf, np.float32)
    for edge in edges:
        origin = (edge.origin + 0.5) / shrunk - 0.5
        dx, dy = x[None] - np.float32(origin[0]), y[:, None] - np.float32(origin[1])
        along = dx * np.float32(edge.along[0]) + dy * np.float32(edge.along[1])
        off = (dy * np.float32(edge.along[0]) - dx * np.float32(edge.along[1])) / np.float32(width)
        there = (along >= edge.ends[0] / shrunk) & (along <= edge.ends[1] / shrunk)
        closer = there & (np.abs(off) < nearest)
        fades = np.exp(-0.5 * off**2)
        colours = fades[..., None] * np.float32(np.concatenate([edge.step, edge.mean - 128]) / 255)
        guide[closer] = np.dstack([fades, off * fades * np.float32(math.exp(0.5)), colours])[closer]
        nearest[closer] = np.abs(off)[closer]
    return guide

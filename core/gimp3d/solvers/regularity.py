"""Motions that map a picture's surroundings of a hole onto themselves: lattices, turns about a centre, reflections.

What is regular is not invented: where a rigid motion of the picture explains nearly all of what is known round the
hole, it also tells what is in it (offset statistics of He & Sun 2012, with rotations and reflections).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ..compute.threads import parallel_map
from ..geometry import colours_at, dilated

SIDE = 96  # px: pictures are shrunk to this to find motions in
ANGLES = sorted({360.0 * k / n for n in range(1, 13) for k in range(n)})  # degrees; of figures with up to 12 arms
EXPLAINED = 0.97  # share of the variance that a motion must explain, of the surroundings and right beside the hole
LOCALLY = 0.5  # share of the variance within some px, grain left out: a board's grain must not turn with a plate's rim
GRAIN, LOCAL = 2.0, 6.0  # px, σ of what is left out and of what is some
OVERLAP = 0.75  # share of the surroundings that it must map to something known
TOLD = 0.2  # share of the hole that it must tell
CANDIDATES = 3  # translations that are looked at for every angle
TRIED = 16  # motions that are followed up
BAND = 0.75  # width of the surroundings, in thicknesses of the hole
LEAST_BAND = 6  # px
PLAIN = 3 * 255.0**-2  # variance of the surroundings, one grey level in each channel, below which nothing is regular
RIM = 4  # px right beside the hole

Places = tuple[np.ndarray, np.ndarray]  # rows and columns of pixels


@dataclass(frozen=True)
class Motion:
    """The pixel p = (row, col) looks like the pixel `turn` @ p + `shift`."""

    turn: np.ndarray  # [2, 2], a rotation or a reflection
    shift: np.ndarray  # [2] px
    explained: float  # share of the variance round the hole
    misfit: float  # RMS grey levels of what is not explained


def find_motions(image: np.ndarray, hole: np.ndarray, known: np.ndarray) -> tuple[Motion, ...]:
    """The motions that explain what is round a picture's hole, best first; none in most pictures.

    The picture is [H, W, 3] uint8; hole and what it shows well, `known`, are [H, W] bool. Reflections are asked where
    nothing turns or repeats: what has both tells by either.
    """
    scale = min(1.0, SIDE / max(hole.shape))
    size = (max(1, round(hole.shape[1] * scale)), max(1, round(hole.shape[0] * scale)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    there = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
    open_ = cv2.resize(hole.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
    band = _band(open_, there)
    if not open_.any() or not band.any() or _variance(small, band) < PLAIN:
        return ()
    ratio = np.array([hole.shape[0] / size[1], hole.shape[1] / size[0]])
    picture, ring = image.astype(np.float32) / 255, _band(hole, known)
    texture = _texture(picture, known)

    def motions(mirrored: bool) -> tuple[Motion, ...]:
        coarse = parallel_map(lambda angle: _of_turn(small, there, open_, band, angle, mirrored), ANGLES)
        found = []
        for _, angle, shift in sorted((c for of_turn in coarse for c in of_turn), key=lambda c: c[0])[:TRIED]:
            corner = turn_of(angle, mirrored).sum(1) / 2  # centres of pixels lie at p + 1/2 in either resolution
            found.append((angle, mirrored, ratio * (shift + 0.5 - corner) - 0.5 + corner))
        settled = parallel_map(lambda f: _settled(picture, texture, known, hole, ring, f), found)
        return tuple(sorted((m for m in settled if m is not None), key=lambda m: -m.explained))

    return motions(mirrored=False) or motions(mirrored=True)


def continue_regularly(
    image: np.ndarray, hole: np.ndarray, known: np.ndarray, motions: tuple[Motion, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """The picture with what motions, see find_motions, tell of the hole, and of which of its pixels [H, W] bool."""
    filled, left = image.copy(), hole.copy()
    for motion in motions:
        rows, cols = np.nonzero(left)
        y, x = _mapped(motion.turn, motion.shift, rows, cols)
        tells = _sample(known.astype(np.float32), y, x) > 0.999
        filled[rows[tells], cols[tells]] = _sample(image, y[tells], x[tells], cv2.INTER_CUBIC)
        left[rows[tells], cols[tells]] = False
    return filled, hole & ~left


def turn_of(angle: float, mirrored: bool = False) -> np.ndarray:
    """[2, 2] a turn by degrees, or a reflection at an axis of half the angle; its columns, a turn back's rows, are the
    turned axes."""
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    return np.array([[c, s], [s, -c]] if mirrored else [[c, -s], [s, c]])


def _band(hole: np.ndarray, known: np.ndarray) -> np.ndarray:
    """[H, W] bool: what is known round the hole."""
    thickness = float(cv2.distanceTransform(hole.astype(np.uint8), cv2.DIST_L2, 5).max(initial=0))
    far = cv2.distanceTransform((~hole).astype(np.uint8), cv2.DIST_L2, 5)
    return known & (far <= max(LEAST_BAND, 2 * BAND * thickness))


def _variance(image: np.ndarray, where: np.ndarray | Places) -> float:
    return float(image[where].var(0).sum())


def _of_turn(
    image: np.ndarray, known: np.ndarray, hole: np.ndarray, band: np.ndarray, angle: float, mirrored: bool
) -> list[tuple[float, float, np.ndarray]]:
    """(cost, angle, shift) of the translations after this turn under which the band is most like what it is mapped to.

    Sums of squared differences over what both sides know, for all translations at once (Fourier transforms).
    """
    import scipy.fft  # slow to import, and many removals fill no picture

    h, w = hole.shape
    side = (h, w) if angle == 0 else (math.ceil(math.hypot(h, w)),) * 2
    turn = turn_of(angle, mirrored)
    middle = np.array([h - 1, w - 1]) / 2 - turn @ (np.array(side) - 1) / 2  # turned pixel z shows turn @ z + middle
    matrix = np.array([[turn[1, 1], turn[1, 0], middle[1]], [turn[0, 1], turn[0, 0], middle[0]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    turned = cv2.warpAffine(image, matrix, side[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)
    shown = cv2.warpAffine(known.astype(np.float32), matrix, side[::-1], flags=flags) > 0.999
    shape = tuple(scipy.fft.next_fast_len(a + b, real=True) for a, b in zip((h, w), side))

    def spectrum(a: np.ndarray) -> np.ndarray:
        return scipy.fft.rfft2(a, shape, axes=(0, 1))

    def correlated(*pairs: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        return scipy.fft.irfft2(sum(np.conj(a) * b for a, b in pairs), shape)

    here, there = band.astype(np.float32), shown.astype(np.float32)
    of_there, of_here = spectrum(there), spectrum(here)
    squares = spectrum((image**2).sum(-1) * here), spectrum((turned**2).sum(-1) * there)
    products = np.conj(spectrum(image * here[..., None])) * spectrum(turned * there[..., None])
    overlap = correlated((of_here, of_there))
    differs = correlated((squares[0], of_there), (of_here, squares[1])) - 2 * scipy.fft.irfft2(products.sum(-1), shape)
    tells = correlated((spectrum(hole.astype(np.float32)), of_there))
    allowed = (overlap >= OVERLAP * band.sum()) & (tells >= TOLD * hole.sum())
    score = np.where(allowed, differs / np.maximum(overlap, 1), np.inf)
    limit = 2 * _variance(image, band)
    found = []
    for _ in range(CANDIDATES):
        v, u = np.unravel_index(int(score.argmin()), score.shape)
        if not score[v, u] < 0.5 * limit:  # pictures are settled finely later, and explain more then
            break
        moved = np.array([v - shape[0] if v >= side[0] else v, u - shape[1] if u >= side[1] else u])
        found.append((float(score[v, u]), angle, turn @ moved + middle))
        rows, cols = (np.arange(at - 2, at + 3) % n for at, n in zip((v, u), score.shape))
        score[np.ix_(rows, cols)] = np.inf
    return found


def _texture(image: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The picture [H, W, 3] without its grain, and the variance [H, W] of that about each pixel, where it is known."""

    def mean(values: np.ndarray, sigma: float) -> np.ndarray:
        sums = cv2.GaussianBlur(np.dstack([values, np.ones(known.shape, np.float32)]) * known[..., None], (0, 0), sigma)
        return sums[..., :-1] / np.maximum(sums[..., -1:], 1e-6)

    smooth = mean(image, GRAIN)
    return smooth, (mean(smooth**2, LOCAL) - mean(smooth, LOCAL) ** 2).sum(-1)


def _settled(
    image: np.ndarray,
    texture: tuple[np.ndarray, np.ndarray],
    known: np.ndarray,
    hole: np.ndarray,
    band: np.ndarray,
    guess: tuple[float, bool, np.ndarray],
) -> Motion | None:
    """The motion near a guess that explains most, if that is enough; it turns about the hole."""
    angle, mirrored, shift = guess
    ring, inside, rim = (_thinned(a, n) for a, n in ((band, 4000), (hole, 1000), (known & dilated(hole, RIM), 4000)))
    if not len(rim[0]):  # photos disagree all round: nothing tells what ends at the hole
        return None
    shows, of_ring, of_rim = known.astype(np.float32), _variance(image, ring), _variance(image, rim)
    middle = np.argwhere(hole).mean(0)
    target = turn_of(angle, mirrored) @ middle + shift

    def at(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        turn = turn_of(angle + values[0], mirrored)
        return turn, target + values[1:] - turn @ middle

    def explained(
        values: np.ndarray, of: Places = ring, variance: float = of_ring, overlap: float = OVERLAP
    ) -> tuple[float, np.ndarray]:
        """Share of the pixels' variance, and the values; so many of them must be mapped to something known."""
        rows, cols = of
        y, x = _mapped(*at(values), rows, cols)
        both = _sample(shows, y, x) > 0.999
        if both.sum() < max(1, overlap * len(rows)):
            return -np.inf, values
        rest = ((_sample(image, y[both], x[both]) - image[rows[both], cols[both]]) ** 2).sum(-1).mean()
        return 1 - float(rest) / (2 * max(variance, PLAIN)), values

    best, values = pattern_search(explained, np.eye(3)[0 if angle or mirrored else 1 :])
    y, x = _mapped(*at(values), *inside)
    tells = (_sample(shows, y, x) > 0.999).mean() >= TOLD
    # where something ends at the hole, only its rim contradicts; where it is plain, something far off is explained
    if not tells or min(best, explained(values, rim, of_rim, 0)[0]) < EXPLAINED:
        return None
    rows, cols = ring
    y, x = _mapped(*at(values), rows, cols)
    both = _sample(shows, y, x) > 0.999
    smooth, varies = texture[0], np.maximum(texture[1][rows, cols], PLAIN)
    differs = ((_sample(smooth, y, x) - smooth[rows, cols]) ** 2).sum(-1)
    if np.mean((differs / (2 * varies))[both]) > 1 - LOCALLY:
        return None
    return Motion(*at(values), best, 255 * math.sqrt(max(0.0, 1 - best) * 2 * of_ring / 3))


def pattern_search(at: Callable[[np.ndarray], tuple[float, Any]], axes: np.ndarray) -> tuple[float, Any]:
    """The best score, and what comes with it, of values [N] near 0; steps of 1 to 0.1 along axes [K, N] are tried
    (Hooke 1961)."""
    values, step = np.zeros(axes.shape[1]), 1.0
    best = at(values)
    while step > 0.1:
        moves = [values + step * sign * axis for axis in axes for sign in (1, -1)]
        found = [at(m) for m in moves]
        k = int(np.argmax([score for score, _ in found]))
        if found[k][0] > best[0]:
            values, best = moves[k], found[k]
        else:
            step /= 2
    return best


def _thinned(where: np.ndarray, most: int) -> Places:
    rows, cols = np.nonzero(where)
    step = max(1, -(-len(rows) // most))
    return rows[::step], cols[::step]


def _mapped(turn: np.ndarray, shift: np.ndarray, rows: np.ndarray, cols: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    y = turn[0, 0] * rows + turn[0, 1] * cols + shift[0]
    x = turn[1, 0] * rows + turn[1, 1] * cols + shift[1]
    return y.astype(np.float32), x.astype(np.float32)


def _sample(picture: np.ndarray, y: np.ndarray, x: np.ndarray, how: int = cv2.INTER_LINEAR) -> np.ndarray:
    """Values [N, ...] at places of a picture, 0 outside."""
    return colours_at(picture, np.stack([x, y], -1) + 0.5, how, cv2.BORDER_CONSTANT)

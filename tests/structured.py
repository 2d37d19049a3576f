"""Pictures with structure and a known answer, each with a hole that the structure runs into."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

SIDE, FINER = 200, 3  # px; samples per pixel along each axis
FINEST = 1.5  # px, σ: a weave's threads are no edges
EDGE = 24.0  # grey levels per pixel from which a slope is an edge
Field = Callable[[np.ndarray, np.ndarray], np.ndarray]


def structured() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Name → (picture [200, 200, 3] uint8, hole [200, 200] bool)."""
    drawn = {
        "checker": _mixed(_share(_checker), (215, 210, 200), (110, 125, 140)) + _grain(1, 4),
        "bricks": _bricks() + _grain(2, 5),
        "stripes ending": _mixed(
            _share(lambda y, x: _turned(y, x, 25)[0] > 10),
            (196, 160, 110),
            _mixed(_share(lambda y, x: _turned(y, x, 25)[1] % 22 < 9), (60, 70, 120), (230, 228, 220)),
        )
        + _grain(3, 4),
        "rug": _flower() + _grain(5, 4),
        "text-like": _mixed(_share(_glyphs), (40, 40, 40), (238, 236, 228)) + _grain(6, 3),
        "curved edge": _mixed(
            _share(lambda y, x: np.hypot(y - 1.15 * SIDE, x - 0.3 * SIDE) < 150), (90, 130, 90), (220, 205, 180)
        )
        + _grain(7, 5),
        "plate": _mixed(
            _share(lambda y, x: np.hypot(y - 0.9 * SIDE, x - 0.4 * SIDE) < 80),
            (225, 225, 220),
            (165, 115, 70) + _grain(14, 14, 3) + 8 * np.sin(0.35 * np.arange(SIDE))[:, None, None],
        )
        + _grain(15, 3),
        "book row": _books() + _grain(9, 3),
        "two mats and wood": _mats() + _grain(11, 3),
        "step": _mixed(_share(lambda y, x: _turned(y, x, 33)[0] > 3), (70, 60, 55), (200, 190, 175)) + _grain(12, 4),
        "corner": _mixed(
            _share(lambda y, x: (_turned(y, x, 20)[0] > -12) & (_turned(y, x, 20)[1] > -10)),
            (200, 80, 60),
            (205, 200, 190),
        )
        + _grain(13, 4),
    }
    hole = _blob()
    return {name: (np.clip(np.rint(picture), 0, 255).astype(np.uint8), hole) for name, picture in drawn.items()}


def edge_error(filled: np.ndarray, truth: np.ndarray, hole: np.ndarray) -> float:
    """px: mean distance between the edges in the hole and the truth's, both ways; NaN where the truth has none."""
    inner = cv2.erode(hole.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    ours, theirs = (_edges(p) for p in (filled, truth))
    if not (theirs & inner).any():
        return float("nan")
    if not ours.any():
        return float(SIDE)
    away = [cv2.distanceTransform((~e).astype(np.uint8), cv2.DIST_L2, 5) for e in (ours, theirs)]
    both = [a[e & inner].mean() for a, e in zip(away, (theirs, ours)) if (e & inner).any()]
    return float(np.mean(both))


def _edges(picture: np.ndarray) -> np.ndarray:
    """[H, W] bool: where colours change most steeply across an edge."""
    grey = cv2.GaussianBlur(picture.astype(np.float32).mean(-1), (0, 0), FINEST)
    return cv2.Canny(np.clip(grey, 0, 255).astype(np.uint8), EDGE, 2 * EDGE, L2gradient=True) > 0


def _turned(y: np.ndarray, x: np.ndarray, degrees: float) -> tuple[np.ndarray, np.ndarray]:
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    y, x = y - SIDE / 2, x - SIDE / 2
    return c * y + s * x, c * x - s * y


def _share(inside: Field) -> np.ndarray:
    """[200, 200]: the share of each pixel that lies inside."""
    y, x = np.mgrid[: SIDE * FINER, : SIDE * FINER] / FINER
    return cv2.resize(inside(y, x).astype(np.float32), (SIDE, SIDE), interpolation=cv2.INTER_AREA)


def _mixed(share: np.ndarray, one: object, other: object) -> np.ndarray:
    return share[..., None] * np.asarray(one, float) + (1 - share[..., None]) * np.asarray(other, float)


def _grain(seed: int, strength: float, size: float = 1.0) -> np.ndarray:
    """[200, 200, 1]: noise whose grains are `size` px; strength in grey levels before it is smoothed."""
    noise = np.random.default_rng(seed).normal(size=(SIDE, SIDE))
    return strength * size * cv2.GaussianBlur(noise, (0, 0), size)[..., None]


def _checker(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    v, u = _turned(y, x, 12)
    return (np.floor(v / 26) + np.floor(u / 26)) % 2 > 0


def _bricks() -> np.ndarray:
    def joint(y: np.ndarray, x: np.ndarray) -> np.ndarray:
        v, u = _turned(y, x, 0)
        return (v % 18 < 2.5) | ((u + np.floor(v / 18) % 2 * 20) % 40 < 2.5)

    v, u = _turned(*np.mgrid[:SIDE, :SIDE].astype(float), 0)
    row = np.floor(v / 18).astype(int)
    tone = np.random.default_rng(4).normal(0, 14, (40, 40))[
        row % 40, np.floor((u + row % 2 * 20) / 40).astype(int) % 40
    ]
    return _mixed(_share(joint), (190, 185, 178), (160, 80, 60) + tone[..., None] * (1, 0.8, 0.7))


def _flower() -> np.ndarray:
    def petals(radius: float, wave: float, phase: float) -> np.ndarray:
        def inside(y: np.ndarray, x: np.ndarray) -> np.ndarray:
            y, x = y - SIDE / 2, x - SIDE / 2
            return np.hypot(y, x) < radius + wave * np.cos(8 * np.arctan2(y, x) + phase)

        return _share(inside)

    heart = _mixed(petals(24, 6, np.pi), (235, 215, 160), (190, 70, 60))
    return _mixed(petals(48, 10, 0), heart, (60, 60, 110))


def _glyphs(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    v, u = y % 24, x % 16
    odd = (np.sin(np.floor(y / 24) * 12.9 + np.floor(x / 16) * 78.2) * 43758.5) % 1 > 0.5
    return (v > 5) & (v < 19) & (u > 3) & (u < 12) & ~((u > 5) & (u < 10) & (v > 8) & (v < 16) & odd)


def _books() -> np.ndarray:
    random = np.random.default_rng(8)
    ends = np.cumsum(random.integers(9, 20, 30))
    colours, tops = random.uniform(50, 220, (31, 3)), random.uniform(20, 34, 31)
    y, x = np.mgrid[:SIDE, :SIDE]
    book = np.searchsorted(ends, x)
    spine = (x - ends[np.clip(book - 1, 0, 29)])[..., None] < 2
    row = np.where(y[..., None] < tops[book][..., None], (120.0, 110.0, 100.0), colours[book] - 30.0 * spine)
    return np.where(y[..., None] > SIDE - 50, np.add(_grain(9, 6, 3), (150, 110, 70)), row)


def _mats() -> np.ndarray:
    def left(y: np.ndarray, x: np.ndarray) -> np.ndarray:
        return _turned(y, x, 8)[1] < -15

    def right(y: np.ndarray, x: np.ndarray) -> np.ndarray:
        v, u = _turned(y, x, 8)
        return (u > 15) & (v < 35)

    v, u = _turned(*np.mgrid[:SIDE, :SIDE].astype(float), 8)
    weave = (120 + 25 * np.sin(1.4 * u) * np.sin(1.4 * v))[..., None] * (0.8, 0.95, 1.1)
    pink = (225, 150, 140) + 8 * np.sin(1.2 * v)[..., None]
    wood = (165, 115, 70) + _grain(10, 14, 3) + 8 * np.sin(0.35 * u)[..., None]
    return _mixed(_share(left), weave, _mixed(_share(right), pink, wood))


def _blob() -> np.ndarray:
    """[200, 200] bool: an irregular hole in the middle."""
    y, x = np.mgrid[:SIDE, :SIDE] - SIDE / 2
    angle = np.arctan2(y, x)
    waves = zip((2, 3, 5), (0.18, 0.1, 0.06), np.random.default_rng(1).uniform(0, 6, 3))
    return np.hypot(y, x) < 32 * (1 + sum(size * np.sin(count * angle + phase) for count, size, phase in waves))

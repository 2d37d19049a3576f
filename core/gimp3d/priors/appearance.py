"""What providers of appearance are given and what they give back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .calls import Call

SURROUNDINGS = 1.0  # margin round the hole's bounding box that textures are taken from, in its side lengths
LEAST_SURROUNDINGS = 32  # px, at least


@dataclass(frozen=True)
class Appearance:
    """The reference without the object."""

    image: np.ndarray  # [H, W, 3] uint8; outside the hole it is the input, bit for bit
    confidence: float
    reason: str
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Unfinished:
    """What a provider is given. It may return anything inside the hole; what it returns outside is ignored."""

    image: np.ndarray  # [H, W, 3] uint8; what stands in the hole means nothing
    hole: np.ndarray  # [H, W] bool, not empty
    seed: int = 0  # the same seed gives the same fill
    unknown: np.ndarray | None = None  # [H, W] bool, pixels that mean nothing either, but are not to be filled
    variant: int = 0  # another fill of the same hole, for people to choose from


Provider = Callable[[Unfinished], Appearance]

# (picture [h, w, 3] uint8, mask [h, w] bool: what is to be painted, seed, call) → the picture painted, [H, W, 3] uint8
Paint = Callable[[np.ndarray, np.ndarray, int, Call], np.ndarray]


@dataclass(frozen=True)
class Painter:
    """Who paints pictures outside this program: a network, another program, a server."""

    who: str  # for messages
    paint: Paint  # its answer is of about the picture's shape, in any size; it need not respect the mask
    answer: str  # what its picture is called in messages
    whole: bool = False  # it is given the whole view, not the hole's surroundings
    notice: str = ""  # what is sent where and what that costs, said before anything is done


def window_round_hole(hole: np.ndarray) -> tuple[slice, slice]:
    """The hole's bounding box, larger by its own size on every side."""
    spans = []
    for axis in (0, 1):
        there = np.flatnonzero(hole.any(1 - axis))
        low, high = int(there[0]), int(there[-1]) + 1
        margin = max(LEAST_SURROUNDINGS, round(SURROUNDINGS * (high - low)))
        spans.append(slice(max(0, low - margin), high + margin))
    return spans[0], spans[1]

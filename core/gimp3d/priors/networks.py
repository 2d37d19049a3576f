"""What networks are fed and what their answers mean, whoever runs them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from ..errors import BadInput
from .pasting import scaled

BRIGHTEST = 2.0  # answers up to here are in [0, 1], give or take what networks overshoot
LONGEST = 8192  # px of a side that a model may declare or be asked for: more is a damaged file or a slip
IMAGENET_MEAN = np.array([0.485, 0.456, 0.406], np.float32)  # of RGB in [0, 1], as published models were trained
IMAGENET_STD = np.array([0.229, 0.224, 0.225], np.float32)


def path_and_size(argument: str, who: str) -> tuple[Path, tuple[int, int] | None]:
    """PATH[,WIDTHxHEIGHT] taken apart; the size is (width, height).

    Raises
    ------
    BadInput
        If the size is none that a picture can have.
    """
    found = re.search(r",(\d+)x(\d+)$", argument)
    if not found:
        return Path(argument), None
    size = int(found[1]), int(found[2])
    check_size(size, f"{who}: {found[0][1:]}")
    return Path(argument[: found.start()]), size


def check_size(size: tuple[int, int], what: str) -> None:
    """Raise BadInput if (width, height) is no size for a picture; `what` says whose it is."""
    if not all(0 < side <= LONGEST for side in size):
        raise BadInput(f"{what} is no size for a picture: sides are from 1 to {LONGEST} pixels")


def with_black_hole(
    image: np.ndarray,  # [H, W, 3] uint8
    mask: np.ndarray,  # [H, W] bool
    width: int,
    height: int,
) -> tuple[np.ndarray, np.ndarray]:
    """What networks that paint are fed: the picture [height, width, 3] in [0, 1], 0 in the hole, and the hole, bool."""
    hole = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0
    return scaled(image, width, height).astype(np.float32) / 255 * ~hole[..., None], hole


def as_picture(answer: np.ndarray, who: str) -> np.ndarray:
    """A network's answer of [1, 3, H, W] in [0, 1] or [0, 255] as [H, W, 3] uint8."""
    values = np.squeeze(answer)
    if values.ndim != 3 or values.shape[0] != 3 or not np.isfinite(values).all():
        raise BadInput(f"{who} answers with {times(answer.shape)}, which is no finite picture")
    if values.max() <= BRIGHTEST:
        values = values * 255
    return np.clip(np.rint(values), 0, 255).astype(np.uint8).transpose(1, 2, 0)


def as_depth(answers: Sequence[np.ndarray], who: str) -> np.ndarray:
    """The first of a network's answers that has two long axes, [h, w] float32."""
    for answer in answers:
        values = np.squeeze(answer)
        if values.ndim == 2 and min(values.shape) > 1:
            return values.astype(np.float32)
    raise BadInput(f"{who} answers with {', '.join(times(a.shape) for a in answers)}, which is no depth picture")


def times(shape: Sequence[int]) -> str:
    return "×".join(map(str, shape))

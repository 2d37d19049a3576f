"""As much detail in the fill as the scene draws of what photos show beside it.

Splats are blurred, and charts, pictures and photos are not: a fill as sharp as those stands out as a patch.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from ...geometry import blurred

BLURS = (0.6, 1.2, 2.4, 4.8)  # px, σ of the blurs between whose results the bands of detail lie
ROUND = 24  # px round the hole in which photo and scene are compared
FAINT = 1e-3  # squared grey levels of a band in which there is nothing


def as_drawn(
    picture: np.ndarray,  # [H, W, 3] float32
    where: np.ndarray,  # [H, W] bool, where it is known
    photo: np.ndarray,  # [H, W, 3] uint8
    drawn: np.ndarray,  # [H, W, 3] uint8, what the scene draws of the same
    beside: np.ndarray,  # [H, W] bool, where these two show the picture's surface
) -> np.ndarray:
    """The picture with the share of each band of its detail that the scene draws of the photo's, [H, W, 3] float32.

    A band's share is Σ d·p / Σ p² of its details p in the photo and d in the drawing, from 0 to 1: of all filters that
    weigh bands, it makes of the photo what is nearest to the drawing (Wiener 1949).
    """
    if not beside.any():
        return picture
    grey = (cv2.cvtColor(p, cv2.COLOR_RGB2GRAY).astype(np.float32) for p in (photo, drawn))
    told = [(p[beside] @ d[beside], p[beside] @ p[beside]) for p, d in zip(*(_bands(g, beside) for g in grey))]
    result = picture.copy()
    for detail, (both, all_) in zip(_bands(picture, where), told):
        result -= (1 - np.clip(both / max(float(all_), FAINT), 0, 1)) * detail
    return np.where(where[..., None], result, picture)


def _bands(picture: np.ndarray, where: np.ndarray) -> Iterator[np.ndarray]:
    """Differences of a picture's blurs, from fine to coarse; only what is known of it counts."""
    finer = picture
    for sigma in BLURS:
        coarser = blurred(picture, where, sigma)
        yield finer - coarser
        finer = coarser

"""How colours differ between the reference and a view, learned from what both show."""

from __future__ import annotations

import cv2
import numpy as np

from ...solvers.colours import NO_CHANGE, ColourChange, learn_change
from .blend import SEAM, SQUARE

SECTORS = 8  # places round the hole, by the direction from its centre, that predict one another
MOST_PAIRS = 4000  # of the surroundings that colours are learned from
SMOOTHING = 1 / 20  # of the reach: half the side of the square that pairs are means of, against misregistration


def learned_change(
    warped: np.ndarray, difference: np.ndarray, alike: np.ndarray, hole: np.ndarray, reach: int
) -> ColourChange:
    """How colours change from the reference to this view, by what both show up to `reach` px round the `hole` [h, w]
    bool: `warped` [h, w, 3] float32 are the reference's colours in the view, `difference` [h, w, 3] the view less
    those, `alike` [h, w] bool the pixels that both show.

    What depends on the place (a highlight) comes into the hole from its rim, by the blend; what depends on the colour,
    hence on the material and on the exposure, is learned.
    """
    count = int(alike.sum())
    if not count:
        return NO_CHANGE
    rows, cols = (x[:: -(-count // MOST_PAIRS)] for x in np.nonzero(alike))
    radius = max(1, round(SMOOTHING * reach))
    colours, change = (_blurred(x, alike, radius)[rows, cols] for x in (warped, difference))
    centre = [x.mean() for x in np.nonzero(hole)]
    turn = np.arctan2(rows - centre[0], cols - centre[1]) / (2 * np.pi) + 0.5
    sector = (SECTORS * turn).astype(int) % SECTORS
    return learn_change(colours, change, sector, np.ones(len(rows)))


def flat(depth: np.ndarray) -> np.ndarray:
    """[h, w] bool: pixels beside no depth edge, where photos do not mix surfaces."""
    nearest = cv2.erode(np.where(depth > 0, depth, 0).astype(np.float32), SQUARE)
    return (cv2.dilate(depth, SQUARE) - nearest) < SEAM * depth


def _blurred(values: np.ndarray, where: np.ndarray, radius: int) -> np.ndarray:
    """The values' means over the pixels `where` of a square, [h, w, 3]."""
    side = (2 * radius + 1, 2 * radius + 1)
    weight = cv2.blur(where.astype(np.float32), side)
    total = cv2.blur((values * where[..., None]).astype(np.float32), side)
    return total / np.maximum(weight, 1e-6)[..., None]

"""Where a hole's pixels are copied from: real pixels, seams where they show least, texture as loud as round it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gimp3d.solvers.exemplar import complete_picture
from gimp3d.solvers.patchmatch import NearestNeighbourField
from gimp3d.solvers.shift_map import shift_map

HOLE = np.zeros((60, 80), bool)
HOLE[20:40, 20:45] = True
PERIOD = 30  # px to the right, by which the picture repeats


@pytest.fixture
def picture() -> np.ndarray:
    tile = np.random.default_rng(0).random((60, PERIOD, 3))
    return np.tile(tile, (1, 3, 1))[:, :80].astype(np.float32)


def field_of(shift: np.ndarray) -> NearestNeighbourField:
    """A field by shifts [60, 80, 2] in the hole."""
    rows, cols = (
        np.where(HOLE, at + shift[..., k], -1).astype(np.int32) for k, at in enumerate(np.indices(HOLE.shape))
    )
    return NearestNeighbourField(rows, cols, np.zeros(HOLE.shape, np.float32))


def test_a_few_pixels_that_are_copied_from_elsewhere_follow_their_neighbours(picture: np.ndarray) -> None:
    rng, shift = np.random.default_rng(1), np.zeros((*HOLE.shape, 2), int)
    shift[..., 1] = PERIOD
    right = field_of(shift)
    stray = HOLE & (rng.random(HOLE.shape) < 0.2)
    shift[stray, 0] += rng.integers(-9, 10, stray.sum())
    shift[stray, 1] -= 3
    found = shift_map(picture, HOLE, ~HOLE, field_of(shift))
    same = (found.rows == right.rows) & (found.cols == right.cols)
    assert same[HOLE].mean() > 0.99


def test_a_field_of_one_shift_stays(picture: np.ndarray) -> None:
    shift = np.zeros((*HOLE.shape, 2), int)
    shift[..., 1] = PERIOD
    before = field_of(shift)
    found = shift_map(picture, HOLE, ~HOLE, before)
    assert (found.rows == before.rows).all() and (found.cols == before.cols).all()


def test_texture_is_as_loud_in_the_hole_as_round_it() -> None:
    """Averages of patches are not: 0.54 of it here."""
    rng = np.random.default_rng(2)
    grain = cv2.GaussianBlur(rng.normal(0, 40, (160, 200, 1)).astype(np.float32), (0, 0), 0.7)
    truth = np.clip(128 + grain[..., None].repeat(3, 2), 0, 255).astype(np.uint8)
    hole = np.zeros(truth.shape[:2], bool)
    hole[60:100, 70:130] = True
    filled = complete_picture(truth, hole)[0].astype(np.float32)
    detail = filled - cv2.GaussianBlur(filled, (0, 0), 1.0)
    inner = np.s_[64:96, 74:126]
    assert 0.6 < detail[inner].std() / detail[~hole].std() < 1.25

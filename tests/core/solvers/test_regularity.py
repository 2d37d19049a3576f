"""What is regular is continued by the motion that explains it; what is not, is not taken for regular."""

from __future__ import annotations

import warnings

import cv2
import numpy as np
import pytest
from structured import structured

from gimp3d.solvers.regularity import continue_regularly, find_motions

PICTURES = structured()


def told(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(truth, what was made of the picture, which pixels motions tell of)."""
    truth, hole = PICTURES[name]
    holed = np.where(hole[..., None], np.uint8(0), truth)
    motions = find_motions(holed, hole, ~hole)
    return truth, *continue_regularly(holed, hole, ~hole, motions)


@pytest.mark.parametrize("name", ["checker", "stripes ending", "curved edge", "step"])
def test_lattices_and_turns_tell_the_whole_hole(name: str) -> None:
    truth, filled, regular = told(name)
    assert (regular == PICTURES[name][1]).all()
    off = np.abs(filled[regular].astype(float) - truth[regular]).mean(-1)
    assert np.median(off) < 4  # the grain of the picture
    assert (off > 30).mean() < 0.02  # no edge in another place


def test_arms_of_a_flower_are_turned_into_place() -> None:
    truth, filled, regular = told("rug")
    assert 0.2 < regular.sum() / PICTURES["rug"][1].sum() < 1  # its middle is seen nowhere
    assert np.median(np.abs(filled[regular].astype(float) - truth[regular])) < 4


def test_a_boards_grain_is_not_turned_with_a_plates_rim() -> None:
    truth, hole = PICTURES["plate"]
    motions = find_motions(np.where(hole[..., None], np.uint8(0), truth), hole, ~hole)
    assert all(abs(motion.turn[1, 0]) < 0.1 for motion in motions)


@pytest.mark.parametrize("angle", [0.0, 33.0])
def test_what_has_an_axis_is_reflected_at_it(angle: float) -> None:
    half = np.random.default_rng(1).integers(0, 256, (130, 75, 3), dtype=np.uint8)
    half = cv2.normalize(cv2.GaussianBlur(half.astype(np.float32), (0, 0), 5), None, 20, 235, cv2.NORM_MINMAX)
    whole = np.concatenate([half, half[:, ::-1]], 1)
    middle = whole.shape[1] / 2, whole.shape[0] / 2
    matrix = cv2.getRotationMatrix2D(middle, angle, 1.0)
    truth = cv2.warpAffine(whole, matrix, whole.shape[1::-1]).astype(np.uint8)
    known = cv2.warpAffine(np.ones(whole.shape[:2], np.uint8), matrix, whole.shape[1::-1]) > 0
    hole = np.zeros(known.shape, bool)
    hole[45:80, 40:66] = True
    motions = find_motions(np.where(hole[..., None], np.uint8(0), truth), hole, known & ~hole)
    filled, regular = continue_regularly(truth, hole, known & ~hole, motions)
    assert motions and np.linalg.det(motions[0].turn) < 0
    assert regular.sum() > 0.9 * hole.sum()
    assert np.abs(filled[regular].astype(float) - truth[regular]).mean() < 4


@pytest.mark.parametrize("name", ["corner", "book row", "two mats and wood"])
def test_what_has_no_counterpart_is_left_to_others(name: str) -> None:
    assert not told(name)[2].any()


@pytest.mark.parametrize("strength", [0, 1, 60])
def test_noise_and_plain_pictures_are_not_regular(strength: int) -> None:
    random = np.random.default_rng(3)
    picture = np.clip(128 + strength * random.normal(size=(90, 120, 3)), 0, 255).astype(np.uint8)
    hole = np.zeros((90, 120), bool)
    hole[30:60, 40:75] = True
    assert find_motions(picture, hole, ~hole) == ()


def test_a_stripe_does_not_make_the_wall_beside_it_regular() -> None:
    """A wall that darkens to one side, and a white stripe far from the hole: the stripe is nearly all that varies."""
    rows, cols = np.mgrid[:90, :120]
    wall = 150 - 0.12 * rows[..., None] + np.random.default_rng(0).normal(0, 1, (90, 120, 3))
    picture = np.where((np.abs(cols - 95) < 4)[..., None], 230, wall).astype(np.uint8)
    hole = (np.abs(rows - 40) < 16) & (np.abs(cols - 60) < 20)
    assert find_motions(picture, hole, ~hole) == ()


def test_a_hole_without_surroundings_has_no_motions() -> None:
    hole = np.ones((40, 50), bool)
    picture = np.zeros((40, 50, 3), np.uint8)
    assert find_motions(picture, hole, ~hole) == ()
    assert not continue_regularly(picture, hole, ~hole, ())[1].any()


def test_without_a_rim_that_is_known_nothing_tells_what_ends_at_the_hole() -> None:
    rows, cols = np.mgrid[:120, :160]
    picture = np.where(((rows // 10 + cols // 10) % 2)[..., None] == 0, np.uint8(60), np.uint8(200)).repeat(3, -1)
    hole = np.zeros(rows.shape, bool)
    hole[50:70, 60:100] = True
    assert find_motions(picture, hole, ~hole)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert find_motions(picture, hole, cv2.dilate(hole.astype(np.uint8), np.ones((13, 13))) == 0) == ()


def test_a_large_hole_is_told_as_well() -> None:
    """cv2.remap refuses pictures of 32,768 rows or columns."""
    rows, cols = np.mgrid[:300, :420]
    truth = np.where(((rows // 20 + cols // 20) % 2)[..., None] == 0, np.uint8(60), np.uint8(200)).repeat(3, -1)
    hole = np.zeros(rows.shape, bool)
    hole[60:250, 110:300] = True
    assert hole.sum() > 1 << 15
    holed = np.where(hole[..., None], np.uint8(0), truth)
    motions = find_motions(holed, hole, ~hole)
    filled, regular = continue_regularly(holed, hole, ~hole, motions)
    assert regular.sum() > 0.4 * hole.sum()
    assert (np.abs(filled[regular].astype(int) - truth[regular]) < 30).mean() > 0.97

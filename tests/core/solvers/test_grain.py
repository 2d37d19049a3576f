"""Fills get the detail that they lack, from where their patches are from, and no more."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from gimp3d.solvers.grain import with_grain
from gimp3d.solvers.patchmatch import NearestNeighbourField

SHAPE = (160, 200)
HOLE = np.zeros(SHAPE, bool)
HOLE[50:110, 60:140] = True


def grainy(seed: int, contrast: float = 0.1) -> np.ndarray:
    """[H, W, 3] float32 in [0, 1]: soft noise."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(*SHAPE, 3)), (0, 0), 1.2)
    return (0.5 + contrast * noise / noise.std()).astype(np.float32)


def copied_from(down: int, right: int) -> NearestNeighbourField:
    """The field of a hole that is a copy of what lies so far off."""
    rows, cols = np.indices(SHAPE, np.int32)
    found = HOLE & (rows + down >= 0) & (rows + down < SHAPE[0])
    where = (np.where(found, a, -1).astype(np.int32) for a in (rows + down, cols + right))
    return NearestNeighbourField(*where, np.zeros(SHAPE, np.float32))


def detail(picture: np.ndarray, where: np.ndarray) -> float:
    """RMS of what a blur leaves out, well inside."""
    fine = picture - cv2.GaussianBlur(picture, (0, 0), 2.0)
    return float(np.sqrt((fine[cv2.erode(where.astype(np.uint8), np.ones((9, 9))) > 0] ** 2).mean()))


def filled(picture: np.ndarray, field: NearestNeighbourField) -> np.ndarray:
    done = picture.copy()
    done[HOLE] = with_grain(picture, HOLE, ~HOLE, field)
    return done


@examples(20)
@given(st.integers(0, 999), st.floats(0.01, 0.12), st.floats(0.0, 0.9))
def test_a_smooth_fill_gets_the_detail_of_what_it_continues(seed: int, contrast: float, had: float) -> None:
    """Whether it has none, or some of its own."""
    truth = grainy(seed, contrast)
    smooth = np.where(HOLE[..., None], 0.5 + had * (grainy(seed + 1, contrast) - 0.5), truth).astype(np.float32)
    done = filled(smooth, copied_from(-55, 3))
    assert detail(done, HOLE) == pytest.approx(detail(truth, ~HOLE), rel=0.2)
    assert cv2.GaussianBlur(done - smooth, (0, 0), 8.0)[HOLE].std() < 0.1 * contrast  # and its colours


@examples(20)
@given(st.integers(0, 999), st.floats(0.3, 1.0))
def test_detail_that_is_there_is_raised_and_not_doubled(seed: int, had: float) -> None:
    """A copy of what the field says it is from, whole or faded: the same detail, at full contrast."""
    truth = grainy(seed)
    copy = np.roll(truth, 55, axis=0)
    faded = np.where(HOLE[..., None], 0.5 + had * (copy - 0.5), truth).astype(np.float32)
    done = filled(faded, copied_from(-55, 0))
    whole = cv2.erode(HOLE.astype(np.uint8), np.ones((9, 9))) > 0
    fine = [(p - cv2.GaussianBlur(p, (0, 0), 2.0))[whole] for p in (done, copy)]
    assert np.abs(fine[0] - fine[1]).std() < 0.35 * fine[1].std()
    if had == 1:
        assert np.abs(done - faded)[whole].max() < 0.05


def test_edges_are_no_grain() -> None:
    """A line where the field is from, too thin to tell by colours about it, is louder than grain: it is not copied."""
    truth = grainy(3, 0.01)
    truth[20:21] = 0.85
    smooth = np.where(HOLE[..., None], np.float32(0.5), truth)
    done = filled(smooth, copied_from(-50, 0))
    assert np.abs(done[HOLE] - 0.5).max() < 0.1


def test_detail_of_another_material_is_none() -> None:
    """Windows reach over a border that what is filled has not: neither its edge nor the other's grain comes with it."""
    truth = grainy(5, 0.02)
    truth[:30] = 0.1 + 4 * (truth[:30] - 0.5)
    smooth = np.where(HOLE[..., None], np.float32(0.5), truth)
    done = filled(smooth, copied_from(-40, 0))  # rows up to 70 are from beyond the border
    assert detail(done, HOLE) < 1.3 * detail(truth, np.arange(SHAPE[0])[:, None].repeat(SHAPE[1], 1) > 112)
    assert np.abs(done[HOLE] - 0.5).max() < 0.1


def test_where_nothing_can_be_copied_nothing_changes() -> None:
    picture, nowhere = grainy(4), np.full(SHAPE, -1, np.int32)
    field = NearestNeighbourField(nowhere, nowhere, np.zeros(SHAPE, np.float32))
    assert (filled(picture, field) == picture).all()
    unusable = with_grain(picture, HOLE, np.zeros(SHAPE, bool), copied_from(-55, 0))
    assert (unusable == picture[HOLE]).all()

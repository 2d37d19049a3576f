"""Patches in memory and their main components."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from gimp3d.solvers.patches import coordinates, lay_out, main_components


def picture(height: int, width: int, channels: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((height, width, channels)).astype(np.float32)


def patch(channels: np.ndarray, row: int, col: int, radius: int) -> np.ndarray:
    """The patch's values in float64, the picture mirrored at its border."""
    sides = [[(0, 0)] * 2 if n == 1 else [(radius, radius)] * 2 for n in channels.shape[:2]]
    padded = np.pad(channels, (sides[0][0], sides[1][0], (0, 0)), mode="reflect").astype(np.float64)
    return padded[row : row + 2 * radius + 1, col : col + 2 * radius + 1].ravel()


@pytest.mark.parametrize(("radius", "channels"), [(0, 3), (1, 1), (2, 3), (3, 3), (2, 5), (5, 4)])
def test_rows_of_patches_are_read_where_they_start(radius: int, channels: int) -> None:
    values = picture(17, 23, channels)
    patches = lay_out(values, radius)
    size = 2 * radius + 1
    for row, col in ((0, 0), (16, 22), (8, 11), (0, 22)):
        start = int(patches.starts(np.array([row]), np.array([col]))[0])
        width = len(patches.weights)
        rows = [patches.values[start + k * patches.stride :][:width] for k in range(size)]
        assert all(len(r) == width for r in rows)  # vectors stay inside the array
        found = np.concatenate([r[patches.weights > 0] for r in rows])
        np.testing.assert_array_equal(found, patch(values, row, col, radius))
    assert patches.weights.sum() * size == pytest.approx(1, rel=1e-6)


@examples(40)
@given(st.integers(0, 3), st.integers(1, 5), st.integers(0, 2**31), st.sampled_from([1e-3, 1.0, 30.0]))
def test_coordinates_never_overstate_how_far_patches_differ(
    radius: int, channels: int, seed: int, scale: float
) -> None:
    values = scale * picture(12, 14, channels, seed) + 1
    patches = lay_out(values, radius)
    rows, cols = (a.ravel() for a in np.mgrid[radius : 12 - radius, radius : 14 - radius])
    starts = patches.starts(rows, cols)
    found = coordinates(patches, main_components(patches, starts), starts).astype(np.float64)
    exact = np.array([patch(values, r, c, radius) for r, c in zip(rows, cols)])
    rounding = 8 * np.finfo(np.float32).eps * np.abs(values).max()  # of coordinates, each a sum of products
    for k in range(0, len(rows), 7):
        bound = np.sqrt(((found - found[k]) ** 2).sum(1))
        truth = np.sqrt(((exact - exact[k]) ** 2).mean(1))
        assert (bound <= truth + rounding).all()


def test_coordinates_hold_most_of_what_smooth_patches_differ_by() -> None:
    y, x = np.mgrid[:40, :60]
    values = np.dstack([np.sin(x / 7), np.cos(y / 9), np.sin((x + y) / 11)]).astype(np.float32)
    patches = lay_out(values, 2)
    rows, cols = (a.ravel() for a in np.mgrid[2:38, 2:58])
    starts = patches.starts(rows, cols)
    found = coordinates(patches, main_components(patches, starts), starts)
    exact = np.array([patch(values, r, c, 2) for r, c in zip(rows[::50], cols[::50])])
    bound = ((found[::50] - found[0]) ** 2).sum(1)
    truth = ((exact - exact[0]) ** 2).mean(1)
    assert bound.sum() > 0.99 * truth.sum()

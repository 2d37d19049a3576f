"""Patches in memory, their main components, and the tree, which leads a patch to others like it."""

from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from gimp3d.compute.jit import kernel
from gimp3d.compute.threads import set_thread_count
from gimp3d.solvers.patches import Tree, coordinates, index_patches, lay_out, leaf_of, main_components


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


@pytest.fixture(autouse=True)
def _default_threads() -> Iterator[None]:
    yield
    set_thread_count(None)


def smooth(height: int, width: int, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(height, width, 3)).astype(np.float32)
    return cv2.GaussianBlur(noise, (0, 0), 1.5)


@kernel
def _leaves(looks, split_component, split_value, out):
    for k in range(len(out)):
        out[k] = leaf_of(looks, 16 * k, split_component, split_value)


def leaves(tree: Tree, found: np.ndarray) -> np.ndarray:
    out = np.zeros(len(found), np.int64)
    _leaves(found.ravel(), tree.split_component, tree.split_value, out)
    return out


@examples(40)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 4), st.floats(0.01, 1), st.integers(0, 2**31))
def test_every_allowed_patch_of_the_grid_lies_in_one_leaf(
    height: int, width: int, step: int, density: float, seed: int
) -> None:
    random = np.random.default_rng(seed)
    allowed = random.random((height, width)) < density
    allowed[random.integers(height), random.integers(width)] = True
    patches = lay_out(np.round(smooth(height, width, seed), 1), 1)  # rounded: many are equal
    _, tree = index_patches(patches, allowed, step)
    on_grid = np.zeros_like(allowed)
    on_grid[::step, ::step] = True
    wanted = np.argwhere(allowed & on_grid if (allowed & on_grid).any() else allowed)
    held = np.stack([tree.rows, tree.cols], 1)[tree.rows >= 0]
    assert sorted(map(tuple, held)) == sorted(map(tuple, wanted))
    assert len(tree.rows) - len(held) < 16
    for place in np.flatnonzero(tree.rows >= 0):
        row, col = tree.rows[place] // tree.step, tree.cols[place] // tree.step
        assert tree.grid[row, col] == place // 16
    assert (tree.grid >= 0).sum() == len(held)


def test_leaves_hold_the_coordinates_of_their_patches() -> None:
    patches = lay_out(smooth(50, 60), 2)
    allowed = np.zeros((50, 60), bool)
    allowed[2:48, 2:58] = True
    components, tree = index_patches(patches, allowed, 2)
    there = tree.rows >= 0
    found = tree.features.reshape(-1, 16, 16).transpose(0, 2, 1).reshape(-1, 16)
    expected = coordinates(patches, components, patches.starts(tree.rows[there], tree.cols[there]))
    np.testing.assert_array_equal(found[there], expected)
    assert (found[~there] > 1e17).all()


def test_patches_are_led_to_their_own_leaf_or_to_one_like_it() -> None:
    patches = lay_out(smooth(90, 120), 2)
    allowed = np.ones((90, 120), bool)
    components, tree = index_patches(patches, allowed, 2)
    there = tree.rows >= 0
    found = coordinates(patches, components, patches.starts(tree.rows[there], tree.cols[there]))
    led = leaves(tree, found)
    assert (led == np.arange(len(tree.rows))[there] // 16).mean() > 0.98  # the rest lies on a split
    others = patches.starts(*np.nonzero(~((np.arange(90) % 2 == 0)[:, None] & (np.arange(120) % 2 == 0))))
    looks = coordinates(patches, components, others)
    in_leaf = tree.features.reshape(-1, 16, 16)[leaves(tree, looks)]
    nearest = ((in_leaf - looks[:, :, None]) ** 2).sum(1).min(1)
    anywhere = np.median(((found[::97, None] - looks[None, ::50]) ** 2).sum(2))
    assert nearest.mean() < 0.25 * anywhere


def test_the_tree_does_not_depend_on_the_thread_count() -> None:
    patches, allowed = lay_out(smooth(150, 160), 2), np.ones((150, 160), bool)
    trees = []
    for threads in (1, 2, 4):
        set_thread_count(threads)
        trees.append(index_patches(patches, allowed, 1)[1])
    for other in trees[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(trees[0], other))


def test_constant_pictures_and_single_patches_are_indexed() -> None:
    patches = lay_out(np.full((20, 30, 3), 0.5, np.float32), 2)
    for count in (1, 15, 16, 17, 100):
        allowed = np.zeros(600, bool)
        allowed[:count] = True
        _, tree = index_patches(patches, allowed.reshape(20, 30), 1)
        assert (tree.rows >= 0).sum() == count
        assert np.isfinite(tree.features).all() and np.isfinite(tree.split_value).all()

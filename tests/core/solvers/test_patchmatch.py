"""Nearest-neighbour fields against exhaustive search, and what must hold for any mask."""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from gimp3d.compute.threads import set_thread_count
from gimp3d.solvers import patchmatch
from gimp3d.solvers.patchmatch import (
    NearestNeighbourField,
    PatchMatchSettings,
    nearest_neighbour_field,
    patch_centres,
    upsampled,
)

APPEARANCE_ONLY = PatchMatchSettings(coherence=0.0)


@pytest.fixture(autouse=True)
def _default_threads() -> Iterator[None]:
    yield
    set_thread_count(None)


def texture(height: int, width: int, seed: int = 0) -> np.ndarray:
    """Noise of several scales, [H, W, 3] uint8."""
    random = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(random.normal(size=(height, width, 3)), (0, 0), s) * s for s in (0.7, 2, 6)]
    return np.clip(128 + 60 * sum(layers), 0, 255).astype(np.uint8)


def disc(height: int, width: int, radius: float) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return (y - height / 2) ** 2 + (x - width / 2) ** 2 < radius**2


def field_of(
    image: np.ndarray,
    target: np.ndarray,
    source: np.ndarray,
    penalty: np.ndarray | None = None,
    settings: PatchMatchSettings = PatchMatchSettings(),
) -> NearestNeighbourField:
    free = np.zeros(target.shape, np.float32)
    return nearest_neighbour_field(image, target, source, free if penalty is None else penalty, settings)


def patches(image: np.ndarray, radius: int) -> np.ndarray:
    """[H, W, patch values] float64 in [0, 1], mirrored at the border."""
    bordered = cv2.copyMakeBorder(image, radius, radius, radius, radius, cv2.BORDER_REFLECT_101)
    h, w = image.shape[:2]
    size = 2 * radius + 1
    return np.dstack([bordered[i : i + h, j : j + w] / 255 for i in range(size) for j in range(size)])


def exhaustive(
    image: np.ndarray, target: np.ndarray, allowed: np.ndarray, penalty: np.ndarray, radius: int = 2
) -> np.ndarray:
    """Least cost of every target pixel, [T]."""
    values = patches(image, radius)
    wanted, offered, extra = values[target], values[allowed], penalty[allowed]
    return np.array([(((offered - p) ** 2).mean(1) + extra).min() for p in wanted])


def recosted(image: np.ndarray, field: NearestNeighbourField, radius: int = 2) -> np.ndarray:
    values = patches(image, radius)
    return ((values[field.found] - values[field.rows[field.found], field.cols[field.found]]) ** 2).mean(1)


def incoherence(field: NearestNeighbourField) -> float:
    """Mean squared deviation of horizontal neighbours' offsets, truncated at 8 px, in [0, 1]."""
    both = field.found[:, 1:] & field.found[:, :-1]
    deviation = np.diff(field.rows, axis=1) ** 2.0 + (np.diff(field.cols, axis=1) - 1) ** 2.0
    return float(np.minimum(deviation[both], 64).mean() / 64)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_costs_come_near_those_of_exhaustive_search(seed: int) -> None:
    image, target = texture(72, 96, seed), disc(72, 96, 14)
    field = field_of(image, target, ~target, None, APPEARANCE_ONLY)
    least = exhaustive(image, target, patch_centres(~target, 2), np.zeros(target.shape))
    assert (field.cost[target] >= least - 1e-6).all()
    assert field.cost[target].mean() <= 1.08 * least.mean()


@pytest.mark.parametrize("patch", [1, 3, 7, 9])
def test_patches_of_any_size_are_compared(patch: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patchmatch, "GRID", 1)
    image, target = texture(60, 90), disc(60, 90, 10)
    field = field_of(image, target, ~target, None, replace(APPEARANCE_ONLY, patch=patch))
    np.testing.assert_allclose(field.cost[target], recosted(image, field, patch // 2), rtol=1e-4, atol=1e-6)
    least = exhaustive(image, target, patch_centres(~target, patch // 2), np.zeros(target.shape), patch // 2)
    assert (field.cost[target] >= least - 1e-6).all()
    most = 1.4 if patch == 1 else 1.08  # of single pixels that look alike, the neighbours do not
    assert field.cost[target].mean() <= most * least.mean()


def test_penalties_count_as_much_as_likeness() -> None:
    image, target = texture(72, 96), disc(72, 96, 14)
    noise = np.random.default_rng(0).uniform(0, 1, target.shape).astype(np.float32)
    penalty = 0.1 * np.maximum(0, cv2.GaussianBlur(noise, (0, 0), 6) - 0.48)
    field = field_of(image, target, ~target, penalty, APPEARANCE_ONLY)
    least = exhaustive(image, target, patch_centres(~target, 2), penalty)
    assert (field.cost[target] >= least - 1e-6).all()
    assert field.cost[target].mean() <= 1.08 * least.mean()


def test_cost_is_the_weighted_misfit_plus_the_penalty_of_the_source() -> None:
    image, target = texture(60, 80), disc(60, 80, 12)
    penalty = np.random.default_rng(1).uniform(0, 0.01, target.shape).astype(np.float32)
    field = field_of(image, target, ~target, penalty, PatchMatchSettings(coherence=0.01))
    expected = 0.99 * recosted(image, field) + penalty[field.rows[target], field.cols[target]]
    np.testing.assert_allclose(field.cost[target], expected, rtol=1e-4, atol=1e-6)


def test_an_exact_copy_of_the_hole_is_found() -> None:
    image = texture(120, 160)
    image[20:50, 90:120] = image[70:100, 20:50]
    target = np.zeros((120, 160), bool)
    target[26:44, 96:114] = True
    field = field_of(image, target, ~target, None, APPEARANCE_ONLY)
    rows, cols = np.nonzero(target)
    exact = (field.rows[target] == rows + 50) & (field.cols[target] == cols - 70)
    assert exact.mean() > 0.95


def test_result_depends_on_the_seed_and_not_on_the_thread_count() -> None:
    image, target = texture(150, 90), disc(150, 90, 40)

    def run(threads: int, seed: int) -> np.ndarray:
        set_thread_count(threads)
        field = field_of(image, target, ~target, None, PatchMatchSettings(seed=seed))
        return np.stack([field.rows, field.cols, field.cost.view(np.int32)])

    first = run(1, 5)
    assert all((run(threads, 5) == first).all() for threads in (1, 2, 4))
    assert (run(1, 6) != first).any()


def test_penalty_keeps_the_field_out_of_what_it_marks() -> None:
    image, target = texture(64, 128), disc(64, 128, 10)
    left = np.broadcast_to(np.arange(128) < 64, target.shape)
    free = field_of(image, target, ~target)
    steered = field_of(image, target, ~target, np.where(left, 1.0, 0.0).astype(np.float32))
    assert left[free.rows[target], free.cols[target]].any()
    assert not left[steered.rows[target], steered.cols[target]].any()


def test_coherence_makes_the_field_smoother() -> None:
    image, target = cv2.GaussianBlur(texture(80, 120), (0, 0), 2), disc(80, 120, 18)
    none, paper, strong = (
        incoherence(field_of(image, target, ~target, None, PatchMatchSettings(coherence=c))) for c in (0.0, 0.001, 0.01)
    )
    assert paper < 0.8 * none
    assert strong < 0.6 * paper


@pytest.mark.parametrize(("coherence", "most"), [(0.0, 1.5), (0.001, 3.0)])
def test_equal_patches_go_to_near_sources(coherence: float, most: float) -> None:
    image, target = np.full((64, 96, 3), 90, np.uint8), disc(64, 96, 12)
    options = PatchMatchSettings(coherence=coherence)
    field = field_of(image, target, ~target, None, options)
    again = field_of(image, target, ~target, None, options)
    rows, cols = np.nonzero(target)
    away = np.hypot(field.rows[target] - rows, field.cols[target] - cols)
    nearest = cv2.distanceTransform((~patch_centres(~target, 2)).astype(np.uint8), cv2.DIST_L2, 5)[target]
    assert (field.rows == again.rows).all() and (field.cols == again.cols).all()
    assert away.mean() < most * nearest.mean()
    if coherence:
        assert incoherence(field) < 0.1


def test_patches_shrink_where_the_image_has_no_room_for_them() -> None:
    target = np.zeros((5, 7), bool)
    target[1:4, 2:5] = True
    field = field_of(texture(5, 7), target, ~target, None, APPEARANCE_ONLY)
    np.testing.assert_allclose(field.cost[target], recosted(texture(5, 7), field, 0), rtol=1e-4, atol=1e-6)
    assert (field.found == target).all()


@pytest.mark.parametrize("source", ["none", "only the target"])
def test_without_a_source_the_field_is_empty(source: str) -> None:
    target = disc(40, 40, 8)
    allowed = np.zeros_like(target) if source == "none" else target
    field = field_of(texture(40, 40), target, allowed)
    assert not field.found.any()
    assert (field.cost == 0).all()


def test_an_empty_target_gives_an_empty_field() -> None:
    nothing = np.zeros((20, 30), bool)
    assert not field_of(texture(20, 30), nothing, ~nothing).found.any()


def test_upsampling_doubles_coordinates_and_keeps_parity() -> None:
    rows, cols = np.full((2, 3, 4), -1, np.int32)
    rows[1, 1], cols[1, 1] = 2, 3
    fine = upsampled(NearestNeighbourField(rows, cols, np.zeros((3, 4), np.float32)), *np.ones((2, 6, 7), bool))
    assert fine.found.sum() == 4
    assert fine.rows[2:4, 2:4].tolist() == [[4, 4], [5, 5]]
    assert fine.cols[2:4, 2:4].tolist() == [[6, 6], [6, 6]]  # the seventh column is the last one


@examples(60)
@given(
    st.integers(1, 48),
    st.integers(1, 70),
    st.sampled_from([1, 3, 5, 7]),
    st.floats(0, 1),
    st.booleans(),
    st.integers(0, 2**31),
)
def test_every_source_is_allowed_and_its_patch_holds_no_target_pixel(
    height: int, width: int, patch: int, density: float, blocky: bool, seed: int
) -> None:
    random = np.random.default_rng(seed)
    noise = random.random((-(-height // 6), -(-width // 6)) if blocky else (height, width))
    target = noise.repeat(6, 0).repeat(6, 1)[:height, :width] < density if blocky else noise < density
    source = random.random((height, width)) < 0.8
    options = PatchMatchSettings(patch=patch, sweeps=2, seed=seed)
    field = field_of(texture(height, width, seed), target, source, None, options)
    assert not field.found[~target].any()
    if not field.found.any():
        assert not target.any() or not (source & ~target).any()
        return
    assert (field.found == target).all()
    rows, cols = field.rows[target], field.cols[target]
    assert source[rows, cols].all()
    within = (patch_centres(~target, r) for r in range(patch // 2, -1, -1))
    assert next(c for c in within if (c & source).any())[rows, cols].all()
    assert np.isfinite(field.cost).all() and (field.cost >= 0).all()

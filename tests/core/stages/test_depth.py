"""Depth completion: scenes with a known answer, and every ill-posed case of docs/method.md."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gimp3d.errors import IllPosed
from gimp3d.geometry import disparity_of
from gimp3d.priors.monodepth import DepthPrior
from gimp3d.solvers.poisson import solve_poisson
from gimp3d.stages.depth import DepthSettings, complete_depth, fit_prior

H, W = 120, 160


V, U = np.mgrid[:H, :W].astype(float)


HARMONIC, PLANAR, SMOOTH = (DepthSettings(surface=s) for s in ("harmonic", "planar", "smooth"))


FLOOR = 0.002 * V + 0.0004 * U + 0.1  # planes in space are affine in disparity


WALL = np.full((H, W), 0.22) + 0.0003 * (U - 80)


SIDE_WALL = 0.24 - 0.002 * (U - 60)


ROOM = np.maximum(np.maximum(FLOOR, WALL), SIDE_WALL)


def blob(centre=(60, 80), radius=28.0):
    y, x = V - centre[0], U - centre[1]
    return np.hypot(x, y) < radius * (1 + 0.2 * np.sin(3 * np.arctan2(y, x)))


def relative_error(found, truth, hole):
    """Of depth, [M]."""
    return np.abs(found.depth[hole] * truth[hole] - 1)


def complete_disparity(disparity, known, hole, prior=None, settings=DepthSettings()):
    prior = None if prior is None else DepthPrior(prior)
    return complete_depth(disparity, known, hole, prior, settings)


def complete(truth, hole, prior=None, settings=DepthSettings(), known=None, noise=0.0):
    rng = np.random.default_rng(0)
    scene = truth * (1 + noise * rng.standard_normal(truth.shape))
    return complete_disparity(np.where(hole, 9.0, scene), ~hole if known is None else known, hole, prior, settings)


@pytest.mark.parametrize("settings", [HARMONIC, PLANAR, DepthSettings()])
def test_a_plane_is_continued_exactly(settings):
    hole = blob()
    found = complete(FLOOR, hole, settings=settings)
    assert relative_error(found, FLOOR, hole).max() < 1e-4
    assert found.fit.scale == 0 and "clamped" not in found.reason


@pytest.mark.parametrize("seed", range(6))
def test_curved_ground_keeps_its_slope(seed):
    """A membrane forgets the slope at the rim, and planes are wrong: the plate is taken, and better than both."""
    rng = np.random.default_rng(seed)
    waves = sum(
        np.sin((U * np.cos(a) + V * np.sin(a)) / rng.uniform(18, 30) + rng.uniform(0, 6))
        for a in rng.uniform(0, np.pi, 3)
    )
    curved, hole = FLOOR * (1 + 0.05 * waves), blob()
    found = complete(curved, hole, noise=0.002)
    harmonic = complete(curved, hole, settings=HARMONIC, noise=0.002)
    assert found.reason.startswith("smooth")
    errors = relative_error(found, curved, hole)
    assert np.median(errors) < 0.7 * np.median(relative_error(harmonic, curved, hole))


def test_parts_of_the_hole_have_their_own_surroundings():
    hole = blob((60, 40), 20) | blob((60, 120), 20)
    scene = np.where(U < 80, FLOOR, 0.0022 * V - 0.0008 * U + 0.4)
    found = complete(scene, hole, noise=0.002)
    assert np.percentile(relative_error(found, scene, hole), 95) < 0.01


SHAPES = ("plane", "sphere", "step", "crease", "terrain")


def random_case(seed, shape="terrain", error=0.05):
    """(truth, scene with noise, prior with unknown gain and shift and smooth errors), as in the research note (K2)."""
    rng = np.random.default_rng(seed)
    truth = 1 + rng.uniform(-0.006, 0.006) * (U - 80) + rng.uniform(-0.003, 0.003) * (V - 60)
    turn = rng.uniform(0, np.pi)
    across = (U - 80) * np.cos(turn) + (V - 60) * np.sin(turn) + rng.uniform(-6, 6)
    if shape == "sphere":
        centre, radius = rng.uniform(-18, 18, 2), rng.uniform(24, 38)
        truth += 0.5 * np.sqrt(np.maximum(1 - np.hypot(V - 60 - centre[0], U - 80 - centre[1]) ** 2 / radius**2, 0))
    elif shape == "step":
        truth += 0.6 * (across > 0)
    elif shape == "crease":
        truth += 0.015 * np.abs(across)
    elif shape == "terrain":
        truth += cv2.GaussianBlur(rng.standard_normal((H, W)), (0, 0), 9) * 2
    spread = np.ptp(truth)
    errors = cv2.GaussianBlur(rng.standard_normal((H, W)), (0, 0), 10)
    prior = (truth + error * spread * errors / errors.std()) / np.exp(rng.uniform(-3, 3)) + rng.uniform(-5, 5)
    return truth, truth + 0.005 * spread * rng.standard_normal((H, W)), prior


def test_a_prior_of_unknown_units_comes_within_a_quarter_of_the_best_scale():
    hole = blob()
    errors = []
    for seed, (shape, error) in enumerate([(s, e) for s in SHAPES for e in (0, 0.05, 0.15)] * 4):
        truth, scene, prior = random_case(seed, shape, error)
        found = complete_disparity(scene, ~hole, hole, prior)
        harmonic = solve_poisson(hole, ~hole, scene).values[hole]
        detail = prior[hole] - solve_poisson(hole, ~hole, prior).values[hole]
        best = harmonic + ((truth[hole] - harmonic) @ detail) / (detail @ detail) * detail
        errors.append(
            [np.sqrt(np.mean((x - truth[hole]) ** 2)) / np.ptp(truth) for x in (1 / found.depth[hole], best, harmonic)]
        )
    measured, oracle, unguided = np.mean(errors, axis=0)
    assert measured < 1.25 * oracle
    assert measured < 0.3 * unguided


def test_the_papers_fixed_scale_is_used_as_set():
    truth, _, _ = random_case(0)
    found = complete(truth, blob(), prior=truth / 0.1, settings=DepthSettings(scale_factor=0.1))
    assert found.fit.scale == 0.1
    assert relative_error(found, truth, blob()).max() < 1e-3


@pytest.mark.parametrize(
    "prior",
    [
        np.full((H, W), 3.0),
        np.full((H, W), np.nan),
        -random_case(2)[0],
        cv2.GaussianBlur(np.random.default_rng(5).standard_normal((H, W)), (0, 0), 2),
    ],
    ids=["constant", "nan", "inverted", "unrelated"],
)
@pytest.mark.parametrize("settings", [HARMONIC, DepthSettings()])
def test_a_useless_prior_leaves_the_completion_unguided(prior, settings):
    truth, hole = random_case(2)[0], blob()
    found, unguided = complete(truth, hole, prior, settings), complete(truth, hole, settings=settings)
    assert found.fit.scale == 0 and found.confidence <= 0.3 and found.reason.startswith("prior not used, ")
    np.testing.assert_array_equal(found.depth, unguided.depth)


def test_a_prior_on_a_flat_ring_says_nothing():
    found = complete(np.full((H, W), 0.5), blob(), prior=V)
    assert found.fit.scale == 0 and found.confidence <= 0.3
    np.testing.assert_allclose(found.depth, 2.0, rtol=1e-6)


def test_guidance_is_hardly_ever_worse_than_none():
    """Where ring and prior agree poorly, s_f is lowered: over random cases the loss stays below 10 % in 97 of 100."""
    hole, worse = blob(), []
    for seed in range(60):
        truth, scene, prior = random_case(seed, SHAPES[seed % 5], 0.15)
        guided, none = (1 / complete_disparity(scene, ~hole, hole, p, HARMONIC).depth[hole] for p in (prior, None))
        worse.append(np.std(guided - truth[hole]) > 1.1 * np.std(none - truth[hole]))
    assert np.mean(worse) <= 0.03


def test_what_the_scale_factor_was_fitted_to_comes_with_it():
    truth, _, prior = random_case(4, "terrain", 0)
    found = complete(truth, blob(), prior)
    m, d = found.fit.ring.astype(np.float64).T
    assert 500 < len(m) < 4000
    np.testing.assert_allclose(found.fit.line, np.polyfit(m, d, 1), rtol=0.01)
    np.testing.assert_allclose(found.fit.line[0], found.fit.scale, rtol=0.01)


@pytest.mark.parametrize("gain", [0.05, 1.0, 30.0])
def test_foliage_on_the_ring_does_not_hide_that_a_prior_is_right(gain):
    """Splats of leaves stand before the ground all over the ring: its small differences are theirs."""
    truth = FLOOR + 0.06 * np.exp(-((U - 80) ** 2 + (V - 60) ** 2) / 150)  # a mound that the ring does not show
    rng, hole = np.random.default_rng(3), blob()
    leaves = ~hole & (cv2.GaussianBlur(rng.standard_normal((H, W)), (0, 0), 1.5) > 0.08)
    scene = np.where(leaves, truth * rng.uniform(1.1, 1.8, truth.shape), truth)
    assert 0.2 < leaves[~hole].mean() < 0.4
    fit = fit_prior(scene, ~hole, hole, truth / gain - 3)
    np.testing.assert_allclose(fit.scale, gain, rtol=0.02)
    np.testing.assert_allclose(fit.shift, 3 * gain, rtol=0.05)


def test_a_right_prior_tells_of_a_mound_though_the_scan_swirls():
    """The ring's own relief is noise, which a prior cannot share; that it errs by less than its mound is enough."""
    hole, errors = blob(), []
    mound = 0.08 * np.exp(-((U - 80) ** 2 + (V - 60) ** 2) / 150)
    for seed in range(4):
        swirls = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal((H, W)), (0, 0), 4)
        scene = FLOOR + mound + 0.004 * swirls / swirls.std()
        guided, none = (complete_disparity(scene, ~hole, hole, p) for p in (4 * (FLOOR + mound) + 1, None))
        assert guided.reason.startswith("guided") and "off by" not in guided.reason
        errors.append([relative_error(x, FLOOR + mound, hole).mean() for x in (guided, none)])
    assert np.mean(errors, axis=0)[0] < 0.4 * np.mean(errors, axis=0)[1]


def test_a_ring_of_fewer_than_ten_pixels_measures_nothing():
    hole = np.ones((H, W), bool)
    hole[60, 80:83] = False
    fit = fit_prior(FLOOR, ~hole, hole, FLOOR)
    assert fit.scale == 0 and "too little is known" in fit.reason


def test_gaps_in_the_prior_do_not_spread():
    truth, _, prior = random_case(4)
    hole = blob()
    prior[55:60, 70:75] = np.nan
    found = complete(truth, hole, prior)
    assert found.fit.scale > 0 and np.isfinite(found.depth).all()


def test_a_hole_that_covers_the_image_is_refused():
    with pytest.raises(IllPosed, match="no rim of known depth"):
        complete(FLOOR, np.ones((H, W), bool))


def test_a_hole_without_a_rim_follows_a_prior_that_fits_elsewhere():
    truth, hole = random_case(6)[0], blob()
    known = ~blob(radius=52)
    with pytest.raises(IllPosed):
        complete(truth, hole, known=known)
    with pytest.raises(IllPosed):
        complete(truth, hole, -truth, known=known)
    found = complete(truth, hole, 5 * truth + 3, known=known)
    assert relative_error(found, truth, hole).max() < 1e-3


def test_a_part_without_a_rim_takes_the_nearest_depth_with_low_confidence():
    hole = blob(radius=12) | blob((60, 140), 10)
    known = ~hole & (U < 110)
    found = complete(np.full((H, W), 0.5), hole, settings=HARMONIC, known=known)
    np.testing.assert_allclose(found.depth[hole], 2.0, rtol=1e-6)
    assert found.confidence <= 0.3 and "no rim" in found.reason


def test_a_part_without_a_rim_takes_the_aligned_prior():
    truth = random_case(7)[0]
    hole = blob(radius=12) | blob((60, 140), 10)
    found = complete(truth, hole, 4 * truth - 1, known=~hole & (U < 110))
    assert relative_error(found, truth, hole).max() < 0.01


def test_a_hole_at_the_border_is_natural_there():
    hole = blob((0, 80), 40)
    assert relative_error(complete(FLOOR, hole), FLOOR, hole).max() < 1e-4
    flat = complete(np.full((H, W), 0.3), hole, settings=HARMONIC)
    np.testing.assert_allclose(flat.depth, 1 / 0.3, rtol=1e-6)


def test_islands_are_boundary():
    hole = blob() & ~blob(radius=6)
    scene = np.where(blob(radius=6), 0.31, 0.3)
    found = complete(scene, hole, settings=HARMONIC)
    ring = blob(radius=8) & hole
    assert (found.depth[ring] < 1 / 0.304).all()


@pytest.mark.parametrize("size", [(1, 1), (1, 2), (1, 3), (2, 2)])
def test_holes_of_one_to_four_pixels_are_interpolated(size):
    hole = np.zeros((H, W), bool)
    hole[50 : 50 + size[0], 70 : 70 + size[1]] = True
    assert relative_error(complete(ROOM, hole), ROOM, hole).max() < 0.02


def test_images_smaller_than_the_ring_are_completed():
    hole = np.zeros((5, 6), bool)
    hole[2, 2:4] = True
    found = complete_disparity(FLOOR[:5, :6], ~hole, hole, FLOOR[:5, :6])
    np.testing.assert_allclose(found.depth, 1 / FLOOR[:5, :6], rtol=1e-3)


def test_an_empty_hole_changes_nothing():
    found = complete(FLOOR, np.zeros((H, W), bool))
    np.testing.assert_array_equal(found.depth, disparity_of(FLOOR.astype(np.float32)))


def test_only_the_hole_changes():
    hole = blob()
    found = complete(ROOM, hole, noise=0.01)
    again = complete(ROOM, hole, noise=0.01)
    noisy = ROOM * (1 + 0.01 * np.random.default_rng(0).standard_normal(ROOM.shape))
    np.testing.assert_array_equal(found.depth[~hole], disparity_of(noisy.astype(np.float32))[~hole])
    assert found.depth.tobytes() == again.depth.tobytes()


def test_pixels_without_a_depth_are_not_known():
    hole = blob()
    scene = np.where(U < 20, np.nan, np.where(V > 110, -np.inf, FLOOR))
    scene[30, 80] = -1.0
    found = complete_disparity(scene, np.ones((H, W), bool), hole)
    assert relative_error(found, FLOOR, hole).max() < 1e-3
    assert (found.depth[~hole & (U < 20)] == 0).all()


@pytest.mark.parametrize("settings", [HARMONIC, DepthSettings()])
def test_sky_stays_infinitely_far(settings):
    """The ground ends at the horizon, and no curtain hangs between it and the sky."""
    scene = np.maximum(0.004 * (V - 59.5), 0)
    hole = blob()
    found = complete(scene, hole, settings=settings)
    assert np.mean(found.depth[hole & (V < 50)] == 0) > 0.98
    below = hole & (V > 70)
    assert np.median(relative_error(found, scene, below)) < (0.2 if settings is HARMONIC else 0.01)


def test_disparities_outside_the_rings_range_are_clamped_and_counted():
    truth, hole = random_case(8)[0], blob()
    spike = truth - 40 * np.exp(-((U - 80) ** 2 + (V - 60) ** 2) / 50)
    found = complete(truth, hole, prior=spike)
    assert "pixels clamped" in found.reason and (found.depth > 0).all()
    ring = truth[~hole & blob(radius=33)]
    assert (1 / found.depth[hole]).min() >= 0.24 * ring.min()

"""Depth completion: scenes with a known answer, and every ill-posed case of METHOD section 8."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gimp3d.errors import BadInput, IllPosed
from gimp3d.priors.monodepth import depth_prior
from gimp3d.solvers.poisson import solve_poisson
from gimp3d.stages.depth import DepthSettings, background_rim, complete_disparity, fit_prior, planar_surfaces

H, W = 120, 160
V, U = np.mgrid[:H, :W].astype(float)
HARMONIC, PLANAR = DepthSettings(surface="harmonic"), DepthSettings(surface="planar")

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


def complete(truth, hole, prior=None, settings=DepthSettings(), known=None, noise=0.0):
    rng = np.random.default_rng(0)
    scene = truth * (1 + noise * rng.standard_normal(truth.shape))
    return complete_disparity(np.where(hole, 9.0, scene), ~hole if known is None else known, hole, prior, settings)


# Surfaces with a known answer


@pytest.mark.parametrize("settings", [HARMONIC, PLANAR, DepthSettings()])
def test_a_plane_is_continued_exactly(settings):
    hole = blob()
    found = complete(FLOOR, hole, settings=settings)
    assert relative_error(found, FLOOR, hole).max() < 1e-4
    np.testing.assert_allclose(found.depth, 1 / found.disparity, rtol=1e-6)
    assert found.scale_factor == 0 and found.clamped == 0


def test_a_floor_and_two_walls_meet_behind_the_object():
    hole = blob()
    found = complete(ROOM, hole, noise=0.005)
    harmonic = complete(ROOM, hole, settings=HARMONIC, noise=0.005)
    assert "3 planes" in found.reason and found.confidence > 0.7
    assert np.median(relative_error(found, ROOM, hole)) < 0.002
    assert np.percentile(relative_error(found, ROOM, hole), 95) < 0.01
    assert np.median(relative_error(harmonic, ROOM, hole)) > 0.01


def test_an_outer_edge_takes_the_farther_plane():
    edge = np.minimum(FLOOR, WALL)
    hole = blob()
    found = complete(edge, hole, noise=0.003)
    assert np.percentile(relative_error(found, edge, hole), 95) < 0.01


def test_planes_that_do_not_meet_in_the_hole_keep_their_parts():
    """A table in front of a far wall: between them there is a step, not a ramp."""
    table = V > 60 + 0.1 * (U - 80)
    scene = np.where(table, FLOOR + 0.2, 0.05)
    hole = blob()
    found = complete(scene, hole, noise=0.003)
    errors = relative_error(found, scene, hole)
    assert np.percentile(errors, 90) < 0.01
    assert np.mean(errors > 0.05) < 0.08  # only where the table's edge is drawn


def test_rough_ground_is_harmonic():
    rng = np.random.default_rng(1)
    rough = FLOOR * (1 + 0.1 * cv2.GaussianBlur(rng.standard_normal((H, W)), (0, 0), 5) * 18)
    found = complete(rough, blob())
    assert found.reason == "harmonic"
    with pytest.raises(IllPosed, match="lie on planes; use --depth-prior auto"):
        complete(rough, blob(), settings=PLANAR)


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
            [np.sqrt(np.mean((x - truth[hole]) ** 2)) / np.ptp(truth) for x in (found.disparity[hole], best, harmonic)]
        )
    measured, oracle, unguided = np.mean(errors, axis=0)
    assert measured < 1.25 * oracle
    assert measured < 0.5 * unguided


def test_the_papers_fixed_scale_is_used_as_set():
    truth, _, _ = random_case(0)
    found = complete(truth, blob(), prior=truth / 0.1, settings=DepthSettings(scale_factor=0.1))
    assert found.scale_factor == 0.1
    assert relative_error(found, truth, blob()).max() < 1e-3


# Priors that say nothing (METHOD section 8)


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
def test_a_useless_prior_leaves_the_completion_harmonic(prior):
    truth, hole = random_case(2)[0], blob()
    found, harmonic = complete(truth, hole, prior), complete(truth, hole, settings=HARMONIC)
    assert found.scale_factor == 0 and found.confidence <= 0.3 and found.reason.startswith("harmonic: ")
    np.testing.assert_array_equal(found.disparity, harmonic.disparity)


def test_a_prior_on_a_flat_ring_says_nothing():
    found = complete(np.full((H, W), 0.5), blob(), prior=V)
    assert found.scale_factor == 0 and found.confidence <= 0.3
    np.testing.assert_allclose(found.disparity, 0.5, rtol=1e-6)


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
    assert found.scale_factor > 0 and np.isfinite(found.disparity).all()


# Holes without enough of a rim


def test_a_hole_that_covers_the_image_is_refused():
    with pytest.raises(IllPosed, match="no rim of known depth"):
        complete(FLOOR, np.ones((H, W), bool))


def test_a_hole_without_a_rim_follows_a_prior_that_fits_elsewhere():
    truth, hole = random_case(6)[0], blob()
    known = ~blob(radius=34)
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
    np.testing.assert_allclose(found.disparity[hole], 0.5, rtol=1e-6)
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
    np.testing.assert_allclose(flat.disparity, 0.3, rtol=1e-6)


def test_islands_are_boundary():
    hole = blob() & ~blob(radius=6)
    scene = np.where(blob(radius=6), 0.31, 0.3)
    found = complete(scene, hole, settings=HARMONIC)
    ring = blob(radius=8) & hole
    assert (found.disparity[ring] > 0.304).all()


@pytest.mark.parametrize("size", [(1, 1), (1, 2), (1, 3), (2, 2)])
def test_holes_of_one_to_four_pixels_are_interpolated(size):
    hole = np.zeros((H, W), bool)
    hole[50 : 50 + size[0], 70 : 70 + size[1]] = True
    assert relative_error(complete(ROOM, hole), ROOM, hole).max() < 0.02


def test_images_smaller_than_the_ring_are_completed():
    hole = np.zeros((5, 6), bool)
    hole[2, 2:4] = True
    found = complete_disparity(FLOOR[:5, :6], ~hole, hole, FLOOR[:5, :6])
    np.testing.assert_allclose(found.disparity, FLOOR[:5, :6], rtol=1e-3)


def test_an_empty_hole_changes_nothing():
    found = complete(FLOOR, np.zeros((H, W), bool))
    np.testing.assert_array_equal(found.disparity, FLOOR.astype(np.float32))


def test_only_the_hole_changes():
    hole = blob()
    found = complete(ROOM, hole, noise=0.01)
    again = complete(ROOM, hole, noise=0.01)
    noisy = ROOM * (1 + 0.01 * np.random.default_rng(0).standard_normal(ROOM.shape))
    np.testing.assert_array_equal(found.disparity[~hole], noisy.astype(np.float32)[~hole])
    assert found.disparity.tobytes() == again.disparity.tobytes()


# Depths that are none, and layers


def test_pixels_without_a_depth_are_not_known():
    hole = blob()
    scene = np.where(U < 20, np.nan, np.where(V > 110, -np.inf, FLOOR))
    scene[30, 80] = -1.0
    found = complete_disparity(scene, np.ones((H, W), bool), hole)
    assert relative_error(found, FLOOR, hole).max() < 1e-3
    assert (found.disparity[~hole & (U < 20)] == 0).all() and (found.depth[~hole & (U < 20)] == 0).all()


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
    assert found.clamped > 0 and (found.disparity > 0).all()
    ring = truth[~hole & blob(radius=33)]
    assert found.disparity[hole].min() >= 0.24 * ring.min()


@pytest.mark.parametrize("settings", [HARMONIC, DepthSettings()])
def test_an_occluder_on_the_rim_does_not_smear(settings):
    """A pole in front of the hole is no boundary: the floor goes on behind it."""
    hole = blob()
    pole = (np.abs(U - 50) < 6) & (V < 90)
    hole &= ~pole
    scene = np.where(pole, 0.8, FLOOR)
    found = complete(scene, hole, settings=settings, noise=0.003)
    assert np.percentile(relative_error(found, FLOOR, hole), 95) < 0.02
    dropped = ~hole & ~background_rim(scene, ~hole, hole)
    assert dropped.any() and not (dropped & ~pole).any()


@pytest.mark.parametrize("scene", [ROOM, np.maximum(FLOOR, WALL), np.maximum(0.004 * (V - 35), 0.02)])
def test_surfaces_that_meet_are_all_kept_as_rim(scene):
    hole = blob()
    assert background_rim(scene, ~hole, hole)[~hole].all()


def test_the_layer_that_makes_up_much_of_the_rim_is_no_occluder():
    hole = blob()
    scene = np.where(V > 65, 0.5, 0.1)
    assert background_rim(scene, ~hole, hole)[~hole].all()


def test_planes_are_found_with_their_share():
    hole = blob()
    found = planar_surfaces(ROOM, ~hole, hole)
    assert found.share > 0.95 and len(found.surfaces) == 1 and found.surfaces[0].planes == 3
    np.testing.assert_allclose(found.surfaces[0].disparity[hole], ROOM[hole], rtol=1e-3)


# Priors from files


def test_the_scene_alone_decides_without_a_file():
    assert all(depth_prior(spec, 4, 5) is None for spec in ("auto", "harmonic", "planar"))


@pytest.mark.parametrize("kind", ["", ",disparity", ",depth"])
def test_a_prior_file_is_read_as_relative_disparity(tmp_path, kind):
    values = np.linspace(1, 2, 48, dtype=np.float32).reshape(6, 8)
    path = tmp_path / "a, b.npy"
    np.save(path, values)
    found = depth_prior(f"file:{path}{kind}", 6, 8)
    np.testing.assert_allclose(found, 1 / values if kind == ",depth" else values, rtol=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_png_priors_keep_their_depth(tmp_path, dtype):
    values = (np.arange(48).reshape(6, 8) * (np.iinfo(dtype).max // 48)).astype(dtype)
    cv2.imwrite(str(tmp_path / "p.png"), values)
    np.testing.assert_array_equal(depth_prior(f"file:{tmp_path}/p.png", 6, 8), values)


def test_a_prior_of_another_size_is_resized(tmp_path):
    np.save(tmp_path / "p.npy", np.tile(np.arange(32.0), (24, 1)))
    found = depth_prior(f"file:{tmp_path}/p.npy", 48, 64)
    assert found.shape == (48, 64)
    np.testing.assert_allclose(np.diff(found[10, 2:-2]), 0.5, atol=1e-6)


def test_depth_without_a_value_is_nan(tmp_path):
    np.save(tmp_path / "p.npy", np.array([[0, 2, np.nan], [-1, 4, np.inf]]))
    found = depth_prior(f"file:{tmp_path}/p.npy,depth", 2, 3)
    np.testing.assert_array_equal(found, [[np.nan, 0.5, np.nan], [np.nan, 0.25, 0]])


def test_unusable_priors_are_refused(tmp_path):
    np.save(tmp_path / "colour.npy", np.ones((6, 8, 3)))
    np.save(tmp_path / "text.npy", np.array([["a", "b"]]))
    np.save(tmp_path / "portrait.npy", np.ones((8, 6)))
    np.save(tmp_path / "empty.npy", np.full((6, 8), np.nan))
    np.save(tmp_path / "object.npy", np.array([[None]]), allow_pickle=True)
    (tmp_path / "broken.npy").write_bytes(b"nothing")
    (tmp_path / "broken.png").write_bytes(b"nothing")
    (tmp_path / "zero.png").write_bytes(b"")
    for name in ("colour.npy", "text.npy", "portrait.npy", "empty.npy", "object.npy", "broken.npy", "broken.png",
                 "zero.png", "missing.npy", "missing.exr", ""):  # fmt: skip
        with pytest.raises(BadInput, match="--depth-prior"):
            depth_prior(f"file:{tmp_path}/{name}", 6, 8)
    with pytest.raises(BadInput, match="not available in this version"):
        depth_prior("onnx:model.onnx", 6, 8)
    with pytest.raises(BadInput, match="unknown provider 'depht'"):
        depth_prior("depht", 6, 8)

"""Layers: occluders on the rim, surfaces that meet, and which part of the hole is whose."""

from __future__ import annotations

import numpy as np
import pytest

from gimp3d.stages.depth.layers import STEP, background_rim, divided, separated, steps, without_front

H, W = 120, 160
V, U = np.mgrid[:H, :W].astype(float)
HOLE = np.hypot(V - 60, U - 80) < 28
RIM = ~HOLE & (np.hypot(V - 60, U - 80) < 30)
FLOOR = 0.002 * V + 0.0004 * U + 0.1
WALL = np.full((H, W), 0.22) + 0.0003 * (U - 80)


@pytest.mark.parametrize("scene", [FLOOR, np.maximum(FLOOR, WALL), np.maximum(0.004 * (V - 35), 0.02)])
def test_surfaces_that_meet_are_all_kept_as_rim(scene):
    assert background_rim(scene, ~HOLE, HOLE)[~HOLE].all()
    assert len(separated(scene, ~HOLE, RIM)) == 1


@pytest.mark.parametrize("gap", [0, 3])
def test_an_occluder_is_no_rim_even_across_a_gap_without_depth(gap):
    """Splats are thin along a silhouette: between a pole and what lies behind it, a few pixels often have no depth."""
    pole = (np.abs(U - 50) < 6) & (V < 90)
    hole = HOLE & ~pole
    known = ~hole & ~((np.abs(U - 50) < 6 + gap) & (90 + gap > V) & ~pole)
    scene = np.where(pole, 0.8, FLOOR)
    dropped = known & ~background_rim(scene, known, hole)
    touching = hole & (np.abs(U - 50) < 8)
    assert dropped.any() and not (dropped & ~pole).any() and touching.any()


def test_a_slope_across_a_gap_is_no_step():
    """Near ground rises by more than a step's height within a gap, but as a plane."""
    steep = 0.05 + 0.012 * (V - 20).clip(0)
    known = ~HOLE & ~((V > 57) & (V < 63))
    assert background_rim(steep, known, HOLE)[known].all()
    assert len(separated(steep, known, RIM & known)) == 1


def test_the_layer_that_makes_up_much_of_the_rim_is_no_occluder():
    scene = np.where(V > 65, 0.5, 0.1)
    assert background_rim(scene, ~HOLE, HOLE)[~HOLE].all()
    near, far = separated(scene, ~HOLE, RIM)
    assert {bool(near[100, 80]), bool(far[100, 80])} == {True, False}


def test_what_hides_the_object_goes_however_large_it_is():
    scene = np.where(V > 65, 0.5, 0.1)
    front = RIM & (V > 65)
    left = without_front(scene, ~HOLE, HOLE, front, STEP)
    ring = np.hypot(V - 60, U - 80) < 40
    assert not left[ring & (V > 66)].any() and left[ring & (V < 63) & ~HOLE].all()
    assert without_front(scene, ~HOLE, HOLE, np.zeros_like(HOLE), STEP)[~HOLE].all()


def test_steps_are_no_slopes():
    assert not steps(FLOOR, np.ones((H, W), bool), 0.01).any()
    stepped = np.where(U > 80, 0.3, 0.2)
    found = steps(stepped, np.ones((H, W), bool), 0.06)
    assert found[:, 79:82].all() and not found[:, :76].any() and not found[:, 85:].any()


def seeds_of(layers):
    seeds = np.full((H, W), -1)
    for k, layer in enumerate(layers):
        seeds[layer & RIM] = k
    return seeds


def test_a_straight_border_goes_straight_through_the_hole():
    first = V > 48 + 0.3 * (U - 80)
    rings = [first & ~HOLE, ~first & ~HOLE]
    part = divided(HOLE, seeds_of(rings), rings)
    assert np.mean((part == 0)[HOLE] == first[HOLE]) > 0.97


def test_other_borders_follow_the_votes_of_the_rim():
    wedge = np.abs(np.arctan2(V - 60, U - 80)) < 0.8
    rings = [wedge & ~HOLE, ~wedge & ~HOLE]
    part = divided(HOLE, seeds_of(rings), rings)
    assert 0.1 < (part == 0)[HOLE].mean() < 0.3
    assert (part[60, 100:] == 0).all() and (part[60, 53:70] == 1).all()


def test_what_is_measured_in_the_hole_votes_too():
    first = U > 80
    rings = [first & ~HOLE, ~first & ~HOLE]
    seeds = seeds_of(rings)
    seeds[50:70, 85:95] = 1
    rings[1] = rings[1] | (seeds == 1)
    part = divided(HOLE, seeds, rings)
    assert (part[50:70, 85:95] == 1).all()


def test_no_layer_and_one_layer():
    assert (divided(HOLE, np.full((H, W), -1), []) == 0).all()
    assert (divided(HOLE, np.where(RIM, 2, -1), [RIM, RIM, RIM]) == 2).all()

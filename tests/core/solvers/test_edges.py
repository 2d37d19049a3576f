"""Straight edges are told on both sides of a hole, and what is no straight edge is not."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from structured import structured

from gimp3d.solvers.edges import find_edges, guide_of
from gimp3d.solvers.exemplar import complete_picture

SIDE, MIDDLE = 180, 90
HOLE = np.hypot(*np.indices((SIDE, SIDE)) - MIDDLE) < 30
Y, X = np.indices((SIDE, SIDE)) - MIDDLE


def textured(picture: np.ndarray, grain: float, size: float = 1.5, seed: int = 0) -> np.ndarray:
    """[H, W] → [H, W, 3] uint8 with blobs of a few pixels over it."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 1, picture.shape), (0, 0), size)
    return np.clip(picture + grain * noise / noise.std(), 1, 255).astype(np.uint8)[..., None].repeat(3, 2)


def found(picture: np.ndarray, hole: np.ndarray = HOLE):  # type: ignore[no-untyped-def]
    return find_edges(np.where(hole[..., None], np.uint8(0), picture), hole, ~hole, ~hole)


def side_of(angle: float, offset: float) -> np.ndarray:
    a = math.radians(angle)
    return math.cos(a) * Y - math.sin(a) * X - offset


@pytest.mark.parametrize("angle", [0, 17, 48, 90, 133])
@pytest.mark.parametrize("offset", [-15, 0, 9])
def test_a_border_of_two_textures_is_found_where_it_is(angle: float, offset: float) -> None:
    edges = found(textured(np.where(side_of(angle, offset) > 0, 150.0, 100.0), 12))
    assert len(edges) == 1
    along, ends = edges[0].along, edges[0].ends
    off = [side_of(angle, offset)[tuple(np.rint(edges[0].origin + t * along).astype(int)[::-1])] for t in (-25, 25)]
    assert np.abs(off).max() < 1.5
    assert ends[1] - ends[0] > 100


@pytest.mark.parametrize(("half_width", "edges"), [(1, 1), (8, 2)])
def test_a_line_is_an_edge_and_a_stripe_two(half_width: float, edges: int) -> None:
    assert len(found(textured(np.where(np.abs(side_of(62, 4)) < half_width, 90.0, 170.0), 5))) == edges


def test_what_hides_some_of_an_edge_is_looked_past() -> None:
    picture, beside = textured(np.where(side_of(30, 0) > 0, 150.0, 100.0), 12), np.hypot(X - 40, Y - 23) < 18
    picture[beside] = 0
    assert len(find_edges(picture, HOLE, ~HOLE & ~beside, ~HOLE & ~beside)) == 1


@pytest.mark.parametrize(
    "picture",
    [
        *(textured(np.full((SIDE, SIDE), 128.0), 30, size, seed) for size in (1, 3, 8) for seed in range(3)),
        textured(128 + 0.6 * side_of(20, 0), 3),  # a slope
        textured(128 + 40 * np.sin((side_of(0, 0) + 6 * np.sin(X / 13)) / 9), 3),  # waves
        textured(np.where((side_of(0, 0) > 0) & (X > 45), 150.0, 100.0), 8),  # a corner before the hole
        textured(np.where(side_of(0, np.where(X > 0, 20, -20)) > 0, 150.0, 100.0), 8),  # two that miss each other
        textured(np.where((np.abs(Y) < 2) & (X > 0) | (np.abs(X) < 2) & (Y > 0), 90.0, 150.0), 8),  # lines that meet
        textured(128 + 40.0 * (side_of(0, 0) > 0) * np.clip(X / 60, 0, 1), 8),  # one that fades out towards the hole
    ],
)  # fmt: skip
def test_nothing_else_is_a_straight_edge(picture: np.ndarray) -> None:
    assert not found(picture)


def run(edges, corner: tuple[float, float], directions: list[int]) -> bool:  # type: ignore[no-untyped-def]
    """Edges end at a place (x, y), one in each direction in degrees, and there are no others."""
    told = []
    for e in edges:
        ends = np.array([e.origin + t * e.along - MIDDLE for t in e.ends])
        away = np.hypot(*(ends - corner).T)
        assert away.min() < 3
        told.append(math.degrees(math.atan2(*(ends[away.argmax()] - corner)[::-1])))
    off = np.abs((np.array(directions)[:, None] - np.array(told) + 180) % 360 - 180)
    return len(told) == len(directions) and bool((off.min(0) < 4).all() and (off.min(1) < 4).all())


@pytest.mark.parametrize("turned", [0, 30, 75])
@pytest.mark.parametrize("corner", [(0, 0), (9, -12)])
def test_two_edges_that_are_told_on_one_side_each_meet_in_a_corner(turned: int, corner: tuple[int, int]) -> None:
    a = math.radians(turned)
    below = math.cos(a) * (Y - corner[1]) - math.sin(a) * (X - corner[0]) > 0
    beyond = math.cos(a) * (X - corner[0]) + math.sin(a) * (Y - corner[1]) > 0
    edges = found(textured(np.where(below & beyond, 150.0, 100.0), 8))
    assert run(edges, corner, [turned, turned + 90])
    checks = found(textured(np.where(below ^ beyond, 150.0, 100.0), 8))
    assert run(checks, corner, [turned + t for t in (0, 90, 180, 270)])


def test_a_border_that_another_one_continues_by_chance_has_its_corner() -> None:
    """A mat's beside a board's grain: both get darker there, but not from the same to the same."""
    mat, board = (X < 3) & (Y < 3), np.where(Y < 3, 110.0, 90.0)
    assert run(found(textured(np.where(mat, 180.0, board), 5)), (3, 3), [180, 270])


@pytest.mark.parametrize("angle", [0, 40, 90, 140])
def test_a_border_runs_on_where_what_is_beside_it_changes(angle: float) -> None:
    """A mat's beside a board that gets brighter: both halves are on one line, though no step is like the other."""
    on = math.cos(math.radians(angle)) * X + math.sin(math.radians(angle)) * Y
    board = 195 + 45 * np.clip(on / 30, -1, 1)
    edges = found(textured(np.where(side_of(angle, 4) > 0, 120.0, board), 5))
    ends = np.array([e.origin + t * e.along - MIDDLE for e in edges for t in e.ends])
    off = math.cos(math.radians(angle)) * ends[:, 1] - math.sin(math.radians(angle)) * ends[:, 0] - 4
    assert len(edges) == 2 and np.abs(off).max() < 1.5 and sorted(np.hypot(*ends.T) < 8) == [False, False, True, True]


def test_borders_on_two_lines_are_not_one() -> None:
    """Close to each other they may lie, as books of a row do."""
    board = 195 + 45 * np.clip(X / 30, -1, 1)
    assert not found(textured(np.where(np.where(X < 0, 0, 5) < Y, 120.0, board), 5))


@pytest.mark.parametrize("turned", [0, 30, 75])
def test_they_meet_right_beyond_the_hole_too(turned: int) -> None:
    a = math.radians(turned)
    down, right = math.cos(a) * Y - math.sin(a) * X, math.cos(a) * X + math.sin(a) * Y
    assert not HOLE[(down > 22.5) & (right > 22.5)].any()
    edges = found(textured(np.where((down < 22.5) & (right < 22.5), 150.0, 100.0), 6))
    corner = 22.5 * (math.cos(a) - math.sin(a)), 22.5 * (math.sin(a) + math.cos(a))
    assert run(edges, corner, [turned + 180, turned + 270])


def test_an_edge_goes_on_where_nothing_says_that_it_ends() -> None:
    picture, known = textured(np.where(side_of(0, 3) > 0, 150.0, 100.0), 8), ~HOLE & (X < 25)
    edges = find_edges(np.where(known[..., None], picture, np.uint8(0)), HOLE, known, known)
    assert len(edges) == 1 and edges[0].origin[0] + edges[0].along[0] * max(edges[0].ends) > MIDDLE + 25


@pytest.mark.parametrize(("sure", "ends"), [(60, True), (0, False), (30, False)])
def test_a_mat_whose_corner_is_near_goes_on_to_what_photos_disagree_on(sure: int, ends: bool) -> None:
    """Its border is told by 22 px; beyond the hole stands something else, and only where that is sure right beside the
    hole the mat ends: not where only its last pixels are, far off."""
    picture = textured(np.where((X > 3) & (Y < 52), 150.0, 100.0), 6)
    clutter = (Y < -20) & (X < 35)
    picture[clutter] = np.random.default_rng(0).integers(1, 255, (clutter.sum(), 1))
    shown = np.where(HOLE[..., None], np.uint8(0), picture)
    edges = find_edges(shown, HOLE, ~HOLE, ~HOLE & ((sure - MIDDLE > Y) | ~clutter))
    assert len(edges) == (not ends)
    for edge in edges:
        at = np.array([edge.origin + t * edge.along - MIDDLE for t in edge.ends])
        assert np.abs(at[:, 0] - 3).max() < 6 and at[:, 1].min() < -28 and 45 < at[:, 1].max() < 60


@pytest.mark.parametrize(("gap", "goes_on"), [(5, True), (0, False)])
def test_an_edge_goes_on_to_a_corner_right_beyond_the_hole(gap: int, goes_on: bool) -> None:
    """A chessboard's: on the hole's other side the next squares soon begin."""
    squares = np.where((X > 4) ^ (Y + 30 + gap < 0), 150.0, 100.0)
    edges = [e for e in found(textured(squares, 6)) if abs(e.along[1]) > 0.99]
    assert len(edges) == goes_on
    for edge in edges:
        reached = sorted(edge.origin[1] + t * edge.along[1] - MIDDLE for t in edge.ends)
        assert -30 - gap < reached[0] < -29 and reached[1] > 60


def test_pixels_of_one_guide_lie_at_one_distance() -> None:
    edge = found(textured(np.where(side_of(48, 3) > 0, 150.0, 100.0), 6))[0]
    guide = guide_of((edge,), HOLE.shape, 1, 6)
    off = (Y + MIDDLE - edge.origin[1]) * edge.along[0] - (X + MIDDLE - edge.origin[0]) * edge.along[1]
    near = (np.abs(off) < 6) & (np.hypot(X, Y) < 60)
    assert np.ptp(guide[near & (np.abs(off - 2) < 0.05)], axis=0).max() < 0.05
    assert ((guide[near, 1] > 0) == (off[near] > 0)).all()
    assert np.abs(guide[np.abs(off) > 30]).max() < 1e-3
    half = guide_of((edge,), (SIDE // 2, SIDE // 2), 2, 3)
    shrunk = cv2.resize(guide, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    assert np.abs(half - shrunk)[np.hypot(X, Y)[::2, ::2] < 60].max() < 0.1


def test_edges_of_two_kinds_have_two_guides() -> None:
    """Beside a dark stripe nothing is copied from beside a bright one, nor from its other edge, nor from where the
    step is the same, as from the bright stripe's far side."""
    off = side_of(48, 0)
    picture = textured(np.select([np.abs(off + 15) < 8, np.abs(off - 15) < 8], [70.0, 190.0], 130.0), 5)
    edges = sorted(found(picture), key=lambda e: e.origin[1] * e.along[0] - e.origin[0] * e.along[1])
    into, out_of, onto, off_it = (e.step.mean() for e in edges)
    assert min(out_of, onto) > 40 and max(into, off_it) < -40
    # where the distance from each is the same, the guide tells them apart by their steps and by their colours
    places = [tuple(np.rint(e.origin).astype(int)[::-1]) for e in edges]
    guides = np.array([guide_of(edges, HOLE.shape, 1, 6)[place] for place in places])
    assert np.ptp(guides[:, :2], axis=0).max() < 0.3
    assert np.allclose(255 * guides[:, 2:5], [e.step for e in edges], atol=12)
    assert np.allclose(128 + 255 * guides[:, 5:], [e.mean for e in edges], atol=12)
    assert np.allclose([e.mean.mean() for e in edges], [100, 100, 160, 160], atol=12)


@pytest.mark.parametrize("seed", range(3))
def test_a_straight_border_stays_straight_through_a_large_hole(seed: int) -> None:
    """Patches alone bend it, or let one side grow over the other: both textures fit the hole's rim."""
    truth = textured(np.where(side_of(62, 4) > 0, 150.0, 110.0), 14, 2.0, seed)
    truth[..., 0] = np.where(side_of(62, 4) > 0, truth[..., 0], truth[..., 0] // 2)
    hole = (np.abs(side_of(62, 0)) < 35) & (np.abs(side_of(152, 0)) < 60)
    filled = complete_picture(np.where(hole[..., None], np.uint8(0), truth), hole)[0].astype(int)
    wrong = hole & ((filled[..., 1] - filled[..., 0] < 20) != (side_of(62, 4) > 0)) & (np.abs(side_of(62, 4)) > 2)
    assert wrong.sum() < 0.005 * hole.sum()


def bowed(radius: float, angle: float) -> np.ndarray:
    """[H, W] px below a circle through the hole."""
    a = math.radians(angle)
    along, below = math.cos(a) * X + math.sin(a) * Y, math.cos(a) * Y - math.sin(a) * X - 2
    return below + radius - np.sqrt(np.maximum(radius**2 - along**2, 0))


def off(edges, below: np.ndarray) -> np.ndarray:  # type: ignore[no-untyped-def]
    """px by which edges miss where `below` [H, W] is 0, every half px along them in the hole."""
    lines = [e.origin + t * e.along for e in edges for t in np.arange(*e.ends, 0.5)]
    x, y = np.rint(lines).astype(int).reshape(-1, 2).clip(0, SIDE - 1).T
    return np.abs(below[y, x][HOLE[y, x]])


@pytest.mark.parametrize("radius", [90, 120, 200, 300])
@pytest.mark.parametrize("angle", [0, 40, 100])
def test_a_curve_runs_on_round(radius: float, angle: float) -> None:
    below = bowed(radius, angle)
    edges = found(textured(np.where(below > 0, 120.0, 190.0), 5))
    missed = off(edges, below)
    assert len(missed) > 100 and missed.mean() < 1.5 and missed.max() < 3.5


@pytest.mark.parametrize("seed", range(4))
def test_a_border_that_is_not_quite_straight_runs_on(seed: int) -> None:
    """As a mat's: no line is told on both sides, and neither side's runs out where the other's does."""
    below = bowed(550, 90)
    missed = off(found(textured(np.where(below > 0, 120.0, 190.0), 5, seed=seed)), below)
    assert len(missed) > 90 and missed.max() < 4


def test_what_is_wrong_next_to_the_hole_does_not_end_an_edge() -> None:
    """Remains of the object in photos' pixels, where masks are too small."""
    below = side_of(46, 4)
    picture = textured(np.where(below > 0, 120.0, 190.0), 5)
    wrong = (np.hypot(X, Y) < 42) & (np.abs(below) < 6) & (X < 0)
    picture[wrong & (below <= 0)], picture[wrong & (below > 0)] = (190, 150, 255), (60, 50, 20)
    edges = found(picture)
    assert len(off(edges, below)) > 90 and off(edges, below).max() < 4


def test_a_boards_streaks_do_not_hide_a_plates_rim() -> None:
    """They run into the hole beside it and go on behind: but what is told there best is the rim."""
    picture, hole = structured()["plate"]
    rim = [edge for edge in found(picture, hole) if np.linalg.norm(edge.step) > 80]
    ends = np.array([edge.origin + t * edge.along for edge in rim for t in edge.ends])
    inside = hole[tuple(np.rint(ends).astype(int).clip(0, 199).T[::-1])]
    assert inside.sum() > 4 and np.abs(np.hypot(ends[:, 1] - 180, ends[:, 0] - 80) - 80)[inside].max() < 2

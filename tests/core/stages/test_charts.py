"""Charts of a floor and a wall that a box hides, and where rays meet them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from scenes import REGION, cameras, charts_of

from gimp3d.box import Box
from gimp3d.camera import Camera
from gimp3d.geometry import sees
from gimp3d.orbit import look_at
from gimp3d.stages import charts as stage
from gimp3d.stages.charts import Chart, ChartSettings, Plane, extent, find, find_planes, first_hits, lay
from gimp3d.stages.ground import look_at as look_round
from gimp3d.stages.witness import Says, Textures, Witness, ask

FLOOR = (np.array([0.0, 0, 1]), 0.0)  # normal, offset
WALL = (np.array([0.0, -1, 0]), -0.4)
SLANT = (np.array([-0.12, 0.05, 1]) / np.linalg.norm([-0.12, 0.05, 1]), 0.02)
BLOCK = (np.array([-0.25, -0.25, 0]), np.array([0.25, 0.25, 0.5]))
UP = np.array([0.0, 0, 1])


def texture(points: np.ndarray) -> np.ndarray:
    x, y, z = np.moveaxis(points, -1, 0)
    waves = [np.sin(9 * x + 4 * y + 8 * z), np.sin(11 * y - 5 * x + 3 * z), np.sin(7 * x - 8 * y - 10 * z)]
    return np.stack([120 + 50 * w + 20 * waves[0] * waves[1] for w in waves], -1)


def striped(points: np.ndarray) -> np.ndarray:
    """Floorboards, which look alike a board further, and faint stains, which do not."""
    return 120 + 0.12 * (texture(points) - 120) + 40 * np.cos(2 * np.pi * points[..., :1] / 0.07)


def plane_reach(origin: np.ndarray, rays: np.ndarray, plane: tuple[np.ndarray, float]) -> np.ndarray:
    """How many rays' lengths away a plane is met; infinite where it is not."""
    normal, offset = plane
    with np.errstate(divide="ignore"):
        reach = (offset - origin @ normal) / (rays @ normal)
    return np.where(reach > 0, reach, np.inf)


def block_reach(origin: np.ndarray, rays: np.ndarray, grow: float = 0.0) -> np.ndarray:
    """The same for the block, grown by so much on every side."""
    with np.errstate(divide="ignore"):
        a, b = (BLOCK[0] - grow - origin) / rays, (BLOCK[1] + grow - origin) / rays
    near, far = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
    return np.where((near < far) & (near > 0), near, np.inf)


def ball_reach(origin: np.ndarray, rays: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """The same for a ball."""
    a, b = (rays**2).sum(-1), rays @ (origin - centre)
    root = b**2 - a * (((origin - centre) ** 2).sum() - radius**2)
    return np.where((root > 0) & (b < 0), (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)


@dataclass(frozen=True)
class Room:
    """Views of surfaces that the block hides."""

    witnesses: list[Witness]


def room(
    eyes: tuple[Camera, ...],
    planes: list[tuple[np.ndarray, float]],
    noise: float = 0.0,
    colours: Callable[[np.ndarray], np.ndarray] = texture,
    block: bool = True,
    front: float = -np.inf,  # y where the first plane ends
    ball: float | None = None,  # radius of one below the block, which touches its top
) -> Room:
    """Photos and depth maps, the latter with relative noise."""
    rng = np.random.default_rng(5)
    witnesses = []
    for camera in eyes:
        shape = (camera.height, camera.width)
        rays = camera.unproject(camera.pixel_centres(), np.ones(shape)) - camera.centre
        reach = np.array([plane_reach(camera.centre, rays, p) for p in planes])
        with np.errstate(invalid="ignore"):
            reach[0][camera.centre[1] + reach[0] * rays[..., 1] < front] = np.inf
        surface = reach.min(0)
        if ball is not None:
            surface = np.minimum(surface, ball_reach(camera.centre, rays, np.array([0, 0, -ball]), ball))
        object_at = block_reach(camera.centre, rays) if block else np.full(shape, np.inf)
        z = np.minimum(surface, object_at)
        shown = np.isfinite(z)
        z = np.where(shown, z, 0)
        photo = np.clip(np.rint(colours(camera.centre + z[..., None] * rays)), 0, 255)
        photo = np.where((object_at < surface)[..., None], [200, 20, 20], photo * shown[..., None]).astype(np.uint8)
        object_ = (object_at < surface).astype(np.uint8)
        hidden, some = (cv2.dilate(object_, np.ones((n, n), np.uint8)) > 0 for n in (3, 7))
        depth = (z * (1 + noise * rng.normal(size=shape))).astype(np.float32)
        witnesses.append(Witness(camera, photo, hidden, some & ~hidden, ~shown, depth))
    return Room(witnesses)


def crowded(bare: Room) -> Room:
    """The same with eight blocks like the object round it, which no box holds."""
    places = [np.array([x, y, 0]) for x in (-0.8, 0, 0.8) for y in (-0.8, 0, 0.8) if x or y]

    def of(seen: Witness) -> Witness:
        camera = seen.camera
        rays = camera.unproject(camera.pixel_centres(), np.ones(seen.hidden.shape)) - camera.centre
        reach = np.min([block_reach(camera.centre - place, rays) for place in places], axis=0)
        front = reach < np.where(seen.depth > 0, seen.depth, np.inf)
        painted = striped(camera.centre + np.where(front, reach, 0)[..., None] * rays)
        photo = np.where(front[..., None], np.clip(painted, 0, 255), seen.photo).astype(np.uint8)
        depth = np.where(front, reach, seen.depth).astype(np.float32)
        return replace(seen, photo=photo, hidden=seen.hidden & ~front, beside=seen.beside & ~front, depth=depth)

    return Room([of(seen) for seen in bare.witnesses])


def hidden_everywhere(eyes: tuple[Camera, ...], points: np.ndarray, grow: float) -> np.ndarray:
    """[N] bool: the block, grown, lies between the point and every camera that frames it, and one does."""
    always, framed = np.ones(len(points), bool), np.zeros(len(points), bool)
    for camera in eyes:
        uv, _ = camera.project(points)
        inside = ((uv >= 0) & (uv < [camera.width, camera.height])).all(1)
        framed |= inside
        always &= ~inside | (block_reach(camera.centre, points - camera.centre, grow) < 1)
    return always & framed


def unseen(chart: Chart, witnesses: list[Witness]) -> np.ndarray:
    """[H, W] bool: what the photos leave open of a chart."""
    surface = chart.camera.unproject(chart.camera.pixel_centres(), chart.depth.astype(float)).reshape(-1, 3)
    said = ask(witnesses, surface, chart.tolerance).reshape(-1, *chart.depth.shape)
    count = {s: (said == s).sum(0) for s in Says}
    shown = count[Says.SEEN] + count[Says.BESIDE] + count[Says.THROUGH]
    return (shown == 0) & (count[Says.HIDDEN] > 0)


def texels(chart: Chart) -> np.ndarray:
    """[H·W, 3] scene coordinates."""
    return chart.camera.unproject(chart.camera.pixel_centres(), chart.depth.astype(float)).reshape(-1, 3)


LOW, HIGH = (0.7, 1.2, 1.9), (1.6, 2.2, 2.8)  # eyes, scene units


def front_cameras(heights: tuple[float, float, float]) -> tuple[Camera, ...]:
    """Views from the room's side of the wall."""
    found = []
    for k in range(9):
        angle = np.radians(-90 + 12 * (k - 4))
        eye = np.array([2.2 * np.cos(angle), 2.2 * np.sin(angle), heights[k % 3]])
        found.append(Camera(str(k), 240, 180, 230.0, 230.0, 120.0, 90.0, look_at(eye, np.array([0, 0, 0.25]), UP)))
    return tuple(found)


EYES = cameras(9, 240, 180)


@pytest.fixture(scope="module")
def noisy() -> Room:
    return room(EYES, [SLANT], noise=0.01)


@pytest.fixture(scope="module")
def floor_room() -> Room:
    return room(EYES, [FLOOR])


@pytest.fixture(scope="module")
def floor_chart(floor_room: Room) -> Chart:
    (chart,) = charts_of([Plane.make(np.zeros(3), UP, REGION)], floor_room.witnesses)
    return chart


def test_a_plane_is_found_where_photos_have_it_though_depths_are_noisy(noisy: Room) -> None:
    (plane,) = find_planes(noisy.witnesses, REGION)
    assert len(find_planes(noisy.witnesses, REGION, ChartSettings(relief=0.0))) == 1  # the first stays
    normal, offset = SLANT
    assert np.degrees(np.arccos(plane.normal @ normal)) < 0.3
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 5), np.linspace(-0.3, 0.3, 5))
    assert np.abs(plane.points(x, y) @ normal - offset).max() < 0.003
    (chart,) = charts_of([plane], noisy.witnesses)
    assert chart.kind == "plane"


def test_depths_that_are_all_wrong_alike_do_not_move_the_plane(floor_room: Room) -> None:
    """Rough splats lie behind the surface that they show."""
    witnesses = [replace(w, depth=w.depth * np.float32(1.02)) for w in floor_room.witnesses]
    planes = find_planes(witnesses, REGION)
    assert planes[0].normal @ UP > np.cos(np.radians(0.3))
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 5), np.linspace(-0.3, 0.3, 5))
    assert np.abs(planes[0].points(x, y)[..., 2]).max() < 0.003


@pytest.mark.parametrize("azimuth", [45, 225])
def test_a_plane_is_found_from_a_start_that_is_tilted(azimuth: float) -> None:
    """Depths have the floor 8° aslant. Fine photos alone match it a board further; that it is not, coarse ones show."""
    eyes = front_cameras(HIGH)[::2]
    slope, towards = np.tan(np.radians(8)), np.radians(azimuth)
    aslant = np.array([slope * np.cos(towards), slope * np.sin(towards), 1])
    true, tilted = room(eyes, [FLOOR], colours=striped), room(eyes, [(aslant / np.linalg.norm(aslant), 0.0)])
    witnesses = [replace(w, depth=t.depth) for w, t in zip(true.witnesses, tilted.witnesses)]
    (plane,) = find_planes(witnesses, REGION)
    assert plane.normal @ UP > np.cos(np.radians(1))
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 5), np.linspace(-0.3, 0.3, 5))
    assert np.abs(plane.points(x, y)[..., 2]).max() < 0.01 * extent(REGION)


def test_a_wall_without_much_texture_is_not_tilted_towards_a_floor_with_more() -> None:
    def colours(points: np.ndarray) -> np.ndarray:
        """A wall that is painted almost evenly, above tiles."""
        tiles = np.floor(points[..., :1] / 0.3) + np.floor(points[..., 1:2] / 0.3)
        faint = 130 + 0.2 * (texture(points) - 120)
        return np.where(points[..., 1:2] > 0.399, faint, 120 + 60 * (tiles % 2) + 0.2 * (texture(points) - 120))

    eyes = front_cameras((0.5, 0.8, 1.2))
    seen = room(eyes, [FLOOR, WALL], noise=0.005, colours=colours)
    planes = find_planes(seen.witnesses, REGION)
    assert len(planes) == 2
    for normal, _ in (FLOOR, WALL):
        assert max(p.normal @ normal for p in planes) > np.cos(np.radians(1.5))


def test_a_further_plane_that_photos_deny_is_none(floor_room: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    """One of a table's end, its legs and the floor between them: where splats draw them, photos agree."""
    kept, slope = find._kept, np.tan(np.radians(16))
    monkeypatch.setattr(find, "SHARED", 0)
    for tilt, stays in (((slope, 0.0), False), ((0.0, -slope), False), ((0.0, 0.0), True)):

        def with_another(*of: Any, tilt: tuple[float, float] = tilt) -> Any:
            first, claim = kept(*of)[0]
            return [(first, claim), (first.tilted(0, *tilt), claim)]

        monkeypatch.setattr(find, "_kept", with_another)
        assert len(find_planes(floor_room.witnesses, REGION)) == 1 + stays


def test_a_floor_among_things_that_hide_most_of_it_is_told_by_the_photos_that_show_it() -> None:
    """Photos that show a neighbour say nothing of the floor behind it."""
    crowd = crowded(room(EYES, [FLOOR], noise=0.005))
    around = find._surface_round(crowd.witnesses, REGION)
    on_floor = around.take(np.abs(around.points[:, 2]) < 0.02)
    said = ask(crowd.witnesses, on_floor.points, find.TOLERANCE)
    assert (said == Says.BEHIND).sum() > (said == Says.SEEN).sum()
    textures, points = Textures.make(crowd.witnesses), on_floor.on(Plane.make(np.zeros(3), UP, REGION))
    assert textures.agreement(points, find._free(on_floor.points, textures)) > textures.agreement(points) + 0.3
    first = find_planes(crowd.witnesses, REGION)[0]
    x, y = np.meshgrid(np.linspace(-0.25, 0.25, 5), np.linspace(-0.25, 0.25, 5))
    assert np.abs(first.points(x, y)[..., 2]).max() < 0.01 * extent(REGION)


@pytest.mark.parametrize("other", [-0.2, 0.3])
@examples(10)
@given(st.floats(0.002, 0.02), st.floats(0.0, 0.7), st.integers(0, 99))
def test_what_stands_before_a_surface_or_shows_beyond_it_does_not_tell_how_it_scatters(
    other: float, sigma: float, share: float, seed: int
) -> None:
    (camera, *_), rng = EYES, np.random.default_rng(seed)
    shape = (camera.height, camera.width)
    z = np.full(shape, 2.0)
    points = camera.unproject(camera.pixel_centres(), z).reshape(-1, 3)
    drawn = z * (1 + sigma * rng.normal(size=shape) + other * (rng.uniform(size=shape) < share))
    nothing = np.zeros(shape, bool)
    view = Witness(camera, np.zeros((*shape, 3), np.uint8), nothing, nothing, nothing, drawn.astype(np.float32))
    assert find.depth_scatter(points, [view]) == pytest.approx(3 * sigma, rel=0.25)


def test_a_plane_is_sought_no_farther_off_than_said(floor_room: Room) -> None:
    textures, around = Textures.make(floor_room.witnesses), find._surface_round(floor_room.witnesses, REGION)
    floor = Plane.make(np.zeros(3), UP, REGION)
    for side in (-1, 1):
        guess = floor.tilted(side * 1.1 * find.SEARCH * extent(REGION), 0, 0)
        agreement = find._Claim(guess, around, [], floor_room.witnesses, extent(REGION)).agreement(textures)
        assert agreement(np.array([-side * 1.1 * find.SEARCH, 0, 0])) == 0 < agreement(np.zeros(3))


@pytest.mark.parametrize("low", [-0.5, -1.0])
def test_a_board_is_not_tilted_by_what_shows_beyond_its_edge(low: float) -> None:
    """Photos see past a shelf, to a floor below: there they tell nothing of how the shelf lies."""
    seen = room(front_cameras(LOW), [FLOOR, WALL, (UP, low)], front=-0.3)
    planes = find_planes(seen.witnesses, REGION)
    (board,) = (p for p in planes if p.normal @ UP > 0.9)
    assert board.normal @ UP > np.cos(np.radians(1))
    x, y = np.meshgrid(np.linspace(-0.25, 0.25, 5), np.linspace(-0.25, 0.25, 5))
    assert np.abs(board.points(x, y)[..., 2]).max() < 0.01 * extent(REGION)


@pytest.mark.parametrize(("high", "street"), [(0.08, 1.0), (0.08, 0.3), (0.12, 0.3)])
def test_of_two_levels_neither_is_a_compromise(high: float, street: float) -> None:
    """A pavement and the street before it: round the object a slope from one to the other has most of both."""

    def colours(points: np.ndarray) -> np.ndarray:
        return 120 + np.where(points[..., 2:] < high / 2, street, 1.0) * (texture(3 * points) - 120)

    eyes = tuple(c.scaled(1.25) if k == 4 else c for k, c in enumerate(front_cameras(LOW)))  # sizes differ
    seen = room(eyes, [(UP, high), FLOOR], noise=0.003, colours=colours, front=0.3)
    planes = sorted(find_planes(seen.witnesses, REGION), key=lambda p: p.origin[2])
    assert len(planes) == 2
    for plane, level in zip(planes, (0, high)):
        x, y = np.meshgrid(np.linspace(-0.3, 0.3, 5), np.linspace(-0.3, 0.3, 5))
        assert np.abs(plane.points(x, y)[..., 2] - level).max() < 0.005 * extent(REGION)


def test_a_floor_is_found_though_nearly_all_that_is_round_the_object_is_wall() -> None:
    """From low down the floor is a strip at the object's foot."""
    seen = room(front_cameras((0.3, 0.4, 0.5)), [FLOOR, WALL])
    around = find._surface_round(seen.witnesses, REGION)
    assert around.weight[around.points[:, 1] < 0.37].sum() < 0.1 * around.weight.sum()
    planes = find_planes(seen.witnesses, REGION)
    for normal, _ in (FLOOR, WALL):
        assert max(p.normal @ normal for p in planes) > np.cos(np.radians(1.5))


@pytest.mark.parametrize("count", [1, 2])
def test_few_photos_do_not_judge_a_plane(count: int) -> None:
    """Three must show a place to agree: with fewer, planes are as they are drawn, and parallel ones are one."""
    seen = room(front_cameras(LOW)[3 : 3 + count], [FLOOR, WALL])
    rows = np.where(np.arange(180) % 2, 1.05, 1).astype(np.float32)[:, None]
    doubled = [replace(w, depth=w.depth * rows) for w in seen.witnesses]
    for witnesses in (seen.witnesses, doubled):
        planes = find_planes(witnesses, REGION)
        assert len(planes) == 2 and planes[0].crosses(planes[1])
    planes = find_planes(seen.witnesses, REGION)
    for normal, _ in (FLOOR, WALL):
        assert max(p.normal @ normal for p in planes) > np.cos(np.radians(1))


ACROSS = (
    np.array([0.0, -0.5, 0.7]) / np.hypot(0.5, 0.7),
    0.15 / np.hypot(0.5, 0.7),
)  # meets FLOOR at y −0.3, WALL at z 0.5


def at_wall() -> np.ndarray:
    """[N, 3] pixels at the wall that led to such a plane."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-0.5, 0.5, 60), np.linspace(0.36, 0.4, 9)))
    return np.stack([x, y, (y + 0.3) / 1.4], -1)


def crossing(told: np.ndarray | None) -> tuple[Plane, tuple[Plane, ...], Room]:
    """A plane that rough depths make up across a corner, the floor and the wall there, and views of them."""
    normal, offset = ACROSS
    plane = replace(Plane.make(offset * normal, normal, REGION), told=told)
    others = tuple(Plane.make(o * n, n, REGION) for n, o in (FLOOR, WALL))
    return plane, others, room(front_cameras(LOW), [FLOOR, WALL])


def test_a_relief_is_of_what_lies_on_no_other_plane() -> None:
    plane, others, seen = crossing(None)
    flat = stage._placed(plane, REGION, seen.witnesses, 200)
    assert flat is not None
    textures = Textures.make(seen.witnesses)
    away = [
        np.abs(lay.lay_surface(flat, REGION, seen.witnesses, textures, others=o).depth - flat.depth).max()
        for o in ((), others)
    ]
    assert away[0] > 0.1 * extent(REGION) and away[1] < 0.03 * extent(REGION)


def test_what_the_object_hides_of_a_plane_hangs_together_with_what_led_to_it() -> None:
    places = {}
    for told in (None, at_wall()):
        plane, _, seen = crossing(told)
        flat = stage._placed(plane, REGION, seen.witnesses, 200)
        assert flat is not None
        places[told is None] = flat.points().reshape(-1, 3)
    assert places[True][:, 2].min() < -0.1 < 0 < places[False][:, 2].min()  # where it goes through the floor


def test_a_ground_takes_little_of_other_planes() -> None:
    """Light and shadow are told on it: what a floor shows once more, elsewhere, is dark in other places."""
    plane, others, seen = crossing(at_wall())
    grounds = look_round([plane, *others], seen.witnesses, REGION)
    shown = {id(g.plane): g.points()[g.known] for g in grounds}
    floor, wall = (shown[id(other)] for other in others)
    assert np.abs(floor[:, 2]).max() < 0.01 and np.abs(wall[:, 1] - 0.4).max() < 0.01
    made_up = shown.get(id(plane), np.zeros((0, 3)))
    assert len(made_up) < 0.4 * len(floor)


def test_a_surface_does_not_begin_anew_where_it_goes_through_another_one() -> None:
    """Pixels at the wall led to the plane: how far depths scatter is asked there, and it ends before the floor."""
    there, tolerance = {}, {}
    for told in (None, at_wall()):
        plane, _, seen = crossing(told)
        flat = stage._placed(replace(plane, told=None), REGION, seen.witnesses, 200)
        assert flat is not None
        laid = lay.Laid(plane, flat.camera, flat.depth, "plane", 0.0, np.nan, (), "")
        chart, _ = stage._chart(laid, REGION, seen.witnesses)
        points = texels(chart).reshape(*chart.depth.shape, 3)
        on_floor = np.abs(points[..., 2]) < 0.01
        on_wall = np.abs(points[..., 1] - 0.4) < 0.01
        there[told is None] = chart.there[on_floor].mean(), chart.there[on_wall].mean()
        tolerance[told is None] = chart.tolerance
    assert there[True][0] > 0.9 and there[False][0] == 0 and there[False][1] > 0.5
    assert tolerance[False] < 0.5 * tolerance[True]


def test_a_claim_s_pose_leads_to_the_plane() -> None:
    plane = Plane.make(np.array([1.0, 2, 0.02]), SLANT[0], REGION)
    claim = find._Claim(plane, find.Beside(*np.zeros((2, 0, 3)), np.zeros(0)), [], [], 0.7)
    other = plane.tilted(0.1, 0.2, -0.1)
    x, y = np.random.default_rng(3).normal(size=(2, 20))
    reached = claim.at(claim.pose_of(other))
    np.testing.assert_allclose(other.local(reached.points(x, y))[:, 2], 0, atol=1e-12)


def test_a_plane_s_axes_are_orthonormal_and_its_coordinates_come_back() -> None:
    plane = Plane.make(np.array([1.0, 2, 0.02]), SLANT[0], REGION).tilted(0.1, 0.2, -0.1)
    axes = np.stack([plane.right, plane.down, plane.normal])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    x, y, height = np.random.default_rng(1).normal(size=(3, 20))
    np.testing.assert_allclose(plane.local(plane.points(x, y, height)), np.stack([x, y, height], -1), atol=1e-12)


def test_tilting_raises_the_plane_by_its_slopes() -> None:
    plane = Plane.make(np.zeros(3), UP, REGION)
    tilted = plane.tilted(0.1, 0.2, -0.3)
    x, y = np.random.default_rng(2).normal(size=(2, 20))
    np.testing.assert_allclose(tilted.local(plane.points(x, y, 0.1 + 0.2 * x - 0.3 * y))[:, 2], 0, atol=1e-12)


def test_the_hole_is_what_no_photo_shows(floor_room: Room, floor_chart: Chart) -> None:
    by_masks = unseen(floor_chart, floor_room.witnesses)
    rim = cv2.morphologyEx(by_masks.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((5, 5), np.uint8)) > 0
    assert (floor_chart.hole != by_masks)[~rim].mean() < 1e-3  # at the rim colours tell
    hole, points = floor_chart.hole.ravel(), texels(floor_chart)
    np.testing.assert_allclose(points[:, 2], 0, atol=1e-5)
    certain = hidden_everywhere(EYES, points, 0.0)
    possible = hidden_everywhere(EYES, points, 0.06)  # 2 px of the farthest view, aslant
    assert certain.sum() > 500 and not possible.all()
    assert hole[certain].all() and not hole[~possible].any()


def test_a_chart_shows_the_floor_and_nothing_in_its_hole(floor_room: Room, floor_chart: Chart) -> None:
    c = floor_chart
    assert c.kind == "plane" and c.there.all() and c.agreement > 0.9 and c.noise < 1e-5
    assert np.abs(c.image[c.known] - texture(texels(c)).reshape(c.image.shape)[c.known]).max() < 4
    assert not (c.known & c.hole).any()
    said = ask(floor_room.witnesses, texels(c), c.tolerance).reshape(-1, *c.depth.shape)
    np.testing.assert_array_equal(c.photos, (said == Says.SEEN).sum(0))
    shown = np.isin(said, (Says.SEEN, Says.BESIDE)).any(0)
    assert (c.hole & ~shown).sum() > 500 and not c.image[c.hole].any()
    assert c.camera.id == "chart:1" and c.camera.forward @ UP == pytest.approx(-1)


def test_a_surface_that_nothing_hides_has_no_chart(floor_room: Room) -> None:
    clear = [replace(w, hidden=np.zeros_like(w.hidden)) for w in floor_room.witnesses]
    assert charts_of([Plane.make(np.zeros(3), UP, REGION)], clear) == ()


def test_what_the_object_hides_of_a_ball_is_found_though_the_plane_lies_below_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    foot, radius = 0.1, 1.0
    monkeypatch.setitem(globals(), "BLOCK", (np.array([-foot, -foot, -0.02]), np.array([foot, foot, 0.5])))
    witnesses = room(EYES, [(UP, -2 * radius)], ball=radius).witnesses
    (chart,) = charts_of([Plane.make(np.array([0, 0, -0.08]), UP, REGION)], witnesses)
    hole = texels(chart)[chart.hole.ravel()]
    assert chart.kind == "relief" and np.abs(hole[:, :2]).max() < foot + 0.03
    assert len(hole) > 0.8 * (2 * foot) ** 2 * (chart.camera.fx / chart.depth[0, 0]) ** 2
    assert np.abs(np.linalg.norm(hole - np.array([0, 0, -radius]), axis=1) - radius).max() < 0.005


def area(chart: Chart, mask: np.ndarray) -> float:
    """Of a chart's texels, square scene units."""
    return float(mask.sum()) * (chart.depth[0, 0] / chart.camera.fx) ** 2


def test_a_loud_texture_that_photos_show_a_little_beside_its_place_is_copied(
    floor_room: Room, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a pixel: they differ by more than on plain floor, but by less than they have in common."""

    def half_plain(points: np.ndarray) -> np.ndarray:
        x = points[..., :1]
        return np.repeat(120 + 100 * np.cos(2 * np.pi * x / 0.13) * (x > 0.35), 3, -1)

    loud = room(EYES, [FLOOR], colours=half_plain)
    beside = [replace(w, photo=np.roll(w.photo, k % 3 - 1, 1)) for k, w in enumerate(loud.witnesses)]
    plane = Plane.make(np.zeros(3), UP, REGION)
    known = []
    for share in (stage.MISPLACED, 0):
        monkeypatch.setattr(stage, "MISPLACED", share)
        (chart,) = charts_of([plane], beside)
        stripes = (texels(chart)[:, 0] > 0.4).reshape(chart.hole.shape) & chart.there & ~chart.hole & (chart.photos > 1)
        known.append(chart.known[stripes].mean())
    assert known[0] > 0.9 and known[1] < 0.5


def test_charts_keep_to_the_size_asked_for(floor_room: Room, floor_chart: Chart) -> None:
    plane = Plane.make(np.zeros(3), UP, REGION)
    small = charts_of([plane], floor_room.witnesses, ChartSettings(largest=50))[0]
    assert max(small.camera.width, small.camera.height) in (50, 51)
    assert area(small, small.hole) == pytest.approx(area(floor_chart, floor_chart.hole), rel=0.05)


@pytest.mark.parametrize(
    ("which", "heights"),
    [
        pytest.param(0, HIGH, id="floor-high"),
        pytest.param(1, LOW, id="wall-low"),
        pytest.param(0, LOW, id="floor-low"),
        pytest.param(1, HIGH, id="wall-high"),
    ],
)
def test_a_floor_ends_at_a_wall_and_the_wall_at_the_floor(which: int, heights: tuple[float, float, float]) -> None:
    eyes = front_cameras(heights)
    seen = room(eyes, [FLOOR, WALL])
    planes = [Plane.make(np.zeros(3), UP, REGION), Plane.make(np.array([0, 0.4, 0]), WALL[0], REGION)]
    chart = charts_of(planes, seen.witnesses)[which]
    (alone,) = charts_of(planes[which : which + 1], seen.witnesses)
    points, there, hole = texels(chart), chart.there.ravel(), chart.hole.ravel()
    behind = (points[:, 1] - 0.4, -points[:, 2])[which]  # how far behind the other surface
    assert alone.there.ravel()[behind > 0.01].any()  # the other chart, not the photos, ends this one
    assert not there[behind > 1e-4].any() and not (hole & ~there).any()
    assert there[behind < -1e-4].all()
    certain = hidden_everywhere(eyes, points, 0.0) & there
    assert certain.sum() > 100 and hole[certain].all()
    assert not hole[~hidden_everywhere(eyes, points, 0.06)].any()


@pytest.mark.parametrize("height", [0.005, 0.4])
def test_parallel_surfaces_do_not_end_each_other(height: float, floor_room: Room, floor_chart: Chart) -> None:
    planes = [Plane.make(np.array([0, 0, h]), UP, REGION) for h in (0.0, height)]
    first = charts_of(planes, floor_room.witnesses)[0]
    np.testing.assert_array_equal(first.there, floor_chart.there)


def test_a_mat_is_where_photos_agree_on_it_and_the_floor_elsewhere(floor_room: Room) -> None:
    """Rough depths do not tell a mat from the floor, but photos do; what the object hides is as what is round it."""
    high, edge = 0.03, 0.05
    raised = room(EYES, [(FLOOR[0], high)])

    def merged(low: Witness, mat: Witness) -> Witness:
        rays = low.camera.unproject(low.camera.pixel_centres(), np.ones(low.depth.shape)) - low.camera.centre
        on_mat = ((low.camera.centre + mat.depth[..., None] * rays)[..., 0] > edge) & ~low.hidden
        photo = np.where(on_mat[..., None], mat.photo, low.photo)
        return replace(low, photo=photo, depth=np.where(on_mat, mat.depth, low.depth))

    seen = [merged(*pair) for pair in zip(floor_room.witnesses, raised.witnesses)]
    planes = [Plane.make(np.array([0, 0, h]), UP, REGION) for h in (0.0, high)]
    alone = [charts_of([plane], seen, ChartSettings(relief=0.0))[0] for plane in planes]
    assert all(chart.there.all() for chart in alone)  # by depths
    for chart, lone, side in zip(charts_of(planes, seen, ChartSettings(relief=0.0)), alone, (-1, 1)):
        beyond = (side * (texels(chart)[:, 0] - edge)).reshape(chart.there.shape)
        told = (chart.photos > 1) | lone.hole
        assert chart.there[told & (beyond > 0.1)].mean() > 0.97
        assert chart.there[told & (beyond < -0.1)].mean() < 0.03
        assert not (chart.hole & ~chart.there).any()
        assert chart.hole[beyond > 0.1].sum() > 100


def test_the_extent_of_several_boxes_holds_them_all() -> None:
    one, two = Box.make([0, 0, 0], [1, 2, 2]), Box.make([10, 0, 0], [1, 1, 1])
    assert extent((one,)) == pytest.approx(3)
    assert extent((one, two)) == pytest.approx(np.linalg.norm([11, 2, 2]))


def chart_of(depth: np.ndarray, normal: np.ndarray, offset: float, away: float = 5.0, texel: float = 0.01) -> Chart:
    """A chart of a height field over the plane normal · p = offset, from `away` above the place nearest to 0."""
    h, w = depth.shape
    eye = (offset + away) * normal
    pose = look_at(eye, eye - normal, np.array([0.0, 1, 0]))
    camera = Camera("chart", w, h, away / texel, away / texel, w / 2, h / 2, pose)
    no, grey = np.zeros((h, w), bool), np.zeros((h, w, 3), np.uint8)
    axes = pose[:3, :3]
    plane = Plane(offset * normal, axes[0], axes[1], normal)
    there = np.ones((h, w), bool)
    laid, shown = (plane, camera, depth, "plane", 1.0, 0.0, (), ""), (there, grey, no, no)
    return Chart(*laid, *shown, 0.01, no.astype(np.uint16), scatter=0.0)


@pytest.mark.parametrize(("led", "height"), [(True, 0.0), (False, 0.0), (False, 1.0)])
def test_a_close_surface_is_there_only_where_it_hangs_together_with_what_led_to_it(led: bool, height: float) -> None:
    """On the floor textures differ as much less in a spot as on the mat. The mat is there if pixels in the spot led to
    it, or if it stands so high that the floor is no question."""
    floor_, mat = (chart_of(np.full((120, 160), 5, np.float32), UP, h) for h in (0.0, 0.02))
    right, down = np.meshgrid(np.arange(160), np.arange(120))
    on_mat, spot = right > 110, np.hypot(right - 35, down - 60) < 30
    told = mat.points()[on_mat | (spot & led)]
    mat = replace(mat, plane=replace(mat.plane, told=told), depth=mat.depth - np.float32(height) * spot)
    better = np.where(on_mat | spot, np.float32(1), np.float32(8))
    pairs = [(floor_, np.full((120, 160), 4, np.float32)), (mat, better)]
    drawn = [(replace(c, tolerance=0.05, hole=np.ones_like(c.hole)), spread) for c, spread in pairs]
    on_floor, on_it = stage._parted(drawn, [Witness(EYES[0], *np.zeros((5, 1, 1)))])
    for one in (on_floor, on_it):
        np.testing.assert_array_equal(one.hole, one.there)
    np.testing.assert_array_equal(on_floor.there, ~on_it.there | (spot & (height > 0)))
    assert on_it.there[right > 125].all() and not on_it.there[(right > 75) & (right < 95)].any()
    stays = led or height > 0
    assert on_it.there[np.hypot(right - 35, down - 60) < 10].all() == stays
    assert on_it.there[right < 75].any() == stays


def rays_of(camera: Camera) -> np.ndarray:
    return camera.unproject(camera.pixel_centres(), np.ones((camera.height, camera.width))) - camera.centre


@pytest.mark.parametrize("camera", EYES[:3])
def test_rays_meet_a_tilted_plane_where_they_should(camera: Camera) -> None:
    chart = chart_of(np.full((80, 100), 5, np.float32), *SLANT)
    asked = np.random.default_rng(3).random((180, 240)) < 0.7
    hits = first_hits([chart], camera, asked)
    reach = plane_reach(camera.centre, rays_of(camera), SLANT)
    uv, _ = chart.camera.project(camera.centre + np.where(np.isfinite(reach), reach, 0)[..., None] * rays_of(camera))
    off = np.abs(uv - [50, 40]) - [50, 40]
    inside, outside = asked & (off < -1e-3).all(-1), ~asked | (off > 1e-3).any(-1)
    assert inside.sum() > 900
    np.testing.assert_allclose(hits.depth[inside], reach[inside], rtol=1e-6)
    assert (hits.chart[inside] == 0).all() and (hits.chart[outside] == -1).all() and not hits.depth[outside].any()
    clear = inside & (np.abs(uv - np.rint(uv)) > 1e-3).all(-1)
    np.testing.assert_array_equal(hits.cols[clear], uv[clear][:, 0].astype(int))
    np.testing.assert_array_equal(hits.rows[clear], uv[clear][:, 1].astype(int))


@pytest.mark.parametrize("camera", EYES[:3])
def test_rays_meet_a_relief_where_they_should(camera: Camera) -> None:
    """Waves of ±2 cm, against bisection of the ray between what is certainly above and below them."""
    low, wave = 0.02, 2 * np.pi / 0.8

    def z_at(uv: np.ndarray) -> np.ndarray:
        return 5 - low * np.sin(wave * (uv[..., 0] - 100) * 0.01) * np.cos(wave * (uv[..., 1] - 80) * 0.01)

    flat = chart_of(np.full((160, 200), 5, np.float32), *FLOOR)
    chart = replace(flat, depth=z_at(flat.camera.pixel_centres()).astype(np.float32))
    hits = first_hits([chart], camera, np.ones((180, 240), bool))
    rays = rays_of(camera)
    above, below = (plane_reach(camera.centre, rays, (UP, h)) for h in (0.025, -0.025))
    framed = np.isfinite(below)
    for reach in (above, below):
        uv, _ = chart.camera.project(camera.centre + np.where(framed, reach, 0)[..., None] * rays)
        framed &= ((uv > 0) & (uv < [200, 160])).all(-1)
    above, below, rays = above[framed], below[framed], rays[framed]
    for _ in range(40):
        middle = (above + below) / 2
        uv, z = chart.camera.project(camera.centre + middle[:, None] * rays)
        over = z < z_at(uv)
        above, below = np.where(over, middle, above), np.where(over, below, middle)
    assert framed.sum() > 2000 and (hits.chart[framed] == 0).all()
    heights = (camera.centre + hits.depth[framed][:, None] * rays)[:, 2] - (camera.centre + above[:, None] * rays)[:, 2]
    grazing = (-rays[:, 2] / np.linalg.norm(rays[:, :2], axis=1)).min()
    assert np.abs(heights).max() < 0.01 * low * wave / (1 - low * wave / grazing)  # the rise over a texel of the ray
    plain = (camera.centre + plane_reach(camera.centre, rays, FLOOR)[:, None] * rays)[:, 2]
    assert np.abs(plain - (camera.centre + above[:, None] * rays)[:, 2]).max() > 0.015  # unlike the plane


def test_the_nearer_of_two_charts_is_met_and_the_other_where_it_is_not() -> None:
    flat = np.full((120, 120), 5, np.float32)
    low, high = chart_of(flat, *FLOOR), chart_of(flat, UP, 0.1)
    gap = np.ones((120, 120), bool)
    gap[40:80, 40:80] = False
    high = replace(high, there=gap)
    camera = EYES[2]
    rays, everything = rays_of(camera), np.ones((180, 240), bool)
    hits = [first_hits(c, camera, everything) for c in ([low, high], [high, low])]
    reach = plane_reach(camera.centre, rays, (UP, 0.1))
    upper, _ = high.camera.project(camera.centre + reach[..., None] * rays)
    through = ((upper > 40.01) & (upper < 79.99)).all(-1)
    off = np.abs(upper - 60).max(-1)
    on = (off < 59.9) & (off > 20.01)
    assert through.sum() > 100 and on.sum() > 1000
    assert (hits[0].chart[on] == 1).all() and (hits[0].chart[through] == 0).all()
    np.testing.assert_allclose(hits[0].depth[on], reach[on], rtol=1e-6)
    np.testing.assert_allclose(hits[0].depth[through], plane_reach(camera.centre, rays, FLOOR)[through], rtol=1e-6)
    np.testing.assert_array_equal(hits[0].depth, hits[1].depth)
    np.testing.assert_array_equal(hits[0].rows, hits[1].rows)


def test_a_chart_is_not_met_from_below_nor_behind_the_camera() -> None:
    chart = chart_of(np.full((80, 100), 5, np.float32), *FLOOR)
    everything = np.ones((180, 240), bool)
    for eye, target in (([0.1, 0, -2], [0, 0, 0]), ([0.1, 0, 2], [0, 0, 4])):
        camera = replace(EYES[0], viewmat=look_at(np.array(eye, float), np.array(target, float), np.array([0.0, 1, 0])))
        assert (first_hits([chart], camera, everything).chart == -1).all()


def test_what_several_photos_show_through_the_object_is_an_island_in_the_hole() -> None:
    given = room(EYES, [FLOOR])
    gap = np.array([[0.0, 0.0, 0.0]])
    witnesses = []
    for k, witness in enumerate(given.witnesses):
        col, row = witness.camera.project(gap)[0][0].astype(int)
        at = np.zeros(witness.hidden.shape, bool)
        if k < 4:
            at[row - 3 : row + 4, col - 3 : col + 4] = True
        there = room((witness.camera,), [FLOOR], block=False).witnesses[0]
        depth, photo = np.where(at, there.depth, witness.depth), np.where(at[..., None], there.photo, witness.photo)
        witnesses.append(replace(witness, hidden=witness.hidden & ~at, depth=depth, photo=photo))
    (chart,) = charts_of([Plane.make(np.zeros(3), UP, REGION)], witnesses)
    uv, _ = chart.camera.project(gap)
    col, row = uv[0].astype(int)
    island = ~chart.hole[row - 2 : row + 3, col - 2 : col + 3]
    assert island.all()


def test_rests_are_what_photos_agree_on_and_specks_do_not_grow() -> None:
    """Beside the hole: a spot of the object's red, two like it that photos disagree on or that is a speck."""
    shape, rng = (60, 80), np.random.default_rng(1)
    no, red = np.zeros(shape, bool), np.zeros(shape, bool)
    hole = no.copy()
    hole[20:40, 30:50] = True
    agreed, disputed, speck = np.s_[27:32, 24:28], np.s_[27:32, 52:56], np.s_[15, 40]
    for place in (hole, agreed, disputed, speck):
        red[place] = True
    known = ~hole
    known[disputed] = False
    colours = np.where(red[..., None], [190.0, 40, 40], [170.0, 130, 90]) + rng.normal(0, 5, (*shape, 3))
    image, photos = np.clip(colours, 0, 255).astype(np.uint8), np.where(hole, 0, 5).astype(np.uint16)
    shown = stage._Shown(~no, image, photos, np.uint16(5) - photos, known, known, hole, np.zeros(no.shape))
    rests, foreign = stage._told_by_colours(shown, image[hole], no)
    assert rests[agreed].all() and not rests[disputed].any() and rests[speck]
    assert foreign[disputed].all() and not foreign[known].any()
    assert rests[27:32, 22].all() and rests[29, 29]  # pixels beside it are mixed
    assert rests[12:18, 37:44].sum() == 1


def test_a_hole_that_is_no_larger_than_a_speck_is_one(
    floor_room: Room, floor_chart: Chart, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thin rod's."""
    monkeypatch.setattr("gimp3d.geometry.SPECK", int(floor_chart.hole.sum()))
    (chart,) = charts_of([Plane.make(np.zeros(3), UP, REGION)], floor_room.witnesses)
    np.testing.assert_array_equal(chart.hole, floor_chart.hole)


@pytest.mark.parametrize(("reach", "is_hole"), [(0, False), (5, True)])
def test_a_speck_that_no_photo_shows_is_no_hole(
    reach: int, is_hole: bool, floor_room: Room, floor_chart: Chart
) -> None:
    """Apart from the hole: a texel, and a spot of many."""
    row, col = 8, floor_chart.hole.shape[1] // 2
    spot = np.zeros(floor_chart.hole.shape, bool)
    spot[row - reach : row + reach + 1, col - reach : col + reach + 1] = True
    assert floor_chart.known[spot].all()

    def with_spot(witness: Witness) -> Witness:
        uv, _ = witness.camera.project(texels(floor_chart)[spot.ravel()])
        rows, cols = np.floor(uv[:, ::-1]).astype(int).T
        on = np.zeros(witness.hidden.shape, np.uint8)
        on[rows, cols] = 1
        covered = cv2.morphologyEx(on, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)) > 0
        photo = np.where(covered[..., None], np.uint8([200, 20, 20]), witness.photo)
        return replace(witness, hidden=witness.hidden | covered, photo=photo)

    (chart,) = charts_of([Plane.make(np.zeros(3), UP, REGION)], [with_spot(w) for w in floor_room.witnesses])
    place = texels(floor_chart).reshape(*spot.shape, 3)[row, col]
    col, row = np.floor(chart.camera.project(place)[0]).astype(int)  # the spot may have widened the chart
    assert chart.hole[row, col] == is_hole and not chart.known[row, col] and chart.there[row, col]
    if not is_hole:
        np.testing.assert_allclose(chart.image[row, col], texture(place), atol=10)


def test_the_object_hides_from_most_what_fewer_photos_show_or_have_something_else_before() -> None:
    def hides(hiding: int, photos: int, behind: int) -> bool:
        said = [Says.HIDDEN] * hiding + [Says.SEEN] * photos + [Says.BEHIND] * behind + [Says.NOTHING]
        return bool(stage._hides_from_most(np.array(said, np.uint8)))

    for photos, behind in ((3, 1), (1, 3), (3, 3)):
        assert hides(4, photos, behind) and not hides(3, photos, behind)


def test_what_no_photo_shows_is_hole_where_the_object_hides_it_in_some() -> None:
    """Beside a neighbour, too, that stands before it in most: once the object is gone the others look at it."""
    columns = [
        ([Says.HIDDEN, Says.BEHIND, Says.BEHIND], True),
        ([Says.HIDDEN, Says.NOTHING, Says.NOTHING], True),
        ([Says.BEHIND, Says.BEHIND, Says.NOTHING], False),
        ([Says.HIDDEN, Says.HIDDEN, Says.SEEN], False),
        ([Says.HIDDEN, Says.HIDDEN, Says.BESIDE], False),
        ([Says.HIDDEN, Says.THROUGH, Says.THROUGH], False),
    ]
    said = np.array([c for c, _ in columns], np.uint8).T[:, None]
    np.testing.assert_array_equal(stage._unseen(said)[0], [hole for _, hole in columns])


def test_a_few_texels_at_the_rim_do_not_end_the_surface_in_the_hole() -> None:
    """Rough depths let photos see through the surface at a spot; a table's edge, in half of what is round the hole."""
    said = np.full((5, 60, 80), Says.SEEN, np.uint8)
    said[:, 20:40, 30:50] = Says.HIDDEN
    edge = said.copy()
    said[:, 24:36, 20:30] = Says.THROUGH
    there = stage.shown_there(said)
    assert there[20:40, 34:50].all() and not there[28, 24]
    edge[:, :, 40:][edge[:, :, 40:] == Says.SEEN] = Says.THROUGH
    there = stage.shown_there(edge)
    assert there[20:40, 30:37].all() and not there[20:40, 44:].any()


def test_a_single_photo_tells_where_a_surface_ends() -> None:
    said = np.full((1, 40, 60), Says.SEEN, np.uint8)
    said[:, :, 30:] = Says.THROUGH
    there = stage.shown_there(said)
    assert there[:, :25].all() and not there[:, 35:].any()


def test_a_far_end_that_one_view_looks_at_costs_the_rest_no_detail() -> None:
    """Close views do not frame the floor's far end, which the block hides in a low one."""
    close = tuple(replace(c, fx=3.5 * c.fx, fy=3.5 * c.fy) for c in EYES)
    pose = look_at(np.array([0, -1.2, 0.4]), np.array([0, 0, 0.3]), UP)
    low = Camera("low", 240, 180, 120.0, 120.0, 120.0, 90.0, pose)
    plane, settings = Plane.make(np.zeros(3), UP, REGION), ChartSettings(largest=300)
    (alone,) = charts_of([plane], room(close, [FLOOR]).witnesses, settings)
    (chart,) = charts_of([plane], room((*close, low), [FLOOR]).witnesses, settings)
    size, alones = (np.linalg.norm(texels(c)[1] - texels(c)[0]) for c in (chart, alone))
    assert size < 1.1 * alones
    (whole,) = charts_of([plane], room((*close, low), [FLOOR]).witnesses, ChartSettings(largest=10_000))
    assert np.ptp(texels(whole)[:, 1]) > 2 * np.ptp(texels(chart)[:, 1])  # where it costs nothing, it is shown


def test_one_photo_alone_does_not_tell_that_the_surface_ends(floor_room: Room, floor_chart: Chart) -> None:
    """A gap in one photo's mask, behind which rough splats lie, is no hole in the floor that the object hides."""
    plane = Plane.make(np.zeros(3), UP, REGION)
    points = texels(floor_chart)[floor_chart.hole.ravel()]
    middle = points[np.linalg.norm(points - points.mean(0), axis=1) < 0.1]

    def with_gap(witness: Witness) -> Witness:
        gap = sees(witness.camera, np.ones(witness.depth.shape, np.float32), middle, np.inf)
        uv, _ = witness.camera.project(middle[gap])
        rows, cols = np.floor(uv[:, ::-1]).astype(int).T
        hidden, depth = witness.hidden.copy(), witness.depth.copy()
        hidden[rows, cols], depth[rows, cols] = False, 20.0
        return replace(witness, hidden=hidden, depth=depth)

    first, second, *others = floor_room.witnesses
    (one,) = charts_of([plane], [with_gap(first), second, *others])
    (two,) = charts_of([plane], [with_gap(first), with_gap(second), *others])
    there = sees(one.camera, one.there.astype(np.float32), middle, np.inf)
    assert there.all() and sees(one.camera, one.hole.astype(np.float32), middle, np.inf).all()
    assert not sees(two.camera, two.there.astype(np.float32), middle, np.inf).any()

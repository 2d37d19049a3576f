"""The object's shadow is found by the light that casts it, and only where there is one; and it is undone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest
from lit_scenes import Lamp, LitScene, blocked, grain, make_scene, plain, rug, stain, tiles
from scenes import BLOCK, floor_colours

from gimp3d.box import Box
from gimp3d.camera import Camera
from gimp3d.gaussians import SH_C0, Gaussians
from gimp3d.pipeline import PRESETS, RemovalResult, RemovalSettings, View, remove_object, render_bytes
from gimp3d.srgb import decoded, encoded, linear
from gimp3d.stages import light_search
from gimp3d.stages.charts import Chart, Plane
from gimp3d.stages.light_search import Light
from gimp3d.stages.shadow import Shadow, find_contact

SUN = Lamp(40, 110, 3)
OWN = Box.make([0, 0, BLOCK / 2], [BLOCK] * 3)
RED = 70  # by which the block is redder than green


@cache
def views(scene: LitScene) -> tuple[View, ...]:
    return tuple(View(c, render_bytes(scene.gaussians, c)) for c in scene.cameras())


@cache
def made(name: str) -> LitScene:
    return {
        "waves": lambda: make_scene("waves", [SUN], floor_colours),
        "grain": lambda: make_scene("grain", [Lamp(55, -40, 8)], grain),
        "tiles": lambda: make_scene("tiles", [Lamp(30, 200, 1)], tiles),
        "soft": lambda: make_scene("soft", [Lamp(45, 174, 8)], tiles),
        "neighbour": lambda: make_scene("neighbour", [SUN], grain, neighbour=True),
        "wall": lambda: make_scene("wall", [Lamp(30, 180, 4)], floor_colours, wall=True),
    }[name]()


@cache
def removed(scene: LitScene, settings: RemovalSettings = PRESETS["draft"]) -> RemovalResult:
    return remove_object(scene.gaussians, views(scene), scene.region, settings)


def log_luminance(picture: np.ndarray) -> np.ndarray:
    return np.log(linear(picture).mean(-1) + 4e-3)


def darkening(
    scene: LitScene, result: RemovalResult, of: Callable[[np.ndarray], np.ndarray] = np.array
) -> tuple[float, float]:
    """Mean log luminance less the truth's, or `of` that, in the shadow, outside the block: before and after."""
    before, after = [], []
    final = scene.gaussians.take(result.keep)
    final = final if result.added is None else final.extended(result.added)
    for view in views(scene)[::3]:
        true = log_luminance(render_bytes(scene.truth, view.camera))
        block = view.image[..., 0].astype(int) - view.image[..., 1] > RED
        dark = log_luminance(view.image) - true
        shadow = (dark < -0.1) & (cv2.dilate(block.astype(np.uint8), np.ones((9, 9), np.uint8)) == 0)
        before.append(dark[shadow])
        after.append((log_luminance(render_bytes(final, view.camera)) - true)[shadow])
    return float(of(np.concatenate(before)).mean()), float(of(np.concatenate(after)).mean())


@pytest.mark.parametrize("name", ["waves", "grain", "tiles", "neighbour", "wall"])
def test_the_light_is_found_and_its_shadow_goes(name: str) -> None:
    scene = made(name)
    result = removed(scene)
    assert result.shadow["found"], result.shadow["reason"]
    off = [
        np.degrees(np.arccos(np.dot(light["direction"], scene.lamps[0].direction))) for light in result.shadow["lights"]
    ]
    assert len(off) == 1 and off[0] < 10, result.shadow
    assert abs(result.shadow["lights"][0]["elevation"] - scene.lamps[0].elevation) < 10
    assert abs((result.shadow["lights"][0]["azimuth"] - scene.lamps[0].azimuth + 180) % 360 - 180) < 14
    before, after = darkening(scene, result)
    assert before < -0.3 and abs(after) < 0.2 * abs(before)


@pytest.mark.parametrize("over_chance", [3.0, 1.0])
def test_where_the_light_that_explains_most_does_not_fit_those_that_fit_are_tried(
    over_chance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, starts, kept = made("tiles"), [], light_search._kept

    def at_first_none(*given: Any) -> tuple[list[Light], np.ndarray]:
        starts.append(given)
        return ([], np.array([over_chance, 0.2])) if len(starts) == 1 else kept(*given)

    monkeypatch.setattr(light_search, "_kept", at_first_none)
    shadow = remove_object(scene.gaussians, views(scene), scene.region, PRESETS["draft"]).shadow
    if over_chance < light_search.EARNS:  # nothing is there: no need to look again
        assert len(starts) == 1 and not shadow["found"]
        return
    assert len(starts) == 2 and shadow["found"], shadow["reason"]
    assert np.degrees(np.arccos(np.dot(shadow["lights"][0]["direction"], scene.lamps[0].direction))) < 10


@pytest.mark.parametrize("paint", [plain, pytest.param(tiles, marks=pytest.mark.slow)])
def test_the_shade_of_a_room_goes_though_no_lamp_casts_it(paint) -> None:  # type: ignore[no-untyped-def]
    scene = make_scene("room", [Lamp(90, 0, np.inf, 0.9)], paint)
    result = removed(scene)
    assert result.shadow["found"], result.shadow["reason"]
    before, after = darkening(scene, result)
    assert before < -0.14 and abs(after) < 0.4 * abs(before), (before, after)


@pytest.mark.parametrize(
    "paint", [*(pytest.param(p, marks=pytest.mark.slow) for p in (plain, floor_colours, tiles)), rug, stain]
)
def test_where_the_object_casts_none_no_shadow_is_found(paint) -> None:  # type: ignore[no-untyped-def]
    scene = make_scene(paint.__name__, [], paint, casts=False)
    result = removed(scene)
    assert not result.shadow["found"] and "no shadow found" in result.shadow["reason"]
    off = remove_object(scene.gaussians, views(scene), scene.region, _off(PRESETS["draft"]))
    np.testing.assert_array_equal(result.keep, off.keep)


def test_a_neighbours_shadow_stays() -> None:
    scene = make_scene("neighbour alone", [SUN], grain, neighbour=True, casts=False)
    result = removed(scene)
    assert not result.shadow["found"]


def test_what_stands_before_the_shadow_keeps_its_colours() -> None:
    scene, result = made("neighbour"), removed(made("neighbour"))
    assert result.added is not None
    final = scene.gaussians.take(result.keep).extended(result.added)
    for view in views(scene):
        blue = (view.image[..., 2].astype(int) - view.image[..., 0] > 80).astype(np.uint8)
        inside = cv2.erode(blue, np.ones((5, 5), np.uint8)) > 0
        if inside.any():
            drawn = render_bytes(final, view.camera)
            assert np.abs(drawn.astype(int) - view.image)[inside].mean() < 3, view.camera.id


def luminance(gaussians: Gaussians) -> np.ndarray:
    """[N] of linear light."""
    return decoded(np.clip(0.5 + SH_C0 * gaussians.sh[:, 0].astype(float), 0.01, 1)).mean(-1)


def test_what_changed_is_removed_and_added() -> None:
    scene, result = made("waves"), removed(made("waves"))
    assert result.added is not None
    gone = np.flatnonzero(~result.keep)
    added = {mean.tobytes(): k for k, mean in enumerate(result.added.means)}
    pairs = [(row, added[m]) for row in gone if (m := scene.gaussians.means[row].tobytes()) in added]
    rows, brighter = (np.array(x) for x in zip(*pairs))
    assert 0.99 * result.lifted < len(rows) <= result.lifted  # a few of them are split, too
    before, after = scene.gaussians.take(rows), result.added.take(brighter)
    np.testing.assert_array_equal(after.quats, before.quats)
    np.testing.assert_array_equal(after.log_scales, before.log_scales)
    np.testing.assert_array_equal(after.opacity_logits, before.opacity_logits)
    gain = luminance(after) / luminance(before)
    share = blocked(before.means.astype(float), SUN.rays(), OWN)
    full, none = gain[share > 0.98], gain[share == 0]
    assert abs(np.median(full) * (1 - SUN.strength) - 1) < 0.15
    assert np.percentile(none, 95) < 1.1, "what is not in its shadow is left alone, but for that of the sky"


def test_pictures_show_photo_light_and_lifted_photo() -> None:
    pictures = [p for p in removed(made("waves")).pictures if p.kind == "shadow"]
    assert len(pictures) == 2
    photo, light, lifted = np.hsplit(pictures[0].draw(), 3)
    assert light.min() < 200 < 250 < light.max()
    changed = (lifted != photo).any(-1)
    assert (lifted[changed].astype(int) - photo[changed] >= 0).mean() > 0.95


@pytest.mark.parametrize("name, left", [("tiles", 0.5), ("soft", 0.26)])
def test_a_marked_shadow_is_lifted(name: str, left: float) -> None:
    """A soft one is not evenly dark, and its edge lies beyond the mark."""
    scene = made(name)
    masks = {}
    for view in views(scene)[::2]:  # the others abstain
        true = render_bytes(scene.truth, view.camera)
        masks[view.camera.id] = log_luminance(view.image) - log_luminance(true) < -0.15
    settings = RemovalSettings(extra_references=1, shadow="mask")
    result = remove_object(scene.gaussians, views(scene), scene.region, settings, shadow_masks=masks)
    assert result.shadow["found"], result.shadow["reason"]
    before, after = darkening(scene, result, np.abs)
    assert after < left * before


def test_of_two_lamps_shadows_the_marked_one_goes() -> None:
    lamps = Lamp(45, 110, 8, 0.45), Lamp(40, -40, 3, 0.4)
    scene = make_scene("two lamps", list(lamps), tiles)
    assert len(removed(scene).shadow["lights"]) == 2, "or this test tells nothing"

    def shadows(view: View) -> list[np.ndarray]:
        """[H, W] bool of each lamp."""
        camera, pixels = view.camera, view.camera.pixel_centres()
        rays = camera.unproject(pixels, np.ones(view.image.shape[:2])) - camera.centre
        floor = camera.centre - rays * (camera.centre[2] / np.minimum(rays[..., 2], -1e-9))[..., None]
        return [blocked(floor.reshape(-1, 3), x.rays(), OWN).reshape(rays.shape[:2]) > 0.5 for x in lamps]

    masks = {view.camera.id: shadows(view)[0] for view in views(scene)}
    settings = replace(PRESETS["draft"], shadow="mask")
    result = remove_object(scene.gaussians, views(scene), scene.region, settings, shadow_masks=masks)
    (light,) = result.shadow["lights"]
    assert np.degrees(np.arccos(np.dot(light["direction"], lamps[0].direction))) < 10
    assert result.added is not None
    final, brighter = scene.gaussians.take(result.keep).extended(result.added), ([], [])
    for view in views(scene)[::3]:
        change = log_luminance(render_bytes(final, view.camera)) - log_luminance(view.image)
        block = view.image[..., 0].astype(int) - view.image[..., 1] > RED
        beside = cv2.dilate(block.astype(np.uint8), np.ones((13, 13), np.uint8)) == 0
        first, second = shadows(view)
        brighter[0].append(change[beside & first & ~second])
        brighter[1].append(change[beside & second & ~first])
    gone, stays = (float(np.median(np.concatenate(b))) for b in brighter)
    assert gone > 0.4 and abs(stays) < 0.1, (gone, stays)


def test_marks_on_what_is_not_dark_change_nothing() -> None:
    scene = make_scene("plain", [], plain, casts=False)
    masks = {}
    for view in views(scene):
        uv, _ = view.camera.project(np.array([[0.6, 0.4, 0.0]]))
        masks[view.camera.id] = cv2.circle(
            np.zeros(view.image.shape[:2], np.uint8), tuple(uv[0].astype(int).tolist()), 15, 1, -1
        ) > 0  # fmt: skip
    settings = RemovalSettings(extra_references=1, shadow="mask")
    result = remove_object(scene.gaussians, views(scene), scene.region, settings, shadow_masks=masks)
    assert not result.shadow["found"]
    assert any("not darker" in w for w in result.warnings)


def test_the_papers_preset_has_none_of_it() -> None:
    assert PRESETS["paper"].shadow == PRESETS["paper-literal"].shadow == "off"
    assert PRESETS["draft"].shadow == PRESETS["balanced"].shadow == PRESETS["best"].shadow == "auto"


def test_rays_of_a_light_spread_as_its_softness_says() -> None:
    light = Light(np.array([0.0, 0.6, 0.8]), 6.0, np.ones(3))
    rays = light.rays(400)
    apart = np.degrees(np.arccos(rays @ light.towards))
    assert np.sqrt((apart**2).mean() / 2) == pytest.approx(6.0, rel=0.15)
    np.testing.assert_allclose(rays.mean(0) / np.linalg.norm(rays.mean(0)), light.towards, atol=0.02)


def _off(settings: RemovalSettings) -> RemovalSettings:
    return replace(settings, shadow="off")


# The dark rim where it touches a surface, told from textures that are dark by chance

SIDE, HOLE = 240, 100  # texels of the chart, and of the hole in its middle
ROUND = (Box.make([0, 0, 0.25], [0.5] * 3),)
Painted = Callable[[np.ndarray, np.ndarray], np.ndarray]  # x, y [H, W] in texels → linear colour [H, W, 3]


def chart_of(
    paint: Painted, taken: Callable[[np.ndarray], np.ndarray] = np.zeros_like, tint: Sequence[float] = (1, 1, 1)
) -> Chart:
    """A chart with a square hole; `taken` is the share of light that is missing at a distance from it, in texels, by
    `tint` more or less in each channel."""
    y, x = np.indices((SIDE, SIDE)).astype(float)
    hole = np.maximum(np.abs(x - SIDE / 2), np.abs(y - SIDE / 2)) < HOLE / 2
    away = cv2.distanceTransform((~hole).astype(np.uint8), cv2.DIST_L2, 5).astype(float)
    light = 1 - taken(away)[..., None] * tint
    image = np.rint(255 * encoded(np.clip(paint(x, y) * light, 0, 1))).astype(np.uint8)
    camera = Camera("chart:1", SIDE, SIDE, 500.0, 500.0, SIDE / 2, SIDE / 2, np.eye(4))
    plane = Plane.make(np.zeros(3), np.array([0.0, 0, 1]), ROUND)
    photos = np.where(hole, 0, 9).astype(np.uint16)
    depth, there = np.full(hole.shape, 5, np.float32), np.ones_like(hole)
    return Chart(
        plane, camera, depth, "plane", 1.0, 0.0, (), "",
        there, np.where(hole[..., None], np.uint8(0), image), ~hole, hole, 0.01, photos, 0.0,
    )  # fmt: skip


def even(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.broadcast_to([0.5, 0.3, 0.22], (*x.shape, 3))


def noise(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Speckles of 3 texels, of a fifth of the light."""
    spots = cv2.GaussianBlur(np.random.default_rng(0).normal(size=x.shape), (0, 0), 1.5)
    return even(x, y) * np.exp(0.2 * spots / spots.std())[..., None]


def boards(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Two materials whose border runs into the hole, and dark joints that do."""
    dark = np.where((x + y) % 60 < 4, 0.3, 1.0)[..., None]
    return np.where((x > SIDE / 2)[..., None], [0.5, 0.3, 0.22], [0.2, 0.26, 0.34]) * dark


def waves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return even(x, y) * (1 + 0.5 * np.sin(x / 11) * np.sin(y / 17))[..., None]


def carpet(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Dark as far as 40 texels round the hole."""
    near = np.maximum(np.abs(x - SIDE / 2), np.abs(y - SIDE / 2)) < HOLE / 2 + 40
    return np.where(near[..., None], 0.4, 1.0) * even(x, y)


def foot(distance: np.ndarray) -> np.ndarray:
    """Half of the light is missing at the hole, a third of that 4 texels away, nothing 10 away."""
    return 0.5 * np.exp(-((distance / 4) ** 2))


@pytest.mark.parametrize("paint", [even, noise, boards])
def test_a_dark_rim_is_found_and_as_dark_as_it_is(paint: Painted) -> None:
    found = find_contact([chart_of(paint, foot)])
    assert isinstance(found, Shadow), found
    ground, (taken,) = found.grounds[0], found.taken
    far = cv2.distanceTransform((~ground.hole).astype(np.uint8), cv2.DIST_L2, 5)
    for near, beyond in ((1, 2), (2, 4)):
        ring = (far > near) & (far <= beyond) & ~ground.hole
        assert abs(np.median(taken[ring]) - np.median(foot(far[ring]))) < 0.1, (near, np.median(taken[ring]))
    assert taken[far > 12].max() < 0.02


@pytest.mark.parametrize("paint", [even, noise, boards])
def test_a_rim_has_the_colour_of_what_the_object_gives_back(paint: Painted) -> None:
    """Yellow takes blue light alone."""
    tint = np.array([0.0, 0.1, 1.0])
    found = find_contact([chart_of(paint, foot, tint)])
    assert isinstance(found, Shadow), found
    ground, (taken,) = found.grounds[0], found.taken
    far = cv2.distanceTransform((~ground.hole).astype(np.uint8), cv2.DIST_L2, 5)
    for near, beyond in ((1, 2), (2, 4)):
        ring = (far > near) & (far <= beyond) & ~ground.hole
        off = np.median(taken[ring], axis=0) - np.median(foot(far[ring])) * tint
        assert np.abs(off).max() < 0.1, (near, off)


@pytest.mark.parametrize("paint", [even, noise, boards, waves, carpet])
def test_what_is_dark_by_chance_is_no_rim(paint: Painted) -> None:
    assert "no dark rim" in str(find_contact([chart_of(paint)]))


def test_a_bright_rim_is_none() -> None:
    assert isinstance(find_contact([chart_of(noise, lambda far: -foot(far))]), str)


def test_a_dimmer_picture_shows_the_same_rim() -> None:
    taken = []
    for dim in (1.0, 0.4):
        found = find_contact([chart_of(lambda x, y, dim=dim: dim * noise(x, y), foot)])  # type: ignore[misc]
        assert isinstance(found, Shadow)
        taken.append(found.taken[0])
    assert np.abs(taken[0] - taken[1]).mean() < 0.01


def test_without_a_surface_round_the_hole_there_is_none() -> None:
    assert isinstance(find_contact([]), str)


@cache
def standing(paint: Callable[[np.ndarray], np.ndarray], tint: tuple[float, ...], lamps: tuple[Lamp, ...]) -> LitScene:
    """A block on a floor that is dark within a few texels of its foot, whatever the lamps; more or less in each
    channel."""

    def dark_at_the_foot(points: np.ndarray) -> np.ndarray:
        beside = np.maximum(np.abs(points[:, :2]) - BLOCK / 2, 0)
        light = 1 - 0.6 * np.exp(-((np.hypot(*beside.T) / 0.05) ** 2))[:, None] * tint
        return encoded(linear_of(paint(points)) * light)

    return make_scene("foot", lamps, dark_at_the_foot, casts=bool(lamps))


def linear_of(colours: np.ndarray) -> np.ndarray:
    return linear(np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8))


@pytest.mark.parametrize(
    ("paint", "tint", "lamps"),
    [(grain, (1, 1, 1), ()), (plain, (1, 1, 1), ()), (grain, (0, 0.2, 1), ()), (grain, (1, 1, 1), (SUN,))],
)
def test_the_rim_goes_with_the_object(
    paint: Callable[[np.ndarray], np.ndarray], tint: tuple[float, ...], lamps: tuple[Lamp, ...]
) -> None:
    scene, truth = standing(paint, tint, lamps), make_scene("bare", [], paint, casts=False).truth
    seen = [View(c, render_bytes(scene.gaussians, c)) for c in scene.cameras(24, 480, 360)]
    result = remove_object(scene.gaussians, seen, scene.region, PRESETS["draft"])
    assert result.shadow["found"] and "dark rim" in result.shadow["reason"], result.shadow["reason"]
    assert len(result.shadow["lights"]) == len(lamps)
    final = scene.gaussians.take(result.keep)
    final = final if result.added is None else final.extended(result.added)
    left, before = [], []
    for view in seen[::4]:
        true, shown, photo = (
            np.log(linear(picture) + 4e-3)[..., np.argmax(tint)]
            for picture in (render_bytes(truth, view.camera), render_bytes(final, view.camera), view.image)
        )
        block = view.image[..., 0].astype(int) - view.image[..., 1] > 70
        rim = (photo - true < -0.15) & (cv2.dilate(block.astype(np.uint8), np.ones((7, 7), np.uint8)) == 0)
        before.append((photo - true)[rim])
        left.append((shown - true)[rim])
    was, now = (float(np.concatenate(x).mean()) for x in (before, left))
    assert was < -0.1 and abs(now) < 0.4 * abs(was), (was, now)

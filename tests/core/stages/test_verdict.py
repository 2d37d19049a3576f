"""The verdict follows what is spoiled on purpose, and knows what it cannot tell."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from scenes import BLOCK, REGION, block, cameras, charts_of, discs, floor, scene, truth

from gimp3d.gaussians import Gaussians
from gimp3d.geometry import SOLID
from gimp3d.pipeline import render_bytes
from gimp3d.raster import surface_depth
from gimp3d.stages import verdict
from gimp3d.stages.charts import Chart, Hits, Plane
from gimp3d.stages.clearing import ClearingSettings, chart_targets, object_pixels
from gimp3d.stages.masks import ViewMasks
from gimp3d.stages.propagate import Reference
from gimp3d.stages.selection import Fate, Selection
from gimp3d.stages.verdict import Verdict, judge
from gimp3d.stages.witness import Witness

EYES = cameras(9, 160, 120)


@dataclass(frozen=True)
class Case:
    """A removal from the block scene, before anything is filled."""

    scene: Gaussians
    keep: np.ndarray
    photos: dict[str, np.ndarray]
    charts: tuple[Chart, ...]
    targets: list[tuple[ViewMasks, Hits]]

    def judged(
        self,
        added: Gaussians | None,
        photographed: bool = True,
        given: Reference | None = None,
        with_charts: bool = True,
        photos: dict[str, np.ndarray] | None = None,
    ) -> Verdict:
        views = [v for v, _ in self.targets]
        left = [v.target & (added is None) for v in views]
        hits = {v.camera.id: h for v, h in self.targets} if with_charts else {}
        seen = set(self.photos) if photographed else set()
        charts = self.charts if with_charts else ()
        kept = self.scene.take(self.keep)
        final = kept if added is None else kept.extended(added)
        found = judge(self.scene, final, views, left, photos or self.photos, seen, charts, hits, given)
        assert found is not None
        return found


def case(whole: Gaussians) -> Case:
    """Rows after the floor's are the block's."""
    removed = np.arange(len(whole)) >= len(floor(with_hole=True))
    rng = np.random.default_rng(0)
    photos, views = {}, []
    for camera in EYES:
        noise = rng.normal(0, 12, (camera.height, camera.width, 3))
        photos[camera.id] = np.clip(render_bytes(whole, camera) + noise, 0, 255).astype(np.uint8)
        depth, alpha = surface_depth(whole, camera)
        no = np.zeros(depth.shape, bool)
        views.append(ViewMasks(camera, no, no, no, no, depth, alpha, depth, alpha, no))
    selection = Selection(np.where(removed, Fate.REMOVED_INSIDE, Fate.OUTSIDE).astype(np.uint8))
    (pixels,) = object_pixels(whole, views, ClearingSettings(), removed)
    witnesses = [
        Witness(v.camera, photos[v.camera.id], *objects, v.alpha_before < SOLID, v.depth_before)
        for v, objects in zip(views, pixels)
    ]
    charts = charts_of([Plane.make(np.zeros(3), np.array([0.0, 0, 1]), REGION)], witnesses)
    unmarked = [np.zeros((120, 160), bool)] * len(views)
    return Case(whole, ~removed, photos, charts, chart_targets(whole, selection, views, witnesses, charts, unmarked))


@pytest.fixture(scope="module")
def plain() -> Case:
    return case(scene())


@pytest.fixture(scope="module")
def patch() -> Gaussians:
    """The floor under the block, as it truly is."""
    whole = truth()
    return whole.take((np.abs(whole.means[:, :2]) <= BLOCK / 2).all(1))


@pytest.fixture(scope="module")
def good(plain: Case, patch: Gaussians) -> Verdict:
    return plain.judged(patch)


def coloured(gaussians: Gaussians, colour: float) -> Gaussians:
    sh = gaussians.sh.copy()
    sh[:, 0] = (colour - 0.5) / 0.28209479
    return replace(gaussians, sh=sh)


def test_a_true_fill_is_good(good: Verdict) -> None:
    assert good.score > 0.3
    assert good.open_share == 0 and good.remains < 0.02
    assert good.haze is not None and good.haze < 0.01
    assert good.ring_fidelity is not None and abs(good.ring_fidelity) < 0.3
    assert good.sharpness is not None and 0.5 < good.sharpness < 2
    assert good.agreement is not None and good.agreement > 0.8
    assert 0 < good.invented < 1 and good.expected_error > 0
    assert good.words[0].startswith(("good", "fair", "poor"))


def test_an_open_hole(plain: Case, good: Verdict) -> None:
    spoiled = plain.judged(None)
    assert spoiled.open_share == 1 and spoiled.score < 0.7 * good.score
    assert any("100% of the hole is open" in w for w in spoiled.words)


def test_a_rest_of_the_object(plain: Case, patch: Gaussians, good: Verdict) -> None:
    rest = block()
    spoiled = plain.judged(patch.extended(rest.take(rest.means[:, 0] > 0)))
    assert spoiled.remains > good.remains + 0.2 and spoiled.score < 0.5 * good.score
    assert any("still looks like it" in w for w in spoiled.words)


def test_haze_before_the_surface(plain: Case, patch: Gaussians, good: Verdict) -> None:
    places = np.random.default_rng(0).uniform([-0.2, -0.2, 0.2], [0.2, 0.2, 0.4], (60, 3))
    fog = discs(places, (0, 0, 1), np.full((60, 3), 0.95), 0.1)
    spoiled = plain.judged(patch.extended(replace(fog, opacity_logits=np.full(60, -1.0, np.float32))))
    assert spoiled.haze is not None and good.haze is not None and spoiled.haze > good.haze + 0.1
    assert spoiled.score < good.score
    assert any("haze" in w for w in spoiled.words)


def test_wrong_colours(plain: Case, patch: Gaussians, good: Verdict) -> None:
    wrong = coloured(patch, 0.95)
    spoiled = plain.judged(wrong)
    assert spoiled.score < 0.7 * good.score and spoiled.expected_error > good.expected_error
    worse = plain.judged(
        coloured(patch.extended(discs(np.array([[0.0, 0, 0.01]]), (0, 0, 1), np.ones((1, 3)), 0.5)), 0.95)
    )
    assert worse.score < spoiled.score
    assert worse.agreement is not None and good.agreement is not None and worse.agreement < good.agreement


def test_a_blurred_fill(plain: Case, good: Verdict) -> None:
    """On a floor of fine checks: a smooth fill lacks their detail."""
    checks = np.where((np.floor(scene().means[:, 0] / 0.035) + np.floor(scene().means[:, 1] / 0.035)) % 2 > 0, 0.8, 0.2)
    whole = scene()
    ground = np.arange(len(whole)) < len(floor(with_hole=True))
    sh = whole.sh.copy()
    sh[ground, 0] = ((checks[ground] - 0.5) / 0.28209479)[:, None]
    given = case(replace(whole, sh=sh))
    under = truth()
    under = under.take((np.abs(under.means[:, :2]) <= BLOCK / 2).all(1))
    fine = under.sh.copy()
    even = (np.floor(under.means[:, 0] / 0.035) + np.floor(under.means[:, 1] / 0.035)) % 2 > 0
    fine[:, 0] = (np.where(even, 0.8, 0.2) - 0.5)[:, None] / 0.28209479
    sharp, smooth = given.judged(replace(under, sh=fine)), given.judged(coloured(under, 0.5))
    assert sharp.sharpness is not None and smooth.sharpness is not None
    assert 0.5 < sharp.sharpness < 2 and smooth.sharpness < 0.5 * sharp.sharpness
    assert any("detail" in w for w in smooth.words)


def test_spoiled_surroundings(plain: Case, patch: Gaussians, good: Verdict) -> None:
    keep = plain.keep.copy()
    beside = (np.abs(plain.scene.means[:, 0]) < 0.5) & (plain.scene.means[:, 1] > 0.3) & (plain.scene.means[:, 1] < 0.6)
    spoiled = replace(plain, keep=keep & ~beside).judged(patch)
    assert spoiled.ring_fidelity is not None and spoiled.ring_fidelity < -1
    assert any("surroundings lost" in w for w in spoiled.words)


def test_without_photos_what_needs_them_is_not_told(plain: Case, patch: Gaussians) -> None:
    found = plain.judged(patch, photographed=False)
    assert found.ring_fidelity is None and found.agreement is None
    assert found.score > plain.judged(None, photographed=False).score
    assert not any("photos show it" in w or "against the photos" in w for w in found.words)


def test_without_charts_there_is_no_surface_for_haze(plain: Case, patch: Gaussians, good: Verdict) -> None:
    found = plain.judged(patch, with_charts=False)
    assert found.haze is None and found.score > plain.judged(None, with_charts=False).score


def test_a_given_picture_tells_what_no_photo_shows(plain: Case, patch: Gaussians, good: Verdict) -> None:
    view = plain.targets[0][0]
    filled = plain.scene.take(plain.keep).extended(patch)
    depth = surface_depth(filled, view.camera)[0]
    picture = Reference(view.camera, render_bytes(filled, view.camera), depth, view.target, ~view.target)
    told = plain.judged(patch, given=picture)
    assert told.invented < 0.3 * good.invented and told.score > good.score
    other = replace(picture, image=cv2.bitwise_not(picture.image))
    assert plain.judged(patch, given=other).score < told.score
    # other views see it beside its place if surfaces are drawn at other heights than the chart's
    rough = replace(plain, charts=tuple(replace(c, noise=0.2 * BLOCK) for c in plain.charts))
    assert rough.judged(patch, given=picture).score < told.score - 0.02
    assert rough.judged(patch).score == pytest.approx(good.score, abs=0.01)


@pytest.mark.parametrize("rough", [0.0, 400.0])
def test_how_rough_a_scan_is_excuses_no_error(rough: float) -> None:
    """The object's pixels miss photos and a given picture by 100 grey levels², whatever those round it do."""
    no, half = np.zeros(40, bool), np.arange(40) < 20
    told, given = np.arange(40) % 2 == 0, half & (np.arange(40) % 2 == 1)
    missed, usual = np.full((2, 40), 100.0)
    usual[~half] = rough
    sample = verdict._Sample(half, told, given, no, usual, missed, np.zeros(40), np.zeros((40, 3)), np.zeros((40, 3)))
    assert verdict._expected_error(sample) == pytest.approx(100.0)


def test_nothing_to_judge(plain: Case, patch: Gaussians) -> None:
    none, photos = np.zeros((120, 160), bool), plain.photos
    views = [replace(v, silhouette=none, target=none) for v, _ in plain.targets]
    assert judge(plain.scene, plain.scene, views, [none] * len(views), photos, set(photos), (), {}, None) is None

"""Optimising new Gaussians: they alone move, and held-out views decide."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import cameras, floor, truth

from gimp3d.compute.threads import set_thread_count
from gimp3d.evaluate import ssim_map
from gimp3d.gaussians import Gaussians
from gimp3d.pipeline import render_bytes
from gimp3d.raster import Gradients, render
from gimp3d.stages import refine
from gimp3d.stages.propagate import Rule
from gimp3d.stages.refine import Observation, RefineSettings, observed, refine_gaussians
from gimp3d.stages.seed import seed_gaussians

FIELDS = ("means", "log_scales", "quats", "opacity_logits", "sh")
QUICK = RefineSettings(steps=40, check=10)


def flat(gaussians: Gaussians) -> Gaussians:
    """The same as surfels; the floor's discs are thin along z, their last axis."""
    return replace(gaussians, log_scales=np.ascontiguousarray(gaussians.log_scales[:, :2]))


@pytest.fixture(scope="module", params=[False, True], ids=["3dgs", "2dgs"])
def task(request: pytest.FixtureRequest) -> tuple[Gaussians, Gaussians, list[Observation]]:
    """The floor with its hole, seeds in it that are too dark, and true pictures of the floor."""
    known, whole = floor(with_hole=True), truth()
    if request.param:
        known, whole = flat(known), flat(whole)
    observations = []
    for camera in cameras(9):
        target = (render(whole, camera).alpha > 0.9) & (render(known, camera).alpha < 0.9)
        rules = np.where(target, Rule.EVIDENCE, Rule.UNTOUCHED).astype(np.uint8)
        observations.append(observed(camera, render_bytes(whole, camera), rules))
    view = observations[1]
    depth = render(whole, view.camera).median_depth
    seeds = seed_gaussians(view.camera, (view.image * 0.8).astype(np.uint8), depth, view.target, request.param)
    return known, seeds, observations


def test_new_gaussians_come_nearer_to_every_view_and_the_rest_keeps_its_bytes(
    task: tuple[Gaussians, Gaussians, list[Observation]],
) -> None:
    known, seeds, observations = task
    before = {name: getattr(known, name).tobytes() for name in FIELDS}
    seeds_before = {name: getattr(seeds, name).tobytes() for name in FIELDS}
    found = refine_gaussians(known, seeds, observations, QUICK)
    assert {name: getattr(known, name).tobytes() for name in FIELDS} == before
    assert {name: getattr(seeds, name).tobytes() for name in FIELDS} == seeds_before
    assert 0 < found.steps <= QUICK.steps and found.confidence > 1 / 0.7 - 1
    assert found.gaussians.usable.all() and len(found.gaussians) == len(seeds)
    for name in FIELDS:
        assert getattr(found.gaussians, name).dtype == np.float32
    assert not np.array_equal(found.gaussians.means, seeds.means)

    def error(new: Gaussians) -> float:
        wrong = [(render_bytes(known.extended(new), o.camera).astype(float) - o.image)[o.target] for o in observations]
        return float(np.sqrt(np.mean([(w**2).mean() for w in wrong])))

    assert error(found.gaussians) < 0.8 * error(seeds)


def test_the_result_does_not_depend_on_threads_or_the_run(
    task: tuple[Gaussians, Gaussians, list[Observation]],
) -> None:
    known, seeds, observations = task
    found = []
    for threads in (1, 3):
        set_thread_count(threads)
        try:
            found.append(refine_gaussians(known, seeds, observations, replace(QUICK, steps=10, check=5)).gaussians)
        finally:
            set_thread_count(None)
    for name in FIELDS:
        assert getattr(found[0], name).tobytes() == getattr(found[1], name).tobytes()


def test_every_view_teaches_once_before_one_does_again(
    task: tuple[Gaussians, Gaussians, list[Observation]], monkeypatch: pytest.MonkeyPatch
) -> None:
    known, seeds, observations = task
    taught, looked = list[tuple[int, bytes]](), list[int]()
    slopes = refine._View.slopes

    def noted(view: refine._View, active: Gaussians) -> Gradients:
        taught.append((id(view), active.means.tobytes()))
        return slopes(view, active)

    monkeypatch.setattr(refine._View, "slopes", noted)
    refine_gaussians(
        known, seeds, observations, RefineSettings(21, check=7, patience=9), progress=lambda _, n, *__: looked.append(n)
    )
    views, states = zip(*taught)
    learners = len(set(views))
    assert learners == 8 and len(views) == 21 and looked == [7, 14, 21]
    assert len(set(views[:8])) == len(set(views[8:16])) == 8
    assert len(set(states)) == 12  # two views from each, but before a look or a new round


def test_held_out_views_keep_the_start_where_every_step_harms(
    task: tuple[Gaussians, Gaussians, list[Observation]], monkeypatch: pytest.MonkeyPatch
) -> None:
    known, seeds, observations = task
    monkeypatch.setattr(refine, "RATES", {**refine.RATES, "means": 50.0})
    monkeypatch.setattr(refine, "COLOUR", 5.0)
    found = refine_gaussians(known, seeds, observations, replace(QUICK, steps=30, check=5))
    assert found.steps == 0 and found.confidence == 0
    for name in FIELDS:
        assert np.array_equal(getattr(found.gaussians, name), getattr(seeds, name))


def test_nothing_to_do_returns_the_input() -> None:
    known, camera = floor(with_hole=True), cameras(9)[1]
    image = render_bytes(known, camera)
    nothing = observed(camera, image, np.zeros(image.shape[:2], np.uint8))
    seeds = known.take(np.arange(5))
    for settings, views in ((RefineSettings(), []), (QUICK, []), (QUICK, [nothing])):
        assert refine_gaussians(known, seeds, views, settings).gaussians is seeds
    none = known.take(np.arange(0))
    assert refine_gaussians(known, none, [nothing], QUICK).gaussians is none


def test_steps_are_those_of_torchs_own_adam() -> None:
    torch = pytest.importorskip("torch")
    seeds = replace(floor(with_hole=True).take(np.arange(20)), sh=np.zeros((20, 4, 3), np.float32))
    state, rng = refine._State(seeds), np.random.default_rng(0)
    arrays = (*(getattr(seeds, name).copy() for name in FIELDS[:4]), seeds.sh[:, :1].copy(), seeds.sh[:, 1:].copy())
    theirs = [torch.from_numpy(a).requires_grad_() for a in arrays]
    rates = [state.rates[name] for name in FIELDS[:4]] + [refine.COLOUR, refine.VIEW_DEPENDENCE]
    optimiser = torch.optim.Adam([{"params": [p], "lr": rate} for p, rate in zip(theirs, rates)], eps=1e-15)
    for _ in range(5):
        slopes = {name: rng.normal(size=getattr(seeds, name).shape).astype(np.float32) for name in FIELDS}
        slopes["means"][0, 0] = np.nan  # such a slope is none
        given = (*(slopes[name] for name in FIELDS[:4]), slopes["sh"][:, :1], slopes["sh"][:, 1:])
        for p, slope in zip(theirs, given):
            p.grad = torch.from_numpy(np.nan_to_num(slope))
        state.step(Gradients(**slopes))
        optimiser.step()
    there = [p.detach().numpy() for p in theirs]
    for name, own in zip(FIELDS, [*there[:4], np.concatenate(there[4:], 1)]):
        np.testing.assert_allclose(getattr(state.gaussians, name), own, rtol=1e-6, atol=1e-7)


def test_the_losss_gradient_by_differences(task: tuple[Gaussians, Gaussians, list[Observation]]) -> None:
    known, seeds, observations = task
    view = refine._View(known, observations[3])
    drawn, rng = view.region.render(seeds), np.random.default_rng(1)
    picture = drawn.rgb.astype(np.float64)
    loss, slopes = view.judged(replace(drawn, rgb=picture))
    assert loss > 0
    there = np.abs(picture) > 1e-3  # off the edges: kinks
    for way in (rng.normal(size=picture.shape), rng.random(picture.shape)):
        step = 1e-6 * way * there
        more, less = (view.judged(replace(drawn, rgb=picture + s))[0] for s in (step, -step))
        expected, scale = float((slopes.rgb * step).sum()), float(np.abs(slopes.rgb * step).sum())
        assert scale > 0 and abs((more - less) / 2 - expected) < 1e-3 * scale


def test_structure_is_that_of_the_metric() -> None:
    rng = np.random.default_rng(2)
    a, b = rng.integers(0, 256, (2, 40, 50, 3), dtype=np.uint8)
    camera = replace(cameras(9)[0], width=50, height=40)
    everywhere = np.ones((40, 50), bool)
    seen = Observation(camera, b, everywhere, everywhere.astype(np.float32))
    view = refine._View(floor(with_hole=True), seen)
    found = view._ssim(a.astype(np.float32) / 255, view.share[..., None] / 3)[0]
    inner = np.s_[6:-6, 6:-6]  # off the border, which the metric mirrors
    np.testing.assert_allclose(found.mean(-1)[inner], ssim_map(a, b)[inner], atol=1e-4)


def test_pixels_count_as_far_as_their_rule_is_believed() -> None:
    camera = cameras(9)[1]
    rules = np.array([[*Rule]], np.uint8)
    seen = observed(camera, np.zeros((1, len(Rule), 3), np.uint8), rules)
    weight = dict(zip(Rule, seen.weight[0]))
    assert weight[Rule.EVIDENCE] > weight[Rule.OWN_PIXELS] == weight[Rule.REFERENCE] > weight[Rule.UNREACHED] == 0
    assert not seen.target[0, Rule.UNTOUCHED] and seen.target.sum() == len(Rule) - 1

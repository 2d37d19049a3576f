"""Optimising new Gaussians: they alone move, held-out views decide, and without torch nothing happens but a warning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import REGION, cameras, floor, scene, truth

from gimp3d import pipeline
from gimp3d.errors import BadInput
from gimp3d.gaussians import Gaussians
from gimp3d.pipeline import PRESETS, View, remove_object, render_bytes
from gimp3d.raster import render
from gimp3d.stages import refine
from gimp3d.stages.propagate import Rule
from gimp3d.stages.refine import Observation, RefineSettings, observed, refine_gaussians
from gimp3d.stages.seed import seed_gaussians
from gimp3d.threads import set_thread_count

torch = pytest.importorskip("torch")
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
    assert 0 < found.steps <= QUICK.steps and found.after < 0.7 * found.before
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


def test_held_out_views_keep_the_start_where_every_step_harms(
    task: tuple[Gaussians, Gaussians, list[Observation]],
) -> None:
    known, seeds, observations = task
    wild = replace(QUICK, steps=30, check=5, rate_means=50.0, rate_colour=5.0)
    found = refine_gaussians(known, seeds, observations, wild)
    assert found.steps == 0 and found.after == found.before
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
    seeds = replace(floor(with_hole=True).take(np.arange(20)), sh=np.zeros((20, 4, 3), np.float32))
    state = refine._State(seeds, QUICK)
    theirs = [p.detach().clone().requires_grad_() for p in state.parameters]
    groups = [{"params": [p], "lr": rate} for p, rate in zip(theirs, state.rates)]
    optimiser = torch.optim.Adam(groups, eps=1e-15)
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        for own, other in zip(state.parameters, theirs):
            own.grad = torch.randn(own.shape, generator=generator)
            other.grad = own.grad.clone()
        state.parameters[0].grad[0, 0] = float("nan")  # such a slope is none
        theirs[0].grad[0, 0] = 0.0
        state.step()
        optimiser.step()
    for own, other in zip(state.parameters, theirs):
        assert torch.equal(own, other)


def test_pixels_count_as_far_as_their_rule_is_believed() -> None:
    camera = cameras(9)[1]
    rules = np.array([[*Rule]], np.uint8)
    seen = observed(camera, np.zeros((1, len(Rule), 3), np.uint8), rules)
    weight = dict(zip(Rule, seen.weight[0]))
    assert weight[Rule.EVIDENCE] > weight[Rule.OWN_PIXELS] > weight[Rule.REFERENCE] > weight[Rule.UNREACHED] == 0
    assert not seen.target[0, Rule.UNTOUCHED] and seen.target.sum() == len(Rule) - 1


def test_depth_maps_normals_agree_with_the_rasterisers() -> None:
    camera = cameras(9)[1]
    drawn = render(flat(truth()), camera, passes=frozenset({"normal", "expected_depth"}))
    rays = torch.from_numpy(refine._rays(camera).astype(np.float32))
    normals = refine._normals(torch.from_numpy(drawn.expected_depth), rays).numpy()
    inner = drawn.alpha > 0.99
    inner[:2], inner[-2:], inner[:, :2], inner[:, -2:] = False, False, False, False
    assert np.median((normals * drawn.normals).sum(-1)[inner]) > 0.95


def test_without_torch_it_is_refused_and_a_removal_goes_on_as_draft(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refine, "torch_is_there", lambda: False)
    monkeypatch.setattr(pipeline, "torch_is_there", lambda: False)
    camera = cameras(9)[1]
    image = render_bytes(truth(), camera)
    seen = observed(camera, image, np.ones(image.shape[:2], np.uint8))
    with pytest.raises(BadInput, match="torch"):
        refine_gaussians(truth(), truth().take(np.arange(3)), [seen], QUICK)
    views = [View(c, render_bytes(scene(), c)) for c in cameras(9)]
    balanced = PRESETS["balanced"]
    result = remove_object(scene(), views, REGION, balanced)
    assert any("torch" in warning and "draft" in warning for warning in result.warnings)
    unrefined = remove_object(scene(), views, REGION, replace(balanced, refine=RefineSettings()))
    assert result.added is not None and unrefined.added is not None
    for name in FIELDS:
        assert getattr(result.added, name).tobytes() == getattr(unrefined.added, name).tobytes()

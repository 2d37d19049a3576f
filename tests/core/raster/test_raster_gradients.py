"""The way back: gradients against the float64 reference, finite differences, invariances, and odd input."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from test_raster_render import CAMERA, one, posed, random_scene

from gimp3d.camera import Camera
from gimp3d.compute import threads
from gimp3d.gaussians import Gaussians, matrices_to_quats, quats_to_matrices
from gimp3d.raster import Gradients, PictureGradients, RasterSettings, Rendering, backward, render, trace
from gimp3d.raster.blend import BLOCK, BLOCK_STATE, CLOSED, HELD
from gimp3d.raster.cpu import Trace
from gimp3d.raster.project import TILE

torch = pytest.importorskip("torch")
from torch_reference import draw  # noqa: E402 (needs torch)

PARAMETERS = ["means", "log_scales", "quats", "opacity_logits", "sh"]
OUTPUTS = {  # a picture's pass
    "rgb": "rgb",
    "alpha": "alpha",
    "expected_depth": "expected_depth",
    "median_depth": "depth",
    "normals": "normal",
}
KINDS = ["3d", "antialiased", "surfels"]
TOLERANCE = 1e-5  # relative L2 error of float32 gradients
BACKGROUND = RasterSettings(background=(0.1, 0.2, 0.3))
WIDE = Camera("wide", 75, 50, 60.0, 63.0, 36.5, 26.0, np.eye(4))
ODD_VALUES = [0.0, -0.0, 1e-30, 1e10, -1e10, 3e38, np.inf, -np.inf, np.nan, 79.0, 81.0, -200.0]


@pytest.fixture
def any_thread_count():
    yield
    threads.set_thread_count(None)


def scene(kind: str, seed: int, count: int = 40, degree: int = 1) -> Gaussians:
    return replace(random_scene(seed, count, degree, kind == "surfels"), antialiased=kind == "antialiased")


def tame_scene(kind: str, seed: int, count: int = 30, degree: int = 1) -> Gaussians:
    """Nothing near the camera's plane, no needles, no surfel edge-on, hardly anything that alpha_max caps."""
    gaussians, rng = scene(kind, seed, count, degree), np.random.default_rng(seed)
    z = rng.uniform(1.5, 5, count)
    means = np.stack([rng.normal(0, 0.3, count) * z, rng.normal(0, 0.25, count) * z, z], 1).astype(np.float32)
    log_scales = rng.uniform(-2.5, -1.2, gaussians.log_scales.shape).astype(np.float32)
    logits = rng.uniform(-2, 2, count).astype(np.float32)
    if kind == "surfels":
        quats = rng.normal(0, 2, (count, 50, 4)).astype(np.float32)
        towards = means / np.linalg.norm(means, axis=1, keepdims=True)
        cosines = np.einsum("nki,ni->nk", quats_to_matrices(quats)[..., 2], towards)
        gaussians = replace(gaussians, quats=quats[np.arange(count), np.argmax(np.abs(cosines) > 0.4, 1)])
    return replace(gaussians, means=means, log_scales=log_scales, opacity_logits=logits)


def drawn_with(
    gaussians: Gaussians, camera: Camera, names: list[str], raster: RasterSettings = BACKGROUND
) -> tuple[Rendering, Trace]:
    rendering, traced = trace(gaussians, camera, raster, frozenset(OUTPUTS[n] for n in names))
    assert isinstance(traced, Trace)
    return rendering, traced


def random_upstream(rendering: Rendering, names: list[str], seed: int, where: np.ndarray) -> dict[str, np.ndarray]:
    """Random gradients of the named pictures, 0 but `where`."""
    rng = np.random.default_rng(seed)
    given = {n: rng.normal(0, 1, getattr(rendering, n).shape).astype(np.float32) for n in names}
    return {n: g * where.reshape(where.shape + (1,) * (g.ndim - 2)) for n, g in given.items()}


def all_gradients(
    gaussians: Gaussians, camera: Camera, seed: int = 0, raster: RasterSettings = BACKGROUND
) -> Gradients:
    """The gradients of all six pictures under a random loss."""
    rendering, traced = drawn_with(gaussians, camera, list(OUTPUTS), raster)
    everywhere = np.ones((camera.height, camera.width), bool)
    return backward(traced, PictureGradients(**random_upstream(rendering, list(OUTPUTS), seed, everywhere)))


def arrays(gradients: Gradients) -> list[np.ndarray]:
    return [getattr(gradients, p) for p in PARAMETERS]


def assert_identical(a: Gradients, b: Gradients) -> None:
    for x, y in zip(arrays(a), arrays(b), strict=True):
        np.testing.assert_array_equal(x, y)


def pairs_in_use(traced: Trace, count: int) -> np.ndarray:
    """[H, W, N] bool: false where a pixel was closed before the Gaussian's turn came."""
    camera, lists = traced.camera, traced.lists
    used = np.ones((camera.height, camera.width, count), bool)
    across = -(-camera.width // TILE)
    for slot, tile in enumerate(lists.tiles):
        planes = traced.kept[3][slot].reshape(TILE // BLOCK, TILE // BLOCK, BLOCK_STATE // 16, BLOCK, BLOCK)
        closed = np.where(planes[:, :, HELD // 16] > 0, planes[:, :, CLOSED // 16], np.inf)
        closed = closed.transpose(0, 2, 1, 3).reshape(TILE, TILE)  # the number of entries that a pixel took
        top, left = tile // across * TILE, tile % across * TILE
        there = used[top : top + TILE, left : left + TILE]
        entries = lists.entries[lists.starts[slot] : lists.stops[slot]]
        there[..., entries] = np.arange(len(entries)) < closed[: there.shape[0], : there.shape[1], None]
    return used


def errors(
    gaussians: Gaussians, camera: Camera, names: list[str], seed: int = 0, raster: RasterSettings = BACKGROUND
) -> np.ndarray:
    """Relative L2 errors of the five parameters' gradients; the reference takes the same Gaussians per pixel."""
    rendering, traced = drawn_with(gaussians, camera, names, raster)
    parameters = [torch.tensor(getattr(gaussians, p), dtype=torch.float64, requires_grad=True) for p in PARAMETERS]
    used = torch.tensor(pairs_in_use(traced, len(gaussians)))
    reference = draw(*parameters, camera, raster, gaussians.antialiased, used)
    sure = ~reference.doubtful.numpy()
    assert sure.mean() > 0.95
    # 1 / alpha amplifies the rounding of a mean depth, or of a direction, that hardly any weight has gone into
    solid = sure & (reference.alpha.detach().numpy() > 0.02)
    given = random_upstream(rendering, names, seed, sure)
    for name in set(names) & {"expected_depth", "normals"}:
        given |= random_upstream(rendering, [name], seed, solid)
    loss = sum((getattr(reference, n) * torch.tensor(g, dtype=torch.float64)).sum() for n, g in given.items())
    expected = torch.autograd.grad(loss, parameters, materialize_grads=True)
    actual = arrays(backward(traced, PictureGradients(**given)))
    return np.array([relative(a, e.numpy()) for a, e in zip(actual, expected)])


def relative(actual: np.ndarray, expected: np.ndarray) -> float:
    """|actual − expected| / |expected|, 0 for 0 / 0."""
    return float(np.linalg.norm(actual - expected) / max(np.linalg.norm(expected), 1e-30))


@pytest.mark.parametrize("name", OUTPUTS)
@pytest.mark.parametrize("kind", KINDS)
def test_every_output_alone_matches_the_reference(kind: str, name: str) -> None:
    found = [errors(tame_scene(kind, s, degree=s % 4), posed((CAMERA, WIDE)[s % 2], s), [name], s) for s in range(4)]
    assert np.max(found) < TOLERANCE


@pytest.mark.parametrize("kind", KINDS)
def test_all_outputs_together_match_the_reference(kind: str) -> None:
    found = [
        errors(tame_scene(kind, s, degree=s % 4), posed((CAMERA, WIDE)[s % 2], s), list(OUTPUTS), s)
        for s in range(4, 12)
    ]
    assert np.max(found) < TOLERANCE


@pytest.mark.parametrize("name", OUTPUTS)
@pytest.mark.parametrize("kind", KINDS)
def test_wild_scenes_match_the_reference(kind: str, name: str) -> None:
    """Needles, giants a few cm from the camera, nearly edge-on surfels. One ulp of such a row's values can change its
    gradient by more than 1e-5, and it may dominate its scene: the bound for single scenes has to be wider."""
    found = np.array([errors(scene(kind, s, degree=s % 4), posed(CAMERA, s), [name], s) for s in range(8)])
    assert np.max(np.median(found, 0)) < TOLERANCE
    assert np.max(found) < 1e-4


@pytest.mark.parametrize("kind", KINDS)
def test_several_tiles_match_the_reference(kind: str) -> None:
    camera = Camera("large", 150, 90, 120.0, 118.0, 74.0, 46.0, np.eye(4))
    assert errors(tame_scene(kind, 20), posed(camera, 20), list(OUTPUTS)).max() < TOLERANCE


@pytest.mark.parametrize("stop", [1e-4, 0.05])
@pytest.mark.parametrize("kind", KINDS)
def test_pixels_that_close_match_the_reference(kind: str, stop: float) -> None:
    """They close at different checks, some not at all, and what lies behind gets nothing from them."""
    gaussians, camera = tame_scene(kind, 21, 120), posed(CAMERA, 21)
    gaussians = replace(
        gaussians,
        opacity_logits=gaussians.opacity_logits + np.float32(1 if stop > 0.01 else 2),
        log_scales=gaussians.log_scales + np.float32(0.7),
    )
    raster = replace(BACKGROUND, stop=stop)
    _, traced = drawn_with(gaussians, camera, ["rgb"], raster)
    taken = pairs_in_use(traced, len(gaussians)).sum(-1)
    assert len(np.unique(taken)) > 4
    assert (taken < len(gaussians)).mean() > 0.1
    for name in OUTPUTS:
        assert errors(gaussians, camera, [name], raster=raster).max() < TOLERANCE, name
    assert errors(gaussians, camera, list(OUTPUTS), raster=raster).max() < TOLERANCE


@pytest.mark.parametrize("kind", KINDS)
def test_other_thresholds_match_the_reference(kind: str) -> None:
    raster = RasterSettings((0.2, 0.4, 0.6), 2.0, 1.5, 2.0, 1e-3, 0.6)
    for seed in range(3):
        assert errors(tame_scene(kind, seed), posed(CAMERA, seed), list(OUTPUTS), raster=raster).max() < TOLERANCE


@pytest.mark.parametrize("kind", KINDS)
def test_the_low_pass_matches_the_reference(kind: str) -> None:
    """Gaussians smaller than a pixel."""
    for seed in range(3):
        gaussians = tame_scene(kind, seed, 60)
        tiny = replace(gaussians, log_scales=gaussians.log_scales - np.float32(2.5))
        assert errors(tiny, CAMERA, list(OUTPUTS)).max() < TOLERANCE


@examples(20)
@given(
    seed=st.integers(0, 10**6),
    width=st.integers(1, 45),
    height=st.integers(1, 45),
    offset=st.floats(-0.6, 0.6),
    kind=st.sampled_from(KINDS),
)
def test_any_picture_matches_the_reference(seed: int, width: int, height: int, offset: float, kind: str) -> None:
    camera = replace(CAMERA, width=width, height=height, cx=width * (0.5 + offset), cy=height * (0.5 - offset / 2))
    gaussians, names = tame_scene(kind, seed, 20), ["rgb", "alpha"]
    rendering, traced = drawn_with(gaussians, camera, names)
    parameters = [torch.tensor(getattr(gaussians, p), dtype=torch.float64, requires_grad=True) for p in PARAMETERS]
    reference = draw(*parameters, camera, BACKGROUND, gaussians.antialiased)
    upstream = random_upstream(rendering, names, seed, ~reference.doubtful.numpy())
    loss = sum((getattr(reference, n) * torch.tensor(g, dtype=torch.float64)).sum() for n, g in upstream.items())
    expected = torch.autograd.grad(loss, parameters, materialize_grads=True)
    for a, e in zip(arrays(backward(traced, PictureGradients(**upstream))), expected, strict=True):
        assert np.linalg.norm(a - e.numpy()) <= 1e-4 * np.linalg.norm(e) + 1e-5  # a picture may hold a tail only


@pytest.mark.parametrize("name", OUTPUTS)
@pytest.mark.parametrize("kind", KINDS)
def test_the_pictures_change_as_the_gradients_say(kind: str, name: str) -> None:
    """Finite differences of `render` itself, along random directions in all parameters."""
    raster, step = replace(BACKGROUND, alpha_min=1e-7, stop=1e-9), 1e-3
    gaussians = tame_scene(kind, 3, 15)
    rendering, traced = drawn_with(gaussians, CAMERA, [name], raster)
    solid = rendering.alpha > 0.02  # a Gaussian's last trace moves the mean depth of pixels that have little else
    solid = solid | np.full_like(solid, name not in ("expected_depth", "normals"))
    rng = np.random.default_rng(3)

    def slope(along: dict[str, np.ndarray], h: float) -> np.ndarray:
        low, high = (
            replace(gaussians, **{p: getattr(gaussians, p) + np.float32(s * h) * along[p] for p in PARAMETERS})
            for s in (-1, 1)
        )
        low, high = (getattr(render(g, CAMERA, raster, frozenset({OUTPUTS[name]})), name) for g in (low, high))
        return (high.astype(float) - low) / (2 * h)

    for _ in range(3):
        along = {p: rng.normal(0, 1, getattr(gaussians, p).shape).astype(np.float32) for p in PARAMETERS}
        expected, shorter = slope(along, step), slope(along, step / 2)
        # where the median does not jump to another Gaussian and nothing bends in between
        smooth = np.abs(expected - shorter) <= 0.02 * np.abs(expected) + 1e-6
        assert smooth[expected != 0].mean() > 0.6
        smooth &= solid.reshape(solid.shape + (1,) * (smooth.ndim - 2))
        upstream = (np.sign(expected) * smooth).astype(np.float32)  # signs, so that nothing cancels
        gradients = backward(traced, PictureGradients(**{name: upstream}))
        predicted = sum(np.sum(getattr(gradients, p).astype(float) * along[p]) for p in PARAMETERS)
        assert predicted == pytest.approx(np.sum(expected * upstream), rel=0.02)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_bit_equal_for_any_thread_count(kind: str, any_thread_count: None) -> None:
    gaussians = scene(kind, 40, 17_000)  # enough for the tile lists to be made in several chunks
    results = []
    for count in (1, 2, 3, 7, 7):
        threads.set_thread_count(count)
        results.append(all_gradients(gaussians, WIDE))
    for result in results[1:]:
        assert_identical(results[0], result)
    assert all(a.any() for a in arrays(results[0]))


def test_concurrent_traces_are_bit_equal_to_single_ones() -> None:
    scenes = [scene(kind, seed, 2000) for seed, kind in enumerate(["3d", "surfels"])]
    alone = [all_gradients(s, WIDE, k) for k, s in enumerate(scenes)]
    with ThreadPoolExecutor(2) as callers:
        together = list(callers.map(lambda k: all_gradients(scenes[k % 2], WIDE, k % 2), range(10)))
    for k, result in enumerate(together):
        assert_identical(alone[k % 2], result)


def test_a_trace_may_be_gone_back_twice() -> None:
    rendering, traced = drawn_with(scene("3d", 41), CAMERA, ["rgb"])
    loss = PictureGradients(rgb=rendering.rgb)
    assert_identical(backward(traced, loss), backward(traced, loss))


def test_tracing_gives_the_rendering() -> None:
    for kind in KINDS:
        gaussians = scene(kind, 42)
        rendering, _ = drawn_with(gaussians, CAMERA, list(OUTPUTS))
        again = render(gaussians, CAMERA, BACKGROUND, frozenset(OUTPUTS.values()))
        for f in fields(Rendering):
            np.testing.assert_array_equal(getattr(rendering, f.name), getattr(again, f.name))


def test_gradients_of_several_pictures_add_up() -> None:
    for kind in KINDS:
        gaussians = tame_scene(kind, 43)
        rendering, traced = drawn_with(gaussians, CAMERA, list(OUTPUTS))
        given = random_upstream(rendering, list(OUTPUTS), 0, np.ones(rendering.alpha.shape, bool))
        parts = [arrays(backward(traced, PictureGradients(**{n: g}))) for n, g in given.items()]
        together = arrays(backward(traced, PictureGradients(**given)))
        for k in range(5):
            assert relative(sum(p[k].astype(float) for p in parts), together[k]) < 1e-5


def test_no_gradient_gives_none() -> None:
    gaussians = scene("3d", 44)
    _, traced = drawn_with(gaussians, CAMERA, list(OUTPUTS))
    for gradient, parameter in zip(arrays(backward(traced, PictureGradients())), PARAMETERS):
        assert gradient.shape == getattr(gaussians, parameter).shape
        assert gradient.dtype == np.float32
        assert not gradient.any()


@pytest.mark.parametrize("kind", KINDS)
def test_no_gaussians_and_hidden_ones_get_no_gradient(kind: str) -> None:
    gaussians = scene(kind, 45)
    none = all_gradients(gaussians.take(np.zeros(len(gaussians), bool)), CAMERA)
    assert [len(a) for a in arrays(none)] == [0] * 5
    behind = replace(gaussians, means=gaussians.means - np.float32([0, 0, 10]))
    assert not any(a.any() for a in arrays(all_gradients(behind, CAMERA)))
    outside = replace(gaussians, means=gaussians.means * np.float32(0.01) + np.float32([500, 0, 3]))
    assert not any(a.any() for a in arrays(all_gradients(outside, CAMERA)))


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_fully_occluded_or_transparent_gets_no_gradient(kind: str) -> None:
    """Rows behind four opaque walls lie behind the stop; rows of opacity 0 are not drawn."""
    gaussians = tame_scene(kind, 46)
    walls = one((0, 0, 1.0), scale=5.0, logit=20.0).take(np.zeros(16, int))
    walls = replace(walls, sh=np.zeros((16, 4, 3), np.float32), antialiased=gaussians.antialiased)
    walls = replace(walls, log_scales=walls.log_scales[:, : gaussians.log_scales.shape[1]])
    found = all_gradients(walls.extended(gaussians), CAMERA)
    assert not any(a[16:].any() for a in arrays(found))
    clear = replace(gaussians, opacity_logits=np.full(len(gaussians), -np.inf, np.float32))
    assert not any(a.any() for a in arrays(all_gradients(clear, CAMERA)))


@examples(60)
@given(st.data())
def test_odd_rows_get_finite_gradients_and_harm_nothing(data: st.DataObject) -> None:
    """Any value in any column; rows that are not drawn get zeros, the others what they get without them."""
    kind = data.draw(st.sampled_from(KINDS))
    gaussians = tame_scene(kind, data.draw(st.integers(0, 99)), 12)
    for _ in range(data.draw(st.integers(1, 5))):
        field = data.draw(st.sampled_from(PARAMETERS[:4]))
        column = getattr(gaussians, field).reshape(len(gaussians), -1)
        row, entry = data.draw(st.integers(0, 11)), data.draw(st.integers(0, column.shape[1] - 1))
        column[row, entry] = data.draw(st.sampled_from(ODD_VALUES))
    with np.errstate(all="ignore"):
        usable = gaussians.usable
    gradients = all_gradients(gaussians, CAMERA)
    assert all(np.isfinite(a).all() for a in arrays(gradients))
    assert not any(a[~usable].any() for a in arrays(gradients))
    without = all_gradients(gaussians.take(usable), CAMERA)
    for a, b in zip(arrays(gradients), arrays(without), strict=True):
        np.testing.assert_array_equal(a[usable], b)


def test_rows_with_broken_colours_get_no_gradient() -> None:
    gaussians = tame_scene("3d", 47)
    broken = np.arange(len(gaussians)) % 3 == 0
    gaussians.sh[broken, 1, 2] = np.nan
    found = arrays(all_gradients(gaussians, CAMERA))
    assert all(np.isfinite(a).all() and not a[broken].any() and a[~broken].any() for a in found)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("logit", [np.inf, 200.0, 20.0, 2.0])
@pytest.mark.parametrize(
    "scales", [(5, 5, 5), (40, 40, 40), (79, 79, 79), (3, -9, -9), (-np.inf,) * 3, (-1, -np.inf, 0)]
)
def test_giants_needles_and_points_get_finite_gradients(kind: str, logit: float, scales: tuple[float, ...]) -> None:
    gaussians = tame_scene(kind, 48, 12)
    extreme = gaussians.take(np.arange(3))
    extreme.log_scales[:] = scales[: extreme.log_scales.shape[1]]
    extreme.opacity_logits[:] = logit
    for raster in (BACKGROUND, replace(BACKGROUND, alpha_min=1e-12)):
        found = all_gradients(gaussians.extended(extreme), CAMERA, raster=raster)
        assert all(np.isfinite(a).all() for a in arrays(found))
        assert found.sh.any()


@pytest.mark.parametrize("log_scale", [4.0, 10.0, 15.0, 40.0, 60.0])
@pytest.mark.parametrize("antialiased", [False, True])
def test_a_needle_that_crosses_the_view_is_not_moved_by_its_ends(antialiased: bool, log_scale: float) -> None:
    """Once it is longer than the view its length hardly matters, and the other gradients stay what they are."""
    needles = [
        replace(one(scale=(np.exp(s), 0.02, 0.02), quat=(0.9, 0.1, 0.2, 0.4)), antialiased=antialiased)
        for s in (4.0, log_scale)
    ]
    base, found = (all_gradients(needle, CAMERA) for needle in needles)
    assert abs(found.log_scales[0, 0]) < 0.01 * np.abs(found.log_scales[0, 1:]).max()
    np.testing.assert_allclose(found.log_scales[0, 1:], base.log_scales[0, 1:], rtol=0.01)
    for p in ("means", "quats", "opacity_logits", "sh"):
        assert relative(getattr(found, p), getattr(base, p)) < 0.05, p


def test_a_picture_of_one_pixel() -> None:
    """alpha = o at the centre: its gradient with respect to the logit is o (1 − o)."""
    camera = Camera("dot", 1, 1, 1.0, 1.0, 0.5, 0.5, np.eye(4))
    _, traced = drawn_with(one(scale=0.5), camera, ["alpha"])
    gradients = backward(traced, PictureGradients(alpha=np.ones((1, 1), np.float32)))
    assert gradients.opacity_logits[0] == pytest.approx(0.09, rel=1e-5)
    np.testing.assert_allclose(gradients.means, 0, atol=1e-7)
    for kind in KINDS:
        assert errors(tame_scene(kind, 49), camera, list(OUTPUTS)).max() < 1e-4


@pytest.mark.parametrize("kind", KINDS)
def test_the_quaternion_gradient_is_normal_to_it_and_shrinks_with_its_length(kind: str) -> None:
    gaussians = tame_scene(kind, 50)
    unit = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    gaussians = replace(gaussians, quats=unit)
    gradient = all_gradients(gaussians, CAMERA).quats
    along = np.abs((gradient * unit).sum(1))
    assert (along <= 1e-6 * np.linalg.norm(gradient, axis=1) + 1e-12).all()
    doubled = all_gradients(replace(gaussians, quats=2 * unit), CAMERA).quats
    np.testing.assert_allclose(doubled, 0.5 * gradient, rtol=1e-5, atol=1e-9)
    negated = all_gradients(replace(gaussians, quats=-unit), CAMERA).quats
    np.testing.assert_array_equal(negated, -gradient)


@pytest.mark.parametrize("kind", KINDS)
def test_a_rigid_motion_of_scene_and_camera_turns_the_gradients(kind: str) -> None:
    """The pictures stay; a mean's gradient is a vector and turns along, logits, scales and colours keep theirs."""
    gaussians = tame_scene(kind, 51, degree=0)
    turn = quats_to_matrices(np.array([[0.4, -0.7, 0.3, 0.5]]))[0]
    shift = np.array([0.5, -0.25, 1.0])
    moved = replace(
        gaussians,
        means=(gaussians.means @ turn.T + shift).astype(np.float32),
        quats=matrices_to_quats(turn @ quats_to_matrices(gaussians.quats.astype(float))).astype(np.float32),
    )
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = turn.T, -turn.T @ shift
    before = all_gradients(gaussians, CAMERA, raster=replace(BACKGROUND, alpha_min=1e-6))
    after = all_gradients(moved, replace(CAMERA, viewmat=viewmat), raster=replace(BACKGROUND, alpha_min=1e-6))
    assert relative(after.means, before.means @ turn.T) < 1e-3
    for p in ("log_scales", "opacity_logits", "sh"):
        assert relative(getattr(after, p), getattr(before, p)) < 1e-3


def test_a_colour_that_is_clamped_to_black_gets_no_gradient() -> None:
    _, traced = drawn_with(one(colour=(0.7, -0.5, 0.5)), CAMERA, ["rgb"])
    gradient = backward(traced, PictureGradients(rgb=np.ones((29, 41, 3), np.float32))).sh[0, 0]
    assert gradient[1] == 0 and gradient[0] > 0 and gradient[0] == gradient[2]


@pytest.mark.parametrize("name", OUTPUTS)
def test_wrong_shapes_are_named(name: str) -> None:
    _, traced = drawn_with(one(), CAMERA, list(OUTPUTS))
    wrong = np.ones((41, 29, 3) if name in ("rgb", "normals") else (41, 29), np.float32)
    with pytest.raises(ValueError, match=rf"{name}: expected shape \(29, 41.*got \(41, 29"):
        backward(traced, PictureGradients(**{name: wrong}))


@pytest.mark.parametrize("name", sorted(set(OUTPUTS) - {"alpha"}))
def test_gradients_of_pictures_that_were_not_rendered_are_named(name: str) -> None:
    rendering, traced = drawn_with(one(), CAMERA, ["alpha"])
    given = np.ones((29, 41, 3) if name in ("rgb", "normals") else (29, 41), np.float32)
    with pytest.raises(ValueError, match=f"gradients of {name}: the rendering has no such pass"):
        backward(traced, PictureGradients(**{name: given}))
    backward(traced, PictureGradients(alpha=rendering.alpha))  # alpha is always there


def test_means_are_not_moved_by_colour_beyond_the_direction() -> None:
    """A covered background: red light of degree 0 has no gradient in the mean of a giant that fills the view."""
    giant = replace(one((0, 0, 5.0), colour=(0.5, 0.5, 0.5)), log_scales=np.full((1, 3), 20, np.float32))
    _, traced = drawn_with(giant, CAMERA, ["rgb"])
    gradients = backward(traced, PictureGradients(rgb=np.ones((29, 41, 3), np.float32)))
    np.testing.assert_allclose(gradients.means, 0, atol=1e-4)
    assert gradients.opacity_logits[0] == pytest.approx(29 * 41 * 0.09 * (0.4 + 0.3 + 0.2), rel=1e-3)

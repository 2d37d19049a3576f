"""Regions: wanted pixels over a frozen scene must show, and go back, what drawing everything does."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from test_raster_render import CAMERA, posed, random_scene

from gimp3d.camera import Camera
from gimp3d.gaussians import Gaussians
from gimp3d.raster import (
    Gradients,
    PictureGradients,
    PixelRegion,
    RasterSettings,
    Rendering,
    backward,
    pixel_region,
    render,
    trace,
)

VIEW = Camera("view", 75, 50, 60.0, 63.0, 36.5, 26.0, np.eye(4))
PICTURES = {  # passes that layers can do
    "rgb": "rgb",
    "alpha": "alpha",
    "expected_depth": "expected_depth",
    "normals": "normal",
}
LAYERED = frozenset(PICTURES.values())
EXACT = RasterSettings(background=(0.1, 0.2, 0.3), stop=1e-12)
DEFAULT = RasterSettings(background=(0.1, 0.2, 0.3))
PARAMETERS = ["means", "log_scales", "quats", "opacity_logits", "sh"]


def frozen_scene(seed: int, surfels: bool = False, count: int = 200) -> Gaussians:
    gaussians = random_scene(seed, count, 1, surfels)
    return gaussians.take(gaussians.means[:, 2] > 0.4)


def active_scene(seed: int, surfels: bool = False, count: int = 20, near: float = 2.5, far: float = 3.0) -> Gaussians:
    """Solid ones in a slab of depths."""
    gaussians, rng = random_scene(1000 + seed, count, 1, surfels), np.random.default_rng(seed)
    z = rng.uniform(near, far, count)
    means = np.stack([rng.normal(0, 0.3, count) * z, rng.normal(0, 0.25, count) * z, z], 1).astype(np.float32)
    log_scales = rng.uniform(-2.5, -1.2, gaussians.log_scales.shape).astype(np.float32)
    return replace(gaussians, means=means, log_scales=log_scales)


def some_pixels(camera: Camera, seed: int = 0) -> np.ndarray:
    """A disc across tiles and a few single pixels."""
    u, v = np.moveaxis(camera.pixel_centres(), -1, 0)
    disc = (u - 0.45 * camera.width) ** 2 + (v - 0.6 * camera.height) ** 2 < (0.3 * camera.height) ** 2
    return disc | (np.random.default_rng(seed).random(disc.shape) < 0.005)


def wanted_blocks(pixels: np.ndarray) -> np.ndarray:
    """[H, W] bool: pixels of 4×4 blocks with a wanted one."""
    height, width = pixels.shape
    padded = np.zeros((-(-height // 4) * 4, -(-width // 4) * 4), bool)
    padded[:height, :width] = pixels
    blocks = padded.reshape(padded.shape[0] // 4, 4, padded.shape[1] // 4, 4).any((1, 3))
    return np.repeat(np.repeat(blocks, 4, 0), 4, 1)[:height, :width]


def assert_shows(
    drawn: Rendering, whole: Rendering, pixels: np.ndarray, atol: float, names: Iterable[str] = PICTURES
) -> None:
    """The region's pictures are the whole view's in the wanted blocks, and 0 elsewhere."""
    inside = wanted_blocks(pixels)
    for name in names:
        actual, expected = getattr(drawn, name), getattr(whole, name)
        assert actual.shape == expected.shape
        assert not actual[~inside].any(), name
        if name in ("expected_depth", "normals"):  # means over the weight, whose rounding a small one amplifies
            where = inside & (whole.alpha > 0.02)
            # opposite normals may all but cancel, and then the sum has no direction
            differs = np.abs(actual - expected)[where] > 100 * atol * (1 + np.abs(expected[where]))
            assert differs.mean() < 0.005 if differs.size else True, name
        else:
            np.testing.assert_allclose(actual[inside], expected[inside], rtol=1e-5, atol=atol, err_msg=name)


def upstream(camera: Camera, names: list[str], pixels: np.ndarray, seed: int = 0) -> PictureGradients:
    """Random gradients in the wanted pixels."""
    rng, shapes = np.random.default_rng(seed), {"rgb": (3,), "normals": (3,)}
    given = {n: rng.normal(0, 1, (camera.height, camera.width, *shapes.get(n, ()))).astype(np.float32) for n in names}
    return PictureGradients(**{n: g * pixels.reshape(pixels.shape + (1,) * (g.ndim - 2)) for n, g in given.items()})


def both_gradients(
    region: PixelRegion, frozen: Gaussians, active: Gaussians, given: PictureGradients
) -> tuple[Gradients, Gradients]:
    """Those of the region and, of the active rows, those of the whole view."""
    got = region.trace(active)[1].backward(given)
    full = backward(trace(frozen.extended(active), region.camera, region.settings, region.passes)[1], given)
    return got, Gradients(**{p: getattr(full, p)[len(frozen) :] for p in PARAMETERS})


def assert_close_gradients(got: Gradients, expected: Gradients, tolerance: float) -> None:
    for p in PARAMETERS:
        a, b = getattr(got, p), getattr(expected, p)
        assert a.shape == b.shape
        assert np.linalg.norm(a - b) <= tolerance * np.linalg.norm(b), p


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("surfels", [False, True])
def test_a_region_without_a_stop_is_the_whole_view(surfels: bool, seed: int) -> None:
    frozen, active = frozen_scene(seed, surfels), active_scene(seed, surfels)
    camera = posed((CAMERA, VIEW)[seed % 2], seed)
    pixels = some_pixels(camera, seed)
    region = pixel_region(frozen, camera, pixels, EXACT, LAYERED)
    whole = render(frozen.extended(active), camera, EXACT, LAYERED)
    assert_shows(region.render(active), whole, pixels, 2e-6)
    assert_layers_save_work(region)
    for name in PICTURES:
        loss = upstream(camera, [name], pixels & (whole.alpha > 0.02), seed)
        assert_close_gradients(*both_gradients(region, frozen, active, loss), 5e-5)
    loss = upstream(camera, list(PICTURES), pixels & (whole.alpha > 0.02), seed)
    assert_close_gradients(*both_gradients(region, frozen, active, loss), 5e-5)


def lengths(region: PixelRegion) -> np.ndarray:
    """How many frozen entries the tiles have."""
    return region._lists.stops - region._lists.starts


def assert_layers_save_work(region: PixelRegion) -> None:
    """Or else these tests would not look at layers."""
    assert (region._slab_stops - region._slab_starts).sum() < 0.6 * lengths(region).sum()
    assert region._front.any() and region._back.any()


@pytest.mark.parametrize("surfels", [False, True])
def test_layers_differ_from_the_whole_view_by_the_stop_only(surfels: bool) -> None:
    for seed in range(4):
        frozen, active = frozen_scene(seed, surfels, 600), active_scene(seed, surfels)
        pixels, whole_view = some_pixels(VIEW, seed), frozen.extended(active)
        region = pixel_region(frozen, VIEW, pixels, DEFAULT, LAYERED)
        whole = render(whole_view, VIEW, DEFAULT, LAYERED)
        assert (render(whole_view, VIEW, EXACT).alpha != whole.alpha)[pixels].any()  # the stop makes a difference
        assert_shows(region.render(active), whole, pixels, 5 * DEFAULT.stop, ["rgb", "alpha"])
        assert_layers_save_work(region)
        for name in ("rgb", "alpha"):
            loss = upstream(VIEW, [name], pixels, seed)
            got, expected = both_gradients(region, frozen, active, loss)
            alone = backward(trace(active, VIEW, DEFAULT)[1], loss)  # what the stop is a part of
            for p in PARAMETERS:
                difference = np.linalg.norm(getattr(got, p) - getattr(expected, p))
                assert difference <= 5 * DEFAULT.stop * np.linalg.norm(getattr(alone, p)), p


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("surfels", [False, True])
def test_without_layers_pictures_and_gradients_are_bit_equal(surfels: bool, seed: int) -> None:
    """With the median depth there are none; and where the active ones are everywhere they would save nothing.

    Only the expected depth may differ in its last bits: a tile sums depths less a typical one, and the region takes
    that from its frozen Gaussians.
    """
    frozen, camera = frozen_scene(seed, surfels, 400), posed(VIEW, seed)
    pixels = some_pixels(camera, seed)
    everywhere = active_scene(seed, surfels, 300, 0.4, 8.0)
    everywhere = replace(everywhere, means=everywhere.means * np.float32([2, 2, 1]))
    names = ["rgb", "alpha", "expected_depth", "normals"]
    passes = frozenset({"rgb", "alpha", "expected_depth", "normal"})
    cases = [(passes | {"depth"}, [*names, "median_depth"], active_scene(seed, surfels)), (passes, names, everywhere)]
    for wanted, pictures, active in cases:
        region = pixel_region(frozen, camera, pixels, DEFAULT, wanted)
        drawn, whole = region.render(active), render(frozen.extended(active), camera, DEFAULT, wanted)
        if "depth" not in wanted:
            np.testing.assert_array_equal(region._slab_stops - region._slab_starts, lengths(region))
        for name in pictures:
            inside = wanted_blocks(pixels)
            rounding = 1e-5 if name == "expected_depth" else 0
            np.testing.assert_allclose(getattr(drawn, name)[inside], getattr(whole, name)[inside], rounding)
            assert not getattr(drawn, name)[~inside].any()
        got, expected = both_gradients(region, frozen, active, upstream(camera, pictures, pixels, seed))
        assert_close_gradients(got, expected, 1e-5)
        pictures = [name for name in pictures if name != "expected_depth"]
        got, expected = both_gradients(region, frozen, active, upstream(camera, pictures, pixels, seed))
        for p in PARAMETERS:
            np.testing.assert_array_equal(getattr(got, p), getattr(expected, p))


@pytest.mark.parametrize("surfels", [False, True])
def test_active_gaussians_that_leave_their_slab_renew_the_layers(surfels: bool) -> None:
    frozen, active = frozen_scene(5, surfels), active_scene(5, surfels)
    pixels = some_pixels(VIEW)
    region = pixel_region(frozen, VIEW, pixels, EXACT, LAYERED)
    for move in ((0, 0, 0), (0.01, 0, 0.01), (0, 0, 2), (0, 0, -1.8), (0.5, 0.3, 0.2), (50, 0, 0), (0, 0, 0)):
        moved = replace(active, means=active.means + np.float32(move))
        whole = render(frozen.extended(moved), VIEW, EXACT, LAYERED)
        assert_shows(region.render(moved), whole, pixels, 2e-6)
        loss = upstream(VIEW, ["rgb", "alpha"], pixels)
        assert_close_gradients(*both_gradients(region, frozen, moved, loss), 5e-5)


def test_small_moves_do_not_renew_the_layers() -> None:
    frozen, active = frozen_scene(6), active_scene(6)
    region = pixel_region(frozen, VIEW, some_pixels(VIEW), EXACT, LAYERED)
    region.render(active)
    before = region._near.copy()
    region.render(replace(active, means=active.means + np.float32([0, 0, 0.01])))
    np.testing.assert_array_equal(region._near, before)
    region.render(replace(active, means=active.means + np.float32([0, 0, 0.5])))
    assert (region._near != before).any()


@examples(25)
@given(
    seed=st.integers(0, 10**4),
    surfels=st.booleans(),
    steps=st.lists(st.tuples(st.integers(0, 12), st.floats(-2.3, 3)), min_size=1, max_size=4),
)
def test_any_number_of_active_gaussians_anywhere(seed: int, surfels: bool, steps: list[tuple[int, float]]) -> None:
    """Numbers and depths that change from one rendering to the next."""
    frozen, pixels = frozen_scene(seed, surfels, 60), some_pixels(CAMERA, seed)
    region = pixel_region(frozen, CAMERA, pixels, EXACT, LAYERED)
    for count, shift in steps:
        active = active_scene(seed, surfels, count)
        active = replace(active, means=active.means + np.float32([0, 0, shift]))
        whole = render(frozen.extended(active), CAMERA, EXACT, LAYERED)
        assert_shows(region.render(active), whole, pixels, 3e-6, ["rgb", "alpha"])


@pytest.mark.parametrize("surfels", [False, True])
def test_nothing_active_nothing_frozen_and_neither(surfels: bool) -> None:
    frozen, active, pixels = frozen_scene(7, surfels), active_scene(7, surfels), some_pixels(VIEW)
    no_frozen, no_active = frozen.take(np.zeros(len(frozen), bool)), active.take(np.zeros(len(active), bool))
    for few, others in ((no_frozen, active), (frozen, no_active), (no_frozen, no_active)):
        region = pixel_region(few, VIEW, pixels, EXACT, LAYERED)
        whole = render(few.extended(others), VIEW, EXACT, LAYERED)
        assert_shows(region.render(others), whole, pixels, 2e-6)
        got, expected = both_gradients(region, few, others, upstream(VIEW, ["rgb", "alpha"], pixels))
        assert_close_gradients(got, expected, 5e-5)


@pytest.mark.parametrize("passes", [LAYERED, LAYERED | {"depth"}])
def test_masks_of_no_pixel_and_of_one(passes: frozenset[str]) -> None:
    frozen, active = frozen_scene(8), active_scene(8)
    nowhere, dot = np.zeros((50, 75), bool), np.zeros((50, 75), bool)
    dot[49, 74] = True  # the corner: its block is cut off by the picture's edge
    region = pixel_region(frozen, VIEW, nowhere, EXACT, passes)
    drawn, traced = region.trace(active)
    assert not any(getattr(drawn, n).any() for n in PICTURES)
    gradients = traced.backward(upstream(VIEW, ["rgb"], ~nowhere))
    assert not any(getattr(gradients, p).any() for p in PARAMETERS)
    whole = render(frozen.extended(active), VIEW, EXACT, passes)
    assert_shows(pixel_region(frozen, VIEW, dot, EXACT, passes).render(active), whole, dot, 2e-6)
    assert wanted_blocks(dot).sum() == 2 * 3


def test_the_whole_picture_is_a_region_too() -> None:
    frozen, active = frozen_scene(9), active_scene(9)
    pixels = np.ones((50, 75), bool)
    region = pixel_region(frozen, VIEW, pixels, EXACT, LAYERED)
    assert_shows(region.render(active), render(frozen.extended(active), VIEW, EXACT, LAYERED), pixels, 2e-6)


def test_gradients_outside_the_wanted_blocks_do_not_count() -> None:
    frozen, active, pixels = frozen_scene(10), active_scene(10), some_pixels(VIEW)
    region = pixel_region(frozen, VIEW, pixels, EXACT)
    traced = region.trace(active)[1]
    everywhere = upstream(VIEW, ["rgb"], np.ones_like(pixels))
    inside = replace(everywhere, rgb=everywhere.rgb * wanted_blocks(pixels)[..., None])
    for p in PARAMETERS:
        np.testing.assert_array_equal(getattr(traced.backward(everywhere), p), getattr(traced.backward(inside), p))


def test_tracing_gives_the_rendering() -> None:
    region = pixel_region(frozen_scene(11), VIEW, some_pixels(VIEW), DEFAULT, LAYERED)
    active = active_scene(11)
    drawn, traced = region.render(active), region.trace(active)[0]
    for name in PICTURES:
        np.testing.assert_array_equal(getattr(drawn, name), getattr(traced, name))


def test_broken_rows_of_both_scenes_are_counted() -> None:
    frozen, active = frozen_scene(12), active_scene(12)
    frozen.means[3] = np.nan
    active.quats[[2, 5]] = 0
    region = pixel_region(frozen, VIEW, some_pixels(VIEW), DEFAULT, LAYERED)
    drawn, traced = region.trace(active)
    assert drawn.ignored == 3
    assert np.isfinite(drawn.rgb).all()
    gradients = traced.backward(upstream(VIEW, ["rgb"], some_pixels(VIEW)))
    assert np.isfinite(gradients.means).all() and not gradients.means[[2, 5]].any()


def test_a_stale_trace_is_refused() -> None:
    region = pixel_region(frozen_scene(13), VIEW, some_pixels(VIEW))
    active = active_scene(13)
    _, stale = region.trace(active)
    _, fresh = region.trace(active)
    loss = upstream(VIEW, ["rgb"], some_pixels(VIEW))
    with pytest.raises(RuntimeError, match="rendered again"):
        stale.backward(loss)
    fresh.backward(loss)
    region.render(active)
    with pytest.raises(RuntimeError, match="rendered again"):
        fresh.backward(loss)


def test_wrong_input_is_named() -> None:
    with pytest.raises(ValueError, match=r"pixels: expected shape \(50, 75\), got \(75, 50\)"):
        pixel_region(frozen_scene(14), VIEW, np.ones((75, 50), bool))
    with pytest.raises(ValueError, match="unknown passes"):
        pixel_region(frozen_scene(14), VIEW, np.ones((50, 75), bool), passes=frozenset({"colour"}))
    for surfels in (False, True):
        region = pixel_region(frozen_scene(14, surfels), VIEW, np.ones((50, 75), bool))
        with pytest.raises(ValueError, match="3D Gaussians and surfels"):
            region.render(active_scene(14, not surfels))

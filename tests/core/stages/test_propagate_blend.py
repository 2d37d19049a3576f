"""The fill in the colours and the light of a view."""

from __future__ import annotations

from unittest import mock

import cv2
import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from gimp3d.geometry import dilated
from gimp3d.stages.propagate import blend
from gimp3d.stages.propagate.blend import blend_band, blend_rim, colours_here


def seam(rows: int = 30, cols: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A far wall on the left, a near thing on the right: base, depth, and a hole over both."""
    base = np.full((rows, cols, 3), 100, np.uint8)
    base[:, cols // 2 :] = 250
    depth = np.full((rows, cols), 4.0, np.float32)
    depth[:, cols // 2 :] = 2.0
    painted = np.zeros((rows, cols), bool)
    painted[8:22, 8:32] = True
    return base, depth, painted


def test_the_papers_blend_takes_no_boundary_across_a_depth_seam() -> None:
    base, depth, painted = seam()
    painted[:, 20:] = False
    raw = np.full((*painted.shape, 3), 60.0, np.float32)
    blended = blend_rim(base, raw, painted, np.zeros_like(painted), depth)
    assert (blended[painted] == 100).all() and (blended[~painted] == base[~painted]).all()


def test_the_blend_corrects_each_side_of_a_depth_seam_by_its_own_photo() -> None:
    base, depth, painted = seam()
    raw = np.where(depth[..., None] > 3, 60.0, 240.0) * np.ones(3, np.float32)
    blended = blend_band(base, raw, painted, ~painted, 6.0, depth)
    assert (blended[painted] == base[painted]).all() and (blended[~painted] == base[~painted]).all()
    flat = blend_band(base, raw, painted, ~painted, 6.0, np.ones_like(depth))
    assert np.abs(flat[painted].astype(int) - base[painted]).max() > 5


def test_what_the_fill_does_not_touch_has_no_say() -> None:
    """Specks of photo between seams: a maze of them would make the solution slow, and worse where it counts."""
    rng = np.random.default_rng(0)
    base, raw = rng.integers(0, 256, (60, 80, 3)).astype(np.uint8), rng.uniform(0, 255, (60, 80, 3)).astype(np.float32)
    painted, band = np.zeros((2, 60, 80), bool)
    painted[20:40, 20:40] = True
    band[15:45, 15:45] = ~painted[15:45, 15:45]
    alone = blend_band(base, raw, painted, band, 6.0, np.where(painted | band, 1.0, 0.0))
    specks = np.zeros_like(band)
    specks[:, 50::2] = rng.random((60, 15)) < 0.7
    depth = np.where(painted | band | specks, 1.0, 0.0)
    assert (blend_band(base, raw, painted, band | specks, 6.0, depth) == alone).all()


def test_a_part_without_photo_keeps_its_colours() -> None:
    base, depth, painted = seam()
    raw = np.full((*painted.shape, 3), 60.0, np.float32)
    assert (blend_band(base, raw, painted, np.zeros_like(painted), 6.0, depth)[painted] == 60).all()


def solved_directly(domain: np.ndarray, weight: np.ndarray, anchor: np.ndarray) -> np.ndarray:
    """Screened Poisson without guidance by a sparse factor in double precision, [N, 3]."""
    index = np.full(domain.shape, -1)
    index[domain] = np.arange(domain.sum())
    links = []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        both = domain[a] & domain[b]
        links.append(np.stack([index[a][both], index[b][both]]))
    i, j = np.concatenate(links, 1)
    graph = scipy.sparse.coo_matrix((np.ones(len(i)), (i, j)), (int(domain.sum()),) * 2)
    graph = graph + graph.T
    matrix = scipy.sparse.diags(np.asarray(graph.sum(1)).ravel() + weight[domain]) - graph
    return scipy.sparse.linalg.spsolve(matrix.tocsc(), (weight[..., None] * anchor)[domain]).reshape(-1, 3)


@examples(15)
@given(seed=st.integers(0, 10_000), width=st.floats(1.0, 20.0))
def test_the_blend_is_exact_to_a_grey_level(seed: int, width: float) -> None:
    rng = np.random.default_rng(seed)
    h, w = rng.integers(12, 50, 2)
    base = rng.integers(0, 256, (h, w, 3)).astype(np.uint8)
    raw = (base + rng.normal(0, 30, 3) + rng.normal(0, 10, base.shape)).astype(np.float32)
    painted = np.zeros((h, w), bool)
    painted[h // 4 : 3 * h // 4, w // 4 : 3 * w // 4] = rng.random((3 * h // 4 - h // 4, 3 * w // 4 - w // 4)) < 0.95
    band = ~painted & (rng.random((h, w)) < 0.8)
    with mock.patch.object(blend, "solve_poisson", wraps=blend.solve_poisson) as solver:
        blended = blend_band(base, raw, painted, band, width, np.ones((h, w)))
    (domain, *_), system = solver.call_args
    assert (domain == (blend.cv2.distanceTransform((~painted).astype(np.uint8), 2, 5) <= blend.FAR * width)).all()
    correction = np.zeros(base.shape)
    correction[domain] = solved_directly(domain, system["weight"], system["anchor"])
    expected = np.clip(np.rint(raw + correction), 0, 255)
    assert np.abs(blended[painted].astype(int) - expected[painted]).max() <= 1
    assert (blended[~painted] == base[~painted]).all()


def test_what_few_pixels_of_photo_say_fades_with_the_distance() -> None:
    base = np.full((40, 120, 3), 100, np.uint8)
    raw = np.full(base.shape, 60.0, np.float32)
    painted = np.ones((40, 120), bool)
    painted[:, :2] = False
    band = np.zeros_like(painted)
    band[19:21, 1] = True  # a hundredth of the hole's outline
    blended = blend_band(base, raw, painted, band, 4.0, np.ones((40, 120)))
    assert blended[20, 2, 0] > 70 and blended[20, 115, 0] < 66


def test_photo_that_shows_something_else_does_not_colour_the_fill() -> None:
    base = np.full((60, 60, 3), 120, np.uint8)
    raw = np.full(base.shape, 100.0, np.float32) + np.random.default_rng(0).normal(0, 2, base.shape).astype(np.float32)
    painted = np.zeros((60, 60), bool)
    painted[20:40, 20:40] = True
    other = np.zeros_like(painted)
    other[18:42, 42:50] = True  # a blue thing that stands elsewhere in the reference's picture
    raw[other] = [20, 30, 180]
    blended = blend_band(base, raw, painted, ~painted, 3.0, np.ones((60, 60)))
    assert np.abs(blended[painted].mean(0) - 120).max() < 2


def test_each_side_of_the_hole_has_its_own_light() -> None:
    base = np.full((60, 100, 3), 120, np.uint8)
    noise = np.random.default_rng(0).normal(0, 3, base.shape).astype(np.float32)
    raw = np.full(base.shape, 115.0, np.float32) + noise
    raw[:, 65:] = 85 + noise[:, 65:]  # the reference saw no gloss there, on a fifth of what lies round the hole
    painted = np.zeros((60, 100), bool)
    painted[20:40, 20:75] = True
    band = ~painted
    band[:, 85:] = False
    blended = blend_band(base, raw, painted, band, 4.0, np.ones((60, 100)))
    assert np.abs(blended[25:35, 72:].mean((0, 1)) - 120).max() < 10
    assert np.abs(blended[25:35, 25].mean(0) - 120).max() < 4


def test_where_hardly_any_photo_touches_the_hole_what_lies_farther_away_tells_its_level() -> None:
    base = np.full((80, 80, 3), 150, np.uint8)
    raw = np.full(base.shape, 130.0, np.float32)
    painted = np.zeros((80, 80), bool)
    painted[30:50, 30:50] = True
    band = np.zeros_like(painted)
    band[:15], band[51, 30:34] = True, True
    base[51, 30:34] = 180  # a few pixels beside it show the object's edge
    blended = blend_band(base, raw, painted, band, 4.0, np.ones((80, 80)))
    assert np.abs(blended[painted].mean(0) - 150).max() < 3


def cloth_on_wood(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Grained brown wood and grey cloth, parted by a border that runs through a hole: the fill, where wood is, T."""
    wood = np.zeros((80, 120), bool)
    wood[:, 70:] = True
    raw = np.where(wood[..., None], [150.0, 100.0, 60.0], [110.0, 115.0, 120.0]).astype(np.float32)
    raw += rng.normal(0, 6, (80, 120, 1)).astype(np.float32)
    painted = np.zeros_like(wood)
    painted[25:55, 30:90] = True
    return raw, wood, painted


def test_wood_shines_where_cloth_does_not() -> None:
    rng = np.random.default_rng(0)
    raw, wood, painted = cloth_on_wood(rng)
    truth = raw + wood[..., None] * np.float32([25, 28, 34])
    photo = np.clip(np.rint(truth + rng.normal(0, 2, raw.shape)), 0, 255).astype(np.uint8)
    one = np.ones(wood.shape)

    def off(fill: np.ndarray) -> np.ndarray:
        blended = blend_band(photo, fill, painted, ~painted, 5.0, one)
        return np.abs(cv2.blur(blended - truth, (5, 5)))[painted & ~(dilated(wood, 6) & dilated(~wood, 6))]

    here = colours_here(raw, photo, painted, ~painted, 5.0)
    assert np.percentile(off(here), 95) < 4 < 8 < np.percentile(off(raw), 95)


def test_an_exposure_that_lowers_contrast_is_followed() -> None:
    raw, _, painted = cloth_on_wood(np.random.default_rng(1))
    photo = np.clip(np.rint(60 + 0.5 * raw), 0, 255).astype(np.uint8)
    here = colours_here(raw, photo, painted, ~painted, 5.0)
    border = np.s_[35:45, 60], np.s_[35:45, 80]
    steps = [np.abs(p[border[0]].mean(0) - p[border[1]].mean(0)).max() for p in (photo.astype(float), here, raw)]
    assert abs(steps[1] - steps[0]) < 4 < 20 < abs(steps[2] - steps[0])


def test_detail_that_lies_elsewhere_in_the_photo_keeps_its_contrast() -> None:
    """Photos of rough scans show the same grain, a pixel or two aside: that is no lower contrast."""
    rng = np.random.default_rng(2)
    grain = cv2.GaussianBlur(rng.normal(0, 1, (80, 120)), (0, 0), 0.8)
    raw = (120 + 25 * grain / grain.std())[..., None] * np.ones(3, np.float32)
    photo = np.clip(np.rint(np.roll(raw, 2, 1)), 0, 255).astype(np.uint8)
    painted = cloth_on_wood(rng)[2]
    here = colours_here(raw.astype(np.float32), photo, painted, ~painted, 5.0)
    assert here[painted].std() > 0.9 * raw[painted].std()


@examples(15)
@given(seed=st.integers(0, 10_000), width=st.floats(1.0, 20.0))
def test_a_fill_in_the_views_colours_keeps_them(seed: int, width: float) -> None:
    rng = np.random.default_rng(seed)
    photo = rng.integers(0, 256, (40, 50, 3)).astype(np.uint8)
    painted, raw = rng.random((40, 50)) < 0.3, photo.astype(np.float32)
    here = colours_here(raw, photo, painted, ~painted & (rng.random((40, 50)) < 0.7), width)
    assert np.abs(here - raw).max() < 1e-3


@pytest.mark.parametrize("count", [0, 10])
def test_no_photo_or_a_few_pixels_of_it_tell_nothing_of_colours(count: int) -> None:
    raw, _, painted = cloth_on_wood(np.random.default_rng(3))
    band = np.zeros_like(painted)
    band[24, 30 : 30 + count] = True
    assert (colours_here(raw, np.zeros(raw.shape, np.uint8), painted, band, 5.0) == raw).all()


def test_light_that_differs_from_side_to_side_is_no_matter_of_colour() -> None:
    rng = np.random.default_rng(4)
    right = np.zeros((80, 120), bool)
    right[:, 60:] = True
    grain = 30 * cv2.GaussianBlur(rng.normal(0, 4, (80, 120, 1)), (0, 0), 3)[..., None]
    raw = (np.where(right[..., None], 140, 100) + grain + np.zeros(3)).astype(np.float32)
    photo = np.clip(np.rint(raw + 25 * right[..., None]), 0, 255).astype(np.uint8)
    painted = cloth_on_wood(rng)[2]
    here = colours_here(raw, photo, painted, ~painted, 5.0)
    assert np.abs(here - raw)[painted].mean() < 2

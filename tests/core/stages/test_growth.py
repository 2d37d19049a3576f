"""What the box cut off: the object's rest is proposed; the floor and a neighbour are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from scenes import BLOCK, REGION, block, cameras, floor, scene

from gimp3d.box import Box, Region
from gimp3d.gaussians import SH_C0, Gaussians
from gimp3d.pipeline import PRESETS, render_bytes
from gimp3d.stages.masks import Masks, MaskSettings, find_masks
from gimp3d.stages.selection import Fate, Growth

VIEWS = cameras(12, 200, 150)
FLOOR = len(floor(with_hole=True))
CUT = (Box.make([-0.08, 0, 0.26], [0.46, 0.62, 0.56]),)  # 10 cm of the block lie outside at +x
BLUE = np.array([0.1, 0.2, 0.8])


def found(gaussians: Gaussians, region: Region, grow: bool = False) -> Masks:
    photos = {c.id: render_bytes(gaussians, c) for c in VIEWS}
    return find_masks(gaussians, region, VIEWS, MaskSettings(grow=grow), photos=photos)


def growth(gaussians: Gaussians, region: Region) -> Growth:
    proposed = found(gaussians, region).growth
    assert proposed is not None
    return proposed


def neighbour() -> Gaussians:
    """A blue block that touches the red one at +x, its face 5 mm outside the box of the latter."""
    moved = block()
    moved.means[:, 0] += BLOCK + 0.03
    moved.sh[:, 0] = (BLUE - 0.5) / SH_C0
    return moved


def test_the_rest_of_a_cut_object_is_proposed_and_the_floor_is_not() -> None:
    masks = found(scene(), CUT)
    proposed = masks.growth
    assert proposed is not None and proposed.box is not None
    beyond = scene().means[FLOOR:, 0] > 0.2
    assert proposed.rows[FLOOR:][beyond].mean() > 0.9 and not proposed.rows[:FLOOR].any()
    assert not (proposed.rows & masks.removed).any()
    assert proposed.box.contains(scene().means[proposed.rows]).all() and proposed.box.contains(CUT[0].corners()).all()
    assert proposed.box.size[0] < 0.8 and (proposed.box.rotation_wxyz == CUT[0].rotation_wxyz).all()
    assert masks.proposed == {"gaussians": int(proposed.rows.sum()), "box": proposed.box.to_json()}
    assert proposed.words in masks.warnings and "--grow" in proposed.words


def test_grow_takes_the_rest_along() -> None:
    plain, grown = found(scene(), CUT), found(scene(), CUT, grow=True)
    rest = plain.growth.rows  # type: ignore[union-attr]
    assert (grown.selection.fates[rest] == Fate.REMOVED_GROWN).all()
    assert (grown.removed == plain.removed | rest).all()
    assert grown.proposed == {"gaussians": 0, "box": None} and not grown.warnings
    assert grown.grown(CUT)[0].size[0] > CUT[0].size[0] and plain.grown(CUT) == CUT


@pytest.mark.parametrize("grow", [False, True])
def test_grow_warns_where_the_boxes_alone_tell_what_goes(grow: bool) -> None:
    """In the preset paper, and where a box holds nothing but floor."""
    paper = replace(PRESETS["paper"].masks, grow=grow)
    bare = (Box.make([0.7, 0.7, 0], [0.5, 0.5, 0.1]),)
    for masks in (find_masks(scene(), CUT, VIEWS, paper), found(scene(), bare, grow)):
        assert masks.removed.any() and masks.growth is None
        assert len(masks.warnings) == grow and all("--grow does nothing" in w for w in masks.warnings)


def test_a_box_that_holds_the_object_proposes_nothing() -> None:
    proposed = growth(scene(), REGION)
    assert not proposed.rows.any() and proposed.box is None and not proposed.words and proposed.region == REGION


def test_a_neighbour_of_another_colour_is_not_proposed() -> None:
    both = scene().extended(neighbour())
    assert not growth(both, REGION).rows.any()
    assert not growth(both, CUT).rows[len(scene()) :].any()


def test_what_goes_on_without_end_is_not_proposed() -> None:
    wall = block()
    wall.means[:, 0] *= 8
    wall.log_scales[:, 0] += np.log(8)
    small = (Box.make([0, 0, 0.26], [0.62, 0.62, 0.56]),)
    assert not growth(floor(with_hole=True).extended(wall), small).rows.any()


@examples(3)
@given(seed=st.integers(0, 1000))
def test_the_order_of_rows_does_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    loose = scene()
    loose.means[:] += rng.normal(0, 1e-3, loose.means.shape)  # no two are equally far from a view
    order = rng.permutation(len(loose))
    assert (growth(loose.take(order), CUT).rows == growth(loose, CUT).rows[order]).all()


def test_of_several_boxes_the_one_that_cuts_is_enlarged() -> None:
    far = replace(CUT[0], center=np.array([-1.2, 0, 0.26]))
    proposed = growth(scene(), (far, *CUT))
    assert proposed.rows.any() and proposed.region[0] is proposed.box and proposed.region[1] is far

"""Oriented boxes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from gimp3d.box import Box, box_from_matrix, in_region, read_region
from gimp3d.errors import BadInput
from gimp3d.gaussians import quats_to_matrices

NUMBERS = st.floats(-3, 3)


@examples(50)
@given(center=st.tuples(*[NUMBERS] * 3), size=st.tuples(*[st.floats(0.1, 4)] * 3), quat=st.tuples(*[NUMBERS] * 4))
def test_contains_is_the_definition(center, size, quat) -> None:
    if np.linalg.norm(quat) < 0.1:
        return
    box = Box.make(center, size, quat)
    points = np.random.default_rng(0).uniform(-6, 6, (300, 3))
    rotation = quats_to_matrices(np.array([quat]))[0]
    local = np.array([rotation.T @ (p - center) for p in points])
    expected = (np.abs(local) <= np.array(size) / 2).all(1)
    assert (box.contains(points) == expected).all()
    assert box.contains(box.center[None])[0] and not box.contains(box.center[None] + 2 * np.linalg.norm(size))[0]
    inner = box.center + 0.999 * (box.corners() - box.center)
    assert box.contains(inner).all()


@examples(50)
@given(quat=st.tuples(*[NUMBERS] * 4), scale=st.tuples(*[st.floats(0.1, 3)] * 3), mirror=st.booleans())
def test_a_matrix_and_its_box_hold_the_same_points(quat, scale, mirror) -> None:
    if np.linalg.norm(quat) < 0.1:
        return
    matrix = np.eye(4)
    matrix[:3, :3] = quats_to_matrices(np.array([quat]))[0] @ np.diag(np.array(scale) * ([-1, 1, 1] if mirror else 1))
    matrix[:3, 3] = [1, -2, 0.5]
    low, high = np.array([-1.0, -0.5, 0.0]), np.array([1.0, 0.5, 2.0])
    box = box_from_matrix(matrix, low, high)
    points = np.random.default_rng(1).uniform(-8, 8, (400, 3))
    local = (np.c_[points, np.ones(400)] @ np.linalg.inv(matrix).T)[:, :3]
    clear = np.minimum(np.abs(local - low), np.abs(local - high)).min(1) > 1e-6
    assert (box.contains(points) == ((local >= low) & (local <= high)).all(1))[clear].all()


def test_sheared_and_flat_matrices_are_refused() -> None:
    shear = np.eye(4)
    shear[0, 1] = 0.3
    with pytest.raises(BadInput, match="sheared"):
        box_from_matrix(shear, -np.ones(3), np.ones(3))
    with pytest.raises(BadInput, match="flat"):
        box_from_matrix(np.diag([1.0, 0, 1, 1]), -np.ones(3), np.ones(3))


def test_boxes_read_from_json_are_a_union(tmp_path: Path) -> None:
    boxes = [Box.make([0, 0, 0], [1, 1, 1]), Box.make([3, 0, 0], [1, 2, 1], [0.5, 0.5, 0.5, 0.5])]
    (tmp_path / "roi.json").write_text(json.dumps([b.to_json() for b in boxes]))
    region = read_region(tmp_path / "roi.json")
    assert in_region(region, np.array([[0, 0, 0], [3, 0, 0], [1.5, 0, 0], [np.nan, 0, 0]])).tolist() == [1, 1, 0, 0]


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        "3",
        "not json",
        '{"center": [0,0,0]}',
        '{"center": [0,0], "size": [1,1,1]}',
        '{"center": [0,0,0], "size": [1,1,-1]}',
        '{"center": [0,0,0], "size": [1,1,1], "rotation_wxyz": [0,0,0,0]}',
        '{"center": [0,0,NaN], "size": [1,1,1]}',
        '{"center": ["a",0,0], "size": [1,1,1]}',
    ],
)
def test_malformed_regions_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "roi.json").write_text(text)
    with pytest.raises(BadInput, match="ROI"):
        read_region(tmp_path / "roi.json")


def test_more_boxes_than_time_allows_are_refused(tmp_path: Path) -> None:
    """Each takes a third of a second and more."""
    box = {"center": [0, 0, 0], "size": [1, 1, 1]}
    (tmp_path / "roi.json").write_text(json.dumps([box] * 300))
    with pytest.raises(BadInput, match="300 boxes; 50 are the most"):
        read_region(tmp_path / "roi.json")


@pytest.mark.parametrize("wrong", [10**400, 1e200, True, "1", None, [1], float("nan")])
def test_numbers_that_no_box_can_have_are_refused(wrong: object, tmp_path: Path) -> None:
    (tmp_path / "roi.json").write_text(json.dumps({"center": [0, 0, wrong], "size": [1, 1, 1]}))
    with pytest.raises(BadInput, match="ROI"):
        read_region(tmp_path / "roi.json")

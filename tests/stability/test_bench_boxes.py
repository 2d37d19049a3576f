"""Boxes of other users are near the scene's own, and each is the same every time."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.boxes import sections
from benchmarks.scenes import GROWN, MOVED, redrawn
from gimp3d.box import Box

REGION = (Box.make([1.0, 2, 3], [2.0, 1, 0.5], [0.9, 0.1, 0.4, 0.1]), Box.make([0.0, 0, 0], [1.0, 1, 1]))


@pytest.mark.parametrize("number", range(1, 20))
def test_boxes_of_another_user_are_a_little_beside_and_larger(number: int) -> None:
    for own, box in zip(REGION, redrawn(REGION, number)):
        moved = np.abs((box.center - own.center) @ own.axes) / own.size
        assert (moved <= MOVED).all() and moved.max() > 0
        assert ((box.size >= own.size) & (box.size <= (1 + GROWN) * own.size)).all()
        assert (box.rotation_wxyz == own.rotation_wxyz).all()
    again, other = redrawn(REGION, number), redrawn(REGION, number + 1)
    assert (again[0].center == redrawn(REGION, number)[0].center).all() and (again[0].center != other[0].center).any()


def test_the_scenes_own_box_is_the_first() -> None:
    assert redrawn(REGION, 0) is REGION


def test_what_was_refused_is_counted_and_not_averaged() -> None:
    cells = [
        {"mask": 30.0, "unseen": 20.0},
        {"mask": 28.0, "unseen": 21.0},
        {"refused": "no"},
        {"mask": 24.0, "unseen": 19.0},
    ]
    (section,) = sections({("desk", "given"): cells, ("bed", "given"): [{"refused": "no"}, {"refused": "no"}]}, "draft")
    assert section.rows[0][2:6] == ["30.00", "26.00", "2.00", "24.00"] and section.rows[0][-1] == "2 of 3"
    assert section.rows[1][2:6] == ["nan", "–", "–", "–"]

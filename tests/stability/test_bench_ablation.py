"""Rules are switched off for the time of a removal, and only then; what is finished is not done again."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scenes import cameras, floor

from benchmarks.ablation import RULES, Around, changed, switched_off
from benchmarks.command import kept
from gimp3d.errors import BadInput
from gimp3d.pipeline import PRESETS
from gimp3d.stages import light_search
from gimp3d.stages.beside import Shown, Sight
from gimp3d.steps import behind

ROOT = Path(__file__).resolve().parents[2]
CAMERA = cameras(1, 60, 45)[0]


@pytest.mark.parametrize("rule", RULES)
def test_every_rule_names_something_that_is_there(rule: str) -> None:
    assert changed(PRESETS["balanced"], RULES[rule]) is not None
    with switched_off(RULES[rule]):
        pass


@pytest.mark.parametrize("rule", [r for r, switches in RULES.items() if any("shown_beside" in s[0] for s in switches)])
def test_what_photos_show_beside_the_object_can_be_told_otherwise(rule: str) -> None:
    ground = floor(with_hole=False)
    none = np.zeros(len(ground), bool)
    sight = Sight(CAMERA, np.zeros((45, 60, 3), np.uint8), np.ones((45, 60), bool), np.zeros((45, 60), bool))
    with switched_off(RULES[rule]):
        told = behind.shown_beside(ground, ~none, none, ~none, [sight])
    assert isinstance(told, Shown) and told.alike.shape == told.share.shape == none.shape


def test_a_constant_and_a_function_come_back_after_an_error() -> None:
    most = light_search.MOST
    twice = Around(lambda before: before + most)
    with pytest.raises(RuntimeError), switched_off([("gimp3d.stages.light_search:MOST", twice)]):
        assert 2 * most == light_search.MOST
        raise RuntimeError
    assert most == light_search.MOST


def test_names_that_are_gone_are_told_in_one_line() -> None:
    with pytest.raises(BadInput, match=r"there is no setting seed\.gone any more"):
        changed(PRESETS["balanced"], [("seed.gone", 1)])
    with (
        pytest.raises(BadInput, match=r"there is no gimp3d\.stages\.seed:GONE any more"),
        switched_off([("gimp3d.stages.seed:GONE", 1)]),
    ):
        pass


def test_a_finished_cell_is_not_measured_again(tmp_path: Path) -> None:
    for number in (1, 2):
        assert kept(tmp_path / "cells.json", "a", lambda n=number: {"n": n}) == {"n": 1}
    assert kept(tmp_path / "cells.json", "b", lambda: {"n": 3}) == {"n": 3}


@pytest.mark.slow
def test_a_rule_switched_off_costs_what_it_is_worth(shared_data: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks.ablation", str(shared_data / "withwithout"), "--quick"]
    done = subprocess.run([*command, "--out", str(tmp_path)], cwd=ROOT, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    cells = {key.split(" | ")[2]: cell for key, cell in json.loads((tmp_path / "cells.json").read_text()).items()}
    assert cells["the paper's blend"]["mask"] < cells[""]["mask"] - 0.1
    assert "| not refined |" in (tmp_path / "ablation.md").read_text()

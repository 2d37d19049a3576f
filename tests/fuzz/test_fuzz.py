"""A slice of `make fuzz`: no changed file makes a reader do anything but read or refuse."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from readers import READERS, case

FEW = 150  # cases of each reader in `make test`
SLICE = 60.0  # seconds of all readers in `make test-all`


@pytest.mark.parametrize("name", READERS)
def test_what_readers_start_from_is_taken(name: str) -> None:
    assert all(READERS[name].check(seed) for seed in READERS[name].seeds())


@pytest.mark.parametrize("name", READERS)
def test_changed_files_are_read_or_refused(name: str) -> None:
    reader = READERS[name]
    seeds = reader.seeds()
    taken = [reader.check(case(reader, seeds, number)) for number in range(FEW)]
    assert not all(taken) or name == "stage"  # a stage that is damaged is just made again


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_a_slice_of_a_minute(name: str) -> None:
    reader = READERS[name]
    seeds, end, number = reader.seeds(), time.monotonic() + SLICE / len(READERS), FEW
    while time.monotonic() < end:
        reader.check(case(reader, seeds, number))
        number += 1
    assert number > 2 * FEW

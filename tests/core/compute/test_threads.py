"""The thread pool."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from gimp3d.compute.threads import parallel_map, run_ranges, set_thread_count, thread_count


def test_ranges_cover_everything_once() -> None:
    for count in (0, 1, 7, 1000):
        seen = np.zeros(count, int)

        def mark(lo: int, hi: int, seen: np.ndarray = seen) -> None:
            seen[lo:hi] += 1

        run_ranges(mark, count)
        assert (seen == 1).all()


def test_results_keep_their_order_and_errors_come_through() -> None:
    assert parallel_map(lambda x: x * x, range(50)) == [x * x for x in range(50)]
    with pytest.raises(ZeroDivisionError):
        parallel_map(lambda x: 1 // x, [1, 0, 2])


def test_nested_calls_run_inline_instead_of_waiting_for_themselves() -> None:
    def inner(x: int) -> int:
        assert thread_count() == 1
        return sum(parallel_map(lambda y: x + y, range(10)))

    assert parallel_map(inner, range(20)) == [10 * x + 45 for x in range(20)]


def test_the_thread_count_can_be_set() -> None:
    try:
        set_thread_count(2)
        names = set(parallel_map(lambda _: threading.current_thread().name, range(40)))
        assert thread_count() == 2 and len(names) <= 2
    finally:
        set_thread_count(None)


@pytest.mark.parametrize("most", [1, 2, 3])
def test_no_more_at_a_time_than_asked_for(most: int) -> None:
    lock, now, peak = threading.Lock(), 0, 0

    def work(x: int) -> int:
        nonlocal now, peak
        with lock:
            now += 1
            peak = max(peak, now)
        time.sleep(0.001)
        with lock:
            now -= 1
        return -x

    try:
        set_thread_count(4)
        assert parallel_map(work, range(40), most) == [-x for x in range(40)]
        assert peak <= most
        with pytest.raises(ZeroDivisionError):
            parallel_map(lambda x: 1 // x, [1, 0, 2], most)
    finally:
        set_thread_count(None)

"""Memory that is used again, and never while somebody looks at it."""

import gc
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gimp3d.compute import buffers

LARGE = buffers.SMALLEST  # bytes


@pytest.fixture(autouse=True)
def nothing_kept():
    buffers.release()
    yield
    buffers.release()


def address(array):
    return array.ctypes.data


@given(
    st.lists(st.integers(0, 40), min_size=1, max_size=3),
    st.sampled_from([np.float32, np.int64, np.int16, np.uint8]),
    st.integers(0, 1),
)
def test_arrays_are_as_asked_for_and_begin_with_a_cache_line(shape, dtype, large):
    shape = (*shape[:-1], shape[-1] + large * LARGE // 64)
    array = buffers.zeros(tuple(shape), dtype)
    assert array.shape == shape and array.dtype == dtype
    assert array.flags.c_contiguous and array.flags.writeable
    assert not array.any()
    assert array.size == 0 or address(array) % buffers.LINE == 0


def test_a_number_is_a_shape_too():
    assert buffers.empty(7, np.float32).shape == buffers.empty(np.int64(7), np.float32).shape == (7,)


def test_memory_comes_back_when_the_last_view_is_gone():
    array = buffers.empty(LARGE, np.uint8)
    array[:] = 255
    place, view = address(array), array[5:9].reshape(2, 2)
    del array
    gc.collect()
    other = buffers.empty(LARGE, np.uint8)
    other[:] = 0
    assert address(other) != place and (view == 255).all()
    del view
    gc.collect()
    again = buffers.zeros(LARGE // 4, np.float32)
    assert address(again) == place and not again.any()


def test_near_sizes_share_memory_and_it_is_large_enough():
    array = buffers.empty(LARGE + 1, np.uint8)
    place = address(array)
    del array
    gc.collect()
    larger = buffers.empty(LARGE + LARGE // 16, np.uint8)
    larger[:] = 1
    assert address(larger) == place
    owner = larger.base
    assert place + larger.nbytes <= owner.memory.ctypes.data + owner.memory.nbytes


def test_no_more_is_kept_than_the_cap(monkeypatch):
    monkeypatch.setattr(buffers, "MOST_KEPT", 3 * LARGE)
    arrays = [buffers.empty(LARGE, np.uint8) for _ in range(5)]
    arrays.clear()
    gc.collect()
    assert 2 * LARGE <= buffers._kept <= 3 * LARGE
    assert buffers._kept == sum(m.nbytes for kept in buffers._free.values() for m in kept)
    buffers.release()
    assert buffers._kept == 0 and not buffers._free


def test_what_was_not_used_for_longest_goes_first(monkeypatch):
    monkeypatch.setattr(buffers, "MOST_KEPT", 5 * LARGE)
    old, new = buffers.empty(LARGE, np.uint8), buffers.empty(2 * LARGE, np.uint8)
    del old
    places = [address(new)]
    del new
    several = [buffers.empty(2 * LARGE, np.uint8) for _ in range(2)]
    places += [address(a) for a in several]
    several.clear()
    gc.collect()
    assert list(buffers._free) == [2 * LARGE + buffers.LINE]
    again = [buffers.empty(2 * LARGE, np.uint8) for _ in range(2)]
    assert {address(a) for a in again} <= set(places)


def test_threads_never_get_the_same_memory_at_once():
    wrong = []

    def use(mark):
        for _ in range(300):
            array = buffers.empty(LARGE, np.uint8)
            array[::4096] = mark
            if (array[::4096] != mark).any():
                wrong.append(mark)

    threads = [threading.Thread(target=use, args=(mark,)) for mark in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
    assert buffers._kept <= buffers.MOST_KEPT

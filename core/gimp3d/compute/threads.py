"""Our own thread pool for nogil kernels over ranges.

Never numba's parallel layer: its work queue aborts the process when two threads enter it, which would take Blender's
unsaved work along. Ranges are fixed by the item count, never by timing, so results do not depend on the thread count
as long as a kernel writes only its own range.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

T = TypeVar("T")
R = TypeVar("R")

SMALL = 300_000  # pixels of a picture, see at_once
_lock = threading.Lock()
_inside = threading.local()  # marks pool threads: nested calls run inline instead of waiting for their own pool
_pool: ThreadPoolExecutor | None = None
_count = 0


def available_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def thread_count() -> int:
    """Threads that kernels may use now."""
    if getattr(_inside, "pool_thread", False):
        return 1
    return _count or available_cores()


def set_thread_count(count: int | None) -> None:
    """Use `count` threads from now on (None: one per core)."""
    global _pool, _count
    with _lock:
        _count = max(0, count or 0)
        if _pool is not None:
            _pool.shutdown(wait=True)
            _pool = None


def _executor() -> ThreadPoolExecutor:
    global _pool
    with _lock:
        if _pool is None:
            count, mark = _count or available_cores(), (_inside, "pool_thread", True)
            _pool = ThreadPoolExecutor(count, thread_name_prefix="gimp3d", initializer=setattr, initargs=mark)
        return _pool


def at_once(pixels: int) -> int | None:
    """How many pictures of so many pixels are worked on at once by NumPy and OpenCV: 2, or all threads.

    Small ones take so little time per call that more than two threads spend theirs on passing on Python's lock.
    """
    return 2 if pixels < SMALL else None


def parallel_map(function: Callable[[T], R], items: Iterable[T], most: int | None = None) -> list[R]:
    """[function(x) for x in items], in order, on the pool, `most` at a time; the first exception is raised."""
    items = list(items)
    if thread_count() == 1 or len(items) < 2:
        return [function(x) for x in items]
    if most is None or most >= thread_count():
        return list(_executor().map(function, items))
    left = iter(enumerate(items))  # next() on it is one step for Python's threads

    def take(_: int) -> list[tuple[int, R]]:
        return [(k, function(x)) for k, x in left]

    found = dict(pair for part in _executor().map(take, range(most)) for pair in part)
    return [found[k] for k in range(len(items))]


def run_ranges(kernel: Callable[..., Any], count: int, *args: Any, chunk: int = 0) -> None:
    """Call `kernel(lo, hi, *args)` over [0, count) in chunks (default: a few per thread)."""
    if count <= 0:
        return
    step = chunk or max(1, -(-count // (4 * thread_count())))
    ranges = [(lo, min(lo + step, count)) for lo in range(0, count, step)]
    parallel_map(lambda r: kernel(r[0], r[1], *args), ranges)

"""Large arrays on memory that was used before.

Fresh memory costs a page fault, and the kernel's zeros, for every page that is written the first time; with several
threads they queue for it. A rasteriser that trains asks for the same hundreds of megabytes in every iteration, and
took an eighth of its time for that. An array from here gives its memory back when the last view of it is gone.
"""

from __future__ import annotations

import ctypes
import sys
import threading

import numpy as np

SMALLEST = 1 << 20  # bytes; less than that the allocator keeps by itself
MOST_KEPT = 256 << 20  # bytes of unused memory
LINE = 64  # bytes; arrays begin with a cache line, because vectors astride two cost twice

_trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
_lock = threading.RLock()  # re-entrant: the garbage collector may give an array back while one is taken
_free: dict[int, list[np.ndarray]] = {}  # by size, in the order in which they were last given back
_kept = 0


class _Lease:
    """Owns the memory of an array; NumPy keeps it alive as long as a view exists."""

    def __init__(self, memory: np.ndarray, shape: tuple[int, ...], dtype: np.dtype) -> None:
        self.memory = memory
        start = memory.ctypes.data + -memory.ctypes.data % LINE
        self.__array_interface__ = {"version": 3, "shape": shape, "typestr": dtype.str, "data": (start, False)}

    def __del__(self) -> None:
        global _kept
        size = self.memory.nbytes
        if not SMALLEST <= size <= MOST_KEPT:
            return
        with _lock:
            _free[size] = [*_free.pop(size, ()), self.memory]
            _kept += size
            while _kept > MOST_KEPT:  # sizes that were given back longest ago go first
                stale = next(iter(_free))
                _kept -= stale
                if len(_free[stale]) == 1:
                    del _free[stale]
                else:
                    _free[stale].pop()


def empty(shape: int | tuple[int, ...], dtype: type) -> np.ndarray:
    """As np.empty."""
    global _kept
    shape = (shape,) if isinstance(shape, int | np.integer) else shape
    kind: np.dtype = np.dtype(dtype)
    size = kind.itemsize * int(np.prod(shape, dtype=np.int64))
    if size < SMALLEST:
        return np.asarray(_Lease(np.empty(size + LINE, np.uint8), shape, kind))
    step = 1 << (size.bit_length() - 4)  # sizes in steps of an eighth or less, so that near ones share
    wanted = -(-size // step) * step + LINE
    with _lock:
        memory = _free[wanted].pop() if wanted in _free else None
        if memory is not None:
            _kept -= memory.nbytes
            if not _free[wanted]:
                del _free[wanted]
    return np.asarray(_Lease(np.empty(wanted, np.uint8) if memory is None else memory, shape, kind))


def zeros(shape: int | tuple[int, ...], dtype: type) -> np.ndarray:
    """As np.zeros."""
    array = empty(shape, dtype)
    array[...] = 0
    return array


def release() -> None:
    """Give unused memory back to the system, also what the C library keeps for itself.

    glibc keeps a heap for each thread; what one thread leaves behind there, no other uses.
    """
    global _kept
    with _lock:
        _free.clear()
        _kept = 0
    if _trim is not None:
        _trim(0)

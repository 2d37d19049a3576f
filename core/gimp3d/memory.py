"""How much memory there is, asked before it is taken: a compiler or a kernel that runs out aborts the whole process."""

from __future__ import annotations

import sys
from contextlib import suppress
from pathlib import Path

BASE = 400 << 20  # bytes of memory: interpreter, libraries, compiled kernels and their compiler …
BASE_ADDRESSES = 900 << 20  # … and of address space
VIEW_PIXEL = 30  # bytes that a removal holds for each pixel of each view, see tests/e2e/test_memory.py
GAUSSIAN = 600  # and for each Gaussian of degree 3
GROUP = Path("/sys/fs/cgroup")


def free_memory() -> int | None:
    """Bytes of memory that this process may still take; None where the system does not tell."""
    found = []
    with suppress(OSError, ValueError, KeyError):
        facts = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        found.append(int(facts["MemAvailable"].split()[0]) << 10)
    with suppress(OSError, ValueError, KeyError):  # a container's limit; "max" is no number
        used = dict(line.split() for line in (GROUP / "memory.stat").read_text().splitlines())
        found.append(int((GROUP / "memory.max").read_text()) - int(used["anon"]))
    return max(0, min(found)) if found else None


def free_addresses() -> int | None:
    """Bytes of address space that this process may still take; None without a limit."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        most = resource.getrlimit(resource.RLIMIT_AS)[0]
        if most != resource.RLIM_INFINITY:
            return max(0, most - int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize())
    return None


def require_memory(needed: float, what: str, addresses: float | None = None) -> None:
    """Raise MemoryError now if so many bytes of memory and of address space cannot be had."""
    for size, free in ((needed, free_memory()), (addresses or needed, free_addresses())):
        if free is not None and size > free:
            raise MemoryError(f"{what} takes about {size / 2**20:,.0f} MiB and {free / 2**20:,.0f} MiB are free")


def require_base_memory() -> None:
    """Raise MemoryError if the kernels could not be loaded or compiled."""
    require_memory(BASE, "gimp3d", BASE_ADDRESSES)


def peak_memory_mb() -> float:
    """The largest resident size of this process so far; 0 where the system does not tell (Windows)."""
    try:
        import resource
    except ImportError:
        return 0.0
    unit = 1024**2 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit

"""How kernels are compiled: nogil, cached in a user folder that is never stale.

numba's cache looks at a kernel's own file only, not at the modules it inlines. Each module's kernels therefore lie in a
folder whose name carries a hash of that module, of those whose kernels it may inline, and of numba's version.
Kernels therefore take constants from their own file or as arguments.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba

HERE = Path(__file__)


def user_cache_folder() -> Path:
    """Where this library may keep caches: GIMP3D_CACHE, else the system's user cache folder."""
    if "GIMP3D_CACHE" in os.environ:
        return Path(os.environ["GIMP3D_CACHE"])
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData/Local")) / "gimp3d"
    if sys.platform == "darwin":
        return Path.home() / "Library/Caches/gimp3d"
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "gimp3d"


def _kernel_sources(module: Path) -> set[Path]:
    """A module with kernels, and those of this package whose kernels it may inline."""
    found, to_read = {HERE, HERE.with_name("simd.py")}, {module}
    while to_read:
        source = to_read.pop()
        found.add(source)
        for dots, name in re.findall(r"^from (\.+)([\w.]+) import", source.read_text("utf-8"), re.M):
            imported = source.parents[len(dots) - 1].joinpath(*name.split(".")).with_suffix(".py")
            if imported not in found and imported.exists() and "jit import" in imported.read_text("utf-8"):
                to_read.add(imported)
    return found


@cache
def _cache_folder(module: Path) -> Path:
    """Where a module's compiled kernels lie."""
    digest = hashlib.sha256(numba.__version__.encode())
    for source in sorted(_kernel_sources(module)):
        digest.update(source.name.encode() + source.read_bytes())
    return user_cache_folder() / "kernels" / f"{module.stem}-{digest.hexdigest()[:16]}"


def _compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """numba's njit, its cache in the folder of the function's module."""

    def decorate(function: Callable[..., Any]) -> Any:
        folder = _cache_folder(Path(function.__code__.co_filename))
        if options.get("cache"):
            _there.setdefault(folder, folder.exists())
        numba.config.CACHE_DIR = str(folder)  # numba looks here when it decorates
        return numba.njit(nogil=True, error_model="numpy", boundscheck=False, **options)(function)

    return decorate


_there: dict[Path, bool] = {}  # folders of modules whose kernels are kept, and whether they were there at the start
_announced = False
kernel = _compiled(cache=True, fastmath=True)
# For kernels that must see NaN and infinity as such:
exact_kernel = _compiled(cache=True, fastmath={"contract"})
# For small functions used inside kernels:
inline_kernel = _compiled(fastmath=True, inline="always")


def announce_compilation(say: Callable[[str], object] = logging.getLogger("gimp3d").warning) -> None:
    """Say once, and only where most is not compiled yet, why the first call takes long."""
    global _announced
    if not _announced and 2 * sum(_there.values()) < len(_there):
        say("first run on this machine: compiling kernels, about a minute")
    _announced = True

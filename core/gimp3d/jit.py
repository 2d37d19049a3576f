"""How kernels are compiled: nogil, cached in a user folder that is never stale.

numba's cache looks at a kernel's own file only, not at the modules it inlines. The cache folder's name therefore
carries a hash of every source file that holds kernels and numba's version: an upgrade starts a fresh folder.
Kernels therefore take constants from their own file or as arguments.
"""

from __future__ import annotations

import hashlib
import logging
import os
import sys
from collections.abc import Callable
from pathlib import Path

import numba


def user_cache_folder() -> Path:
    """Where this library may keep caches: GIMP3D_CACHE, else the system's user cache folder."""
    if "GIMP3D_CACHE" in os.environ:
        return Path(os.environ["GIMP3D_CACHE"])
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData/Local")) / "gimp3d"
    if sys.platform == "darwin":
        return Path.home() / "Library/Caches/gimp3d"
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "gimp3d"


def _source_hash() -> str:
    digest = hashlib.sha256(numba.__version__.encode())
    root = Path(__file__).parent
    for source in sorted(root.rglob("*.py")):
        text = source.read_bytes()
        if b"jit import" in text or source.name == "jit.py":
            digest.update(source.relative_to(root).as_posix().encode())
            digest.update(text)
    return digest.hexdigest()[:16]


kernel_cache = user_cache_folder() / f"kernels-{_source_hash()}"
_to_announce = not kernel_cache.exists()
numba.config.CACHE_DIR = str(kernel_cache)

kernel = numba.njit(nogil=True, cache=True, fastmath=True, error_model="numpy", boundscheck=False)
# For kernels that must see NaN and infinity as such:
exact_kernel = numba.njit(nogil=True, cache=True, fastmath={"contract"}, error_model="numpy", boundscheck=False)
# For small functions used inside kernels:
inline_kernel = numba.njit(nogil=True, fastmath=True, error_model="numpy", boundscheck=False, inline="always")


def announce_compilation(say: Callable[[str], object] = logging.getLogger("gimp3d").warning) -> None:
    """Say once, and only where nothing is compiled yet, why the first call takes long."""
    global _to_announce
    if _to_announce:
        _to_announce = False
        say("first run on this machine: compiling kernels, up to 15 seconds")

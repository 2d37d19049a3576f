"""One process at a time works on a job: a lock that ends with the process that holds it, however that ends.

The standard library alone: the child that runs a removal reads this file by its path.
"""

from __future__ import annotations

import errno
import os
import time
from pathlib import Path
from typing import IO

if os.name == "nt":
    import msvcrt
else:
    import fcntl

HELD = (errno.EACCES, errno.EAGAIN, errno.EDEADLK)


def hold(path: Path | str, patience: float = 0.0) -> IO[bytes] | None:
    """The locked file, to be kept open; None if another process has held it for `patience` seconds.

    Where a disk knows no locks, nothing is locked.
    """
    file = open(path, "ab")  # noqa: SIM115, it is open for as long as it is locked
    until = time.monotonic() + patience
    while True:
        try:
            if os.name == "nt":
                file.seek(0)
                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            else:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in HELD:
                if time.monotonic() < until:
                    time.sleep(0.05)
                    continue
                file.close()
                return None
        return file


def is_held(path: Path) -> bool:
    """Whether a process holds the lock now."""
    if not path.exists():
        return False
    try:
        file = hold(path)
    except OSError:  # a folder that cannot be written
        return False
    if file is not None:
        file.close()
    return file is None

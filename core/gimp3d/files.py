"""Files of others read with care, and our own written so that a fault leaves what was there."""

from __future__ import annotations

import json
import os
import re
import secrets
import stat
import sys
import tempfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from .errors import BadInput, refusing

UNFINISHED = ".gimp3d-part"  # ends the names of files that are being written


def user_state_folder() -> Path:
    """Where this user's own records and logs lie: GIMP3D_STATE, else the system's folder for them."""
    if "GIMP3D_STATE" in os.environ:
        return Path(os.environ["GIMP3D_STATE"])
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData/Local")) / "gimp3d" / "state"
    if sys.platform == "darwin":
        return Path.home() / "Library/Application Support/gimp3d"
    return Path(os.environ.get("XDG_STATE_HOME", Path.home() / ".local/state")) / "gimp3d"


def user_secret() -> bytes:
    """32 random bytes that this user's runs on this machine share; others each time where they cannot be kept."""
    path = user_state_folder() / "secret"
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with suppress(FileExistsError), open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(secrets.token_bytes(32))
        if len(found := path.read_bytes()) == 32:
            return found
    return secrets.token_bytes(32)


def require_file(path: Path) -> Path:
    """The path, if a file lies there or nothing does; BadInput for a pipe, a socket or a device."""
    if is_stream(path):
        raise BadInput(f"{path} is a pipe or a device; a file is needed, as it is read more than once")
    return path


def write_atomically(path: Path, write: Callable[[IO[bytes]], Any]) -> None:
    """Let `write(file)` fill a temporary file beside `path`, then move it there; nothing half-written stays.

    A link is followed and the file's permissions are kept. A pipe or a device is written to as it is. BadInput if the
    folder cannot be written or the disk is full.
    """
    with refusing(f"cannot write {path}", OSError):
        if is_stream(path):
            with path.open("wb") as stream:
                write(stream)
            return
        target = Path(os.path.realpath(path))
        target.parent.mkdir(parents=True, exist_ok=True)
        short = target.name.encode()[:100].decode(errors="ignore")  # no name is longer than file systems allow
        name = target.with_name(f".{short}.{secrets.token_hex(4)}.{os.getpid()}{UNFINISHED}")
        old = target.stat() if target.exists() else None
        try:
            with open(name, "xb", opener=lambda n, flags: os.open(n, flags, 0o600 if old else 0o666)) as file:
                write(file)
                file.flush()
                os.fsync(file.fileno())
            if old:
                with suppress(OSError, AttributeError):  # AttributeError: Windows knows no owners
                    os.chown(name, old.st_uid, old.st_gid)
                name.chmod(stat.S_IMODE(old.st_mode))
            os.replace(name, target)
        except BaseException:
            with suppress(OSError):
                os.unlink(name)
            raise


def write_json(path: Path, document: Any) -> None:
    """Write a JSON file as `write_atomically` does."""
    write_atomically(path, lambda f: f.write(json.dumps(document, indent=1).encode()))


def try_target(path: Path, is_folder: bool = False) -> None:
    """Raise BadInput now if `path`, or a file in the folder `path`, could not be written later."""
    with refusing(f"cannot write {path}", OSError, ValueError), suppress(FileNotFoundError):
        if is_stream(path):
            if is_folder or not os.access(path, os.W_OK):
                raise BadInput(f"cannot write {path} (a pipe or device)")
            return
        target = Path(os.path.realpath(path))
        if target.exists() and target.is_dir() != is_folder:
            raise BadInput(f"cannot write {path} (it is {'a file' if is_folder else 'a folder'})")
        place = target if is_folder else target.parent
        while not place.exists() and place != place.parent:
            place = place.parent
        with tempfile.TemporaryFile(prefix=".gimp3d-", dir=place):
            pass
        os.lstat(place / target.name)  # fails where the name is too long


def sweep(folders: Iterable[Path]) -> None:
    """Delete what killed runs left half-written in folders; what a living process writes stays."""
    for folder in set(folders):
        with suppress(OSError):
            for left in folder.glob(f".*{UNFINISHED}"):
                owner = re.search(rf"\.(\d+){re.escape(UNFINISHED)}$", left.name)
                if owner and not _alive(int(owner[1])):
                    with suppress(OSError):
                        left.unlink()


def is_stream(path: Path) -> bool:
    """A pipe, a socket or a device, which is written to and never replaced."""
    with suppress(OSError, ValueError):  # whoever opens it says why it cannot be read
        kind = path.stat().st_mode
        return not stat.S_ISREG(kind) and not stat.S_ISDIR(kind)
    return False


def identity(path: Path) -> tuple[int, ...] | None:
    """Tells a file from what replaces it; None where there is none."""
    with suppress(OSError):
        found = os.stat(path)
        return found.st_dev, found.st_ino, found.st_mtime_ns, found.st_size
    return None


def _alive(process: int) -> bool:
    if os.name != "posix":  # there, a file that is open cannot be deleted
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return process != os.getpid()

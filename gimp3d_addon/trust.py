"""What this user has allowed on this machine: a .blend may come from anybody, and may ask for anything.

Kept in Blender's user folder and shown in the preferences; never in a .blend.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from gimp3d.files import write_json
from gimp3d.io.cameras import PHOTOS

from .installation import user_folder

ALLOWED, PHOTO_FOLDERS = "allowed.json", "photos.json"


def unconfirmed(providers: Iterable[str]) -> list[str]:
    """What providers would run or read, each in full, as far as nobody has allowed it on this machine."""
    known = allowed()
    return [said for said in map(in_full, providers) if said and said not in known]


def in_full(provider: str) -> str:
    """What a provider would run or read; empty for those that the program brings along.

    A command runs in Blender's folder, and a file may be another one tomorrow: both are part of what is allowed.
    """
    name, _, argument = provider.partition(":")
    if not argument:
        return ""
    if name == "command":
        return f"{provider}\nin the folder {Path.cwd()}"
    for path in (argument, argument.rpartition(",")[0]):  # the size or kind may follow
        if os.path.isfile(path):
            with open(path, "rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            return f"{provider}\nthe file {Path(path).resolve()}\nSHA-256 {digest}"
    return provider


def allowed() -> list[str]:
    """What was allowed, in full, oldest first."""
    return _read(ALLOWED)


def allow(said: Iterable[str]) -> None:
    _write(ALLOWED, list(dict.fromkeys([*allowed(), *said])))


def forget(said: str) -> None:
    """Ask again before this is run."""
    _write(ALLOWED, [a for a in allowed() if a != said])


def know_photos(photos: Iterable[Path]) -> None:
    """The user chose these pictures; what lies in their folders may go into jobs."""
    known = _read(PHOTO_FOLDERS)
    new = dict.fromkeys(str(path.parent) for photo in photos for path in (photo.absolute(), photo.resolve()))
    if not new.keys() <= set(known):
        _write(PHOTO_FOLDERS, list(dict.fromkeys([*known, *new])))


def is_known_photo(path: Path) -> bool:
    """Whether a file is named as a picture and lies, links followed, in a folder that the user took pictures from."""
    known = _read(PHOTO_FOLDERS)
    named = path.suffix.lower() in PHOTOS and str(path.absolute().parent) in known  # no disk or network is asked yet
    return named and str(path.resolve().parent) in known and path.is_file()


_last: dict[str, tuple[int, list[str]]] = {}  # a panel asks many times a second


def _read(name: str) -> list[str]:
    path = user_folder("trusted") / name
    try:
        changed = path.stat().st_mtime_ns
        if _last.get(name, (0, []))[0] != changed:
            found: Any = json.loads(path.read_text(encoding="utf-8"))
            _last[name] = changed, [f for f in found if isinstance(f, str)] if isinstance(found, list) else []
    except (OSError, ValueError):
        return []
    return _last[name][1]


def _write(name: str, entries: list[str]) -> None:
    write_json(user_folder("trusted") / name, entries)
    _last.pop(name, None)

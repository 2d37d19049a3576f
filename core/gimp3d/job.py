"""The job folder: everything a removal needs and everything it made, so that it can resume or move.

DIR/job.json      the RemovalJob; paths inside are relative to DIR where possible
DIR/stages/       one .npz (+ .json) per finished stage, with a key of its inputs
DIR/summary.json  written at the end
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import IO, Any

from .errors import BadInput

JOB_VERSION = 1
SHADOWS = ("auto", "off", "mask")  # what the object's own shadow is taken for


@dataclass(frozen=True)
class RemovalJob:
    """What `gimp3d remove` was asked to do; the fields are the command line's (CONTRACT: remove)."""

    scene: str
    cameras: str
    roi: str
    out: str
    images: str | None = None  # folder; "none": views are rendered from the scene itself
    extra_masks: str | None = None  # folder of masks that are filled too: shadows, reflections
    shadow: str = "auto"  # one of SHADOWS
    shadow_masks: str | None = None  # folder of masks of the object's shadow
    reference: str | None = None
    reference_image: str | None = None
    inpaint: str = "exemplar"
    depth_prior: str = "auto"
    refine_views: str | None = None  # provider that refines painted views beside the reference
    preset: str = "balanced"
    set: dict[str, str] = field(default_factory=dict)  # single settings that override the preset
    views_out: str | None = None
    report: str | None = None
    summary: str | None = None
    device: str = "auto"
    threads: int | None = None
    seed: int = 0
    grow: bool = False  # take along what of the object the boxes cut off

    PATHS = (
        *("scene", "cameras", "roi", "out", "images", "extra_masks", "shadow_masks"),
        *("reference_image", "views_out", "report", "summary"),
    )

    def resolved(self, folder: Path) -> RemovalJob:
        """The same job with its relative paths made absolute against `folder`."""
        return self._with_paths(lambda v: str(folder / v))

    def relative_to(self, folder: Path) -> RemovalJob:
        """The same job with paths below `folder` made relative to it, so that the folder can move."""
        root = folder.resolve()

        def shorten(value: str) -> str:
            absolute = Path(value).resolve()
            return absolute.relative_to(root).as_posix() if absolute.is_relative_to(root) else str(absolute)

        return self._with_paths(shorten)

    def _with_paths(self, change: Callable[[str], str]) -> RemovalJob:
        changed: dict[str, Any] = {}
        for name in self.PATHS:
            value = getattr(self, name)
            changed[name] = value if value in (None, "none") else change(value)
        return replace(self, **changed)


def save_job(folder: Path, job: RemovalJob) -> None:
    """Write `folder`/job.json (atomically), making the folder if needed."""
    folder.mkdir(parents=True, exist_ok=True)
    document = {"version": JOB_VERSION, **asdict(job.relative_to(folder))}
    write_atomically(folder / "job.json", lambda f: f.write(json.dumps(document, indent=1).encode()))


def load_job(folder: Path) -> RemovalJob:
    """Read a job folder; its paths come back absolute.

    Raises
    ------
    BadInput
        If the folder holds no job, or one of another version.
    """
    try:
        document = json.loads((folder / "job.json").read_text(encoding="utf-8"))
    except OSError:
        raise BadInput(f"job: {folder} holds no job.json; give SCENE, --cameras, --roi and --out") from None
    except ValueError as error:
        raise BadInput(f"job: {folder / 'job.json'} is damaged ({error}); prepare the job again") from None
    known = {f.name for f in fields(RemovalJob)}
    if not isinstance(document, dict) or document.pop("version", None) != JOB_VERSION or set(document) - known:
        raise BadInput(f"job: {folder / 'job.json'} was made by another version; prepare the job again")
    try:
        return RemovalJob(**document).resolved(folder)
    except TypeError as error:
        raise BadInput(f"job: {folder / 'job.json'} is incomplete ({error})") from None


def write_atomically(path: Path, write: Callable[[IO[bytes]], Any]) -> None:
    """Let `write(file)` fill a temporary file beside `path`, then move it there; nothing half-written stays.

    Raises
    ------
    BadInput
        If the folder cannot be written or the disk is full.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                write(file)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(name, 0o666 & ~_umask())
            os.replace(name, path)
        except BaseException:
            with suppress(OSError):
                os.unlink(name)
            raise
    except OSError as error:
        raise BadInput(f"cannot write {path} ({error.strerror})") from None


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask

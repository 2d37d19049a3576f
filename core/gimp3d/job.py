"""The job folder: everything a removal needs and everything it made, so that it can resume or move.

DIR/job.json      the RemovalJob; paths inside are relative to DIR where possible
DIR/stages/       one .npz per finished stage, with a key of its inputs
DIR/summary.json  written at the end
"""

from __future__ import annotations

import hashlib
import hmac
import json
import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from .errors import BadInput, refusing
from .files import require_file, user_secret, user_state_folder, write_atomically
from .schema import SETTING, Between, checked, kinds, parse_json

JOB_VERSION = 1
LARGEST_JOB = 1 << 20  # bytes of a job.json
MOST_RECORDS = 1000  # of jobs that this user wrote on this machine
COMMAND = "command:"
PROVIDERS = ("inpaint", "depth_prior", "refine_views")  # fields and settings that may name a program, host or model
WRITTEN = ("out", "report", "summary", "views_out")  # the paths of a job that are written
MOST_VARIANTS = 16  # as many brushes as a setting may name
SHADOWS = ("auto", "off", "mask")  # what the object's own shadow is taken for


@dataclass(frozen=True)
class RemovalJob:
    """What `gimp3d remove` was asked to do; the fields are the command line's."""

    scene: str
    cameras: str
    roi: str
    out: str
    images: str | None = None  # folder; "none": views are rendered from the scene itself
    extra_masks: str | None = None  # folder of masks that are filled too: shadows, reflections
    shadow: Literal["auto", "off", "mask"] = "auto"
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
    threads: Annotated[int, Between(1, 1024)] | None = None
    seed: Annotated[int, Between(0, 2**32 - 1)] = 0
    grow: bool = False  # take along what of the object the boxes cut off
    variants: Annotated[int, Between(1, MOST_VARIANTS)] = 1  # fills to choose from: OUT, OUT.2.ply, …

    PATHS = (
        *("scene", "cameras", "roi", "out", "images", "extra_masks", "shadow_masks"),
        *("reference_image", "views_out", "report", "summary"),
    )

    def resolved(self, folder: Path) -> RemovalJob:
        """The same job with its relative paths made absolute against `folder`."""
        return self._with_paths(lambda value: str(folder / value))

    def outs(self) -> list[Path]:
        """The scenes that are written: OUT.ply, OUT.2.ply and so on, one for each variant."""
        out = Path(self.out)
        return [out, *(out.with_suffix(f".{k}{out.suffix}") for k in range(2, self.variants + 1))]

    def relative_to(self, folder: Path) -> RemovalJob:
        """The same job with paths below `folder` made relative to it, so that the folder can move."""
        root = folder.resolve()

        def shorten(value: str) -> str:
            absolute = Path(value).resolve()
            return absolute.relative_to(root).as_posix() if absolute.is_relative_to(root) else str(absolute)

        return self._with_paths(shorten)

    def _with_paths(self, change: Callable[[str], str]) -> RemovalJob:
        named = {name: getattr(self, name) for name in self.PATHS}
        changed: dict[str, Any] = {name: change(v) for name, v in named.items() if v not in (None, "none")}
        return replace(self, **changed)


def save_job(folder: Path, job: RemovalJob) -> None:
    """Write `folder`/job.json (atomically), making the folder if needed, and remember that this user wrote it."""
    with refusing(f"job: cannot make the folder {folder}", OSError):
        folder.mkdir(parents=True, exist_ok=True)
    # The mark makes the file's content one that nobody else can have written, see _record.
    document = {"version": JOB_VERSION, "mark": secrets.token_hex(16), **asdict(job.relative_to(folder))}
    text = json.dumps(document, indent=1).encode()
    write_atomically(folder / "job.json", lambda f: f.write(text))
    with suppress(OSError):  # where there is no place for the mark, the job counts as a stranger's
        record = _record(text)
        record.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        record.touch()
        for stale in sorted(record.parent.iterdir(), key=lambda p: p.stat().st_mtime)[:-MOST_RECORDS]:
            stale.unlink()


def load_job(folder: Path, given: Mapping[str, Any] | None = None, allow_command: bool = False) -> RemovalJob:
    """Read a job folder; its paths come back absolute.

    A job from elsewhere cannot reach out of its folder: paths that lead out, and providers that are a command, a host
    or a model, count only if the user gives them again (`given`, in place of the job's fields). This user's own jobs
    may, but for commands, which the user has to know and want (`allow_command`). BadInput if the folder holds no job,
    one that is damaged or of another version, or one that reaches out.
    """
    path, given = folder / "job.json", given or {}
    with refusing(f"job: {folder} holds no job.json; give SCENE, --cameras, --roi and --out", OSError):
        text = require_file(path).read_bytes()
    try:
        document: dict[str, Any] = checked(dict[str, Any], parse_json(text, str(path), LARGEST_JOB), str(path))
    except BadInput as error:
        raise BadInput(f"job: {error}; it is damaged, prepare the job again") from None
    document.pop("mark", None)
    if document.pop("version", None) != JOB_VERSION or set(document) - set(kinds(RemovalJob)):
        raise BadInput(f"job: {path} was made by another version; prepare the job again")
    stored: RemovalJob = checked(RemovalJob, document, f"job: {path}", SETTING)
    _refuse_reaching_out(stored, folder, given, _record(text).exists())
    job = stored.resolved(folder)
    for _, value in _named_providers(job, given):
        if value.startswith(COMMAND) and not allow_command:
            raise BadInput(
                f"job: {path} wants to run {value.removeprefix(COMMAND)!r}; if you know this command and "
                "want it run, add --allow-command"
            )
    return replace(job, **given)


def _refuse_reaching_out(job: RemovalJob, folder: Path, given: Mapping[str, Any], own: bool) -> None:
    """Raise BadInput if a job names what it did not bring, and neither did the user, nor wrote it so themselves."""
    root = folder.resolve()
    written = {"stages", "summary.json", *(getattr(job, n) for n in WRITTEN if n not in given)}
    for link in (p for p in folder.rglob("*") if p.is_symlink() and not _lies_in(root, p)):  # links are not followed
        if not own or any(link.relative_to(folder).is_relative_to(w) for w in written if w):
            raise BadInput(f"job: {link} is a link that leads out of the folder; take it away")
    if own:
        return
    stranger = f"job: {folder / 'job.json'} was not written by you on this machine, and"
    for name in job.PATHS:
        value, option = getattr(job, name), "SCENE" if name == "scene" else f"--{name.replace('_', '-')}"
        if name not in given and value not in (None, "none") and not _lies_in(root, folder / value):
            raise BadInput(f"{stranger} {option} leads out of its folder, to {value}; give {option} if you want that")
    for name, value in _named_providers(job, given):
        option = f"--{name.replace('_', '-')}"
        if ":" in value and not value.startswith(COMMAND):
            raise BadInput(f"{stranger} names {option} {value}; give {option} if you want that")


def _named_providers(job: RemovalJob, given: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Those that the job names itself, as options or as settings, rather than the user."""
    for name in PROVIDERS:
        if name not in given:
            yield name, getattr(job, name) or ""
        if "set" not in given:
            yield name, job.set.get(name, "")


def _lies_in(root: Path, path: Path) -> bool:
    try:
        return path.resolve().is_relative_to(root)
    except (OSError, RuntimeError, ValueError):  # a loop of links, a name that no file can have
        return False


def _record(text: bytes) -> Path:
    """The mark that this user wrote this job.json on this machine."""
    return user_state_folder() / "jobs" / hashlib.sha256(text).hexdigest()


class StageStore:
    """Keeps each stage's result in `folder` under the key of the whole job's inputs.

    A result of another key (other scene, cameras or program version) or of other settings is ignored and overwritten,
    and so is a file that is damaged, no stage's at all, or written by anybody else: each carries a checksum that only
    this user's runs on this machine can make, as kernels trust the shapes of what stages hand on.
    """

    def __init__(self, folder: Path, key: str, resume: bool, settings: Mapping[str, Any] | None = None) -> None:
        self.folder, self.key, self.resume = folder, key, resume
        self.settings = json.loads(json.dumps(settings or {}))  # tuples as they come back
        self.secret = user_secret()

    def load(self, name: str) -> Any | None:
        """The stage's stored result, or None if there is none of this key, it is damaged or no longer understood."""
        path = self._path(name)
        if not self.resume or not path.is_file():
            return None
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {k: file[k] for k in file.files}
            document = json.loads(bytes(arrays.pop("document")).decode())
            result, fits = document["result"], (document["key"], document["settings"]) == (self.key, self.settings)
            ours = fits and hmac.compare_digest(document["checksum"], self._checksum(result, arrays))
            return self._decode(result, arrays) if ours else None
        except Exception:  # empty, damaged, somebody else's, of an older version: whatever it is, the stage runs again
            return None

    def save(self, name: str, result: Any) -> None:
        """Store a result made of dataclasses, tuples, arrays, strings, numbers and None."""
        arrays: dict[str, np.ndarray] = {}
        encoded = self._encode(result, arrays)
        document = {"key": self.key, "settings": self.settings, "result": encoded}
        document["checksum"] = self._checksum(encoded, arrays)
        arrays["document"] = np.frombuffer(json.dumps(document).encode(), dtype=np.uint8)
        write_atomically(self._path(name), lambda f: np.savez(f, **arrays))  # type: ignore[arg-type]

    def _checksum(self, encoded: Any, arrays: Mapping[str, np.ndarray]) -> str:
        digest = hmac.new(self.secret, json.dumps(encoded, sort_keys=True).encode(), "sha256")
        for name, array in sorted(arrays.items()):
            digest.update(f"{name} {array.dtype} {array.shape}".encode())
            digest.update(np.ascontiguousarray(array).data)
        return digest.hexdigest()

    def _path(self, name: str) -> Path:
        return self.folder / f"{name.replace(' ', '-')}.npz"

    def _encode(self, value: Any, arrays: dict[str, np.ndarray]) -> Any:
        if is_dataclass(value):
            members = {f.name: self._encode(getattr(value, f.name), arrays) for f in fields(value)}
            return {"kind": [type(value).__module__, type(value).__qualname__], "fields": members}
        if isinstance(value, np.ndarray):
            key = f"a{len(arrays)}"
            arrays[key] = value
            return {"array": key}
        if isinstance(value, Path):
            return {"path": str(value)}
        if isinstance(value, (tuple, list)):
            return {"tuple": [self._encode(v, arrays) for v in value]}
        if isinstance(value, np.generic):
            return value.item()
        if value is None or isinstance(value, (str, int, float, bool)):
            return value
        raise TypeError(f"a stage result holds a {type(value).__name__}, which cannot be stored")

    def _decode(self, value: Any, arrays: dict[str, np.ndarray]) -> Any:
        if not isinstance(value, dict):
            return value
        if "array" in value:
            return arrays[value["array"]]
        if "tuple" in value:
            return tuple(self._decode(v, arrays) for v in value["tuple"])
        if "path" in value:
            return Path(value["path"])
        module, name = value["kind"]  # trusted, as the checksum is right
        return getattr(import_module(module), name)(**{k: self._decode(v, arrays) for k, v in value["fields"].items()})


class SharedStages:
    """The stages that variants of one removal have in common, in memory; the others go to each variant's own store."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names, self.results = names, dict[str, Any]()
        self.own: StageStore | None = None

    def load(self, name: str) -> Any | None:
        found = self.results.get(name)
        if found is None and self.own:
            found = self.own.load(name)
        if found is not None and name in self.names:
            self.results[name] = found
        return found

    def save(self, name: str, result: Any) -> None:
        if name in self.names:
            self.results[name] = result
        if self.own:
            self.own.save(name, result)

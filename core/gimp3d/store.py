"""Finished stages on disk: dataclasses of arrays as .npz, no pickle, so that a job can be resumed anywhere."""

from __future__ import annotations

import json
import zipfile
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .job import write_atomically


class StageStore:
    """Keeps each stage's result in `folder` under the key of the whole job's inputs.

    A result of another key (other scene, cameras, settings or program version) is ignored and overwritten.
    """

    def __init__(self, folder: Path, key: str, kinds: tuple[type, ...], resume: bool) -> None:
        self.folder, self.key, self.resume = folder, key, resume
        self.kinds = {kind.__name__: kind for kind in kinds}

    def load(self, name: str) -> Any | None:
        """The stage's stored result, or None if there is none of this key, it is damaged or no longer understood."""
        path = self._path(name)
        if not self.resume or not path.exists():
            return None
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {k: file[k] for k in file.files}
            document = json.loads(bytes(arrays.pop("document")).decode())
        except (OSError, ValueError, KeyError, zipfile.BadZipFile):
            return None  # a crash in the middle of an older version's write; the stage simply runs again
        if document["key"] != self.key:
            return None
        try:
            return self._decode(document["result"], arrays)
        except (KeyError, TypeError):
            return None  # stored before a kind of result got other fields

    def save(self, name: str, result: Any) -> None:
        """Store a result made of dataclasses, tuples, arrays, strings, numbers and None."""
        arrays: dict[str, np.ndarray] = {}
        document = {"key": self.key, "result": self._encode(result, arrays)}
        arrays["document"] = np.frombuffer(json.dumps(document).encode(), dtype=np.uint8)
        write_atomically(self._path(name), lambda f: np.savez(f, **arrays))  # type: ignore[arg-type]

    def _path(self, name: str) -> Path:
        return self.folder / f"{name.replace(' ', '-')}.npz"

    def _encode(self, value: Any, arrays: dict[str, np.ndarray]) -> Any:
        if is_dataclass(value) and type(value).__name__ in self.kinds:
            members = {f.name: self._encode(getattr(value, f.name), arrays) for f in fields(value)}
            return {"kind": type(value).__name__, "fields": members}
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
        members = {k: self._decode(v, arrays) for k, v in value["fields"].items()}
        return self.kinds[value["kind"]](**members)

"""Finished stages on disk: dataclasses of arrays as .npz, no pickle, so that a job can be resumed anywhere."""

from __future__ import annotations

import hmac
import json
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from .files import user_secret, write_atomically


class StageStore:
    """Keeps each stage's result in `folder` under the key of the whole job's inputs.

    A result of another key (other scene, cameras or program version) or of other settings is ignored and overwritten,
    and so is a file that is damaged, no stage's at all, or written by anybody else: each carries a checksum that only
    this user's runs on this machine can make, as kernels trust the shapes of what stages hand on.
    """

    def __init__(
        self,
        folder: Path,
        key: str,
        resume: bool,
        settings: Mapping[str, Any] | None = None,  # of the whole removal, as plain values
    ) -> None:
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
            if document["key"] != self.key or document["settings"] != self.settings:
                return None
            if not hmac.compare_digest(document["checksum"], self._checksum(document["result"], arrays)):
                return None
            return self._decode(document["result"], arrays)
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
        if name not in self.results and self.own and (found := self.own.load(name)) is not None:
            self._keep(name, found)
            return found
        return self.results.get(name)

    def save(self, name: str, result: Any) -> None:
        self._keep(name, result)
        if self.own:
            self.own.save(name, result)

    def _keep(self, name: str, result: Any) -> None:
        if name in self.names:
            self.results[name] = result

"""A run of `gimp3d remove` on a made scene, and what must hold of it; the fixture `remove` (conftest.py) makes one."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scenes import cameras

from gimp3d.camera import Camera
from gimp3d.gaussians import SH_C0, Gaussians
from gimp3d.io.ply import SplatFile, read_ply
from gimp3d.pipeline import render_bytes

RED = np.array([0.85, 0.12, 0.1])  # the block's colour, which no fill may have


@dataclass(frozen=True)
class Removal:
    """What `gimp3d remove` did."""

    folder: Path
    code: int
    errors: list[str]  # lines on stderr

    @property
    def summary(self) -> dict[str, Any]:
        return json.loads((self.folder / "summary.json").read_text())

    @property
    def before(self) -> SplatFile:
        return read_ply(self.folder / "scene.ply")

    @property
    def after(self) -> SplatFile:
        return read_ply(self.folder / "out.ply")

    @property
    def added(self) -> Gaussians:
        count = self.summary["counts"]["added"]
        return self.after.gaussians.take(np.arange(len(self.after.gaussians))[-count or len(self.after.gaussians) :])

    def stage(self, name: str) -> dict[str, Any]:
        return next(s for s in self.summary["stages"] if s["name"] == name)

    @property
    def words(self) -> str:
        """All that it said."""
        return " | ".join([*self.summary["warnings"], *(s["reason"] for s in self.summary["stages"])])


Remove = Callable[..., Removal]


def command(folder: Path, options: Sequence[object]) -> list[object]:
    cams, roi, out = folder / "cameras.json", folder / "roi.json", folder / "out.ply"
    files = ["remove", folder / "scene.ply", "--cameras", cams, "--roi", roi, "--out", out]
    return [*files, "--summary", folder / "summary.json", "--progress", "none", *options]


def assert_refused(removal: Removal, words: str, code: int = 3) -> None:
    """One line that says why, and no output."""
    assert removal.code == code
    assert len(removal.errors) == 1 and removal.errors[0].startswith("gimp3d: error: "), removal.errors
    assert words in removal.errors[0]
    assert not (removal.folder / "out.ply").exists() and not (removal.folder / "summary.json").exists()


def assert_filled(removal: Removal, true: Gaussians, views: Sequence[Camera] = (), psnr: float = 36.0) -> None:
    """Nearly the true picture, from the views of the command line's own test unless others are given."""
    assert removal.code == 0, removal.errors
    result = removal.after.gaussians
    for camera in views or cameras(4):
        error = render_bytes(result, camera).astype(float) - render_bytes(true, camera)
        found = 10 * np.log10(255**2 / (error**2).mean())
        assert found > psnr, (camera.id, found)


def assert_legal(removal: Removal) -> None:
    """New Gaussians can be drawn, and none has the object's colour."""
    assert removal.code == 0, removal.errors
    added = removal.added
    assert len(added) > 0 and added.usable.all() and np.isfinite(added.opacity_logits).all()
    assert (np.abs(0.5 + SH_C0 * added.sh[:, 0] - RED).max(1) > 0.1).all()

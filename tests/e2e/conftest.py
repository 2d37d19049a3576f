"""The fixture that runs the command on a made scene."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from removals import Removal, Remove, command
from scenes import REGION, cameras, scene

from gimp3d.box import Region
from gimp3d.camera import Camera
from gimp3d.cli import main
from gimp3d.gaussians import Gaussians
from gimp3d.io.cameras import write_transforms
from gimp3d.io.images import write_png
from gimp3d.io.ply import write_gaussians


@pytest.fixture
def remove(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Remove:
    """Writes a scene's files, changes them where the test wants to, and runs the command."""

    def run(
        gaussians: Gaussians | None = None,
        views: Sequence[Camera] = (),
        region: Region = REGION,
        options: Sequence[object] = (),
        photo: Callable[[Camera], np.ndarray] | None = None,  # None: views are rendered from the scene
        change: Callable[[Path], None] = lambda folder: None,
        folder: str = "scene",
    ) -> Removal:
        place = tmp_path / folder
        place.mkdir(exist_ok=True)
        write_gaussians(place / "scene.ply", scene() if gaussians is None else gaussians)
        write_transforms(place / "cameras.json", views or cameras())
        (place / "roi.json").write_text(json.dumps([b.to_json() for b in region]))
        if photo:
            for camera in views or cameras():
                write_png(place / f"{camera.id}.png", photo(camera))
        change(place)
        capsys.readouterr()
        options = options if photo else ("--images", "none", *options)
        code = main([str(a) for a in command(place, options)])
        return Removal(place, code, capsys.readouterr().err.strip().splitlines())

    return run

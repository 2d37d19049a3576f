"""Every script in the user guide runs as it stands, and every picture and operator that it names exists."""

from __future__ import annotations

import re
from pathlib import Path

import bpy
import pytest
from scenes import cameras, scene

from gimp3d.io.cameras import write_transforms
from gimp3d.io.ply import write_gaussians
from gimp3d_addon.chosen import current_splat
from gimp3d_addon.operators.remove import SOURCE

DOCS = Path(__file__).resolve().parents[2] / "docs"
GUIDE = (DOCS / "blender.md").read_text(encoding="utf-8")
SCRIPTS = re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL)


@pytest.mark.parametrize("script", SCRIPTS, ids=range(len(SCRIPTS)))
def test_the_guides_scripts_run(script: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_gaussians(tmp_path / "scene.ply", scene())
    write_transforms(tmp_path / "transforms.json", cameras())
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work.blend"), check_existing=False)
    monkeypatch.chdir(tmp_path)
    exec(compile(script, "docs/blender.md", "exec"), {})
    assert current_splat(bpy.context)[SOURCE].name == "scene"


def test_the_guides_pictures_exist() -> None:
    pictures = re.findall(r"\]\((pictures/[^)]+)\)", GUIDE)
    assert len(pictures) >= 5 and all((DOCS / p).is_file() for p in pictures)

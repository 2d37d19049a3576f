"""--shadow from the shell: what is found is told, wrong use is one line, a resumed run says the same."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from lit_scenes import Lamp, make_scene
from scenes import floor_colours

from gimp3d.camera import output_name
from gimp3d.cli import main
from gimp3d.io.cameras import write_transforms
from gimp3d.io.images import read_image, write_png
from gimp3d.io.ply import read_ply, write_gaussians
from gimp3d.pipeline import render_bytes

LAMP = Lamp(40, 110, 3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The block in the sun, as files; views are drawn from the scene."""
    made, root = make_scene("sun", [LAMP], floor_colours), tmp_path_factory.mktemp("sun")
    write_gaussians(root / "scene.ply", made.gaussians)
    write_transforms(root / "cams.json", made.cameras(12, 160, 120))
    (root / "roi.json").write_text(json.dumps([box.to_json() for box in made.region]))
    return root


def run(folder: Path, out: Path, *more: str) -> int:
    words = ["--cameras", str(folder / "cams.json"), "--roi", str(folder / "roi.json"), "--images", "none"]
    return main(["remove", str(folder / "scene.ply"), *words, "--out", str(out), "--progress", "none", *more])


def test_the_summary_tells_of_the_light_and_a_resumed_run_does_the_same(folder: Path, tmp_path: Path) -> None:
    options = ["--preset", "draft", "--job", str(tmp_path / "job"), "--summary", str(tmp_path / "s.json")]
    assert run(folder, tmp_path / "a.ply", *options, "--report", str(tmp_path / "report")) == 0
    summary = json.loads((tmp_path / "s.json").read_text())
    shadow = summary["shadow"]
    assert shadow["found"] and 0 < shadow["explained"] <= 1 and 0 < shadow["confidence"] < 1
    light = shadow["lights"][0]
    assert abs(light["elevation"] - LAMP.elevation) < 10 and abs(light["azimuth"] - LAMP.azimuth) < 12
    assert light["softness"] > 0 and np.dot(light["direction"], LAMP.direction) > np.cos(np.radians(10))
    counts = summary["counts"]
    assert counts["lifted"] > 100
    assert counts["gaussians_out"] == counts["gaussians_in"] - counts["removed"] + counts["added"]
    assert {"surfaces", "light", "lift", "charts"} <= {s["name"] for s in summary["stages"]}
    assert "object&#x27;s shadow in" in (tmp_path / "report" / "index.html").read_text()
    assert run(folder, tmp_path / "b.ply", *options, "--resume") == 0
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_off_leaves_every_colour(folder: Path, tmp_path: Path) -> None:
    summary = tmp_path / "s.json"
    assert run(folder, tmp_path / "o.ply", "--preset", "draft", "--shadow", "off", "--summary", str(summary)) == 0
    found = json.loads(summary.read_text())
    assert not found["shadow"]["found"] and found["counts"]["lifted"] == 0
    before, after = (read_ply(p).gaussians for p in (folder / "scene.ply", tmp_path / "o.ply"))
    kept = len(before) - found["counts"]["removed"]
    known = {m.tobytes(): k for k, m in enumerate(before.means)}
    rows = [known[m.tobytes()] for m in after.means[:kept]]
    np.testing.assert_array_equal(after.sh[:kept], before.sh[rows])


def test_masks_show_the_shadow_too(folder: Path, tmp_path: Path) -> None:
    words = ["--cameras", str(folder / "cams.json"), "--roi", str(folder / "roi.json"), "--images", "none"]
    options = ["--out", str(tmp_path / "m"), "--pictures", str(tmp_path / "p"), "--progress", "none"]
    assert main(["masks", str(folder / "scene.ply"), *words, *options]) == 0
    assert json.loads((tmp_path / "p" / "light.json").read_text())["shadow"]["found"]
    picture = read_image(next((tmp_path / "p").rglob("*.shadow.png")))
    assert picture.shape == (120, 3 * 160, 3)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--shadow", "mask"], "go together"),
        (["--shadow-masks", "{}"], "go together"),
        (["--shadow", "mask", "--shadow-masks", "{}"], "holds no mask"),
        (["--shadow", "mask", "--shadow-masks", "{}", "--preset", "paper"], "another preset"),
        (["--shadow", "maybe"], "invalid choice"),
    ],
)
def test_wrong_use_is_one_line(
    options: list[str], words: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(folder, tmp_path / "o.ply", *(o.format(tmp_path) for o in options)) == 2
    error = capsys.readouterr().err.strip()
    assert error.startswith("gimp3d: error:") and words in error and "\n" not in error
    assert not (tmp_path / "o.ply").exists()


def test_a_marked_shadow_is_lifted(folder: Path, tmp_path: Path) -> None:
    lit = make_scene("sun", [LAMP], floor_colours)
    for camera in lit.cameras(12, 160, 120):
        dark = render_bytes(lit.gaussians, camera).mean(-1) < 0.9 * render_bytes(lit.truth, camera).mean(-1)
        write_png(tmp_path / "marks" / f"{output_name(camera.id)}.png", dark)
    options = ["--preset", "draft", "--shadow", "mask", "--shadow-masks", str(tmp_path / "marks")]
    assert run(folder, tmp_path / "o.ply", *options, "--summary", str(tmp_path / "s.json")) == 0
    shadow = json.loads((tmp_path / "s.json").read_text())["shadow"]
    assert shadow["found"] and shadow["lights"] == []

"""A scene in other units, elsewhere or turned gives the same removal: every length follows the scene."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scenes import BLOCK, REGION, block, cameras, floor

from gimp3d.box import Box, Region
from gimp3d.camera import Camera
from gimp3d.cli import main
from gimp3d.gaussians import Gaussians, matrices_to_quats, quats_to_matrices
from gimp3d.io.cameras import write_transforms
from gimp3d.io.images import read_image, write_png
from gimp3d.io.ply import SplatFile, file_of, new_rows, write_ply
from gimp3d.pipeline import render_bytes

SIZE = 3.2  # of the scene
ALIKE = 0.05  # dB
# dB with the built-in fill: it chooses between patches that are nearly alike, and where rounding makes a texel known or
# unknown it chooses others. Units that are powers of two round nothing.
ALIKE_BUILT_IN = 0.2
VIEWS = cameras(5, 240, 180)
Homes = Callable[[str, "Moved"], tuple[Path, float]]


def roughened(g: Gaussians, seed: int) -> Gaussians:
    """Splats off their grid, of many colours, as a scan's are: in one that is too regular, last bits break ties."""
    rng = np.random.default_rng(seed)
    means, sizes, sh = (
        (values + spread * rng.normal(size=values.shape)).astype(np.float32)
        for values, spread in ((g.means, 2e-3), (g.log_scales, 0.02), (g.sh, 0.15))
    )
    return replace(g, means=means, log_scales=sizes, sh=sh)


TRUTH = roughened(floor(with_hole=False), 0)
HIDDEN = (np.abs(floor(with_hole=False).means[:, :2]) <= BLOCK / 2).all(1)
SCENE = TRUTH.take(~HIDDEN).extended(roughened(block(), 1))


@dataclass(frozen=True)
class Moved:
    """Points p become scale · R p + shift."""

    scale: float = 1.0
    shift: float = 0.0  # sizes of the scaled scene, along an oblique axis
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    degrees: float = 0.0
    double: bool = False  # positions are doubles in the file

    @property
    def name(self) -> str:
        return f"x{self.scale:g} +{self.shift:g} {self.degrees:g}deg{' double' if self.double else ''}"

    @property
    def turn(self) -> np.ndarray:
        half, axis = np.radians(self.degrees) / 2, np.array(self.axis) / np.linalg.norm(self.axis)
        return quats_to_matrices(np.array([[np.cos(half), *np.sin(half) * axis]]))[0]

    @property
    def offset(self) -> np.ndarray:
        return self.shift * SIZE * self.scale * np.array([0.6, -0.48, 0.64])

    def points(self, points: np.ndarray) -> np.ndarray:
        return self.scale * points.astype(np.float64) @ self.turn.T + self.offset

    def gaussians(self, g: Gaussians) -> Gaussians:
        quats = matrices_to_quats(self.turn @ quats_to_matrices(g.quats.astype(np.float64)))
        sizes = (g.log_scales + np.log(self.scale)).astype(np.float32)
        return replace(g, means=self.points(g.means), log_scales=sizes, quats=quats.astype(np.float32))

    def region(self, region: Region) -> Region:
        return tuple(
            Box.make(self.points(b.center), b.size * self.scale, matrices_to_quats((self.turn @ b.axes)[None])[0])
            for b in region
        )

    def camera(self, camera: Camera) -> Camera:
        viewmat = np.eye(4)
        viewmat[:3, :3] = camera.R @ self.turn.T
        viewmat[:3, 3] = self.scale * camera.t - viewmat[:3, :3] @ self.offset
        return replace(camera, viewmat=viewmat)

    def back(self, points: np.ndarray) -> np.ndarray:
        return (points - self.offset) @ self.turn / self.scale


def as_file(gaussians: Gaussians, double: bool) -> SplatFile:
    file = file_of(replace(gaussians, means=gaussians.means.astype(np.float32)))
    properties = {n: "double" if double and n in "xyz" else "float" for n in file.table.properties}
    header = tuple(
        h.replace("float", "double")
        if double and h in ("property float x", "property float y", "property float z")
        else h
        for h in file.table.header
    )
    table = replace(file.table, header=header, properties=properties)
    rows = new_rows(table, gaussians)
    return SplatFile(gaussians, replace(table, rows=rows.view(f"V{rows.dtype.itemsize}")))


def write_scene(folder: Path, moved: Moved, gaussians: Gaussians) -> None:
    """The scene as a file holds it, its views, region and photos."""
    folder.mkdir()
    file = as_file(moved.gaussians(gaussians), moved.double)
    write_ply(folder / "scene.ply", file, np.ones(len(gaussians), bool))
    write_transforms(folder / "cameras.json", [moved.camera(c) for c in VIEWS])
    (folder / "roi.json").write_text(json.dumps([b.to_json() for b in moved.region(REGION)]))


def as_held(moved: Moved, gaussians: Gaussians) -> Gaussians:
    """The scene at home with the digits that a shift leaves in its file: their loss is not the program's fault."""
    if moved.double or not moved.shift:
        return gaussians
    stored = moved.points(gaussians.means).astype(np.float32).astype(np.float64)
    return replace(gaussians, means=moved.back(stored).astype(np.float32))


def score(folder: Path, moved: Moved, gaussians: Gaussians, fill: str) -> float:
    """PSNR of the filled views against the true ones, dB."""
    write_scene(folder, moved, gaussians)
    files = [str(folder / "scene.ply"), "--cameras", str(folder / "cameras.json")]
    for camera in VIEWS:
        write_png(folder / f"{camera.id}.png", render_bytes(SCENE, camera))
    options = [
        "--roi",
        str(folder / "roi.json"),
        "--out",
        str(folder / "out.ply"),
        "--views-out",
        str(folder / "views"),
        "--preset",
        "draft",
        "--inpaint",
        fill,
    ]
    assert main(["remove", *files, *options, "--progress", "none"]) == 0
    files[0] = str(folder / "out.ply")
    assert main(["render", *files, "--out", str(folder / "drawn"), "--progress", "none", "--passes", "rgb,depth"]) == 0
    errors = []
    for camera in VIEWS:
        drawn = read_image(folder / "drawn" / f"{camera.id}.png").astype(float)
        errors.append(((drawn - render_bytes(TRUTH, camera)) ** 2).mean())
    depth = np.load(folder / "drawn" / f"{VIEWS[0].id}.depth.npy")
    assert 1 < np.median(depth[depth > 0]) / moved.scale < 5
    return float(10 * np.log10(255**2 / np.mean(errors)))


@pytest.fixture(scope="module")
def homes(tmp_path_factory: pytest.TempPathFactory) -> Homes:
    """Folder and score of the removal at home, for a fill and what a file holds of the scene; made when asked for."""

    @cache
    def made(fill: str, shifted: Moved | None) -> tuple[Path, float]:
        folder = tmp_path_factory.mktemp("home") / "home"
        return folder, score(folder, Moved(), as_held(shifted or Moved(), SCENE), fill)

    return lambda fill, moved: made(fill, moved if moved.shift and not moved.double else None)


def assert_alike(homes: Homes, folder: Path, moved: Moved, fill: str = "telea", most: float = ALIKE) -> None:
    assert abs(score(folder, moved, SCENE, fill) - homes(fill, moved)[1]) <= most


SCALES = [Moved(scale=10.0**k) for k in range(-6, 7) if k]
SHIFTS = [Moved(shift=s) for s in (10, 1e3, 1e4)] + [Moved(shift=1e5, double=True)]
TURNS = [Moved(axis=a, degrees=d) for a, d in (((0, 0, 1), 45), ((1, 2, 3), 77), ((1, 0, 0), 180), ((-1, 1, 0.3), 123))]
MIXED = [Moved(1e-5, 1e3, (1, 2, 3), 50), Moved(1e5, 1e5, (3, 1, 0), 200, True)]

BUILT_IN = [*SCALES[::3], SHIFTS[2], TURNS[1], *MIXED]


@pytest.mark.slow
@pytest.mark.parametrize("moved", [*SCALES, *SHIFTS, *TURNS, *MIXED], ids=lambda m: m.name)
def test_a_moved_scene_gives_the_same_picture(moved: Moved, homes: Homes, tmp_path: Path) -> None:
    assert_alike(homes, tmp_path / "moved", moved)


@pytest.mark.slow
@pytest.mark.parametrize("moved", BUILT_IN, ids=lambda m: m.name)
def test_a_moved_scene_gives_nearly_the_same_picture_with_the_built_in_fill(
    moved: Moved, homes: Homes, tmp_path: Path
) -> None:
    assert_alike(homes, tmp_path / "moved", moved, "exemplar", ALIKE_BUILT_IN)


@pytest.mark.slow
@pytest.mark.parametrize("power", [-20, -10, 11, 20])
def test_units_that_are_a_power_of_two_apart_give_the_same_fill(power: int, homes: Homes, tmp_path: Path) -> None:
    moved = Moved(2.0**power)
    assert_alike(homes, tmp_path / "moved", moved, "exemplar")
    home, there = (f / "views" / "charts" / "1.png" for f in (homes("exemplar", moved)[0], tmp_path / "moved"))
    assert home.read_bytes() == there.read_bytes()


def test_tiny_units_far_away_give_the_same_picture(homes: Homes, tmp_path: Path) -> None:
    """The slice of the matrix that CI runs."""
    assert_alike(homes, tmp_path / "moved", Moved(1e-4, 1e5, double=True))

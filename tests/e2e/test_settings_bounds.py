"""A removal with any one setting at its bounds is done or refused: no traceback, no hang."""

from __future__ import annotations

import json
import math
import signal
import typing
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from scenes import REGION, cameras, scene

from gimp3d.cli import main
from gimp3d.io.cameras import write_transforms
from gimp3d.io.ply import write_gaussians
from gimp3d.pipeline import RemovalSettings
from gimp3d.schema import SETTING, Between, kinds

LONGEST = 120  # seconds of a removal of 3 views of 60 × 45 pixels, on a busy machine
LARGE = 1e9  # where there is no upper bound


def bounds(settings: Any = RemovalSettings(), prefix: str = "") -> Iterator[tuple[str, str]]:
    """Every number among the settings with its least and greatest value, as --set takes them."""
    for field in fields(settings):
        value, kind = getattr(settings, field.name), kinds(type(settings))[field.name]
        if is_dataclass(value):
            yield from bounds(value, f"{prefix}{field.name}.")
            continue
        limits = [a for a in (kind, *typing.get_args(kind)) if isinstance(a, Between)]
        limits += [a for k in typing.get_args(kind) for a in typing.get_args(k) if isinstance(a, Between)]
        plain = int if kind is int or int in typing.get_args(kind) else float
        if isinstance(value, bool | str | tuple) or (
            value is None and not limits and float not in typing.get_args(kind)
        ):
            continue
        limit = limits[0] if limits else SETTING[plain]
        for end in (limit.low, limit.high):
            clipped = end if math.isfinite(end) else math.copysign(LARGE, end)
            yield f"{prefix}{field.name}", str(int(clipped) if plain is int else clipped)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bounds")
    write_gaussians(folder / "scene.ply", scene())
    write_transforms(folder / "cameras.json", [replace(c, id=f"{k}") for k, c in enumerate(cameras(3, 60, 45))])
    (folder / "roi.json").write_text(json.dumps(REGION[0].to_json()))
    return folder


def cases() -> Iterator[Any]:
    for key, value in bounds():
        yield pytest.param(key, value, id=f"{key}={value}")


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGALRM"), reason="no alarm clock on this system")
@pytest.mark.parametrize(("key", "value"), list(cases()))
def test_a_setting_at_its_bound_is_done_or_refused(
    key: str, value: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def too_long(*_: object) -> None:
        raise KeyboardInterrupt

    files = ["scene.ply", "--cameras", "cameras.json", "--roi", "roi.json", "--out", "out.ply"]
    options = [str(folder / f) if "." in f else f for f in files]
    before = signal.signal(signal.SIGALRM, too_long)
    signal.alarm(LONGEST)
    try:
        refine = () if key.startswith("refine.steps") else ("--set", f"refine.steps={2 if 'refine' in key else 0}")
        steps = "3" if key == "refine.steps" and int(value) > 3 else value  # as many as it takes, that is
        code = main(
            [
                "remove",
                *options,
                "--images",
                "none",
                "--progress",
                "none",
                "--preset",
                "draft",
                *refine,
                "--set",
                f"{key}={steps}",
            ]
        )
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    assert code in (0, 2, 3), capsys.readouterr().err

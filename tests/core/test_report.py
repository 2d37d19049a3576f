"""The report page: complete, self-contained, and safe to open."""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from scenes import REGION, cameras, scene

from gimp3d.io.images import read_image
from gimp3d.pictures import PLOT_HIGH, PLOT_LOW, FitAxes, by_rule, fit_plot, offset_colours, outlined, relief, tinted
from gimp3d.pipeline import RemovalSettings, View, remove_object, render_bytes
from gimp3d.report import write_removal_report
from gimp3d.stages.propagate import Rule

IMAGE = np.full((20, 30, 3), 90, np.uint8)
HERE = np.zeros((20, 30), bool)
HERE[5:12, 8:20] = True


def test_the_page_shows_every_picture_and_escapes_names(tmp_path: Path) -> None:
    views = [View(c, render_bytes(scene(), c)) for c in cameras(4)]
    result = remove_object(scene(), views, REGION, RemovalSettings(charts=None, extra_references=0))
    summary = {
        "version": "0",
        "seconds_total": 1.0,
        "peak_memory_mb": 10.0,
        "stages": [
            {"name": s.name, "seconds": s.seconds, "confidence": s.confidence, "reason": "<b>"} for s in result.stages
        ],
        "counts": {"removed": 5, "added": 6, "changed": 2},
        "verdict": asdict(result.verdict) | {"words": ["fair", "<u>enlarge</u>"], "haze": None},
        "settings": {"inpaint": "file:<x>"},
        "warnings": ["<script>alert(1)</script>"],
    }
    page = write_removal_report(tmp_path, scene(), views, (result,), summary).read_text()
    pictures = re.findall(r"src='([^']+)'", page)
    assert len(pictures) >= 2 * 4 + 6 and len(set(pictures)) == len(pictures)
    for name in pictures:
        assert read_image(tmp_path / name).size > 0
    assert "<script" not in page and "&lt;script&gt;" in page and "&lt;b&gt;" in page and "file:&lt;x&gt;" in page
    assert result.verdict and f"<b>{result.verdict.score:.2f}</b>fair" in page and "<li>&lt;u&gt;enlarge" in page
    assert "open share" in page and "haze" not in page
    choice = result.references[0]
    assert f"<b>{choice.camera_id}" in page and f"{choice.scores[0].score:.2f}" in page
    book = re.findall(r"<figure( hidden)?><img src='(view_\d+\.png)'", page)
    assert [hidden for hidden, _ in book] == ["", *[" hidden"] * (len(result.painted) - 1)]
    for (_, name), painted in zip(book, result.painted.values(), strict=True):
        np.testing.assert_array_equal(read_image(tmp_path / name), painted)
    assert not re.search(r"(src|href)='(https?:|//)", page)


@pytest.mark.parametrize(
    "drawn",
    [
        tinted(IMAGE, HERE),
        relief(np.where(HERE, 0, 2.0), HERE),
        relief(np.zeros((20, 30)), HERE),
        outlined(IMAGE, HERE),
        offset_colours(IMAGE, np.where(HERE, 3, -1), np.where(HERE, 4, -1)),
        offset_colours(IMAGE, np.full((20, 30), -1), np.full((20, 30), -1)),
        by_rule(IMAGE, np.where(HERE, Rule.OWN_PIXELS, Rule.UNTOUCHED), IMAGE),
    ],
)
def test_every_kind_of_picture_is_drawn(drawn: np.ndarray) -> None:
    assert drawn.dtype == np.uint8 and drawn.shape[0] == 20 and drawn.shape[2] == 3
    assert (drawn[:, :30] != IMAGE).any() or (drawn[:, -30:] != IMAGE).any()


@pytest.mark.parametrize("slope", [0.4, 3.0, -1.0])
@pytest.mark.parametrize("tilt", [1.0, 0.5])
def test_a_plot_shows_the_line_that_was_fitted_among_the_dots(slope: float, tilt: float) -> None:
    prior = 7 + np.random.default_rng(0).normal(size=800)
    disparity = slope * prior + 2 + 0.1 * abs(slope) * np.random.default_rng(1).normal(size=800)
    ring, line = np.stack([prior, disparity], -1), (tilt * slope, 2 + (1 - tilt) * slope * 7)
    axes = FitAxes.around(ring)
    dots, (start, end) = axes.place(ring), axes.line(line)
    assert ((dots > PLOT_LOW) & (dots < PLOT_HIGH)).all(1).mean() > 0.95
    of_dots, of_line = np.polyfit(*dots.T, 1), np.polyfit(*np.stack([start, end]).T, 1)
    assert of_line[0] / of_dots[0] == pytest.approx(tilt, abs=0.05)
    middle = axes.place(np.array([7.0, 7 * slope + 2]))  # where the two cross
    assert np.polyval(of_line, middle[0]) == pytest.approx(middle[1], abs=0.1)
    assert np.polyval(of_dots, middle[0]) == pytest.approx(middle[1], abs=8)
    drawn = fit_plot(ring, line, 0.9 * slope)
    assert all((drawn == colour).all(-1).sum() > 300 for colour in ((198, 81, 2), (94, 85, 163)))


def test_a_fit_of_a_constant_prior_is_drawn() -> None:
    drawn = fit_plot(np.full((40, 2), 3.0), (0.0, 0.0), 0.0)
    rows, cols = np.nonzero((drawn == (94, 85, 163)).all(-1))
    assert len(rows) and np.ptp(rows) < 20 and np.ptp(cols) < 20  # all pairs are one dot

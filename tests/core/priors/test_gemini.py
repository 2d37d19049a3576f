"""Gemini by Google's own client, against a stand-in on this machine that speaks generateContent."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np
import pytest
from pictures import disc, error, holed, inner, refuse, scenery
from stand_ins import COLOUR, Gemini, serving

from gimp3d.errors import Cancelled
from gimp3d.priors.calls import Call
from gimp3d.priors.gemini import SIZES, padded_to
from gimp3d.priors.inpaint import check_provider, inpaint_reference

ONLINE = Call(allow_network=True)


@pytest.fixture
def google(monkeypatch: pytest.MonkeyPatch) -> Iterator[Gemini]:
    """A stand-in where Google's client looks for Google, and a key."""
    pytest.importorskip("google.genai", reason="the optional extra gemini is not installed")
    monkeypatch.delenv("GOOGLE_API_KEY", raising=False)
    monkeypatch.setenv("GEMINI_API_KEY", "the-key")
    with serving(Gemini()) as server:
        monkeypatch.setenv("GOOGLE_GEMINI_BASE_URL", server.url)
        yield server


@pytest.mark.parametrize("spec", ["gemini", "gemini:gemini-3-pro-image-preview"])
@pytest.mark.parametrize("size", [(120, 160), (300, 131)])
def test_gemini_paints_the_hole(google: Gemini, spec: str, size: tuple[int, int]) -> None:
    picture, hole = scenery(*size), disc(*size)
    call = Call(allow_network=True, prompt="a wooden floor")
    done = inpaint_reference(spec, holed(picture, hole), hole, 2**32 - 1, call=call)
    assert np.abs(done.image[inner(hole, 5)].astype(int) - COLOUR).max() <= 12  # it was resampled there and back
    assert (done.image[~hole] == picture[~hole]).all()
    assert google.model == (spec.partition(":")[2] or "gemini-2.5-flash-image")
    config = google.request["generationConfig"]
    assert config["responseModalities"] == ["IMAGE"] and config["seed"] == 2**31 - 1
    assert set(config["imageConfig"].values()) <= set(SIZES)  # aspectRatio, or aspect_ratio of older clients
    assert "shows: a wooden floor" in google.request["contents"][0]["parts"][2]["text"]
    assert len(google.asked) == 1


def test_a_picture_that_comes_back_shifted_is_registered(google: Gemini) -> None:
    google.shift = 16
    picture, hole = scenery(240, 320), disc(240, 320, 30)
    done = inpaint_reference("gemini", holed(picture, hole), hole, call=ONLINE)
    assert "shifted" in done.reason
    assert error(done.image, np.full_like(picture, COLOUR), inner(hole, 6)) < 12


def test_what_stood_in_the_hole_is_not_sent(google: Gemini) -> None:
    picture, hole = scenery(), disc()
    sent = []
    for base in (picture, holed(picture, hole)):
        inpaint_reference("gemini", base, hole, call=ONLINE)
        sent.append(google.request)
    assert sent[0] == sent[1]


def test_a_busy_server_is_asked_again(google: Gemini, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gimp3d.priors.gemini.PAUSE", 0.01)
    google.mode = "busy"
    done = inpaint_reference("gemini", scenery(), disc(), call=ONLINE)
    assert len(google.asked) == 3 and done.confidence > 0.5


@pytest.mark.parametrize(
    ("mode", "words"),
    [
        ("no key", "Google refused .400 INVALID_ARGUMENT.: API key not valid"),
        ("refuses", "answers without a picture .IMAGE_SAFETY"),
        ("idle", "left the hole as it was; try another --seed or --set prompt="),
        ("tall", "answers with 400×1000 pixels, not the shape"),
    ],
)
def test_geminis_refusals_are_told(google: Gemini, mode: str, words: str) -> None:
    google.mode = mode
    assert "the-key" not in refuse(words, "gemini", scenery(), disc(), ONLINE)


def test_gemini_has_a_time_limit_and_can_be_cancelled(google: Gemini) -> None:
    google.mode = "hangs"
    refuse("was not done after 0.3 s", "gemini", scenery(), disc(), Call(seconds=0.3, allow_network=True))

    def cancel(stage: str, done: int, total: int, message: str = "") -> None:
        if "paints" in message:
            raise Cancelled(message)

    with pytest.raises(Cancelled):
        inpaint_reference("gemini", scenery(), disc(), call=Call(progress=cancel, allow_network=True))


def test_a_server_that_is_not_there_is_told(google: Gemini, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gimp3d.priors.gemini.ATTEMPTS", 1)
    with serving(Gemini()) as gone:
        monkeypatch.setenv("GOOGLE_GEMINI_BASE_URL", gone.url)
    refuse("cannot reach Google", "gemini", scenery(), disc(), ONLINE)


def test_what_it_costs_is_said_before(google: Gemini) -> None:
    said: list[str] = []

    def progress(stage: str, done: int, total: int, message: str = "") -> None:
        said.append(f"{message} ({len(google.asked)} asked)")

    notice = check_provider("gemini", ONLINE)
    assert notice.startswith("pictures of the scene are sent to Google's gemini-2.5-flash-image, ")
    assert notice.endswith("one or two a removal, about $0.04 each")
    assert "its price in Google's list" in check_provider("gemini:another", ONLINE)
    inpaint_reference("gemini", scenery(), disc(), call=Call(progress=progress, allow_network=True))
    assert said[0] == f"{notice} (0 asked)"


# Before anything is installed or asked


def test_gemini_is_asked_only_when_that_is_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GEMINI_API_KEY", "the-key")
    said = refuse(
        "sends pictures of the scene to Google and costs money; .*--allow-network", "gemini", scenery(), disc()
    )
    assert "the-key" not in said


def test_without_a_key_or_the_client_the_error_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("GEMINI_API_KEY", "GOOGLE_API_KEY"):
        monkeypatch.delenv(name, raising=False)
    refuse("there is no key; set GEMINI_API_KEY or GOOGLE_API_KEY", "gemini", scenery(), disc(), ONLINE)
    monkeypatch.setenv("GOOGLE_API_KEY", "the-key")
    monkeypatch.setitem(sys.modules, "google.genai", None)
    refuse(r"needs Google's client.*pip install 'gimp3d\[gemini\]'", "gemini", scenery(), disc(), ONLINE)


@pytest.mark.parametrize("size", [(1, 1), (160, 120), (1920, 1080), (300, 2000), (5000, 100)])
def test_pictures_are_padded_to_a_shape_that_can_be_asked_for(size: tuple[int, int]) -> None:
    aspect, (top, bottom, left, right) = padded_to(*size)
    wide, high = size[0] + left + right, size[1] + top + bottom
    assert abs(np.log(wide / high / (SIZES[aspect][0] / SIZES[aspect][1]))) < 0.02 or size == (1, 1)
    assert min(top, bottom, left, right) >= 0 and not ((top or bottom) and (left or right))

"""ComfyUI and A1111 servers: stand-ins on this machine speak their protocols; no model is behind them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pictures import disc, holed, inner, refuse, scenery
from stand_ins import COLOUR, Automatic, Comfy, Handler, StandIn, serving

from gimp3d.errors import BadInput, Cancelled
from gimp3d.io.images import decode_image
from gimp3d.priors.calls import Call
from gimp3d.priors.inpaint import check_provider, inpaint_reference
from gimp3d.priors.servers import filled, is_local, painted_size


@pytest.fixture
def comfy() -> Iterator[Comfy]:
    with serving(Comfy()) as server:
        yield server


@pytest.fixture
def automatic() -> Iterator[Automatic]:
    with serving(Automatic()) as server:
        yield server


def paints_the_hole(spec: str, call: Call = Call(), seed: int = 0) -> None:
    picture, hole = scenery(), disc()
    done = inpaint_reference(spec, holed(picture, hole), hole, seed, call=call)
    assert np.abs(done.image[inner(hole)].astype(int) - COLOUR).max() <= 3
    assert (done.image[~hole] == picture[~hole]).all()
    assert done.confidence > 0.9 and "picture pasted" in done.reason


# ComfyUI


def test_comfyui_paints_by_the_workflow_that_comes_with_this_program(comfy: Comfy) -> None:
    paints_the_hole(comfy.url, Call(prompt="a wooden floor"), seed=2**32 - 1)
    nodes = {n["class_type"]: n["inputs"] for n in comfy.prompt.values()}
    assert nodes["CheckpointLoaderSimple"]["ckpt_name"] == "sd-v1-5-inpainting.safetensors"  # the one for inpainting
    assert nodes["KSampler"]["denoise"] == 1.0 and nodes["KSampler"]["seed"] == 2**32 - 1
    texts = [n["inputs"]["text"] for n in comfy.prompt.values() if n["class_type"] == "CLIPTextEncode"]
    assert texts[0].startswith("a wooden floor, ")
    assert comfy.paths()[:5] == ["/system_stats", "/upload/image", "/upload/image",
                                 "/object_info/CheckpointLoaderSimple", "/prompt"]  # fmt: skip
    assert comfy.paths()[-1] == "/view" and "/interrupt" not in comfy.paths()
    sizes = {decode_image(data, "").shape for data in comfy.uploads.values()}
    assert sizes == {(512, 552, 3)}  # the hole's surroundings, in a size that diffusion models like


def test_what_stood_in_the_hole_does_not_reach_the_server(comfy: Comfy) -> None:
    picture, hole = scenery(), disc()
    uploads = []
    for base in (picture, holed(picture, hole)):
        comfy.uploads, comfy.polls = {}, 0
        inpaint_reference(comfy.url, base, hole)
        uploads.append(comfy.uploads)
    assert uploads[0] == uploads[1]


def test_comfyui_takes_a_named_checkpoint_and_a_users_workflow(comfy: Comfy, tmp_path: Path) -> None:
    paints_the_hole(f"{comfy.url},dreamer_8.safetensors")
    shipped = Path(__file__).parents[3] / "core/gimp3d/priors/workflows/inpaint.json"
    own = json.loads(shipped.read_text())
    own["1"]["inputs"]["ckpt_name"] = "dreamer_8.safetensors"
    own["7"]["inputs"] |= {"denoise": 0.8, "steps": 8, "seed": 5}
    (tmp_path / "mine, too.json").write_text(json.dumps(own))
    comfy.polls = 0
    paints_the_hole(f"{comfy.url},{tmp_path}/mine, too.json")
    assert comfy.prompt["7"]["inputs"]["steps"] == 8


@pytest.mark.parametrize(
    ("mode", "more", "words"),
    [
        ("fails", "", "failed in KSampler: CUDA out of memory"),
        ("saves nothing", "", "saved no picture; it needs a node Save Image"),
        ("", ",none.safetensors", "has no checkpoint none.safetensors; it has dreamer_8.safetensors, sd-v1-5"),
    ],
)
def test_comfyuis_failures_are_told(comfy: Comfy, mode: str, more: str, words: str) -> None:
    comfy.mode = mode
    refuse(words, comfy.url + more, scenery(), disc())


def test_comfyuis_complaints_about_a_workflow_are_told(comfy: Comfy, tmp_path: Path) -> None:
    workflow = {
        "1": {"class_type": "CheckpointLoaderSimple", "inputs": {"ckpt_name": "gone.ckpt"}},
        "2": {"class_type": "LoadImage", "inputs": {"image": "{image}"}},
        "3": {"class_type": "LoadImageMask", "inputs": {"image": "{mask}", "channel": "red"}},
    }
    (tmp_path / "w.json").write_text(json.dumps(workflow))
    words = r"refused \(400 Bad Request\): Prompt outputs failed validation; CheckpointLoaderSimple: Value not in list"
    refuse(words, f"{comfy.url},{tmp_path}/w.json", scenery(), disc())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "cannot read"),
        ("no json", "is not JSON"),
        ('{"nodes": [], "links": []}', "is no workflow in API format"),
        ('{"1": {"class_type": "LoadImage", "inputs": {"image": "{image}"}}}', 'takes no "{mask}"'),
        ("[]", "is no workflow in API format"),
    ],
)
def test_workflows_that_cannot_be_used_are_refused_before_anything_is_sent(
    comfy: Comfy, tmp_path: Path, text: str | None, words: str
) -> None:
    if text is not None:
        (tmp_path / "w.json").write_text(text)
    with pytest.raises(BadInput, match=words):
        check_provider(f"{comfy.url},{tmp_path}/w.json")
    assert comfy.asked == []


@pytest.mark.parametrize(("mode", "last"), [("hangs", "/interrupt"), ("waits", "/queue")])
def test_cancel_stops_comfyui_only_at_our_own_picture(comfy: Comfy, mode: str, last: str) -> None:
    """What somebody else's prompt paints meanwhile goes on; ours leaves the queue."""
    comfy.mode = mode

    def cancel(stage: str, done: int, total: int, message: str = "") -> None:
        if "paint" in message:
            raise Cancelled(message)

    with pytest.raises(Cancelled, match=r"paints, \d s" if mode == "hangs" else "has others to paint first"):
        inpaint_reference(comfy.url, scenery(), disc(), call=Call(progress=cancel))
    stops = [path for method, path in comfy.asked if method == "POST" and path in ("/interrupt", "/queue")]
    assert stops == [last]


def test_a_server_that_takes_too_long_is_interrupted(comfy: Comfy) -> None:
    comfy.mode = "hangs"
    refuse("was not done after 0.6 s", comfy.url, scenery(), disc(), Call(seconds=0.6))
    assert "/interrupt" in comfy.paths()


# Automatic1111


def test_a1111_paints(automatic: Automatic) -> None:
    paints_the_hole(f"{automatic.url},sd_xl", Call(prompt="a wooden floor"), seed=7)
    asked = automatic.request
    assert asked["denoising_strength"] == 1 and asked["inpainting_fill"] == 0 and asked["seed"] == 7
    assert asked["prompt"].startswith("a wooden floor, ") and asked["negative_prompt"]
    assert (asked["width"], asked["height"]) == (552, 512)
    assert asked["override_settings"] == {"sd_model_checkpoint": "sd_xl"}
    assert automatic.paths()[:2] == ["/system_stats", "/sdapi/v1/progress"]


def test_a1111_is_asked_how_far_it_is_and_interrupted(automatic: Automatic) -> None:
    automatic.mode = "hangs"

    def cancel(stage: str, done: int, total: int, message: str = "") -> None:
        raise Cancelled(message)

    with pytest.raises(Cancelled, match=r"paints, 40%, \d s"):
        inpaint_reference(automatic.url, scenery(), disc(), call=Call(progress=cancel))
    assert automatic.paths()[-1] == "/sdapi/v1/interrupt" and automatic.stopped.is_set()


@pytest.mark.parametrize(
    ("mode", "words"),
    [
        ("fails", r"refused \(500 .*\): OutOfMemoryError; CUDA out of memory"),
        ("chatters", "cannot understand what .* answered"),
    ],
)
def test_a1111s_failures_are_told(automatic: Automatic, mode: str, words: str) -> None:
    automatic.mode = mode
    refuse(words, automatic.url, scenery(), disc())


def test_workflows_are_comfyuis(automatic: Automatic, tmp_path: Path) -> None:
    (tmp_path / "w.json").write_text('{"1": {"class_type": "LoadImage", "inputs": {"a": "{image}", "b": "{mask}"}}}')
    refuse("is no ComfyUI; workflows are ComfyUI's", f"{automatic.url},{tmp_path}/w.json", scenery(), disc())


# Which servers may be asked


@pytest.mark.parametrize(
    ("host", "local"),
    [("localhost", True), ("127.0.0.1", True), ("127.8.9.1", True), ("::1", True), ("192.168.1.5", False),
     ("localhost.example.org", False), ("127.0.0.1.example.org", False), ("0.0.0.0", False), ("2130706433", False)],
)  # fmt: skip
def test_only_this_machine_is_local(host: str, local: bool) -> None:
    assert is_local(host) == local


def test_other_machines_are_asked_only_when_that_is_allowed() -> None:
    refuse("192.0.2.7 is not this machine; .* only with --allow-network", "http://192.0.2.7:8188", scenery(), disc())
    refuse("painter.example is not this machine", "https://painter.example", scenery(), disc())
    notice = check_provider("https://painter.example", Call(allow_network=True))
    assert notice == "pictures of the scene are sent to painter.example"


class Redirects(StandIn):
    def answer(self, *_: object) -> tuple[int, object]:
        return 302, {}


class Speaks(StandIn):
    def answer(self, *_: object) -> tuple[int, object]:
        return 200, b"<html>hello</html>"


class Nothing(StandIn):
    def answer(self, *_: object) -> tuple[int, object]:
        return 404, b"nothing here"


@pytest.mark.parametrize(
    ("server", "words"),
    [
        (Redirects(), r"refused \(302"),
        (Speaks(), "cannot understand what .* answered .<html>hello"),
        (Nothing(), "is neither ComfyUI nor a Stable Diffusion web UI with its API on"),
    ],
)
def test_other_servers_are_refused(server: StandIn, words: str) -> None:
    """A redirection is not followed: pictures for this machine must not end on another one."""
    with serving(server):
        refuse(words, server.url, scenery(), disc())


@pytest.mark.parametrize(
    ("server", "path", "answer"),
    [
        (Comfy(), "/upload/image", ["a.png"]),
        (Comfy(), "/upload/image", {"name": 5, "subfolder": {}}),
        (Comfy(), "/prompt", 5),
        (Comfy(), "/history/the-prompt", None),
        (Comfy(), "/history/the-prompt", {"the-prompt": []}),
        (Comfy(), "/history/the-prompt", {"the-prompt": {"status": {"messages": [5]}}}),
        (Comfy(), "/history/the-prompt", {"the-prompt": {"outputs": {"9": {"images": ["a.png"]}}}}),
        (Automatic(), "/sdapi/v1/img2img", {"images": ["\u00e4"]}),
        (Automatic(), "/sdapi/v1/img2img", b"[" * 100_000),
    ],
)
def test_answers_that_say_something_else_are_told_in_one_line(
    server: StandIn, path: str, answer: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Found by make fuzz."""
    well = server.answer

    def garbled(handler: Handler, asked: str, *more: Any) -> tuple[int, Any]:
        return (200, answer) if asked == path else well(handler, asked, *more)

    monkeypatch.setattr(server, "answer", garbled)
    with serving(server):
        assert "\n" not in refuse("cannot understand what", server.url, scenery(), disc())


@pytest.mark.parametrize("said", [{"node_errors": {"1": {}}}, {"node_errors": {"1": {"errors": [{}]}}}, [], 5])
def test_refusals_that_give_no_reason_are_told(said: object, monkeypatch: pytest.MonkeyPatch) -> None:
    """Found by make fuzz."""
    server = Nothing()
    monkeypatch.setattr(server, "answer", lambda *_: (400, said))
    with serving(server):
        refuse(r"refused \(400", server.url, scenery(), disc())


def test_a_server_that_is_not_running_is_told() -> None:
    with serving(Comfy()) as server:
        url = server.url
    refuse("cannot reach .*; is it running", url, scenery(), disc())


def test_local_servers_are_not_asked_through_a_proxy(comfy: Comfy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", "http://192.0.2.1:3128")
    monkeypatch.delenv("no_proxy", raising=False)
    paints_the_hole(comfy.url)


@pytest.mark.parametrize("spec", ["http://", "http:/127.0.0.1", "http://me:secret@127.0.0.1:1", "http://127.0.0.1:x",
                                  "http://127.0.0.1:99999", "http://[::1", "http://127.0.0.1/?a=b"])  # fmt: skip
def test_addresses_that_are_none_are_refused(spec: str) -> None:
    assert "secret" not in refuse("is no server's address|is no address", spec, scenery(), disc())


@pytest.mark.parametrize(("width", "height"), [(160, 120), (1, 1), (4000, 300), (900, 700), (3000, 2990)])
def test_sizes_suit_diffusion_models(width: int, height: int) -> None:
    wide, high = painted_size(width, height)
    assert wide % 8 == high % 8 == 0 and max(wide, high) <= 1024 and min(wide, high) >= 8
    if min(width, height) >= 512 * max(width, height) / 1024:
        assert min(wide, high) >= 512


def test_workflows_are_filled_in_place() -> None:
    workflow = {"1": {"inputs": {"seed": "{seed}", "text": "photo of {prompt}", "link": ["2", 0], "steps": 30}}}
    values = {"seed": 3, "prompt": "a rug"}
    assert filled(workflow, values) == {
        "1": {"inputs": {"seed": 3, "text": "photo of a rug", "link": ["2", 0], "steps": 30}}
    }

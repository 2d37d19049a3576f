"""Stand-ins for painters that cannot be had here: they speak the real protocols and paint one colour.

Weights cannot be had here, so models are a few scripted operations and servers paint without a model. What they are
strict about is the protocol: fields, types, sizes, the order of requests.
"""

from __future__ import annotations

import base64
import contextlib
import email.parser
import email.policy
import json
import threading
import urllib.parse
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gimp3d.io.images import decode_image, encode_png

COLOUR = (200, 50, 30)  # that they all paint, RGB


def painted(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    return np.where(mask[..., None], np.array(COLOUR, np.uint8), image)


def big_lama(path: Path, colour: tuple[int, ...] = COLOUR) -> Path:
    """A TorchScript file with big-lama.pt's inputs and answer, and its complaint about sizes."""
    import torch

    class Lama(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.colour = torch.nn.Parameter(torch.tensor(colour).float().view(1, 3, 1, 1) / 255)

        def forward(self, image: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
            assert image.dim() == 4 and image.size(1) == 3 and mask.size(1) == 1
            assert image.size(2) % 8 == 0 and image.size(3) % 8 == 0, "sizes must be multiples of 8"
            assert image.shape[2:] == mask.shape[2:]
            assert bool(((mask == 0) | (mask == 1)).all()) and bool((image <= 1).all()) and bool((image >= 0).all())
            return image * (1 - mask) + mask * self.colour

    torch.jit.script(Lama()).save(str(path))
    return path


def depth_model(path: Path) -> Path:
    """A TorchScript file that takes a normalised picture and answers with its green channel, as disparity [1, h, w]."""
    import torch

    class Looks(torch.nn.Module):
        def forward(self, image: torch.Tensor) -> torch.Tensor:
            assert image.dim() == 4 and image.size(1) == 3
            return image[:, 1]

    torch.jit.script(Looks()).save(str(path))
    return path


@dataclass
class StandIn:
    """A server on this machine, and what it was asked."""

    url: str = ""
    asked: list[tuple[str, str]] = field(default_factory=list)  # (method, path without query)
    mode: str = ""  # what it does otherwise than well
    stopped: threading.Event = field(default_factory=threading.Event)

    def paths(self) -> list[str]:
        return [path for _, path in self.asked]

    def answer(self, handler: Handler, path: str, query: dict[str, str], body: bytes) -> tuple[int, Any]:
        """(status, JSON document or bytes)."""
        raise NotImplementedError


class Handler(BaseHTTPRequestHandler):
    stand_in: StandIn

    def do_GET(self) -> None:
        self._answer(b"")

    def do_POST(self) -> None:
        self._answer(self.rfile.read(int(self.headers["Content-Length"])))

    def _answer(self, body: bytes) -> None:
        parts = urllib.parse.urlsplit(self.path)
        self.stand_in.asked.append((self.command, parts.path))
        query = dict(urllib.parse.parse_qsl(parts.query, keep_blank_values=True))
        try:
            status, document = self.stand_in.answer(self, parts.path, query, body)
        except Exception as error:  # so that the test that asked sees it
            status, document = 418, {"error": {"code": 418, "message": f"the stand-in says {error!r}"}}
        data = document if isinstance(document, bytes) else json.dumps(document).encode()
        with contextlib.suppress(ConnectionError):
            self.send_response(status)
            if 300 <= status < 400:
                self.send_header("Location", "http://192.0.2.1/elsewhere")
            self.send_header("Content-Type", "image/png" if isinstance(document, bytes) else "application/json")
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

    def log_message(self, *_: Any) -> None: ...


@contextlib.contextmanager
def serving(stand_in: StandIn) -> Iterator[StandIn]:
    handler = type("OneHandler", (Handler,), {"stand_in": stand_in})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    stand_in.url = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield stand_in
    finally:
        stand_in.stopped.set()
        server.shutdown()
        server.server_close()


CHECKPOINTS = ["dreamer_8.safetensors", "sd-v1-5-inpainting.safetensors"]
NODES = {  # class → its required inputs
    "CheckpointLoaderSimple": {"ckpt_name"},
    "LoadImage": {"image"},
    "LoadImageMask": {"image", "channel"},
    "CLIPTextEncode": {"clip", "text"},
    "InpaintModelConditioning": {"positive", "negative", "vae", "pixels", "mask", "noise_mask"},
    "KSampler": {"model", "positive", "negative", "latent_image", "seed", "steps", "cfg", "sampler_name", "scheduler",
                 "denoise"},
    "VAEDecode": {"samples", "vae"},
    "SaveImage": {"images", "filename_prefix"},
}  # fmt: skip


@dataclass
class Comfy(StandIn):
    """ComfyUI's server. Modes: "" paints, "fails" in the sampler, "hangs", "waits" behind another prompt for ever."""

    uploads: dict[str, bytes] = field(default_factory=dict)
    prompt: dict[str, Any] = field(default_factory=dict)
    polls: int = 0
    result: bytes = b""

    def answer(self, handler: Handler, path: str, query: dict[str, str], body: bytes) -> tuple[int, Any]:
        if path == "/system_stats":
            return 200, {"system": {"os": "posix", "comfyui_version": "0.3.60"}, "devices": []}
        if path == "/object_info/CheckpointLoaderSimple":
            inputs = {"required": {"ckpt_name": [CHECKPOINTS, {}]}}
            return 200, {"CheckpointLoaderSimple": {"input": inputs, "output": ["MODEL", "CLIP", "VAE"]}}
        if path == "/upload/image":
            return self._upload(handler.headers["Content-Type"], body)
        if path == "/prompt":
            return self._take(json.loads(body))
        if path == "/queue":
            if handler.command == "POST":
                assert json.loads(body) == {"delete": ["the-prompt"]}
                return 200, b""
            mine = [1, "the-prompt", self.prompt, {}, ["9"]]
            others = [0, "somebody-elses", {}, {}, []]
            return 200, {"queue_running": [others if self.mode == "waits" else mine],
                         "queue_pending": [mine] if self.mode == "waits" else []}  # fmt: skip
        if path == "/interrupt":
            assert json.loads(body) == {"prompt_id": "the-prompt"}
            return 200, b""
        if path == "/history/the-prompt":
            self.polls += 1
            return 200, {} if self.polls < 3 or self.mode in ("hangs", "waits") else {"the-prompt": self._done()}
        if path == "/view":
            assert query == {"filename": "gimp3d_00001_.png", "subfolder": "", "type": "output"}
            return 200, self.result
        return 404, b"404: Not Found"

    def _upload(self, kind: str, body: bytes) -> tuple[int, Any]:
        message = email.parser.BytesParser(policy=email.policy.HTTP).parsebytes(
            f"Content-Type: {kind}\r\n\r\n".encode() + body
        )
        parts = {p.get_param("name", header="content-disposition"): p for p in message.iter_parts()}
        assert parts["overwrite"].get_payload(decode=True).strip() == b"true"
        name = parts["image"].get_filename()
        self.uploads[name] = parts["image"].get_payload(decode=True)
        return 200, {"name": name, "subfolder": "", "type": "input"}

    def _take(self, document: dict[str, Any]) -> tuple[int, Any]:
        """As ComfyUI validates a prompt, in small."""
        assert document["client_id"]
        self.prompt = document["prompt"]
        for number, node in self.prompt.items():
            kind, inputs = node["class_type"], node["inputs"]
            assert set(inputs) >= NODES[kind], kind
            for value in inputs.values():
                assert not isinstance(value, list) or value[0] in self.prompt
                assert not isinstance(value, str) or "{" not in value, f"{value} was not replaced"
            if kind in ("LoadImage", "LoadImageMask"):
                assert inputs["image"] in self.uploads
            if kind == "KSampler":
                assert isinstance(inputs["seed"], int) and 0 < inputs["denoise"] <= 1
            if kind == "CheckpointLoaderSimple" and inputs["ckpt_name"] not in CHECKPOINTS:
                details = f"ckpt_name: '{inputs['ckpt_name']}' not in {CHECKPOINTS}"
                wrong = {"type": "value_not_in_list", "message": "Value not in list", "details": details}
                error = {"type": "prompt_outputs_failed_validation", "message": "Prompt outputs failed validation",
                         "details": "", "extra_info": {}}  # fmt: skip
                return 400, {"error": error, "node_errors": {number: {"errors": [wrong], "class_type": kind}}}
        return 200, {"prompt_id": "the-prompt", "number": 1, "node_errors": {}}

    def _done(self) -> dict[str, Any]:
        if self.mode == "fails":
            what = {"node_type": "KSampler", "exception_message": "CUDA out of memory.\n", "node_id": "7"}
            status = {"status_str": "error", "completed": False, "messages": [["execution_error", what]]}
            return {"prompt": [], "outputs": {}, "status": status}
        if self.mode == "saves nothing":
            return {"outputs": {"9": {"text": ["hello"]}}, "status": {"status_str": "success", "completed": True}}
        files = {n["class_type"]: n["inputs"]["image"] for n in self.prompt.values() if "image" in n["inputs"]}
        image, mask = (decode_image(self.uploads[files[k]], k) for k in ("LoadImage", "LoadImageMask"))
        assert image.shape == mask.shape and not any(side % 8 for side in image.shape[:2])
        self.result = encode_png(painted(image, mask[..., 0] > 127))
        shown = {"images": [{"filename": "preview.png", "subfolder": "", "type": "temp"}]}
        saved = {"images": [{"filename": "gimp3d_00001_.png", "subfolder": "", "type": "output"}]}
        return {
            "outputs": {"8": shown, "9": saved},
            "status": {"status_str": "success", "completed": True, "messages": []},
        }


@dataclass
class Automatic(StandIn):
    """Stable Diffusion web UI's API. Modes: "" paints, "fails", "hangs" until it is interrupted."""

    request: dict[str, Any] = field(default_factory=dict)

    def answer(self, handler: Handler, path: str, query: dict[str, str], body: bytes) -> tuple[int, Any]:
        if path == "/sdapi/v1/progress":
            assert query == {"skip_current_image": "true"}
            state = {"job": "", "sampling_step": 12, "sampling_steps": 30}
            return 200, {"progress": 0.4, "eta_relative": 3.0, "state": state, "current_image": None, "textinfo": None}
        if path == "/sdapi/v1/interrupt":
            self.stopped.set()
            return 200, {}
        if path != "/sdapi/v1/img2img":
            return 404, {"detail": "Not Found"}
        self.request = json.loads(body)
        if self.mode == "fails":
            return 500, {"error": "OutOfMemoryError", "detail": "", "body": "", "errors": "CUDA out of memory"}
        if self.mode == "hangs":
            self.stopped.wait(30)
        if self.mode == "chatters":
            return 200, {"images": [], "parameters": {}, "info": ""}
        image, mask = (
            decode_image(base64.b64decode(t), "") for t in (self.request["init_images"][0], self.request["mask"])
        )
        height, width = self.request["height"], self.request["width"]
        assert image.shape == mask.shape == (height, width, 3) and not height % 8 and not width % 8
        picture = base64.b64encode(encode_png(painted(image, mask[..., 0] > 127))).decode()
        return 200, {"images": [picture], "parameters": {}, "info": "{}"}


@dataclass
class Gemini(StandIn):
    """Google's generateContent. Modes: "" paints, "busy" twice, "no key", "refuses" the picture, "idle", "tall"."""

    request: dict[str, Any] = field(default_factory=dict)
    model: str = ""
    shift: int = 0  # px by which its picture is off, as theirs are

    def answer(self, handler: Handler, path: str, query: dict[str, str], body: bytes) -> tuple[int, Any]:
        assert handler.headers["x-goog-api-key"] == "the-key" and "key" not in query
        version, _, self.model = path.removesuffix(":generateContent").partition("/models/")
        assert path.endswith(":generateContent") and version in ("/v1", "/v1beta")  # older clients: v1beta
        self.request = json.loads(body)
        if self.mode == "busy" and len(self.asked) < 3:
            return 503, _refusal(503, "UNAVAILABLE", "The model is overloaded.")
        if self.mode == "no key":
            return 400, _refusal(400, "INVALID_ARGUMENT", "API key not valid. Please pass a valid API key.")
        if self.mode == "refuses":
            return 200, {"candidates": [{"finishReason": "IMAGE_SAFETY", "index": 0}], "modelVersion": self.model}
        if self.mode == "hangs":
            self.stopped.wait(30)
        shown, mask = self._pictures()
        answer = painted(shown, mask) if self.mode != "idle" else shown
        answer = np.roll(answer, (self.shift, -self.shift), (0, 1))
        if self.mode == "tall":
            answer = cv2.resize(answer, (400, 1000))
        data = base64.b64encode(encode_png(answer)).decode()
        content = {"role": "model", "parts": [{"inlineData": {"mimeType": "image/png", "data": data}}]}
        usage = {"promptTokenCount": 600, "candidatesTokenCount": 1290, "totalTokenCount": 1890}
        return 200, {"candidates": [{"content": content, "finishReason": "STOP", "index": 0}], "usageMetadata": usage}

    def _pictures(self) -> tuple[np.ndarray, np.ndarray]:
        (content,) = self.request["contents"]
        *inline, words = (
            {k.replace("_t", "T"): v for k, v in p.get("inlineData", p).items()} for p in content["parts"]
        )
        assert content["role"] == "user" and "magenta" in words["text"]
        assert [p["mimeType"] for p in inline] == ["image/png"] * 2  # mime_type is the same to Google
        pictures = [decode_image(base64.urlsafe_b64decode(p["data"]), "") for p in inline]  # both alphabets
        where = pictures[1][..., 0] > 127
        assert (pictures[0][where] == (255, 0, 255)).all() and pictures[0].shape == pictures[1].shape
        return pictures[0], where


def _refusal(code: int, status: str, message: str) -> dict[str, Any]:
    return {"error": {"code": code, "message": message, "status": status}}

"""Painting servers that artists run: ComfyUI, and Stable Diffusion web UI (Automatic1111, Forge, SD.Next)."""

from __future__ import annotations

import base64
import hashlib
import ipaddress
import json
import time
import urllib.error
import urllib.parse
import urllib.request
import uuid
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import BadInput, one_line, refusing
from ..io.images import decode_image, encode_png
from ..schema import parse_json, read_json
from .calls import Call, Painter, waited
from .pasting import interpolated, resized, scaled

SHORTEST, LONGEST = 512, 1024  # px of the sides that diffusion models paint well; the longest side decides
MULTIPLE = 8  # px; their latents have one value for so many
STEPS, GUIDANCE = 30, 6.0  # of A1111; ComfyUI's are in the workflow
SOFT_EDGE = 4  # px of A1111's mask blur, its own default
POLL = 0.25  # s between two looks whether ComfyUI is done
QUICK = 2.0  # s that a word of progress or the end of the work may take
PROGRESS = "/sdapi/v1/progress?skip_current_image=true"
MOST_BYTES = 256 << 20  # of an answer
NO_ANSWER = (AttributeError, LookupError, OverflowError, TypeError, ValueError)  # of JSON that says something else
PROMPT = "photograph of the empty place, surfaces and textures of the surroundings continued, nothing standing there"
SHIPPED = Path(__file__).parent / "workflows" / "inpaint.json"
Values = dict[str, Any]  # what a painter is told: prompt, negative, seed, strength, checkpoint
NEGATIVE = "object, person, text, watermark, frame, blurry"


def painter(address: str, call: Call) -> Painter:
    """A server's address, and after a comma a ComfyUI workflow (.json, in API format) or a checkpoint's name.

    A server on this machine needs no leave; pictures go to others only where `call.allow_network`.
    Raises BadInput if the address is none, or is not allowed, or the workflow cannot be used.
    """
    url, _, more = address.partition(",")
    server = _Server(url, call)
    own = more.endswith(".json")
    workflow = _workflow(Path(more) if own else SHIPPED, server.option)

    def paint(image: np.ndarray, mask: np.ndarray, seed: int, call: Call) -> np.ndarray:
        h, w = mask.shape
        width, height = painted_size(w, h)
        if call.strength == 1:
            image = interpolated(image, mask)  # a trace of what stands there comes through
        shown, hole = scaled(image, width, height), scaled(mask.astype(np.uint8), width, height) > 0
        values: Values = {"prompt": f"{call.prompt}, {PROMPT}" if call.prompt else PROMPT, "negative": NEGATIVE}
        values |= {"seed": seed, "strength": call.strength, "checkpoint": "" if own else more}
        work = _Comfy(server, workflow) if server.is_comfy() else _Automatic(server)
        if own and isinstance(work, _Automatic):
            raise BadInput(f"{server.option}: {url} is no ComfyUI; workflows are ComfyUI's, leave {more} away")
        data = waited(server.host, lambda: work.paint(shown, hole, values), call, lambda: work.doing, work.stop)
        answer = resized(decode_image(data, f"what {url} answered"), (height, width), f"the picture from {url}")
        return scaled(answer, w, h)

    notice = "" if server.local else f"pictures of the scene are sent to {server.host}"
    return Painter(server.host, paint, f"the picture that {url} painted", notice=notice)


def painted_size(width: int, height: int) -> tuple[int, int]:
    """The (width, height) in which a picture of that size is painted."""
    factor = min(max(1.0, SHORTEST / min(width, height)), LONGEST / max(width, height))
    wide, high = (max(MULTIPLE, round(factor * side / MULTIPLE) * MULTIPLE) for side in (width, height))
    return wide, high


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """A server on this machine must not pass pictures on to another one."""

    def redirect_request(self, *_: Any) -> None:
        return None


class _Server:
    """JSON and bytes over HTTP, with errors of one line."""

    def __init__(self, url: str, call: Call) -> None:
        with refusing(f"{call.option} http: {url!r} is no address", ValueError):
            parts = urllib.parse.urlsplit(url)
            host, port = parts.hostname, parts.port
        self.option = f"{call.option} {parts.scheme}"
        if not host or parts.username is not None or parts.query or parts.fragment:
            shown = f"{parts.scheme}://{host}" if host else url  # without a password
            raise BadInput(f"{self.option}: {shown} is no server's address; give http://127.0.0.1:8188 or alike")
        self.host = f"{host}:{port}" if port else host
        self.url, self.local, self.seconds = url.rstrip("/"), is_local(host), call.seconds
        if not self.local and not call.allow_network:
            raise BadInput(
                f"{self.option}: {host} is not this machine; pictures are sent there only with --allow-network"
            )
        proxy = urllib.request.ProxyHandler({} if self.local else None)  # none, or the system's
        self._opener = urllib.request.build_opener(_NoRedirect(), proxy)

    def is_comfy(self) -> bool:
        """Whether ComfyUI answers there; BadInput if neither it nor A1111 does."""
        for path, comfy in (("/system_stats", True), (PROGRESS, False)):
            with suppress(_NotThere):
                self.get(path, QUICK * 5)
                return comfy
        raise BadInput(
            f"{self.option}: {self.url} is neither ComfyUI nor a Stable Diffusion web UI with its API on "
            "(start it with --api)"
        )

    def get(self, path: str, seconds: float | None = None) -> Any:
        return self._json(self.ask(path, seconds=seconds))

    def post(self, path: str, document: Any, seconds: float | None = None) -> Any:
        return self._json(self.ask(path, json.dumps(document).encode(), "application/json", seconds) or b"{}")

    def upload(self, path: str, name: str, data: bytes) -> Any:
        """A picture as a form with a file."""
        border = uuid.uuid4().hex
        head = (
            f'--{border}\r\nContent-Disposition: form-data; name="overwrite"\r\n\r\ntrue\r\n'
            f'--{border}\r\nContent-Disposition: form-data; name="image"; filename="{name}"\r\n'
            "Content-Type: image/png\r\n\r\n"
        )
        body = head.encode() + data + f"\r\n--{border}--\r\n".encode()
        return self._json(self.ask(path, body, f"multipart/form-data; boundary={border}"))

    def ask(self, path: str, data: bytes | None = None, kind: str = "", seconds: float | None = None) -> bytes:
        request = urllib.request.Request(self.url + path, data, {"Content-Type": kind} if kind else {})
        try:
            with self._opener.open(request, timeout=seconds or self.seconds) as response:
                answer: bytes = response.read(MOST_BYTES + 1)
        except urllib.error.HTTPError as error:
            with error:
                said = _said(error.read(1 << 16))
            words = f"{self.option}: {self.url} refused ({error.code} {error.reason}): {said}"
            kind_of_error = _NotThere if error.code == 404 else BadInput
            raise kind_of_error(words) from None
        except (OSError, HTTPException) as error:
            reason = getattr(error, "reason", None) or error
            words = str(reason)[:200] or type(reason).__name__
            raise BadInput(f"{self.option}: cannot reach {self.url} ({words}); is it running?") from None
        if len(answer) > MOST_BYTES:
            raise BadInput(f"{self.option}: {self.url} answers with more than {MOST_BYTES >> 20} MB")
        return answer

    def _json(self, data: bytes) -> Any:
        with refusing(self.unclear, BadInput):
            return parse_json(data, data[:60].decode("utf-8", "replace"))

    @property
    def unclear(self) -> str:
        """What is wrong with an answer that says something else than it should."""
        return f"{self.option}: cannot understand what {self.url} answered"


class _NotThere(BadInput):
    """A server that knows no such path."""


def is_local(host: str) -> bool:
    """Whether a host is this machine by its very name: nothing is looked up."""
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


@dataclass
class _Comfy:
    """A prompt in ComfyUI's queue."""

    server: _Server
    workflow: dict[str, Any]
    prompt_id: str = ""
    doing: str = "gets the picture"
    stopped: bool = False

    def paint(self, image: np.ndarray, mask: np.ndarray, values: Values) -> bytes:
        server, values = self.server, dict(values)
        with refusing(server.unclear, *NO_ANSWER):
            for name, picture in (("image", image), ("mask", mask)):
                data = encode_png(picture)
                named = f"gimp3d-{hashlib.sha256(data).hexdigest()[:16]}.png"  # the same picture is not kept twice
                answer = server.upload("/upload/image", named, data)
                values[name] = "/".join(filter(None, (answer.get("subfolder", ""), answer.get("name", named))))
            if "{checkpoint}" in json.dumps(self.workflow):
                values["checkpoint"] = self._checkpoint(values["checkpoint"])
            answer = server.post("/prompt", {"prompt": filled(self.workflow, values), "client_id": uuid.uuid4().hex})
            self.prompt_id = str(answer["prompt_id"])
            while not self.stopped:
                history = server.get(f"/history/{self.prompt_id}")
                if self.prompt_id in history:
                    return self._picture(history[self.prompt_id])
                self.doing = "paints" if self._is_running() else "has others to paint first"
                time.sleep(POLL)
        raise BadInput(f"{server.option}: stopped")  # nobody waits for it any longer

    def _checkpoint(self, wanted: str) -> str:
        """The model that is named, else the first one for inpainting, else the first one."""
        loader = "CheckpointLoaderSimple"
        found = self.server.get(f"/object_info/{loader}")
        names = [str(name) for name in found[loader]["input"]["required"]["ckpt_name"][0]]
        if not names or (wanted and wanted not in names):
            there = f"it has {', '.join(names)}" if names else "put one into its models/checkpoints"
            raise BadInput(f"{self.server.option}: {self.server.url} has no checkpoint {wanted}; {there}")
        return wanted or next((name for name in names if "inpaint" in name.lower()), names[0])

    def _is_running(self) -> bool:
        running = self.server.get("/queue", QUICK).get("queue_running", [])
        return any(self.prompt_id in item[:2] for item in running)

    def _picture(self, done: Any) -> bytes:
        """The first picture that the workflow saved, else the first that it showed."""
        status = done.get("status", {})
        for kind, what in status.get("messages", []):
            if kind == "execution_error":
                words = one_line(f"{what.get('node_type')}: {what.get('exception_message')}")
                raise BadInput(f"{self.server.option}: {self.server.url} failed in {words}")
        if status.get("status_str", "success") != "success":
            raise BadInput(f"{self.server.option}: {self.server.url} stopped before the picture was done")
        pictures = [p for output in done.get("outputs", {}).values() for p in output.get("images", [])]
        pictures.sort(key=lambda p: p.get("type") != "output")
        if not pictures:
            raise BadInput(f"{self.server.option}: the workflow saved no picture; it needs a node Save Image")
        query = {key: pictures[0].get(key, "") for key in ("filename", "subfolder", "type")}
        return self.server.ask(f"/view?{urllib.parse.urlencode(query)}")

    def stop(self) -> None:
        """Take our prompt out of the queue; interrupt only if it is ours that is painted."""
        self.stopped = True
        if not self.prompt_id:
            return
        with suppress(BadInput, *NO_ANSWER):
            if self._is_running():
                self.server.post("/interrupt", {"prompt_id": self.prompt_id}, QUICK)
            else:
                self.server.post("/queue", {"delete": [self.prompt_id]}, QUICK)


@dataclass
class _Automatic:
    """An img2img request to A1111's API."""

    server: _Server

    def paint(self, image: np.ndarray, mask: np.ndarray, values: Values) -> bytes:
        height, width = mask.shape
        shown, hole = (base64.b64encode(encode_png(picture)).decode() for picture in (image, mask))
        fill = 0 if values["strength"] == 1 else 1  # 0: what stands there is blurred away, 1: kept
        request = {"init_images": [shown], "mask": hole, "width": width, "height": height, "resize_mode": 0}
        request |= {"prompt": values["prompt"], "negative_prompt": values["negative"], "seed": values["seed"]}
        request |= {"steps": STEPS, "cfg_scale": GUIDANCE, "denoising_strength": values["strength"]}
        request |= {"mask_blur": SOFT_EDGE, "inpainting_fill": fill, "inpaint_full_res": False}
        request |= {"n_iter": 1, "batch_size": 1, "send_images": True}
        if values["checkpoint"]:
            request["override_settings"] = {"sd_model_checkpoint": values["checkpoint"]}
        answer = self.server.post("/sdapi/v1/img2img", request)
        with refusing(self.server.unclear, *NO_ANSWER):
            text = answer["images"][0]
            return base64.b64decode(text.partition(",")[2] if text.startswith("data:") else text, validate=True)

    @property
    def doing(self) -> str:
        with suppress(BadInput, *NO_ANSWER):
            return f"paints, {float(self.server.get(PROGRESS, QUICK)['progress']):.0%}"
        return "paints"

    def stop(self) -> None:
        with suppress(BadInput):
            self.server.post("/sdapi/v1/interrupt", {}, QUICK)


def filled(workflow: Any, values: Mapping[str, Any]) -> Any:
    """A workflow with values in the place of its texts "{name}"; in longer texts they are replaced as text."""
    if isinstance(workflow, dict):
        return {key: filled(value, values) for key, value in workflow.items()}
    if isinstance(workflow, list):
        return [filled(value, values) for value in workflow]
    if not isinstance(workflow, str):
        return workflow
    for name, value in values.items():
        if workflow == f"{{{name}}}":
            return value
        workflow = workflow.replace(f"{{{name}}}", str(value))
    return workflow


def _workflow(path: Path, option: str) -> dict[str, Any]:
    """A user's workflow: it takes {image} and {mask}, and if it likes {prompt}, {negative}, {seed}, {strength}, …"""
    workflow = read_json(path, option)
    nodes = workflow.values() if isinstance(workflow, dict) else []
    if not nodes or not all(isinstance(node, dict) and "class_type" in node for node in nodes):
        raise BadInput(
            f"{option}: {path} is no workflow in API format; export it in ComfyUI by Workflow › Export (API)"
        )
    text = json.dumps(workflow)
    missing = [name for name in ('"{image}"', '"{mask}"') if name not in text]
    if missing:
        raise BadInput(f"{option}: {path} takes no {' and no '.join(missing)}; write that where a file's name stands")
    return workflow


def _said(body: bytes) -> str:
    """What an error's body says, in one line: ComfyUI's, A1111's, or any text."""
    text = body.decode("utf-8", "replace")
    with suppress(BadInput, *NO_ANSWER):
        document = parse_json(body, "")
        error = document.get("error")
        parts = [error.get("message"), error.get("details")] if isinstance(error, dict) else [error]
        for node in (document.get("node_errors") or {}).values():
            parts += [f"{node['class_type']}: {e['message']}, {e['details']}" for e in node["errors"]]
        parts += [document.get("errors"), document.get("detail")]
        text = "; ".join(str(part) for part in parts if part) or text
    return one_line(text)

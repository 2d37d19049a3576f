"""Google's Gemini image models (the paper's Nano Banana) through Google's own client."""

from __future__ import annotations

import importlib.util
import os
from functools import partial
from typing import Any

import cv2
import numpy as np

from ..errors import BadInput, one_line
from ..io.images import decode_image, encode_png
from .calls import Call, Painter, waited
from .pasting import scaled

MODEL = "gemini-2.5-flash-image"  # Nano Banana
KEYS = ("GEMINI_API_KEY", "GOOGLE_API_KEY")
# Sizes (width, height) of the pictures that the models answer with, by the aspect ratio that is asked for.
SIZES = {
    "1:1": (1024, 1024), "2:3": (832, 1248), "3:2": (1248, 832), "3:4": (864, 1184), "4:3": (1184, 864),
    "4:5": (896, 1152), "5:4": (1152, 896), "9:16": (768, 1344), "16:9": (1344, 768), "21:9": (1536, 672),
}  # fmt: skip
DOLLARS = {"gemini-2.5-flash-image": 0.039, "gemini-3.1-flash-image-preview": 0.067}  # a picture, by Google's list
ATTEMPTS = 3  # of a request that the server is too busy for; by the client
PAUSE = 1.0  # s before the second one, longer before the third
HIDDEN = (255, 0, 255)  # the colour that covers the hole
LEFT = 0.1  # share of the hole that may be of nearly that colour in the answer
NEARLY = 40  # grey levels in each channel
OTHER_SHAPE = 0.05  # by which the answer's aspect ratio may differ from that asked for
PROMPT = (
    "The first picture is a photograph in which an area is covered in flat magenta; the second picture shows the same "
    "area in white. Replace the magenta by what is behind it: continue the surfaces, textures, edges, light and "
    "reflections of the surroundings. Put no object there. Keep every other pixel exactly as and where it is: same "
    "framing, size, sharpness and colours. Answer with the picture alone."
)


def painter(model: str, call: Call) -> Painter:
    """Gemini's model of that name, or Nano Banana.

    Raises BadInput if going online is not allowed, there is no key in the environment, or Google's client is missing.
    """
    model, who = model or MODEL, f"{call.option} gemini"
    if not call.allow_network:
        raise BadInput(f"{who}: sends pictures of the scene to Google and costs money; allow it with --allow-network")
    key = next((os.environ[name] for name in KEYS if os.environ.get(name)), "")
    if not key:
        raise BadInput(f"{who}: there is no key; set {' or '.join(KEYS)} (free at aistudio.google.com)")
    if importlib.util.find_spec("google") is None or importlib.util.find_spec("google.genai") is None:
        raise BadInput(f"{who}: needs Google's client, which is not installed; pip install 'gimp3d[gemini]'")

    def paint(image: np.ndarray, mask: np.ndarray, seed: int, call: Call) -> np.ndarray:
        h, w = mask.shape
        aspect, (top, bottom, left, right) = padded_to(w, h)
        width, height = SIZES[aspect]
        way = cv2.BORDER_REFLECT_101 if min(w, h) > 1 else cv2.BORDER_REPLICATE
        shown, hole = (
            scaled(cv2.copyMakeBorder(p, top, bottom, left, right, way), width, height)
            for p in (np.where(mask[..., None], np.uint8(0), image), mask.astype(np.uint8) * 255)
        )
        hole = hole > 0
        shown = np.where(hole[..., None], np.array(HIDDEN, np.uint8), shown)
        asked = partial(_asked, who, model, key, [encode_png(shown), encode_png(hole)], aspect, seed, call)
        answer = decode_image(waited(model, asked, call, lambda: "paints"), f"what {model} answered")
        high, wide = answer.shape[:2]
        if abs(np.log(wide / high / (width / height))) > OTHER_SHAPE:
            raise BadInput(
                f"{who}: {model} answers with {wide}×{high} pixels, not the shape of the picture that it got "
                f"({width}×{height})"
            )
        inside = scaled(answer, width, height)[hole].astype(int)
        if len(inside) and (np.abs(inside - HIDDEN).max(1) < NEARLY).mean() > LEFT:
            raise BadInput(f"{who}: {model} left the hole as it was; try another --seed or --set prompt=…")
        return scaled(answer, left + w + right, top + h + bottom)[top : top + h, left : left + w]

    price = f"about ${DOLLARS[model]:.2f} each" if model in DOLLARS else "its price in Google's list each"
    notice = f"pictures of the scene are sent to Google's {model}, usually one or two a removal, {price}"
    return Painter(model, paint, f"the picture that {model} painted", notice=notice)


def padded_to(width: int, height: int) -> tuple[str, tuple[int, int, int, int]]:
    """The nearest aspect ratio that can be asked for, and the (top, bottom, left, right) px that are missing to it."""
    ratios = {name: wide / high for name, (wide, high) in SIZES.items()}
    aspect = min(ratios, key=lambda name: abs(np.log(ratios[name] / (width / height))))
    across = max(0, round(height * ratios[aspect]) - width)
    down = max(0, round(width / ratios[aspect]) - height)
    return aspect, (down // 2, down - down // 2, across // 2, across - across // 2)


def _asked(who: str, model: str, key: str, pictures: list[bytes], aspect: str, seed: int, call: Call) -> bytes:
    """The picture that Gemini answers with."""
    from google import genai
    from google.genai import errors, types

    contents: list[Any] = [types.Part.from_bytes(data=data, mime_type="image/png") for data in pictures]
    contents.append(PROMPT + (f" The covered area shows: {call.prompt}." if call.prompt else ""))
    options = types.HttpOptions(
        timeout=int(1000 * call.seconds),
        retry_options=types.HttpRetryOptions(attempts=ATTEMPTS, initial_delay=PAUSE, jitter=PAUSE),
    )
    config = types.GenerateContentConfig(
        response_modalities=["IMAGE"],
        image_config=types.ImageConfig(aspect_ratio=aspect),
        seed=seed & 0x7FFFFFFF,
        candidate_count=1,
    )
    try:
        client = genai.Client(vertexai=False, api_key=key, http_options=options)
        answer = client.models.generate_content(model=model, contents=contents, config=config)
    except errors.APIError as error:
        raise BadInput(f"{who}: Google refused ({error.code} {error.status}): {one_line(error.message)}") from None
    except Exception as error:  # of whatever library the client has for its connections
        raise BadInput(f"{who}: cannot reach Google ({one_line(error) or type(error).__name__})") from None
    said = []
    for candidate in answer.candidates or []:
        for part in (candidate.content.parts if candidate.content else None) or []:
            if part.inline_data is not None and part.inline_data.data:
                return part.inline_data.data
            said.append(part.text or "")
        said.append(str(candidate.finish_reason.value) if candidate.finish_reason else "")
    if answer.prompt_feedback is not None and answer.prompt_feedback.block_reason is not None:
        said.append(f"blocked: {answer.prompt_feedback.block_reason.value}")
    why = one_line("; ".join(filter(None, said))) or "no reason given"
    raise BadInput(f"{who}: {model} answers without a picture ({why})")

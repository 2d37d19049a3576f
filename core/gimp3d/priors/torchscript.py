"""TorchScript models, run by torch on the CPU. A model file is code: torch runs what it says."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..compute.threads import thread_count
from ..errors import BadInput
from .appearance import Painter
from .calls import Call, waited
from .networks import as_picture, times, with_black_hole
from .pasting import scaled

MULTIPLE = 8  # px; LaMa's encoder halves a picture three times
LONGEST_SIDE = 1280  # px; larger pictures are reduced: LaMa loses its grip, and a laptop its memory


@dataclass(frozen=True)
class TorchModel:
    """A model file that is there, with a torch that may run it."""

    who: str  # for messages: option and path
    path: Path

    def look(self, *inputs: np.ndarray) -> tuple[np.ndarray, ...]:
        """The model's outputs to these inputs (float32).

        Raises
        ------
        BadInput
            If it is no TorchScript model or cannot be run.
        """
        import torch

        before = torch.get_num_threads()
        torch.set_num_threads(thread_count())
        try:
            model = torch.jit.load(str(self.path), map_location="cpu").eval()
            with torch.no_grad():
                answer: Any = model(*(torch.from_numpy(np.ascontiguousarray(i, np.float32)) for i in inputs))
            answers = list(answer.values()) if isinstance(answer, dict) else answer
            answers = answers if isinstance(answers, (list, tuple)) else (answers,)
            return tuple(a.float().numpy() for a in answers if isinstance(a, torch.Tensor))
        except (RuntimeError, TypeError, ValueError) as error:  # torch's own are RuntimeErrors
            lines = str(error).strip().splitlines()  # the last one says what; before it stands where
            reason = lines[-1] if lines else type(error).__name__
            words = f"torch cannot run it ({reason[:200]}); it must be a TorchScript model"
            raise BadInput(f"{self.who}: {words}") from None
        finally:
            torch.set_num_threads(before)


def read_model(option: str, path: Path) -> TorchModel:
    """The model at a path; nothing of it is run yet.

    Raises
    ------
    BadInput
        If there is no such file, or no torch.
    """
    if not path.is_file():
        raise BadInput(f"{option}: cannot read {path} (no such file)")
    if importlib.util.find_spec("torch") is None:
        raise BadInput(f"{option}: needs PyTorch, which is not installed; pip install 'gimp3d[torch]'")
    return TorchModel(f"{option}: {path}", path)


def painter(argument: str, call: Call) -> Painter:
    """A network that paints as LaMa's file big-lama.pt does.

    It takes a picture [1, 3, H, W] of RGB in [0, 1] and a mask [1, 1, H, W] of 0 and 1 = fill, H and W multiples of 8
    (mirrored beyond the border, as IOPaint and simple-lama do), and answers with [1, 3, H, W] in [0, 1].

    Raises
    ------
    BadInput
        If there is no such file, or no torch.
    """
    model = read_model(f"{call.option} torchscript", Path(argument))

    def paint(image: np.ndarray, mask: np.ndarray, seed: int, call: Call) -> np.ndarray:
        h, w = mask.shape
        factor = min(1.0, LONGEST_SIDE / max(h, w))
        width, height = max(1, round(factor * w)), max(1, round(factor * h))
        picture, hole = with_black_hole(image, mask, width, height)
        more = ((0, -height % MULTIPLE), (0, -width % MULTIPLE))
        inputs = [
            np.pad(picture, (*more, (0, 0)), mode="symmetric").transpose(2, 0, 1)[None],
            np.pad(hole, more, mode="symmetric")[None, None].astype(np.float32),
        ]
        answers = waited(model.path.name, lambda: model.look(*inputs), call)
        if not answers:
            raise BadInput(f"{model.who} answers with no picture")
        answer = as_picture(answers[0], model.who)
        if answer.shape[:2] != inputs[0].shape[2:]:
            sizes = (times(a[::-1]) for a in (answer.shape[:2], inputs[0].shape[2:]))
            raise BadInput("{} answers with {} pixels to a picture of {}".format(model.who, *sizes))
        return scaled(answer[:height, :width], w, h)

    return Painter(model.path.name, paint, f"the picture that {model.path} painted")

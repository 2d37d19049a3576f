"""TorchScript models through torch. Weights cannot be had here: the file is a stand-in with big-lama.pt's protocol."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from pictures import disc, holed, inner, refuse, scenery
from stand_ins import COLOUR, big_lama

from gimp3d.priors.inpaint import check_provider, inpaint_reference

torch = pytest.importorskip("torch")


@pytest.fixture(scope="module")
def lama(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return big_lama(tmp_path_factory.mktemp("models") / "big-lama.pt")


@pytest.mark.parametrize("size", [(120, 160), (121, 163), (40, 37)])
def test_a_model_paints_the_hole_of_a_picture_of_any_size(lama: Path, size: tuple[int, int]) -> None:
    """It complains of sizes that are no multiples of 8, of masks between 0 and 1, and of colours beyond [0, 1]."""
    picture, hole = scenery(*size), disc(*size, radius=min(size) / 5)
    done = inpaint_reference(f"torchscript:{lama}", holed(picture, hole), hole)
    assert np.abs(done.image[hole].astype(int) - COLOUR).max() <= 1
    assert (done.image[~hole] == picture[~hole]).all()
    assert done.confidence == 1.0 and "picture pasted" in done.reason


def test_what_stood_in_the_hole_does_not_matter(lama: Path) -> None:
    picture, hole = scenery(), disc()
    black = np.where(hole[..., None], np.uint8(0), picture)
    fills = [inpaint_reference(f"torchscript:{lama}", base, hole).image for base in (black, holed(picture, hole))]
    assert (fills[0] == fills[1]).all()


def test_large_pictures_are_reduced(lama: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gimp3d.priors.networks.LONGEST_SIDE", 64)
    picture, hole = scenery(), disc()
    done = inpaint_reference(f"torchscript:{lama}", holed(picture, hole), hole)
    assert np.abs(done.image[inner(hole, 6)].astype(int) - COLOUR).max() <= 2
    assert (done.image[~hole] == picture[~hole]).all()


def test_what_is_not_known_is_painted_too_and_not_compared(lama: Path) -> None:
    """Of a chart, much may be known to nobody: it must not be taken for a black wall."""
    picture, hole = scenery(), disc()
    unknown = np.zeros_like(hole)
    unknown[:, :40] = True
    base = np.where(unknown[..., None], np.uint8(0), holed(picture, hole))
    done = inpaint_reference(f"torchscript:{lama}", base, hole, unknown=unknown)
    assert done.confidence == 1.0 and (done.image[~hole] == base[~hole]).all()


def saved(module: torch.nn.Module, path: Path) -> str:
    torch.jit.script(module).save(str(path))
    return f"torchscript:{path}"


class OneInput(torch.nn.Module):
    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return image


class Features(torch.nn.Module):
    def forward(self, image: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        return mask


class Smaller(torch.nn.Module):
    def forward(self, image: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        return image[:, :, ::2, ::2]


class Inverts(torch.nn.Module):
    def forward(self, image: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        return 1 - image


class NoTensor(torch.nn.Module):
    def forward(self, image: torch.Tensor, mask: torch.Tensor) -> str:
        return "hello"


@pytest.mark.parametrize(
    ("module", "words"),
    [
        (OneInput(), "torch cannot run it"),
        (Features(), "which is no finite picture"),
        (Smaller(), "answers with 68×60 pixels to a picture of 136×120"),
        (Inverts(), "does not match the view"),
        (NoTensor(), "answers with no picture"),
    ],
)
def test_models_that_cannot_paint_are_refused(tmp_path: Path, module: torch.nn.Module, words: str) -> None:
    refuse(words, saved(module, tmp_path / "m.pt"), scenery(), disc())


def test_files_that_are_no_models_are_refused(tmp_path: Path) -> None:
    refuse("cannot read .*nothing.pt", f"torchscript:{tmp_path}/nothing.pt", scenery(), disc())
    (tmp_path / "text.pt").write_text("no model")
    refuse("torch cannot run it .*must be a TorchScript model", f"torchscript:{tmp_path}/text.pt", scenery(), disc())
    torch.save({"weights": torch.zeros(2)}, tmp_path / "weights.pt")  # what LaMa's own repository has
    refuse("must be a TorchScript model", f"torchscript:{tmp_path}/weights.pt", scenery(), disc())


def test_without_torch_the_error_says_how_to_get_it(lama: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    refuse(r"needs PyTorch.*pip install 'gimp3d\[torch\]'", f"torchscript:{lama}", scenery(), disc())


def test_nothing_is_told_beforehand_as_nothing_leaves_the_machine(lama: Path) -> None:
    assert check_provider(f"torchscript:{lama}") == ""

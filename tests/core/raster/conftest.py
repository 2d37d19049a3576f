"""Settings of the rasteriser's tests."""

from __future__ import annotations

import importlib.util

if importlib.util.find_spec("torch"):
    import torch

    torch.set_num_threads(1)  # the reference's tensors are small: handing them to threads takes ten times as long

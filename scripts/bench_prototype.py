"""Times the rasteriser's first prototype for bench_raster.py: a JSON request per line in, an answer per line out.

A process of its own, because numba's settings (NUMBA_CACHE_DIR) are per process and gimp3d sets them.

    python scripts/bench_prototype.py FOLDER
"""

from __future__ import annotations

import importlib
import json
import sys
from functools import cache
from typing import Any

import numpy as np


def main() -> None:
    sys.path.insert(0, sys.argv[1])
    scene, kernels = importlib.import_module("scene"), importlib.import_module("gs_numba")
    gaussians = cache(scene.scene)
    for line in sys.stdin:
        print(json.dumps(answer(scene, kernels, gaussians, **json.loads(line))), flush=True)


def answer(
    scene: Any, kernels: Any, gaussians: Any, n: int, width: int, height: int, threads: int, seed: int, size: float,
    repetitions: int,
) -> dict[str, Any]:  # fmt: skip
    """Best (wall, CPU) in ms of forward and backward, and the picture's mean as proof that it is the same."""
    raster = kernels.Raster(threads, "v16")
    gradients = np.random.default_rng(seed).normal(size=(5, height, width)).astype(np.float32)
    times = []
    for _ in range(repetitions):
        picture = raster.forward(gaussians(n, seed, size), scene.camera(width, height), width, height)
        raster.backward(gradients)
        t = raster.t
        times.append([(t["fwd"], t["cpu_f"]), (t["bwd"], t["cpu_b"])])
    if raster.pool:
        raster.pool.shutdown()
    forward, backward = (1e3 * np.min(times, axis=0)).tolist()
    return {"forward": forward, "backward": backward, "mean": float(picture[:3].mean())}


if __name__ == "__main__":
    main()

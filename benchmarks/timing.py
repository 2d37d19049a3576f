"""Time and memory of kernels: the least of several repetitions, processes of their own, and which machine it was."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import llvmlite.binding
import numba
import numpy as np

from gimp3d.compute.threads import available_cores

from .command import ROOT

replaced = patch.object  # (owner, name, value): a module's attribute has another value inside
SLOW_MS, SLOW_REPETITIONS = 1000.0, 3  # what takes longer is repeated less often


def machine() -> dict[str, Any]:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if "model name" in line]
    features = llvmlite.binding.get_host_cpu_features()
    extensions = {"avx512f": "AVX-512", "avx2": "AVX2", "sse2": "SSE2", "neon": "NEON"}
    return {
        "cpu": names[0] if names else platform.processor(),
        "architecture": llvmlite.binding.get_host_cpu_name(),
        "cores": available_cores(),
        "vectors": next((word for name, word in extensions.items() if features.get(name)), "none known"),
        "load_at_start": [round(x, 2) for x in os.getloadavg()],
        "python": platform.python_version(),
        "numba": numba.__version__,
        "numpy": np.__version__,
    }


def about(host: dict[str, Any]) -> str:
    return f"{host['cpu']}, {host['cores']} cores; load at the start {host['load_at_start'][0]}."


class Watch:
    """(wall, CPU) in ms since the last lap; CPU time is that of all threads together."""

    def __init__(self) -> None:
        self.last = time.perf_counter(), time.process_time()

    def lap(self) -> tuple[float, float]:
        before, self.last = self.last, (time.perf_counter(), time.process_time())
        return 1e3 * (self.last[0] - before[0]), 1e3 * (self.last[1] - before[1])


def timed(run: Callable[[], Any]) -> tuple[float, float]:
    watch = Watch()
    _kept_until_read = run()  # giving the memory back is not what is timed
    return watch.lap()


def best_of(run: Callable[[], Any], repetitions: int) -> np.ndarray:
    """The least of each number that `run` gives."""
    watch = Watch()
    samples = [run()]
    if watch.lap()[0] > SLOW_MS:
        repetitions = min(repetitions, SLOW_REPETITIONS)
    return np.min(samples + [run() for _ in range(repetitions - 1)], axis=0)


def cost(pair: Any) -> dict[str, float]:
    return {"wall_ms": round(float(pair[0]), 3), "cpu_ms": round(float(pair[1]), 3)}


def in_new_process(module: str, call: str, **environment: str) -> Any:
    """What `call` of a benchmark's module gives in a process of its own."""
    code = f"import json; from {module} import *; print(json.dumps({call}))"
    paths = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    command, given = [sys.executable, "-c", code], {**os.environ, **environment, "PYTHONPATH": paths}
    done = subprocess.run(command, env=given, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])

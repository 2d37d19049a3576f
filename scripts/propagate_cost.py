"""What propagation costs, in time and memory, on a made room; how much of it is Poisson; how exact that is."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from bench_raster import say
from made_room import Shot, loaders, reference_of, shoot

from gimp3d.compute.threads import available_cores
from gimp3d.solvers.poisson import PoissonSolution, solve_poisson
from gimp3d.stages import propagate as stage
from gimp3d.stages.propagate import Reference, propagate

Size = tuple[int, int]
SHOTS = 6  # different views; more views repeat them
MIB = 1 << 20


@cache
def room(size: Size) -> tuple[Reference, list[Shot]]:
    shots = [shoot(turn, *size) for turn in np.linspace(0, 2 * np.pi, SHOTS, endpoint=False)]
    return reference_of(shots[0], shots), shots


@dataclass
class PoissonUse:
    """CPU seconds in the solver, and its systems."""

    seconds: float = 0.0
    systems: list[tuple[tuple[Any, ...], dict[str, Any], PoissonSolution]] = field(default_factory=list)


@contextmanager
def watched_poisson(keep: bool = False) -> Iterator[PoissonUse]:
    use, lock = PoissonUse(), threading.Lock()

    def watched(*args: Any, **more: Any) -> PoissonSolution:
        start = time.thread_time()
        solution = solve_poisson(*args, **more)
        with lock:
            use.seconds += time.thread_time() - start
            if keep:
                use.systems.append((args, more, solution))
        return solution

    with mock.patch.object(stage, "solve_poisson", watched):
        yield use


def speed(cases: tuple[tuple[int, Size], ...]) -> list[dict[str, Any]]:
    """Wall and CPU time by the number of views and their size; the loads are copies of arrays, and count."""
    rows = []
    for count, size in cases:
        reference, shots = room(size)
        propagate(reference, loaders(shots, 2))  # kernels are compiled or loaded
        with watched_poisson() as poisson:
            wall, cpu = time.perf_counter(), time.process_time()
            done = propagate(reference, loaders(shots, count))
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        kept = sum(a.nbytes for p in done.views for a in (p.image, p.raw, p.rules))
        row = {
            "views": count,
            "size": size,
            "hole": float(np.mean([s.view.target.mean() for s in shots])),
            "wall_s": wall,
            "cpu_s": cpu,
            "cpu_ms_per_view": 1e3 * cpu / count,
            "poisson_share": poisson.seconds / cpu,
            "kept_mib_per_view": kept / count / MIB,
            "load": os.getloadavg()[0],
            "cores": available_cores(),
        }
        say(
            f"{count:4} views {size[0]}×{size[1]}: {wall:.1f} s wall, {cpu:.1f} s CPU, "
            f"{row['cpu_ms_per_view']:.0f} ms per view, Poisson {row['poisson_share']:.0%}"
        )
        rows.append(row)
    return rows


def memory(cases: tuple[tuple[int, Size], ...]) -> list[dict[str, Any]]:
    """Peak memory above that of the room itself, each case in a process of its own."""
    rows = [_in_new_process(count, size) for count, size in cases]
    for row in rows:
        say(
            f"{row['views']:4} views {row['size'][0]}×{row['size'][1]}: peak {row['peak_mib']:.0f} MiB above the room, "
            f"{row['kept_mib']:.0f} MiB of it results; all views at once would be {row['all_views_mib']:.0f} MiB"
        )
    return rows


def _in_new_process(count: int, size: Size) -> dict[str, Any]:
    code = f"import json, propagate_cost; print(json.dumps(propagate_cost.peak_of({count}, {tuple(size)})))"
    paths = [str(Path(__file__).resolve().parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def peak_of(count: int, size: Size) -> dict[str, Any]:
    reference, shots = room(size)
    propagate(reference, loaders(shots, 1))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    done = propagate(reference, loaders(shots, count))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    view = shots[0].view
    one = sum(a.nbytes for a in vars(view).values() if isinstance(a, np.ndarray))
    return {
        "views": count,
        "size": size,
        "peak_mib": (peak - before) / 1024,
        "kept_mib": sum(a.nbytes for p in done.views for a in (p.image, p.raw, p.rules)) / MIB,
        "all_views_mib": count * one / MIB,
    }


def exactness(size: Size, views: int) -> dict[str, Any]:
    """The blend's systems against a sparse factor in double precision, and pixels changed outside the hole."""
    reference, shots = room(size)
    with watched_poisson(keep=True) as poisson:
        done = propagate(reference, loaders(shots, views))
    largest, total, unknowns = 0.0, 0.0, 0
    for (hole, *_), more, solution in poisson.systems:
        domain = np.asarray(hole) & ~solution.unanchored
        difference = np.abs(solution.values[domain] - _directly(domain, more["weight"], more["anchor"]))
        largest = max(largest, float(difference.max(initial=0.0)))
        total, unknowns = total + float(difference.sum()), unknowns + difference.size
    outside = sum(
        int((part.pasted(s.view.base) != s.view.base).any(-1)[~s.view.target].sum())
        for part, s in zip(done.views, shots)
    )
    row = {
        "size": size,
        "views": views,
        "unknowns": unknowns // 3,
        "largest_grey_levels": largest,
        "mean_grey_levels": total / max(1, unknowns),
        "changed_outside": outside,
    }
    say(f"Poisson: off by {largest:.4f} grey levels at most; {outside} pixels changed outside the hole")
    return row


def _directly(domain: np.ndarray, weight: np.ndarray, anchor: np.ndarray) -> np.ndarray:
    """[N, 3]: the screened system's solution by a sparse factor."""
    index = np.full(domain.shape, -1)
    index[domain] = np.arange(domain.sum())
    links = []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        both = domain[a] & domain[b]
        links.append(np.stack([index[a][both], index[b][both]]))
    i, j = np.concatenate(links, 1)
    count = int(domain.sum())
    graph = scipy.sparse.coo_matrix((np.ones(len(i)), (i, j)), (count, count))
    graph = graph + graph.T
    held = np.asarray(weight)[domain]
    matrix = scipy.sparse.diags(np.asarray(graph.sum(1)).ravel() + held) - graph
    return scipy.sparse.linalg.splu(matrix.tocsc()).solve(held[:, None] * np.asarray(anchor)[domain])

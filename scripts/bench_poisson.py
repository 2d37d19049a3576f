"""Measures the Poisson solver in one run, against pyamg and SciPy: time, iterations, error and memory by size, shape
and share of the hole, and by tolerance; several channels.

Writes OUT/poisson.json, OUT/poisson.md and a chart. Times are CPU ms of one thread, the best of several repetitions in
which the solvers take turns. Run by `make bench-poisson`.

    python scripts/bench_poisson.py [--quick] [--out build/bench_poisson] [--chart FILE.svg]
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse
import ctypes
import json
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyamg
import scipy
import scipy.ndimage
import scipy.sparse
import scipy.sparse.linalg
from bench_raster import HERE, ROOT, machine, say, write
from poisson_report import draw_chart, markdown

from gimp3d.compute.threads import set_thread_count
from gimp3d.solvers.poisson import PoissonSettings, solve_hole

SIZES = {"480p": (480, 854), "1080p": (1080, 1920), "4K": (2160, 3840)}
TOLERANCES = (1e-3, 1e-6, 1e-9)
MOST_SECONDS = 60.0  # of a direct solve; without one the error is that to a residual of 1e-13
SLOW_S, REPETITIONS, SLOW_REPETITIONS = 1.0, 9, 2  # what takes longer than SLOW_S is repeated less often
DIRECT = ("spsolve", "splu")
OURS, OURS_SINGLE = "gimp3d", "gimp3d float32"


@dataclass(frozen=True)
class Case:
    """A hole in an image."""

    size: str
    share: float = 0.08
    shape: str = "blob"  # one irregular part; "parts": many, with islands, some at the border
    screened: bool = False  # a fifth of the pixels drawn to values of their own


@dataclass(frozen=True)
class Problem:
    """A·x = b for x = u − level; where pixels are drawn, they are to `anchor` with `weight`."""

    hole: np.ndarray
    values: np.ndarray
    weight: np.ndarray | None
    anchor: np.ndarray | None
    matrix: scipy.sparse.csr_matrix
    right: np.ndarray
    level: float
    assembly_ms: float


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="480p only, in seconds")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench_poisson")
    parser.add_argument(
        "--chart", type=Path, help="default: assets/poisson_speed.svg, or OUT/poisson_speed.svg if --quick"
    )
    given = parser.parse_args()
    chart = given.chart or (given.out if given.quick else ROOT / "assets") / "poisson_speed.svg"
    sizes = ["480p"] if given.quick else list(SIZES)
    set_thread_count(1)

    host = {**machine(), "scipy": scipy.__version__, "pyamg": pyamg.__version__}
    say(", ".join(f"{name} {value}" for name, value in host.items()))
    results: dict[str, Any] = {"quick": given.quick, "machine": host}
    warm_up()
    results["memory"] = [memory(size, solver) for size in sizes[-1:] for solver in SOLVERS]
    results["by_tolerance"] = [row for size in sizes for row in compared(Case(size), TOLERANCES, DIRECT)]
    others = [Case(s, share) for s in sizes for share in (0.05, 0.15)]
    others += [Case(s, shape="parts") for s in sizes] + [Case(s, screened=True) for s in sizes]
    results["by_shape"] = [row for case in others for row in compared(case, (1e-6,), ())]
    results["channels"] = [row for size in sizes for row in channels(Case(size))]

    write(given.out / "poisson.json", json.dumps(results, indent=1))
    write(given.out / "poisson.md", markdown(results))
    write(chart, draw_chart(results))
    rows = results["by_tolerance"] + results["by_shape"]
    missed = [r for r in rows if r["solver"] != OURS_SINGLE and r["residual"] > 1.01 * (r["tolerance"] or 1e-12)]
    for row in missed:
        say(f"the residual is above the tolerance: {row}")
    return 1 if missed else 0


# -------------------------------------------------------------------------------------------------------- the problem


def make_hole(case: Case) -> np.ndarray:
    """[H, W] bool with the share of pixels asked for."""
    h, w = SIZES[case.size]
    rng = np.random.default_rng(7)
    if case.shape == "parts":
        small = scipy.ndimage.gaussian_filter(rng.standard_normal((120, 214)), 5)
        field = scipy.ndimage.zoom(small, (h / 120, w / 214), order=1)[:h, :w]
        field += 0.1 * field.std() * scipy.ndimage.gaussian_filter(rng.standard_normal((h, w)), 1.5)
        return field > np.quantile(field, 1 - case.share)
    y, x = np.mgrid[:h, :w]
    y, x = y - rng.uniform(0.42, 0.58) * h, x - rng.uniform(0.42, 0.58) * w
    angle = np.arctan2(y, x)
    radius = 1 + sum(
        a * np.sin(k * angle + rng.uniform(0, 6)) for k, a in ((2, 0.25), (3, 0.15), (7, 0.08), (40, 0.01))
    )
    distance = np.hypot(x, y) / radius
    return distance < np.quantile(distance, case.share)


def make_values(case: Case, channels: int = 1) -> np.ndarray:
    """[H, W, channels]: waves of all lengths and noise."""
    h, w = SIZES[case.size]
    y, x = np.mgrid[:h, :w] / h
    rng = np.random.default_rng(1)
    waves = np.sin(7 * x + 3 * y) + 0.5 * np.cos(23 * x * y)
    return waves[..., None] + 0.1 * rng.standard_normal((h, w, channels))


@cache
def problem(case: Case) -> Problem:
    hole, values = make_hole(case), make_values(case)[..., 0]
    weight = anchor = None
    if case.screened:
        rng = np.random.default_rng(2)
        weight = np.where(rng.random(hole.shape) < 0.2, 10 ** rng.uniform(-3, 1, hole.shape), 0.0)
        anchor = rng.standard_normal(hole.shape)
    start = time.process_time()
    matrix, right, level = assemble(hole, values, weight, anchor)
    return Problem(hole, values, weight, anchor, matrix, right, level, 1e3 * (time.process_time() - start))


def assemble(
    hole: np.ndarray, values: np.ndarray, weight: np.ndarray | None, anchor: np.ndarray | None
) -> tuple[scipy.sparse.csr_matrix, np.ndarray, float]:
    """Matrix, right-hand side, and the constant that it is relative to: the one that fits best."""
    rows, columns = np.nonzero(hole)
    count = len(rows)
    index = np.full(np.add(hole.shape, 2), -1)
    index[rows + 1, columns + 1] = np.arange(count)
    known = np.pad(np.where(hole, np.nan, values), 1, constant_values=np.nan)
    ties, right, pairs = np.zeros(count), np.zeros(count), []
    degree = np.zeros(count)
    for dy, dx in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        q = rows + 1 + dy, columns + 1 + dx
        linked = np.flatnonzero(index[q] >= 0)
        pairs.append((linked, index[q][linked]))
        degree[linked] += 1
        tied = np.isfinite(known[q])
        ties += tied
        right += np.where(tied, known[q], 0)
    if weight is not None and anchor is not None:
        ties += weight[hole]
        right += (weight * anchor)[hole]
    level = right.sum() / ties.sum()
    here, there = (np.concatenate(side) for side in zip(*pairs))
    links = scipy.sparse.csr_matrix((np.ones(len(here)), (here, there)), (count, count))
    return (scipy.sparse.diags(degree + ties) - links).tocsr(), right - level * ties, level


# -------------------------------------------------------------------------------------------------------- the solvers

Solution = tuple[np.ndarray, int | None]  # x, iterations


def ours(precision: str) -> Callable[[Problem, float], Solution]:
    def solve(given: Problem, tolerance: float) -> Solution:
        chosen = PoissonSettings(tolerance, precision=precision)
        found = solve_hole(
            given.hole, ~given.hole, given.values, settings=chosen, weight=given.weight, anchor=given.anchor
        )
        return found.values - given.level, found.iterations

    return solve


def pyamg_cg(given: Problem, tolerance: float) -> Solution:
    residuals: list[float] = []
    levels = pyamg.ruge_stuben_solver(given.matrix)
    return levels.solve(given.right, tol=tolerance, accel="cg", residuals=residuals), len(residuals) - 1


def scipy_cg(given: Problem, tolerance: float) -> Solution:
    steps = [0]

    def count(_: np.ndarray) -> None:
        steps[0] += 1

    found, _ = scipy.sparse.linalg.cg(given.matrix, given.right, rtol=tolerance, maxiter=100_000, callback=count)
    return found, steps[0]


def spsolve(given: Problem, _: float) -> Solution:
    return scipy.sparse.linalg.spsolve(given.matrix.tocsc(), given.right), None


def splu(given: Problem, _: float) -> Solution:
    """The ordering for symmetric matrices, several times as fast as the default one."""
    options = {"SymmetricMode": True, "DiagPivotThresh": 0.0}
    factor = scipy.sparse.linalg.splu(given.matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", options=options)
    return factor.solve(given.right), None


SOLVERS: dict[str, Callable[[Problem, float], Solution]] = {
    OURS: ours("float64"),
    OURS_SINGLE: ours("float32"),
    "pyamg RS + CG": pyamg_cg,
    "SciPy CG": scipy_cg,
    "splu": splu,
    "spsolve": spsolve,
}


# ------------------------------------------------------------------------------------------------------------ measured


def compared(case: Case, tolerances: tuple[float, ...], direct: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """Every solver at every tolerance: time, iterations, true residual, and error against a direct solution."""
    given = problem(case)
    about = {**asdict(case), "unknowns": len(given.right), "assembly_ms": round(given.assembly_ms, 1)}
    exact, exact_by, range_ = None, "gimp3d to 1e-13", np.ptp(given.values[given.hole])
    rows = []
    for solver in direct:
        with tempfile.TemporaryDirectory() as folder:
            answer = in_child(f"solved_directly({case}, {solver!r}, {folder!r})", seconds=MOST_SECONDS)
            if answer is None:
                say(f"{case.size} {solver}: stopped after {MOST_SECONDS:.0f} s")
                rows.append({**about, "solver": solver, "tolerance": None, "ms": None, "residual": 0.0})
                continue
            exact, exact_by = np.load(answer["file"]), solver
        rows.append(outcome(about, solver, None, given, exact, answer["ms"], None))
    if exact is None:
        exact = SOLVERS[OURS](given, 1e-13)[0]
    iterative = [name for name in SOLVERS if name not in DIRECT]
    for tolerance in tolerances:
        names = [n for n in iterative if n != OURS_SINGLE or tolerance >= 1e-6]  # float32 has no 9 digits
        times, found = taking_turns({n: lambda n=n, t=tolerance: SOLVERS[n](given, t) for n in names})
        for name in names:
            rows.append(outcome(about, name, tolerance, given, found[name][0], times[name], found[name][1]))
    for row, x in ((r, r.pop("x")) for r in rows if "x" in r):
        row["error"] = float(np.abs(x - exact).max() / range_)
        row["exact_by"] = exact_by
        say(" ".join(f"{key} {value}" for key, value in row.items() if key not in ("assembly_ms", "exact_by")))
    problem.cache_clear()
    yield from rows


def outcome(
    about: dict[str, Any],
    solver: str,
    tolerance: float | None,
    given: Problem,
    x: np.ndarray,
    ms: float,
    iterations: int | None,
) -> dict[str, Any]:
    residual = np.linalg.norm(given.right - given.matrix @ x.astype(np.float64)) / np.linalg.norm(given.right)
    row = {**about, "solver": solver, "tolerance": tolerance, "ms": round(ms, 3), "iterations": iterations}
    return {**row, "residual": float(residual), "x": x}


def taking_turns(runs: dict[str, Callable[[], Any]]) -> tuple[dict[str, float], dict[str, Any]]:
    """The least CPU time of each in ms, and what it gave."""
    best, gave = {}, {}
    for repetition in range(REPETITIONS):
        for name, run in runs.items():
            if repetition < SLOW_REPETITIONS or best[name] < 1e3 * SLOW_S:
                start = time.process_time()
                gave[name] = run()
                best[name] = min(1e3 * (time.process_time() - start), best.get(name, np.inf))
    return best, gave


def channels(case: Case) -> Iterator[dict[str, Any]]:
    """A picture of three channels blended (gradients of another one), and one channel of it."""
    hole, values, fill = make_hole(case), make_values(case, 3), make_values(case, 3)[::-1]
    for precision in ("float64", "float32"):
        kind = np.dtype(precision).type
        settings = PoissonSettings(precision=precision)  # the default tolerance
        arrays = {n: (values[..., :n].astype(kind), fill[..., :n].astype(kind)) for n in (1, 3)}
        runs = {str(n): lambda n=n, s=settings, a=arrays: solve_hole(hole, ~hole, *a[n], s) for n in (1, 3)}
        best, _ = taking_turns(runs)
        row = {"size": case.size, "unknowns": int(hole.sum()), "precision": precision}
        row |= {
            "one_ms": round(best["1"], 3),
            "three_ms": round(best["3"], 3),
            "ratio": round(best["3"] / best["1"], 2),
        }
        say(" ".join(f"{key} {value}" for key, value in row.items()))
        yield row


def memory(size: str, solver: str) -> dict[str, Any]:
    """The most memory of a process for a solve, above that with the problem alone."""
    answer = in_child(f"memory_of({size!r}, {solver!r})", seconds=MOST_SECONDS)
    row = {"size": size, "solver": solver, "mib": answer}
    say(f"memory {size} {solver}: {answer} MiB")
    return row


# ------------------------------------------------------------------------------------------- in processes of their own


def in_child(call: str, seconds: float | None = None) -> Any:
    """What `call` of this module gives there; None if it takes longer."""
    paths = [str(HERE), *filter(None, [os.environ.get("PYTHONPATH")])]
    code = f"import json, bench_poisson; from bench_poisson import *; print(json.dumps({call}))"
    try:
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
            stdout=subprocess.PIPE,
            text=True,
            check=True,
            timeout=seconds,
        )
    except subprocess.TimeoutExpired:
        return None
    return json.loads(done.stdout.splitlines()[-1])


def warm_up() -> None:
    """Compile or load all kernels."""
    for case in (Case("480p"), Case("480p", screened=True)):
        for name in (OURS, OURS_SINGLE):
            SOLVERS[name](problem(case), 1e-3)
    list(channels(Case("480p")))


def solved_directly(case: Case, solver: str, folder: str) -> dict[str, Any]:
    given, file = problem(case), f"{folder}/x.npy"
    start = time.process_time()
    x, _ = SOLVERS[solver](given, 0.0)
    ms = 1e3 * (time.process_time() - start)
    np.save(file, x)
    return {"ms": ms, "file": file}


def memory_of(size: str, solver: str) -> float | None:
    """MiB; None where the system cannot tell."""
    status, reset = Path("/proc/self/status"), Path("/proc/self/clear_refs")
    if not reset.exists():
        return None
    given = problem(Case(size))
    SOLVERS[solver](problem(Case("480p", share=0.01)), 1e-6)

    def kib(name: str) -> int:
        return next(int(line.split()[1]) for line in status.read_text().splitlines() if line.startswith(name))

    ctypes.CDLL(None).malloc_trim(0)  # what making the problem used goes back to the system
    reset.write_text("5")  # the peak is what is used now
    before = kib("VmRSS")
    _kept = SOLVERS[solver](given, 1e-6)
    return round((kib("VmHWM") - before) / 1024, 1)


if __name__ == "__main__":
    warnings.filterwarnings("ignore", category=scipy.sparse.SparseEfficiencyWarning)
    sys.exit(main())

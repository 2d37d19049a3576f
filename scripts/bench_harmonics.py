"""Measures the SH fit in one run: speed against torch and NumPy, accuracy inside and outside the cone of views on
simulated materials, what bad observations do, and, given the benchmark scenes, what it brings to a removal.

Writes OUT/harmonics.json, OUT/harmonics.md and two charts. Times are the best of several repetitions: other processes
can only make them longer. Run by `make bench-harmonics`.

    python scripts/bench_harmonics.py [--quick] [--data FOLDER] [--out build/bench_harmonics] [--charts FOLDER]
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from bench_raster import Watch, best_of, cost, machine, say, write
from harmonics_report import accuracy_chart, markdown, stability_chart
from materials import MATERIALS, RULES, errors_of, simulate

from gimp3d.compute.threads import set_thread_count
from gimp3d.evaluate import benchmark
from gimp3d.pipeline import PRESETS
from gimp3d.solvers.harmonics import HarmonicsSettings, Observations, fit_harmonics, sh_basis

ROOT = Path(__file__).resolve().parents[1]
RIDGE = 0.01  # of the fits that are the same for all
FEW = 1000  # Gaussians that slow methods are timed on; their times are scaled up
SLOW = ("torch lstsq", "numpy lstsq")
SEEDS = (100, 101)  # not those on which the constants of the fit were chosen
SCENES = ("desk", "corner", "gloss", "rocks", "desk_shadow", "corner_shadow")


@dataclass(frozen=True)
class Plan:
    """What is measured."""

    count: int  # Gaussians that are timed
    views: tuple[int, ...]
    threads: tuple[int, ...]
    repetitions: int
    simulated_views: tuple[int, ...]
    cones: tuple[int, ...]  # half angles, degrees
    each: int  # simulated Gaussians per material


FULL = Plan(50_000, (10, 30, 100), (1, 4), 5, (5, 10, 30, 100), (10, 30, 90), 300)
QUICK = Plan(2_000, (10, 30), (1,), 2, (5, 30), (10, 90), 40)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="less of everything, in seconds")
    parser.add_argument("--data", type=Path, help="with/without scenes, to measure removals too (ten minutes more)")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench_harmonics")
    parser.add_argument("--charts", type=Path, help="default: assets, or OUT if --quick")
    given = parser.parse_args()
    plan = QUICK if given.quick else FULL
    results: dict[str, Any] = {"quick": given.quick, "machine": machine(), "count": plan.count, "ridge": RIDGE}
    results["speed"] = list(speed(plan))
    results["accuracy"] = list(accuracy(plan))
    results["stability"] = list(stability(plan))
    results["scenes"] = scenes(given.data, given.out) if given.data else []
    charts = given.charts or (given.out if given.quick else ROOT / "assets")
    write(given.out / "harmonics.json", json.dumps(results, indent=1))
    write(given.out / "harmonics.md", markdown(results))
    write(charts / "harmonics.svg", accuracy_chart(results))
    write(charts / "harmonics_stability.svg", stability_chart(results))
    return 0


# -------------------------------------------------------------------------------------------------------------- speed


def speed(plan: Plan) -> Iterator[dict[str, Any]]:
    """Time per case and method, and how far the methods that do the same differ."""
    for threads in plan.threads:
        for views in plan.views:
            for degree in (1, 2, 3):
                row: dict[str, Any] = {"threads": threads, "views": views, "degree": degree}
                row |= timed(plan, views, degree, threads)
                yield row
                told = ", ".join(f"{name} {c['cpu_ms']:.0f}" for name, c in row["times"].items())
                say(f"{views:>3} views, degree {degree}, {threads} thr, ms CPU: {told}")


def timed(plan: Plan, views: int, degree: int, threads: int) -> dict[str, Any]:
    anchors, references, observed = random_observations(plan.count, views)
    set_thread_count(threads)
    fixed = HarmonicsSettings(ridge=RIDGE)
    methods = {
        "gimp3d": lambda: fit_harmonics(anchors, references, observed, degree),
        "gimp3d, fixed": lambda: fit_harmonics(anchors, references, observed, degree, fixed),
        **torch_methods(anchors, references, observed, degree, threads),
        "numpy lstsq": lambda: numpy_lstsq(anchors, references, observed, degree),
    }
    times, found = {}, {}
    for name, method in methods.items():
        found[name] = method()
        slow = name in SLOW
        best = best_of(lambda m=method: lap(m), 1 if slow else plan.repetitions)
        times[name] = cost(best * (plan.count / min(FEW, plan.count) if slow else 1))
    if "torch Cholesky" not in found:
        return {"times": times}
    difference = np.abs(found["gimp3d, fixed"].sh[:, 1:] - found["torch Cholesky"]).max()
    return {"times": times, "difference": float(difference)}


def lap(method: Any) -> tuple[float, float]:
    watch = Watch()
    method()
    return watch.lap()


def random_observations(count: int, views: int) -> tuple[np.ndarray, np.ndarray, Observations]:
    """Directions in a wide cone; the first is the reference. All in float32."""
    rng = np.random.default_rng(0)
    directions = 0.5 * rng.normal(size=(count, views, 3)) + [0, 0, 1]
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    colours = rng.uniform(0.4, 0.5, (count, views, 3)).astype(np.float32)
    directions = directions.astype(np.float32)
    weights = rng.uniform(0.1, 1, count * views).astype(np.float32)
    offsets = np.arange(count + 1) * views
    observed = Observations(offsets, directions.reshape(-1, 3), colours.reshape(-1, 3), weights)
    return colours[:, 0].copy(), directions[:, 0].copy(), observed


def torch_methods(
    anchors: np.ndarray, references: np.ndarray, observed: Observations, degree: int, threads: int
) -> dict[str, Any]:
    """The fixed fit by batched tensors, basis and weights included."""
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # or threads that wait on a busy machine count as work
    try:
        import torch
    except ImportError:
        return {}
    torch.set_num_threads(threads)
    n, k = len(anchors), (degree + 1) ** 2 - 1
    sigma = fit_harmonics(anchors, references, observed, 0).sigma
    c0, w0, towards, colours, given = (
        torch.from_numpy(a).reshape(n, -1, *a.shape[1:])
        for a in (anchors, references, observed.directions, observed.colours, observed.weights)
    )

    def basis(directions: torch.Tensor) -> torch.Tensor:
        x, y, z = directions.unbind(-1)
        return torch.stack(list(TERMS[degree](x, y, z)), -1)

    def system(few: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        residuals, cosine = colours[:few] - c0[:few], (towards[:few] * w0[:few]).sum(-1)
        scale = sigma * torch.exp(1 - cosine)
        weights = given[:few] * torch.exp(-(residuals**2).sum(-1) / (2 * scale**2))
        return basis(towards[:few]) - basis(w0[:few]), residuals, weights[..., None]

    def cholesky() -> np.ndarray:
        x, residuals, weights = system(n)
        weighted = (x * weights).transpose(1, 2)
        factor = torch.linalg.cholesky(weighted @ x + RIDGE * torch.eye(k))
        return torch.cholesky_solve(weighted @ residuals, factor).numpy()

    def lstsq() -> np.ndarray:
        x, residuals, weights = system(FEW)
        root, m = weights.sqrt(), len(x)
        ridge = math.sqrt(RIDGE) * torch.eye(k).expand(m, k, k)
        left, right = torch.cat([x * root, ridge], 1), torch.cat([residuals * root, torch.zeros(m, k, 3)], 1)
        return torch.linalg.lstsq(left, right).solution.numpy()

    return {"torch Cholesky": cholesky, "torch lstsq": lstsq}


def terms(degree: int) -> Any:
    """Y_k, k ≥ 1, of tensors: sh_basis makes NumPy arrays."""
    from gimp3d.sh import C1, C2, C3

    def values(x: Any, y: Any, z: Any) -> Iterator[Any]:
        yield from (-C1 * y, C1 * z, -C1 * x)
        xx, yy, zz = x * x, y * y, z * z
        if degree > 1:
            yield from (C2[0] * x * y, C2[1] * y * z, C2[2] * (2 * zz - xx - yy), C2[3] * x * z, C2[4] * (xx - yy))
        if degree > 2:
            yield from (C3[0] * y * (3 * xx - yy), C3[1] * x * y * z, C3[2] * y * (4 * zz - xx - yy))
            yield from (C3[3] * z * (2 * zz - 3 * xx - 3 * yy), C3[4] * x * (4 * zz - xx - yy))
            yield from (C3[5] * z * (xx - yy), C3[6] * x * (xx - 3 * yy))

    return values


TERMS = {degree: terms(degree) for degree in (1, 2, 3)}


def numpy_lstsq(anchors: np.ndarray, references: np.ndarray, observed: Observations, degree: int) -> list[np.ndarray]:
    """The given weights alone: the loop is the cost."""
    k, found = (degree + 1) ** 2 - 1, []
    for i in range(min(FEW, len(anchors))):
        here = slice(observed.offsets[i], observed.offsets[i + 1])
        root = np.sqrt(observed.weights[here])[:, None]
        x = (sh_basis(observed.directions[here], degree) - sh_basis(references[i], degree))[:, 1:]
        left = np.concatenate([x * root, math.sqrt(RIDGE) * np.eye(k)])
        right = np.concatenate([(observed.colours[here] - anchors[i]) * root, np.zeros((k, 3))])
        found.append(np.linalg.lstsq(left, right, rcond=None)[0])
    return found


# ----------------------------------------------------------------------------------------------- accuracy, stability


def accuracy(plan: Plan) -> Iterator[dict[str, Any]]:
    """RMSE per number of views, cone, material and rule, inside and outside the cone; 8 % of observations wrong."""
    for views in plan.simulated_views:
        for half_angle in plan.cones:
            found: dict[tuple[str, str], list[np.ndarray]] = {}
            for seed in SEEDS:
                s = simulate(views, math.radians(half_angle), seed, plan.each)
                for rule in RULES:
                    for where, errors in errors_of(s, rule).items():
                        per_kind = [np.mean(errors[s.kinds == kind] ** 2) for kind in range(len(MATERIALS))]
                        found.setdefault((rule, where), []).append(np.sqrt(per_kind))
            for rule in RULES:
                inside, outside = (np.mean(found[rule, where], 0) for where in ("inside", "outside"))
                for kind, name in enumerate(MATERIALS):
                    row = {"views": views, "cone": half_angle, "rule": rule, "material": name}
                    yield row | {"inside": float(inside[kind]), "outside": float(outside[kind])}
    say("accuracy: done")


def stability(plan: Plan) -> Iterator[dict[str, Any]]:
    """Error curves: RMSE inside the cone, and the 99th percentile of errors all round."""
    cases: dict[str, dict[float, dict[str, Any]]] = {
        "wrong observations": {x: {"wrong": x} for x in (0.0, 0.1, 0.2, 0.3, 0.4)},
        "exposure jumps": {x: {"jump": 1 + x} for x in (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)},
        "reference lit otherwise": {x: {"exposure": 1 - x} for x in (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)},
        "views": {x: {"views": x} for x in (1, 2, 3, 5, 10, 20, 40)},
        "clustered views": {
            x: {"views": 10, "half_angle": math.radians(x), "away": math.radians(45)} for x in (0.1, 0.3, 1, 3, 10, 30)
        },
        "two near-equal views": {x: {"views": 2, "half_angle": math.radians(x)} for x in (0.01, 0.1, 1, 3, 10, 30)},
    }
    for case, settings in cases.items():
        for x, changed in settings.items():
            usual = {"views": 30, "half_angle": math.radians(40), "seed": SEEDS[0], "each": plan.each}
            s = simulate(**{**usual, **changed})
            for rule in RULES:
                errors = errors_of(s, rule)
                inside = float(np.sqrt(np.mean(errors["inside"] ** 2)))
                all_round = float(np.quantile(np.abs(errors["all round"]), 0.99))
                yield {"case": case, "x": x, "rule": rule, "inside": inside, "all_round": all_round}
    say("stability: done")


# ------------------------------------------------------------------------------------------------------------- scenes


def scenes(data: Path, out: Path) -> list[dict[str, Any]]:
    """Removals with the balanced preset, by how the colours are fitted."""
    balanced = PRESETS["balanced"]
    asked = {
        "degree 0": (0, HarmonicsSettings()),
        "degree 1, ridge 1": (1, HarmonicsSettings(ridge=1.0)),
        "floor 20": (2, HarmonicsSettings()),
        "floor 20, offset": (2, HarmonicsSettings(offset=True)),
    }
    variants = {
        name: replace(balanced.seed, sh_degree=degree, harmonics=settings) for name, (degree, settings) in asked.items()
    }
    presets = {name: replace(balanced, seed=changed) for name, changed in variants.items()}
    with mock.patch.dict(PRESETS, presets), mock.patch.object(benchmark, "BASELINES", ()):
        rows = benchmark.run_benchmark(data, out / "scenes", SCENES, list(presets))
    say(benchmark.table(rows))
    return rows


if __name__ == "__main__":
    sys.exit(main())

"""Measures the rasteriser in one run: speed by size, resolution and threads, blends per second and their share of the
core's peak, the region case, first calls, memory, and against plain torch and (where given) the first prototype.

Writes OUT/raster.json, OUT/raster.md and a chart. Times are the best of several repetitions: other processes can only
make them longer. Run by `make bench-raster`.

    python scripts/bench_raster.py [--quick] [--prototype FOLDER] [--out build/bench_raster] [--chart FILE.svg]
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from itertools import cycle
from pathlib import Path
from typing import Any
from unittest import mock

import llvmlite.binding
import numba
import numpy as np
from chart import in_words
from raster_report import draw_chart, markdown, shown

from gimp3d.camera import Camera
from gimp3d.compute.simd import fma16, splat16, store16
from gimp3d.compute.threads import available_cores, set_thread_count
from gimp3d.gaussians import Gaussians
from gimp3d.job import write_atomically
from gimp3d.raster import PictureGradients, backward, contributions, cpu, pixel_region, render, trace

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent

PASSES = frozenset({"rgb", "alpha", "expected_depth"})
SEED, SIZE = 0, 0.7  # of the scene; the prototype's own benchmark takes the same
FOV = math.radians(60.0)  # horizontal
SLOW_MS, SLOW_REPETITIONS = 1000.0, 3  # what takes longer is repeated less often
LANES = 16
# Floating-point operations per lane of a 3D Gaussian with rgb and expected depth; comparisons, selections and integer
# operations are not counted, nor what is done once per list entry.
ALPHA_FLOPS = 2 + 4 + 13  # whitened offset; opacity − |offset|²; 2^x: 3 to split, 5 FMA
BLEND_FLOPS = ALPHA_FLOPS + 2 + 8  # weight and transmittance; FMA for r, g, b, z
# value: 4 FMA; a step back: 1 − alpha, /, weight, −, FMA, p; sums of r, g, b, z: 4 FMA; moments: 2 × p, 3 +, 3 FMA
UNBLEND_FLOPS = ALPHA_FLOPS + 8 + 7 + 8 + 11
LARGEST_DIFFERENCE, MEAN_DIFFERENCE = 1e-2, 1e-3  # of rgb between torch's picture and ours
PARAMETERS = ("means", "log_scales", "quats", "opacity_logits", "sh")
SLAB = (5.2, 6.2)  # depths of the region's active Gaussians

Size = tuple[int, int]
SMALL, HALF_HD, FULL_HD = (480, 270), (960, 540), (1920, 1080)


@dataclass(frozen=True)
class Plan:
    """What is measured."""

    counts: tuple[int, ...]
    sizes: tuple[Size, ...]
    threads: tuple[int, ...]
    surfel_counts: tuple[int, ...]
    surfel_sizes: tuple[Size, ...]
    surfel_threads: tuple[int, ...]
    prototype: tuple[tuple[int, Size], ...]
    torch: tuple[int, Size]
    region: tuple[int, Size]
    rectangle: tuple[int, int, int, int]  # left, top, width, height
    active: int
    memory: tuple[tuple[int, Size], ...]
    repetitions: int


FULL = Plan(
    counts=(100_000, 500_000, 2_000_000),
    sizes=(SMALL, HALF_HD, FULL_HD),
    threads=(1, 2, 4),
    surfel_counts=(100_000, 500_000),
    surfel_sizes=(SMALL, HALF_HD),
    surfel_threads=(1, 4),
    prototype=((100_000, SMALL), (500_000, SMALL), (500_000, HALF_HD)),
    torch=(100_000, SMALL),
    region=(500_000, SMALL),
    rectangle=(160, 96, 160, 80),
    active=10_000,
    memory=((500_000, HALF_HD), (2_000_000, FULL_HD)),
    repetitions=8,
)
QUICK = Plan(
    counts=(20_000,),
    sizes=(SMALL,),
    threads=(1, 4),
    surfel_counts=(20_000,),
    surfel_sizes=(SMALL,),
    surfel_threads=(4,),
    prototype=((20_000, SMALL),),
    torch=(20_000, (120, 68)),
    region=(20_000, SMALL),
    rectangle=(160, 96, 160, 80),
    active=400,
    memory=((20_000, SMALL),),
    repetitions=2,
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="20k Gaussians at 480×270 only, below a minute")
    parser.add_argument("--prototype", type=Path, help="folder of the first prototype, to compare with")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench_raster")
    parser.add_argument(
        "--chart", type=Path, help="default: assets/raster_speed.svg, or OUT/raster_speed.svg if --quick"
    )
    given = parser.parse_args()
    plan = QUICK if given.quick else FULL
    chart = given.chart or (given.out if given.quick else ROOT / "assets") / "raster_speed.svg"

    results: dict[str, Any] = {"quick": given.quick, "machine": machine()}
    say(", ".join(f"{name} {value}" for name, value in results["machine"].items()))
    in_new_process("warm_up()")  # a process that compiles needs more memory than one that finds the kernels
    # Memory first, while this process is small: a child's ru_maxrss begins with that of the process that started it.
    results["memory"] = [memory(n, size) for n, size in plan.memory]
    results["first_call"] = first_calls(plan.counts[0])
    warm_up()
    results["peak_gflops_per_core"] = peak_gflops()
    say(f"FMA peak {results['peak_gflops_per_core']:.1f} GFLOP/s per core")
    results["flops"] = {"forward": BLEND_FLOPS, "backward": UNBLEND_FLOPS}  # per lane
    results["speed"] = list(speed(plan))
    results["blends"] = blends(results["speed"], results["peak_gflops_per_core"])
    results["region"] = [region(plan, threads, slab) for slab in (True, False) for threads in (1, 4)]
    results["prototype"] = prototype(given.prototype, plan) if given.prototype else []
    scene.cache_clear()
    results["torch"] = against_torch(plan)

    write(given.out / "raster.json", json.dumps(results, indent=1))
    write(given.out / "raster.md", markdown(results))
    write(chart, draw_chart(results))
    if results["torch"] and not results["torch"]["agrees"]:
        say("torch's picture differs from ours: the comparison is worth nothing")
        return 1
    return 0


# ---------------------------------------------------------------------------------------------------------- the scene


@cache
def scene(count: int, surfels: bool = False) -> Gaussians:
    """Sheets at four depths and a volume between; flattened, and the smaller the more there are, so that pixels see
    about as many of any count. The prototype's benchmark draws the same numbers in the same order."""
    rng = np.random.default_rng(SEED)
    on_sheet = rng.random(count) < 0.7
    sheets = 4 + 1.5 * rng.integers(0, 4, count) + 0.15 * rng.normal(size=count)
    z = np.where(on_sheet, sheets, rng.uniform(2.5, 10, count))
    means = np.stack([rng.uniform(-0.65, 0.65, count) * z, rng.uniform(-0.38, 0.38, count) * z, z], 1)
    sizes = np.log(0.0065 * SIZE * math.sqrt(100_000 / count) * z)[:, None] + 0.55 * rng.normal(size=(count, 1))
    log_scales = sizes + 0.35 * rng.normal(size=(count, 3))
    log_scales[np.arange(count), rng.integers(0, 3, count)] += math.log(0.15)
    quats = rng.normal(size=(count, 4))
    quats[:, 0] += 1
    logits = 1.8 * rng.normal(size=count) - 1.4
    kept = [a.astype(np.float32) for a in (means, log_scales[:, :2] if surfels else log_scales, quats, logits)]
    del on_sheet, sheets, z, means, sizes, log_scales, quats, logits
    sh = np.empty((count, 16, 3), np.float32)
    for part in np.array_split(sh, 64):  # in parts: float64 coefficients would be the peak of the memory measured
        part[:] = 0.12 * rng.normal(size=part.shape)
    sh[:, 0] = 0.8 * rng.normal(size=(count, 3))
    return Gaussians(*kept, sh)


def camera(size: Size) -> Camera:
    """At the origin, looking along z."""
    width, height = size
    focal = 0.5 * width / math.tan(FOV / 2)
    return Camera("bench", width, height, focal, focal, width / 2, height / 2, np.eye(4))


def picture_gradients(size: Size) -> PictureGradients:
    values = np.random.default_rng(SEED).normal(size=(5, size[1], size[0])).astype(np.float32)
    return PictureGradients(
        rgb=np.ascontiguousarray(np.moveaxis(values[:3], 0, 2)), alpha=values[3], expected_depth=values[4]
    )


# ------------------------------------------------------------------------------------------------------------- timing


class Watch:
    """(wall, CPU) in ms since the last lap; CPU time is that of all threads together."""

    def __init__(self) -> None:
        self.lap()

    def lap(self) -> tuple[float, float]:
        before = getattr(self, "last", (0.0, 0.0))
        self.last = time.perf_counter(), time.process_time()
        return 1e3 * (self.last[0] - before[0]), 1e3 * (self.last[1] - before[1])


def best_of(run: Callable[[], Any], repetitions: int) -> np.ndarray:
    """The least of each number that `run` gives."""
    watch = Watch()
    samples = [run()]
    if watch.lap()[0] > SLOW_MS:
        repetitions = min(repetitions, SLOW_REPETITIONS)
    samples += [run() for _ in range(repetitions - 1)]
    return np.min(samples, axis=0)


def cost(pair: Any) -> dict[str, float]:
    wall, cpu_time = pair
    return {"wall_ms": round(float(wall), 3), "cpu_ms": round(float(cpu_time), 3)}


@contextmanager
def tile_phases() -> Iterator[list[tuple[float, float]]]:
    """What the work on tiles alone costs: blending, and the way back through it."""
    over_tiles, laps = cpu.over_tiles, []

    def timed(*args: Any) -> None:
        watch = Watch()
        over_tiles(*args)
        laps.append(watch.lap())

    with mock.patch.object(cpu, "over_tiles", timed):
        yield laps


def draw_once(gaussians: Gaussians, view: Camera, gradients: PictureGradients) -> list[tuple[float, float]]:
    """(wall, CPU) of forward, backward, and in them blending and unblending."""
    with tile_phases() as phases:
        watch = Watch()
        _, traced = trace(gaussians, view, passes=PASSES)
        forward = watch.lap()
        _kept_until_read = backward(traced, gradients)  # giving the memory back is not the rasteriser's time
        return [forward, watch.lap(), *phases]


def warm_up() -> None:
    """Compile or load all kernels."""
    view, gradients = camera((64, 36)), picture_gradients((64, 36))
    for surfels in (False, True):
        draw_once(scene(500, surfels), view, gradients)
    gaussians = scene(500)
    contributions(gaussians, view)
    _, traced = pixel_region(gaussians, view, np.ones((36, 64), bool), passes=PASSES).trace(gaussians)
    traced.backward(gradients)
    scene.cache_clear()


# ----------------------------------------------------------------------------------------------------- what is measured


def speed(plan: Plan) -> Iterator[dict[str, Any]]:
    """Forward and backward of every configuration."""
    solid = [("3d", n, s, t) for n in plan.counts for s in plan.sizes for t in plan.threads]
    flat = [("surfels", n, s, t) for n in plan.surfel_counts for s in plan.surfel_sizes for t in plan.surfel_threads]
    for kind, n, size, threads in solid + flat:
        set_thread_count(threads)
        gaussians, view, gradients = scene(n, kind == "surfels"), camera(size), picture_gradients(size)
        costs = best_of(lambda g=gaussians, v=view, d=gradients: draw_once(g, v, d), plan.repetitions)
        names = ("forward", "backward", "blend", "unblend")
        row = {"kind": kind, "n": n, "size": size, "threads": threads, **dict(zip(names, map(cost, costs)))}
        if threads == 1:
            row["lanes"] = lanes_blended(trace(gaussians, view, passes=PASSES)[1])
        say(
            f"{kind:7} {in_words(n):>5} {shown(size):>9} {threads} thr: forward {ms(costs[0])}, backward {ms(costs[1])}"
        )
        yield row


def lanes_blended(traced: cpu.Trace) -> int:
    """Evaluations of a Gaussian at a pixel that were really made: 16 per block that an entry was blended into."""
    return LANES * count_blocks(traced.lists.starts, traced.ends, traced.masks)


@numba.njit
def count_blocks(starts, ends, masks):
    blocks = 0
    for s in range(len(starts)):
        for i in range(starts[s], ends[s]):
            mask = masks[i]
            while mask:
                mask &= mask - np.uint64(1)
                blocks += 1
    return blocks


def blends(speed_rows: list[dict[str, Any]], peak: float) -> list[dict[str, Any]]:
    """Lanes per second of CPU time on one core, and for 3D Gaussians their arithmetic as a share of the peak."""
    rows = []
    for row in (r for r in speed_rows if "lanes" in r):
        out = {name: row[name] for name in ("kind", "n", "size", "lanes")}
        for name, phase, flops in (("forward", "blend", BLEND_FLOPS), ("backward", "unblend", UNBLEND_FLOPS)):
            giga_lanes = row["lanes"] / row[phase]["cpu_ms"] / 1e6
            out[name] = {"giga_lanes_per_s": round(giga_lanes, 4)}
            if row["kind"] == "3d":
                out[name]["share_of_peak"] = round(giga_lanes * flops / peak, 4)
        rows.append(out)
        say(
            f"{row['kind']:7} {in_words(row['n']):>5} {shown(row['size']):>9} blends: forward {out['forward']}, "
            f"backward {out['backward']}"
        )
    return rows


def peak_gflops() -> float:
    """FMA peak of one core, from independent chains in registers: ten fill AVX-512's, five already AVX2's."""
    out, turns = np.empty(LANES, np.float32), 4_000_000
    best = 0.0
    for kernel, chains in ((five_chains, 5), (ten_chains, 10)):
        kernel(1, np.float32(0.5), np.float32(1), out)
        seconds = best_of(lambda k=kernel: timed_cpu(k, turns, out), 5)
        best = max(best, 2 * LANES * chains * turns / float(seconds) / 1e9)
    return round(best, 2)


def timed_cpu(kernel: Callable[..., None], turns: int, out: np.ndarray) -> float:
    start = time.process_time()
    kernel(turns, np.float32(0.5), np.float32(1), out)
    return time.process_time() - start


@numba.njit
def five_chains(turns, factor, shift, out):
    x = splat16(factor)
    a, b, c, d, e = x, x * x, x + shift, x - shift, x * shift
    for _ in range(turns):
        a, b, c = fma16(a, factor, shift), fma16(b, factor, shift), fma16(c, factor, shift)
        d, e = fma16(d, factor, shift), fma16(e, factor, shift)
    store16(out, 0, a + b + c + d + e)


@numba.njit
def ten_chains(turns, factor, shift, out):
    x = splat16(factor)
    a, b, c, d, e = x, x * x, x + shift, x - shift, x * shift
    f, g, h, i, j = a + x, b + x, c + x, d + x, e + x
    for _ in range(turns):
        a, b, c = fma16(a, factor, shift), fma16(b, factor, shift), fma16(c, factor, shift)
        d, e, f = fma16(d, factor, shift), fma16(e, factor, shift), fma16(f, factor, shift)
        g, h, i, j = fma16(g, factor, shift), fma16(h, factor, shift), fma16(i, factor, shift), fma16(j, factor, shift)
    store16(out, 0, a + b + c + d + e + f + g + h + i + j)


def region(plan: Plan, threads: int, slab: bool) -> dict[str, Any]:
    """An iteration on some Gaussians in a rectangle, against drawing the whole scene."""
    set_thread_count(threads)
    (n, size), (left, top, width, height) = plan.region, plan.rectangle
    gaussians, view, gradients = scene(n), camera(size), picture_gradients(size)
    pixels = np.zeros((view.height, view.width), bool)
    pixels[top : top + height, left : left + width] = True
    candidates = contributions(gaussians, view, pixels=pixels).total > 0
    if slab:
        candidates &= (gaussians.means[:, 2] > SLAB[0]) & (gaussians.means[:, 2] < SLAB[1])
    rng = np.random.default_rng(SEED)
    rows = np.flatnonzero(candidates)
    active = np.zeros(n, bool)
    active[rng.choice(rows, min(plan.active, len(rows)), replace=False)] = True
    moving = gaussians.take(active)
    jittered = [
        replace(moving, means=moving.means + rng.normal(0, 1e-3, moving.means.shape).astype(np.float32))
        for _ in range(5)
    ]
    watch = Watch()
    here = pixel_region(gaussians.take(~active), view, pixels, passes=PASSES)
    moves = cycle(jittered)

    def iterate() -> list[tuple[float, float]]:
        moved = next(moves)
        watch = Watch()
        _, traced = here.trace(moved)
        _kept_until_read = traced.backward(gradients)
        return [watch.lap()]

    iterate()
    prepared = watch.lap()
    in_region = best_of(iterate, 4 * plan.repetitions)[0]
    whole = best_of(lambda: draw_once(gaussians, view, gradients), plan.repetitions)[:2].sum(0)
    row = {
        "depths": "slab" if slab else "all",
        "n": n,
        "size": size,
        "rectangle": (width, height),
        "active": len(moving),
        "threads": threads,
        "prepare": cost(prepared),  # making the region, and the first iteration
        "iteration": cost(in_region),
        "whole": cost(whole),
        "cpu_ratio": round(whole[1] / in_region[1], 2),
        "wall_ratio": round(whole[0] / in_region[0], 2),
    }
    say(f"region, {row['active']} active at {row['depths']} depths, {threads} thr: {ms(in_region)}, whole {ms(whole)}")
    return row


def prototype(folder: Path, plan: Plan) -> list[dict[str, Any]]:
    """Ours and the prototype in turns, so that both meet the same noise of the machine."""
    rows = []
    with tempfile.TemporaryDirectory() as cache_folder:
        command = [sys.executable, str(HERE / "bench_prototype.py"), str(folder)]
        environment = {**os.environ, "NUMBA_CACHE_DIR": cache_folder}
        with subprocess.Popen(
            command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as process:

            def ask(**request: Any) -> dict[str, Any]:
                process.stdin.write(json.dumps(request) + "\n")
                process.stdin.flush()
                return json.loads(process.stdout.readline())

            for (n, size), threads in ((case, t) for case in plan.prototype for t in (1, 4)):
                set_thread_count(threads)
                gaussians, view, gradients = scene(n), camera(size), picture_gradients(size)
                request = {"n": n, "width": size[0], "height": size[1], "threads": threads, "seed": SEED, "size": SIZE}
                answer = ask(**request, repetitions=1)  # compiles
                mean = render(gaussians, view, passes=PASSES).rgb.mean()
                ours, theirs = [], []
                for _ in range(4):
                    ours.append(best_of(lambda g=gaussians, v=view, d=gradients: draw_once(g, v, d)[:2], 3))
                    answer = ask(**request, repetitions=3)
                    theirs.append([answer["forward"], answer["backward"]])
                row = {"n": n, "size": size, "threads": threads, **compared(ours, theirs)}
                row["mean_difference"] = abs(float(mean) - answer["mean"])
                rows.append(row)
                say(f"prototype {in_words(n):>5} {shown(size):>9} {threads} thr: {told(row)}")
    return rows


def compared(ours: list[Any], theirs: list[Any]) -> dict[str, Any]:
    """The best of both, [·, forward and backward, wall and CPU], and theirs divided by ours."""
    our_best, their_best = np.min(ours, axis=0), np.min(theirs, axis=0)
    row: dict[str, Any] = {}
    for k, name in enumerate(("forward", "backward")):
        wall, cpu_time = their_best[k] / our_best[k]
        row[name] = {
            "ours": cost(our_best[k]),
            "theirs": cost(their_best[k]),
            "wall_ratio": round(float(wall), 2),
            "cpu_ratio": round(float(cpu_time), 2),
        }
    return row


def told(row: dict[str, Any]) -> str:
    parts = []
    for name in ("forward", "backward"):
        r = row[name]
        parts.append(
            f"{name} {r['theirs']['wall_ms']:.1f} ms, ours {r['ours']['wall_ms']:.1f} ms (× {r['wall_ratio']})"
        )
    return "; ".join(parts)


def against_torch(plan: Plan) -> dict[str, Any]:
    """Plain torch, and whether its picture is ours."""
    try:
        import torch
    except ImportError:
        say("no comparison with torch: it is not installed")
        return {}
    from tiled_torch import draw

    def run(gaussians: Gaussians, size: Size) -> tuple[list[tuple[float, float]], np.ndarray, list[np.ndarray]]:
        leaves = [torch.from_numpy(getattr(gaussians, name)).clone().requires_grad_() for name in PARAMETERS]
        given = picture_gradients(size)
        watch = Watch()
        pictures = draw(*leaves, camera(size))
        forward = watch.lap()
        torch.autograd.backward(pictures, [torch.from_numpy(g) for g in (given.rgb, given.alpha, given.expected_depth)])
        return [forward, watch.lap()], pictures[0].detach().numpy(), [leaf.grad.numpy() for leaf in leaves]

    n, size = plan.torch
    gaussians, view, gradients = scene(n), camera(size), picture_gradients(size)
    result: dict[str, Any] = {"n": n, "size": size, "rows": []}
    default = torch.get_num_threads()
    for threads in sorted({1, default}):
        torch.set_num_threads(threads)
        set_thread_count(threads)
        run(scene(500), (64, 36))
        ours = best_of(lambda: draw_once(gaussians, view, gradients)[:2], plan.repetitions)
        (once, _, _), (twice, picture, their_gradients) = run(gaussians, size), run(gaussians, size)
        row = {"threads": threads, **compared([ours], [once, twice])}
        result["rows"].append(row)
        say(f"torch {in_words(n):>5} {shown(size):>9} {threads} thr: {told(row)}")
    torch.set_num_threads(default)

    rendering, traced = trace(gaussians, view, passes=PASSES)
    difference = np.abs(picture - rendering.rgb)
    our_gradients = backward(traced, gradients)
    result["largest_difference"], result["mean_difference"] = float(difference.max()), float(difference.mean())
    result["gradient_difference"] = {
        name: float(np.linalg.norm(theirs - getattr(our_gradients, name)) / np.linalg.norm(theirs))
        for name, theirs in zip(PARAMETERS, their_gradients)
    }
    result["agrees"] = bool(difference.max() < LARGEST_DIFFERENCE and difference.mean() < MEAN_DIFFERENCE)
    say(f"torch's picture differs by {difference.max():.1e} at most, {difference.mean():.1e} in the mean")
    return result


# ------------------------------------------------------------------------------------------- in processes of their own


def in_new_process(call: str, **environment: str) -> Any:
    """What `call` of this module gives there."""
    paths = [str(HERE), *filter(None, [os.environ.get("PYTHONPATH")])]
    code = f"import json, bench_raster; print(json.dumps(bench_raster.{call}))"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **environment, "PYTHONPATH": os.pathsep.join(paths)},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return json.loads(done.stdout)


def first_calls(count: int) -> dict[str, Any]:
    """Seconds of the first forward and backward, with no kernels in the cache, and with all."""
    with tempfile.TemporaryDirectory() as folder:
        cold, warm = (in_new_process(f"first_call({count})", GIMP3D_CACHE=folder) for _ in range(2))
    say(f"first forward + backward: {cold:.2f} s, with kernels in the cache {warm:.2f} s")
    return {"n": count, "size": SMALL, "cold_s": cold, "warm_s": warm}


def first_call(count: int) -> float:
    gaussians, view, gradients = scene(count), camera(SMALL), picture_gradients(SMALL)
    start = time.perf_counter()
    draw_once(gaussians, view, gradients)
    return round(time.perf_counter() - start, 3)


def memory(count: int, size: Size) -> dict[str, Any]:
    """The most memory that a process had until the scene was there, until it was drawn, and until backward."""
    peaks = in_new_process(f"memory_peaks({count}, {size})")
    row = {"n": count, "size": size, **dict(zip(("scene_mib", "forward_mib", "backward_mib"), peaks))}
    say(f"memory {in_words(count):>5} {shown(size):>9}: {peaks} MiB with the scene, after forward, after backward")
    return row


def memory_peaks(count: int, size: Size) -> list[float]:
    warm_up()
    gaussians, view, gradients = scene(count), camera(size), picture_gradients(size)
    peaks = [peak_mib()]
    _, traced = trace(gaussians, view, passes=PASSES)
    peaks.append(peak_mib())
    _kept_until_read = backward(traced, gradients)
    return [*peaks, peak_mib()]


def peak_mib() -> float:
    import resource  # not on Windows

    unit = 1 if sys.platform == "darwin" else 1024
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20, 1)


# ---------------------------------------------------------------------------------------------------- what is written


def machine() -> dict[str, Any]:
    info = Path("/proc/cpuinfo")
    names = (
        [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line]
        if info.exists()
        else []
    )
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


def write(path: Path, words: str) -> None:
    write_atomically(path, lambda file: file.write(words.encode()))
    say(f"wrote {path}")


def ms(costs: Any) -> str:
    return f"{costs[0]:8.1f} ms ({costs[1]:8.1f} CPU)"


def say(words: str) -> None:
    print(words, flush=True)


if __name__ == "__main__":
    sys.exit(main())

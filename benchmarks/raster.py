"""Measures the rasteriser in one run: speed by size, resolution and threads, blends per second and their share of the
core's peak, the region case, first calls, memory, and against plain torch.

Writes OUT/raster.json, OUT/raster.md and a chart. Times are the best of several repetitions: other processes can only
make them longer. Run by `make bench-raster`.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import cycle
from pathlib import Path
from typing import Any

import numba
import numpy as np

from gimp3d.camera import Camera
from gimp3d.compute.simd import fma16, splat16, store16
from gimp3d.compute.threads import set_thread_count
from gimp3d.gaussians import Gaussians
from gimp3d.memory import peak_memory_mb
from gimp3d.raster import PictureGradients, backward, contributions, cpu, pixel_region, trace

from .command import ASSETS, parser_of, say, told_in_one_line, write_results
from .plots import Line, Panel, draw_panels
from .tables import Row, Section, columns, in_words, markdown, shown, values, where
from .timing import Watch, about, best_of, cost, in_new_process, machine, replaced, timed

PASSES = frozenset({"rgb", "alpha", "expected_depth"})
SEED = 0
FOV = math.radians(60.0)  # horizontal
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
RECTANGLE = (160, 96, 160, 80)  # the region: left, top, width, height
PHASES = ("forward", "backward", "blend", "unblend")

Size = tuple[int, int]
SMALL, HALF_HD, FULL_HD = (480, 270), (960, 540), (1920, 1080)


@dataclass(frozen=True)
class Plan:
    """What is measured."""

    speed: tuple[tuple[str, tuple[int, ...], tuple[Size, ...], tuple[int, ...]], ...]  # kind, counts, sizes, threads
    torch: tuple[int, Size]
    region: tuple[int, int]  # Gaussians in all, and active
    memory: tuple[tuple[int, Size], ...]
    repetitions: int


FULL = Plan(
    speed=(
        ("3d", (100_000, 500_000, 2_000_000), (SMALL, HALF_HD, FULL_HD), (1, 2, 4)),
        ("surfels", (100_000, 500_000), (SMALL, HALF_HD), (1, 4)),
    ),
    torch=(100_000, SMALL),
    region=(500_000, 10_000),
    memory=((500_000, HALF_HD), (2_000_000, FULL_HD)),
    repetitions=8,
)
QUICK = Plan(
    speed=(("3d", (20_000,), (SMALL,), (1, 4)), ("surfels", (20_000,), (SMALL,), (4,))),
    torch=(20_000, (120, 68)),
    region=(20_000, 400),
    memory=((20_000, SMALL),),
    repetitions=2,
)


def main() -> int:
    given = parser_of(__doc__, "raster", quick="20k Gaussians at 480×270 only, below a minute").parse_args()
    plan = QUICK if given.quick else FULL
    results: Row = {"quick": given.quick, "machine": machine()}
    in_new_process(__spec__.name, "warm_up()")  # a process that compiles needs more memory than one that does not
    # Memory first, while this process is small: a child's ru_maxrss begins with that of the process that started it.
    results["memory"] = [memory(n, size) for n, size in plan.memory]
    results["first_call"] = first_calls(plan.speed[0][1][0])
    warm_up()
    results["peak_gflops_per_core"] = peak_gflops()
    results["speed"] = list(speed(plan))
    results["blends"] = list(blends(results["speed"], results["peak_gflops_per_core"]))
    results["region"] = [region(plan, threads, slab) for slab in (True, False) for threads in (1, 4)]
    scene.cache_clear()
    results["torch"] = against_torch(plan)
    write_results(given.out, "raster", results, report(results))
    draw(results, (given.out if given.quick else ASSETS) / "raster_speed.svg")
    if results["torch"] and not results["torch"]["agrees"]:
        say("torch's picture differs from ours: the comparison is worth nothing")
        return 1
    return 0


# ---------------------------------------------------------------------------------------------------------- the scene


@cache
def scene(count: int, surfels: bool = False) -> Gaussians:
    """Sheets at four depths and a volume between; flattened, and the smaller the more there are, so that pixels see
    about as many of any count."""
    rng = np.random.default_rng(SEED)
    on_sheet = rng.random(count) < 0.7
    sheets = 4 + 1.5 * rng.integers(0, 4, count) + 0.15 * rng.normal(size=count)
    z = np.where(on_sheet, sheets, rng.uniform(2.5, 10, count))
    means = np.stack([rng.uniform(-0.65, 0.65, count) * z, rng.uniform(-0.38, 0.38, count) * z, z], 1)
    sizes = np.log(0.00455 * math.sqrt(100_000 / count) * z)[:, None] + 0.55 * rng.normal(size=(count, 1))
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
    found = np.random.default_rng(SEED).normal(size=(5, size[1], size[0])).astype(np.float32)
    rgb = np.ascontiguousarray(np.moveaxis(found[:3], 0, 2))
    return PictureGradients(rgb=rgb, alpha=found[3], expected_depth=found[4])


# ------------------------------------------------------------------------------------------------------------- timing


def draw_once(gaussians: Gaussians, view: Camera, gradients: PictureGradients) -> list[tuple[float, float]]:
    """(wall, CPU) of forward, backward, and in them the work on tiles alone: blending and unblending."""
    over_tiles, phases = cpu.over_tiles, []

    def watched(*args: Any) -> None:
        watch = Watch()
        over_tiles(*args)
        phases.append(watch.lap())

    with replaced(cpu, "over_tiles", watched):
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


def speed(plan: Plan) -> Iterator[Row]:
    """Forward and backward of every configuration."""
    for kind, n, size, threads in [(k, n, s, t) for k, ns, ss, ts in plan.speed for n in ns for s in ss for t in ts]:
        set_thread_count(threads)
        gaussians, view, gradients = scene(n, kind == "surfels"), camera(size), picture_gradients(size)
        costs = best_of(lambda g=gaussians, v=view, d=gradients: draw_once(g, v, d), plan.repetitions)
        row = {"kind": kind, "n": n, "size": size, "threads": threads, **dict(zip(PHASES, map(cost, costs)))}
        if threads == 1:  # evaluations of a Gaussian at a pixel: 16 per block that an entry was blended into
            traced = trace(gaussians, view, passes=PASSES)[1]
            masks, _, ends, _ = traced.kept
            row["lanes"] = LANES * count_blocks(traced.lists.starts, ends, masks)
        say(f"{kind} {in_words(n)} {shown(size)} {threads} threads: {pair(row['forward'])} + {pair(row['backward'])}")
        yield row


def count_blocks(starts: np.ndarray, ends: np.ndarray, masks: np.ndarray) -> int:
    """How many bits are set in the masks of the entries that lists, which do not overlap, used."""
    steps = np.zeros(len(masks) + 1, np.int64)
    np.add.at(steps, starts, 1)
    np.add.at(steps, ends, -1)
    return int(np.unpackbits(masks[steps.cumsum()[:-1] > 0].view(np.uint8)).sum())


def blends(speed_rows: list[Row], peak: float) -> Iterator[Row]:
    """Lanes per second of CPU time on one core, and for 3D Gaussians their arithmetic as a share of the peak."""
    for row in (r for r in speed_rows if "lanes" in r):
        out = {name: row[name] for name in ("kind", "n", "size", "lanes")}
        for name, phase, flops in (("forward", "blend", BLEND_FLOPS), ("backward", "unblend", UNBLEND_FLOPS)):
            giga_lanes = row["lanes"] / row[phase]["cpu_ms"] / 1e6
            out[name] = {"giga_lanes_per_s": round(giga_lanes, 4)}
            if row["kind"] == "3d":
                out[name]["share_of_peak"] = round(giga_lanes * flops / peak, 4)
        yield out


def peak_gflops() -> float:
    """FMA peak of one core, from independent chains in registers: ten fill AVX-512's, five already AVX2's."""
    out, turns = np.empty(LANES, np.float32), 4_000_000
    best = 0.0
    for kernel, chains in ((five_chains, 5), (ten_chains, 10)):
        given = (np.float32(0.5), np.float32(1), out)
        kernel(1, *given)  # compiles
        _, cpu_ms = best_of(lambda k=kernel, g=given: timed(lambda: k(turns, *g)), 5)
        best = max(best, 2 * LANES * chains * turns / cpu_ms / 1e6)
    return round(best, 2)


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


def region(plan: Plan, threads: int, slab: bool) -> Row:
    """An iteration on some Gaussians in a rectangle, against drawing the whole scene."""
    set_thread_count(threads)
    (n, most), (left, top, width, height) = plan.region, RECTANGLE
    gaussians, view, gradients = scene(n), camera(SMALL), picture_gradients(SMALL)
    pixels = np.zeros((view.height, view.width), bool)
    pixels[top : top + height, left : left + width] = True
    candidates = contributions(gaussians, view, pixels=pixels).total > 0
    if slab:
        candidates &= (gaussians.means[:, 2] > SLAB[0]) & (gaussians.means[:, 2] < SLAB[1])
    rng, rows = np.random.default_rng(SEED), np.flatnonzero(candidates)
    active = np.zeros(n, bool)
    active[rng.choice(rows, min(most, len(rows)), replace=False)] = True
    moving = gaussians.take(active)
    jitter = [rng.normal(0, 1e-3, moving.means.shape).astype(np.float32) for _ in range(5)]
    moves = cycle([replace(moving, means=moving.means + j) for j in jitter])
    watch = Watch()
    here = pixel_region(gaussians.take(~active), view, pixels, passes=PASSES)

    def iterate() -> list[tuple[float, float]]:
        moved = next(moves)
        watch = Watch()
        _, traced = here.trace(moved)
        _kept_until_read = traced.backward(gradients)
        return [watch.lap()]

    iterate()
    prepared = watch.lap()  # making the region, and the first iteration
    in_region = best_of(iterate, 4 * plan.repetitions)[0]
    whole = best_of(lambda: draw_once(gaussians, view, gradients), plan.repetitions)[:2].sum(0)
    costs = {"prepare": cost(prepared), "iteration": cost(in_region), "whole": cost(whole)}
    ratios = {"cpu_ratio": round(whole[1] / in_region[1], 2), "wall_ratio": round(whole[0] / in_region[0], 2)}
    about_it = {"depths": "slab" if slab else "all", "n": n, "active": len(moving), "threads": threads}
    return about_it | costs | ratios


def against_torch(plan: Plan) -> Row:
    """Plain torch, and whether its picture is ours."""
    try:
        import torch
    except ImportError:
        say("no comparison with torch: it is not installed")
        return {}
    from .tiled_torch import draw as torch_draw

    def run(gaussians: Gaussians, size: Size) -> tuple[list[tuple[float, float]], np.ndarray]:
        leaves = [torch.from_numpy(getattr(gaussians, name)).clone().requires_grad_() for name in PARAMETERS]
        given = picture_gradients(size)
        watch = Watch()
        pictures = torch_draw(leaves, camera(size))
        forward = watch.lap()
        torch.autograd.backward(pictures, [torch.from_numpy(g) for g in (given.rgb, given.alpha, given.expected_depth)])
        return [forward, watch.lap()], pictures[0].detach().numpy()

    n, size = plan.torch
    gaussians, view, gradients = scene(n), camera(size), picture_gradients(size)
    result: Row = {"n": n, "size": size, "rows": []}
    default = torch.get_num_threads()
    for threads in sorted({1, default}):
        torch.set_num_threads(threads)
        set_thread_count(threads)
        run(scene(500), (64, 36))
        ours = best_of(lambda: draw_once(gaussians, view, gradients)[:2], plan.repetitions)
        (once, _), (twice, picture) = run(gaussians, size), run(gaussians, size)
        row: Row = {"threads": threads}
        for k, name in enumerate(PHASES[:2]):
            theirs = np.minimum(once[k], twice[k])
            ratios = dict(zip(("wall_ratio", "cpu_ratio"), (theirs / ours[k]).round(2).tolist()))
            row[name] = {"ours": cost(ours[k]), "theirs": cost(theirs), **ratios}
        result["rows"].append(row)
    torch.set_num_threads(default)

    difference = np.abs(picture - trace(gaussians, view, passes=PASSES)[0].rgb)
    result["largest_difference"], result["mean_difference"] = float(difference.max()), float(difference.mean())
    result["agrees"] = bool(difference.max() < LARGEST_DIFFERENCE and difference.mean() < MEAN_DIFFERENCE)
    return result


def first_calls(count: int) -> Row:
    """Seconds of the first forward and backward, with no kernels in the cache, and with all."""
    with tempfile.TemporaryDirectory() as folder:
        call = f"first_call({count})"
        cold, warm = (in_new_process(__spec__.name, call, GIMP3D_CACHE=folder) for _ in range(2))
    return {"n": count, "size": SMALL, "cold_s": cold, "warm_s": warm}


def first_call(count: int) -> float:
    gaussians, view, gradients = scene(count), camera(SMALL), picture_gradients(SMALL)
    start = time.perf_counter()
    draw_once(gaussians, view, gradients)
    return round(time.perf_counter() - start, 3)


def memory(count: int, size: Size) -> Row:
    """The most memory that a process had until the scene was there, until it was drawn, and until backward."""
    peaks = in_new_process(__spec__.name, f"memory_peaks({count}, {size})")
    return {"n": count, "size": size, **dict(zip(("scene_mib", "forward_mib", "backward_mib"), peaks))}


def memory_peaks(count: int, size: Size) -> list[float]:
    warm_up()
    gaussians, view, gradients = scene(count), camera(size), picture_gradients(size)
    peaks = [round(peak_memory_mb(), 1)]
    _, traced = trace(gaussians, view, passes=PASSES)
    peaks.append(round(peak_memory_mb(), 1))
    _kept_until_read = backward(traced, gradients)
    return [*peaks, round(peak_memory_mb(), 1)]


# ---------------------------------------------------------------------------------------------------- what is written


def report(results: Row) -> str:
    host, first, torch = results["machine"], results["first_call"], results["torch"]
    of = {"kind": "{kind}", "Gaussians": "{n:,}", "picture": "{size[0]}×{size[1]}"}
    lanes = {"lanes": "{lanes:,}"}
    for way in PHASES[:2]:
        lanes |= {f"{way}, G/s": f"{{{way}[giga_lanes_per_s]:.2f}}", f"{way} of peak": f"{{{way}[share_of_peak]:.0%}}"}
    region = {"depths": "{depths}", "active": "{active}", "threads": "{threads}", "first": ms("prepare")}
    region |= {"iteration": ms("iteration"), "whole": ms("whole")}
    region |= {"CPU ratio": "{cpu_ratio}", "wall ratio": "{wall_ratio}"}
    versus = {"threads": "{threads}"}
    for way in PHASES[:2]:
        versus |= {f"ours {way}": ms(f"{way}[ours]"), f"theirs {way}": ms(f"{way}[theirs]")}
        versus |= {f"wall ratio {way}": f"{{{way}[wall_ratio]}}"}
    peaks = {"scene, MiB": "{scene_mib}", "after forward": "{forward_mib}", "after backward": "{backward_mib}"}
    sections = [
        Section(
            "Speed",
            "rgb, alpha and expected depth, SH degree 3. Milliseconds, wall (CPU), best of several.",
            *columns(results["speed"], of | {"threads": "{threads}"} | {way: ms(way) for way in PHASES[:2]}),
        ),
        Section(
            "Blends per second",
            f"A lane is one Gaussian at one pixel: {BLEND_FLOPS} operations forward, {UNBLEND_FLOPS} backward. FMA "
            f"peak {results['peak_gflops_per_core']:.0f} GFLOP/s per core ({host['architecture']}, {host['vectors']}).",
            *columns(results["blends"], of | lanes),
        ),
        Section(
            "A region",
            "Forward and backward of active Gaussians in a rectangle, against those of the whole scene and picture.",
            *columns(results["region"], region),
        ),
        Section(
            "First call and memory",
            f"First forward and backward of a process ({in_words(first['n'])}, {shown(first['size'])}): "
            f"{first['cold_s']:.1f} s compiling, {first['warm_s']:.2f} s with kernels in the cache.",
            *columns(results["memory"], of | peaks),
        ),
    ]
    if torch:
        words = f"{in_words(torch['n'])} Gaussians, {shown(torch['size'])}. Its picture differs from ours by "
        words += f"{torch['largest_difference']:.1e} at most, {torch['mean_difference']:.1e} in the mean."
        sections.append(Section("Plain torch, tile by tile", words, *columns(torch["rows"], versus)))
    return markdown("Speed of the rasteriser", about(host), sections)


def ms(key: str) -> str:
    """The format of a cost: wall (CPU)."""
    return f"{{{key}[wall_ms]:.1f}} ({{{key}[cpu_ms]:.1f}})"


def pair(costs: dict[str, float]) -> str:
    return f"{costs['wall_ms']:.1f} ({costs['cpu_ms']:.1f})"


def draw(results: Row, path: Path) -> None:
    """Wall times with the most threads measured."""
    rows = where(results["speed"], kind="3d")
    threads = max(r["threads"] for r in rows)
    torch = results["torch"]
    panels = []
    for name, heading in (("forward", "Forward: the picture"), ("backward", "Backward: gradients of all parameters")):
        lines = []
        for size in values(rows, "size"):
            points = [(r["n"], r[name]["wall_ms"]) for r in where(rows, size=size, threads=threads)]
            lines.append(Line(shown(size), points))
        for row in where(torch["rows"], threads=threads) if torch else ():
            at = [(torch["n"], row[name]["theirs"]["wall_ms"])]
            lines.append(Line(f"plain torch, {shown(torch['size'])}", at, shown(torch["size"]), "none", "s", True))
        ticks = {n: in_words(n) for n in values(rows, "n")}
        panels.append(Panel(heading, lines, "Gaussians in the scene (log)", "wall time, ms (log)", x_ticks=ticks))
    host = results["machine"]
    words = f"rgb, alpha and expected depth, SH degree 3; {threads} threads, {host['cpu']} ({host['vectors']})"
    draw_panels(path, "Wall time to draw Gaussians, and for the gradients", words, [panels], (5.0, 4.2))


if __name__ == "__main__":
    told_in_one_line(main)

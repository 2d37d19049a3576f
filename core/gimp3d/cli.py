"""The command line (CONTRACT: gimp3d). Thin: reads files, calls the library, writes files, reports."""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn, TextIO

# Before NumPy is imported: the kernels have a thread pool of their own, and OpenBLAS's threads, which spin while they
# wait for its small products, cost as much processor time again.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from . import __version__
from .errors import BadInput, Cancelled, Gimp3dError, Terminated
from .files import identity, user_state_folder, write_atomically
from .job import PROVIDERS, SHADOWS, RemovalJob, load_job, save_job
from .memory import require_base_memory

Namespace = argparse.Namespace
DEPTH_PRIORS = "auto|harmonic|planar|file:PATH|onnx:PATH|torchscript:PATH|command:CMD, then ,disparity|,depth|,metric"
PAINTERS = "file:PATH|onnx:PATH[,WxH]|torchscript:PATH|gemini[:MODEL]|http://HOST:PORT|command:CMD"
REFINERS = "asks command:CMD or http://HOST:PORT to refine the painted views, the completed reference beside them"
NETWORK = "providers may send pictures of the scene to other machines (gemini, http: of another host)"
IMAGES = "photos; none: views are rendered from the scene"
GROW = "take along what of the object the boxes cut off"
SHADOW = "the object's shadow and reflection: undone where clear, left; or its shadow as --shadow-masks marks it"
SHADOW_MASKS = "white pixels of DIR/<ID without extension>.png are the object's shadow (--shadow mask)"
EXTRA_MASKS = "white pixels of DIR/<ID without extension>.png are filled too: shadows, reflections"


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise BadInput(f"{message}; see {self.prog} --help")


def build_parser() -> argparse.ArgumentParser:
    """Every command and option of the contract."""
    parser = _Parser(prog="gimp3d", description="Remove an object from a Gaussian splat scene and fill the hole.")
    parser.add_argument("--version", action="version", version=f"gimp3d {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)

    info = commands.add_parser("info", help="say what a scene file holds")
    info.add_argument("scene")
    info.add_argument("--json", action="store_true", help="as JSON")

    convert = commands.add_parser("convert", help="write a scene as an Inria-style PLY")
    convert.add_argument("input", metavar="IN")
    convert.add_argument("output", metavar="OUT")

    draw = commands.add_parser("render", help="draw a scene from its cameras")
    _scene_and_cameras(draw)
    draw.add_argument("--out", required=True, metavar="DIR")
    draw.add_argument("--split", choices=("train", "test", "all"), default="all")
    draw.add_argument("--frames", metavar="ID,ID", help="only these cameras")
    draw.add_argument("--passes", default="rgb", metavar="rgb,alpha,depth,normal")
    draw.add_argument("--scale", type=float, default=1.0, help="resolution factor")
    draw.add_argument("--background", default="0,0,0", metavar="R,G,B", help="0–1 each")
    _running(draw)

    masks = commands.add_parser("masks", help="write the region to fill in every view")
    _scene_and_cameras(masks)
    masks.add_argument("--roi", required=True)
    masks.add_argument("--out", required=True, metavar="DIR")
    masks.add_argument("--images", metavar="DIR|none", help=IMAGES)
    masks.add_argument("--grow", action="store_true", help=GROW)
    masks.add_argument("--mode", choices=("need", "paper"), default="need")
    masks.add_argument("--extra-masks", metavar="DIR", help=EXTRA_MASKS)
    masks.add_argument("--shadow", choices=SHADOWS, default="auto", help=SHADOW)
    masks.add_argument("--shadow-masks", metavar="DIR", help=SHADOW_MASKS)
    masks.add_argument(
        "--pictures",
        metavar="DIR",
        help="also draw the region over each view, the surface that would be completed, and the charts",
    )
    masks.add_argument("--depth-prior", default="auto", metavar="PROVIDER", help=DEPTH_PRIORS)
    masks.add_argument("--split", choices=("train", "test", "all"), default="train")
    masks.add_argument("--frames", metavar="ID,ID", help="only these cameras are written")
    _running(masks)

    remove = commands.add_parser("remove", help="remove what lies in the region and fill the hole")
    remove.add_argument("scene", nargs="?")
    remove.add_argument("--cameras")
    remove.add_argument("--roi")
    remove.add_argument("--out", metavar="OUT.ply")
    remove.add_argument("--images", metavar="DIR|none", help=IMAGES)
    remove.add_argument("--grow", action="store_true", help=GROW)
    remove.add_argument("--extra-masks", metavar="DIR", help=EXTRA_MASKS)
    remove.add_argument("--shadow", choices=SHADOWS, default="auto", help=SHADOW)
    remove.add_argument("--shadow-masks", metavar="DIR", help=SHADOW_MASKS)
    remove.add_argument(
        "--reference", metavar="ID|chart:N", help="the view or chart to complete first (default: chosen)"
    )
    remove.add_argument("--reference-image", metavar="FILE", help="that view or chart without the object")
    remove.add_argument(
        "--inpaint",
        metavar="PROVIDER",
        help=f"exemplar|telea|ns|shiftmap|fsr|{PAINTERS}",
    )
    remove.add_argument("--depth-prior", metavar="PROVIDER", help=DEPTH_PRIORS)
    remove.add_argument("--refine-views", metavar="PROVIDER", help=REFINERS)
    remove.add_argument("--allow-network", action="store_true", help=NETWORK)
    remove.add_argument("--preset", default="balanced", help="draft|balanced|best|paper")
    remove.add_argument("--set", action="append", default=[], metavar="key=value", help="one setting, stage.name=value")
    remove.add_argument("--views-out", metavar="DIR", help="write every completed view")
    remove.add_argument("--report", metavar="DIR", help="write an HTML report with stage pictures")
    remove.add_argument("--summary", metavar="FILE.json")
    remove.add_argument("--job", metavar="DIR", help="keep every stage here; alone: run the job prepared there")
    remove.add_argument("--allow-command", action="store_true", help="run the command that the job in --job names")
    remove.add_argument("--resume", action="store_true", help="go on from the finished stages in --job")
    remove.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    remove.add_argument("--seed", type=int, default=0)
    _running(remove)

    orbit = commands.add_parser("orbit", help="make cameras round a region")
    orbit.add_argument("scene")
    orbit.add_argument("--roi", required=True)
    orbit.add_argument("--out", required=True, metavar="CAMS.json")
    orbit.add_argument("--views", type=int, default=24)
    orbit.add_argument("--up", metavar="X,Y,Z", help="default: away from the floor under the region")
    orbit.add_argument("--size", default="960x540", metavar="WxH")
    orbit.add_argument("--fov", type=float, default=50.0, metavar="DEG", help="horizontal")

    evaluate = commands.add_parser("evaluate", help="score pictures against true ones")
    evaluate.add_argument("--pred", required=True, metavar="DIR")
    evaluate.add_argument("--truth", required=True, metavar="DIR")
    evaluate.add_argument("--masks", required=True, metavar="DIR")
    evaluate.add_argument("--mask-suffix", default=".mask.png")
    evaluate.add_argument("--exclude", default="", metavar="ID,ID")
    evaluate.add_argument("--json", metavar="FILE")

    bench = commands.add_parser("bench", help="score removals on scenes with ground truth, beside baselines")
    bench.add_argument("data", metavar="DATA", help="folder of scenes, each with truth/")
    bench.add_argument("--out", required=True, metavar="DIR", help="where results and pictures go")
    bench.add_argument("--scenes", metavar="NAME,NAME")
    bench.add_argument("--presets", default="balanced", metavar="NAME,NAME")
    _running(bench)
    return parser


def _scene_and_cameras(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene")
    parser.add_argument("--cameras", required=True, help="transforms.json, COLMAP folder, or cameras.json")


def _running(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--threads", type=int, metavar="N", help="default: one per core")
    parser.add_argument("--progress", choices=("bar", "json", "none"), default="bar")
    parser.add_argument("--quiet", action="store_true", help="no progress, no summary text")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code (CONTRACT: 0, 1, 2, 3, 129, 130, 143)."""
    shown = Reporter("none")
    try:
        given = build_parser().parse_args(arguments)
        shown = Reporter("none" if getattr(given, "quiet", False) else getattr(given, "progress", "none"))
        if given.command in COMPILED:
            require_base_memory()
        COMMANDS[given.command](given, shown)
        return 0
    except Gimp3dError as error:
        return _fail(shown, error.exit_code, str(error))
    except Terminated as stop:
        return _fail(shown, stop.exit_code, "terminated; nothing was changed")
    except KeyboardInterrupt:
        return _fail(shown, Cancelled.exit_code, "interrupted; nothing was changed")
    except MemoryError as error:
        return _fail(shown, 3, f"out of memory: {error or 'no more is free'}; use fewer or smaller views")
    except Exception as error:
        return _fail(shown, 1, f"unforeseen fault ({type(error).__name__}: {error}); {_logged(arguments)}")


def _fail(shown: Reporter, code: int, message: str) -> int:
    line = re.sub(r"\s+", " ", message)
    shown.error(line)
    say(f"gimp3d: error: {line}", sys.stderr)
    return code


def _logged(arguments: Sequence[str] | None) -> str:
    """Write down the exception that is being handled; says where."""
    words = (
        f"gimp3d {__version__}, {sys.version}, {sys.platform}\n{arguments or sys.argv[1:]}\n{traceback.format_exc()}"
    )
    path = user_state_folder() / "logs" / f"{time.strftime('%Y-%m-%d-%H%M%S')}-{os.getpid()}.log"
    try:
        write_atomically(path, lambda f: f.write(words.encode("utf-8", "backslashreplace")))
        for stale in sorted(path.parent.glob("*.log"))[:-MOST_LOGS]:
            stale.unlink()
    except (Gimp3dError, OSError):
        return "its log could not be written"
    return f"please report it with its log, {path}"


def say(text: str, stream: TextIO | None, end: str = "\n") -> None:
    """Print, whatever has become of the stream: a run does not depend on whether somebody listens."""
    if stream is None:
        return
    with suppress(OSError, ValueError):
        coding = stream.encoding or "utf-8"
        stream.write(text.encode(coding, "backslashreplace").decode(coding) + end)
        stream.flush()


class Reporter:
    """Shows progress as a bar on stderr, as JSON lines on stdout, or not at all."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self._width = 0

    def __call__(self, stage: str, done: int, total: int, message: str = "") -> None:
        if self.kind == "json":
            say(json.dumps({"stage": stage, "done": done, "total": total, "message": message}), sys.stdout)
        elif self.kind == "bar":
            filled = 24 * done // max(1, total)
            line = f"{stage:<14} [{'#' * filled}{'.' * (24 - filled)}] {done}/{total} {message}"[:110]
            say(f"\r{line:<{self._width}}", sys.stderr, "\n" if done >= total else "\r")
            self._width = 0 if done >= total else len(line)

    def done(self, summary: dict[str, Any]) -> None:
        if self.kind == "json":
            say(json.dumps({"stage": "done", "summary": summary}), sys.stdout)

    def error(self, message: str) -> None:
        if self.kind == "json":
            say(json.dumps({"stage": "error", "message": message}), sys.stdout)


def _info(given: Namespace, _: Reporter) -> None:
    from .commands import scene_info

    facts = scene_info(Path(given.scene))
    if given.json:
        say(json.dumps(facts, indent=1), sys.stdout)
    else:
        for key, value in facts.items():
            say(f"{key.replace('_', ' '):<22} {value}", sys.stdout)


def _convert(given: Namespace, _: Reporter) -> None:
    from .commands import convert

    convert(Path(given.input), Path(given.output))


def _render(given: Namespace, shown: Reporter) -> None:
    from .commands import render_views

    render_views(
        Path(given.scene),
        Path(given.cameras),
        Path(given.out),
        split=given.split,
        frames=_names(given.frames),
        passes=tuple(_names(given.passes) or ()),
        scale=given.scale,
        background=_numbers(given.background, 3, "--background"),
        threads=given.threads,
        progress=shown,
    )


def _masks(given: Namespace, shown: Reporter) -> None:
    from .commands import write_masks

    write_masks(
        Path(given.scene),
        Path(given.cameras),
        Path(given.roi),
        Path(given.out),
        images=given.images,
        mode=given.mode,
        grow=given.grow,
        split=given.split,
        frames=_names(given.frames),
        extra_masks=Path(given.extra_masks) if given.extra_masks else None,
        shadow=given.shadow,
        shadow_masks=Path(given.shadow_masks) if given.shadow_masks else None,
        pictures=Path(given.pictures) if given.pictures else None,
        depth_prior=given.depth_prior,
        threads=given.threads,
        progress=shown,
    )


def _remove(given: Namespace, shown: Reporter) -> None:
    from .commands import job_settings, run_removal
    from .pipeline import provider_notices

    folder = Path(given.job) if given.job else None
    job = _job(given, folder)
    before = identity(Path(job.out))
    start = time.perf_counter()
    for notice in provider_notices(job_settings(job), given.allow_network):
        print(f"gimp3d: note: {notice}", file=sys.stderr)
    try:
        summary = run_removal(job, folder, given.resume, shown, given.allow_network)
    except KeyboardInterrupt:
        if identity(Path(job.out)) in (before, None):
            raise
        say(f"gimp3d: warning: interrupted after {job.out} was written, which is complete", sys.stderr)
        return
    shown.done(summary)
    if not given.quiet and given.progress == "bar":
        counts = summary["counts"]
        seconds = time.perf_counter() - start
        words = f"removed {counts['removed']} and added {counts['added']} Gaussians in {seconds:.1f} s: {job.out}"
        say(words, sys.stdout)
        if summary["verdict"]:
            say(f"score {summary['verdict']['score']:.2f}: {'; '.join(summary['verdict']['words'])}", sys.stdout)
    if given.progress != "json":
        for warning in summary["warnings"]:
            say(f"gimp3d: warning: {warning}", sys.stderr)


def _job(given: Namespace, folder: Path | None) -> RemovalJob:
    """The removal that the options describe, or the one that is prepared in the folder."""
    options = {f: getattr(given, f) for f in RemovalJob.__dataclass_fields__ if f != "set"}
    options = {f: value for f, value in options.items() if value is not None}
    missing = [f"--{k}" if k != "scene" else "SCENE" for k in ("scene", "cameras", "roi", "out") if k not in options]
    if folder and missing and (given.scene is None or (folder / "job.json").is_file()):
        again = {f: value for f, value in options.items() if f in GIVEN_AGAIN}
        return load_job(folder, again, given.allow_command)
    if missing:
        raise BadInput(f"remove needs {', '.join(missing)} (or --job DIR alone, to run a prepared job)")
    if given.resume and not folder:
        raise BadInput("--resume needs --job DIR, the folder of the run to go on with")
    job = RemovalJob(**options, set=_settings(given.set))
    if folder:
        save_job(folder, job)
    return job


def _orbit(given: Namespace, _: Reporter) -> None:
    from .commands import write_orbit

    size = re.fullmatch(r"(\d+)x(\d+)", given.size)
    if not size:
        raise BadInput(f"--size: WIDTHxHEIGHT expected, got {given.size!r}")
    up, why = write_orbit(
        Path(given.scene),
        Path(given.roi),
        Path(given.out),
        views=given.views,
        up=_numbers(given.up, 3, "--up") if given.up is not None else None,
        width=int(size[1]),
        height=int(size[2]),
        fov_degrees=given.fov,
    )
    say(f"{given.out}: {given.views} cameras; up is {up[0]:.2f},{up[1]:.2f},{up[2]:.2f} ({why})", sys.stdout)


def _evaluate(given: Namespace, _: Reporter) -> None:
    from .evaluate.metrics import evaluate_folders

    scores = evaluate_folders(
        Path(given.pred),
        Path(given.truth),
        Path(given.masks),
        mask_suffix=given.mask_suffix,
        exclude=tuple(_names(given.exclude) or ()),
    )
    if given.json:
        write_atomically(Path(given.json), lambda f: f.write(json.dumps(scores, indent=1).encode()))
    for warning in scores["warnings"]:
        say(f"gimp3d: warning: {warning}", sys.stderr)
    say(f"{'view':<20} {'PSNR dB':>8} {'SSIM':>7} {'FLIP':>7}", sys.stdout)
    for name, row in [*scores["views"].items(), ("mean", scores["mean"])]:
        say(f"{name:<20} {row['psnr']:8.2f} {row['ssim']:7.3f} {row['flip']:7.3f}", sys.stdout)


def _bench(given: Namespace, shown: Reporter) -> None:
    from .compute.threads import set_thread_count
    from .evaluate.benchmark import run_benchmark, table
    from .pipeline import PRESETS

    presets = _names(given.presets) or ()
    unknown = [p for p in presets if p not in PRESETS]
    if unknown:
        raise BadInput(f"--presets: no preset {', '.join(unknown)}; there are {', '.join(PRESETS)}")
    set_thread_count(given.threads)
    rows = run_benchmark(Path(given.data), Path(given.out), _names(given.scenes) or (), presets, shown)
    say(table(rows), sys.stdout)


COMPILED = {"render", "masks", "remove", "bench"}  # commands that need the kernels
MOST_LOGS = 20
GIVEN_AGAIN = (*RemovalJob.PATHS, *PROVIDERS, "threads")  # what replaces a prepared job's
COMMANDS = {
    "info": _info,
    "convert": _convert,
    "render": _render,
    "masks": _masks,
    "remove": _remove,
    "orbit": _orbit,
    "evaluate": _evaluate,
    "bench": _bench,
}


def _names(text: str | None) -> tuple[str, ...] | None:
    return tuple(n.strip() for n in text.split(",") if n.strip()) if text else None


def _numbers(text: str, count: int, option: str) -> tuple[float, ...]:
    try:
        values = tuple(float(v) for v in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(abs(v) < float("inf") for v in values):
        raise BadInput(f"{option}: {count} numbers separated by commas expected, got {text!r}")
    return values


def _settings(pairs: Sequence[str]) -> dict[str, str]:
    for pair in pairs:
        if "=" not in pair:
            raise BadInput(f"--set: key=value expected, got {pair!r}")
    return dict(p.split("=", 1) for p in pairs)


def entry_point() -> None:
    """The `gimp3d` program: a terminated run ends like an interrupted one."""
    _open_streams()
    if not sys.warnoptions:
        warnings.simplefilter("ignore")  # what matters is said by us, in a line

    def stop(number: int, _: Any) -> NoReturn:
        raise Terminated(number)

    try:
        for name in ("SIGTERM", "SIGHUP"):
            if hasattr(signal, name):
                signal.signal(getattr(signal, name), stop)
        code = main()
    except SystemExit as end:  # --help
        code = int(end.code or 0)
    except Terminated as end:
        code = end.exit_code
    except KeyboardInterrupt:
        code = Cancelled.exit_code
    with suppress(OSError, ValueError, AttributeError, KeyboardInterrupt):  # the reader of our output may have gone
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(code)  # all files are closed; taking the interpreter down piece by piece takes a third of a second


def _open_streams() -> None:
    """A standard stream that is closed leads nowhere, so that no file of ours takes its number and gets its text."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free: this one


if __name__ == "__main__":
    entry_point()

"""The command line, `gimp3d`. Thin: options here, files in `commands`, the work in the library."""

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
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, TextIO

# Before NumPy is imported: the kernels have a thread pool of their own, and OpenBLAS's threads, which spin while they
# wait for its small products, cost as much processor time again.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from . import __version__
from .errors import BadInput, Cancelled, Gimp3dError, Terminated
from .files import identity, user_state_folder, write_atomically, write_json
from .job import PROVIDERS, SHADOWS, RemovalJob, load_job, save_job
from .memory import require_base_memory
from .progress import count_words

Namespace = argparse.Namespace
Option = Callable[..., Any]  # a command's add_argument
Command = Callable[[str, Callable[[Namespace, "Reporter"], None], str], Option]  # adds one: its name, runner and words
DEPTH_PRIORS = "auto|harmonic|planar|file:PATH|onnx:PATH|torchscript:PATH|command:CMD, then ,disparity|,depth|,metric"
PAINTERS = "file:PATH|onnx:PATH[,WxH]|torchscript:PATH|gemini[:MODEL]|http://HOST:PORT|command:CMD"
REFINERS = "asks command:CMD or http://HOST:PORT to refine the painted views, the completed reference beside them"
NETWORK = "providers may send pictures of the scene to other machines (gemini, http: of another host)"
MOST_LOGS = 20  # of unforeseen faults that are kept
GIVEN_AGAIN = (*RemovalJob.PATHS, *PROVIDERS, "threads")  # what replaces a prepared job's


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise BadInput(f"{message}; see {self.prog} --help")


def build_parser() -> argparse.ArgumentParser:
    """Every command with its options; `run` among the values is what carries it out."""
    parser = _Parser(prog="gimp3d", description="Remove an object from a Gaussian splat scene and fill the hole.")
    parser.add_argument("--version", action="version", version=f"gimp3d {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)

    def command(name: str, run: Callable[[Namespace, Reporter], None], words: str) -> Option:
        added = commands.add_parser(name, help=words)
        added.set_defaults(run=run)
        return added.add_argument

    _scene_commands(command)
    _removal_commands(command)
    return parser


def _scene_commands(command: Command) -> None:
    option = command("info", _info, "say what a scene file holds")
    option("scene", type=Path)
    option("--json", action="store_true", help="as JSON")

    option = command("convert", partial(_call, "convert"), "write a scene as an Inria-style PLY")
    option("source", metavar="IN", type=Path)
    option("target", metavar="OUT", type=Path)

    option = command("render", partial(_call, "render_views"), "draw a scene from its cameras")
    _scene_and_cameras(option)
    option("--split", choices=("train", "test", "all"), default="all")
    option("--frames", metavar="ID,ID", type=_names, help="only these cameras")
    option("--passes", type=_names, default="rgb", metavar="rgb,alpha,depth,normal")
    option("--scale", type=float, default=1.0, help="resolution factor")
    option("--background", type=_three, default="0,0,0", metavar="R,G,B", help="0–1 each")
    _running(option)

    option = command("masks", partial(_call, "write_masks"), "write the region to fill in every view")
    _scene_and_cameras(option)
    option("--roi", required=True, type=Path)
    _object(option)
    option("--mode", choices=("need", "paper"), default="need")
    words = "also draw the region over each view, the surface that would be completed, and the charts"
    option("--pictures", metavar="DIR", type=Path, help=words)
    option("--split", choices=("train", "test", "all"), default="train")
    option("--frames", metavar="ID,ID", type=_names, help="only these cameras are written")
    _running(option)

    option = command("orbit", _orbit, "make cameras round a region")
    option("scene", type=Path)
    option("--roi", required=True, type=Path)
    option("--out", required=True, metavar="CAMS.json", type=Path)
    option("--views", type=int, default=24)
    option("--up", metavar="X,Y,Z", type=_three, help="default: away from the floor under the region")
    option("--size", default="960x540", metavar="WxH", type=_size)
    option("--fov", type=float, default=50.0, metavar="DEG", dest="fov_degrees", help="horizontal")


def _removal_commands(command: Command) -> None:
    option = command("remove", _remove, "remove what lies in the region and fill the hole")
    option("scene", nargs="?")
    option("--cameras")
    option("--roi")
    option("--out", metavar="OUT.ply")
    _object(option)
    option("--reference", metavar="ID|chart:N", help="the view or chart to complete first (default: chosen)")
    option("--reference-image", metavar="FILE", help="that view or chart without the object")
    option("--inpaint", metavar="PROVIDER", help=f"exemplar|telea|ns|shiftmap|fsr|{PAINTERS}")
    option("--refine-views", metavar="PROVIDER", help=REFINERS)
    option("--allow-network", action="store_true", help=NETWORK)
    option("--preset", default="balanced", help="draft|balanced|best|paper")
    option("--set", action="append", default=[], metavar="key=value", help="one setting, stage.name=value")
    option("--views-out", metavar="DIR", help="write every completed view")
    option("--report", metavar="DIR", help="write an HTML report with stage pictures")
    option("--summary", metavar="FILE.json")
    option("--job", metavar="DIR", type=Path, help="keep every stage here; alone: run the job prepared there")
    option("--allow-command", action="store_true", help="run the command that the job in --job names")
    option("--resume", action="store_true", help="go on from the finished stages in --job")
    option("--device", choices=("auto", "cpu", "cuda"), default="auto")
    option("--seed", type=int, default=0)
    option("--variants", type=int, default=1, metavar="N", help="N fills to choose from: OUT.ply, OUT.2.ply, …")
    _running(option)

    option = command("evaluate", _evaluate, "score pictures against true ones")
    for name in ("--pred", "--truth", "--masks"):
        option(name, required=True, metavar="DIR", type=Path)
    option("--mask-suffix", default=".mask.png")
    option("--exclude", default="", metavar="ID,ID", type=_names)
    option("--json", metavar="FILE", type=Path)

    option = command("bench", _bench, "score removals on scenes with ground truth, beside baselines")
    option("data", metavar="DATA", type=Path, help="folder of scenes, each with truth/")
    option("--out", required=True, metavar="DIR", type=Path, help="where results and pictures go")
    option("--scenes", default="", metavar="NAME,NAME", type=_names)
    option("--presets", default="balanced", metavar="NAME,NAME", type=_names)
    _running(option)


def _scene_and_cameras(option: Option) -> None:
    option("scene", type=Path)
    option("--cameras", required=True, type=Path, help="transforms.json, COLMAP folder, or cameras.json")
    option("--out", required=True, metavar="DIR", type=Path)


def _object(option: Option) -> None:
    """What goes with the object: options of `masks` and `remove`."""
    shadow = "the object's shadow and reflection: undone where clear, left; or its shadow as --shadow-masks marks it"
    option("--images", metavar="DIR|none", help="photos; none: views are rendered from the scene")
    option("--grow", action="store_true", help="take along what of the object the boxes cut off")
    option("--extra-masks", metavar="DIR", help="white pixels of its pictures are filled too: shadows, reflections")
    option("--shadow", choices=SHADOWS, default="auto", help=shadow)
    words = "white pixels of DIR/<ID without extension>.png are the object's shadow (--shadow mask)"
    option("--shadow-masks", metavar="DIR", help=words)
    option("--depth-prior", metavar="PROVIDER", help=DEPTH_PRIORS)


def _running(option: Option) -> None:
    """How commands that need the kernels are run."""
    option("--threads", type=int, metavar="N", help="default: one per core")
    option("--progress", choices=("bar", "json", "none"), default="bar")
    option("--quiet", action="store_true", help="no progress, no summary text")


def _names(text: str) -> tuple[str, ...]:
    return tuple(n.strip() for n in text.split(",") if n.strip())


def _three(text: str) -> tuple[float, ...]:
    values: tuple[float, ...] = ()
    with suppress(ValueError):
        values = tuple(float(v) for v in text.split(","))
    if len(values) != 3 or not all(abs(v) < float("inf") for v in values):
        raise argparse.ArgumentTypeError(f"3 numbers separated by commas expected, got {text!r}")
    return values


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    if not found:
        raise argparse.ArgumentTypeError(f"WIDTHxHEIGHT expected, got {text!r}")
    return int(found[1]), int(found[2])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code: 0, 1, 2, 3, 129, 130 or 143."""
    shown = Reporter("none")
    try:
        given = build_parser().parse_args(arguments)
        shown = Reporter("none" if getattr(given, "quiet", False) else getattr(given, "progress", "none"))
        if hasattr(given, "threads"):  # the kernels are needed
            require_base_memory()
        given.run(given, shown)
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
    shown.last(stage="error", message=line)
    say(f"gimp3d: error: {line}", sys.stderr)
    return code


def _logged(arguments: Sequence[str] | None) -> str:
    """Write down the exception that is being handled; says where."""
    program = f"gimp3d {__version__}, {sys.version}, {sys.platform}"
    words = f"{program}\n{arguments or sys.argv[1:]}\n{traceback.format_exc()}"
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

    def last(self, **facts: Any) -> None:
        """How it ended, where somebody reads lines."""
        if self.kind == "json":
            say(json.dumps(facts), sys.stdout)


def _values(given: Namespace, *others: str) -> dict[str, Any]:
    """The options that were given, as the keywords of the function that a command calls."""
    own = {"command", "run", "progress", "quiet", *others}
    return {name: value for name, value in vars(given).items() if value is not None and name not in own}


def _info(given: Namespace, _: Reporter) -> None:
    from .commands import scene_info

    facts = scene_info(given.scene)
    lines = (f"{key.replace('_', ' '):<22} {value}" for key, value in facts.items())
    say(json.dumps(facts, indent=1) if given.json else "\n".join(lines), sys.stdout)


def _call(function: str, given: Namespace, shown: Reporter) -> None:
    """What a command does that is a function of `commands`, and says nothing at its end."""
    from . import commands

    progress = {"progress": shown} if "progress" in given else {}
    getattr(commands, function)(**_values(given), **progress)


def _remove(given: Namespace, shown: Reporter) -> None:
    from .commands import run_removal
    from .pipeline import provider_notices
    from .presets import job_settings

    job = _job(given)
    before = identity(Path(job.out))
    start = time.perf_counter()
    for notice in provider_notices(job_settings(job), given.allow_network):
        print(f"gimp3d: note: {notice}", file=sys.stderr)
    try:
        summary = run_removal(job, given.job, given.resume, shown, given.allow_network)
    except KeyboardInterrupt:
        if identity(Path(job.out)) in (before, None):
            raise
        say(f"gimp3d: warning: interrupted after {job.out} was written, which is complete", sys.stderr)
        return
    shown.last(stage="done", summary=summary)
    if not given.quiet and given.progress == "bar":
        written = ", ".join(v["out"] for v in summary["variants"])
        seconds = time.perf_counter() - start
        say(f"{count_words(summary['counts'])} in {seconds:.1f} s: {written}", sys.stdout)
        if summary["verdict"]:
            say(f"score {summary['verdict']['score']:.2f}: {'; '.join(summary['verdict']['words'])}", sys.stdout)
    if given.progress != "json":
        for warning in summary["warnings"]:
            say(f"gimp3d: warning: {warning}", sys.stderr)


def _job(given: Namespace) -> RemovalJob:
    """The removal that the options describe, or the one that is prepared in the folder."""
    options = {f: v for f, v in _values(given, "set").items() if f in RemovalJob.__dataclass_fields__}
    missing = [f"--{k}" if k != "scene" else "SCENE" for k in ("scene", "cameras", "roi", "out") if k not in options]
    if given.job and missing and (given.scene is None or (given.job / "job.json").is_file()):
        again = {f: value for f, value in options.items() if f in GIVEN_AGAIN}
        return load_job(given.job, again, given.allow_command)
    if missing:
        raise BadInput(f"remove needs {', '.join(missing)} (or --job DIR alone, to run a prepared job)")
    if given.resume and not given.job:
        raise BadInput("--resume needs --job DIR, the folder of the run to go on with")
    for pair in given.set:
        if "=" not in pair:
            raise BadInput(f"--set: key=value expected, got {pair!r}")
    job = RemovalJob(**options, set=dict(p.split("=", 1) for p in given.set))
    if given.job:
        save_job(given.job, job)
    return job


def _orbit(given: Namespace, _: Reporter) -> None:
    from .commands import write_orbit

    width, height = given.size
    up, why = write_orbit(**_values(given, "size"), width=width, height=height)
    say(f"{given.out}: {given.views} cameras; up is {up[0]:.2f},{up[1]:.2f},{up[2]:.2f} ({why})", sys.stdout)


def _evaluate(given: Namespace, _: Reporter) -> None:
    from .evaluate import evaluate_folders

    scores = evaluate_folders(**_values(given, "json"))
    if given.json:
        write_json(given.json, scores)
    for warning in scores["warnings"]:
        say(f"gimp3d: warning: {warning}", sys.stderr)
    say(f"{'view':<20} {'PSNR dB':>8} {'SSIM':>7} {'FLIP':>7}", sys.stdout)
    for name, row in [*scores["views"].items(), ("mean", scores["mean"])]:
        say(f"{name:<20} {row['psnr']:8.2f} {row['ssim']:7.3f} {row['flip']:7.3f}", sys.stdout)


def _bench(given: Namespace, shown: Reporter) -> None:
    from .compute.threads import set_thread_count
    from .evaluate import run_benchmark, table
    from .pipeline import PRESETS

    unknown = [p for p in given.presets if p not in PRESETS]
    if unknown:
        raise BadInput(f"--presets: no preset {', '.join(unknown)}; there are {', '.join(PRESETS)}")
    set_thread_count(given.threads)
    say(table(run_benchmark(given.data, given.out, given.scenes, given.presets, shown)), sys.stdout)


def entry_point() -> None:
    """The `gimp3d` program: a terminated run ends like an interrupted one."""
    # A standard stream that is closed leads nowhere, so that no file of ours takes its number and gets its text.
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free: this one
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
    except KeyboardInterrupt as end:
        code = end.exit_code if isinstance(end, Terminated) else Cancelled.exit_code
    with suppress(OSError, ValueError, AttributeError, KeyboardInterrupt):  # the reader of our output may have gone
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(code)  # all files are closed; taking the interpreter down piece by piece takes a third of a second

"""Counts what was done to the program and what of it went wrong: inputs, faults, kills, moved scenes, changed files.

Prints the table of docs/reliability.md and writes it to OUT/reliability.md. Run by `make bench-faults`.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

from .command import ROOT, parser_of, say, told_in_one_line, write
from .tables import table

sys.path[:0] = [str(ROOT / "tests" / name) for name in ("e2e", "fuzz", "stability", "")]
from readers import READERS
from test_faults import KILLS, MOMENTS
from test_fuzz import FEW
from test_units import ALIKE, ALIKE_BUILT_IN

CASES_OF = {  # tests that stand for more than one case
    "test_a_signal_at_any_moment_leaves_out_whole": MOMENTS,
    "test_a_killed_removal_goes_on_to_the_same_bytes": KILLS,
    "test_changed_files_are_read_or_refused": FEW,
}


ROWS = (  # what is tried, by which tests, what has to hold, and which of these tests, as pytest's -k
    (
        "wrong inputs: files, options, values, library calls",
        "tests/core/test_schema.py tests/core/io tests/core/test_box.py tests/core/test_camera.py "
        "tests/e2e/test_command_line.py tests/core/priors/test_servers.py tests/core/priors/test_monodepth.py",
        "one line, exit 2 or 3, no output",
        "refused or bad or no_setting or no_other_setting or no_sensible or no_scene or damaged or truncated or "
        "lies or memory or description or larger or words_are_checked or told",
    ),
    ("jobs and files that reach out, or run something", "tests/core/test_job.py", "refused before any write", ""),
    (
        "faults: targets, devices, links, streams, memory, stage files",
        "tests/core/test_files.py tests/e2e/test_faults.py",
        "the exit code of the contract, OUT as it was",
        "not any_moment and not killed_removal",
    ),
    (
        "kills: SIGINT, SIGTERM, SIGHUP, SIGKILL at moments spread over a run",
        "tests/e2e/test_faults.py",
        "OUT is the old or the new one, whole; a run goes on to the same bytes",
        "any_moment or killed_removal",
    ),
    (
        "moved scenes: units, shifts, turns; filled by Telea",
        "tests/stability/test_units.py",
        f"the same picture to {ALIKE} dB",
        "not built_in and not power",
    ),
    (
        "some of them, filled by the built-in fill",
        "tests/stability/test_units.py",
        f"to {ALIKE_BUILT_IN} dB; the same chart to the byte where units are powers of two apart",
        "built_in or power",
    ),
    ("changed files, a few for every reader", "tests/fuzz", "read or refused", "not minute"),
)


def main() -> int:
    out = parser_of(__doc__, "faults").parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    # A shell's background job ignores Ctrl-C, and so would every program that is started here and interrupted.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    lines, wrong = [], 0
    for what, tests, holds, chosen in ROWS:
        say(what)
        tried, lost, seconds = run(tests, chosen, out / "results.xml")
        say(f"{tried:,} tried, {lost} lost, {seconds:.0f} s")
        wrong += lost
        lines.append([what, holds, f"{tried:,}", lost, f"{seconds:.0f}"])
    head = ("tried", "what has to hold", "number", "lost", "seconds")
    words = table(head, [*lines, *fuzzed(ROOT / "build" / "fuzz")])
    say(words)
    write(out / "reliability.md", words)
    return 1 if wrong else 0


def run(tests: str, chosen: str, results: Path) -> tuple[int, int, float]:
    """How many cases of a row were tried, how many failed, and how long it took."""
    start = time.perf_counter()
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--junitxml={results}"]
    command += [*tests.split(), *(("-k", chosen) if chosen else ())]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    tried = lost = 0
    for case in ElementTree.parse(results).getroot().iter("testcase"):
        if case.find("skipped") is not None:
            continue
        tried += next((count for test, count in CASES_OF.items() if case.attrib["name"].startswith(test)), 1)
        lost += case.find("failure") is not None or case.find("error") is not None
    if lost:
        say(done.stdout[-3000:])
    return tried, lost, time.perf_counter() - start


def fuzzed(folder: Path) -> Iterator[list[object]]:
    """What `make fuzz` has done so far, as rows: of readers in memory, and of those that need files."""
    path = folder / "counts.json"
    counts = json.loads(path.read_text()) if path.exists() else {}
    found = [p.name for p in (folder / "found").glob("*")]
    for where, in_files in (("in memory", False), ("that need files", True)):
        done = {name: c for name, c in counts.items() if READERS[name].needs_files == in_files}
        if not done:
            continue
        cases, seconds = (sum(c[what] for c in done.values()) for what in ("cases", "seconds"))
        least = min(c["cases"] for c in done.values())
        what = f"changed files, `make fuzz`: {len(done)} readers {where}, {least:,} each"
        lost = sum(f.startswith(f"{name}-") for f in found for name in done)
        yield [what, "read or refused", f"{cases:,}", lost, f"{seconds:.0f}"]


if __name__ == "__main__":
    told_in_one_line(main)

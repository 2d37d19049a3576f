"""Throws changed files at every reader, for as long as it is let; goes on where it stopped. Run by `make fuzz`.

With atheris, libFuzzer's engine for Python, half of the cases start from what reached new lines, which is kept in
OUT/corpus; the others, and all without atheris, start from files that a reader takes. OUT/counts.json holds how many
cases each reader has had, until readers of texts and numbers have had --in-memory and those of files --in-files.

    python tools/fuzz.py [--out build/fuzz] [--in-memory 1000000] [--in-files 100000] [--seconds S] [--only NAME]

A case that a reader neither takes nor refuses is written to OUT/found and ends the run with exit code 1.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import json
import os
import random
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests" / "fuzz"), str(ROOT / "core")]
GUIDED = importlib.util.find_spec("atheris") is not None
if GUIDED:
    import atheris

    READ_HERE = ("io", "schema", "job", "store", "box", "camera", "files", "settings",
                 "priors.networks", "priors.servers", "priors.monodepth")  # fmt: skip
    ALL = (p.relative_to(ROOT / "core").with_suffix("").parts for p in (ROOT / "core" / "gimp3d").rglob("*.py"))
    OTHERS = [n for n in map(".".join, ALL) if not n.removeprefix("gimp3d.").startswith(READ_HERE)]
    with atheris.instrument_imports(include=["gimp3d"], exclude=[n.removesuffix(".__init__") for n in OTHERS]):
        from readers import READERS, Reader, case, mutated
else:
    from readers import READERS, Reader, case, mutated

AT_ONCE = {False: 500_000, True: 100_000}  # cases of a process, whose start takes 2 s: of readers in memory, of files
LONGEST = 2  # times the largest seed: what grows without end gets slow
SLOWEST, LARGEST = 20, 4096  # seconds and MiB that a case may take


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "fuzz")
    parser.add_argument("--in-memory", type=int, default=1_000_000, help="cases of each reader that needs no file")
    parser.add_argument("--in-files", type=int, default=100_000, help="cases of each that does")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="for all of them, this time")
    parser.add_argument("--only", choices=READERS)
    parser.add_argument("--chunk", type=int, help=argparse.SUPPRESS)  # in a process of its own
    given = parser.parse_args()
    if given.chunk:
        return run_chunk(READERS[given.only], given.out, given.chunk)
    # atheris ends a process without letting it clean up
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as place:
        return run_all(given, {**os.environ, "TMPDIR": place})


def run_all(given: argparse.Namespace, environment: dict[str, str]) -> int:
    """All readers in turn, each in processes of its own, until they have had their cases or the time is over."""
    end, failed = time.monotonic() + given.seconds, False
    names = [given.only] if given.only else list(READERS)
    while names and time.monotonic() < end:
        for name in list(names):
            state, most = read_counts(given.out), given.in_files if READERS[name].needs_files else given.in_memory
            done = state.get(name, {"cases": 0, "seconds": 0.0, "engine": ""})
            if done["cases"] >= most or time.monotonic() >= end:
                names.remove(name)
                continue
            size = min(AT_ONCE[READERS[name].needs_files], most - done["cases"])
            start = time.monotonic()
            command = [sys.executable, __file__, "--out", str(given.out), "--only", name, "--chunk", str(size)]
            ran = subprocess.run(command, env=environment, capture_output=True, text=True, errors="replace")
            if ran.returncode:
                print(f"{name}: found something\n{ran.stdout[-2000:]}{ran.stderr[-1000:]}", flush=True)
                names.remove(name)
                failed = True
                continue
            done = {
                "cases": done["cases"] + size,
                "seconds": round(done["seconds"] + time.monotonic() - start, 1),
                "engine": "atheris" if GUIDED else "by number",
            }
            write_counts(given.out, name, done)
            print(f"{name:<18} {done['cases']:>9,} of {most:,} cases, {done['seconds']:.0f} s", flush=True)
    total = read_counts(given.out)
    cases, seconds = (sum(d[what] for d in total.values()) for what in ("cases", "seconds"))
    print(f"{cases:,} cases in all, {seconds:.0f} s")
    return int(failed)


def run_chunk(reader: Reader, out: Path, size: int) -> int:
    """So many cases of one reader; anything that is no refusal ends the process."""
    warnings.simplefilter("ignore")
    found, corpus = out / "found", out / "corpus" / reader.name
    for folder in (found, corpus):
        folder.mkdir(parents=True, exist_ok=True)
    done = read_counts(out).get(reader.name, {"cases": 0})["cases"]
    seeds = reader.seeds()
    if not GUIDED:
        for number in range(done, done + size):
            data = case(reader, seeds, number)
            try:
                reader.check(data)
            except BaseException:
                (found / f"{reader.name}-{number}").write_bytes(data)
                raise
        return 0
    for seed in seeds:
        (corpus / hashlib.sha1(seed).hexdigest()).write_bytes(seed)

    def changed(data: bytes, most: int, seed: int) -> bytes:
        rng = random.Random(seed)
        start = data if data and rng.random() < 0.5 else rng.choice(seeds)
        if rng.random() < 0.3:
            return atheris.Mutate(start, most)
        return mutated(start, rng, reader.is_json)[:most]

    words = f"-runs={size} -seed={done + 1} -timeout={SLOWEST} -rss_limit_mb={LARGEST}"
    words += f" -max_len={LONGEST * max(map(len, seeds))}"
    options = [sys.argv[0], *words.split(), f"-artifact_prefix={found}/{reader.name}-", str(corpus)]
    atheris.Setup(options, lambda data: reader.check(data) and None, custom_mutator=changed)
    atheris.Fuzz()  # ends the process
    return 0


def read_counts(out: Path) -> dict[str, Any]:
    path = out / "counts.json"
    return json.loads(path.read_text()) if path.exists() else {}


def write_counts(out: Path, name: str, done: dict[str, Any]) -> None:
    from gimp3d.files import write_atomically

    counts = {**read_counts(out), name: done}
    write_atomically(out / "counts.json", lambda f: f.write(json.dumps(counts, indent=1).encode()))


if __name__ == "__main__":
    sys.exit(main())

"""Benchmarks: one module per question (`python -m benchmarks.NAME`, or `make bench-…`; docs/benchmarks.md)."""

import os
import sys
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as in the command, before NumPy is imported
_TESTS = Path(__file__).resolve().parents[1] / "tests"
sys.path[:0] = [str(_TESTS), str(_TESTS / "core" / "raster")]  # made scenes whose truth is known; torch's rasteriser

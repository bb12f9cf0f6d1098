"""Measuring: CPU time as medians, C programs compiled on the spot."""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np


def cpu_ns(run: Callable[[], object], steps: float, repeats: int = 5) -> float:
    """Median CPU time of run() over its scenario-steps [ns], after one call that compiles and warms up."""
    jax.block_until_ready(run())
    times = []
    for _ in range(repeats):
        start = time.process_time()
        jax.block_until_ready(run())
        times.append(time.process_time() - start)
    return float(np.median(times)) / steps * 1e9


def seconds(run: Callable[[], object]) -> float:
    """Wall time of one call [s]."""
    start = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - start


def c_library(source: Path, real: str, *more: str) -> ctypes.CDLL:
    """Compile a C file with gcc for this machine, ``-DREAL=float`` or ``double``, and load it; more: further flags.

    Raises RuntimeError with the compiler's words where that fails.
    """
    place = Path(tempfile.mkdtemp())
    compiled, target = place / f"{source.stem}_{real}.o", place / f"{source.stem}_{real}.so"
    fast = ["-O3", "-march=native", "-mprefer-vector-width=512", "-ffast-math", "-fno-finite-math-only"]
    flags = [*fast, "-fPIC", *more, f"-DREAL={real}"]  # infinities and NaN keep their meaning
    # linked by itself: linked with -ffast-math, a library makes its whole process take denormal numbers for zero
    for command in (
        ["gcc", "-c", *flags, str(source), "-o", str(compiled)],
        ["gcc", "-shared", str(compiled), "-o", str(target), "-lm"],
    ):
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"`gcc` must compile {source.name}, but it says: {done.stderr.strip()}")
    return ctypes.CDLL(str(target))

"""The experiments as processes: one in this process, or several side by side with a progress line each.

Apart from `__main__`, for a process that is spawned cannot import that.
"""

from __future__ import annotations

import contextlib
import importlib
import sys
import time
from concurrent.futures import Future, ProcessPoolExecutor
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import jax
from tqdm import tqdm

import jaxatt
from experiments.report import Report


class Experiment(NamedTuple):
    """What is known of an experiment before it runs."""

    seconds: int  # of one core, with --quick, nothing compiled yet
    checks: int  # with --quick
    figure: str  # the one to open first


EXPERIMENTS = {
    "observer_pd": Experiment(24, 29, "fault_sizes"),
    "gyro_ekf": Experiment(50, 55, "sixteen_subsets"),
    "cmg_loss": Experiment(100, 88, "figure_7"),
    "star_isolation": Experiment(70, 88, "roc"),
    "wheel_mrac": Experiment(45, 77, "loss_of_effectiveness"),
    "microsat": Experiment(90, 61, "reconfiguration"),
    "rare_events": Experiment(160, 16, "curves"),
    "yardstick": Experiment(140, 55, "board"),
    "identify": Experiment(6, 6, "walk"),
}
NAMES = tuple(EXPERIMENTS)
LOOPS = tuple(name for name in NAMES if find_spec(f"jaxatt.loops.{name}"))  # which have studies and a campaign
STUDIES = {"tune": "experiments.tuning"}  # words that may follow the names, and where the studies lie


def prepare() -> None:
    """What every process of the experiments begins with."""
    jax.config.update("jax_enable_x64", True)
    jaxatt.configure()


def run(name: str, study: str, quick: bool, out: Path) -> dict:
    """One experiment, or study, of one loop; what it found, for `written`."""
    prepare()
    started = time.perf_counter()
    title = f"{name} {study}".strip()
    report = Report(out, quick, title.replace(" ", "_"))
    importlib.import_module(f"{STUDIES.get(study, 'experiments')}.{name}").run(report)
    report.note(f"{title} took {time.perf_counter() - started:.0f} s")
    return report.found()


def logged(name: str, study: str, quick: bool, out: Path) -> dict:
    """`run` with what it prints in a file, DIR/NAME.txt, for several run at once."""
    with table_of(out, name).open("w") as file, contextlib.redirect_stdout(file):
        return run(name, study, quick, out)


def table_of(out: Path, name: str) -> Path:
    return out / f"{name}.txt"


def side_by_side(names: list[str], jobs: int, study: str, quick: bool, out: Path) -> list[dict]:
    """The experiments in so many processes, the longest first, a progress line each; their tables at the end."""
    out.mkdir(parents=True, exist_ok=True)
    if quick and not study:
        loads = [0.0] * jobs
        for name in by_length(names):
            loads[loads.index(min(loads))] += EXPERIMENTS[name].seconds
        print(f"{len(names)} experiments, {jobs} side by side: about {max(loads) / 60:.1f} minutes on idle cores")
    for name in names:
        table_of(out, name).unlink(missing_ok=True)
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        running = {name: pool.submit(logged, name, study, quick, out) for name in by_length(names)}
        watch({name: running[name] for name in names}, study, quick, out)
    for name in names:
        if table_of(out, name).exists():
            print(table_of(out, name).read_text(), end="")
            table_of(out, name).unlink()
    return [running[name].result() for name in names]


def by_length(names: list[str]) -> list[str]:
    return sorted(names, key=lambda name: -EXPERIMENTS[name].seconds)


def watch(running: dict[str, Future], study: str, quick: bool, out: Path) -> None:
    """A progress line for each experiment until all are done: how many checks it has made, and the last one.

    Where nobody watches, a line when an experiment ends.
    """
    started, live, told = time.perf_counter(), sys.stdout.isatty(), set()
    of = " of {total_fmt}" if quick and not study else ""
    form = "{desc:16} {n_fmt:>4}" + of + " checks {elapsed:>6} {postfix}"
    bars = {
        name: tqdm(desc=name, total=EXPERIMENTS[name].checks, position=i, bar_format=form, disable=not live)
        for i, name in enumerate(running)
    }
    while len(told) < len(running):
        time.sleep(0.5)
        for name, future in running.items():
            path = table_of(out, name)
            lines = path.read_text().splitlines() if path.exists() else []
            checks = [line for line in lines if line.endswith((" ok", " NOT OK")) and not line.startswith("check ")]
            ended = ("failed" if future.exception() else "done") if future.done() else ""
            last = checks[-1][:48].strip() if checks else "..." if lines else "waits"
            bars[name].n = len(checks)
            bars[name].set_postfix_str(ended or last)
            if ended and name not in told:
                told.add(name)
                if not live:
                    print(f"{name}: {ended}, {len(checks)} checks, {time.perf_counter() - started:.0f} s", flush=True)
    for bar in bars.values():
        bar.close()

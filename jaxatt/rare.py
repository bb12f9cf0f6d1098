"""The probability of a loss that plain sampling never meets, and runs that show it.

Subset simulation (Au and Beck, 2001) climbs from level to level of a continuous score: a tenth of the runs survive each,
so that 1e-6 takes six levels and not a hundred million runs. A pilot chooses the levels; repeats keep to them, so that
each is an unbiased estimate and their spread is the interval. `design_point` finds the nearest failure by gradient,
`importance` samples around it.

May import: check, compiling, contract, design_point, engine, loss, noise, normal_space, reliability, resuming, subset, sweeping.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import numpy as np

from jaxatt import check
from jaxatt.compiling import in_threads, programs_at_once
from jaxatt.contract import System
from jaxatt.design_point import Points, design_point, importance
from jaxatt.engine import simulate
from jaxatt.loss import Curve, Groups, Loss, failure, groups, log_t, said, wilson
from jaxatt.noise import block_key
from jaxatt.normal_space import STEP, Event, event_of, kept_failures, programs
from jaxatt.reliability import Sensitivity, sensitivity
from jaxatt.resuming import mark_of, replaced
from jaxatt.subset import KEPT, Pilot, Population, piloted, populated
from jaxatt.sweeping import progress_bar

__all__ = [
    "Groups", "Loss", "Points", "Sensitivity", "design_point", "failure", "groups", "importance", "probability",
    "sensitivity",
]  # fmt: skip


def probability(
    system: System, params, scenario, key, *, ticks: int, score: Callable, above: float, normals: int = 0,
    chains: int = 128, moves: int = 10, repeats: int = 8, label: Callable | None = None,
    path: str | Path | None = None, progress: bool | None = None,
) -> Loss:  # fmt: skip
    """The probability that a score exceeds a number, down to 1e-9, by subset simulation.

    Random are the noise of the run and ``normals`` numbers of the scenario, all independent and standard normal. The
    score must be continuous, such as a peak: chains climb it. A run whose score is NaN counts as lost. One population
    costs chains * moves runs a level, a level is a factor of ten; the pilot and every repeat are one population each.
    Another params, key or ``above`` compiles nothing.

    Args:
        system: the loop.
        params: what the engineer ships.
        scenario: what the day brings, or a function u (normals,) -> scenario of standard normal numbers.
        key: fixes everything random.
        ticks: how many ticks a run lasts.
        score: as of `sweep`, but giving one tally of one number.
        above: the event is score > above.
        normals: numbers u of the scenario; 0 where it is the same in all runs.
        chains: that run side by side, a multiple of 8; more of them help where a flag says so.
        moves: runs of each chain at a level, at least 5; their reciprocal is the share that survives a level.
        repeats: independent estimates, at least 4.
        label: log -> int or str of one run: sorts the failures kept into modes.
        path: file (.npz) that holds the pilot and every finished repeat; if it exists, the computation goes on from
            there, and its result equals that of an uninterrupted one bit for bit. A finished file takes more repeats.
        progress: show a bar; None shows it on terminals and in notebooks, after two seconds.

    Returns:
        A `Loss`. Where more than a tenth of the runs fail, it is a plain count with Wilson's interval and no levels.
        Where none fails, p is 0 and the interval (0, 3 / independent runs).

    Raises:
        ValueError: numbers outside their domain, a score of several numbers or one that is a step, chains that are no
            multiple of 8, fewer repeats than the file holds, a file of another event or release of JAX, and points
            that the free memory does not hold.
        TypeError: what is no number or no key, a score that is a bool, a call under jit, grad or vmap.

    Warns:
        UserWarning with the flags, if there are any, and what they mean.

    Example:
        >>> peak = lambda params, scenario, now, log: scores.peak(log.xi, now.k >= 100)
        >>> loss = rare.probability(
        ...     loop.system, loop.params, healthy, jax.random.key(0), ticks=300, score=peak, above=0.004
        ... )
    """
    began = time.perf_counter()
    event, key = event_of("probability", system, params, scenario, key, ticks, score, above, normals, chains, moves)
    repeats = check.whole("repeats", repeats, 4)
    if label is not None:
        check.function("label", label)
    devices = jax.local_devices()
    kept = KEPT * repeats * event.size // event.chains
    size = f"`ticks` = {ticks} with `chains` = {chains}"
    check.fits_memory(size, event.bytes + kept, "use fewer chains, or runs of fewer ticks")
    jobs = int(max(1, min(programs_at_once(), (check.free_memory() - kept) // event.bytes)))
    numbers = key, event.params, event.scenario, ticks, event.above, chains, moves
    mark = "" if path is None else mark_of(programs(event, key), numbers)
    pilot, done, looks = _resumed(path, mark, repeats)
    with progress_bar(progress, 7 * (repeats + 1), " levels") as bar:
        if pilot is None:
            with jax.debug_nans(False), jax.debug_infs(False):  # a NaN counts as lost
                pilot = piloted(event, block_key(key, 0), partial(_advance, bar, None))
            if pilot.distinct <= 2 and not (pilot.distinct == 0 and pilot.nan):
                check.refuse("score", f"be continuous: {STEP}", f"one of {pilot.distinct} values in {event.n} runs")
            _saved(path, mark, pilot, done, looks)
        levels = len(pilot.levels) + 1
        bar.total = (repeats + 1) * levels
        bar.update((len(done) + 1) * levels - bar.n)

        def one(r: int) -> Population:
            with jax.default_device(devices[r % len(devices)]), jax.debug_nans(False), jax.debug_infs(False):
                return populated(event, block_key(key, 1 + r), pilot, partial(_advance, bar, levels))

        for found in in_threads(one, range(len(done), repeats), jobs):
            done.append(found)
            if len(done) == repeats:
                looks += 1
            _saved(path, mark, pilot, done, looks)
    return _loss(event, pilot, done, looks, label, began)


def _advance(bar, levels: int | None, level: int, p: float, acceptance: float) -> None:
    of = "about 7" if levels is None else str(levels)
    bar.set_postfix_str(f"level {level + 1} of {of}, P ~ {p:.0e}, acceptance {acceptance:.2f}", refresh=False)
    bar.update()


def _loss(event: Event, pilot: Pilot, done: list[Population], looks: int, label, began: float) -> Loss:
    by_repeat = np.array([one.p for one in done])
    repeats, n = len(done), event.n
    curve = Curve(pilot.grid, *log_t([one.curve for one in done])[:3])
    p, low, high, cv = (float(a) for a in log_t(by_repeat))
    if not len(pilot.levels):
        low, high = map(float, wilson(round(p * repeats * n), repeats * n))
    elif p == 0:
        low, high = 0.0, 3 / (repeats * n)
    some = [one for one in done if one.p > 0]
    mean = lambda a: float(np.mean(a)) if len(a) else np.nan
    cv_au_beck = mean([one.cv for one in some]) / np.sqrt(repeats)
    acceptance, shares = (_mean([getattr(one, name) for one in done]) for name in ("acceptance", "shares"))
    roots, rhos = mean([one.roots for one in some]), np.cos(pilot.angles)
    flags = {
        "stuck": cv > 2 * cv_au_beck,
        "lost": bool(len(pilot.levels)) and len(some) < repeats,
        "unreached": not pilot.reached,
        "plateau": bool(np.any(shares < 0.03) or np.any(shares[:-1] > 0.3)),
        "frozen": bool(np.any(acceptance < 0.1) or np.any(rhos > 0.999)),
        "few roots": roots < 3,
        "nan": pilot.nan or any(one.nan for one in done),
    }
    failures = kept_failures(event, [(one.u, one.noise, one.score, one.root, one.weight) for one in done])
    modes = None if label is None else _modes(event, failures, label, repeats)
    runs = pilot.runs + sum(int(np.sum(~np.isnan(one.shares))) for one in done) * n
    seconds = time.perf_counter() - began
    return Loss(
        p, low, high, cv, cv_au_beck, by_repeat, pilot.levels, rhos, acceptance, curve, runs,
        said([flag for flag, up in flags.items() if up]), failures, seconds, modes, roots, looks, event.words,
    )  # fmt: skip


def _mean(rows):
    """Mean over the rows that hold a number, NaN where none does."""
    rows = np.array(rows)
    known = np.sum(~np.isnan(rows), axis=0)
    return np.where(known, np.nansum(rows, axis=0), np.nan) / np.maximum(known, 1)


def _modes(event: Event, failures, label: Callable, repeats: int) -> dict:
    """Shares of the failures of each repeat by the label of their logs."""
    modes: dict = {}
    for i, (repeat, weight) in enumerate(zip(failures.repeat, failures.weight)):
        scenario, noise = jax.tree.map(lambda a, i=i: a[i], (failures.scenario, failures.noise))
        name = label(simulate(event.system, event.params, scenario, noise, ticks=event.ticks))
        name = name.item() if hasattr(name, "item") else name
        modes.setdefault(name, np.zeros(repeats))[repeat] += weight
    return modes


# the file


def _saved(path, mark: str, pilot: Pilot, done: list[Population], looks: int) -> None:
    if path is None:
        return
    arrays = {f"pilot.{name}": a for name, a in pilot._asdict().items()}
    arrays |= {f"repeat{r}.{name}": a for r, one in enumerate(done) for name, a in one._asdict().items()}
    replaced(check.place("path", path), dict(mark=np.array(mark), done=len(done), looks=looks, **arrays))


def _resumed(path, mark: str, repeats: int) -> tuple[Pilot | None, list[Population], int]:
    """The pilot, the finished repeats and how often there were as many as asked for, of the file if there is one."""
    if path is None or not check.place("path", path).exists():
        if path is not None:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
        return None, [], 0
    try:
        with np.load(path, allow_pickle=False) as held:
            read = lambda kind, name: kind(*(_plain(held[f"{name}.{field}"]) for field in kind._fields))
            same, count, looks = str(held["mark"]) == mark, int(held["done"]), int(held["looks"])
            pilot, done = read(Pilot, "pilot"), [read(Population, f"repeat{r}") for r in range(count)]
    except Exception:  # whatever NumPy says of another or a broken file
        same = False
    if not same:
        must = "hold the same event: loop, params, scenario, score, above, ticks, key, chains, moves and release of JAX"
        check.refuse("path", must, f"`{path}`")
    if repeats < count:
        check.refuse("repeats", f"not be fewer than the {count} that `{path}` holds", repeats)
    return pilot, done, looks


def _plain(a):
    return a.item() if a.shape == () else a

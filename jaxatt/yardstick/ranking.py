"""`rank`: calibrate detectors to one false-alarm rate, run the catalogue, compare them on common days.

May import: board, calibration, harness, kinds, metrics, rules, telemetry, worlds, check, loss.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from jaxatt import check
from jaxatt.loss import wilson
from jaxatt.yardstick import metrics, rules, worlds
from jaxatt.yardstick.board import VERSION, Board, plain
from jaxatt.yardstick.calibration import DISTINCT, Calibration, calibration, typed, windows, windows_of
from jaxatt.yardstick.harness import Found, run
from jaxatt.yardstick.kinds import effects, single, unit_of
from jaxatt.yardstick.metrics import HORIZON
from jaxatt.yardstick.rules import validated
from jaxatt.yardstick.telemetry import Detector
from jaxatt.yardstick.worlds import WORLDS, World

RULESETS = ("nominal", "open")
RATE = 0.1  # [1/h]
MOST = 100_000  # days of a cell
EARLY = 0.03  # share of days with an alarm before the onset above which a row is marked
TIMED = 1e-4  # probability below which a score is marked as dependent on time


def rank(
    detectors: Sequence[Detector], world: World = WORLDS["leo4"], *, ruleset: str = "nominal", days: int = 256,
    key: Any = None, cells: Any = None, hours: float = 4000, progress: bool = False,
) -> Board:  # fmt: skip
    """Rank detectors of attitude faults at equal false-alarm rates.

    Args:
        detectors: to rank, of different names; the reference rows are added.
        world: where.
        ruleset: "nominal", fitted on fault-free telemetry alone, or "open".
        days: of each cell, the same in all.
        key: of calibration, validation and test days; None for the key that the hash of the detectors gives.
        cells: (kind, size) pairs; None for the catalogue.
        hours: of healthy windows to calibrate on, and as many to validate.
        progress: tell what is being run.

    Returns:
        `Board`.

    Raises:
        ValueError: no detector, two of one name, hours < 100, an unknown ruleset or cell; a detector that fails a check
            (`rules.checked`): one that looks ahead, at other days, or outside itself.
        TypeError: a detector that gives no score () and blame (channels,).

    Example:
        >>> board = rank([BASELINES["chi2_10"], mine], days=32, hours=400)
        >>> print(board.table())
    """
    started = time.perf_counter()
    check.kind("world", world, World)
    ranked = validated(detectors, world)
    if not isinstance(ruleset, str) or ruleset not in RULESETS:
        check.refuse("ruleset", f"be one of {', '.join(RULESETS)}", check.short(ruleset))
    n = windows_of(hours, world.window)
    days = check.whole("days", days, 4)
    if days > MOST:
        check.refuse("days", f"be at most {MOST}", days)
    key = None if key is None else typed(key)
    whole = [(k, s) for k, sizes in world.catalogue.items() for s in sizes]
    catalogue = whole if cells is None else _cells(world, cells)
    references = tuple(d for d in world.references if d.name not in {r.name for r in ranked})
    rows, names = (*ranked, *references), [d.name for d in ranked] + [d.name for d in references]
    tell = (
        (lambda text: print(f"{time.perf_counter() - started:6.0f} s  {text}", flush=True))
        if progress
        else (lambda text: None)
    )

    tell("checks")
    records = rules.records(world)
    found_checks = [rules.checked(d, world, records) for d in ranked]
    for d, found in zip(ranked, found_checks):
        failed = [name for name, ok in found._asdict().items() if ok is False]
        if failed:
            check.refuse(f"detectors, {d.name},", "pass the checks of the yardstick", f"not {', '.join(failed)}")
    seed = rules.seed_of(world, ranked, VERSION, world.example()) if key is None else None
    key = rules.key_of(seed) if seed is not None else key

    tell(f"calibrate and validate on {n} windows each")
    healthy = windows(world, rows, jax.random.fold_in(key, 1), n)
    fresh = windows(world, rows, jax.random.fold_in(key, 2), n)
    cal = calibration(world, healthy, fresh.peak, RATE)
    test = jax.random.fold_in(key, 3)

    def tried(cell, of=world, numbers=None, many=days):
        drawn = worlds.days(of, test, np.arange(many), cell if numbers is None else numbers)
        return run(of, rows, test, drawn, threshold=cal.threshold, excess=cal.excess), worlds.true_channels(
            world, drawn
        )

    tell(f"{len(catalogue)} cells of {days} days")
    results = {cell: tried(cell) for cell in catalogue}
    tell("held out")
    held = held_out(tried, world, test, days) if cells is None else {}
    tell("mismatch")
    robust = mismatch(tried, world, days) if cells is None else {}
    tell("time")
    timed = clock_check(world, rows, jax.random.fold_in(key, 2), healthy, min(2048, n))

    order = sorted(found_rows(names, len(ranked), catalogue, results, cal, held, robust, timed, world), key=_by_rank)
    for row in order:
        i = names.index(row["name"])
        row |= {"tuned": rows[i].tuned, "hash": rules.digest(rows[i], world.example())}
        row["nanoseconds"] = found_checks[i].nanoseconds if i < len(ranked) else None
    weights = metrics.weights_of(catalogue, world.sized)
    first, punctual = (
        np.stack([getattr(results[c][0], f) for c in catalogue])[..., : len(ranked)] for f in ("first", "punctual")
    )
    difference, error = metrics.paired(first, punctual, weights)
    header = {
        "board": VERSION, "world": world.name, "world_version": world.version, "ruleset": ruleset, "days": days,
        "hours": hours, "rate": RATE, "seed": None if seed is None else f"{seed:016x}", "detectors": names[: len(ranked)],
        "cells": None if cells is None else catalogue, "jax": jax.__version__, "jaxatt": _version(),
        "machine": f"{platform.machine()} {jax.default_backend()}", "seconds": time.perf_counter() - started,
    }  # fmt: skip
    matrix = {"names": names[: len(ranked)], "difference": difference, "error": error}
    return Board(*(plain(part) for part in (header, order, cell_table(world, names, catalogue, results), matrix)))


def _cells(world: World, cells) -> list:
    """The cells, if they are some of the world's kinds, and none is there twice."""
    given = list(cells) if isinstance(cells, (list, tuple)) else []
    if not given:
        check.refuse("cells", "be None or hold at least one cell (kind, size)", check.short(cells))
    found = []
    for i, cell in enumerate(given):
        if cell is None:
            check.refuse(f"cells[{i}]", "be (kind, size)", None)
        worlds.refuse_foreign(world, cell)
        kind, size = cell
        found.append((kind, tuple(map(float, size)) if isinstance(size, (tuple, list)) else float(size)))
    if len(set(found)) < len(found):
        check.refuse("cells", "differ", check.short(max(found, key=found.count)))
    return found


def _by_rank(row):
    return row["rank"] or 99, row["macro"] if np.isfinite(row["macro"]) else 99


def _version() -> str:
    import jaxatt

    return jaxatt.__version__


def held_out(tried, world: World, key, days: int) -> dict[str, np.ndarray]:
    """RMD60 (detectors,) of the kinds at sizes of the test key, and of kinds that are in no catalogue."""
    found = {}
    for i, (kind, sizes) in enumerate(world.sized.items()):
        share = np.asarray(jax.random.uniform(jax.random.fold_in(key, 1000 + i), (days,)))
        drawn = np.exp(np.log(sizes[0]) + share * np.log(sizes[-1] / sizes[0]))
        each = [effects((kind, float(s))) for s in drawn]
        both = jax.tree.map(lambda *a: np.array(a, np.float32), *each)
        found[f"{kind}, drawn"] = tried(None, numbers=both)[0]
    for kind, sizes in world.held_out.items():
        for size in sizes:
            found[f"{kind} {size}"] = tried((kind, size))[0]
    return {name: metrics.rmd(f.first, f.punctual)[0] for name, f in found.items()}


def mismatch(tried, world: World, days: int) -> dict[tuple[str, str], np.ndarray]:
    """Episodes of alarms per hour (detectors,) of fault-free days in worlds that differ, 2 days a cell, by mode."""
    found = {}
    for name, sample in world.mismatch.items():
        other = world._replace(name=name, sample=sample)
        episodes = tried(None, of=other, many=2 * days)[0].episodes
        for m, mode in enumerate(world.modes):
            found[name, mode] = episodes[m :: len(world.modes)].mean(0) * 3600 / world.window
    return found


def clock_check(world: World, rows, key, healthy: Found, n: int) -> np.ndarray:
    """Probability (detectors,) that exceedances of the healthy 99 % level are spread evenly over the window."""
    modes = len(world.modes)
    level = np.array(
        [[np.nanquantile(healthy.last[m::modes, d], 0.99) for m in range(modes)] for d in range(len(rows))]
    )
    drawn = worlds.days(world, key, np.arange(n), None)
    sixths = run(world, rows, key, drawn, threshold=level).sixths
    return np.array([metrics.time_dependent(sixths[:, d]) for d in range(len(rows))])


def cell_table(world: World, names, catalogue, results) -> dict:
    """ "kind size" -> row -> RMD60, its standard error, P10, P60."""
    table = {}
    for cell in catalogue:
        f = results[cell][0]
        mean, error = metrics.rmd(f.first, f.punctual)
        shares = [np.divide(*metrics.share_within(f.first, f.punctual, t)) for t in (10.0, HORIZON)]
        table[label(world, cell)] = {
            name: [mean[i], error[i], shares[0][i], shares[1][i]] for i, name in enumerate(names)
        }
    return table


def label(world: World, cell) -> str:
    """A cell in words."""
    kind, size = cell
    sizes = size if isinstance(size, tuple) else (size,)
    return f"{kind} {' + '.join(f'{s:g}' for s in sizes)}" if kind not in world.plain else kind


def found_rows(
    names, ranked: int, catalogue, results, cal: Calibration, held, robust, timed, world: World
) -> list[dict]:
    """One dict a row."""
    weights = metrics.weights_of(catalogue, world.sized)
    first = np.stack([results[c][0].first for c in catalogue])
    punctual = np.stack([results[c][0].punctual for c in catalogue])
    values = np.stack([metrics.rmd(first[i], punctual[i])[0] for i in range(len(catalogue))])
    draws = (
        np.random.default_rng(0)
        .multinomial(first.shape[1], np.full(first.shape[1], 1 / first.shape[1]), 400)
        .astype(float)
    )
    difference, error = metrics.paired(first[..., :ranked], punctual[..., :ranked], weights)
    places = metrics.ranks(difference, error)
    sized = [i for i, (kind, _) in enumerate(catalogue) if kind in world.sized]
    rows = []
    for d, name in enumerate(names):
        clipped, mask = metrics.restricted(first[..., d]), punctual[..., d].astype(float)
        again = (draws @ (clipped * mask).T) / np.maximum(draws @ mask.T, 1)
        of = lambda pick, d=d: float(np.mean([values[i, d] for i in pick])) if pick else None
        share = {t: np.sum([metrics.share_within(first[i, :, d], punctual[i, :, d], t) for i in sized], axis=0) for t in (10.0, HORIZON)} if sized else {}  # fmt: skip
        early = 1 - punctual[..., d].mean()
        unclear = float(np.mean([results[c][0].unclear[:, d].mean() for c in catalogue]))
        worst = max(robust.items(), key=lambda item, d=d: item[1][d]) if robust else None
        notes = _notes(cal, d, early, unclear, timed[d], world)
        p_within = {f"p{round(t)}": 100 * float(np.divide(*share[t])) if share else None for t in (10.0, HORIZON)}
        rows.append({
            "name": name, "rank": int(places[d]) if d < ranked else None,
            "tied": bool(d < ranked and np.sum(places == places[d]) > 1),
            "macro": float(weights @ values[:, d]) if sized else float("nan"),
            "macro_se": float(np.std(again @ weights, ddof=1)), "mean_of_cells": of(sized),
            "units": unit_means(world, catalogue, values[:, d]), **p_within,
            "p_intervals": {f"p{round(t)}": [100 * float(x) for x in wilson(*share[t])] for t in share},
            "detectable": detectable_sizes(world, catalogue, first[..., d], punctual[..., d]),
            "isolation": isolation(catalogue, results, d), "early": float(early), "unclear": unclear,
            "pairs": of([i for i, (kind, _) in enumerate(catalogue) if kind in world.pairs]),
            "threshold": {m: [cal.threshold[d, i], cal.low[d, i], cal.high[d, i]] for i, m in enumerate(world.modes)},
            "rate": {m: [cal.rate[d, i], cal.rate_low[d, i], cal.rate_high[d, i]] for i, m in enumerate(world.modes)},
            "robustness": {} if worst is None else {
                "rate": float(worst[1][d]), "world": worst[0][0], "mode": worst[0][1],
                "all": {f"{w}, {m}": float(r[d]) for (w, m), r in robust.items()}},
            "consequence": consequence(world, catalogue, results, d), "time": float(timed[d]), "notes": notes,
            "held_out": float(np.mean([v[d] for v in held.values()])) if held else None,
            "held_out_cells": {cell: float(v[d]) for cell, v in held.items()},
        })  # fmt: skip
    return rows


def _notes(cal: Calibration, d: int, early, unclear, timed, world: World) -> list[str]:
    notes = []
    for m, mode in enumerate(world.modes):
        if cal.distinct[d, m] < DISTINCT and cal.distinct[d, m] < 0.5 * cal.windows:
            low, high = cal.reachable_low[d, m], cal.reachable_high[d, m]
            notes.append(f"{mode}: threshold not reachable, rate in [{low:.3g}, {high:.3g}]")
    if early > EARLY:
        notes.append(f"{100 * early:.1f} % early")
    if unclear > 0:
        notes.append(f"{100 * unclear:.2g} % NaN")
    if timed < TIMED:
        notes.append("time-dependent")
    return notes


def unit_means(world: World, catalogue, values) -> dict[str, float]:
    """Mean over the sized kinds of each unit of the mean over their sizes."""
    found = {}
    for unit in world.units:
        kinds = sorted({k for k, _ in catalogue if k in world.sized and unit_of(k) == unit})
        if kinds:
            of = [np.mean([v for (k, _), v in zip(catalogue, values) if k == kind]) for kind in kinds]
            found[unit] = float(np.mean(of))
    return found


def detectable_sizes(world: World, catalogue, first, punctual, resamples: int = 200) -> dict:
    """Smallest size found within 10 s with probability .95 and its bootstrap interval, for kinds of three sizes or more."""
    found, rng = {}, np.random.default_rng(1)
    for kind in world.sized:
        here = [i for i, (k, _) in enumerate(catalogue) if k == kind]
        if len(here) < 3:
            continue
        sizes = [catalogue[i][1] for i in here]
        hit, kept = (first[here] <= 10.0) & punctual[here], punctual[here].astype(float)
        n = hit.shape[1]
        of = lambda w, sizes=sizes, hit=hit, kept=kept: metrics.detectable(
            sizes, (hit @ w) / np.maximum(kept @ w, 1), kept @ w
        )
        again = [of(w.astype(float)) for w in rng.multinomial(n, np.full(n, 1 / n), resamples)]
        low, high = np.quantile(again, [0.025, 0.975], method="inverted_cdf")
        found[kind] = [of(np.ones(n)), float(low), float(high)]
    return found


def isolation(catalogue, results, d: int) -> dict:
    """Mean log score at the alarm and ten seconds on, and the share of right channels; single faults, macro over units."""
    scores: dict[str, dict[str, list]] = {"at_alarm": {}, "later": {}, "right": {}}
    for cell in catalogue:
        if not single(cell[0]):
            continue
        f, truth = results[cell]
        hit = np.isfinite(f.first[:, d]) & f.punctual[:, d]
        unit = unit_of(cell[0])
        for name in ("at_alarm", "later"):
            blame = getattr(f, name)[:, d]
            good = hit & np.isfinite(blame).all(-1)
            scores[name].setdefault(unit, []).extend(metrics.log_score(blame[good][:, None], truth[good])[:, 0])
        good = hit & np.isfinite(f.at_alarm[:, d]).all(-1)
        if good.any():
            guess = np.argmax(f.at_alarm[good, d], axis=-1)
            scores["right"].setdefault(cell[0], []).extend(truth[good][np.arange(good.sum()), guess])
    found = {}
    for name in ("at_alarm", "later"):
        units = [np.mean(v) for v in scores[name].values() if len(v)]
        found[name] = float(np.mean(units)) if units else None
    return found | {"right": {kind: float(np.mean(v)) for kind, v in scores["right"].items()}}


def consequence(world: World, catalogue, results, d: int):
    """Mean pointing error beyond the healthy one until the alarm or 60 s [deg s], wheel kinds."""
    here = [results[c][0] for c in catalogue if unit_of(c[0]) == "wheel" and c[0] in world.sized]
    return (
        float(np.rad2deg(np.mean([metrics.mean_where(f.excess[:, d], f.punctual[:, d]) for f in here])))
        if here
        else None
    )

"""Small probabilities against known ones: ``python -m benchmarks.rare [NAME ...] [--sets N] [--out FILE]``.

Every case is estimated by ``--sets`` sets with keys of their own, a set being a pilot and 8 repeats. Each line shows the
probability that is known (exact, by quadrature, or by importance sampling and long runs made for the case), the mean of the
sets over it, the spread of a set, how many intervals of 95 % cover it, how many sets carry a flag, runs and CPU seconds of
a set, and how many times as many runs, and CPU seconds of `sweep`, plain sampling takes to the same spread.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

import jaxatt
from jaxatt import rare, scores, sweep
from jaxatt.contract import System
from jaxatt.loops import observer_pd


class Case(NamedTuple):
    """An event whose probability is known."""

    system: System
    params: Any
    scenario: Any
    ticks: int
    score: Callable
    above: float
    exact: float
    chains: int = 96


def mirror(normals: int) -> System:
    """A loop whose log is its noise, shifted by the scenario."""
    tick = lambda params, scenario, now, x, z, noise: (x, z, scenario + noise)
    return System(lambda params, scenario: (scenario, ()), tick, lambda p, s, t, x, z: 0 * x, 1.0, 1, normals)


def square(params, scenario, now, log):
    return scores.peak(log @ log)


def scaled(params, scenario, now, log):
    return scores.total(params * jnp.sum(log) / jnp.sqrt(1000.0))


def four(params, scenario, now, log):
    u, v = (log[0] + log[1]) / jnp.sqrt(2.0), (log[0] - log[1]) / jnp.sqrt(2.0)
    return scores.peak(jnp.maximum(jnp.abs(v) - 0.2 * u * u, jnp.abs(u) - 0.5))


class Modes(scores.Total):
    """The larger of two sums over their thresholds."""

    def __add__(self, later):
        return Modes(self.total + later.total, self.rest + later.rest)

    def value(self):
        return jnp.maximum(self.total, self.rest)


def modes(params, scenario, now, log):
    """x_1, and minus the sum of the other 99 over the root of 99, less params by the last of the 10 ticks."""
    first = jnp.where(now.k == 0, log[0], 0.0)
    return Modes(first, -(jnp.sum(log) - first) / jnp.sqrt(99.0) - params / 10)


def breitung(params, scenario, now, log):
    a, b = log
    g1 = jnp.where(a > 3.5, 4 - a, 0.85 - 0.1 * a)
    g2 = jnp.where(b > 2, 0.5 - 0.1 * b, 2.3 - b)
    return scores.final(-jnp.minimum(g1, g2))


def needle(params, scenario, now, log):
    return scores.final(jnp.where(log[0] > 4, 1.0, log[1] / 5))


OMEGA, ZETA, HELD = 2 * np.pi * 1.25, 0.02, 0.02  # [rad/s], [1], [s] of the oscillator


def oscillator() -> System:
    """q'' + 2 zeta omega q' + omega^2 q = w from rest, white noise held between ticks."""
    flow = lambda p, s, t, x, z: (x[1], z - 2 * ZETA * OMEGA * x[1] - OMEGA**2 * x[0])
    return System(lambda p, s: ((s, s), s), lambda p, s, now, x, z, n: (x, n[0], x[0]), flow, HELD, 1, 1)


def spread_of_oscillator(ticks: int) -> float:
    """Standard deviation of q after so many ticks, by the exact transition."""
    from scipy.linalg import expm

    a = np.zeros((3, 3))
    a[0, 1], a[1, 0], a[1, 1], a[1, 2] = 1, -(OMEGA**2), -2 * ZETA * OMEGA, 1
    step = expm(a * HELD)
    f, g, covariance = step[:2, :2], step[:2, 2], np.zeros((2, 2))
    for _ in range(ticks):
        covariance = f @ covariance @ f.T + np.outer(g, g)
    return float(np.sqrt(covariance[0, 0]))


def excursion(params, scenario, now, log):
    return scores.peak(jnp.abs(log) / params)


def peak_xi(params, scenario, now, log):
    return scores.peak(log.xi, now.k >= 100)


def cases() -> dict[str, Case]:
    """All cases by name."""
    one, zero, two = np.float32(1), np.float32(0), mirror(2)
    healthy = jaxatt.on_axes(jaxatt.Fault())
    day = observer_pd.scenario._replace(star=healthy, gyro=healthy)
    shipped, day = jax.tree.map(np.float32, (observer_pd.params, day))
    sigma = np.float32(spread_of_oscillator(1500))
    excursions = (3.5, 4.258e-2), (4.0, 7.646e-3), (4.5, 1.0188e-3), (5.0, 1.0321e-4), (6.0, 4.699e-7)
    fifty = lambda p: float(stats.chi2.isf(-np.expm1(np.log1p(-p) / 50), 3))  # that the largest of 50 exceeds with p
    peaks = (3.23e-3, 1.067e-3), (3.6e-3, 3.22e-5), (3.8e-3, 4.15e-6), (4.0e-3, 4.79e-7), (4.4e-3, 4.44e-9)
    found = {
        "chi_square_6": Case(mirror(6), one, zero, 300, square, 50.74440649, 1e-6),
        "chi_square_9": Case(mirror(6), one, zero, 300, square, 65.54834804, 1e-9),
        "fifty_4": Case(mirror(3), one, zero, 50, square, fifty(1e-4), 1e-4, 48),
        "fifty_6": Case(mirror(3), one, zero, 50, square, fifty(1e-6), 1e-6, 48),
        "linear_4": Case(mirror(100), one, zero, 10, scaled, 4.0, 3.16712e-5),
        "linear_6": Case(mirror(100), one, zero, 10, scaled, 6.0, 9.86588e-10),
        "four_3": Case(two, one, zero, 1, four, 3.0, 2.22279507e-3),
        "four_4": Case(two, one, zero, 1, four, 4.0, 4.51213895e-5),
        "four_5": Case(two, one, zero, 1, four, 5.0, 3.62993610e-7),
        "modes": Case(mirror(10), zero, zero, 10, modes, 4.75, 2.0341661e-6),
        "modes_uneven": Case(mirror(10), np.float32(0.5), zero, 10, modes, 4.5, 3.6843e-6),
        "breitung": Case(two, one, zero, 1, breitung, 0.0, 3.19579e-5),
        "needle": Case(two, one, zero, 1, needle, 0.999999, 3.19579e-5),
    }
    for b, p in excursions:
        found[f"oscillator_{b:g}"] = Case(oscillator(), sigma, zero, 1500, excursion, b, p, 304)
    for b, p in peaks:
        found[f"observer_pd_{b:g}"] = Case(observer_pd.system, shipped, day, 300, peak_xi, b, p, 128)
    return found


def measured(case: Case, sets: int) -> dict:
    """What the sets of a case say, against what is known."""
    ask: dict[str, Any] = dict(ticks=case.ticks, score=case.score)
    estimate = lambda seed: rare.probability(
        case.system, case.params, case.scenario, jax.random.key(seed), above=case.above, chains=case.chains,
        progress=False, **ask,
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # flags are counted
        estimate(0)
        start = time.process_time()
        found = [estimate(1 + seed) for seed in range(sets)]
        cpu = (time.process_time() - start) / sets
    many = 2048
    days = jax.tree.map(lambda a: np.broadcast_to(a, (many, *np.shape(a))), case.scenario)
    plain = lambda: sweep(case.system, case.params, days, jax.random.key(0), progress=False, **ask)
    plain()
    start = time.process_time()
    plain()
    each = (time.process_time() - start) / many
    p = np.array([loss.p for loss in found])
    cv = float(np.mean([loss.cv for loss in found]) if sets < 20 else p.std(ddof=1) / p.mean())
    runs = float(np.mean([loss.runs for loss in found]))
    needed = (1 - case.exact) / (case.exact * cv**2)
    return dict(
        exact=case.exact, mean=float(p.mean() / case.exact), error=cv / sets**0.5, cv=cv, sets=sets,
        covered=sum(loss.low < case.exact < loss.high for loss in found), runs=runs, cpu=cpu,
        flagged=sum(bool(loss.flags) for loss in found), stuck=sum("stuck" in loss.flags for loss in found),
        fewer_runs=needed / runs, less_cpu=needed * each / cpu,
    )  # fmt: skip


def main() -> None:
    known = cases()
    parser = argparse.ArgumentParser(prog="python -m benchmarks.rare", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(known)}; none for all")
    parser.add_argument("--sets", type=int, default=4, help="estimates of each case")
    parser.add_argument("--out", type=Path, default=Path("results/rare.json"), help="table as JSON")
    args = parser.parse_args()
    jaxatt.configure()
    rows = {}
    print(f"{'case':18}{'known':>10}{'mean/known':>16}{'cv':>6}{'covered':>9}{'flags':>6}{'stuck':>6}{'runs':>9}{'CPU s':>7}"
          f"{'fewer runs':>12}{'less CPU':>10}", flush=True)  # fmt: skip
    for name in args.names or known:
        row = rows[name] = measured(known[name], args.sets)
        print(f"{name:18}{row['exact']:10.3g}{row['mean']:9.3f} +- {row['error']:.2f}{row['cv']:6.2f}"
              f"{row['covered']:5d}/{row['sets']:<3d}{row['flagged']:6d}{row['stuck']:6d}{row['runs']:9.0f}{row['cpu']:7.1f}"
              f"{row['fewer_runs']:12.3g}{row['less_cpu']:10.3g}", flush=True)  # fmt: skip
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()

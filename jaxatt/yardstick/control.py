"""Controllers on the yardstick: the same faults of wheels, starts and noise for each, and one question: did it settle?

Plant, sensors and MEKF are those of `leo4`, of which a controller replaces `decide`. An episode holds a fixed attitude for
300 s from an error of 1 to 10 deg, with wheels that are weak, reversed or biased from the start. It succeeds if the true
pointing error is at most .2 deg at every tick of the last 30 s. Episode i has the same body, start, noise and order of wheels
in every cell and for every controller, so all comparisons are paired.

May import: leo4, leo4_days, board, calibration, metrics, rules, worlds, check, contract, faults, loss, scores, sweeping, vec.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple
from zlib import crc32

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check, scores
from jaxatt.contract import System, no_check
from jaxatt.faults import Fault
from jaxatt.loss import wilson
from jaxatt.sweeping import progress_bar, sweep
from jaxatt.vec import Vec3, zeros
from jaxatt.yardstick import leo4, leo4_days, metrics, rules, worlds
from jaxatt.yardstick.board import Pairs, fixed, opened, plain, row_of, stored
from jaxatt.yardstick.calibration import typed
from jaxatt.yardstick.leo4 import Reading
from jaxatt.yardstick.worlds import WORLDS, World

VERSION = "1"
DURATION, JUDGED = 300.0, 30.0  # [s] of an episode; of its end, in which the gate holds
GATE = 0.2 * np.pi / 180  # [rad] of the true pointing error
PACKETS = round(DURATION / leo4.PACKET)
ERROR = (1.0, 10.0)  # [deg] at the start, about an axis of any direction
SPIN = 2e-4  # [rad/s] standard deviation of the rate about each axis at the start
DECILES = ("odd", "even", "all")
RANKS = "wild"  # the cell that ranks


class Controller(NamedTuple):
    """A controller: init(params) -> z; step(params, z, reading) -> z, torque (4,) of the wheels [N m], at 10 Hz."""

    name: str
    init: Callable[[Any], Any]
    step: Callable[[Any, Any, Reading], tuple[Any, Any]]
    params: Any = ()  # `init` and `step` get it first; any tree of arrays
    tuned: int = 0  # how many numbers were fitted


# faults


class Cell(NamedTuple):
    """Ranges of the faults of four wheels, which each episode puts into an order of its own; uniform in each range."""

    low: Any  # (4,) gains [1], sizes
    high: Any  # (4,)
    flipped: Any  # (4,) probability that the gain is negative
    least: Any  # (4,) biases [N m], sizes, of either sign
    most: Any  # (4,)
    onset: Any  # (2,) [s] the range


def cell(gain=(), flipped=(), bias=(), onset=(0.0, 0.0)) -> Cell:
    """A cell by its wheels: ranges (low, high) of gains [1] and of biases [mN m]; wheels that are not told of are healthy."""
    four = lambda given, healthy: np.array([*given, *[healthy] * (4 - len(given))], float)
    gains, biases = four(gain, (1.0, 1.0)), 1e-3 * four(bias, (0.0, 0.0))
    return Cell(gains[:, 0], gains[:, 1], four(flipped, 0.0), biases[:, 0], biases[:, 1], np.array(onset, float))


CELLS = {
    "none": cell(),
    "gain": cell(gain=[(0.0, 0.6)]),
    "gain2": cell(gain=[(0.02, 0.6)] * 2),
    "gain4": cell(gain=[(0.1, 0.6)] * 4),
    "sign": cell(gain=[(0.3, 1.0)], flipped=[1]),
    "sign2": cell(gain=[(0.3, 1.0)] * 2, flipped=[1] * 2),
    "bias": cell(bias=[(2.0, 10.0)]),
    "all": cell(gain=[(0.0, 0.6)], bias=[(0.0, 0.0), (2.0, 10.0)]),
    "wild": cell(gain=[(0.1, 1.0)] * 4, flipped=[0.5] * 4, bias=[(0.0, 5.0)] * 4),
    "dead_flip": cell(gain=[(0.0, 0.0), (0.1, 1.0)], flipped=[0, 1], bias=[(0.0, 0.0)] * 2 + [(0.0, 5.0)] * 2),
    "late": cell(gain=[(0.3, 1.0)], flipped=[1], onset=(60.0, 180.0)),
}


def _share(u, deciles):
    """The place in a range of a uniform number u: deciles 0 odd ones, the first, third ..., 1 even ones, 2 all."""
    tenth = 2 * jnp.floor(5 * u) + deciles + (5 * u - jnp.floor(5 * u))
    return jnp.where(deciles > 1, u, tenth / 10)


def _episode(name, spread: leo4_days.Spread, key, index, faults: tuple[Cell, Any]) -> leo4.Scenario:
    """The scenario of one episode; name and spread as of `leo4_days.draw`."""
    cell, deciles = faults
    day = leo4_days.draw(name, spread, key, index)
    key = jax.random.fold_in(jax.random.fold_in(jax.random.fold_in(key, np.uint32(crc32(b"control"))), name), index)
    gauss, even = jax.random.split(key)
    axis, spin = jnp.split(jax.random.normal(gauss, (6,), jnp.float32), 2)
    uniform = jax.random.uniform(even, (22,), jnp.float32)
    place, start, gain, bias, flip, sign = jnp.split(uniform, [4, 6, 10, 14, 18])
    role = jnp.argsort(jnp.argsort(place))
    cell = jax.tree.map(lambda a: a[role] if a.shape == (4,) else a, cell)
    between = lambda low, high, u: low + (high - low) * _share(u, deciles)
    error, onset = between(*ERROR, start[0]), between(cell.onset[0], cell.onset[1], start[1])
    wheel = jax.tree.map(lambda a: jnp.broadcast_to(a, 4), Fault())._replace(
        onset=jnp.broadcast_to(onset, 4),
        scale=between(cell.low, cell.high, gain) * jnp.where(flip < cell.flipped, -1, 1),
        bias=between(cell.least, cell.most, bias) * jnp.where(sign < 0.5, -1, 1),
    )
    off = (error * np.pi / 180 / jnp.sqrt(axis @ axis)) * axis
    return day._replace(
        mode=0.0 * day.mode, wave=zeros(), off=Vec3.of(off), spin=Vec3.of(SPIN * spin), wheel=wheel
    )  # fmt: skip


def episodes(cell: Cell, key, numbers, *, world: World = WORLDS["leo4"], deciles: str = "odd") -> leo4.Scenario:
    """Scenarios of the episodes ``numbers`` of a cell, float32 NumPy arrays with n in front.

    Args:
        cell: one of `CELLS`, or a `cell` of your own.
        key: of the draws.
        numbers: (n,) which episodes.
        world: whose bodies and sensors.
        deciles: "odd" for the tenths of each range, counted from one, that are tested; "even" for those to tune on; "all".
            The ranges are those of gain, bias, onset and starting error.

    Raises:
        ValueError: deciles of another name.

    Example:
        >>> train = episodes(CELLS["wild"], jax.random.key(0), np.arange(1024), deciles="even")
    """
    if not isinstance(deciles, str) or deciles not in DECILES:
        check.refuse("deciles", f"be one of {', '.join(DECILES)}", check.short(deciles))
    wide = lambda a: np.broadcast_to(a, (len(numbers), *np.shape(a)))
    faults = jax.tree.map(wide, (cell, float(DECILES.index(deciles))))
    return worlds.drawn(partial(_episode, *world.sample.args), key, numbers, faults)


# the loop


class Params(NamedTuple):
    """The world's params and the controller's."""

    world: leo4.Params
    controller: Any


@lru_cache
def driven(init: Callable, step: Callable) -> System:
    """The loop of `leo4` under a controller; equal arguments give the same system.

    Its params are `Params`, its scenarios and log those of `leo4`, so `jaxatt.simulate`, `sweep` and gradients take it.
    """

    def begin(params: Params, scenario):
        x, z = leo4.init(params.world, scenario)
        return x, (z, init(params.controller), jnp.zeros_like(scenario.bias))

    def tick(params: Params, scenario, now, x, z, noise):
        z, memory, torque = z
        law = lambda memory, reading: step(params.controller, memory, reading)
        z, memory, log = leo4.packet(params.world, scenario, now, z, noise, law, memory, torque)
        return x, (z, memory, log.telemetry.torque[-1]), log

    def flow(params: Params, scenario, t, x, z):
        return x

    return leo4.system._replace(init=begin, tick=tick, flow=flow, check=no_check)


class Outcome(NamedTuple):
    """What an episode leaves; n episodes in front."""

    success: Any  # bool: within the gate at every tick of the last 30 s
    settled: Any  # [s] from the onset until the pointing error stays within the gate; 0 if it never left
    outside: Any  # bool: beyond it at the end
    peak: Any  # [rad] largest pointing error from the onset on; NaN of a lost run
    lost: Any  # bool: some command was no number


def score(params: Params, scenario, now, log: leo4.Log) -> Outcome:
    """The tallies of one packet; an error that is NaN is beyond the gate."""
    t = now.t + leo4.DT * jnp.arange(leo4.TICKS, dtype=log.pointing.dtype)
    beyond = ~(log.pointing <= GATE)
    onset = scenario.wheel.onset[0]
    angle = 2 * jnp.arcsin(jnp.minimum(log.pointing / 2, 1))  # it is the chord
    return Outcome(
        success=scores.always(~jnp.any(beyond & (t > DURATION - JUDGED - leo4.DT / 2))),
        settled=scores.peak(jnp.max(jnp.where(beyond, t + leo4.DT - onset, 0))),
        outside=scores.final(beyond[-1]),
        peak=scores.peak(jnp.max(jnp.where(t >= onset, angle, 0))),
        lost=scores.always(jnp.isfinite(jnp.sum(log.telemetry.torque))),  # that none was lost; `run` negates it
    )


def run(controller: Controller, scenarios: leo4.Scenario, key, *, world: World = WORLDS["leo4"]) -> Outcome:
    """What n episodes under a controller leave.

    Args:
        controller: that drives.
        scenarios: leaves with n in front (`episodes`).
        key: of the noise: episode i meets ``noise_of(system, key, i, PACKETS)``.
        world: the params of its computer.

    Returns:
        NumPy arrays, (n,); settled is inf where the end is beyond the gate.

    Example:
        >>> key = jax.random.key(0)
        >>> found = run(CONTROLLERS["pd"], episodes(CELLS["gain"], key, np.arange(1024)), key)
        >>> found.success.mean()
    """
    system = driven(controller.init, controller.step)
    params = jax.tree.map(worlds.short, Params(world.params, controller.params))
    with np.errstate(all="ignore"):
        found = sweep(system, params, scenarios, key, ticks=PACKETS, score=score, progress=False)
    return found._replace(settled=np.where(found.outside, np.inf, found.settled), lost=~found.lost)


# the board


class ControlBoard(NamedTuple):
    """A ranking of controllers in plain values: numbers, words, lists and dicts; None where there is no number."""

    header: dict  # versions, test key, episodes a cell, deciles, seconds
    rows: list  # one dict a controller, the best first
    cells: dict  # cell -> name -> success [share, low, high], settling and peak [median, 95 %] in s and deg, lost
    matrix: dict  # names; difference and error: cell -> (n, n)

    def row(self, name: str) -> dict:
        """The row of that name; KeyError where there is none."""
        return row_of(self.rows, name)

    def pairs(self, cell: str = RANKS) -> Pairs:
        """Differences of success in a cell, row - column, on the same episodes, with standard errors."""
        of = (np.array(self.matrix[part][cell], float) for part in ("difference", "error"))
        return Pairs(tuple(self.matrix["names"]), *of)

    def table(self) -> str:
        """The board as text: success with half the width of Wilson's interval, settling times, largest errors."""
        h, names = self.header, [name for name in CELLS if name in self.cells]  # a file sorts them by name
        lines = [f"yardstick {h['board']}, controllers in {h['world']}, {h['n']} episodes a cell, {h['deciles']} deciles, test key {h['seed'] or 'given'}"]  # fmt: skip
        for head, field, said in (
            ("success %", "success", lambda p, low, high: f"{100 * p:.1f} +-{50 * (high - low):3.1f}"),
            ("settling s, median / 95 % of all episodes; - is never", "settling", _two(0)),
            ("largest pointing error from the onset deg, median / 95 %", "peak", _two(1)),
        ):
            lines += ["", head, f"{'':16} " + " ".join(f"{name:>13}" for name in names)]
            for row in self.rows:
                each = [said(*self.cells[c][row["name"]][field]) for c in names]
                rank = f"{row['rank']}{'=' if row['tied'] else ''}"
                lines.append(f"{rank:3} {row['name']:12} " + " ".join(f"{text:>13}" for text in each))
        notes = [f"{row['name']}: {row['lost']} episodes lost by a command that is no number" for row in self.rows if row["lost"]]  # fmt: skip
        return "\n".join([*lines, *notes])

    def figure(self):
        """Success of each controller in each cell with its interval. Needs matplotlib."""
        import matplotlib.pyplot as plt

        names, rows = [name for name in CELLS if name in self.cells], [row["name"] for row in self.rows]
        found = np.array([[self.cells[c][name]["success"] for c in names] for name in rows], float)
        fig, ax = plt.subplots(figsize=(1.5 + 0.92 * len(names), 1.2 + 0.62 * len(rows)), layout="constrained")
        image = ax.imshow(100 * found[..., 0], cmap="cividis", vmin=0, vmax=100, aspect="auto")
        for i, j in np.ndindex(*found.shape[:2]):
            share, low, high = 100 * found[i, j]
            dark = "white" if share < 55 else "black"
            ax.text(j, i - 0.12, f"{share:.1f}", ha="center", va="center", color=dark, fontsize=10)
            ax.text(j, i + 0.22, f"{low:.1f} to {high:.1f}", ha="center", va="center", color=dark, fontsize=6.5)
        ax.set_xticks(range(len(names)), names)
        ax.set_yticks(range(len(rows)), [f"{row['rank']}  {row['name']}" for row in self.rows])
        ax.xaxis.tick_top()
        ax.get_xticklabels()[names.index(RANKS)].set_fontweight("bold")
        fig.colorbar(image, ax=ax, label="success [%]", pad=0.01)
        fig.suptitle(f"{self.header['n']} episodes a cell; below each share its 95 % interval; {RANKS} ranks", fontsize=9)  # fmt: skip
        return fig

    def to_json(self, path) -> None:
        """Write the board, sorted keys."""
        stored(self, path)

    @classmethod
    def from_json(cls, path) -> ControlBoard:
        """The board of a file; ValueError for what is none."""
        return cls(*opened(cls._fields, path))


def _two(digits: int) -> Callable:
    return lambda a, b: f"{fixed(a, 0, digits)} / {fixed(b, 0, digits)}"


def control(
    controllers: Sequence[Controller], world: World = WORLDS["leo4"], *, n: int = 20_000, key: Any = None,
    deciles: str = "odd", progress: bool | None = None,
) -> ControlBoard:  # fmt: skip
    """Rank controllers by how often they settle under faults of wheels that they are not told of.

    Args:
        controllers: to rank, of different names.
        world: where; one of `leo4`'s.
        n: episodes of each of the eleven `CELLS`, the same for all controllers.
        key: of starts, faults and noise; None for the key that the hash of the controllers gives.
        deciles: of the ranges, as of `episodes`: what is tested unless you tune or compare.
        progress: show a bar; None shows it on terminals and in notebooks, after two seconds.

    Returns:
        `ControlBoard`. A command that is no number loses the episode, which counts as failed.

    Raises:
        ValueError: no controller, two of one name, another world, n < 2, a step with callbacks or other effects.
        TypeError: a controller that does not give z as it got it and torques (4,).

    Example:
        >>> board = control([CONTROLLERS["pid"], mine], n=2048)
        >>> print(board.table())
    """
    started = time.perf_counter()
    ranked, n = rules.named("controllers", controllers, Controller, _shapes), check.whole("n", n, 2)
    check.kind("world", world, World)
    if world.system is not leo4.system or not isinstance(world.sample, partial):
        check.refuse("world", "be a world of leo4's", world.name)
    for c in ranked:
        if not rules.pure(c, example()):
            check.refuse(f"controllers, {c.name},", "be free of callbacks and other effects", "not")
    key = None if key is None else typed(key)
    seed = rules.seed_of(world, ranked, VERSION, example()) if key is None else None
    key = rules.key_of(seed) if seed is not None else key

    found: dict[str, dict[str, Outcome]] = {}
    with progress_bar(progress, n * len(CELLS) * len(ranked), " episodes") as bar:
        for name, faults in CELLS.items():
            scenarios, found[name] = episodes(faults, key, np.arange(n), world=world, deciles=deciles), {}
            for c in ranked:
                found[name][c.name] = run(c, scenarios, key, world=world)
                bar.update(n)
    header = {
        "board": VERSION, "track": "control", "world": world.name, "world_version": world.version, "n": n,
        "deciles": deciles, "seed": None if seed is None else f"{seed:016x}", "controllers": [c.name for c in ranked],
        "jax": jax.__version__, "machine": f"{platform.machine()} {jax.default_backend()}",
        "seconds": time.perf_counter() - started,
    }  # fmt: skip
    return ControlBoard(*(plain(part) for part in (header, *board_parts(ranked, found))))


def board_parts(ranked: Sequence[Controller], found: dict[str, dict[str, Outcome]]) -> tuple[list, dict, dict]:
    """Rows, cells and matrix of a board from what the episodes left, by cell and controller."""
    names = [c.name for c in ranked]
    wins = {cell: np.stack([outcome[name].success for name in names]).astype(float) for cell, outcome in found.items()}
    gaps = {cell: success[:, None] - success for cell, success in wins.items()}
    error = {cell: gap.std(-1, ddof=1) / np.sqrt(gap.shape[-1]) for cell, gap in gaps.items()}
    difference = {cell: gap.mean(-1) for cell, gap in gaps.items()}
    rank = metrics.ranks(-difference[RANKS], error[RANKS])  # less success is worse
    rows = [
        {
            "name": c.name, "rank": int(rank[i]), "tied": int(np.sum(rank == rank[i])) > 1, "tuned": c.tuned,
            "success": {cell: success[i].mean() for cell, success in wins.items()},
            "lost": int(sum(outcome[c.name].lost.sum() for outcome in found.values())), "hash": rules.digest(c, example()),
        }
        for i, c in enumerate(ranked)
    ]  # fmt: skip
    rows.sort(key=lambda row: (row["rank"], -row["success"][RANKS], names.index(row["name"])))
    cells = {cell: {name: summary(outcome[name]) for name in names} for cell, outcome in found.items()}
    return rows, cells, {"names": names, "difference": difference, "error": error}


def summary(found: Outcome) -> dict:
    """Success with its 95 % interval, quantiles of settling time and peak over all episodes, how many were lost."""
    n, wins = len(found.success), int(np.sum(found.success))
    known = lambda values: np.where(np.isnan(values), np.inf, values)
    of = lambda values: [float(np.quantile(known(values), q, method="inverted_cdf")) for q in (0.5, 0.95)]
    return {
        "success": [wins / n, *wilson(wins, n)], "settling": of(found.settled), "peak": of(np.rad2deg(found.peak)),
        "lost": int(found.lost.sum()),
    }  # fmt: skip


def example() -> Reading:
    """A reading at rest on the aim, float32."""
    q, three, four = jnp.array([1.0, 0, 0, 0], jnp.float32), jnp.zeros(3, jnp.float32), jnp.zeros(4, jnp.float32)
    return Reading(four, q, jnp.asarray(True), q, three, q, three, three, four)


def _shapes(c: Controller) -> None:
    """Raise where a step does not give back the structure of z, and torques (4,)."""
    torque = rules.stepped(c, example(), "torque (4,)")
    if not hasattr(torque, "shape") or torque.shape != (4,) or not jnp.issubdtype(torque.dtype, jnp.floating):
        found = f"{torque.shape} and type {torque.dtype}" if hasattr(torque, "shape") else check.short(torque)
        raise TypeError(f"`{c.name}.step` must return torques of shape (4,) and a floating type, but it is {found}.")

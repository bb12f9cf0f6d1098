"""Detectors in the loop: several share one simulation, and each day leaves a few numbers.

The tallies of a detector: its largest score in the window, its first alarm after the onset, whether it alarmed before,
its blame at the alarm and ten seconds later, the pointing error until the alarm, episodes of alarms. Several detectors
run in one sweep and cost one simulation. The score of a packet counts at its stamp, t = 0 at the window's start.

May import: metrics, telemetry, worlds, compiling, contract, scores, soft_scores, sweeping.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import scores, soft_scores
from jaxatt.compiling import jitted
from jaxatt.contract import System, no_check
from jaxatt.sweeping import sweep
from jaxatt.yardstick import worlds
from jaxatt.yardstick.metrics import HORIZON
from jaxatt.yardstick.telemetry import Detector, OnResiduals
from jaxatt.yardstick.worlds import World

LATER = 10.0  # [s] after an alarm at which the blame is read again
QUIET = 60.0  # [s] that end an episode of alarms
SIXTHS = 6


class Params(NamedTuple):
    """The world's params, each detector's, and what the harness decides."""

    world: Any
    detectors: tuple
    threshold: Any  # (detectors, modes)
    excess: Any  # (modes,) [rad] pointing error above which it counts


class Watch(NamedTuple):
    """State of the harness beside the world's and the detectors'."""

    alarm: Any  # (detectors,) [s] first alarm after the onset; inf before
    last: Any  # (detectors,) [s] last alarm


class Told(NamedTuple):
    """What a packet told."""

    t: Any  # [s] stamp in the window
    score: Any  # (detectors,)
    up: Any  # (detectors,) bool: in the window and not at or below the threshold
    blame: Any  # (detectors, channels)
    alarm: Any  # (detectors,) [s] first alarm after the onset until now
    quiet: Any  # (detectors,) [s] since the last alarm before
    pointing: Any  # (ticks,) [rad]
    mode: Any  # 0 or 1


class Found(NamedTuple):
    """What a day leaves; n days in front, then the detectors."""

    peak: Any  # largest score in the window
    first: Any  # [s] from the onset to the first alarm after it
    punctual: Any  # bool: no alarm up to the onset
    at_alarm: Any  # (channels,) blame at that alarm; NaN without
    later: Any  # (channels,) ten seconds on
    excess: Any  # [rad s] pointing error beyond the healthy until the alarm or 60 s
    episodes: Any  # of alarms in the window
    last: Any  # score of the last packet
    sixths: Any  # (6,) packets with an alarm in each sixth of the window
    unclear: Any  # share of packets whose score is NaN
    pointing: Any  # [rad] at the end


def onset(onsets: Callable, scenario):
    """The first onset [s] of a day, from the start of the run; inf without a fault. onsets: of the world."""
    return reduce(jnp.minimum, [jnp.min(a) for a in onsets(scenario)])


@lru_cache
def watched(system: System, onsets: Callable, warmup: float, steps: tuple) -> System:
    """A world's system with detectors in its tick; steps: their (init, step). Equal arguments give the same system."""

    def init(params: Params, scenario):
        x, z = system.init(params.world, scenario)
        like = jax.tree.leaves(z)[0]
        states = tuple(start(p) for (start, _), p in zip(steps, params.detectors))
        n = len(steps)
        return x, (z, states, Watch(jnp.full(n, jnp.inf, like.dtype), jnp.full(n, -jnp.inf, like.dtype)))

    def tick(params: Params, scenario, now, x, z, noise):
        world, states, watch = z
        x, world, log = system.tick(params.world, scenario, now, x, world, noise)
        told = _told(steps, params.detectors, states, log.telemetry)
        score = jnp.stack([verdict.score for _, verdict in told])
        t, mode = now.t + (system.dt - warmup), log.telemetry.mode
        limit = jnp.where(mode > 0, params.threshold[:, 1], params.threshold[:, 0])
        up = ~(score <= limit) & (t > 0)
        found = up & jnp.isinf(watch.alarm) & (t > onset(onsets, scenario) - warmup)
        alarm = jnp.where(found, t, watch.alarm)
        out = Told(t, score, up, jnp.stack([v.blame for _, v in told]), alarm, t - watch.last, log.pointing, mode)
        return x, (world, tuple(s for s, _ in told), Watch(alarm, jnp.where(up, t, watch.last))), out

    def flow(params: Params, scenario, t, x, z):
        return system.flow(params.world, scenario, t, x, z[0])

    return system._replace(init=init, tick=tick, flow=flow, check=no_check)


def _told(steps: tuple, params: tuple, states: tuple, telemetry) -> list:
    """State and verdict of every detector; those on residuals share them, for all have seen the same packets."""
    shared: dict = {}
    told = []
    for (_, step), p, z in zip(steps, params, states):
        if isinstance(step, OnResiduals):
            if step.residuals not in shared:
                shared[step.residuals] = step.residuals(z[0], telemetry)
            state, r = shared[step.residuals]
            after, verdict = step.step(p, z[1], r, telemetry)
            told.append(((state, after), verdict))
        else:
            told.append(step(p, z, telemetry))
    return told


@lru_cache
def tallies(packet: float, onsets: Callable, warmup: float, window: float) -> Callable:
    """The tallies of one packet [s], a score function. Equal arguments give the same function."""
    return partial(_tallies, packet, onsets, warmup, window)


def _tallies(packet, onsets, warmup, window, params: Params, scenario, now, told: Told) -> Found:
    since = onset(onsets, scenario) - warmup
    inside, after = told.t > 0, told.t > since
    mode = jnp.where(told.mode > 0, 1, 0)
    n = len(told.pointing)
    dt = packet / n
    ticks = told.t - packet + dt * jnp.arange(n, dtype=told.t.dtype)
    counted = (ticks >= since) & (ticks < since + HORIZON)
    beyond = jnp.where(counted, jnp.maximum(told.pointing - params.excess[mode], 0), 0)
    excess = dt * sum(beyond[i] for i in range(n))
    sixth = jnp.floor(told.t * (SIXTHS / window) - 1e-6)
    here = (jnp.arange(SIXTHS) == sixth) & inside
    return Found(
        peak=scores.peak(told.score, inside),
        first=scores.first(now, told.up & after, since + (warmup - packet)),
        punctual=scores.always(~(told.up & ~after)),
        at_alarm=scores.held(told.blame, (told.up & after)[:, None]),
        later=scores.held(told.blame, (told.t >= told.alarm + LATER)[:, None]),
        excess=scores.total(excess + 0 * told.score, ~(told.alarm < told.t) & after),
        episodes=scores.total(1.0 * (told.up & (told.quiet > QUIET)).astype(told.score.dtype)),
        last=scores.final(told.score),
        sixths=scores.total((told.up[:, None] & here).astype(told.score.dtype)),
        unclear=scores.mean(jnp.isnan(told.score).astype(told.score.dtype), inside),
        pointing=scores.final(told.pointing[-1]),
    )


def run(
    world: World, detectors: Sequence[Detector], key, days, *, threshold=None, excess=None, progress=False
) -> Found:
    """What n days leave of every detector.

    Args:
        world: of the days.
        detectors: that watch, side by side.
        key: of the noise: day i meets ``noise_of(world.system, key, i, world.packets)``.
        days: scenarios, leaves with n in front (`worlds.days`).
        threshold: (detectors, modes); None for no alarms.
        excess: (modes,) [rad] pointing error that is healthy; None for infinite.
        progress: show a bar.

    Returns:
        NumPy arrays, (n, ...).

    Example:
        >>> found = run(WORLDS["leo4"], [chi2(10)], key, days(WORLDS["leo4"], key, np.arange(128), None))
    """
    detectors = tuple(detectors)
    n, modes = len(detectors), len(world.modes)
    system = watched(world.system, world.onsets, world.warmup, tuple((d.init, d.step) for d in detectors))
    score = tallies(system.dt, world.onsets, world.warmup, world.window)
    wide = lambda a, shape: np.full(shape, np.inf, np.float32) if a is None else np.asarray(a, np.float32)
    params = Params(
        world.params, tuple(d.params for d in detectors), wide(threshold, (n, modes)), wide(excess, (modes,))
    )
    params = jax.tree.map(worlds.short, params)
    with np.errstate(all="ignore"):
        found = sweep(system, params, days, key, ticks=world.packets, score=score, progress=progress)
    return found


class Softly(NamedTuple):
    """What numbers of the detectors are differentiated through; one value a detector in front."""

    peak: Any  # largest score in the window
    delay: Any  # [s] expected min(delay, 60 s) of an alarm whose probability a packet is soft


def _softly(packet, onsets, warmup, width, params: Params, scenario, now, told: Told) -> Softly:
    since = onset(onsets, scenario) - warmup
    counted = (told.t > since) & (told.t <= since + HORIZON)
    limit = jnp.where(told.mode > 0, params.threshold[:, 1], params.threshold[:, 0])
    silent = jnp.where(counted, 1 - soft_scores.soft_alarm(told.score, limit, width), 1)
    waited = jnp.where(counted, packet * silent, 0)
    delay = soft_scores.Delay(waited, silent, jnp.zeros_like(waited))
    return Softly(scores.peak(told.score, told.t > 0), delay)


def slopes(
    world: World, detectors: Sequence[Detector], key, days, numbers, params_of: Callable, *, threshold=None, width: float = 1.0
) -> tuple[Softly, Softly]:  # fmt: skip
    """What n days leave of detectors of numbers x, and its gradient, by forward mode.

    Args:
        world, detectors, key, days: as of `run`.
        numbers: x, (k,).
        params_of: x -> the params of all detectors, a tuple.
        threshold: (detectors, modes); it gets a gradient too. None for infinite ones, which no score passes.
        width: [unit of the score] over which the probability of an alarm rises at the threshold.

    Returns:
        `Softly` of shape (n, detectors), and its gradient (n, detectors, k + 2): by the numbers, and by the threshold
        of the first and of the second mode.
    """
    detectors, x = tuple(detectors), np.asarray(numbers, np.float32)
    shape = len(detectors), len(world.modes)
    h = np.full(shape, np.inf, np.float32) if threshold is None else np.asarray(threshold, np.float32)
    system = watched(world.system, world.onsets, world.warmup, tuple((d.init, d.step) for d in detectors))
    axes = np.eye(len(x) + shape[1], dtype=np.float32)
    directions = axes[:, : len(x)], axes[:, len(x) :]
    world_params, width = jax.tree.map(worlds.short, (world.params, width))
    sloped = _sloped(system, params_of, world.packets, world.onsets, world.warmup)
    return jax.tree.map(np.asarray, sloped(directions, x, h, days, key, world_params, width))


@lru_cache(maxsize=8)
def _sloped(system: System, params_of: Callable, packets: int, onsets: Callable, warmup: float):
    """Of a system with detectors: value and gradient of `Softly`, compiled once."""

    def found(x, move, h, days, key, world_params, width):
        params = Params(world_params, params_of(x), h + move, jnp.full(h.shape[1], jnp.inf, h.dtype))
        score = partial(_softly, system.dt, onsets, warmup, width)
        return sweep(system, params, days, key, ticks=packets, score=score, progress=False)

    def along(direction, x, h, *rest):
        return jax.jvp(lambda x, move: found(x, move, h, *rest), (x, jnp.zeros_like(h[0])), direction)

    return jitted(jax.vmap(along, in_axes=(0, *[None] * 6), out_axes=(None, -1)))

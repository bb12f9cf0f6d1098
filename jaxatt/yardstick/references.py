"""Rows that are on every board and say what it is worth: one that never alarms, one that guesses, one that counts time.

And what the chi-square rows of all worlds share. Telemetry of every world has readings ``gyro`` (ticks, gyros) and an ``innovation``.

May import: telemetry, batching, detection.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxatt.batching import in_lanes
from jaxatt.detection import window_sum
from jaxatt.yardstick.telemetry import Detector, Verdict


def summed(line, new):
    """The window (N, ...) of the latest with one more, and its sum: `detection.window_sum` with a batch left where it is."""
    return in_lanes(window_sum, line, new)


@cache
def window_of(packets: int):
    """The init of a window of so many packets, or of as many means."""
    return lambda params: jnp.zeros(packets)


def nothing(params):
    """No state."""
    return ()


@cache
def null_of(channels: int) -> Callable:
    """The step that never alarms."""

    def null_step(params, z, telemetry):
        score = 0 * telemetry.innovation[(0,) * telemetry.innovation.ndim]
        return z, Verdict(score, jnp.ones(channels, score.dtype))

    return null_step


@cache
def random_of(channels: int) -> Callable:
    """The step whose score is a hash of the gyros' bits, uniform in [0, 1)."""

    def random_step(params, z, telemetry):
        words = jax.lax.bitcast_convert_type(telemetry.gyro.astype(jnp.float32).reshape(-1), jnp.uint32)
        h = jnp.uint32(2166136261)
        for i in range(len(words)):
            h = (h ^ words[i]) * jnp.uint32(16777619)
            h = h ^ (h >> 15)
        h = (h ^ (h >> 13)) * jnp.uint32(0xC2B2AE35)
        score = ((h ^ (h >> 16)) >> 8).astype(telemetry.gyro.dtype) * 2.0**-24
        return z, Verdict(score, jnp.ones(channels, score.dtype))

    return random_step


class Clock(NamedTuple):
    """The window of chi2_10 and how many packets have come."""

    recent: Any
    seen: Any


def clock_init(params) -> Clock:
    return Clock(jnp.zeros(10), jnp.zeros(()))


@cache
def clock_of(chi2_step: Callable, opens: int, shuts: int) -> Callable:
    """The step of chi2_10 that counts packets and alarms from one to another alone: what the onset law must not reward."""

    def clock_step(params, z: Clock, telemetry):
        recent, verdict = chi2_step(params, z.recent, telemetry)
        first = (z.seen >= opens) & (z.seen < shuts)
        return Clock(recent, z.seen + 1), Verdict(jnp.where(first, verdict.score, 0), verdict.blame)

    return clock_step


def references(channels: int, chi2: Detector, warmup: int, window: int) -> tuple[Detector, ...]:
    """null, random, and the clock, which alarms in the first third of the window; warmup, window: in packets."""
    return (
        Detector("null", nothing, null_of(channels)),
        Detector("random", nothing, random_of(channels)),
        Detector("clock", clock_init, clock_of(chi2.step, warmup, warmup + window // 3), chi2.params, chi2.tuned),
    )

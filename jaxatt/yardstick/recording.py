"""Residuals of days of leo4, recorded: what the baselines are fitted to and the learned detector learns from.

May import: leo4, leo4_days, telemetry, worlds, baselines, contract, noise, sweeping.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt.contract import no_check
from jaxatt.noise import one_key
from jaxatt.sweeping import recorded
from jaxatt.yardstick import baselines, leo4, leo4_days, worlds
from jaxatt.yardstick.telemetry import residuals_init, residuals_step

WINDOWS = 256


class Healthy(NamedTuple):
    """Fault-free telemetry: packets of the window, n days in front."""

    residuals: Any  # (n, 1200, 7)
    features: Any  # (n, 1200, 13)
    means: Any  # (n, 1200, 13) those of ten packets


def _init(params, scenario):
    x, z = leo4.system.init(params, scenario)
    return x, (z, residuals_init(), jnp.zeros((10, 13)))


def _tick(params, scenario, now, x, z, noise):
    x, world, log = leo4.system.tick(params, scenario, now, x, z[0], noise)
    state, r = residuals_step(z[1], log.telemetry)
    recent = jnp.concatenate([z[2][1:], baselines.features(r, log.telemetry)[None]])
    return x, (world, state, recent), (r, recent[9], sum(recent[i] for i in range(10)) / 10)


_SYSTEM = leo4.system._replace(init=_init, tick=_tick, check=no_check)


def _all(log):
    return log


def _residuals(log):
    return log[0]


def healthy(key=None, windows: int = WINDOWS) -> Healthy:
    """Residuals and features of fault-free days of leo4, NumPy; key None for the public one."""
    key = one_key(jax.random.key(0) if key is None else key)
    days = worlds.days(worlds.WORLDS["leo4"], jax.random.wrap_key_data(key), np.arange(windows), None)
    skipped = round(leo4_days.WARMUP / leo4.PACKET)
    return Healthy(*(np.moveaxis(np.asarray(a[skipped:], np.float32), -1, 0) for a in _recorded(_all, days, key)))


@lru_cache
def public() -> Healthy:
    """`healthy` of the public key, run once."""
    return healthy()


def covariance_of(found: Healthy) -> np.ndarray:
    """Covariance (7, 7) of healthy residuals, whose mean is 0."""
    r = found.residuals.reshape(-1, 7).astype(float)
    return r.T @ r / len(r)


def whitening(found: Healthy) -> np.ndarray:
    """L^-1, (7, 7): z = L^-1 r has unit covariance, L L' = that of r."""
    return np.linalg.inv(np.linalg.cholesky(covariance_of(found)))


def residuals_of(days, key) -> np.ndarray:
    """Residuals (n, 1800, 7) of whole days of leo4 (`worlds.days`), warm-up included; the noise is the key's."""
    return np.moveaxis(_recorded(_residuals, days, one_key(key)), -1, 0)


def _recorded(record, days, key):
    params = jax.tree.map(worlds.short, worlds.WORLDS["leo4"].params)
    return recorded(_SYSTEM, record, leo4_days.PACKETS, 1, params, days, key)

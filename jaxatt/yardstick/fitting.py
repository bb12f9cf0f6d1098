"""The baselines fitted to fault-free telemetry of the tuning key, which is public: ``jax.random.key(0)``.

May import: leo4, telemetry, worlds, baselines, bank, check, compiling,
contract, noise, engine, sweeping.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.contract import no_check
from jaxatt.noise import one_key
from jaxatt.sweeping import recorded
from jaxatt.yardstick import bank, baselines, leo4, worlds
from jaxatt.yardstick.telemetry import Detector, OnResiduals, residuals_init, residuals_step, with_residuals

WINDOWS = 256
SHARE = 0.95  # of the features' variance that the plane of pca holds
NAMES = (
    "mrp", "chi2_1", "chi2_10", "chi2_60", "parity", "parity 30 s", "cusum", "glr", "mmae", "pca",
    "null", "random", "clock", "flatline",
)  # fmt: skip


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


def _both(log):
    return log


def healthy(key=None, windows: int = WINDOWS) -> Healthy:
    """Residuals and features of fault-free days of leo4, NumPy; key None for the public one."""
    key = one_key(jax.random.key(0) if key is None else key)
    world = worlds.WORLDS["leo4"]
    days = worlds.days(world, jax.random.wrap_key_data(key), np.arange(windows), None)
    params = jax.tree.map(lambda a: np.asarray(a, np.float32), world.params)
    records = recorded(_SYSTEM, _both, worlds.PACKETS, 1, params, days, key)
    skipped = round(worlds.WARMUP / leo4.PACKET)
    return Healthy(*(np.moveaxis(np.asarray(a[skipped:], np.float32), -1, 0) for a in records))


@lru_cache
def _public() -> Healthy:
    return healthy()


def pca_params(features, means) -> baselines.PcaParams:
    """Plane and limits; features of packets and the means of ten, (n, packets, 13) both.

    Standardised by the spread of the means; plane and variances are those of the packets, limits those of the means.
    """
    single, flat = (np.asarray(a, float).reshape(-1, a.shape[-1]) for a in (features, means))
    mean, std = single.mean(0), flat.std(0)
    packets, z = (single - mean) / std, (flat - mean) / std
    values, vectors = np.linalg.eigh(packets.T @ packets / len(packets))
    values, vectors = values[::-1], vectors[:, ::-1]
    k = int(np.searchsorted(np.cumsum(values) / values.sum(), SHARE)) + 1
    main = vectors[:, :k].T / np.sqrt(values[:k, None])
    rest = np.eye(len(values)) - vectors[:, :k] @ vectors[:, :k].T
    limits = [np.quantile(np.sum((z @ m.T) ** 2, axis=1), 0.9999) for m in (main, rest)]
    return baselines.PcaParams(*(np.asarray(a, np.float32) for a in (mean, std, main, rest, limits)))


def tune(name: str, key=None) -> Detector:
    """A baseline fitted anew.

    Args:
        name: one of `NAMES`.
        key: of the fault-free days that it is fitted to; None for the public ones of ``jax.random.key(0)``.

    Raises:
        ValueError: a name that is none of them.

    Example:
        >>> glr = tune("glr")
    """
    fixed = {d.name: d for d in (baselines.MRP, *map(baselines.chi2, (1, 10, 60)), *baselines.REFERENCE)}
    if name in fixed:
        return fixed[name]
    if name not in NAMES:
        check.refuse("name", f"be one of {', '.join(NAMES)}", check.short(name))
    found = _public() if key is None else healthy(key)
    r = found.residuals.reshape(-1, 7).astype(float)
    covariance = r.T @ r / len(r)
    std = np.sqrt(np.diag(covariance))
    if name.startswith("parity"):
        return baselines.parity(10 if name == "parity" else 60, std[3])
    if name == "cusum":
        params = baselines.CusumParams(std.astype(np.float32), np.float32(0.25))
        return Detector("cusum", with_residuals(baselines.cusum_init), OnResiduals(baselines.cusum_step), params, 1)
    if name == "glr":
        params = baselines.glr_params(covariance, bank.laws())
        return Detector("glr", with_residuals(baselines.glr_init), OnResiduals(baselines.glr_step), params, 8)
    if name == "mmae":
        return bank.mmae(covariance)
    return Detector(
        "pca",
        with_residuals(baselines.pca_init),
        OnResiduals(baselines.pca_step),
        pca_params(found.features, found.means),
        3,
    )

"""Gains and threshold of Yun & Kang (2020) by gradient: alpha, beta, sigma, k_q and k_w0 together."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

from jaxatt import Fault, Vec3, objectives, on_axes, scores, sweep
from jaxatt.objectives import penalty, weighted
from jaxatt.study import batch, varied
from jaxatt.systems import observer_pd as op
from jaxatt.tuning import averaged, best_of, bounded, gradient_check, multi_start, tune, worst_case
from jaxatt.vec import norm

TICKS = 400  # 40 s: a slew, a gyro fault that grows from 15-20 s on, a star-sensor fault from 30-35 s on
QUIET_FROM = 5.0  # [s] from here to the onset an alarm is a false one; the observer converges meanwhile
TEMPERATURE = 0.1  # [1] of the smooth alarm, in thresholds
NAMES = ("alpha", "beta", "sigma", "k_q", "k_w0")
PAPER = dict(alpha=1.1, beta=15.0, sigma=0.01, k_q=330.0, k_w0=125.0)
BOUNDS = bounded(
    dict(alpha=0.05, beta=1.0, sigma=1e-3, k_q=20.0, k_w0=5.0),
    dict(alpha=20.0, beta=500.0, sigma=0.1, k_q=2000.0, k_w0=1000.0),
)


def drawn(key, n: int) -> op.Scenario:
    """n days: attitude, rate, the observer's start error, both faults' onsets, sizes and directions at random."""
    k = iter(jax.random.split(key, 11))
    normal = lambda size: Vec3(*(size * jax.random.normal(next(k), (3, n))))
    uniform = lambda low, high: jax.random.uniform(next(k), (n,), minval=low, maxval=high)
    axis = normal(1.0)
    q = axis * (jnp.tan(uniform(60.0, 150.0) * jnp.pi / 180 / 4) / norm(axis))
    w = normal(0.5)
    way = normal(1.0)
    bias = way * (uniform(0.01, 0.06) / norm(way))
    onset, tau = uniform(15.0, 20.0), uniform(0.5, 5.0)
    star_onset, star_size = uniform(30.0, 35.0), uniform(0.003, 0.02)
    healthy = jax.tree.map(lambda a: jnp.full(n, a), op.scenario)
    one = jax.tree.map(lambda a: jnp.full(n, a), Fault())
    return healthy._replace(
        q=q, w=w, q_hat=q + normal(0.05), w_hat=w + normal(0.05),
        gyro=Vec3(*(one._replace(onset=onset, drift=b, tau=tau) for b in bias)),
        star=on_axes(one._replace(onset=star_onset, random=star_size)),
    )  # fmt: skip


def score(params: op.Params, scenario: op.Scenario, now, log: op.Log) -> dict:
    """What is judged, by the loop's own names, and the smooth stand-ins that are tuned."""
    real = op.score(params, scenario, now, log)
    onset = scenario.gyro.x.onset
    before = now.t < onset
    quiet = before & (now.t >= QUIET_FROM)
    q = norm(log.e_q)
    soft = objectives.detection(
        now, objectives.alarm(log.xi, params.sigma, TEMPERATURE * params.sigma), onset, QUIET_FROM
    )
    return dict(
        post_q=real.rms_q_ill,  # [1] true attitude error after the first onset, rms of a run
        post_u=real.rms_u_ill,  # [N m]
        rms_u=real.rms_u,  # [N m] whole run
        peak_u=real.peak_u,  # [N m]
        transient=scores.mean(q, before),  # [1] attitude error of the slew
        settling=real.settling,  # [s]
        delay=real.delay,  # [s]
        miss=real.miss,  # [1]
        false_alarms=scores.mean(log.alarm, quiet),  # [1]
        soft_settling=scores.total(now.dt * objectives.alarm(q, 0.01, 0.002), before),  # [s] time outside the band
        soft_delay=soft.delay, soft_miss=soft.miss, soft_false=soft.false_alarms,
        ok=real.ok,
    )  # fmt: skip


def scored(gains: dict, scenarios: op.Scenario, key) -> dict:
    """The scores of each scenario under the given gains."""
    return sweep(op.system, op.params._replace(**gains), scenarios, key, ticks=TICKS, score=score)

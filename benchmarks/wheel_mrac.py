"""Speed of the wheel test bed: 90 s slews with MRAC and estimation, noise and all tallies."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import jaxatt
from benchmarks.measure import cpu_ns, seconds
from jaxatt import scores
from jaxatt.controllers import Adaptation
from jaxatt.loops import wheel_mrac as wm

SUBSTEPS = 8


def equal(n: int):
    """n times the paper's scenario."""
    return jax.tree.map(lambda a: np.full(n, a), wm.scenario)


def rows(quick: bool):
    """CPU time per tick, that is 8 RK4 steps of the plant and the controller, and per RK4 step; scenario rate."""
    n, ticks = 1024, 500 if quick else 4501
    steps, key = n * ticks, jax.random.key(0)
    for real in (np.float32, np.float64):
        params, scenarios = jax.tree.map(lambda a, real=real: np.asarray(a, real), (wm.params, equal(n)))
        for name, system in (
            ("continuous", wm.system_of(substeps=SUBSTEPS)),
            ("sampled", wm.system_of(sampled=True, substeps=SUBSTEPS)),
        ):
            shipped = params._replace(law=params.law._replace(gamma=real(1e-8))) if name == "sampled" else params

            def run(system=system, shipped=shipped, scenarios=scenarios):
                return jaxatt.sweep(system, shipped, scenarios, key, ticks=ticks, score=wm.score, progress=False)

            ns = cpu_ns(run, steps, repeats=3 if quick else 5)
            label = f"{name} adaptation, {np.dtype(real).name}, N = {n}"
            yield {"name": f"{label}: tick of {SUBSTEPS} RK4 steps", "value": ns, "unit": "CPU ns"}
            yield {"name": f"{label}: RK4 step", "value": ns / SUBSTEPS, "unit": "CPU ns"}
            yield {"name": f"{label}: 90 s slews", "value": n * ticks / 4501 / seconds(run), "unit": "scenarios/s wall"}
    n, ticks = 128, 500
    worlds, system = equal(n), wm.system_of(substeps=SUBSTEPS)

    @jax.jit
    def gradient(theta):
        def cost(theta):
            params = wm.params._replace(
                K=jnp.exp(theta[0]), law=Adaptation(gamma=jnp.exp(theta[1])), P0=jnp.exp(theta[2])
            )
            score = lambda params, scenario, now, log: scores.mean(log.error**2)
            return jnp.mean(jaxatt.sweep(system, params, worlds, key, ticks=ticks, score=score))

        return jax.value_and_grad(cost)(theta)

    theta = jnp.log(jnp.array([1.0, 1e-6, 1e-6]))
    ns = cpu_ns(lambda: gradient(theta), n * ticks, repeats=3)
    yield {"name": f"gradient in K, gamma, P0, float64, N = {n}: tick", "value": ns, "unit": "CPU ns"}

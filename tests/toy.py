"""A loop small enough to be written out in NumPy: a noisy oscillator under sampled feedback."""

from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxatt import scores
from jaxatt.engine import Now, System, every


class Params(NamedTuple):
    gain: Any = 0.3


class Scenario(NamedTuple):
    start: Any = 1.0
    stiffness: Any = 4.0


class X(NamedTuple):
    position: Any
    speed: Any


class Log(NamedTuple):
    position: Any
    u: Any


def init(params, scenario):
    return X(scenario.start, 0.0), 0.0


def tick(params, scenario, now, x, z, noise):
    u = every(3, now, lambda: -params.gain * (x.speed + 0.1 * noise[0]) + 0.01 * noise[1], z)
    return x, u, Log(x.position, u)


def flow(params, scenario, t, x, z):
    return X(x.speed, -scenario.stiffness * x.position + z + 0.05 * jnp.sin(t))


# compiles in two thirds of the time, for tests of what no optimisation changes
QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}

SYSTEM = System(init, tick, flow, dt=0.2, substeps=3, normals=2)


def tallied(score, params, scenario, log, dt):
    """The scores of a log that is made up, time first: what tick after tick adds."""
    ticks = len(jax.tree.leaves(log)[0])
    one = lambda k: score(params, scenario, Now(k, k * dt, dt), jax.tree.map(lambda a: jnp.asarray(a)[k], log))
    return scores.values(reduce(scores.add, map(one, jnp.arange(ticks))))

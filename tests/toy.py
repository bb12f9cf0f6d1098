"""A loop small enough to be written out in NumPy: a noisy oscillator under sampled feedback."""

from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp

from jaxatt.check import finite, not_negative
from jaxatt.contract import System
from jaxatt.engine import every


class Params(NamedTuple):
    gain: Annotated[Any, "1/s", finite] = 0.3


class Scenario(NamedTuple):
    start: Annotated[Any, "m", finite] = 1.0
    stiffness: Annotated[Any, "1/s^2", not_negative] = 4.0


class X(NamedTuple):
    position: Any
    speed: Any


class Log(NamedTuple):
    position: Any
    u: Any


def init(params, scenario):
    return X(scenario.start, 0.0), 0.0


def tick(params, scenario, now, x, z, noise):
    u = every(3, now, lambda: -(params.gain * (x.speed + 0.1 * noise[0])) + 0.01 * noise[1], z)
    return x, u, Log(x.position, u)


def flow(params, scenario, t, x, z):
    return X(x.speed, z - scenario.stiffness * x.position + 0.05 * jnp.sin(t))


SYSTEM = System(init, tick, flow, dt=0.2, substeps=3, normals=2)

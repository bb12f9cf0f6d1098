"""A loop small enough to be written out in NumPy: a noisy oscillator under sampled feedback."""

from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxatt.engine import System, every


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


SYSTEM = System(init, tick, flow, dt=0.2, substeps=3, normals=2)

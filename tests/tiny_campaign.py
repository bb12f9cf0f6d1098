"""A campaign on a loop of one mass, small enough to be run in many processes: ``python tiny_campaign.py PATH ...``."""

import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import System, check, scores


class Params(NamedTuple):
    gain: Any = 2.0  # () [1/s^2]
    table: Any = np.linspace(0, 1, 3)  # (3,) [1]


class Scenario(NamedTuple):
    start: Any = 1.0  # () [m]
    push: Any = 0.0  # () [m/s^2]


class State(NamedTuple):
    x: Any
    v: Any


class Scores(NamedTuple):
    rms: Any  # [m]
    far: Any  # [s] first time outside 1 m; inf if never
    last: Any  # (2,) [m, m/s]
    ok: Any


def init(params, scenario):
    return State(scenario.start, jnp.zeros(())), jnp.zeros(())


def tick(params, scenario, now, x, z, noise):
    z = -params.gain * (x.x + 0.1 * noise[0]) - x.v
    return x, z, State(x.x, x.v)


def flow(params, scenario, t, x, z):
    return State(x.v, z + scenario.push + 0.1 * jnp.sin(x.x))


def refuse_bad(params, scenario):
    check.positive("params.gain", params.gain)
    check.between("scenario.start", scenario.start, -1e3, 1e300, "the arena")


def score(params, scenario, now, log):
    return Scores(
        rms=scores.rms(log.x * log.x),
        far=scores.first(now, jnp.abs(log.x) > 1),
        last=scores.final(jnp.stack([log.x, log.v])),
        ok=scores.always(jnp.isfinite(log.x)),
    )


def draw(key, index):
    u = jax.random.uniform(jax.random.fold_in(key, index), (2,))
    return dict(start=2 * u[0] - 1, push=jnp.sin(u[1]))


def sample(key, index):
    drawn = draw(key, index)
    start = jnp.where(index == 5, 1e200, jnp.where(index == 300, -1e6, drawn["start"]))  # 5 diverges, 300 is refused
    return Scenario(start, jnp.where(index == 5, 1e308, drawn["push"]))


def record(log):
    return dict(position=log.x)


system = System(init, tick, flow, dt=0.1, substeps=2, normals=1, check=refuse_bad)


def campaign(block=128, **change):
    from jaxatt.campaign import Campaign

    one = Campaign(system, Params(), sample, jax.random.key(3), 30, score, inputs=draw, block=block)
    return one._replace(**{"units": {"rms": "m", "far": "s", "start": "m"}, **change})


def main(path, n, block, shard, *words):
    """Run a campaign, and say so when the first block is there."""
    import jaxatt.campaign as module

    jax.config.update("jax_enable_x64", True)
    write = module._write

    def told(*args):
        write(*args)
        print("written", flush=True)

    module._write = told
    shard = tuple(map(int, shard.split("/")))
    more = dict(record=record, every=10) if "record" in words else {}
    module.run(Path(path), campaign(int(block), **more), int(n), shard=shard, progress=False)


if __name__ == "__main__":
    main(*sys.argv[1:])

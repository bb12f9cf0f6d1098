"""A campaign on a loop of one mass, small enough to be run, and killed, in many processes."""

from __future__ import annotations

import time
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import System, check, scores
from jaxatt.campaign import Campaign, run
from jaxatt.check import positive


class Params(NamedTuple):
    gain: Annotated[Any, "1/s^2", positive] = 2.0
    table: Annotated[Any, "1", (3,)] = np.linspace(0, 1, 3)


class Scenario(NamedTuple):
    start: Annotated[Any, "m"] = 1.0
    push: Annotated[Any, "m/s^2"] = 0.0


class State(NamedTuple):
    x: Annotated[Any, "m"]
    v: Annotated[Any, "m/s"]


class Scores(NamedTuple):
    rms: Annotated[Any, "m"]
    far: Annotated[Any, "s"]  # first time outside 1 m; inf if never
    last: Annotated[Any, "m, m/s", (2,)]
    ok: Any


def init(params, scenario):
    return State(scenario.start, jnp.zeros(())), jnp.zeros(())


def tick(params, scenario, now, x, z, noise):
    z = -params.gain * (x.x + 0.1 * noise[0]) - x.v
    return x, z, State(x.x, x.v)


def flow(params, scenario, t, x, z):
    return State(x.v, z + scenario.push + 0.1 * jnp.sin(x.x))


def refuse_bad(params, scenario):
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
    return Scenario(start, jnp.where(index == 5, 1.7e308, drawn["push"]))


def record(log):
    return dict(position=log.x)


system = System(init, tick, flow, dt=0.1, substeps=2, normals=1, check=refuse_bad)


def campaign(block: int = 128, **change):
    one = Campaign(system, Params(), sample, jax.random.key(3), 30, score, inputs=draw, block=block)
    return one._replace(**{"units": {"start": "m"}, **change})


def work(path, blocks, block=128, shard=(0, 1), **change):
    """Run the campaign in a process of its own."""
    jax.config.update("jax_enable_x64", True)
    run(Path(path), campaign(block, **change), blocks * block, shard=shard, progress=False)


class Death(NamedTuple):
    """What a killed run left."""

    blocks: int  # that count as done
    inside: bool  # a block was being written


def processes():
    """Processes that start with everything imported, and nothing computed."""
    context = get_context("forkserver")
    context.set_forkserver_preload([__name__])
    return context


def killed(context, path: Path, blocks: int, after: int, moment: float, **change) -> Death:
    """Start a campaign and kill -9 it ``moment`` seconds after so many of its blocks are done."""
    process = context.Process(target=work, args=(path, blocks), kwargs=change)
    process.start()
    while after and process.is_alive() and not (path / "done" / "c" / str(after - 1)).exists():
        time.sleep(0.001)
    time.sleep(moment)
    process.kill()
    process.join()
    marked = {int(f.name) for f in path.glob("done/c/*") if f.name.isdigit()}
    chunks = {
        int(f.name.split(".")[0]) for f in path.glob("*/c/**/*") if f.is_file() and f.name.split(".")[0].isdigit()
    }
    return Death(len(marked), bool(chunks - marked))


def files(path: Path) -> dict[str, bytes]:
    """Every file of a store, by its place in it."""
    return {str(f.relative_to(path)): f.read_bytes() for f in sorted(path.rglob("*")) if f.is_file()}

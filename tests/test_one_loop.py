"""A function over lanes as one loop: the same numbers as by `jax.vmap`, and None where it cannot be."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxatt import one_loop

ROOT = Path(__file__).parents[1]
LANES = 5
TIMES = np.array([0.0, 0.25, 0.5])


def reference(f, shared, held, x, times):
    """x after every step, each by `jax.vmap` over the lanes."""
    for t in times:
        x = jax.vmap(lambda held, x: f(shared, held, x, t), in_axes=-1, out_axes=-1)(held, x)  # noqa: B023
    return x


def scalars(shared, held, x, t):
    a, b = x
    c = jnp.where(held["on"], jnp.sin(a) * shared["gain"], b / (1 + held["size"] ** 2))
    return a + 0.1 * c * jnp.exp(-t), jnp.clip(b - 0.1 * a * held["size"], -1.0, 1.0)


def small_arrays(shared, held, x, t):
    a, b = x
    turned = jnp.stack([b[1], -b[0], b[2]]) * shared["axis"] + held["pull"][::-1]
    total = jnp.sum(turned) + jnp.max(held["pull"]) + jnp.min(b)
    return a * 0.9 + 0.1 * total, b + 0.1 * jnp.concatenate([turned[1:], turned[:1]]) * t


def with_stages(shared, held, x, t):
    """A loop of fixed length and a value set apart, as RK4 has them."""
    from jaxatt.engine import rk4

    return rk4(lambda t, x: jax.jit(jnp.cos)(x + t) * held, t, x, shared)


def operands(dtype):
    rng = np.random.default_rng(3)
    some = lambda *shape: jnp.asarray(rng.normal(size=(*shape, LANES)), dtype)
    number = lambda a: jnp.asarray(a, dtype)
    return {
        scalars: ({"gain": number(0.7)}, {"on": jnp.arange(LANES) % 2 == 0, "size": some()}, (some(), some())),
        small_arrays: ({"axis": number([0.2, 0.5, -1.0])}, {"pull": some(3)}, (some(), some(3))),
        with_stages: (number(0.1), some(2), some(2)),
    }


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("f", [scalars, small_arrays, with_stages])
def test_one_loop_gives_the_numbers_of_vmap(f, dtype):
    shared, held, x = operands(dtype)[f]
    found = jax.jit(lambda *a: one_loop.advanced(f, LANES, *a))(shared, held, x, jnp.asarray(TIMES, dtype))
    expected = reference(f, shared, held, x, TIMES.astype(dtype))
    assert jax.tree.map(jnp.shape, found) == jax.tree.map(jnp.shape, expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected)):
        assert a.dtype == dtype
        np.testing.assert_allclose(a, b, rtol=0, atol=20 * np.finfo(dtype).eps * (1 + np.abs(b).max()))


def test_float32_without_64_bits_is_the_same():
    shared, held, x = operands(np.float32)[scalars]
    times = jnp.asarray(TIMES, np.float32)
    run = lambda: jax.jit(lambda *a: one_loop.advanced(scalars, LANES, *a))(shared, held, x, times)
    wide = run()
    with jax.enable_x64(False):
        narrow = run()
    for a, b in zip(wide, narrow):
        np.testing.assert_allclose(a, b, rtol=1e-6)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_python_numbers_are_of_the_type_of_the_state(dtype):
    _, held, x = operands(dtype)[scalars]
    times = jnp.asarray(TIMES, dtype)
    ways = [
        one_loop.advanced(scalars, LANES, {"gain": gain}, held, x, times) for gain in (0.7, jnp.asarray(0.7, dtype))
    ]
    assert all(a.dtype == dtype and (a == b).all() for a, b in zip(*ways))


def loops(shared, held, x, t):
    return jax.lax.while_loop(lambda a: a > 1, lambda a: a / 2, x + held)


def multiplies(shared, held, x, t):
    return jnp.linalg.solve(jnp.eye(2) + jnp.outer(x, x), held)


def branches_on_a_number(shared, held, x, t):
    return x if x > 0 else held


@pytest.mark.parametrize("f, shape", [(loops, ()), (multiplies, (2,)), (branches_on_a_number, ())])
def test_what_is_no_arithmetic_of_scalars_gives_none(f, shape):
    held = x = jnp.ones((*shape, LANES))
    assert one_loop.advanced(f, LANES, (), held, x, jnp.asarray(TIMES)) is None


def test_a_state_without_numbers_gives_none():
    same = lambda shared, held, x, t: x
    assert one_loop.advanced(same, LANES, (), (), (), jnp.asarray(TIMES)) is None
    assert one_loop.advanced(same, LANES, (), (), jnp.ones((0, LANES)), jnp.asarray(TIMES)) is None


def test_too_much_arithmetic_gives_none(monkeypatch):
    shared, held, x = operands(np.float64)[scalars]
    for name in ("MOST", "WIDEST"):
        with monkeypatch.context() as less:
            less.setattr(one_loop, name, 2)
            assert one_loop.advanced(scalars, LANES, shared, held, x, jnp.asarray(TIMES)) is None


SWEEPS = """
import json, sys
import jax, jaxatt, numpy as np
jax.config.update("jax_enable_x64", True)
jaxatt.configure(cache=sys.argv[1])
from jaxatt import one_loop, scores
from jaxatt.loops import observer_pd as loop
taken = []
advanced = one_loop.advanced
one_loop.advanced = lambda *a: taken.append(advanced(*a)) or taken[-1]
key = jax.random.key(1)
draw = lambda key: loop.scenario._replace(std_w=1e-3 * jax.random.uniform(key))
scenarios = jax.vmap(draw)(jax.random.split(key, 130))
last = lambda params, scenario, now, log: scores.final(log.q.x)
run = lambda **how: jaxatt.sweep(loop.system, loop.params, scenarios, key, ticks=200, score=last, progress=False)
quick = run()
again = jaxatt.rerun(loop.system, loop.params, scenarios, key, 129, ticks=200).q.x[-1]
traced = jax.jit(lambda s: jaxatt.sweep(loop.system, loop.params, s, key, ticks=200, score=last))(scenarios)
jaxatt.configure(cores=1)
print(json.dumps(dict(
    one=[a is not None for a in taken], same=bool(again == quick[129]), cores=quick.tobytes() == run().tobytes(),
    apart=float(abs(quick - np.asarray(traced)).max()), size=float(abs(quick).max()),
)))
"""


def test_a_sweep_in_one_loop_is_the_sweep_and_its_scenario_runs_again_bit_for_bit(tmp_path):
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_"))}
    run = subprocess.run(
        [sys.executable, "-c", SWEEPS, str(tmp_path)], env=environment | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout)
    assert found["one"] and all(found["one"]), "no step of the loop ran in one loop"
    assert found["same"] and found["cores"]
    assert found["apart"] < 1e-9 * found["size"]

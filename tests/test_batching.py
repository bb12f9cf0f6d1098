"""A kernel that has the scenarios in the last axis, called for one."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt.batching import hoisted, lanes_last

shapes = []


def kernel(f, a, pair):
    shapes.append((a.shape, [b.shape for b in pair]))
    return {"sum": f(a) + pair[0], "first": a[0]}


def one(a, c, flag):
    return lanes_last(kernel, lambda x: jnp.where(flag, c, 1) * jnp.sum(x), a, a, (c * 1.0, jnp.ones(2)))


def test_the_kernel_sees_the_batch_last_and_its_results_lead_again():
    a, c, flag = np.arange(12.0).reshape(4, 3), np.arange(4), np.array([True, False, True, True])
    want = np.where(flag, c, 1) * a.sum(axis=1) + c
    shapes.clear()
    got = jax.vmap(one)(a, c, flag)
    np.testing.assert_allclose(got["sum"], want)
    np.testing.assert_allclose(got["first"], a[:, 0])
    assert shapes[-1] == ((3, 4), [(4,), (2, 4)])  # what no scenario has for itself is there too
    got = jax.vmap(one, (1, 0, None), 0)(a.T, c, True)
    np.testing.assert_allclose(got["sum"], c * a.sum(axis=1) + c)


def test_without_a_batch_the_kernel_sees_one_scenario():
    shapes.clear()
    assert one(jnp.arange(3.0), 2, True)["sum"] == 8
    assert jax.jvp(lambda a: one(a, 2, True)["sum"], (jnp.ones(3),), (jnp.ones(3),))[1] == 6
    assert {shape for shape, _ in shapes} == {(3,)}


def test_a_closure_becomes_operands_of_every_type():
    @jax.jit
    def seen(c, k, flag):
        g, operands = hoisted(lambda x: {"y": jnp.where(flag, c * x, x[k])}, jnp.zeros(3))
        assert {a.dtype.kind for a in operands} == {"f", "i", "b"}
        return g(operands, jnp.arange(3.0))["y"]

    np.testing.assert_array_equal(seen(2.0, 1, True), [0, 2, 4])
    np.testing.assert_array_equal(seen(2.0, 1, False), [1, 1, 1])

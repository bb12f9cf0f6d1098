"""What tests share: scores of a log that no loop has written, equal scenarios, the count of compilations."""

from functools import cache, reduce

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import scores
from jaxatt.contract import Now

compilations = []  # one entry for every program that XLA has compiled, or found in its cache, so far
jax.monitoring.register_event_duration_secs_listener(
    lambda event, *_, **__: compilations.append(event) if "backend_compile" in event else None
)


def tallied(score, params, scenario, log, dt):
    """Their values, time first in the log: what tick after tick adds."""
    ticks = len(jax.tree.leaves(log)[0])
    one = lambda k: score(params, scenario, Now(k, k * dt, dt), jax.tree.map(lambda a: jnp.asarray(a)[k], log))
    return scores.values(reduce(scores.add, map(one, jnp.arange(ticks))))


def repeated(tree, n):
    """n equal scenarios, every leaf (n, ...)."""
    return jax.tree.map(lambda a: np.broadcast_to(np.asarray(a), (n, *np.shape(a))), tree)


@cache
def scores_and_last(score):
    """A loop's scores and its last log: one program for all tests that sweep the loop."""
    return lambda params, scenario, now, log: (score(params, scenario, now, log), jax.tree.map(scores.final, log))


def wide(scenario):
    """A satellite's wheel faults as four numbers, so that one program runs whatever fails."""
    return scenario._replace(wheel=jax.tree.map(lambda a: np.broadcast_to(np.asarray(a, float), (4,)), scenario.wheel))


def left(p):
    """The matrix (4, 4) of x -> p x for a quaternion p, scalar first."""
    w, x, y, z = p
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


def right(q):
    """The matrix (4, 4) of x -> x q for a quaternion q, scalar first."""
    w, x, y, z = q
    return np.array([[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]])

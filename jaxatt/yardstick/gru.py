"""The learned row: a gated recurrent unit that reads whitened residuals and gives the odds of each faulty channel.

Cho et al. (2014), with the reset gate behind the product (cuDNN's form, one product a packet for the state). Its numbers
are trained in `learning` and shipped in ``jaxatt/data/gru.npz``.

May import: leo4, telemetry, products.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt.yardstick.leo4 import Telemetry
from jaxatt.yardstick.products import product
from jaxatt.yardstick.telemetry import Detector, OnResiduals, Verdict, with_residuals

WEIGHTS = Path(__file__).parents[1] / "data" / "gru.npz"  # made by ``python -m experiments.yardstick_gru``
UNITS, HIDDEN, CLASSES = 32, 32, 12  # of the state; of the layer behind it; no fault, and eleven channels
LIMIT = 8.0  # [sd] at which an input is clipped


class Gru(NamedTuple):
    """Numbers of the unit; rows of a matrix are outputs."""

    whiten: Any  # (7, 7) L^-1 of the residuals' covariance in healthy runs; not trained
    inputs: Any  # (96, 14) of update, reset, candidate
    recur: Any  # (96, 32)
    offset: Any  # (96,)
    hidden: Any  # (32, 32)
    hidden_offset: Any  # (32,)
    out: Any  # (12, 32)
    out_offset: Any  # (12,)


def features(params: Gru, r, times: Callable = product):
    """What the unit reads (14,): z = L^-1 r of residuals r (7,), and (z^2 - 1) / sqrt 2, both clipped at 8.

    times: (M, x) -> M x.
    """
    z = jnp.clip(times(params.whiten, r), -LIMIT, LIMIT)
    return jnp.concatenate([z, jnp.minimum((z * z - 1) / np.sqrt(2).item(), LIMIT)])


def advanced(params: Gru, h, driven, times: Callable = product):
    """The state h (32,) a packet later; driven: ``inputs`` times the features, plus ``offset``, (96,).

    u, v = sigma(W x + U h + b), c = tanh(W x + b + v (U h)), h' = h + u (c - h).
    """
    own = times(params.recur, h)
    (u, v, c), (u_own, v_own, c_own) = jnp.split(driven, 3), jnp.split(own, 3)
    candidate = jnp.tanh(c + jax.nn.sigmoid(v + v_own) * c_own)
    return h + jax.nn.sigmoid(u + u_own) * (candidate - h)


def logits(params: Gru, h, times: Callable = product):
    """Logits (12,) of no fault and of each channel, of the state h (32,)."""
    layer = jax.nn.relu(times(params.hidden, h) + params.hidden_offset)
    return times(params.out, layer) + params.out_offset


def gru_init(params: Gru):
    """The state before the first packet."""
    return jnp.zeros(UNITS)


def gru_step(params: Gru, h, r, telemetry: Telemetry):
    """ln of the odds of a fault, whichever; blame: the probabilities of the channels."""
    driven = product(params.inputs, features(params, r)) + params.offset
    h = advanced(params, h, driven)
    found = logits(params, h)
    return h, Verdict(jax.nn.logsumexp(found[1:]) - found[0], jax.nn.softmax(found)[1:])


def gru(params: Gru) -> Detector:
    """The unit as a row of the board; every trained number counts as tuned."""
    tuned = sum(np.size(a) for a in params[1:])
    return Detector("gru", with_residuals(gru_init), OnResiduals(gru_step), params, tuned)


@cache
def shipped() -> Gru:
    """The numbers in the package."""
    with np.load(WEIGHTS, allow_pickle=False) as held:
        return Gru(*(held[name] for name in Gru._fields))

"""The linear packet model: signatures of faults for the GLR, and a bank of Kalman filters, one for each faulty channel.

Off line in NumPy and float64; on board a filter of the bank is two products with constant matrices.

May import: leo4, steady, telemetry, products.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxatt.yardstick import leo4
from jaxatt.yardstick.products import product
from jaxatt.yardstick.steady import steady
from jaxatt.yardstick.telemetry import (
    KD,
    MEMORY,
    Detector,
    OnResiduals,
    Verdict,
    with_residuals,
)

LENGTH = 128  # [packets] of a signature
WALK = (0.3 * leo4.SECOND,) * 4 + (1.5 * leo4.SECOND,) * 3 + (3e-5,) * 4  # of the bank's fault amplitudes per packet
FORGET = (
    7200.0  # [packets] of an amplitude: for ever, a gyro's could not be told from its bias and no filter were steady
)
APPEAR, GO = 1e-5, 1e-3  # probabilities per packet that a fault comes, and goes


class AxisModel(NamedTuple):
    """A packet of one body axis near rest: x+ = A x + B v, (nu, dyn) = C x + D v.

    x: turn error, bias error (truth - estimate), rate less the rate observer's, its acceleration. v: error of the mean
    rate of the gyros in each of the five ticks, the star sample's error, unmodelled acceleration of the body.
    """

    A: np.ndarray  # (4, 4)
    B: np.ndarray  # (4, 7)
    C: np.ndarray  # (2, 4)
    D: np.ndarray  # (2, 7)


def axis_model() -> AxisModel:
    """The model, by running filter and observer on unit inputs."""
    ahead, out = np.zeros((4, 11)), np.zeros((2, 11))
    for i, unit in enumerate(np.eye(11)):
        (turn, bias, rate, acceleration), (*gyro, star, push) = unit[:4], unit[4:]
        nu = turn + star
        turn, bias, dyn = turn - leo4.params.k_turn * nu, bias - leo4.params.k_bias * nu, 0.0
        for error in gyro:
            e = rate + bias + error
            dyn += e
            rate, acceleration = rate - KD[0] * e, acceleration + KD[1] * e
            turn += -leo4.DT * (bias + error) + 0.5 * leo4.DT**2 * push
            rate += leo4.DT * (push - acceleration)
        ahead[:, i], out[:, i] = (turn, bias, rate, acceleration), (nu, dyn)
    return AxisModel(ahead[:, :4], ahead[:, 4:], out[:, :4], out[:, 4:])


class BodyModel(NamedTuple):
    """What faults add to the residuals: 13 deviations from the healthy run, x+ = A x + F f, r = C x + E f.

    x: those of three axes and of the parity's baseline; f (11,): amplitudes of the faults [rad/s, rad, N m].
    """

    A: np.ndarray  # (13, 13)
    C: np.ndarray  # (7, 13)
    F: np.ndarray  # (13, 11)
    E: np.ndarray  # (7, 11)


def body_model() -> BodyModel:
    """The axes' models side by side, and the parity: r = p - B, B+ = B + r / 600."""
    axis = axis_model()
    A, C, F, E = np.zeros((13, 13)), np.zeros((7, 13)), np.zeros((13, 11)), np.zeros((7, 11))
    axes, J = np.array(leo4.AXES), np.array(leo4.INERTIA)
    for i in range(3):
        here, rows = slice(4 * i, 4 * i + 4), [i, 4 + i]
        A[here, here], C[rows, here] = axis.A, axis.C
        push = -np.linalg.inv(J)[i] @ axes  # a friction of 1 N m pulls the other way
        for number, columns, by in ((0, slice(leo4.TICKS), 0.75 * axes[i]), (7, slice(6, 7), push)):
            F[here, number : number + 4] = np.outer(axis.B[:, columns].sum(1), by)
            E[rows, number : number + 4] = np.outer(axis.D[:, columns].sum(1), by)
        F[here, 4 + i], E[rows, 4 + i] = axis.B[:, 5], axis.D[:, 5]
    A[12, 12], C[3, 12] = 1 - 1 / MEMORY, -1.0
    E[3, :4] = leo4.PARITY
    F[12, :4] = np.array(leo4.PARITY) / MEMORY
    return BodyModel(A, C, F, E)


def signatures(packets: int = LENGTH) -> np.ndarray:
    """Response of the residuals to a unit step of each fault, (11, packets, 7): gyro bias, star bias, wheel offset."""
    model, x, found = body_model(), np.zeros((13, 11)), []
    for _ in range(packets):
        found.append(model.C @ x + model.E)
        x = model.A @ x + model.F
    return np.moveaxis(np.array(found), -1, 0)


def laws(packets: int = LENGTH) -> tuple[np.ndarray, np.ndarray]:
    """How an axis answers to a unit step in time, (packets, 3, 2), and the parity to its own, (packets,).

    Steps of the mean rate of the gyros [rad/s], of the star sample [rad], of the acceleration of the body [rad/s^2]; seen by
    innovation and dynamics.
    """
    axis, x, found = axis_model(), np.zeros((4, 3)), []
    of_gyro = lambda M: M[:, : leo4.TICKS].sum(1)
    B, D = (np.stack([of_gyro(M), M[:, 5], M[:, 6]], axis=1) for M in (axis.B, axis.D))
    for _ in range(packets):
        found.append((axis.C @ x + D).T)
        x = axis.A @ x + B
    return np.array(found), (1 - 1 / MEMORY) ** np.arange(packets)


# the bank


class Bank(NamedTuple):
    """Constant filters of the eleven hypotheses, each with 14 states, and the healthy law."""

    ahead: Any  # (11, 14, 14) of the state before an update
    gain: Any  # (11, 14, 7) on the residual
    seen: Any  # (11, 7, 14)
    root: Any  # (11, 7, 7) L^-1 of the innovation's covariance
    healthy: Any  # (7, 7) L^-1 of the residual's
    offset: Any  # (11,) log-determinants of the healthy law less the hypothesis
    appear: Any = APPEAR
    go: Any = GO


class BankState(NamedTuple):
    """What the bank remembers."""

    x: Any  # (11, 14)
    odds: Any  # (11,) of each hypothesis against the healthy one


def bank_params(covariance) -> Bank:
    """The bank's filters; covariance: (7, 7) of the residuals in healthy runs."""
    model, std = body_model(), np.sqrt(np.diag(covariance))
    L = np.linalg.cholesky(covariance)
    ahead, gain, seen, root, offset = [], [], [], [], []
    for h in range(11):
        F = np.block([[model.A, model.F[:, [h]]], [np.zeros((1, 13)), np.full((1, 1), 1 - 1 / FORGET)]])
        H = np.hstack([model.C, model.E[:, [h]]])
        units = np.array([1e-5, 1e-7, 1e-5, 1e-6] * 3 + [1e-5, WALK[h]])  # lest the algebra loses digits
        F, H = F * units / units[:, None], H * units / std[:, None]
        found = steady(F, np.diag([0.0] * 13 + [1.0]), H, covariance / np.outer(std, std))
        K = F @ found.gain
        ahead.append((F - K @ H) * units[:, None] / units)
        gain.append(K * units[:, None] / std)
        seen.append(H * std[:, None] / units)
        lower = np.linalg.cholesky(found.innovation) * std[:, None]
        root.append(np.linalg.inv(lower))
        offset.append(np.log(np.diag(L)).sum() - np.log(np.diag(lower)).sum())
    made = ahead, gain, seen, root, np.linalg.inv(L), offset, APPEAR, GO
    return Bank(*(np.asarray(a, np.float32) for a in made))


def bank_init(params: Bank) -> BankState:
    return BankState(jnp.zeros((11, 14)), jnp.full(11, APPEAR))


def believed(params: Bank, x, odds, r):
    """States (11, 14) and odds (11,) of the hypotheses after the residuals r (7,)."""
    innovation = r - product(params.seen, x)
    white, healthy = product(params.root, innovation), product(params.healthy, r)
    gained = params.offset + 0.5 * (jnp.sum(healthy * healthy) - jnp.sum(white * white, axis=1))
    log = jnp.log(odds) + gained
    top = jnp.maximum(jnp.max(log), 0)
    odds, one = jnp.exp(log - top), jnp.exp(-top)
    p, go = params.appear, params.go
    odds = ((1 - go) * odds + p * one) / ((1 - 11 * p) * one + go * jnp.sum(odds))
    return product(params.ahead, x) + product(params.gain, jnp.broadcast_to(r, (11, 7))), odds


def bank_step(params: Bank, z: BankState, r, telemetry: leo4.Telemetry):
    """ln of the sum of the odds; odds' = odds N(r_h; S_h) / N(r; Sigma), then hypotheses appear and go."""
    x, odds = believed(params, z.x, z.odds, r)
    return BankState(x, odds), Verdict(jnp.log(jnp.sum(odds)), odds)


def mmae(covariance) -> Detector:
    """The bank as a row of the board."""
    return Detector("mmae", with_residuals(bank_init), OnResiduals(bank_step), bank_params(covariance), 5)

"""The bound that no detector passes: a Neyman-Pearson test that knows kind, channel, sign, size and onset.

In closed form of the seven residuals taken as white, which the dynamics are not quite: a row may lie 5 % below.

May import: bank, leo4, metrics, telemetry.
"""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from jaxatt.yardstick import leo4
from jaxatt.yardstick.bank import signatures
from jaxatt.yardstick.metrics import HORIZON
from jaxatt.yardstick.telemetry import STD

# kind -> its channels and the size of one unit of the catalogue in SI units
STEPS = {
    "gyro_bias": (slice(0, 4), leo4.SECOND),
    "star_bias": (slice(4, 7), leo4.SECOND),
    "wheel_offset": (slice(7, 11), 1e-3),
}
PROBABILITY = 0.95
_NORMAL = NormalDist()


def energies(covariance=None) -> dict[str, np.ndarray]:
    """Norm of the whitened response to one unit of size over t packets, (channels, 120) for each kind.

    covariance: (7, 7) of the residuals; None takes their variances by theory.
    """
    root = np.linalg.inv(np.linalg.cholesky(np.diag(np.square(STD)) if covariance is None else covariance))
    white = signatures(round(HORIZON / leo4.PACKET)) @ root.T
    length = np.sqrt(np.cumsum(np.sum(white**2, axis=2), axis=1))
    return {kind: length[channels] * unit for kind, (channels, unit) in STEPS.items()}


def bound(kind: str, seconds: float = 10.0, rate: float = 0.1, covariance=None) -> float:
    """The least size that can be found within so many seconds with probability .95, in the unit of the catalogue.

    (Phi^-1(1 - rate t) + Phi^-1(.95)) / E_t, the mean over the channels; rate [1/h].
    """
    length = energies(covariance)[kind][:, round(seconds / leo4.PACKET) - 1]
    needed = _NORMAL.inv_cdf(1 - rate * seconds / 3600) + _NORMAL.inv_cdf(PROBABILITY)
    return float(np.mean(needed / length))


def delay(kind: str, size: float, rate: float = 0.1, covariance=None) -> float:
    """The least RMD60 [s] of one size: P(d <= t) <= Phi(size E_t - Phi^-1(1 - rate t))."""
    length = size * energies(covariance)[kind]
    t = leo4.PACKET * np.arange(1, length.shape[1])  # after a whole packet of the fault
    missed = [
        1 - _NORMAL.cdf(e - _NORMAL.inv_cdf(1 - rate * s / 3600)) for row in length[:, :-1] for e, s in zip(row, t)
    ]
    return leo4.PACKET / 2 + leo4.PACKET * float(np.sum(missed)) / len(length)

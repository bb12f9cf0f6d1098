"""The bound that no detector passes: a Neyman-Pearson test that knows kind, channel, sign, size and onset.

In closed form of the seven residuals taken as white. The dynamics are not: their noise swings back, so that what stays, as a
wheel's offset does, stands out more than `bound` says. Rows that look at one packet after the other do not see that, and may
lie 5 % below; for one that does, `coloured` is the bound.

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


def coloured(kind: str, residuals, seconds: float = 10.0, rate: float = 0.1, past: float = 30.0) -> float:
    """`bound` for the noise as recorded: Gaussian, whatever its colour.

    E_t^2 = s' C^-1 s, with C the covariance of stretches of the residuals and s the response to one unit of size, 0 before
    the onset; what came before tells of the noise after.

    Args:
        kind: of `STEPS`.
        residuals: of healthy runs (n, packets, 7), so many that stretches outnumber their lengths a hundred times.
        seconds, rate: as of `bound`.
        past: [s] of the stretch before the onset.
    """
    before, after = (round(span / leo4.PACKET) for span in (past, seconds))
    r = np.asarray(residuals, float)
    starts = range(0, r.shape[1] - before - after + 1, 17)  # a step that divides neither seconds nor minutes
    stretches = np.concatenate([r[:, i : i + before + after].reshape(len(r), -1) for i in starts])
    channels, unit = STEPS[kind]
    response = np.pad(signatures(after)[channels] * unit, ((0, 0), (before, 0), (0, 0))).reshape(-1, stretches.shape[1])
    energy = np.sum(response * np.linalg.solve(stretches.T @ stretches / len(stretches), response.T).T, axis=1)
    needed = _NORMAL.inv_cdf(1 - rate * seconds / 3600) + _NORMAL.inv_cdf(PROBABILITY)
    return float(np.mean(needed / np.sqrt(energy)))


def delay(kind: str, size: float, rate: float = 0.1, covariance=None) -> float:
    """The least RMD60 [s] of one size: P(d <= t) <= Phi(size E_t - Phi^-1(1 - rate t))."""
    length = size * energies(covariance)[kind]
    t = leo4.PACKET * np.arange(1, length.shape[1])  # after a whole packet of the fault
    missed = [
        1 - _NORMAL.cdf(e - _NORMAL.inv_cdf(1 - rate * s / 3600)) for row in length[:, :-1] for e, s in zip(row, t)
    ]
    return leo4.PACKET / 2 + leo4.PACKET * float(np.sum(missed)) / len(length)

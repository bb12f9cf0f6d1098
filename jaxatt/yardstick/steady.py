"""The steady Kalman filter of a linear model that does not change with time, off line in NumPy.

May import: nothing of ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Steady(NamedTuple):
    """What the Kalman filter of x+ = F x + v, y = H x + e converges to."""

    prior: np.ndarray  # (n, n) covariance of x before an update
    gain: np.ndarray  # (n, m) of the update x + K (y - H x)
    innovation: np.ndarray  # (m, m) covariance of y - H x


def steady(F, Q, H, R, S=None) -> Steady:
    """The steady filter, by the doubling algorithm of Chu, Fan, Lin & Wang (2004); v and e have covariances Q and R.

    Args:
        F: (n, n).
        Q: (n, n).
        H: (m, n).
        R: (m, m), positive definite.
        S: (n, m) covariance of v with the e of the same instant; None for none.

    Raises:
        ValueError: a model whose filter does not converge.

    Example:
        >>> float(steady([[1.0]], [[1.0]], [[1.0]], [[1.0]]).prior[0, 0])  # the golden ratio
        1.618033988749895
    """
    F, Q, H, R = (np.asarray(a, float) for a in (F, Q, H, R))
    n, m = F.shape[0], H.shape[0]
    across = np.zeros((n, m)) if S is None else np.asarray(S, float)
    weight = np.linalg.inv(R)
    A, G, P = (F - across @ weight @ H).T, H.T @ weight @ H, Q - across @ weight @ across.T
    for _ in range(40):
        with np.errstate(over="ignore", invalid="ignore"):  # of a filter that does not converge
            inner = np.linalg.inv(np.eye(n) + G @ P)
            step = A.T @ P @ inner @ A
            A, G, P = A @ inner @ A, G + A @ inner @ G @ A.T, P + step
        if not np.isfinite(P).all():
            break
        if np.abs(step).max() <= 1e-10 * np.abs(P).max():
            innovation = H @ P @ H.T + R
            return Steady(P, np.linalg.solve(innovation, H @ P).T, innovation)
    raise ValueError("`F, Q, H, R` must have a steady filter, but the doubling did not converge.")

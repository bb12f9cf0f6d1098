"""The baselines fitted to telemetry of the tuning key, which is public, ``jax.random.key(0)``: all but "gru" to fault-free days.

May import: telemetry, recording, baselines, bank, gru, learning, check.
"""

from __future__ import annotations

import numpy as np

from jaxatt import check
from jaxatt.yardstick import bank, baselines, gru, learning
from jaxatt.yardstick.recording import covariance_of, healthy, public
from jaxatt.yardstick.telemetry import Detector, OnResiduals, with_residuals

SHARE = 0.95  # of the features' variance that the plane of pca holds
NAMES = (
    "mrp", "chi2_1", "chi2_10", "chi2_60", "parity", "parity 30 s", "cusum", "glr", "mmae", "pca",
    "gyro_chi2", "gyro_parity", "gru", "null", "random", "clock", "flatline",
)  # fmt: skip


def pca_params(features, means) -> baselines.PcaParams:
    """Plane and limits; features of packets and the means of ten, (n, packets, 13) both.

    Standardised by the spread of the means; plane and variances are those of the packets, limits those of the means.
    """
    single, flat = (np.asarray(a, float).reshape(-1, a.shape[-1]) for a in (features, means))
    mean, std = single.mean(0), flat.std(0)
    packets, z = (single - mean) / std, (flat - mean) / std
    values, vectors = np.linalg.eigh(packets.T @ packets / len(packets))
    values, vectors = values[::-1], vectors[:, ::-1]
    k = int(np.searchsorted(np.cumsum(values) / values.sum(), SHARE)) + 1
    main = vectors[:, :k].T / np.sqrt(values[:k, None])
    rest = np.eye(len(values)) - vectors[:, :k] @ vectors[:, :k].T
    limits = [np.quantile(np.sum((z @ m.T) ** 2, axis=1), 0.9999) for m in (main, rest)]
    return baselines.PcaParams(*(np.asarray(a, np.float32) for a in (mean, std, main, rest, limits)))


def tune(name: str, key=None) -> Detector:
    """A baseline fitted anew.

    Args:
        name: one of `NAMES`.
        key: of the fault-free days that it is fitted to; None for the public ones of ``jax.random.key(0)``. "gru" learns
            from faults, by training that takes a quarter of an hour; None for the numbers that are shipped.

    Raises:
        ValueError: a name that is none of them.

    Example:
        >>> glr = tune("glr")
    """
    fixed = {d.name: d for d in (baselines.MRP, *map(baselines.chi2, (1, 10, 60)), *baselines.REFERENCE)}
    if name in fixed:
        return fixed[name]
    if name not in NAMES:
        check.refuse("name", f"be one of {', '.join(NAMES)}", check.short(name))
    if name == "gru":
        return gru.gru(gru.shipped() if key is None else learning.train(key).params)
    found = public() if key is None else healthy(key)
    covariance = covariance_of(found)
    std = np.sqrt(np.diag(covariance))
    if name.startswith("parity"):
        return baselines.parity(10 if name == "parity" else 60, std[3])
    if name == "cusum":
        params = baselines.CusumParams(std.astype(np.float32), np.float32(0.25))
        return Detector("cusum", with_residuals(baselines.cusum_init), OnResiduals(baselines.cusum_step), params, 1)
    if name == "glr":
        params = baselines.glr_params(covariance, bank.laws())
        return Detector("glr", with_residuals(baselines.glr_init), OnResiduals(baselines.glr_step), params, 8)
    if name == "mmae":
        return bank.mmae(covariance)
    if name.startswith("gyro"):
        return next(row for row in baselines.gyro_rows(covariance) if row.name == name)
    return Detector(
        "pca",
        with_residuals(baselines.pca_init),
        OnResiduals(baselines.pca_step),
        pca_params(found.features, found.means),
        3,
    )

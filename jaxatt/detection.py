"""Fault detection: from residuals to alarms, from alarms to the channel at fault."""

from __future__ import annotations

import jax.numpy as jnp

# chi-square of the innovation, channel by channel


def smoothed(mean, value, memory):
    """The moving mean of normalised innovations after one more; memory in (0, 1], 1 for no memory."""
    return mean + memory * (value - mean)


def chi_square(mean, memory):
    """Square of a `smoothed` mean of unit white noise over its variance: chi-square with one degree of freedom."""
    return mean * mean * (2 - memory) / memory


def worst_above(statistic, threshold):
    """Which channel, at most one, has the largest statistic and that above the threshold; (n, *lanes) bool."""
    largest = jnp.max(statistic, axis=0)
    channel = jnp.arange(statistic.shape[0]).reshape(-1, *(1,) * largest.ndim)
    return (largest > threshold) & (channel == jnp.argmax(statistic, axis=0))

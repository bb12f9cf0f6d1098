"""Sensor triads: how star sensors and gyros read, faults included.

May import: check, vec, attitude, faults, mounting, scores.
"""

from __future__ import annotations

from jaxatt.check import door
from jaxatt.faults import channel, read
from jaxatt.vec import Vec3


@door
def triad(faults: Vec3, t, std, normals, last: Vec3) -> Vec3:
    """The three channels of a star sensor or rate gyro from tick time t [s] on, a `Vec3` of `Channel`.

    faults: `Vec3` of `Fault`; std: standard deviation of each channel's noise; normals: standard normal numbers
    of shape (3, *lanes); last: the previous reading.
    """
    return Vec3(*(channel(f, t, std, n, v) for f, n, v in zip(faults, normals, last)))


@door
def read_triad(channels: Vec3, truth: Vec3) -> Vec3:
    """The reading of a triad whose true signals are ``truth``."""
    return Vec3(*map(read, channels, truth))

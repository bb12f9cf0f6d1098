"""Guidance: where the spacecraft shall point, and in which mode it is.

A `Target` is an attitude with its rate and acceleration, for feed-forward (`wheel_feed_forward` of the body's momentum).
Quaternions: scalar first, body to reference.

May import: check, vec, attitude.
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxatt import check
from jaxatt.attitude import (
    quat_conjugate,
    quat_from_rotation,
    quat_from_vector,
    quat_normalised,
    quat_rotate,
    quat_to_body,
    vector_from_quat,
)
from jaxatt.check import finite
from jaxatt.vec import Mat3, Quat, Vec3, cross, norm, where, zeros


class Target(NamedTuple):
    """What to follow."""

    q: Quat  # attitude
    w: Vec3  # [rad/s] body rate, in the target's axes
    a: Vec3  # [rad/s^2] its rate of change, in the target's axes


def tracking_error(q: Quat, w: Vec3, target: Target) -> tuple[Quat, Vec3, Vec3]:
    """Attitude, rate [rad/s] and feed-forward acceleration [rad/s^2] against a target, in body axes.

    e = conj(q_d) q, e_w = w - A(e)' w_d, and A(e)' a_d - w x A(e)' w_d, the body's acceleration once it follows.
    """
    e = quat_conjugate(target.q) * q
    wanted = quat_to_body(e, target.w)
    return e, w - wanted, quat_to_body(e, target.a) - cross(w, wanted)


# slews


class Slew(NamedTuple):
    """A turn about a fixed axis: acceleration, coast, deceleration; `slew` plans one."""

    start: Quat  # attitude at t = 0
    axis: Vec3  # unit vector, in body and, turned by start, in reference axes
    angle: Any  # [rad]
    acceleration: Any  # [rad/s^2]
    ramp: Any  # [s] how long it accelerates
    duration: Any  # [s]


def slew(start: Quat, end: Quat, rate_max, acceleration_max) -> Slew:
    """The quickest turn from start to end about the fixed axis between them, from rest to rest.

    ramp = min(w_max / a_max, sqrt(angle / a_max)), duration = angle / (a_max ramp) + ramp. It is the quickest about that
    axis, not of all turns. The limits must fit what the wheels give about this axis.

    Args:
        start, end: attitudes, unit quaternions.
        rate_max: [rad/s] of the coast; inf for none.
        acceleration_max: [rad/s^2].

    Raises:
        ValueError: limits that are not positive.

    Example:
        >>> plan = slew(q0, q1, jnp.deg2rad(0.5), 2e-4)
        >>> target = slew_at(plan, now.t - start_time)
    """
    check.limit("rate_max", rate_max)
    check.positive("acceleration_max", acceleration_max)
    turn = vector_from_quat(quat_conjugate(start) * end)
    angle = norm(turn)
    some = angle > 0
    ramp = jnp.minimum(rate_max / acceleration_max, jnp.sqrt(jnp.where(some, angle, 1) / acceleration_max))
    ramp = jnp.where(some, ramp, 0)
    duration = jnp.where(some, angle / (acceleration_max * jnp.where(some, ramp, 1)) + ramp, 0)
    axis = turn / jnp.where(some, angle, 1)
    return Slew(start, axis, angle, acceleration_max, ramp, duration)


def slew_at(plan: Slew, t) -> Target:
    """The target at t [s] after the slew's start; at rest before it and after its end."""
    a, T, braking = plan.acceleration, plan.ramp, plan.duration - plan.ramp
    rising = jnp.clip(t, 0, T)
    coasting = jnp.clip(t - T, 0, jnp.maximum(braking - T, 0))
    falling = jnp.clip(plan.duration - t, 0, T)
    done = a * (rising * rising / 2 + T * coasting + (T * T - falling * falling) / 2)
    rate = a * jnp.minimum(rising, falling)
    gain = jnp.where((t >= 0) & (t < T), a, 0) - jnp.where((t >= braking) & (t < plan.duration), a, 0)
    return Target(plan.start * quat_from_vector(done * plan.axis), rate * plan.axis, gain * plan.axis)


# tabulated attitude


class Profile(NamedTuple):
    """Attitudes at given times; between them the body turns at constant rate."""

    t: Annotated[Any, "s", finite, ("knots",)]  # ascending
    q: Annotated[Quat, "1", finite, ("knots",)]  # unit quaternions; their signs do not matter

    def check(self, name: str) -> None:
        """Refuse, with ValueError, fewer than two rows, times that do not ascend, half a turn from a row to the next."""
        if np.shape(self.t)[0] < 2:
            check.refuse(name, "have two rows or more", f"one of {np.shape(self.t)[0]}")
        if check.concrete(self):
            t, q = np.asarray(self.t), np.stack(self.q)
            check.each(f"{name}.t", "ascend (difference to the next)", np.diff(t, axis=0), np.diff(t, axis=0) > 0)
            check.unit(f"{name}.q", self.q)
            angle = 2 * np.rad2deg(np.arccos(np.clip(np.abs((q[:, 1:] * q[:, :-1]).sum(0)), 0, 1)))
            check.each(f"{name}.q", "turn by less than 179.9 deg from one to the next", angle, angle < 179.9)


def follow(profile: Profile, t) -> Target:
    """The target at t [s]: q_a exp(s log(conj(q_a) q_b)) between two rows; at rest at the ends outside them."""
    times, q = jnp.asarray(profile.t), jax.tree.map(jnp.asarray, profile.q)
    i = jnp.clip(jnp.sum(times <= t, axis=0) - 1, 0, times.shape[0] - 2)
    before, after = (Quat(*(c[i + k] for c in q)) for k in (0, 1))
    span = times[i + 1] - times[i]
    turn = vector_from_quat(quat_conjugate(before) * after)
    s = (t - times[i]) / span
    moving = (s >= 0) & (s < 1)
    return Target(before * quat_from_vector(jnp.clip(s, 0, 1) * turn), where(moving, turn / span, zeros()), zeros())


# pointing


def nadir(r: Vec3, v: Vec3) -> Quat:
    """The attitude with z to the Earth's centre, y against the orbit's normal and x ahead; r [m], v [m/s], inertial.

    On a circular orbit of rate n its body rate is (0, -n, 0).
    """
    z = -r / norm(r)
    h = cross(r, v)
    y = -h / norm(h)
    return quat_from_rotation(Mat3(cross(y, z), y, z).T)


def orbit_rate(r: Vec3, v: Vec3):
    """Rate [rad/s] at which the nadir attitude turns about -y: |r x v| / |r|^2."""
    return norm(cross(r, v)) / (r @ r)


def pointed(q: Quat, axis: Vec3, direction: Vec3) -> Quat:
    """The attitude nearest to q whose body axis points along a reference direction; both unit vectors.

    q turned by (1 + c.s, c x s) / |.| in reference axes, c = A(q) axis and s the direction; a half turn about some normal
    of c where the two are opposite, to 1e-6 rad.
    """
    c = quat_rotate(q, axis)
    both = c + direction
    w = both @ both / 2  # 1 + c.s without the digits that the sum loses where c and s are nearly opposite
    side = cross(c, direction)
    side = side - (c @ side) * c  # of a short product rounding leaves a part along c, which half a turn would double
    opposite = w < 5e-13
    other = where(jnp.abs(c.x) < 0.6, Vec3(1.0, 0.0, 0.0), Vec3(0.0, 1.0, 0.0))
    normal = cross(c, other)
    turn = Quat(jnp.where(opposite, 0, w), *where(opposite, normal, side))
    return quat_normalised(turn) * q


# modes


class Rule(NamedTuple):
    """A row of a mode machine: in mode ``before``, once flag number ``flag`` has been up for ``ticks`` ticks, to ``after``."""

    before: int
    flag: int
    ticks: int
    after: int


class Mode(NamedTuple):
    """State of a mode machine."""

    mode: Any  # () int
    counts: Any  # (rules,) int: for how many ticks on end each rule's flag has been up in this mode


def first_mode(rules: tuple[Rule, ...], mode: int) -> Mode:
    """The mode machine in its first mode. Raises ValueError without rules and for a rule that waits no tick."""
    if not rules:
        check.refuse("rules", "hold at least one rule", "empty")
    for i, rule in enumerate(rules):
        if rule.ticks < 1:
            check.refuse(f"rules[{i}].ticks", "be 1 or more", rule.ticks)
    return Mode(jnp.asarray(mode), jnp.zeros(len(rules), int))


def next_mode(rules: tuple[Rule, ...], state: Mode, flags) -> Mode:
    """The mode after one more tick: the first rule that is due wins, and every change sets all counts to zero.

    rules: static rows; flags: (n,) bool, those of this tick. Raises ValueError for a rule on a flag that is not there.
    """
    before, flag, ticks, after = (np.array(column) for column in zip(*rules))
    flags = jnp.asarray(flags, bool)
    if not (flag.min() >= 0 and flag.max() < len(flags)):
        check.refuse("rules", f"name flags from 0 to {len(flags) - 1}", f"{flag.min()} to {flag.max()}")
    counts = jnp.where((state.mode == before) & flags[flag], state.counts + 1, 0)
    due = counts >= ticks
    changes = jnp.any(due, axis=0)
    mode = jnp.where(changes, jnp.asarray(after)[jnp.argmax(due, axis=0)], state.mode)
    return Mode(mode.astype(state.mode.dtype), jnp.where(changes, 0, counts))

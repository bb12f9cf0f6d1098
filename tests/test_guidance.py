"""Guidance: slews, tabulated attitudes, pointing, and the mode machine."""

from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from slopes import slopes

from jaxatt import fields
from jaxatt.attitude import quat_from_vector, quat_rate, quat_rotate, quat_to_body
from jaxatt.guidance import (
    Profile,
    Rule,
    Target,
    first_mode,
    follow,
    nadir,
    next_mode,
    orbit_rate,
    pointed,
    slew,
    slew_at,
    tracking_error,
)
from jaxatt.vec import Quat, Vec3, array, norm

RNG = np.random.default_rng(21)
POINTED = jax.jit(pointed)
FOLLOWED = jax.jit(lambda table, t: jax.jvp(lambda t: follow(table, t), (t,), (1.0,)))  # the target and its derivative
DEG = np.pi / 180
START = Quat.of(Rotation.from_rotvec([0.4, -0.2, 1.0]).as_quat(scalar_first=True))
TURN = 109.947 * DEG * np.array([2.0, -1.0, 2.0]) / 3


def turned(q: Quat, r) -> Quat:
    return q * quat_from_vector(Vec3.of(r))


def apart(p: Quat, q: Quat):
    """Angle [rad] between two attitudes, by SciPy."""
    a, b = (Rotation.from_quat(np.array(p), scalar_first=True) for p in (p, q))
    return (a.inv() * b).magnitude()


def unit_quat():
    q = RNG.normal(size=4)
    return Quat.of(q / np.linalg.norm(q))


# slews


@pytest.mark.parametrize("rate, duration", [(0.5 * DEG, 263.5273), (3 * DEG, 195.9050)])  # the second does not coast
def test_a_slew_takes_the_time_of_its_equation_and_ends_where_it_shall(rate, duration):
    end = turned(START, TURN)
    plan = slew(START, end, rate, 2e-4)
    angle, ramp = 109.947 * DEG, min(rate / 2e-4, np.sqrt(109.947 * DEG / 2e-4))
    assert plan.duration == pytest.approx(angle / (2e-4 * ramp) + ramp, rel=1e-12)
    assert plan.duration == pytest.approx(duration, abs=1e-3)  # the angle is known to .0005 deg
    at = jax.jit(slew_at)

    def turning(t, q):
        return np.array(quat_rate(Quat.of(q), Vec3(*at(plan, t).w)))

    q = np.array(START)
    knots = np.unique([0, plan.ramp, plan.duration - plan.ramp, plan.duration])
    for a, b in pairwise(knots):  # smooth between them
        q = solve_ivp(turning, (a, b - 1e-9), q, "DOP853", rtol=1e-10, atol=1e-12).y[:, -1]
    assert apart(Quat.of(q), end) < 1e-7 and apart(at(plan, plan.duration).q, end) < 1e-12


@pytest.mark.parametrize("rate", [0.5 * DEG, 3 * DEG, np.inf])
def test_attitude_rate_and_acceleration_of_a_slew_belong_together(rate):
    """Rate is the derivative of the attitude, acceleration that of the rate, within their bounds, at every phase."""
    plan = slew(START, turned(START, TURN), rate, 2e-4)
    t = jnp.linspace(-20, float(plan.duration) + 20, 401) + 0.0123
    target = jax.vmap(lambda t: slew_at(plan, t))(t)
    moves = lambda t: jax.jvp(lambda t: slew_at(plan, t), (t,), (1.0,))[1]
    change = jax.vmap(moves)(t)
    expected = quat_rate(target.q, target.w)
    for a, b in zip([*change.q, *change.w], [*expected, *target.a]):
        np.testing.assert_allclose(a, b, atol=1e-12)
    assert float(norm(target.w).max()) <= min(rate, 1) * (1 + 1e-12)
    np.testing.assert_allclose(np.unique(np.round(norm(target.a), 12)), [0, 2e-4], atol=1e-12)
    assert norm(slew_at(plan, -1.0).w) == 0 and norm(slew_at(plan, 400.0).w) == 0


def test_the_axis_of_a_slew_is_fixed_in_body_axes_and_the_shorter_way_is_taken():
    plan = slew(START, -turned(START, TURN), 0.5 * DEG, 2e-4)  # -q is the same attitude
    np.testing.assert_allclose(array(plan.axis), [2 / 3, -1 / 3, 2 / 3], rtol=1e-12)
    assert plan.angle == pytest.approx(109.947 * DEG, rel=1e-12)
    long_way = slew(START, turned(START, 200 / 109.947 * TURN), 0.5 * DEG, 2e-4)
    assert long_way.angle == pytest.approx(160 * DEG, rel=1e-12)
    assert array(long_way.axis)[0] == pytest.approx(-2 / 3)


def test_a_slew_to_where_it_starts_takes_no_time_and_has_finite_gradients():
    plan = slew(START, START, 0.5 * DEG, 2e-4)
    assert plan.duration == 0 and plan.ramp == 0
    target = slew_at(plan, 0.0)
    assert apart(target.q, START) < 1e-12 and norm(target.w) == norm(target.a) == 0
    cost = lambda r: array(slew_at(slew(START, turned(START, r), 0.01, 1e-3), 1.0).q).sum()
    for kind in (jnp.float32, jnp.float64):
        assert np.isfinite(jax.grad(cost)(jnp.zeros(3, kind))).all()


@pytest.mark.parametrize(
    "rate, acceleration, word", [(0.0, 1.0, "rate_max"), (1.0, -1.0, "acceleration_max"), (1.0, np.inf, "acc")]
)
def test_limits_that_turn_nothing_are_refused(rate, acceleration, word):
    with pytest.raises(ValueError, match=f"`{word}.* must be"):
        slew(START, turned(START, TURN), rate, acceleration)


def test_gradients_of_a_slew_are_those_of_central_differences():
    def cost(p):
        plan = slew(START, turned(START, p[:3]), p[3], p[4])
        target = slew_at(plan, p[5])
        return target.q @ Quat(1.0, 2.0, 3.0, 4.0) + 50 * (target.w @ Vec3(1.0, -2.0, 0.5)) + 1e-3 * plan.duration

    at = [[*TURN, 0.5 * DEG, 2e-4, t] for t in (20.0, 130.0, 240.0)]
    found, central = slopes(cost, at, [1e-6, 1e-6, 1e-6, 1e-8, 1e-9, 1e-5])
    np.testing.assert_allclose(found, central, rtol=2e-6, atol=1e-8)


# tabulated attitudes

KNOTS = [unit_quat() for _ in range(5)]
for _i in range(4):  # at most 150 deg from knot to knot
    KNOTS[_i + 1] = turned(KNOTS[_i], RNG.uniform(-1.4, 1.4, 3))
TIMES = np.array([0.0, 1.0, 3.0, 3.5, 6.0])


def profile(signs=(1, 1, 1, 1, 1)):
    return Profile(TIMES, Quat.of(np.array([np.array(q) * s for q, s in zip(KNOTS, signs)]).T))


def test_a_profile_is_followed_at_constant_rate_between_its_rows():
    """SciPy's Slerp; the signs of the quaternions do not matter; the rate is the derivative."""
    from scipy.spatial.transform import Slerp

    theirs = Slerp(TIMES, Rotation.from_quat(np.array([np.array(q) for q in KNOTS]), scalar_first=True))
    for t in (0.0, 0.3, 1.0, 2.9, 3.2, 5.99):
        for table in (profile(), profile((1, -1, -1, 1, -1))):
            target, change = FOLLOWED(table, t)
            assert (theirs(t).inv() * Rotation.from_quat(np.array(target.q), scalar_first=True)).magnitude() < 1e-12
            if t not in TIMES:  # there the rate jumps
                np.testing.assert_allclose(array(change.q), array(quat_rate(target.q, target.w)), atol=1e-12)
            assert norm(target.a) == 0


def test_outside_its_rows_a_profile_rests_at_the_ends():
    for t, knot in ((-5.0, 0), (6.0, 4), (9.0, 4)):
        target, _ = FOLLOWED(profile(), t)
        assert apart(target.q, KNOTS[knot]) < 1e-12 and norm(target.w) == 0


def test_profiles_that_say_not_where_to_turn_are_refused():
    fields.validate("profile", profile())
    q, half = KNOTS[0], turned(KNOTS[0], [np.pi, 0, 0])
    two = lambda a, b: Quat.of(np.array([np.array(a), np.array(b)]).T)
    bad = [
        (Profile(TIMES[:2], two(q, half)), r"`profile\.q\[0\]` must turn by less than 179.9 deg"),
        (Profile(TIMES[:2], two(q, 2 * half)), r"`\|profile\.q\|\[1\]` must be 1"),
        (Profile(np.zeros(2), two(q, q)), r"`profile\.t\[0\]` must ascend"),
        (Profile(TIMES[:1], Quat.of(np.array(q)[:, None])), "`profile` must have two rows or more"),
    ]
    for table, message in bad:
        with pytest.raises(ValueError, match=message):
            fields.validate("profile", table)


def test_gradients_of_a_profile_are_those_of_central_differences():
    def cost(p):
        q = turned(KNOTS[3], p[:3])
        table = profile()
        moved = Quat(*(a.at[3].set(b) for a, b in zip(map(jnp.asarray, table.q), q)))
        target = follow(Profile(table.t, moved), p[3])
        return target.q @ Quat(1.0, 2.0, 3.0, 4.0) + target.w @ Vec3(1.0, -2.0, 0.5)

    found, central = slopes(cost, [0.1, -0.2, 0.3, 2.2])
    np.testing.assert_allclose(found, central, rtol=1e-6, atol=1e-8)
    still = Profile(TIMES, Quat(*(np.full(5, c, np.float32) for c in (1, 0, 0, 0))))
    assert np.isfinite(jax.grad(lambda t: follow(still, t).q.x)(jnp.float32(2.0)))


# pointing


def test_the_nadir_attitude_looks_down_and_turns_about_minus_y():
    """On a circular orbit: z down, x ahead, y against the normal; the rate (0, -n, 0), by the derivative along the orbit."""
    n, i = 1.1e-3, 1.7
    r = lambda t: Vec3(7e6 * jnp.cos(n * t), 7e6 * jnp.sin(n * t) * np.cos(i), 7e6 * jnp.sin(n * t) * np.sin(i))
    v = lambda t: jax.jvp(r, (t,), (1.0,))[1]
    attitude = lambda t: nadir(r(t), v(t))
    q, change = jax.jvp(attitude, (700.0,), (1.0,))
    np.testing.assert_allclose(array(quat_rotate(q, Vec3(0.0, 0.0, 1.0))), -array(r(700.0)) / 7e6, atol=1e-12)
    np.testing.assert_allclose(array(quat_rotate(q, Vec3(1.0, 0.0, 0.0))), array(v(700.0)) / (7e6 * n), atol=1e-12)
    normal = quat_rotate(q, Vec3(0.0, -1.0, 0.0))
    np.testing.assert_allclose(array(normal), [0, -np.sin(i), np.cos(i)], atol=1e-12)
    w = 2 * (Quat(q.w, -q.x, -q.y, -q.z) * change).v
    np.testing.assert_allclose(array(w), [0, -n, 0], atol=1e-9 * n + 1e-15)
    assert orbit_rate(r(700.0), v(700.0)) == pytest.approx(n, rel=1e-12)
    single = nadir(*(Vec3(*(jnp.float32(c) for c in f(700.0))) for f in (r, v)))
    np.testing.assert_allclose(array(single), array(q), atol=1e-6)


def test_a_body_axis_points_where_it_shall_by_the_smallest_turn():
    for _ in range(30):
        q, axis, s = unit_quat(), *(Vec3.of(v / np.linalg.norm(v)) for v in RNG.normal(size=(2, 3)))
        p = POINTED(q, axis, s)
        np.testing.assert_allclose(array(quat_rotate(p, axis)), array(s), atol=1e-12)
        assert apart(p, q) == pytest.approx(np.arccos(np.clip(quat_rotate(q, axis) @ s, -1, 1)), abs=1e-7)


@pytest.mark.parametrize("kind, least", [(np.float64, 1e-12), (np.float32, 1e-6)])
@pytest.mark.parametrize("off", [0.0, 1e-9, 1e-7, 2e-6, 1e-5, 1e-3])
def test_an_axis_that_points_the_other_way_turns_by_half_a_turn(kind, least, off):
    for _ in range(10):
        q, a = unit_quat(), RNG.normal(size=3)
        a /= np.linalg.norm(a)
        q, axis = jax.tree.map(kind, (q, Vec3.of(a)))
        c = np.array(quat_rotate(q, axis), float)
        side = np.cross(c, RNG.normal(size=3))
        s = -c + off * side / np.linalg.norm(side)
        s /= np.linalg.norm(s)
        p = POINTED(q, axis, jax.tree.map(kind, Vec3.of(s)))
        tolerance = 4 * least + 2 * off * (off < 1e-6)  # below a microradian it takes the opposite itself
        np.testing.assert_allclose(np.array(quat_rotate(p, axis), float), s, atol=tolerance)
        assert apart(p, q) == pytest.approx(np.pi - off, abs=tolerance + 2e-6)


def test_gradients_of_pointing_are_those_of_central_differences_and_finite_at_the_opposite():
    q, axis = unit_quat(), Vec3(0.0, 0.6, 0.8)

    def cost(p):
        s = Vec3.of(p)
        return pointed(q, axis, s / norm(s)) @ Quat(1.0, 2.0, 3.0, 4.0) + nadir(s, Vec3(0.3, 0.1, 1.0)) @ Quat(
            4.0, 1.0, 2.0, 3.0
        )

    found, central = slopes(cost, [0.8, 0.36, 0.48])
    np.testing.assert_allclose(found, central, rtol=1e-6, atol=1e-8)
    opposite = jax.grad(lambda s: array(pointed(Quat(1.0, 0.0, 0.0, 0.0), axis, Vec3.of(s))).sum())
    for kind in (jnp.float32, jnp.float64):
        for sign in (-1, 1):
            assert np.isfinite(opposite(sign * jnp.array([0.0, 0.6, 0.8], kind))).all()


def test_the_tracking_error_moves_as_it_says():
    """e' = e (0, e_w) / 2; and with w' the feed-forward the rate error of a follower stays zero."""
    q, p, w, wd, a = unit_quat(), unit_quat(), *(Vec3.of(v) for v in RNG.normal(size=(3, 3)))
    target = Target(p, wd, a)
    e, e_w, _ = tracking_error(q, w, target)
    moved = lambda h: Target(turned(p, h * array(wd)), wd + h * a, a)  # to first order
    error = lambda h: tracking_error(turned(q, h * array(w)), w, moved(h))
    change = jax.jvp(lambda h: error(h)[0], (0.0,), (1.0,))[1]
    np.testing.assert_allclose(array(change), array(quat_rate(e, e_w)), atol=1e-12)
    change = jax.jvp(lambda h: error(h)[1], (0.0,), (1.0,))[1]  # of a body at constant rate
    np.testing.assert_allclose(array(change), -array(error(0.0)[2]), atol=1e-12)
    np.testing.assert_allclose(array(e_w), array(w - quat_to_body(e, wd)), rtol=1e-12)
    on_target = tracking_error(p, wd, target)
    np.testing.assert_allclose(array(on_target[1]), 0, atol=1e-15)
    np.testing.assert_allclose(array(on_target[2]), array(a), atol=1e-12)


# modes: 0 detumble, 1 safe, 2 nominal; flags slow, known, fault, fast

SLOW, KNOWN, FAULT, FAST = range(4)
RULES = (Rule(0, SLOW, 3, 1), Rule(1, KNOWN, 3, 2), Rule(2, FAULT, 1, 1), Rule(1, FAST, 2, 0), Rule(2, FAST, 2, 0))


NEXT = jax.jit(partial(next_mode, RULES))


def modes(start, *flags):
    """The mode after each tick, of flags that are up, tick by tick."""
    state, found = first_mode(RULES, start), []
    for up in flags:
        state = NEXT(state, np.array([i in up for i in range(4)]))
        found.append(int(state.mode))
    return found


@pytest.mark.parametrize(
    "start, flags, expected",
    [
        (0, [{SLOW}] * 3, [0, 0, 1]),
        (0, [{SLOW}, {SLOW}, set(), {SLOW}, {SLOW}, {SLOW}], [0, 0, 0, 0, 0, 1]),  # on end
        (0, [{KNOWN, FAULT, FAST}] * 4, [0] * 4),  # rules of other modes do not fire
        (2, [{FAULT}], [1]),
        (2, [{FAULT, FAST}, set()], [1, 1]),
        (2, [{FAST}, {FAST, FAULT}], [2, 1]),  # both are due: the first row wins
        (1, [{KNOWN}, {KNOWN}, {KNOWN}, {FAULT}, {KNOWN}, {KNOWN}, {KNOWN}], [1, 1, 2, 1, 1, 1, 2]),
        (1, [{KNOWN}, {KNOWN, FAST}, {KNOWN, FAST}], [1, 1, 2]),  # due at once: the first row
        (1, [{KNOWN, FAST}, {KNOWN, FAST}, {SLOW}, {SLOW}, {SLOW}, {KNOWN}], [1, 0, 0, 0, 1, 1]),  # counters clear
        (2, [{FAST}, {FAST}, {FAST, SLOW}, {SLOW}, {SLOW}], [2, 0, 0, 0, 1]),
    ],
)
def test_the_modes_change_as_the_rows_say(start, flags, expected):
    assert modes(start, *flags) == expected


def test_the_counts_start_anew_with_every_mode():
    state = first_mode(RULES, 1)
    state = NEXT(state, np.array([False, True, False, True]))
    assert state.counts.tolist() == [0, 1, 0, 1, 0]
    state = NEXT(state, np.array([False, True, False, True]))
    assert int(state.mode) == 0 and state.counts.tolist() == [0] * 5


def test_scenarios_change_their_modes_each_by_itself():
    flags = RNG.uniform(size=(30, 4, 7)) < 0.6

    def run(flags):
        def tick(state, flags):
            state = next_mode(RULES, state, flags)
            return state, state.mode

        return jax.lax.scan(tick, first_mode(RULES, 0), flags)[1]

    together, run = jax.jit(jax.vmap(run, in_axes=-1, out_axes=-1))(flags), jax.jit(run)
    assert set(np.unique(together)) == {0, 1, 2}
    for i in range(7):
        np.testing.assert_array_equal(together[:, i], run(flags[..., i]))


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: first_mode((Rule(0, 0, 0, 1),), 0), r"`rules\[0\].ticks` must be 1 or more, but it is 0"),
        (lambda: first_mode((), 0), "`rules` must hold at least one rule"),
        (lambda: next_mode(RULES, first_mode(RULES, 0), jnp.zeros(3, bool)), "`rules` must name flags from 0 to 2"),
    ],
)
def test_rules_that_cannot_fire_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_guidance_of_many_scenarios_is_that_of_each():
    q = np.array([np.array(unit_quat()) for _ in range(4)]).T
    r, t = RNG.normal(size=(3, 4)), np.array([0.0, 30.0, 200.0, 900.0])

    def one(q, r, t):
        q = Quat.of(q)
        plan = slew(q, turned(q, r), 0.5 * DEG, 2e-4)
        d = Vec3.of(r) / norm(Vec3.of(r))
        return (
            slew_at(plan, t),
            pointed(q, Vec3(0.0, 0.0, 1.0), d),
            nadir(Vec3.of(r), Vec3(0.3, 0.1, 1.0)),
            follow(profile(), t / 100),
        )

    together, one = jax.jit(jax.vmap(one, in_axes=-1, out_axes=-1))(q, r, t), jax.jit(one)
    for i in range(4):
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(one(q[:, i], r[:, i], t[i]))):
            np.testing.assert_allclose(a[i], b, rtol=1e-12, atol=1e-13)

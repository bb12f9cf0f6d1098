"""Linear analysis: matrices, growth rates and margins where they are known in closed form, against runs, observability."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from jaxatt import simulate
from jaxatt.contract import System
from jaxatt.controllers import Adaptation
from jaxatt.delays import delayed, pushed
from jaxatt.linear import _exponential, growth_rates, margins, observability_rank, sampled
from jaxatt.loops import wheel_mrac as wm

jax.config.update("jax_enable_x64", True)

T = 0.1  # [s] of `LATE`
DELAYS = 9


@pytest.mark.parametrize(
    "A", [[[4.0]], [[0.0]], [[0.0, 40.0], [-40.0, 0.0]], [[-1.0, 3.0, 0.5], [0, -2, 1], [0.1, 0, -5]]]
)
def test_the_exponential_is_scipys(A):
    """4 is the hard one: halved to 1 and no further, fifteen terms are not enough."""
    np.testing.assert_allclose(_exponential(np.array(A)), expm(np.array(A)), rtol=2e-14, atol=2e-14)


class X(NamedTuple):
    pos: Any
    vel: Any


def test_growth_rates_of_a_known_loop():
    """x'' = -x - 0.2 x': growth rate -0.1, but for the RK4 step's own error."""
    flow = lambda p, s, t, x, z: X(x.vel, -x.pos - 0.2 * x.vel)
    loop = System(lambda p, s: (X(s, s), ()), lambda p, s, now, x, z, n: (x, z, None), flow, dt=0.01)
    M = sampled(loop, 1.0, 1.0, ticks=5)
    np.testing.assert_allclose(growth_rates(M, 0.05), [-0.1, -0.1], atol=1e-9)


# a double integrator under a PD law whose command arrives late


class Gains(NamedTuple):
    k: Any = 1.0
    c: Any = 1.4
    factor: Any = 1.0


class Held(NamedTuple):
    line: Any  # (DELAYS + 1,) commands
    u: Any


def late_tick(p, delay, now, x, z, noise):
    line = pushed(z.line, -p.factor * (p.k * x.pos + p.c * x.vel))
    return x, Held(line, delayed(line, delay / T)), x.pos


LATE = System(
    lambda p, delay: (X(1.0, 0.0), Held(jnp.zeros(DELAYS + 1), 0.0)),
    late_tick,
    lambda p, delay, t, x, z: X(x.vel, z.u),
    dt=T,
)
PHI, GAMMA = np.array([[1, T], [0, 1]]), np.array([[T * T / 2], [T]])


def late_matrix(ticks, k, c):
    """`LATE` in NumPy: position, velocity, and the commands under way, the latest first."""
    K = np.array([[k, c]])
    if ticks == 0:
        return PHI - GAMMA @ K
    M = np.zeros((2 + ticks, 2 + ticks))
    M[:2, :2], M[:2, -1:], M[2:3, :2] = PHI, GAMMA, -K
    M[3:, 2:-1] = np.eye(ticks - 1)
    return M


@pytest.mark.parametrize("ticks", [0, 1, 7, 9])
def test_what_is_under_way_in_a_delay_line_is_part_of_the_state(ticks):
    M = sampled(LATE, Gains(), ticks * T, ticks=1)
    theirs = np.abs(np.linalg.eigvals(late_matrix(ticks, 1.0, 1.4)))
    ours = np.abs(np.linalg.eigvals(M))
    np.testing.assert_allclose(np.sort(ours)[::-1][: len(theirs)], np.sort(theirs)[::-1], atol=1e-9)
    assert np.all(np.sort(ours)[::-1][len(theirs) :] < 0.05)  # what has left the line: zero, as a multiple root


def test_a_late_loop_is_called_unstable_where_its_run_diverges():
    """Position and rate gain such that six ticks are borne and seven are not."""
    gains = Gains(c=1.55)
    called = [growth_rates(sampled(LATE, gains, d * T, ticks=1), T)[0] for d in range(DELAYS + 1)]
    runs = jax.vmap(lambda d: simulate(LATE, gains, d, jnp.zeros((1200, 0)), ticks=1200))(T * np.arange(DELAYS + 1.0))
    early, late = (np.abs(np.asarray(runs)[:, part]).max(axis=1) for part in (slice(300, 450), slice(1050, 1200)))
    assert (np.array(called) > 0).tolist() == (late > early).tolist()
    assert called[6] < 0 < called[7]


def test_the_wheel_loop_is_called_unstable_where_its_run_diverges():
    """Attitude readings up to ten ticks late, adaptation off: unstable from eight ticks on."""
    params = wm.params._replace(law=Adaptation(gamma=0.0), ope=0.0, a_r=0.4, a_y=-0.1, K=12.0, turn=0.0)
    quiet = wm.scenario._replace(noise=0.0, momentum=3e-3)
    loop, late = wm.system_of(sampled=True, substeps=5), wm.DT * np.arange(wm.DELAYS + 1.0)
    states = ("x.theta", "x.y", "z.sensors.line")
    called = [
        growth_rates(sampled(loop, params, quiet._replace(delay=d), ticks=1, states=states), wm.DT)[0] for d in late
    ]
    run = lambda d: simulate(loop, params, quiet._replace(delay=d), jnp.zeros((1500, 3)), ticks=1500).step
    step = np.abs(np.asarray(jax.vmap(run)(late)))
    diverges = step[:, 1250:].max(axis=1) > step[:, 250:500].max(axis=1)
    assert (np.array(called) > 0).tolist() == diverges.tolist()
    assert called[7] < 0 < called[8]


def test_gain_margins_in_closed_form():
    """PD on a double integrator: up to 2 / (c T). x' = a x - k x: down to a / k, up to a coth(a T / 2) / k."""
    double = margins(lambda factor, delay: sampled(LATE, Gains(factor=factor), delay, ticks=1), T)
    np.testing.assert_allclose(double[:2], [2 / (1.4 * T), 0], rtol=1e-9)
    assert double.delay == double.phase == np.inf and np.isnan(double.crossover)
    a, k = 0.8, 2.0
    single = margins(lambda factor, delay: np.array([[np.exp(a * T) - factor * k * np.expm1(a * T) / a]]), T)
    np.testing.assert_allclose(single[:2], [a / np.tanh(a * T / 2) / k, a / k], rtol=1e-9)


def root(f, a: float, b: float) -> Any:
    """The root of f between a and b (brentq alone is typed as if it may also return a report)."""
    return brentq(f, a, b)


def test_delay_and_phase_margin_are_those_of_the_loops_transfer_function():
    """c is such that the phase margin over the crossover is six ticks, for a line is exact on whole ticks."""

    def crossing(c):
        L = lambda w: (np.array([[1.0, c]]) @ np.linalg.solve(np.exp(1j * w * T) * np.eye(2) - PHI, GAMMA))[0, 0]
        w = root(lambda w: np.abs(L(w)) - 1, 0.5, 10)
        return w, np.pi + np.angle(L(w))

    c = root(lambda c: np.divide(*crossing(c)[::-1]) - 6 * T, 1.4, 3.0)
    found = margins(
        lambda factor, delay: sampled(LATE, Gains(c=c, factor=factor), delay, ticks=1), T, longest=DELAYS * T
    )
    w, phase = crossing(c)
    np.testing.assert_allclose(found[2:], [6 * T, np.degrees(phase), w], rtol=1e-7)


def test_an_unstable_loop_has_no_margins():
    with pytest.raises(
        ValueError, match=r"`matrix_of\(1, 0\)` must be of a stable loop, but it is of one with .* 0.0953"
    ):
        margins(lambda factor, delay: np.array([[1.1]]), 1.0)
    with pytest.raises(ValueError, match="`most` must be greater than 1"):
        margins(lambda factor, delay: np.array([[0.9]]), 1.0, most=1.0)


# what is left out


class Four(NamedTuple):
    pos: Any
    vel: Any
    clock: Any
    bias: Any


def four(back=0.0):
    """A damped oscillator that winds a clock, under a bias that stays; back: of the clock on the oscillator."""
    flow = lambda p, s, t, x, z: Four(x.vel, -x.pos - 0.2 * x.vel + x.bias + back * x.clock, x.pos + z, 0.0)
    return System(lambda p, s: (Four(s, s, s, s), 0.0), lambda p, s, now, x, z, n: (x, x.vel, None), flow, dt=0.01)


def test_what_drifts_by_itself_may_be_left_out():
    whole = growth_rates(sampled(four(), 1.0, 1.0, ticks=1), 0.01)
    np.testing.assert_allclose(whole[:4], [0, 0, -0.1, -0.1], atol=1e-9)
    part = sampled(four(), 1.0, 1.0, ticks=1, states=("x.vel", "x.pos"))
    np.testing.assert_allclose(growth_rates(part, 0.01), [-0.1, -0.1], atol=1e-9)
    assert part[1, 0] == pytest.approx(0.01, rel=0.01)  # in the order asked for: velocity moves position


def test_what_something_comes_back_through_may_not_be_left_out():
    states = ("x.pos", "x.vel")
    with pytest.raises(ValueError, match=r"`states` must hold x.clock too, through which .* comes back"):
        sampled(four(-0.1), 1.0, 1.0, ticks=1, states=states)
    with pytest.raises(ValueError, match=r"`states` must hold z\.line too"):  # over several ticks
        sampled(LATE, Gains(), 7 * T, ticks=1, states=("x",))
    assert np.isnan(jax.jit(lambda s: sampled(four(-0.1), 1.0, s, ticks=1, states=states))(1.0)).all()
    assert sampled(LATE, Gains(), 7 * T, ticks=1, states=("x", "z.line")).shape == (2 + DELAYS + 1,) * 2


@pytest.mark.parametrize(
    "how, words",
    [
        (dict(states=("x.spin",)), r"`states` must hold paths of x.pos, x.vel, z.line, z.u, but it is 'x.spin'"),
        (dict(states="x"), r"`states` must be a tuple of paths, such as \('x.theta', 'z'\), but it is 'x'"),
        (dict(states=()), "`states` must be a tuple of paths"),
        (dict(after=3), "`after` must be a multiple of `ticks` = 2, but it is 3"),
        (dict(ticks=0), "`ticks` must be a whole number of at least 1, but it is 0"),
    ],
)
def test_bad_arguments_are_refused(how, words):
    with pytest.raises(ValueError, match=words):
        sampled(LATE, Gains(), 0.0, **{"ticks": 2, **how})


def test_it_begins_after_the_first_period():
    """At tick 0 this loop does nothing: the matrix is that of a later tick, or of the first one where asked for."""
    tick = lambda p, s, now, x, z, n: (jnp.where(now.k > 0, x / 2, x), z, None)
    loop = System(lambda p, s: (s, ()), tick, lambda p, s, t, x, z: 0.0, dt=1.0)
    found = [sampled(loop, 1.0, 1.0, ticks=1, after=after)[0, 0] for after in (None, 0, 5)]
    assert [float(a) for a in found] == [0.5, 1.0, 0.5]


# observability


def test_observability_of_a_double_integrator():
    A = np.array([[0, 1, 0], [0, 0, 0], [0, 0, 0.0]])
    assert observability_rank(A, np.array([[1.0, 0, 0]]), np.ones(3), duration=10.0) == 2
    assert observability_rank(A, np.array([[0.0, 1, 0]]), np.ones(3), duration=10.0) == 1


@pytest.mark.parametrize("read, rank", [(0, 3), (1, 2), (2, 1)])
def test_a_chain_of_integrators_shows_what_lies_behind_the_reading(read, rank):
    assert observability_rank(np.eye(3, k=1), np.eye(3)[[read]], np.ones(3), duration=3.0) == rank


def test_directions_count_by_their_size():
    """Largest first 1, then 1e-5 and 1e-10 of it: above 1e-8 there are two, whatever the second one is."""
    rank = lambda *scale: observability_rank(np.zeros((3, 3)), np.eye(3), np.array(scale), duration=1.0)
    assert rank(1, 1e-5, 1e-10) == 2
    assert rank(1e-10, 1, 1e-5) == 2
    assert rank(1, 1e-5, 1e-7) == 3

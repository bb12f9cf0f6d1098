"""The satellite that reconfigures itself."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from made_up import repeated, scores_and_last, wide

from benchmarks.microsat import batched
from jaxatt.attitude import quat_from_vector, quat_rotate
from jaxatt.contract import Now
from jaxatt.detection import threshold_quantile
from jaxatt.engine import simulate
from jaxatt.faults import Fault, on_axes
from jaxatt.loops import microsat as ms
from jaxatt.noise import noise_of
from jaxatt.sweeping import sweep
from jaxatt.vec import Quat, Vec3, array, zeros
from jaxatt.wheels import pyramid

DEG = np.pi / 180
KEY = jax.random.key(3)
ONSET = 20.0


SCORE = scores_and_last(ms.score)  # the program of test_loops


def first_wheel(**what):
    return ms.WheelFault(onset=np.array([ONSET, np.inf, np.inf, np.inf]), **what)


def about(axis, fault):
    return Vec3(*(fault if i == axis else Fault() for i in range(3)))


FAULTS = [
    dict(wheel=first_wheel(drive=0.0)),
    dict(wheel=first_wheel(wear=5.0)),
    dict(gyro=about(1, Fault(ONSET, bias=0.2 * DEG))),
    dict(gyro=on_axes(Fault(ONSET, scale=0.0))),
    dict(star=about(2, Fault(ONSET, bias=1 * DEG))),
    dict(box=Fault(ONSET, stuck=1.0)),
    dict(box=Fault(ONSET, 40.0, missing=1.0)),
    {},
]
TICKS = 600
PARAMS = ms.params._replace(judged=50.0)
T0 = 350.0 * np.arange(16)  # [s] along the orbit, its shadow included


@pytest.fixture(scope="module")
def found():
    """Scores of every fault on sixteen noises, acting and not: (2, faults, 16)."""
    one = [wide(ms.scenario._replace(**fault)) for fault in FAULTS]
    stacked = jax.tree.map(lambda *a: np.repeat(np.stack([np.asarray(x) for x in a]), 16, axis=0), *one)
    stacked = stacked._replace(t0=T0[np.arange(len(FAULTS) * 16) % 16])
    runs = [
        sweep(ms.system, PARAMS, stacked._replace(act=np.full(len(stacked.t0), act)), KEY, ticks=TICKS, score=SCORE)[0]
        for act in (1.0, 0.0)
    ]
    return jax.tree.map(lambda *a: np.stack(a).reshape(2, len(FAULTS), 16, *a[0].shape[1:]), *runs)


def test_every_run_is_finite(found):
    assert found.ok.all()


def test_the_filter_is_consistent(found):
    n = 16 * 200  # star samples after 10 s, without a fault
    assert abs(found.nis[0, 7].mean() - 1) < 4 * np.sqrt(2 / (3 * n))
    assert abs(found.nees[0, 7].mean() - 1) < 4 * np.sqrt(2 / (6 * 16))


def test_healthy_runs_are_those_of_an_independent_program(found):
    """Batched NumPy, written apart from the parts and their filter, on the same normal numbers."""
    noise = np.stack([noise_of(ms.system, KEY, 7 * 16 + i, TICKS) for i in range(16)], axis=1)
    days = repeated(ms.scenario, 16)._replace(t0=T0)
    pointing, knowledge, _, nis = batched(days, TICKS, lambda k: noise[k]).swapaxes(0, 1)
    np.testing.assert_allclose(np.sqrt(np.mean(pointing[500:] ** 2, axis=0)), found.last[0, 7], rtol=1e-6)
    count = (nis[100:] > 0).sum(0)
    np.testing.assert_allclose(nis[100:].sum(0) / 3 / count, found.nis[0, 7], rtol=1e-6)
    assert np.sqrt(np.mean(knowledge[100:] ** 2)) < 0.02 * DEG


def test_a_healthy_run_and_an_outage_blame_nobody(found):
    for case in (6, 7):
        for alarm in (found.wheel_alarm, found.star_alarm, found.gyro_alarm):
            assert np.isinf(alarm[:, case]).all()
    assert found.last[0, 6].max() < 0.1 * DEG  # the gyro bears twenty seconds without stars


@pytest.mark.parametrize("case, unit", [(0, "wheel"), (1, "wheel"), (2, "gyro"), (3, "gyro"), (4, "star"), (5, "star")])
def test_a_fault_is_found_and_the_right_unit_blamed(found, case, unit):
    alarms = dict(
        wheel=found.wheel_alarm[0, case, :, 0], gyro=found.gyro_alarm[0, case], star=found.star_alarm[0, case]
    )
    assert (alarms[unit] >= ONSET).all() and (alarms[unit] <= ONSET + 5).all()
    for other in alarms.keys() - {unit}:
        assert np.isinf(alarms[other]).all(), other
    assert np.isinf(found.wheel_alarm[0, case, :, 1:]).all()


@pytest.mark.parametrize("case", [0, 2, 3, 4, 5])
def test_reconfiguration_keeps_the_pointing_that_is_lost_without(found, case):
    assert np.median(found.last[0, case]) < 0.2 * DEG
    assert np.median(found.last[1, case]) > 3 * np.median(found.last[0, case])


def test_a_wheel_that_follows_its_drive_is_kept_and_a_dead_one_left_out(found):
    """The drive's error of a wheel with friction comes to rest, that of a dead one grows."""
    assert np.isinf(found.wheel_out[:, 1:]).all()
    out = found.wheel_out[0, 0]
    assert np.isinf(out[:, 1:]).all()
    grace = ms.params.limits.grace
    assert (out[:, 0] >= found.wheel_alarm[0, 0, :, 0] + grace).all() and (out[:, 0] <= ONSET + grace + 3).all()


def test_without_grace_a_wheel_leaves_at_its_alarm():
    computer, y = started()
    computer = computer._replace(wheel=ms.Cusum(jnp.array([9.0, 0, 7, 0]), jnp.array([0, 0, 0, 11.0])))
    y = y._replace(tacho=y.tacho._replace(value=computer.tacho))

    @jax.jit
    def after(computer, grace, moved):
        limits = ms.params.limits._replace(grace=grace, moved=moved)
        return ms.wheel_residual(ms.params._replace(limits=limits), ms_now(200), computer, y)[0]

    first = after(computer, 0.0, 0.0)
    assert first.verdict.in_use.tolist() == [1, 1, 1, 0] and first.verdict.suspect.tolist() == [False] * 3 + [True]
    second = after(first, 0.0, 0.0).verdict
    assert second.suspect.tolist() == [True, False, False, True]
    assert second.in_use.tolist() == [1, 1, 1, 0]  # three wheels must remain
    shipped = after(computer, ms.params.limits.grace, ms.params.limits.moved).verdict
    assert shipped.in_use.tolist() == [1, 1, 1, 1] and shipped.suspect.tolist() == [False] * 3 + [True]


def test_who_does_not_act_leaves_nothing_out_but_says_so(found):
    assert np.isfinite(found.wheel_alarm[1, 0, :, 0]).all() and np.isfinite(found.gyro_alarm[1, 2]).all()


def test_the_wheels_are_a_pyramid():
    np.testing.assert_allclose(np.stack(ms.AXES).T, np.array(pyramid(54.7356 * DEG)), atol=1e-15)


def test_thresholds_of_the_cross_check_are_quantiles():
    np.testing.assert_allclose(ms.CROSS, threshold_quantile(1e-8, np.arange(3.0, 25, 3)), rtol=1e-7)


def test_momentum_of_body_and_wheels_is_conserved_without_outer_torque():
    """(A (J w + W h))' = 0 in inertial axes, whatever the wheels do."""
    quiet = zeros(), jnp.array([1e-2, -5e-3, 8e-3, 2e-3])
    x = ms.X(Quat(1.0, 0.0, 0.0, 0.0), Vec3(0.02, -0.05, 0.07), jnp.array([0.1, -0.2, 0.15, 0.05]), zeros())
    x = jax.tree.map(jnp.asarray, x)
    z = ms.Z(None, None, quiet[1], quiet[0])  # pyright: ignore[reportArgumentType]

    def momentum(x):
        total = Vec3(*(jnp.sum(a * x.h) for a in ms.scenario.axes))
        return array(quat_rotate(x.q, ms.scenario.J @ x.w + total))

    rate = jax.jit(lambda x: jax.jvp(momentum, (x,), (ms.flow(ms.params, ms.scenario, 0.0, x, z),))[1])(x)
    np.testing.assert_allclose(rate, 0, atol=1e-15)


def test_a_late_sample_updates_the_attitude_of_its_exposure():
    """With a latency of one tick the filter is as good as with two: it knows when the sample was taken."""
    scenarios = repeated(wide(ms.scenario), 128)._replace(latency=np.repeat([1, 2], 64))
    found = sweep(ms.system, ms.params, scenarios, KEY, ticks=TICKS, score=SCORE)[0]
    nees = found.nees.reshape(2, 64).mean(1)
    assert (abs(nees - 1) < 4 * np.sqrt(2 / (6 * 64))).all(), nees


@cache
def started():
    """Computer and readings at the start."""
    z = begun(zeros())[1]
    return z.computer, z.sensors.readings


@jax.jit
def begun(turn):
    return ms.init(ms.params, ms.scenario._replace(turn=turn))


@jax.jit
def judged(computer, witness, arbiter, cross, sun, field):
    params = ms.params._replace(limits=ms.params.limits._replace(witness=witness, arbiter=arbiter))
    return ms.judge(
        params, ms_now(200), computer, ms.Sample(jnp.asarray(True), jnp.asarray(3.0), cross, sun, field)
    ).verdict


def verdict(
    rejected=0.0,
    guilty=np.inf,
    nis=3.0,
    cross=0.0,
    gyro_out=False,
    witness=1.0,
    arbiter=1.0,
    sun=2.0,
    field=2.0,
    odd=(0, 0),
):
    """Who is blamed, in words, from what the detectors say."""
    computer, _ = started()
    computer = computer._replace(rejected=jnp.asarray(rejected), guilty=jnp.asarray(guilty), nis=jnp.full(20, nis))
    computer = computer._replace(
        verdict=computer.verdict._replace(gyro_out=jnp.asarray(gyro_out)), odd=jnp.asarray(odd, float)
    )
    out = judged(computer, witness, arbiter, cross, sun, field)
    return " ".join(unit for unit in ("star", "gyro", "sun", "field") if getattr(out, f"{unit}_out"))


def ms_now(k):
    return Now(jnp.asarray(k), k * ms.DT, ms.DT)


@pytest.mark.parametrize(
    "said, blamed",
    [
        ({}, ""),
        (dict(cross=1.5), "star"),  # the sample disagrees with Sun and field
        (dict(rejected=4.0), ""),  # strange, but nobody is guilty yet
        (dict(rejected=4.0, guilty=10.0), "gyro"),
        (dict(rejected=8.0), "star"),  # by elimination
        (dict(nis=8.0), "star"),
        (dict(nis=8.0, guilty=10.0), "gyro"),
        (dict(rejected=4.0, witness=0.0), "gyro"),  # the first logic blames the gyro
        (dict(cross=1.5, gyro_out=True), "star"),  # the gyro was blamed for what the star tracker did
        (dict(cross=1.5, field=0.5), ""),  # the Sun alone disagrees: not yet for long
        (dict(cross=1.5, field=0.5, odd=(19, 0)), "sun"),
        (dict(cross=1.5, sun=0.5, odd=(0, 19)), "field"),
        (dict(cross=1.5, sun=0.5, odd=(19, 0)), ""),  # the other one began to disagree
        (dict(cross=1.5, field=0.5, rejected=4.0), "star"),  # strange innovations: the star tracker has jumped
        (dict(cross=1.5, field=0.5, guilty=10.0), "star"),  # the filter's bias has followed it
        (dict(cross=1.5, sun=0.5, guilty=10.0, odd=(0, 19)), "field"),  # torquers in a wrong field
        (dict(cross=1.5, sun=np.inf, field=2.0), ""),  # one against one, in the Earth's shadow: wait
        (dict(cross=1.5, sun=np.inf, field=2.0, rejected=4.0), "star"),
        (dict(cross=1.5, field=0.5, arbiter=0.0), "star"),  # the first logic blames the star tracker
    ],
)
def test_verdicts(said, blamed):
    assert verdict(**said) == blamed


@pytest.mark.parametrize("latency", [3.0, 1.5, 0.5])
def test_a_latency_that_the_clone_cannot_bear_is_refused(latency):
    with pytest.raises(ValueError, match=rf"scenario.latency.*from 1 to 2 ticks, but it is {latency:g}"):
        simulate(ms.system, ms.params, ms.scenario._replace(latency=latency), KEY, ticks=1)


def test_a_table_that_is_too_short_is_refused():
    with pytest.raises(ValueError, match=r"params.table.*must reach"):
        simulate(ms.system, ms.params, ms.scenario._replace(t0=1e5), KEY, ticks=1)


def test_a_table_shorter_than_the_run_is_refused():
    """It reaches to 12 690 s; the last of so many ticks is one tick later, in the second scenario."""
    late = repeated(ms.scenario, 2)._replace(t0=np.array([0.0, 12_000.0]))
    with pytest.raises(
        ValueError, match=r"`params\.table` must reach from 0 s to 12690\.1 s .* good from 0 s to 12690 s"
    ):
        sweep(ms.system, ms.params, late, KEY, ticks=6902, score=ms.score)
    with pytest.raises(ValueError, match=r"`params\.table` must reach"):
        simulate(ms.system, ms.params, ms.scenario._replace(t0=12_000.0), KEY, ticks=6902)


def test_wheels_of_which_three_lie_in_a_plane_are_refused():
    """The law inverts W W' of the wheels in use, which may be any three."""
    half = np.sqrt(0.5)
    axes = Vec3(np.array([1.0, 0, 0, half]), np.array([0, 1.0, 0, half]), np.array([0, 0, 1.0, 0]))
    with pytest.raises(ValueError, match=r"params\.axes without wheel 2` must span space"):
        simulate(ms.system, ms.params._replace(axes=axes), ms.scenario, KEY, ticks=1)


def test_the_first_error_of_the_filter_is_the_scenarios_turn():
    turn = Vec3(1e-3, -2e-3, 5e-4)
    x, z = begun(turn)
    off = x.q * quat_from_vector(-turn)
    np.testing.assert_allclose(array(z.computer.belief.q), array(off), atol=1e-12)

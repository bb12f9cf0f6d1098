"""What the study of star_isolation rests on: a surrogate that means what the loop does, bounds, seeds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.tuning import star_isolation as stars
from jaxatt import detection, simulate, soft_scores
from jaxatt.loops import star_isolation as si

RUNS = 5
NUMBERS = 4.0, 4.0, 2e-6  # window, margin, believed gyro noise


@pytest.fixture(scope="module")
def flown():
    """What the loop itself does with `NUMBERS`: its verdicts, and its readings as the study takes them."""
    scenarios, faulty = stars.world(RUNS, 3)
    params = si.params._replace(threshold=float(stars.threshold_of(*NUMBERS[:2])), std_gyro=NUMBERS[2])
    keys = jax.random.split(jax.random.key(3), RUNS)
    one = lambda scenario, key: simulate(si.system_of(window=4), params, scenario, key, ticks=stars.END)
    log = jax.jit(jax.vmap(one))(scenarios, keys)
    return log.verdict, stars.Recorded(log.readings, scenarios.q_hat, faulty)


@pytest.fixture(scope="module")
def surrogate(flown):
    """(a, temperature) -> cost, its slope in a, and the hard terms; all three numbers move with a from `NUMBERS`."""

    @jax.jit
    def along(a, temperature):
        def cost(a):
            window, margin, std_gyro = NUMBERS
            numbers = (window + 0.3 * jnp.sin(a), margin * jnp.exp(-a), std_gyro * jnp.exp(2 * a))
            J, threshold = stars.evaluated(numbers, flown[1]), stars.threshold_of(*numbers[:2])
            soft, hard = (
                stars.terms_of(p, flown[1].faulty)
                for p in (soft_scores.soft_alarm(J, threshold, temperature), 1.0 * (threshold < J))
            )
            return jnp.mean(stars.cost_of(*soft)), hard

        return jax.jvp(cost, (a,), (1.0,), has_aux=True)

    return along


def test_a_fault_lies_across_the_boresight_of_one_star_sensor():
    scenarios, faulty = stars.world(200, 3)
    bias = np.stack([axis.bias.T for axis in scenarios.star])  # (axis, sensor, run)
    assert 50 < faulty.sum() < 150
    assert np.all(bias[stars.ROLL, stars.ROLL] == 0) and np.all(bias[1, stars.PITCH] == 0)
    own = np.take_along_axis(bias, faulty[None, None], axis=1)[:, 0]
    size = np.sqrt((own**2).sum(axis=0)) / si.params.std_star
    assert np.all((size >= 2) & (size <= 5)) and np.all(np.take_along_axis(bias, 1 - faulty[None, None], axis=1) == 0)
    assert 0 < np.mean(own.sum(axis=0) > 0) < 1


def test_the_hard_cost_is_what_the_loop_itself_does(flown, surrogate):
    verdict, data = flown
    _, _, (delay, false) = surrogate(0.0, 1.0)
    alarms = np.asarray(verdict.alarm)
    for i in range(RUNS):
        own, other = alarms[i, :, data.faulty[i]], alarms[i, :, 1 - data.faulty[i]]
        found = own[stars.ONSET :]
        waited = stars.DT * (np.argmax(found) + 1 if found.any() else len(found))
        assert delay[i] == pytest.approx(waited)
        quiet = np.concatenate([own[stars.SETTLED + 1 : stars.ONSET], other[stars.SETTLED + 1 :]])
        assert false[i] == pytest.approx(quiet.mean(), abs=1e-12)
    assert len(set(np.asarray(delay))) > 1 and false.sum() > 0  # or nothing was compared


def test_the_surrogate_becomes_the_hard_cost_and_its_slope_is_exact(surrogate):
    off_the_kink = 0.5  # the surrogate is linear in the window between whole numbers
    h, value = 1e-4, lambda a: surrogate(off_the_kink + a, stars.TEMPERATURE)[0]
    central = (8 * (value(h) - value(-h)) - (value(2 * h) - value(-2 * h))) / (12 * h)
    assert float(surrogate(off_the_kink, stars.TEMPERATURE)[1]) == pytest.approx(float(central), rel=1e-5)
    _, _, hard = surrogate(0.0, 1.0)
    hard = float(jnp.mean(stars.cost_of(*hard)))
    assert abs(surrogate(0.0, 1e-3)[0] / hard - 1) < 0.01 < abs(surrogate(0.0, 1.0)[0] / hard - 1)


def test_the_margin_counts_deviations_of_the_windowed_statistic():
    assert float(stars.threshold_of(*stars.RULES["paper (3 sigma, N = 1)"][:2])) == pytest.approx(27)
    assert float(stars.threshold_of(10.0, 5.0)) == pytest.approx(float(detection.threshold_moment(5, 30)))


def test_the_studys_seeds_differ():
    assert len({stars.TUNE, stars.CHOOSE, stars.JUDGE}) == 3

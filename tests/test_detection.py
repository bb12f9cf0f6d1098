"""Windows, thresholds, causes and surrogates of detection."""

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
from scipy import stats  # noqa: E402
from slopes import slopes  # noqa: E402

from jaxatt import detection, soft_scores  # noqa: E402

RNG = np.random.default_rng(0)


def test_a_window_sums_the_last_values():
    J = RNG.chisquare(3, (50, 2, 4))
    plain = np.array([J[max(0, k - 6) : k + 1].sum(axis=0) for k in range(50)])
    np.testing.assert_allclose(detection.windowed(J, 7), plain, rtol=1e-14)
    np.testing.assert_allclose(soft_scores.soft_windowed(J, 7.0, 12), plain, rtol=1e-13)
    between = 0.5 * (detection.windowed(J, 7) + detection.windowed(J, 8))
    np.testing.assert_allclose(soft_scores.soft_windowed(J, 7.5, 12), between, rtol=1e-13)


def test_the_window_on_board_is_that_of_the_whole_run():
    J = RNG.chisquare(3, (20, 2))
    _, sums = jax.lax.scan(detection.window_sum, jnp.zeros((7, 2)), jnp.asarray(J))
    np.testing.assert_allclose(sums, detection.windowed(J, 7), rtol=1e-14)


@pytest.mark.parametrize("n", [0, -1, 1.5])
def test_a_window_of_no_length_is_refused(n):
    with pytest.raises(ValueError, match="`n` must be a whole number of at least 1"):
        detection.windowed(np.zeros((5, 2)), n)


def test_thresholds_are_those_of_the_table():
    assert detection.threshold_nsigma(3, 3) == 27 and detection.threshold_nsigma(3, 30) == 270
    assert detection.threshold_mean(5, 3) == 15
    np.testing.assert_allclose(detection.threshold_moment(jnp.array([3, 5]), 3), [10.35, 15.25], atol=5e-3)


def test_the_quantile_is_that_of_scipy():
    p, dof = np.meshgrid([0.5, 1e-2, 1e-5, 1e-9, 1e-100, 1e-290], [0.1, 1, 2, 3, 30, 300, 1e5])
    np.testing.assert_allclose(detection.threshold_quantile(p, dof), stats.chi2.isf(p, dof), rtol=1e-9)


@pytest.mark.parametrize(
    "p, dof, word", [(0.0, 3, "false_alarm"), (1.0, 3, "false_alarm"), (0.1, -1, "dof"), (0.1, 1e30, "dof")]
)
def test_a_quantile_of_nothing_is_refused(p, dof, word):
    with pytest.raises(ValueError, match=f"`{word}` must"):
        detection.threshold_quantile(p, dof)


def test_nan_alarms():
    assert detection.alarm(jnp.array([1.0, 28.0, np.nan]), 27.0).tolist() == [False, True, True]


def test_causes():
    first, second = jnp.array([0, 1, 0, 1], bool), jnp.array([0, 0, 1, 1], bool)
    assert detection.isolate(first, second).tolist() == [0, 1, 2, 3]
    times = jnp.array([np.inf, 3.0, 8.0, 3.0]), jnp.array([np.inf, np.inf, 3.0, 5.0])
    assert detection.isolate_first(*times, 1.0).tolist() == [0, 1, 2, 1]
    assert detection.isolate_first(*times, 5.0).tolist() == [0, 1, 3, 3]


def test_soft_delay_is_the_delay_where_alarms_are_certain():
    p = np.zeros((20, 3))
    p[[0, 7], [0, 1]] = 1.0
    np.testing.assert_allclose(soft_scores.soft_delay(jnp.asarray(p), 0.1), [0.1, 0.8, 2.0], rtol=1e-12)


@pytest.mark.slow
def test_surrogates_have_the_gradient_of_central_differences():
    J = jnp.asarray(RNG.chisquare(3, (40, 5)) * np.linspace(1, 6, 40)[:, None])

    def cost(theta):
        p = soft_scores.soft_alarm(soft_scores.soft_windowed(J, theta[0], 8), theta[1], 2.0)
        return jnp.mean(soft_scores.soft_delay(p, 0.1)) + 30 * jnp.mean(p[:10])

    at = jnp.array([3.4, 25.0])
    for i in range(2):
        h = 1e-5 * jnp.eye(2)[i]
        assert jax.grad(cost)(at)[i] == pytest.approx(float(cost(at + h) - cost(at - h)) / 2e-5, rel=1e-6)
    certain = jax.grad(lambda p: jnp.sum(soft_scores.soft_delay(p, 0.1)))(jnp.ones((4, 2)))
    assert np.isfinite(certain).all()


def test_the_worst_channel_is_one_and_only_above_the_threshold():
    above = lambda *statistic: detection.worst_above(jnp.array(statistic), 40.0).tolist()
    assert above(1.0, 2.0, 0.0) == [False, False, False]
    assert above(50.0, 60.0, 10.0) == [False, True, False]
    assert above(60.0, 60.0, 10.0) == [True, False, False]  # of equals, the first


def test_smoothed_noise_is_chi_square():
    z = np.random.default_rng(0).normal(size=200_000)
    m = jax.lax.scan(lambda m, z: ((n := detection.smoothed(m, z, 0.25)), n), 0.0, jnp.asarray(z))[1]
    c = np.asarray(detection.chi_square(m, 0.25))[100:]
    np.testing.assert_allclose([c.mean(), (c > 3.841).mean()], [1, 0.05], rtol=0.05)


def test_a_statistic_that_is_no_number_is_above_any_threshold():
    np.testing.assert_array_equal(detection.worst_above(jnp.array([1.0, np.nan, 9.0]), 5.0), [False, True, False])


# sequential detectors


def run(step, state, values, *rest):
    """What a detector says of values (T,), one after another."""

    def tick(state, value):
        state, *said = step(state, value, *rest)
        return state, said

    return jax.lax.scan(tick, state, jnp.asarray(values))[1]


ZERO = detection.Cusum(jnp.zeros(()), jnp.zeros(()))


def test_cusum_is_pages_recursion_on_both_sides():
    x = np.random.default_rng(9).normal(size=300) + np.repeat([0, 1.5, -1.5], 100)
    up = down = 0.0
    plain = []
    for value in x:
        up, down = max(0.0, up + value - 0.5), max(0.0, down - value - 0.5)
        plain.append(max(up, down))
    np.testing.assert_allclose(run(detection.cusum, ZERO, x, 0.5)[0], plain, rtol=1e-12, atol=1e-12)
    assert plain[99] < 10 < plain[199] and plain[299] > 30  # a shift of either sign is seen


def test_cusum_alarms_as_often_and_as_late_as_theory_says():
    """1000 runs to the first alarm at 5: the mean is 465.4 without a shift, 10.38 with one of 1; four standard errors."""
    for shift, ticks, expected in ((0.0, 6000, 465.444), (1.0, 100, 10.376)):

        def one(key, shift=shift, ticks=ticks):
            def tick(carry, x):
                state, length, going = carry
                state, g = detection.cusum(state, x + shift, 0.5)
                return (state, length + going, going & (g <= 5.0)), None

            x = jax.random.normal(key, (ticks,))
            return jax.lax.scan(tick, (ZERO, 0, True), x)[0][1]

        lengths = np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(4), 1000)))
        assert (lengths < ticks).mean() > 0.999
        assert abs(lengths.mean() - expected) < 4 * lengths.std() / np.sqrt(1000)


def test_colour_decides_on_the_alarms_of_cusum():
    """Differenced white noise never gets far, AR(1) noise of .5 alarms nine times as often as white: 53 against 465."""
    z = np.random.default_rng(5).normal(size=(2001, 300))
    reset = lambda state, g: jax.tree.map(lambda a: jnp.where(g > 5, 0.0, a), state)

    def alarms(x):
        def tick(state, value):
            state, g = detection.cusum(state, value, 0.5)
            return reset(state, g), g > 5

        start = detection.Cusum(jnp.zeros(300), jnp.zeros(300))
        return int(jax.lax.scan(tick, start, jnp.asarray(x))[1].sum())

    coloured = np.zeros((2001, 300))
    for k in range(1, 2001):
        coloured[k] = 0.5 * coloured[k - 1] + np.sqrt(0.75) * z[k]
    assert alarms(np.diff(z, axis=0) / np.sqrt(2)) == 0
    assert 600_000 / alarms(coloured[1:]) == pytest.approx(53, rel=0.05)
    assert 600_000 / alarms(z[1:]) == pytest.approx(465, rel=0.15)


def test_glr_is_the_best_of_all_jumps():
    x = np.random.default_rng(8).normal(size=60) + 8.0 * (np.arange(60) >= 45)
    M = 20
    statistic, ago = run(detection.glr, jnp.zeros(M), x)
    for k in range(60):
        tails = [x[max(0, k + 1 - m) : k + 1].sum() for m in range(1, M + 1)]
        ratios = np.square(tails) / (2 * np.arange(1, M + 1))
        assert statistic[k] == pytest.approx(ratios.max(), rel=1e-12) and ago[k] == 1 + ratios.argmax()
    # the log-likelihood ratio itself: the best constant mean of the last m values against none
    m = int(ago[59])
    late = x[60 - m :]
    ratio = stats.norm.logpdf(late, late.mean()).sum() - stats.norm.logpdf(late).sum()
    assert statistic[59] == pytest.approx(ratio, rel=1e-9) and m == 15


@pytest.mark.slow
@pytest.mark.parametrize("threshold, length", [(5.414, 297.0), (8.0, 3400.0)])
def test_the_run_length_of_glr_is_not_that_of_its_quantile(threshold, length):
    def one(key):
        def tick(carry, x):
            sums, n, going = carry
            sums, g, _ = detection.glr(sums, x)
            return (sums, n + going, going & (g <= threshold)), None

        return jax.lax.scan(tick, (jnp.zeros(20), 0, True), jax.random.normal(key, (int(8 * length),)))[0][1]

    n = 2000 if length < 1000 else 300
    lengths = np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(6), n)))
    assert lengths.mean() == pytest.approx(length, rel=0.03 + 4 / np.sqrt(n))


def test_the_run_length_of_a_chi_square_window_is_not_that_of_its_quantile():
    """Ten NIS of 3 degrees: 59.70 is exceeded with probability 1e-3, yet alarms from a full window come 2470 apart."""
    threshold = float(detection.threshold_quantile(1e-3, 30))
    assert threshold == pytest.approx(59.70, abs=5e-3)

    def one(key):
        def tick(carry, x):
            recent, n, going = carry
            recent, total = detection.window_sum(recent, x)
            return (recent, n + going, going & (total <= threshold)), None

        nis = jnp.square(jax.random.normal(key, (20_000, 3))).sum(-1)
        return jax.lax.scan(tick, (jnp.zeros(10), 0, True), nis)[0][1]

    lengths = np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(7), 300)))
    assert abs(lengths.mean() - 2470) < 4 * lengths.std() / np.sqrt(300)


def test_persistence_counts_up_and_down_between_its_ends():
    count, counts = jnp.asarray(0), []
    for up in (1, 1, 0, 1, 1, 1, 1, 0, 0, 0, 0, 0):
        count = detection.persistence(count, bool(up), 4)
        counts.append(int(count))
    assert counts == [1, 2, 1, 2, 3, 4, 4, 3, 2, 1, 0, 0]


def test_a_missing_value_is_not_fed():
    state = detection.Cusum(2.0, 1.0)
    for value, valid in ((np.nan, True), (7.0, False), (np.nan, False)):
        kept, g = detection.cusum(state, value, 0.5, valid)
        assert kept == state and g == 2
        sums, g, ago = detection.glr(jnp.array([1.0, 3.0]), value, valid)
        assert sums.tolist() == [1, 3] and g == pytest.approx(9 / 4) and ago == 2
    assert int(detection.persistence(3, True, 8, False)) == 3


def test_gradients_of_the_detectors_are_those_of_central_differences():
    x = jnp.asarray(RNG.normal(size=30) + 0.7)
    costs = [
        lambda s: jnp.sum(run(lambda c, v: detection.cusum(c, s[0] * v + s[1], s[2]), ZERO, x)[0]),
        lambda s: jnp.sum(run(lambda c, v: detection.glr(c, s[0] * v + s[1]), jnp.zeros(5), x)[0]),
    ]
    for cost in costs:
        found, central = slopes(cost, [1.3, 0.2, 0.4])
        np.testing.assert_allclose(found, central, rtol=1e-6, atol=1e-6)
    gradient = jax.grad(lambda v: detection.cusum(detection.Cusum(1.0, 1.0), v, 0.5)[1])
    assert gradient(np.nan) == 0 and gradient(jnp.float32(np.nan)) == 0


def test_detectors_take_scenarios_behind_their_own_axes():
    x = RNG.normal(size=(9, 4))
    lanes = jax.vmap(lambda x: run(detection.glr, jnp.zeros(5), x), in_axes=-1, out_axes=-1)(x)
    for i in range(4):
        for a, b in zip(lanes, run(detection.glr, jnp.zeros(5), x[:, i])):
            np.testing.assert_allclose(a[:, i], b, rtol=1e-14)
    g = jax.vmap(lambda x: run(detection.cusum, ZERO, x, 0.5)[0], in_axes=-1, out_axes=-1)(x)
    np.testing.assert_allclose(g[:, 2], run(detection.cusum, ZERO, x[:, 2], 0.5)[0], rtol=1e-14)

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxatt import scores
from jaxatt.contract import Now

VALUES = np.random.default_rng(3).normal(size=40)
INSIDE = np.arange(40) % 3 == 0


def total(tally_of, ticks=range(40)):
    tallies = [tally_of(Now(k, 0.5 * k, 0.5), VALUES[k], INSIDE[k]) for k in ticks]
    sum_ = scores.empty(jax.tree.map(jnp.asarray, tallies[0]))
    for tally in tallies:
        sum_ = scores.add(sum_, tally)
    return float(scores.values(sum_))


def crossed(values, threshold, since):
    """Time from tick ``since`` to where the line through the ticks' values first rises above the threshold."""
    k = since + np.argmax(values[since:] > threshold)
    if k == since:
        return 0.0
    before = values[k - 1]
    return 0.5 * (k - 1 + (threshold - before) / (values[k] - before) - since)


@pytest.mark.parametrize(
    ("tally_of", "expected"),
    [
        (lambda now, v, i: scores.mean(v), VALUES.mean()),
        (lambda now, v, i: scores.mean(v, i), VALUES[INSIDE].mean()),
        (lambda now, v, i: scores.mean(v > 0, i), (VALUES[INSIDE] > 0).mean()),
        (lambda now, v, i: scores.rms(v * v, i), np.sqrt((VALUES[INSIDE] ** 2).mean())),
        (lambda now, v, i: scores.peak(v), VALUES.max()),
        (lambda now, v, i: scores.peak(v, i), VALUES[INSIDE].max()),
        (lambda now, v, i: scores.first(now, v > 1), 0.5 * np.argmax(VALUES > 1)),
        (lambda now, v, i: scores.first(now, v > 1, since=2.0), 0.5 * np.argmax(VALUES > 1) - 2),
        (lambda now, v, i: scores.settling(now, v > 1), 0.5 * np.max(np.flatnonzero(VALUES > 1))),
        (lambda now, v, i: scores.final(v), VALUES[-1]),
        (lambda now, v, i: scores.always(v < 9), 1),
        (lambda now, v, i: scores.always(v < 0), 0),
        (lambda now, v, i: scores.span(v), np.ptp(VALUES)),
        (lambda now, v, i: scores.span(v, i), np.ptp(VALUES[INSIDE])),
        (lambda now, v, i: scores.total(v), VALUES.sum()),
        (lambda now, v, i: scores.total(v, i), VALUES[INSIDE].sum()),
        (lambda now, v, i: scores.peak_time(now, v), 0.5 * np.argmax(VALUES)),
        (lambda now, v, i: scores.peak_time(now, jnp.minimum(v, 1)), 0.5 * np.argmax(VALUES >= 1)),
        (lambda now, v, i: scores.margin(v, 2.5), 2.5 - VALUES.max()),
        (lambda now, v, i: scores.margin(v, 0.0, i), -VALUES[INSIDE].max()),
        (lambda now, v, i: scores.alarm_time(now, v, 1.0), crossed(VALUES, 1.0, 0)),
        (lambda now, v, i: scores.alarm_time(now, v, 0.3, 12.0), crossed(VALUES, 0.3, 24)),
        (lambda now, v, i: scores.alarm_time(now, v, 0.5, 10.5), crossed(VALUES, 0.5, 21)),
        (lambda now, v, i: scores.alarm_time(now, v, -9.0, 2.0), 0.0),
        (lambda now, v, i: scores.alarm_time(now, v, 9.0), np.inf),
    ],
)
def test_tallies_add_up_to_the_statistics_of_the_run(tally_of, expected):
    assert total(tally_of) == pytest.approx(expected, rel=1e-12)


def test_empty_windows_are_nan_never_is_inf():
    never = np.False_
    assert np.isnan(total(lambda now, v, i: scores.mean(v, never)))
    assert np.isnan(total(lambda now, v, i: scores.rms(v, never)))
    assert np.isnan(total(lambda now, v, i: scores.peak(v, never)))
    assert np.isnan(total(lambda now, v, i: scores.settling(now, v > 1, never)))
    assert np.isnan(total(lambda now, v, i: scores.span(v, never)))
    assert np.isnan(total(lambda now, v, i: scores.margin(v, 1, never)))
    assert total(lambda now, v, i: scores.alarm_time(now, v, -9, since=99)) == np.inf
    assert total(lambda now, v, i: scores.total(v, never)) == 0
    assert total(lambda now, v, i: scores.first(now, never)) == np.inf
    assert total(lambda now, v, i: scores.settling(now, never)) == 0
    assert total(lambda now, v, i: scores.settling(now, np.True_)) == np.inf


def test_nan_does_not_hide():
    bad = lambda now, v: jnp.where(now.k == 7, jnp.nan, v)
    assert np.isnan(total(lambda now, v, i: scores.mean(bad(now, v))))
    assert np.isnan(total(lambda now, v, i: scores.rms(bad(now, v))))
    assert np.isnan(total(lambda now, v, i: scores.peak(bad(now, v))))
    assert total(lambda now, v, i: scores.always(scores.finite({"a": bad(now, v), "b": 1.0}))) == 0


def test_gradient_of_an_rms_at_zero_is_finite():
    assert np.isfinite(jax.grad(lambda a: scores.values(scores.rms(a * a)))(0.0))


def test_an_empty_tally_adds_nothing_and_keeps_shapes_and_types():
    tally = scores.mean(jnp.ones((2, 3), jnp.float32), True)
    empty = scores.empty(tally)
    assert jax.tree.map(lambda a: (a.shape, a.dtype), empty) == jax.tree.map(lambda a: (a.shape, a.dtype), tally)
    for a, b in zip(scores.add(empty, tally), tally):
        np.testing.assert_array_equal(a, b)


def test_a_tree_of_tallies_becomes_the_same_tree_of_numbers():
    tree = dict(a=scores.mean(2.0), b=(scores.final(3.0), [scores.always(True)]))
    assert scores.values(scores.add(tree, tree)) == dict(a=2.0, b=(3.0, [True]))
    assert scores.is_tally(tree["a"]) and not scores.is_tally(tree["b"])
    with pytest.raises(
        TypeError, match=r"^`score` must return a tree of tallies, such as scores\.rms\(x\), but it holds 3"
    ):
        scores.empty(3.0)


# long runs and odd values


def long_run(tally_of, ticks):
    """The value of a tally that takes the same number at every one of so many ticks, in float32."""
    one = jax.tree.map(jnp.asarray, tally_of(np.float32(0.1)))
    run = lambda ticks: jax.lax.fori_loop(0, ticks, lambda _, sum_: scores.add(sum_, one), scores.empty(one))
    return scores.values(jax.jit(run)(ticks))


@pytest.mark.parametrize("ticks", [10**5, 864_000, 8_640_000, 20 * 10**6])
@pytest.mark.parametrize(
    ("tally_of", "right"),
    [
        (scores.mean, lambda n: 0.1),
        (lambda v: scores.rms(v * v), lambda n: 0.1),
        (scores.total, lambda n: 0.1 * n),
        (lambda v: scores.mean(v > 0), lambda n: 1),
    ],
)
def test_sums_of_float32_are_right_at_any_length(tally_of, right, ticks):
    assert long_run(tally_of, ticks) == pytest.approx(right(ticks), rel=2e-7)


def test_the_forward_derivative_of_a_long_mean_is_right_too():
    one = jax.tree.map(jnp.asarray, scores.mean(np.float32(0.1)))

    def mean(v):
        step = lambda sum_, _: (scores.add(sum_, scores.mean(v)), None)
        return scores.values(jax.lax.scan(step, scores.empty(one), None, length=10**6)[0])

    assert jax.jvp(mean, (np.float32(0.1),), (np.float32(1),))[1] == pytest.approx(1, rel=2e-7)


def test_the_time_of_an_alarm_does_not_depend_on_how_ticks_are_put_together():
    some = [scores.alarm_time(Now(k, 0.5 * k, 0.5), VALUES[k], 1.0) for k in range(40)]
    empty = scores.empty(jax.tree.map(jnp.asarray, some[0]))
    whole = scores.values(sum(some[1:], some[0]))
    for cut in (0, 1, 7, int(np.argmax(VALUES > 1)), 39):
        left, right = sum(some[:cut], empty), sum(some[cut:], empty)
        assert float(scores.values(left + right)) == float(whole)


def test_an_infinite_value_makes_an_infinite_mean():
    bad = lambda now, v: jnp.where(now.k == 7, jnp.inf, v)
    assert total(lambda now, v, i: scores.mean(bad(now, v))) == np.inf
    assert total(lambda now, v, i: scores.total(bad(now, v))) == np.inf


@pytest.mark.parametrize("value", [2, 2.0, True, np.int64(2), np.float64(2), np.array(2), np.float32(2), np.uint8(2)])
def test_every_tally_takes_a_number_of_any_type(value):
    right = dict(mean=value, rms=2**0.5 if value is not True else 1, peak=value, final=value, span=0, total=40 * value, always=1, first=0,
                 settling=np.inf, peak_time=0, margin=1 - int(value), alarm_time=0)  # fmt: skip
    timed, against = {"first", "settling", "peak_time", "alarm_time"}, {"margin": (1.0,), "alarm_time": (0.5,)}
    with jax.numpy_dtype_promotion("strict"):
        for name, number in right.items():
            tally = getattr(scores, name)
            found = total(
                lambda now, v, i, t=tally, n=name: t(*([now] if n in timed else []), value, *against.get(n, ()))
            )
            assert found == pytest.approx(float(number)), name


def test_a_window_may_be_a_number_or_of_another_shape():
    assert total(lambda now, v, i: scores.mean(v, 1.0 * i)) == pytest.approx(VALUES[INSIDE].mean())
    assert scores.values(scores.mean(2.0, np.array([True, False]))).tolist()[0] == 2
    assert scores.values(scores.settling(Now(3, 1.5, 0.5), True, np.array([True, False]))).tolist()[0] == np.inf


def test_nan_is_no_truth():
    assert not scores.truth(np.nan) and scores.truth(2) and not scores.truth(0.0)

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

"""Small probabilities against exact ones, the promises of `jaxatt.rare`, and what it refuses."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy
from scipy import stats

import jaxatt
from benchmarks.rare import breitung, four, mirror, modes, needle, scaled, square
from jaxatt import normal_space, rare, scores, subset
from jaxatt.loss import log_t, wilson

ROOT = Path(__file__).parents[1]
PARAMS, SCENARIO = np.float32(1.0), np.float32(0.0)
key = jax.random.key


SIX, FEW, MANY, TEN, ONE = mirror(6), mirror(2), mirror(100), mirror(10), mirror(1)


def two(params, scenario, now, log):
    """x_1, or minus the sum of the other 99 over the root of 99."""
    return modes(0.0, scenario, now, log)


def first(params, scenario, now, log):
    return scores.final(log[0])


def linear(params, scenario, now, log):
    return scores.final((log[0] + log[1]) / jnp.sqrt(2.0))


def estimate(system=FEW, score=linear, above=4.0, seed=0, ticks=1, **more):
    return rare.probability(
        system, PARAMS, SCENARIO, key(seed), ticks=ticks, score=score, above=above, progress=False, **more
    )


def same(a, b):
    """Whether two results agree in every bit but the time that they took."""
    a, b = (jax.tree.leaves(loss._replace(seconds=0.0, event=0, flags=len(loss.flags))) for loss in (a, b))
    assert len(a) == len(b)
    for left, right in zip(a, b):
        np.testing.assert_array_equal(left, right)


@pytest.fixture(scope="module")
def beyond():
    """P(x_1 > 4), a result that several tests look at."""
    return estimate()


# exact cases


def test_the_peak_of_chi_squares_of_300_ticks():
    loss = estimate(SIX, square, 50.74440649, seed=1, ticks=300, chains=96, repeats=4)
    assert 0.65 < loss.p / 1e-6 < 1.5 and loss.low < 1e-6 < loss.high and not loss.flags
    assert loss.runs < 36_000 and 0.05 < loss.cv < 0.3
    assert 0.4 < loss.acceptance.mean() < 0.5 and np.all(np.abs(loss.acceptance - 0.44) < 0.1)  # a pilot of 96 chains


def test_a_sum_in_a_thousand_dimensions():
    for above, low, high, repeats in ((4.0, 0.65, 1.5, 4), (6.0, 0.5, 1.8, 8)):
        loss = estimate(MANY, scaled, above, ticks=10, chains=96, repeats=repeats)
        assert low < loss.p / stats.norm.sf(above) < high


def test_draws_beyond_five_sigma_occur_as_often_as_they_should():
    """1.3e8 draws hold 7.7 beyond 5.3 in the mean; a draw of 23 bits would end at 5.2947."""
    beyond = lambda params, scenario, now, log: scores.total(jnp.sum(log > 5.3))
    met = jaxatt.sweep(MANY, PARAMS, np.zeros(2048, np.float32), key(4), ticks=650, score=beyond, progress=False)
    assert stats.poisson.ppf(5e-4, 7.71) <= np.sum(met) <= stats.poisson.ppf(1 - 5e-4, 7.71)
    assert 1 / 1.6 < estimate(ONE, first, 6.2, seed=2).p / stats.norm.sf(6.2) < 1.6


def test_four_branches():
    for c, exact in ((3.0, 2.22279507e-3), (5.0, 3.62993610e-7)):
        assert 0.7 < estimate(FEW, four, c, chains=96).p / exact < 1.4


def test_two_modes_are_both_among_the_failures():
    def label(log):
        return "first" if log[0, 0] > 4.75 else "rest"

    loss = estimate(TEN, two, 4.75, ticks=10, label=label)
    assert 0.65 < loss.p / 2.0341661e-6 < 1.5
    assert set(loss.modes) == {"first", "rest"}
    np.testing.assert_allclose(sum(loss.modes.values()), loss.by_repeat > 0)


def test_chains_that_stick_are_flagged_and_the_interval_covers_all_the_same():
    with pytest.warns(UserWarning, match="stuck"):
        found = [estimate(FEW, breitung, 0.0, seed) for seed in range(8)]
    assert sum("stuck" in loss.flags for loss in found) >= 5
    assert sum(loss.low < 3.19579e-5 < loss.high for loss in found) >= 7


def test_the_curve_falls_to_the_estimate_and_its_first_part_is_that_of_a_sweep(beyond):
    b, p, low, high = beyond.curve
    assert len(b) >= 50 and (np.diff(b) > 0).all() and (np.diff(p) <= 1e-12).all() and b[-1] == 4.0
    assert p[-1] == pytest.approx(beyond.p) and set(beyond.levels) <= set(b)
    exact = stats.norm.sf(b)
    assert np.mean((low < exact) & (exact < high)) > 0.8
    values = jaxatt.sweep(FEW, PARAMS, np.zeros(4096, np.float32), key(9), ticks=1, score=linear, progress=False)
    plain = np.array([np.mean(values > at) for at in b])
    seen = b < beyond.levels[0]
    spread = np.sqrt(exact * (1 - exact) * (1 / 4096 + 1 / (8 * 1280)))
    assert seen.sum() > 5 and (np.abs(plain - p)[seen] < 4 * spread[seen]).all()


def test_a_needle_is_missed_and_the_guide_says_so():
    loss = estimate(score=needle, above=0.999999, chains=32, repeats=4, seed=2)
    exact = stats.norm.sf(4) + stats.norm.sf(5)
    assert exact == pytest.approx(3.19579e-5, rel=1e-4) and loss.high < 0.1 * exact
    page = (ROOT / "docs/guides/rare_events.md").read_text()
    assert re.search(r"needle.{,400}of (\d+) estimates (\d+) missed", page, re.S)


# the parts of the estimator


def an_event(score=first, above=4.0, chains=128, moves=10):
    return normal_space.event_of(
        "probability", FEW, PARAMS, SCENARIO, key(0), 1, score, above, normals=0, chains=chains, moves=moves
    )


def test_moves_keep_the_normal_law_above_a_level():
    event, raw = an_event(moves=50)
    b = 1.0
    x = stats.norm.isf(stats.norm.sf(b) * np.random.default_rng(0).random(128)).astype(np.float32)
    noise = np.random.default_rng(1).standard_normal((10, 2, 128)).astype(np.float32)
    noise[0, 0] = x
    start = normal_space.Point(np.zeros((0, 128), np.float32), noise)
    level = subset._moved(event, raw, 1, b, start, x, 1.0, np.zeros((50, 128), int), False)
    last = np.asarray(subset.drawn_again(event, raw, level, 49 * 128 + np.arange(128)).noise)
    assert (last[0, 0] > b).all() and np.array_equal(last[0, 0], level.states[-1])
    assert stats.kstest(last[0, 0], lambda x: 1 - stats.norm.sf(x) / stats.norm.sf(b)).pvalue > 1e-3
    others = np.delete(last.reshape(20, 128), 0, axis=0)
    assert stats.kstest(others.ravel(), "norm").pvalue > 1e-3
    assert (np.abs(others.var(axis=1) - 1) < 0.5).all()


def test_a_proposal_that_ties_with_the_level_is_not_taken():
    at = normal_space.Point(np.zeros((0, 2)), np.zeros((1, 1, 2)))
    ahead = normal_space.Point(np.zeros((0, 2)), np.ones((1, 1, 2)))
    assert normal_space.chosen(at, ahead, np.array([1.0, 1.5]), 1.0).noise.tolist() == [[[0.0, 1.0]]]


def test_systematic_resampling_is_unbiased():
    rng = np.random.default_rng(0)
    for m, k in ((13, 40), (40, 16), (16, 16)):
        counts = np.array([np.bincount(subset.systematic(rng, m, k), minlength=m) for _ in range(4000)])
        assert (np.abs(counts - k / m) <= 1).all() and (counts.sum(axis=1) == k).all()
        assert (np.abs(counts.mean(axis=0) - k / m) < 5 * np.sqrt(0.25 / 4000)).all()


def test_repeats_keep_to_the_pilots_levels_and_angles_and_count_no_seed():
    event, raw = an_event(above=3.0)
    tell = lambda *a: None
    pilot = subset.piloted(event, raw, tell)
    assert len(pilot.levels) == 2 and pilot.reached and pilot.runs == 3 * event.n
    other = np.asarray(normal_space.block_key(raw, 7))
    found = subset.populated(event, other, pilot, tell)
    level = subset.first_level(event, other)
    shares = [np.mean(level.states > pilot.levels[0])]
    for number, angle in enumerate(pilot.angles):
        level = subset.next_level(event, other, level, pilot.levels[number], angle)
        assert (level.angles == angle).all() and level.states.shape == (10, 128)
        changed = np.diff(np.concatenate([level.before[None], level.states]), axis=0) != 0
        np.testing.assert_array_equal(changed, level.ahead > level.level)  # the first state is a move from its seed
        shares.append(np.mean(level.states > [*pilot.levels, 3.0][number + 1]))
    np.testing.assert_array_equal(found.shares, shares)
    assert found.p == pytest.approx(np.prod(shares)) and not np.isclose(shares[0], 0.1, atol=1e-9)


def test_populations_at_fixed_levels_are_unbiased():
    event, raw = an_event(above=3.0, chains=16)
    tell = lambda *a: None
    pilot = subset.piloted(event, raw, tell)
    some = [subset.populated(event, np.asarray(normal_space.block_key(raw, r)), pilot, tell).p for r in range(100)]
    assert abs(np.mean(some) / stats.norm.sf(3.0) - 1) < 3 * np.std(some) / np.mean(some) / np.sqrt(100) < 0.3


def test_au_and_becks_spread_counts_correlation_along_the_chains():
    rng = np.random.default_rng(0)
    above = rng.random((10, 4000)) < 0.1
    share = above.mean()
    assert subset.au_beck(above, 0) == pytest.approx((1 - share) / share / above.size)
    assert subset.au_beck(above, 1) == pytest.approx(subset.au_beck(above, 0), rel=0.1)
    stuck = np.broadcast_to(above[:1], above.shape)  # chains that never move are worth one state each
    p = stuck.mean()
    assert subset.au_beck(stuck, 1) == pytest.approx((1 - p) / p / 4000, rel=1e-6)


def test_the_interval_is_students_on_the_logarithm():
    found = np.array([1.0, 2.0, 3.0, 6.0])
    reach = stats.t.ppf(0.975, 3) * np.std(found, ddof=1) / 2
    p, low, high, cv = log_t(found * 1e-6)
    assert p == pytest.approx(3e-6) and cv == pytest.approx(np.std(found, ddof=1) / 3 / 2)
    np.testing.assert_allclose([low, high], 3e-6 * np.exp([-reach / 3, reach / 3]))
    test = stats.binomtest(30, 100).proportion_ci(method="wilson")
    np.testing.assert_allclose(wilson(30, 100), (test.low, test.high))


# where there is little to climb


def test_a_share_that_is_not_rare_is_counted():
    loss = estimate(above=0.5, repeats=4)
    assert not len(loss.levels) and loss.runs == 5 * 1280 and not loss.flags
    assert loss.low < stats.norm.sf(0.5) < loss.high and (loss.low, loss.high) == wilson(round(loss.p * 5120), 5120)


def test_a_score_with_a_bound_ends_in_zero_and_flags():
    def bounded(params, scenario, now, log):
        return scores.final(jnp.minimum(log[0], 2.0))

    with pytest.warns(UserWarning, match="unreached"):
        loss = estimate(score=bounded, above=3.0, repeats=4)
    assert loss.p == 0 and (loss.low, loss.high) == (0, 3 / 5120) and {"lost", "unreached"} <= set(loss.flags)
    assert len(loss.failures.score) == 0 and len(loss.levels) < 40


def test_a_score_that_counts_is_a_plateau():
    def steps(params, scenario, now, log):
        return scores.final(jnp.floor(log[0] / 1.5) + jnp.floor(log[1] / 1.5))

    with pytest.warns(UserWarning, match="plateau"):
        assert "plateau" in estimate(score=steps, above=4.5, repeats=4).flags


def test_nan_counts_as_lost():
    def broken(params, scenario, now, log):
        return scores.final(jnp.where(log[0] > 3, jnp.nan, log[0]))

    with pytest.warns(UserWarning, match="nan"):
        loss = estimate(score=broken, above=9.0)
    assert "nan" in loss.flags and 0.65 < loss.p / stats.norm.sf(3) < 1.5 and (loss.failures.score == np.inf).all()


# failures


def drifting(u):
    return toy.Scenario(start=jnp.float32(1) + 0.1 * u[0])


def position(params, scenario, now, log):
    return scores.peak(log.position)


def test_failures_replay():
    params = toy.Params(np.float32(0.3))
    ask: dict[str, Any] = dict(ticks=33, score=position, above=1.5, normals=1)
    loss = rare.probability(toy.SYSTEM, params, drifting, key(0), progress=False, **ask)
    kept = loss.failures
    assert len(kept.score) > 20 and (kept.score > 1.5).all() and kept.noise.shape[1:] == (33, 2)
    assert 0.6 < loss.p / stats.norm.sf(5) < 1.6  # the start is almost all of it
    for i in range(0, len(kept.score), 7):
        scenario, noise = rare.failure(loss, i)
        assert float(scenario.start) == pytest.approx(1 + 0.1 * kept.u[i, 0], rel=1e-6)
        log = jaxatt.simulate(toy.SYSTEM, params, scenario, noise, ticks=33)
        assert float(log.position.max()) == pytest.approx(kept.score[i], rel=1e-6)
    given = toy.SYSTEM, params, drifting, key(0), 33, position, 1.5, 1, 128, 10
    event, _ = normal_space.event_of("probability", *given)
    at = event.origin()
    at.u[:, : len(kept.u)], at.noise[:33, :, : len(kept.u)] = kept.u.T, np.moveaxis(kept.noise, 0, -1)
    np.testing.assert_array_equal(np.asarray(normal_space.valued(event, at)[0])[: len(kept.u)], kept.score)


def test_failures_are_spread_over_their_roots_and_stand_for_all(beyond):
    kept = beyond.failures
    assert sorted(set(kept.repeat)) == list(range(8))
    for repeat in range(8):
        here = kept.repeat == repeat
        assert here.sum() <= 8 and kept.weight[here].sum() == pytest.approx(1)
        assert len(set(kept.root[here])) >= min(3, here.sum())
    wrong: tuple[Any, ...] = (-1, len(kept.score), 1.0)
    for i in wrong:
        with pytest.raises(ValueError, match="`i` must"):
            rare.failure(beyond, i)


# the same numbers, whatever happens


def test_points_that_are_drawn_again_give_the_same_bits(beyond, monkeypatch):
    monkeypatch.setattr(normal_space, "STORED", 0)
    same(estimate(), beyond)


def test_killed_and_resumed_gives_the_same_bits_and_a_finished_file_takes_more(beyond, tmp_path, monkeypatch):
    path, alive = tmp_path / "new" / "loss.npz", []

    def killed(event, key, pilot, tell):
        if not alive:
            raise KeyboardInterrupt
        alive.pop()
        return subset.populated(event, key, pilot, tell)

    monkeypatch.setattr(rare, "populated", killed)
    for repeats in (0, 3, 2):
        alive.extend(range(repeats))
        with pytest.raises(KeyboardInterrupt):
            estimate(path=path)
    monkeypatch.setattr(rare, "populated", subset.populated)
    same(estimate(path=path), beyond)
    assert [f.name for f in path.parent.iterdir()] == ["loss.npz"]
    more = estimate(path=path, repeats=12)
    assert more.looks == 2 and "look 2" in str(more) and np.array_equal(more.by_repeat[:8], beyond.by_repeat)
    same(more._replace(looks=1), estimate(repeats=12))
    with pytest.raises(ValueError, match="`repeats` must not be fewer than the 12"):
        estimate(path=path)
    for other in (dict(above=4.1), dict(seed=1), dict(score=first), dict(chains=64), dict(ticks=2), dict(system=SIX)):
        with pytest.raises(ValueError, match="`path` must hold the same event"):
            estimate(**{"path": path, "repeats": 12, **other})


def test_one_compilation_serves_all_numbers(beyond):
    programs = normal_space.untraced(normal_space.propose, 1), normal_space.untraced(normal_space.value, 3)
    sizes = [program._cache_size() for program in programs]
    estimate(above=3.7, seed=5, repeats=4)
    rare.probability(FEW, np.float32(2), np.float32(0.1), key(1), ticks=2, score=linear, above=3.0, repeats=4)
    assert [program._cache_size() for program in programs] == sizes


@pytest.mark.slow
def test_two_devices_give_the_same_bits():
    code = (
        "import os, sys; os.environ['XLA_FLAGS'] = '--xla_force_host_platform_device_count=2'; sys.path.insert(0, 'tests')\n"
        "import jax, numpy as np, test_rare as t\n"
        "both = jax.local_devices(); assert len(both) == 2\n"
        "ask = dict(above=2.0, repeats=4, chains=32); loss = t.estimate(**ask)\n"
        "jax.local_devices = lambda: both[:1]; t.same(loss, t.estimate(**ask))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


# the second method


def test_a_design_point_and_importance_sampling_of_a_plane():
    ask: dict[str, Any] = dict(ticks=10, score=scaled, above=6.0)
    points = rare.design_point(MANY, PARAMS, SCENARIO, key(0), **ask)
    assert points.beta == pytest.approx([6.0], rel=1e-5) and points.found_by.tolist() == [8]
    assert points.form == pytest.approx([9.86588e-10], rel=1e-3) and points.residual[0] < 1e-3
    np.testing.assert_allclose(points.noise, 6 / np.sqrt(1000), rtol=1e-3)
    log = jaxatt.simulate(MANY, PARAMS, SCENARIO, points.noise[0], ticks=10)
    assert float(log.sum()) / np.sqrt(1000) == pytest.approx(6.0, rel=1e-5)
    with pytest.warns(UserWarning, match="unchecked"):
        loss = rare.importance(MANY, PARAMS, SCENARIO, key(1), points, runs=5000, **ask)
    assert loss.low < 9.86588e-10 < loss.high and loss.cv < 0.1 and loss.runs == 5120
    assert (loss.failures.score > 6).all() and loss.roots > 100


def test_points_of_four_branches_and_what_is_missed_with_one_of_them():
    ask: dict[str, Any] = dict(ticks=1, score=four, above=4.0)
    points = rare.design_point(FEW, PARAMS, SCENARIO, key(0), starts=16, **ask)
    np.testing.assert_allclose(points.beta, [4, 4, 4.5, 4.5], rtol=1e-3)
    assert points.form.sum() == pytest.approx(1.55 * 4.51213895e-5, rel=0.01)
    assert points.found_by.sum() <= 16
    whole = estimate(FEW, four, 4.0)
    loss = rare.importance(FEW, PARAMS, SCENARIO, key(1), points, runs=5000, against=whole, **ask)
    assert 0.85 < loss.p / 4.51213895e-5 < 1.15 and not loss.flags
    one = rare.Points(*(a[:1] for a in points))
    with pytest.warns(UserWarning, match="contradicts"):
        loss = rare.importance(FEW, PARAMS, SCENARIO, key(1), one, runs=5000, against=whole, **ask)
    assert "contradicts" in loss.flags and loss.p < 0.6 * 4.51213895e-5


# what failures have in common, and what changes their probability


def test_failures_of_two_modes_fall_into_two_groups():
    loss = estimate(TEN, two, 4.75, chains=96, repeats=4, ticks=10, seed=3)
    noise = loss.failures.noise.reshape(len(loss.failures.score), 100)
    features = np.stack([noise[:, 0], -noise[:, 1:].sum(axis=1) / np.sqrt(99)], axis=1)
    found = rare.groups(loss, features)
    assert len(found.index) == 2 and found.share.sum() == pytest.approx(1)
    assert np.all(np.diff(found.share) <= 0) and np.all((found.low <= found.share) & (found.share <= found.high))
    ahead = features[:, 0] > 4.75
    assert len(np.unique(found.member[ahead])) == len(np.unique(found.member[~ahead])) == 1
    assert found.member[found.index].tolist() == [0, 1]  # each stands for its own


def test_failures_of_one_kind_are_one_group(beyond):
    found = rare.groups(beyond, beyond.failures.noise.reshape(len(beyond.failures.score), -1))
    assert len(found.index) == 1 and found.share.tolist() == [1] and not found.member.any()
    with pytest.raises(ValueError, match=r"`features` must have shape \(\d+, numbers\)"):
        rare.groups(beyond, np.zeros((3, 2)))
    with pytest.raises(ValueError, match=r"`features\[0, 0\]` must be finite"):
        rare.groups(beyond, np.full((len(beyond.failures.score), 2), np.nan))


def test_the_gradient_of_a_probability_is_the_exact_one():
    """P = Phi(-b / theta) for a sum scaled by theta: d ln P / d theta = phi(b / theta) b / theta^2 / P."""
    loss = estimate(MANY, scaled, 4.75, ticks=10, chains=96)
    told = rare.sensitivity(loss, MANY, lambda theta: theta["size"], {"size": 1.0}, ticks=10, score=scaled)
    exact = stats.norm.pdf(4.75) * 4.75 / stats.norm.sf(4.75)
    assert told.gradient["size"] == pytest.approx(exact, rel=0.1) and 0 < told.error["size"] < 0.05 * exact
    assert told.mean["size"] == pytest.approx(4.75, rel=1e-3)  # the score is theta times what it is at 1


def test_the_gradient_of_a_probability_where_the_edge_has_two_sides():
    """Failures beyond a at theta_1 x_1 and beyond b at theta_2 times the rest: each side has its own parameter."""

    def sides(params, scenario, now, log):
        return scores.peak(jnp.maximum(params[0] * log[0], params[1] * log[1]))

    loss = rare.probability(FEW, (PARAMS, PARAMS), SCENARIO, key(1), ticks=1, score=sides, above=4.0, progress=False)
    told = rare.sensitivity(loss, FEW, tuple, (1.0, 1.0), ticks=1, score=sides)
    exact = stats.norm.pdf(4.0) * 4.0 / stats.norm.sf(4.0) / 2
    assert abs(told.gradient[0] - exact) < 4 * told.error[0] and told.error[0] < 0.5 * exact
    assert sum(told.gradient) == pytest.approx(2 * exact, rel=0.1)
    few = loss._replace(failures=jax.tree.map(lambda a: a[:3], loss.failures))
    with pytest.raises(ValueError, match="`loss` must have levels and at least 8 failures, but it is one with 3"):
        rare.sensitivity(few, FEW, tuple, (1.0, 1.0), ticks=1, score=sides)


# refusals


def flag(params, scenario, now, log):
    return scores.always(log[0] < 3)


def alarmed(params, scenario, now, log):
    return scores.peak(log[0] > 3)


def pair(params, scenario, now, log):
    return dict(a=scores.peak(log[0]), b=scores.peak(log[1]))


@pytest.mark.parametrize(
    "wrong, kind, words",
    [
        (dict(score=flag), TypeError, "`score` must be continuous: hand over what it is a threshold of"),
        (dict(score=alarmed), ValueError, "`score` must be continuous: .* but it is one of"),
        (dict(score=pair), ValueError, "`score` must give one tally of one number, but it is 2"),
        (dict(score=3), TypeError, "`score` must be a function"),
        (dict(above=np.inf), ValueError, "`above` must be finite, but it is inf"),
        (dict(moves=4), ValueError, "`moves` must be a whole number of at least 5, but it is 4"),
        (dict(chains=100), ValueError, "`chains` must be a multiple of 8, but it is 100"),
        (dict(repeats=3), ValueError, "`repeats` must be a whole number of at least 4, but it is 3"),
        (dict(normals=2), ValueError, "`normals` must be 0 where `scenario` is no function"),
        (dict(ticks=0), ValueError, "`ticks` must be a whole number of at least 1"),
        (dict(label=3), TypeError, "`label` must be a function"),
        (dict(path=3), TypeError, "`path` must be a path"),
        (dict(ticks=2**30), ValueError, "`ticks` = 1073741824 with `chains` = 128 takes .* GB"),
    ],
)
def test_refusals(wrong, kind, words):
    with pytest.raises(kind, match=words):
        estimate(**wrong)


def test_it_has_no_gradient_and_says_so():
    with pytest.raises(TypeError, match="`probability` must be called outside jit, grad and vmap"):
        jax.grad(lambda p: rare.probability(FEW, p, SCENARIO, key(0), ticks=1, score=linear, above=4.0).p)(1.0)


def test_a_result_in_words(beyond):
    assert str(beyond).startswith("P(linear > 4 in 1 s) = ") and "e-5 (95 %: " in str(beyond)
    assert str(beyond).endswith(f"{beyond.runs // 1000} {beyond.runs % 1000:03} runs, no flags")

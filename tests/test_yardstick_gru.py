"""The learned row: the detector is the trained unit, its windows say the truth, its training learns and goes on where it was."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxatt.yardstick import bank, baselines, gru, learning, leo4, leo4_days, recording, rules, tune, worlds
from jaxatt.yardstick.learning import Days, Plan, Stretch, train
from jaxatt.yardstick.telemetry import STD

PLAN = Plan(rounds=3, days=16, passes=2, batch=18, rate=0.02)


def plain_verdicts(p, r):
    """Scores (packets,) and probabilities (packets, 12) of residuals r (packets, 7) by a loop in NumPy."""
    sigmoid = lambda a: 1 / (1 + np.exp(-a))
    h, found = np.zeros(32), []
    for row in r:
        z = np.clip(p.whiten @ row, -8, 8)
        x = np.concatenate([z, np.minimum((z * z - 1) / np.sqrt(2), 8)])
        (wu, wv, wc), (ou, ov, oc) = np.split(p.inputs @ x + p.offset, 3), np.split(p.recur @ h, 3)
        u = sigmoid(wu + ou)
        h = (1 - u) * h + u * np.tanh(wc + sigmoid(wv + ov) * oc)
        found.append(p.out @ np.maximum(p.hidden @ h + p.hidden_offset, 0) + p.out_offset)
    found = np.array(found)
    weights = np.exp(found - found.max(1, keepdims=True))
    return np.log(weights[:, 1:].sum(1) / weights[:, 0]), weights / weights.sum(1, keepdims=True)


@pytest.mark.short
def test_the_shipped_unit_is_that_of_the_equations_alone_and_in_a_batch_and_as_it_was_trained():
    row = tune("gru")
    params = jax.tree.map(lambda a: a.astype(float), row.params)
    assert gru.WEIGHTS.stat().st_size < 100_000 and all(np.isfinite(a).all() for a in params)
    assert row.tuned == sum(a.size for a in params[1:]) and rules.pure(row, leo4_days.example())
    r = np.random.default_rng(0).normal(size=(70, 7, 3)) * np.array(STD)[:, None]
    r[40:, 3, 1] += 3 * STD[3]  # a gyro's bias, as the parity sees it
    step = lambda h, r: gru.gru_step(params, h, r, leo4_days.example())
    told = jax.lax.scan(jax.vmap(step, in_axes=-1, out_axes=-1), jnp.zeros((32, 3)), r)[1]
    alone = jax.lax.scan(step, jnp.zeros(32), r[..., 2])[1]
    np.testing.assert_allclose(told.score[..., 2], alone.score, rtol=1e-9, atol=1e-9)
    for i in range(3):
        score, p = plain_verdicts(params, r[..., i])
        np.testing.assert_allclose(told.score[..., i], score, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(told.blame[..., i], p[:, 1:], rtol=1e-9, atol=1e-12)
    assert told.score[-1, 1] > 3 > told.score[39].max() and told.blame[-1, :4, 1].sum() > 0.9
    # the training's loss of these days, were channel 2 at fault in the second, is what these verdicts say, also in two parts
    truth = np.zeros((70, 12, 3), bool)
    truth[:, 0], truth[40:, 0, 1], truth[40:, 3, 1] = True, False, True
    weight = np.random.default_rng(1).random((70, 3))
    given = np.concatenate([1 - told.blame.sum(1, keepdims=True), told.blame], 1)
    surprise = -weight * np.log(np.sum(given * truth, axis=1))
    wanted = surprise[:30].mean(), surprise[30:].mean()
    lost = lambda h, fresh, rows: learning.loss(
        params, np.ones(32), h, Stretch(fresh, r[rows], truth[rows], weight[rows])
    )
    one, h = lost(np.ones((32, 3)), np.ones(3, bool), slice(0, 30))
    two, h = lost(h, np.zeros(3, bool), slice(30, 70))
    np.testing.assert_allclose([one, two], wanted, rtol=1e-5)


def made_up(key, n):
    """White residuals whose parity jumps at the onset, gyro 1 at fault."""
    rng = np.random.default_rng(int(jax.random.key_data(key)[-1]))
    r, onset = rng.normal(size=(n, leo4_days.PACKETS, 7)).astype(np.float32), rng.integers(600, 1680, n)
    r[..., 3] += 2 * (np.arange(leo4_days.PACKETS) >= onset[:, None])
    return Days(r, onset, np.tile(np.arange(11) == 1, (n, 1)))


def test_stretches_are_days_from_first_to_last_packet():
    plan = Plan(days=50, passes=2, batch=18)
    days = made_up(jax.random.key(0), 50)
    days.r[..., 0] = np.arange(leo4_days.PACKETS)  # the packet's number
    days.r[..., 1] = np.arange(50)[:, None]
    days.onset[:10] = learning.NEVER
    told = list(learning.stretches(days, plan, np.random.default_rng(2)))
    assert len(told) == plan.steps == 50
    fresh, r, truth, weight = (np.stack(a) for a in zip(*told))  # (steps, packets, ..., lanes)
    assert r.shape == (50, 200, 7, 18) and truth.shape == (50, 200, 12, 18)
    seen = []
    for lane in range(18):
        starts = np.flatnonzero(fresh[:, lane])
        assert not weight[: starts[0], :, lane].any() and starts[0] < 9 and (np.diff(starts) == 9).all()
        for k in starts[starts + 9 <= 50]:
            packet, day = (np.concatenate(r[k : k + 9, :, i, lane]) for i in (0, 1))
            (which,) = set(day.astype(int))
            assert 0 <= packet[0] <= 600
            np.testing.assert_array_equal(packet, np.minimum(packet[0] + np.arange(1800), 1799))
            on, over = packet >= days.onset[which], packet[0] + np.arange(1800) > 1799
            here, w = np.concatenate(truth[k : k + 9, ..., lane]), np.concatenate(weight[k : k + 9, :, lane])
            np.testing.assert_array_equal(here[:, 0], ~on)
            np.testing.assert_array_equal(here[:, 1:], (np.arange(11) == 1) & on[:, None])
            late = packet >= days.onset[which] + 120
            assert not w[late | over].any() and w[~on & ~over].all() and w[on & ~late & ~over].all()
            seen.append(which)
    assert len(seen) >= 72 and set(np.bincount(seen)) <= {1, 2}  # days come in turn


def test_a_packet_of_any_number_is_as_likely_faulty_as_healthy():
    rng = np.random.default_rng(3)
    onset, first = (
        np.where(rng.random(4000) < 0.2, learning.NEVER, rng.integers(720, 1680, 4000)),
        rng.integers(0, 601, 4000),
    )
    calm, faulty = learning.weights(onset, first)
    k = np.arange(1800)[:, None] + first
    on, judged = k >= onset, k < np.minimum(onset + 120, 1800)
    sums = calm * np.sum(~on & (k < 1800), 1), faulty * np.sum(on & judged, 1)
    likely = slice(300, 1500)  # where a day may be either
    np.testing.assert_allclose(sums[0][likely], sums[1][likely], rtol=1e-9)
    np.testing.assert_allclose(sums[0][likely], sums[0][300], rtol=1e-9)
    assert max(calm.max(), faulty.max()) == learning.HEAVIEST


@pytest.mark.short
def test_a_drawn_day_is_one_of_the_public_catalogue_with_its_onset_and_channel(monkeypatch):
    monkeypatch.setattr(recording, "residuals_of", lambda days, key: days)
    found = learning.drawn(jax.random.key(4), 256)
    days = found.r
    onset = np.floor((worlds.onset_of(worlds.WORLDS["leo4"], days) + 300) / 0.5)
    assert 0.1 < np.mean(np.isinf(onset)) < 0.3
    np.testing.assert_array_equal(found.onset, np.where(np.isinf(onset), learning.NEVER, onset))
    assert set(found.channels[np.isfinite(worlds.onset_of(worlds.WORLDS["leo4"], days))].sum(1)) == {1, 3}
    bias = np.abs(days.gyro.bias[np.isfinite(days.gyro.onset)]) / leo4.SECOND
    sizes = np.unique(bias[bias > 0])
    assert len(sizes) > 5 and all(np.isclose(s, leo4_days.SIZED["gyro_bias"], rtol=1e-4).any() for s in sizes)


@pytest.mark.short
def test_a_training_learns_and_a_killed_one_goes_on_with_the_same_numbers(monkeypatch, tmp_path):
    monkeypatch.setattr(recording, "public", lambda: None)
    monkeypatch.setattr(recording, "whitening", lambda _: np.eye(7))
    rounds = []

    def drawn(key, n, deadly=False):
        rounds.append(key)
        if len(rounds) == 3:
            raise KeyboardInterrupt
        return made_up(key, n)

    monkeypatch.setattr(learning, "drawn", drawn)
    key, file = jax.random.key(5), tmp_path / "run" / "training.npz"
    with pytest.raises(KeyboardInterrupt):
        train(key, PLAN, save=file)
    resumed = train(key, PLAN, save=file)
    assert len(rounds) == 4  # the third round again, and no other
    whole = train(key, PLAN)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(resumed), jax.tree.leaves(whole), strict=True))
    assert whole.loss.shape == (3,) and whole.loss[2] < 0.7 * whole.loss[0]
    np.testing.assert_array_equal(whole.params.whiten, np.eye(7))
    for other, plan in ((key, PLAN._replace(rate=0.01)), (jax.random.key(6), PLAN)):
        with pytest.raises(ValueError, match="`save` must hold a training of the same key, plan, program and JAX"):
            train(other, plan, save=file)
    with pytest.raises(ValueError, match=r"`plan.batch` must be at most 288, or no step is made, but it is 289"):
        train(key, PLAN._replace(batch=289))


def test_gyro_tests_read_what_a_gyro_reads_too_much():
    """A step of s at gyro i is an innovation of s at gyro i alone: y = G w + V p is all of y."""
    covariance = np.diag(np.square(STD))
    gyros, parity = baselines.gyro_rows(covariance)
    unit = bank.body_model().E[:, :4]  # residuals of the first packet of a step of 1 rad/s: rate observer and parity
    first = np.zeros((7, 4))
    first[3], first[4:] = unit[3], 5 * 0.75 * np.array(leo4.AXES)  # before the observer follows
    std = 1 / np.abs(np.diag(gyros.params.seen @ first))
    np.testing.assert_allclose(std[:, None] * (gyros.params.seen @ first), np.eye(4), atol=1e-6)
    for row, k, size in ((gyros, 1, 1 / std[2]), (parity, 0, 0.5 / STD[3])):
        mean, s, m = row.init(row.params)[1], 1e-4, 0.25
        for n in range(1, 4):
            mean, verdict = row.step.step(row.params, mean, s * first[:, 2], None)
            wanted = (s * size * (1 - (1 - m) ** n)) ** 2 * (2 - m) / m
            assert float(verdict.score) == pytest.approx(wanted, rel=1e-5)
        guilty = np.eye(11)[2] if k else np.arange(11) < 4
        np.testing.assert_array_equal(verdict.blame, guilty)

"""The learned row: the detector is the trained unit, its windows say the truth, its training learns and goes on where it was."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxatt.yardstick import bank, baselines, gru, learning, leo4, recording, rules, tune, worlds
from jaxatt.yardstick.learning import Days, Plan, train
from jaxatt.yardstick.telemetry import STD

PLAN = Plan(rounds=3, days=16, passes=2, batch=8, rate=0.02)


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
    assert row.tuned == sum(a.size for a in params[1:]) and rules.pure(row)
    r = np.random.default_rng(0).normal(size=(70, 7, 3)) * np.array(STD)[:, None]
    r[40:, 3, 1] += 3 * STD[3]  # a gyro's bias, as the parity sees it
    step = lambda h, r: gru.gru_step(params, h, r, rules.example())
    told = jax.lax.scan(jax.vmap(step, in_axes=-1, out_axes=-1), jnp.zeros((32, 3)), r)[1]
    alone = jax.lax.scan(step, jnp.zeros(32), r[..., 2])[1]
    np.testing.assert_allclose(told.score[..., 2], alone.score, rtol=1e-9, atol=1e-9)
    for i in range(3):
        score, p = plain_verdicts(params, r[..., i])
        np.testing.assert_allclose(told.score[..., i], score, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(told.blame[..., i], p[:, 1:], rtol=1e-9, atol=1e-12)
    assert told.score[-1, 1] > 3 > told.score[39].max() and told.blame[-1, :4, 1].sum() > 0.9
    # the training's loss of these days, were channel 2 at fault in the second, is what these verdicts say
    truth = np.zeros((70, 12, 3), bool)
    truth[:, 0], truth[40:, 0, 1], truth[40:, 3, 1] = True, False, True
    given = np.concatenate([1 - told.blame.sum(1, keepdims=True), told.blame], 1)[learning.UNJUDGED :]
    wanted = -np.log(np.sum(given * truth[learning.UNJUDGED :], axis=1)).mean()
    assert float(learning.loss(params, np.ones(32), r, truth)) == pytest.approx(wanted, rel=1e-5)


def made_up(key, n):
    """White residuals whose parity jumps at the onset, gyro 1 at fault."""
    rng = np.random.default_rng(int(jax.random.key_data(key)[-1]))
    r, onset = rng.normal(size=(n, worlds.PACKETS, 7)).astype(np.float32), rng.integers(600, 1680, n)
    r[..., 3] += 2 * (np.arange(worlds.PACKETS) >= onset[:, None])
    return Days(r, onset, np.tile(np.arange(11) == 1, (n, 1)))


def test_windows_hold_the_onset_and_the_truth():
    days = made_up(jax.random.key(0), 50)
    days.r[..., 0] = np.arange(worlds.PACKETS)  # the packet's number
    days.r[..., 1] = np.arange(50)[:, None]
    at = np.random.default_rng(1).permutation(50)[:40]
    r, truth = learning.windows(days, at, np.random.default_rng(2))
    assert r.shape == (200, 7, 80) and truth.shape == (200, 12, 80)
    packet, day = r[:, 0], r[0, 1].astype(int)
    np.testing.assert_array_equal(day, np.tile(at, 2))
    assert (np.diff(packet, axis=0) == 1).all() and (packet >= learning.UNJUDGED).all()
    on = packet >= days.onset[day]
    np.testing.assert_array_equal(truth[:, 0], ~on)
    np.testing.assert_array_equal(truth[:, 1:], (np.arange(11) == 1)[:, None] & on[:, None])
    assert not on[:, 40:].any() and not on[: learning.LEAST, :40].any() and on[-1, :40].all()


@pytest.mark.short
def test_a_drawn_day_is_one_of_the_public_catalogue_with_its_onset_and_channel(monkeypatch):
    monkeypatch.setattr(recording, "residuals_of", lambda days, key: days)
    found = learning.drawn(jax.random.key(4), 256)
    days = found.r
    np.testing.assert_allclose(found.onset, np.floor((worlds.onset_of(days) + 300) / 0.5), atol=0)
    assert set(found.channels.sum(1)) == {1, 3}
    bias = np.abs(days.gyro.bias[np.isfinite(days.gyro.onset)]) / leo4.SECOND
    sizes = np.unique(bias[bias > 0])
    assert len(sizes) > 5 and all(np.isclose(s, worlds.SIZED["gyro_bias"], rtol=1e-4).any() for s in sizes)


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
    with pytest.raises(ValueError, match=r"`plan.days` must be a multiple of plan.batch, 8, but it is 20"):
        train(key, PLAN._replace(days=20))


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

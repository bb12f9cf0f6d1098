"""The yardstick: its world against a plain loop, its faults, detectors, metrics and rules, and one small ranking."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.yardstick import ewma_at_rate, ewma_central
from jaxatt import rerun, scores, simulate
from jaxatt.yardstick import (
    Detector,
    Verdict,
    bank,
    baselines,
    calibrate,
    calibration,
    descent,
    kinds,
    leo4,
    leo4_days,
    metrics,
    oracle,
    rank,
    ranking,
    rules,
    tune,
    worlds,
)
from jaxatt.yardstick import __main__ as command
from jaxatt.yardstick.board import differences
from jaxatt.yardstick.harness import Found, Softly, run, slopes
from jaxatt.yardstick.products import correlations, product
from jaxatt.yardstick.steady import steady
from jaxatt.yardstick.telemetry import STD

WORLD = worlds.WORLDS["leo4"]
KEY = jax.random.key(3)


# the world


def plain_day(scenario, noise, packets):
    """The telemetry of a day by a loop written from the specification with NumPy arrays: rows of packets."""
    J0 = np.array(leo4.INERTIA, float)
    D = np.diag(np.array(scenario.stretch))
    J, inv, inv0 = D @ J0 @ D, np.linalg.inv(D @ J0 @ D), np.linalg.inv(J0)
    b = np.deg2rad([45, 135, 225, 315])
    G = np.stack([np.sqrt(2 / 3) * np.cos(b), np.sqrt(2 / 3) * np.sin(b), np.full(4, 1 / np.sqrt(3))], 1)
    K1, K2 = leo4.FILTER.gain[:, 0]
    constant, wave, phi, axis = (np.array(getattr(scenario, name)) for name in ("constant", "wave", "phi", "axis"))

    def mul(p, q):
        return np.concatenate([[p[0] * q[0] - p[1:] @ q[1:]], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])])

    def conj(p):
        return p * [1, -1, -1, -1]

    def rot(v):
        h2 = v @ v / 4
        return np.concatenate([[1 - h2 / 2 + h2**2 / 24], v / 2 * (1 - h2 / 6)])

    def aim(t):
        A, w = (scenario.swing if scenario.mode else 0.0), 2 * np.pi / 300
        th = A * np.sin(w * t + scenario.psi)
        q = np.concatenate([[np.cos(th / 2)], np.sin(th / 2) * axis])
        return q, A * w * np.cos(w * t + scenario.psi) * axis, -w * w * th * axis

    def rates(t, x, torque):
        q, w = x[:4], x[4:]
        d = constant + wave * np.sin(1.1e-3 * t + phi)
        return np.concatenate([mul(q, np.concatenate([[0], w])) / 2, inv @ (torque + d - np.cross(w, J @ w))])

    faulty = lambda fault, t: (t >= np.asarray(fault.onset)) * np.ones_like(fault.onset)
    bias, last = np.array(scenario.bias), np.zeros(4)
    q, w, _ = aim(0.0)
    hat, bhat = mul(q, rot(-np.array(scenario.turn))), 0.75 * G.T @ bias - np.array(scenario.bias_error)
    rows = []
    for p in range(packets):
        q, hat = q / np.linalg.norm(q), hat / np.linalg.norm(hat)
        t, n = 0.5 * p, noise[p].reshape(5, 11)
        on = faulty(scenario.star, t)
        error = scenario.std_star * n[0, 8:] * np.where(on, scenario.star.growth, 1) + on * scenario.star.bias
        star = mul(q, rot(error))
        d = mul(conj(hat), star)
        nu = 2 * d[1:] * (-1 if d[0] < 0 else 1)
        row = {"star": star, "attitude": hat, "bias": bhat, "innovation": nu, "aim": aim(t)[0], "aim_rate": aim(t)[1]}
        hat, bhat = mul(hat, rot(K1 * nu)), bhat + K2 * nu
        gyros, torques = [], []
        for j in range(5):
            t = 0.1 * (5 * p + j)
            on, f = faulty(scenario.gyro, t), scenario.gyro
            extra = on * (f.bias + f.drift * (1 - np.exp(-np.maximum(t - np.where(on, f.onset, 0), 0) / f.tau)))
            white = scenario.std_gyro * n[j, :4] * np.where(on, f.growth, 1)
            y = ((1 + scenario.scale) * (G @ w) + bias) * np.where(on, f.scale, 1) + extra + white
            y = np.where(on * f.stuck > 0, last, y)
            bias, last = bias + scenario.rrw * np.sqrt(0.1) * n[j, 4:8], y
            w_hat = 0.75 * G.T @ y - bhat
            q_aim, w_aim, a_aim = aim(t)
            e = mul(conj(q_aim), hat)
            u = J0 @ (a_aim - 0.02 * e[1:] * (-1 if e[0] < 0 else 1) - 0.18 * (w_hat - w_aim)) + np.cross(
                w_hat, J0 @ w_hat
            )
            tau = np.clip(0.75 * G @ u, -0.03, 0.03)
            gyros.append(y)
            torques.append(tau)
            hat = mul(hat, rot(0.1 * w_hat + 0.005 * inv0 @ (G.T @ tau - np.cross(w_hat, J0 @ w_hat))))
            on, f = faulty(scenario.wheel, t), scenario.wheel
            torque = G.T @ (tau * np.where(on, f.scale, 1) + on * f.bias)
            x = np.concatenate([q, w])
            k1 = rates(t, x, torque)
            k2 = rates(t + 0.05, x + 0.05 * k1, torque)
            k3 = rates(t + 0.05, x + 0.05 * k2, torque)
            k4 = rates(t + 0.1, x + 0.1 * k3, torque)
            x = x + 0.1 / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            q, w = x[:4], x[4:]
        rows.append(row | {"gyro": np.array(gyros), "torque": np.array(torques)})
    return rows


def fault_of(day, **parts):
    """The day with other faults from 20 s on."""
    put = lambda fault, fields: fault._replace(onset=np.where(fields.pop("where"), 20.0, np.inf), **fields)
    return day._replace(**{unit: put(getattr(day, unit), dict(fields)) for unit, fields in parts.items()})


@pytest.mark.short
def test_a_day_is_that_of_a_plain_numpy_loop():
    day = jax.tree.map(lambda a: np.asarray(a[0], float), worlds.days(WORLD, KEY, np.array([5]), None))
    first = lambda n: np.arange(n) == 1
    day = fault_of(
        day,
        gyro={"where": first(4), "bias": np.full(4, 1e-4), "growth": np.full(4, 2.0), "drift": np.full(4, 0.1)},
        star={"where": first(3), "bias": np.full(3, 1e-4)},
        wheel={"where": first(4), "scale": np.full(4, 0.3), "bias": np.full(4, 1e-3)},
    )
    packets = 100
    noise = np.random.default_rng(0).normal(size=(packets, 55))
    found = simulate(leo4.system, leo4.params, day, jnp.asarray(noise), ticks=packets).telemetry
    rows = plain_day(day, noise, packets)
    for name in rows[0]:
        wanted = np.stack([row[name] for row in rows])
        scale = np.abs(wanted).max()
        np.testing.assert_allclose(getattr(found, name), wanted, rtol=1e-9, atol=1e-9 * scale, err_msg=name)
    assert (found.mode == 1).all() and found.star_valid.all()


def test_the_filter_has_the_constants_of_the_specification():
    K, P = leo4.FILTER.gain[:, 0], leo4.FILTER.prior
    np.testing.assert_allclose(K, [0.0727414, -2.94840e-4], rtol=2e-6)  # as printed
    after = P - np.outer(K, P[0])
    np.testing.assert_allclose(
        [leo4.STD_INNOVATION, np.sqrt(after[0, 0]), np.sqrt(after[1, 1])],
        np.array([10.38483, 2.6971, 0.067986]) * leo4.SECOND, rtol=2e-5,
    )  # fmt: skip
    np.testing.assert_allclose(
        [leo4.STD_GYRO, leo4.RRW], [1.83973e-5, 2.42407e-8], rtol=6e-6
    )  # the last digit is cut off


def test_a_steady_filter_solves_its_riccati_equation():
    rng = np.random.default_rng(1)
    F, H = 0.5 * rng.normal(size=(4, 4)), rng.normal(size=(2, 4))
    root = rng.normal(size=(6, 6))
    joint = root @ root.T
    Q, S, R = joint[:4, :4], joint[:4, 4:], joint[4:, 4:]
    P = steady(F, Q, H, R, S).prior
    cross = F @ P @ H.T + S
    np.testing.assert_allclose(F @ P @ F.T + Q - cross @ np.linalg.solve(H @ P @ H.T + R, cross.T), P, rtol=1e-8)
    with pytest.raises(ValueError, match="must have a steady filter"):
        steady(np.diag([2.0]), [[1.0]], [[0.0]], [[1.0]])


@pytest.mark.short
def test_days_are_the_same_in_all_cells_but_for_the_fault():
    numbers = np.arange(64)
    healthy = worlds.days(WORLD, KEY, numbers, None)
    for cell in (
        ("gyro_bias", 3.06),
        ("star_noise", 2.0),
        ("gyro_bias+wheel_offset", (1.0, 2.0)),
        ("star_frozen", 1.0),
    ):
        day = worlds.days(WORLD, KEY, numbers, cell)
        for name in day._fields:
            if name not in ("gyro", "star", "wheel", "box"):
                assert all(np.array_equal(a, b) for a, b in zip(*(jax.tree.leaves(getattr(d, name)) for d in (healthy, day)))), name  # fmt: skip
        onset, truth = worlds.onset_of(WORLD, day), worlds.true_channels(WORLD, day)
        assert (onset >= 0).all() and (onset < 540).all() and np.ptp(onset) > 400
        assert set(truth.sum(1)) == {3 if cell[0].startswith("star") else len(cell[0].split("+"))}
    assert np.isinf(worlds.onset_of(WORLD, healthy)).all() and set(healthy.mode) == {0.0, 1.0}
    pair = worlds.days(WORLD, KEY, numbers, ("gyro_bias+gyro_bias", (1.0, 2.0)))
    sizes = np.sort(np.abs(pair.gyro.bias) / leo4.SECOND, axis=1)
    np.testing.assert_allclose(sizes, np.tile([0, 0, 1, 2], (64, 1)), rtol=1e-5)


@pytest.mark.short
def test_an_intermittent_fault_comes_every_five_seconds():
    day = jax.tree.map(
        lambda a: np.asarray(a[0], float), worlds.days(WORLD, KEY, np.array([4]), ("gyro_intermittent", 1e4))
    )
    day = day._replace(gyro=day.gyro._replace(onset=np.where(np.isfinite(day.gyro.onset), 3.0, np.inf)))
    quiet = np.zeros((100, 55))
    gyro = simulate(leo4.system, leo4.params, day, jnp.asarray(quiet), ticks=100).telemetry.gyro[:40].reshape(200, 4)
    channel = int(np.argmin(day.gyro.onset))
    on = np.abs(np.diff(np.asarray(gyro[:, channel]), prepend=gyro[0, channel])) > 1e-2
    np.testing.assert_allclose(0.1 * np.flatnonzero(on), [3, 4, 8, 9, 13, 14, 18, 19], atol=1e-9)


@pytest.mark.parametrize("cell", ["gyro_bias", ("gyro_bias",), ("no_fault", 1.0), ("gyro_bias", -1.0), ("gyro_bias+star_bias", (1.0,))])  # fmt: skip
def test_what_is_no_cell_is_refused(cell):
    with pytest.raises((ValueError, TypeError), match="`cell` must"):
        kinds.effects(cell)


# detectors


def residual_past():
    """A covariance, 128 packets of residuals, and the GLR's memory of them."""
    covariance = np.diag(np.square(STD))
    for i in range(3):
        covariance[i, 4 + i] = covariance[4 + i, i] = 0.06 * STD[0] * STD[4]
    r = np.random.default_rng(2).normal(size=(128, 7)) * STD
    params = baselines.glr_params(covariance, bank.laws())
    a, b, c, d = params.whiten
    return covariance, r, params, np.stack([a * r[:, :3], b * r[:, :3] + c * r[:, 4:]], 1), d * r[:, 3][:, None, None]


def glr_statistics(params, axes, parity):
    found = zip(
        correlations(params.axis, axes), correlations(params.parity, parity), params.gyro, params.star, params.wheel
    )
    parts = [(product(g, jnp.concatenate([a[0], p[0]])), s * a[1], product(w, a[2])) for a, p, g, s, w in found]
    return jnp.abs(jnp.stack([jnp.concatenate(part) for part in parts]))


@pytest.mark.short
def test_the_glr_is_the_direct_convolution_alone_and_in_a_batch():
    covariance, r, params, axes, parity = residual_past()
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    z, filters = r @ root.T, bank.signatures() @ root.T
    wanted = [
        [abs(np.sum(filters[h, :lag] * z[128 - lag :])) / np.linalg.norm(filters[h, :lag]) for h in range(11)]
        for lag in baselines.LAGS
    ]
    axes, parity = (np.asarray(a, np.float32) for a in (axes, parity))
    np.testing.assert_allclose(glr_statistics(params, axes, parity), wanted, atol=1e-5)
    wide = lambda a: jnp.asarray(a)[..., None] * jnp.array([1.0, -1.0, 2.0])
    many = jax.vmap(lambda a, b: glr_statistics(params, a, b), in_axes=-1, out_axes=-1)(wide(axes), wide(parity))
    np.testing.assert_allclose(many[..., 2], 2 * np.array(wanted), atol=3e-5)


def test_products_are_those_of_matrices_in_every_batch():
    rng = np.random.default_rng(3)
    M, x = rng.normal(size=(3, 4, 5)), rng.normal(size=(3, 5, 7))
    wanted = np.einsum("hij,hjn->hin", M, x)
    np.testing.assert_allclose(jax.vmap(product, (None, -1), -1)(M, x), wanted, rtol=1e-12)
    np.testing.assert_allclose(
        jax.vmap(product, (-1, None), -1)(np.stack([M, 2 * M], -1), x[..., 0])[..., 1], 2 * wanted[..., 0]
    )
    np.testing.assert_allclose(product(M, x[..., 0]), wanted[..., 0])


@pytest.mark.short
def test_the_bank_adds_up_what_its_filters_believe():
    """A fault that is there in the residuals raises the odds of its own hypothesis."""
    covariance = np.diag(np.square(STD))
    params = jax.tree.map(jnp.asarray, bank.bank_params(covariance))
    shape, step = bank.signatures(40), jax.jit(bank.believed)
    for h, size in ((2, 20 * leo4.SECOND), (5, 60 * leo4.SECOND), (9, 2e-3)):
        x, odds = jnp.zeros((11, 14)), jnp.full(11, 1e-5)
        for r in size * shape[h]:
            x, odds = step(params, x, odds, jnp.asarray(r, jnp.float32))
        assert int(jnp.argmax(odds)) == h and float(jnp.sum(odds)) > 10


def test_no_detector_can_pass_the_oracle_which_has_its_closed_form():
    np.testing.assert_allclose([oracle.bound(kind) for kind in oracle.STEPS], [2.69, 20.4, 0.143], rtol=0.01)
    found = [oracle.delay("star_bias", size) for size in leo4_days.SIZED["star_bias"]]
    np.testing.assert_allclose(found, [58.0, 53.4, 36.0, 8.15, 1.41, 0.55, 0.26, 0.25], rtol=0.02)


def test_the_bound_of_coloured_noise_is_that_of_what_is_new_in_it():
    """r_k = rho r_(k-1) + e_k: the bound is that of white noise e, for the response s_k - rho s_(k-1)."""
    rho, std, kind = -0.4, np.array(STD), "wheel_offset"
    r = np.random.default_rng(0).normal(size=(3000, 120, 7)) * std
    for k in range(1, 120):
        r[:, k] += rho * r[:, k - 1]
    channels, unit = oracle.STEPS[kind]
    response = bank.signatures(20)[channels] * unit
    new = response - rho * np.pad(response, ((0, 0), (1, 0), (0, 0)))[:, :-1]
    needed = 3.454 + 1.645
    wanted = np.mean(needed / np.sqrt(np.sum((new / std) ** 2, axis=(1, 2))))
    assert oracle.coloured(kind, r[:, 40:], past=5.0) == pytest.approx(wanted, rel=0.03)
    assert wanted < 0.8 * oracle.bound(kind)


# metrics


def test_a_tally_keeps_the_value_at_the_first_event():
    values, events = [1.0, 2.0, 3.0, 4.0], [False, True, False, True]
    kept = [scores.held(np.array([v, -v]), np.array([e, False])) for v, e in zip(values, events)]
    total = scores.empty(jax.tree.map(jnp.asarray, kept[0]))
    for tally in kept:
        total = scores.add(total, tally)
    np.testing.assert_array_equal(scores.values(total), [2.0, np.nan])


def test_isotonic_regression_is_the_nearest_rising_sequence():
    rng = np.random.default_rng(4)
    for _ in range(20):
        y, w = rng.normal(size=6), rng.uniform(0.5, 2, 6)
        cost = lambda f, y=y, w=w: np.sum(w * (f - y) ** 2)
        best = metrics.isotonic(y, w)
        assert (np.diff(best) >= 0).all()
        for _ in range(200):
            assert cost(np.sort(best + 0.1 * rng.normal(size=6))) >= cost(best) - 1e-12
    assert metrics.detectable([1, 2, 4], [0.0, 0.9, 1.0], [1, 1, 1]) == pytest.approx(2 * 2**0.5)
    assert metrics.detectable([1, 2, 4], [0.0, 0.9, 0.9], [1, 1, 1]) == np.inf


def test_ranks_follow_holm_and_copies_tie():
    rng = np.random.default_rng(5)
    days = rng.uniform(0, 60, (3, 200, 1))
    first = np.concatenate([days, days, np.minimum(days + 5, 80)], axis=2)
    difference, error = metrics.paired(first, np.ones_like(first, bool), np.full(3, 1 / 3))
    assert error[0, 1] == 0 and difference[0, 1] == 0 and difference[2, 0] > 3
    np.testing.assert_array_equal(metrics.ranks(difference, error), [1, 1, 3])


def test_weights_are_means_over_sizes_kinds_and_units():
    cells = [(kind, size) for kind, sizes in worlds.CATALOGUE["leo4"].items() for size in sizes]
    weights = metrics.weights_of(cells, leo4_days.SIZED)
    assert weights.sum() == pytest.approx(1) and len(cells) == 83 and np.count_nonzero(weights) == 64
    assert weights[[kind == "star_bias" for kind, _ in cells]].sum() == pytest.approx(1 / 6)


def test_uneven_alarms_are_found_out_and_even_ones_are_not():
    rng = np.random.default_rng(6)
    chances = [metrics.time_dependent(rng.poisson(0.5, (500, 6))) for _ in range(200)]
    assert abs(np.mean(np.array(chances) < 0.1) - 0.1) < 0.07
    assert metrics.time_dependent(rng.poisson([1, 1, 0.2, 0.2, 0.2, 0.2], (500, 6))) < 1e-10


def test_a_threshold_is_the_quantile_of_run_maxima():
    maxima = np.random.default_rng(7).exponential(size=20_000)
    h, low, high = calibration.threshold_of(maxima, 0.1, 600.0)
    assert low < h < high and h == pytest.approx(-np.log(1 - np.exp(-1 / 60)), rel=0.05)
    rate, least, most = calibration.rate_of(200, 12_000, 600.0)
    assert least < rate < most and rate == pytest.approx(0.1008, rel=1e-3)


@pytest.mark.short
def test_a_gradient_at_a_fixed_rate_is_that_of_central_differences():
    """An EWMA of white noise: 12 000 windows, a rate at which every tenth has an alarm; common noise."""
    how = jax.random.key(0), 12_000, 600, 1.2
    here, central = ewma_at_rate(0.1, *how), ewma_central(0.1, 0.02, *how)
    assert here["total"] == pytest.approx(central, rel=0.1)
    assert here["slope"] > 4 * here["error"] and here["total"] > 1.2 * here["partial"]  # the threshold's part matters


def test_the_slope_of_a_threshold_is_that_of_the_maxima_next_to_it():
    rng = np.random.default_rng(8)
    maxima = rng.exponential(size=4000)
    h, *_ = calibration.threshold_of(maxima, 1.0, 600.0)
    slope, error = calibration.threshold_slope(maxima, np.stack([maxima, np.ones(4000)], 1), h)
    np.testing.assert_allclose(slope, [h, 1.0], atol=3 * error[0])  # M = x M0 has dh/dx = h
    assert error[1] == 0


def scaled(x):
    return (MINE.params * x[0],)


@pytest.mark.short
def test_slopes_of_a_score_that_is_scaled_are_the_score():
    brief = WORLD._replace(window=50.0)
    days = worlds.days(WORLD, KEY, np.arange(4), ("star_bias", 65.2))
    days = days._replace(star=days.star._replace(onset=np.where(np.isfinite(days.star.onset), 310.0, np.inf)))
    told, moved = slopes(brief, [MINE], KEY, days, [1.0], scaled, threshold=[[40.0, 40.0]], width=4.0)
    assert told.peak.shape == (4, 1) and moved.peak.shape == (4, 1, 3)
    np.testing.assert_allclose(moved.peak[..., 0], told.peak, rtol=1e-5)
    assert not moved.peak[..., 1:].any()
    hold, slew = moved.delay[:, 0, 1:].T
    assert (hold[::2] > 0).all() and (slew[1::2] > 0).all() and not hold[1::2].any() and not slew[::2].any()
    assert (told.delay > 0).all() and (told.delay < 10).all()
    # x s - h = x (s - h / x): the delay at (x, h) is that at (1, h / x) of a width over x
    more, _ = slopes(brief, [MINE], KEY, days, [1.25], scaled, threshold=[[50.0, 50.0]], width=5.0)
    np.testing.assert_allclose(more.delay, told.delay, rtol=1e-3)


def test_a_calibration_tells_how_its_threshold_moves(monkeypatch):
    """Of made-up windows whose largest score is x[0] times an exponential one, the threshold is as much of its slope."""
    monkeypatch.setattr(calibration, "run", made_up)

    def softly(world, rows, key, days, numbers, params_of, **_):
        peak = made_up(world, rows, key, days).peak
        slope = np.stack([peak / numbers[0], 0 * peak, 0 * peak], axis=-1)
        return Softly(peak, None), Softly(slope, None)

    monkeypatch.setattr(calibration, "slopes", softly)
    found = calibrate(
        WORLD, [MINE, MINE._replace(name="two")], KEY, hours=400, gradient=([2.0], lambda x: (x[0], x[0]))
    )
    assert found.slope.shape == found.slope_error.shape == (2, 2, 1)
    assert (np.abs(found.slope[..., 0] - found.threshold / 2) < 4 * found.slope_error[..., 0]).all()
    assert calibrate(WORLD, [MINE, MINE._replace(name="two")], KEY, hours=400).slope is None
    with pytest.raises(TypeError, match="must return a tuple of params, one a detector"):
        calibrate(WORLD, [MINE], KEY, gradient=([2.0], lambda x: x[0]))
    with pytest.raises(ValueError, match=r"`gradient\[0\]` must be finite numbers"):
        calibrate(WORLD, [MINE], KEY, gradient=([np.nan], scaled))

    monkeypatch.setattr(descent, "slopes", lambda *a, threshold=None, width=1.0: tuple(
        s._replace(delay=s.peak) for s in softly(*a)))  # fmt: skip
    step = descent.at_fixed_rate(WORLD, MINE, KEY, [2.0], scaled, hours=400, days=2)
    np.testing.assert_allclose(step.gradient, step.partial)  # the made-up delay knows no threshold
    np.testing.assert_allclose(step.partial, step.cost / 2)
    assert step.slope.shape == (2, 1) and step.threshold.shape == (2,)


def test_isolation_gives_the_even_guess_ln_of_one_in_eleven():
    truth = np.eye(11, dtype=bool)[[4]]
    assert metrics.log_score(np.ones((1, 1, 11)), truth)[0, 0] == pytest.approx(np.log(1 / 11))
    assert metrics.log_score(np.eye(11)[[4]][:, None], truth)[0, 0] == pytest.approx(np.log(0.99 + 0.01 / 11))


# rules and ranking


def nis_step(params, z, telemetry):
    z = 0.9 * z + jnp.sum(telemetry.innovation**2) * params
    return z, Verdict(z, jnp.ones(11, z.dtype))


MINE = Detector("mine", lambda params: jnp.zeros(()), nis_step, np.float32(1 / leo4.STD_INNOVATION**2), 1)


@pytest.mark.parametrize(
    "spoiled, said",
    [
        (MINE._replace(step=lambda p, z, t: (z, Verdict(t.innovation, jnp.ones(11)))), "a score of shape"),
        (MINE._replace(step=lambda p, z, t: (z, Verdict(z, jnp.ones(3)))), "a blame of shape"),
        (MINE._replace(step=lambda p, z, t: ((z, z), Verdict(z, jnp.ones(11)))), "must return z as it got it"),
        (MINE._replace(step=lambda p, z, t: z), "must return z, Verdict"),
    ],
)
def test_a_step_of_the_wrong_shape_is_refused_by_name(spoiled, said):
    with pytest.raises(TypeError, match=f"`mine.step` {'must return ' if said.startswith('a ') else ''}.*{said}"):
        rank([spoiled])


def test_a_board_needs_detectors_of_different_names_and_enough_hours():
    for arguments, said in ((([],), "at least one"), (([MINE, MINE],), "differ")):
        with pytest.raises(ValueError, match=said):
            rank(*arguments)
    with pytest.raises(ValueError, match="`hours` must"):
        rank([MINE], hours=10)
    with pytest.raises(ValueError, match="`ruleset` must"):
        rank([MINE], ruleset="mine")


def test_a_detector_with_a_callback_is_not_pure_and_its_numbers_change_the_key():
    def told(params, z, telemetry):
        jax.debug.callback(lambda a: None, z)
        return nis_step(params, z, telemetry)

    record = WORLD.example()
    assert rules.pure(MINE, record) and not rules.pure(MINE._replace(step=told), record)
    other = MINE._replace(params=np.float32(1.0))
    assert (
        rules.digest(MINE, record) == rules.digest(MINE._replace(name="other"), record) != rules.digest(other, record)
    )
    seeds = {rules.seed_of(WORLD, [d], "1", record) for d in (MINE, other, MINE._replace(name="other"))}
    assert len(seeds) == 3


def test_the_harness_reports_what_the_telemetry_says():
    """One day of each mode against its telemetry, played to the detector packet by packet."""
    days = worlds.days(WORLD, KEY, np.arange(2), ("gyro_stuck", 1.0))
    flat = baselines.REFERENCE[3]
    found = run(WORLD, [MINE, flat], KEY, days, threshold=[[40.0, 40.0], [1.5, 1.5]], excess=[2e-3, 2e-3])
    assert {a.dtype for a in jax.tree.leaves(found) if a.dtype.kind == "f"} == {np.dtype(np.float32)}
    onset = worlds.onset_of(WORLD, days)
    for i in range(2):
        log = rerun(leo4.system, short(leo4.params), days, KEY, i, ticks=WORLD.packets)
        score, t = np.zeros(WORLD.packets), 0.5 * (np.arange(WORLD.packets) + 1) - WORLD.warmup
        for k, nu in enumerate(np.asarray(log.telemetry.innovation, float)):
            score[k] = 0.9 * (score[k - 1] if k else 0) + nu @ nu / leo4.STD_INNOVATION**2
        inside, after = t > 0, t > onset[i]
        assert found.peak[i, 0] == pytest.approx(score[inside].max(), rel=1e-4)
        assert found.last[i, 0] == pytest.approx(score[-1], rel=1e-3)
        hits = np.flatnonzero((score > 40) & after & inside)
        delay = t[hits[0]] - onset[i] if len(hits) else np.inf
        assert found.first[i, 0] == pytest.approx(delay, abs=1e-3)
        assert found.punctual[i, 0] == ~np.any((score > 40) & inside & ~after)
        assert (
            0 < found.first[i, 1] <= 1.5
            and found.at_alarm[i, 1].argmax() == worlds.true_channels(WORLD, days)[i].argmax()
        )
        ticks = np.arange(5 * WORLD.packets) * 0.1 - WORLD.warmup
        stop = min(onset[i] + found.first[i, 1], onset[i] + 60)
        beyond = np.maximum(np.ravel(log.pointing) - 2e-3, 0) * ((ticks >= onset[i]) & (ticks < stop))
        assert found.excess[i, 1] == pytest.approx(0.1 * beyond.sum(), abs=1e-5)


def short(tree):
    return jax.tree.map(np.float32, tree)


def made_up(world, rows, key, days, *, threshold=None, excess=None, progress=False):
    """Days of which the first row finds every fault in 5 s, the second in 50 s, the others nothing."""
    n, d = len(jax.tree.leaves(days)[0]), len(rows)
    rng = np.random.default_rng(int(jax.random.key_data(key)[-1]) % 2**31)
    faulty = np.isfinite(worlds.onset_of(world, days))[:, None]
    delays = np.array([5.0, 50.0, *[np.inf] * (d - 2)]) + rng.uniform(-1, 1, (n, d))
    blame = np.zeros((n, d, world.channels)) + 0.01 + worlds.true_channels(world, days)[:, None]
    hit = np.isfinite(delays) & faulty
    return Found(
        peak=rng.exponential(size=(n, d)), first=np.where(hit, delays, np.inf), punctual=np.ones((n, d), bool),
        at_alarm=np.where(hit[..., None], blame, np.nan), later=np.where(hit[..., None], blame, np.nan),
        excess=np.ones((n, d)), episodes=np.zeros((n, d)) + np.arange(d), last=rng.normal(size=(n, d)),
        sixths=rng.poisson(1.0, (n, d, 6)), unclear=np.zeros((n, d)), pointing=np.full(n, 1e-3),
    )  # fmt: skip


def test_a_ranking_of_made_up_days_says_what_they_hold(monkeypatch, tmp_path):
    monkeypatch.setattr(ranking, "run", made_up)
    monkeypatch.setattr(calibration, "run", made_up)
    monkeypatch.setattr(rules, "checked", lambda *_: rules.Checks(True, True, True, True, True, 10.0))
    deaf = Detector("deaf", lambda params: (), baselines.REFERENCE[1].step)
    board = rank([MINE, deaf], days=16, hours=400)
    mine, other = board.rows[:2]
    assert (mine["name"], mine["rank"], other["name"], other["rank"]) == ("mine", 1, "deaf", 2)
    assert mine["macro"] == pytest.approx(5, abs=0.3) and board.row("null")["macro"] == 60.0
    assert mine["units"]["star"] == pytest.approx(5, abs=0.3) and mine["p10"] == 100 and other["p10"] == 0
    assert mine["detectable"]["gyro_bias"][0] == 1.0 and other["detectable"]["gyro_bias"][0] is None
    assert mine["isolation"]["at_alarm"] > -0.15 and mine["isolation"]["right"]["gyro_bias"] == 1
    assert mine["rate"]["hold"][1] < 0.1 < mine["rate"]["hold"][2] and mine["held_out"] == pytest.approx(5, abs=0.3)
    assert other["robustness"]["rate"] == 6 and mine["notes"] == []
    assert board.pairs.difference[0, 1] == pytest.approx(-45, abs=0.5) and 0 < board.pairs.error[0, 1] < 0.3
    board.to_json(tmp_path / "board.json")
    again = type(board).from_json(tmp_path / "board.json")
    assert again == board and differences(again, rank([MINE, deaf], days=16, hours=400)) == []
    assert "mine" in board.table() and len(board.figure().axes) == 2 and "mine" in board.cards()
    with pytest.raises(ValueError, match="pass the checks of the yardstick, but it is not causal"):
        monkeypatch.setattr(rules, "checked", lambda *_: rules.Checks(False, True, True, True, True, 10.0))
        rank([MINE], days=16, hours=400)


def test_the_command_rebuilds_a_board_and_says_where_it_differs(monkeypatch, tmp_path, capsys):
    for module in (ranking, calibration):
        monkeypatch.setattr(module, "run", made_up)
    monkeypatch.setattr(rules, "checked", lambda *_: rules.Checks(True, True, True, True, True, 10.0))
    monkeypatch.setattr(command, "configure", lambda: None)
    board, path = rank([tune("chi2_10"), tune("mrp")], days=16, hours=100, cells=[("gyro_bias+wheel_offset", (1.0, 2.0)), ("star_bias", 5)]), tmp_path / "b.json"  # fmt: skip
    board.to_json(path)
    assert command.main([str(path)]) == 0 and "the same to the bit" in capsys.readouterr().out
    path.write_text(re.sub(r'"macro": \d', '"macro": 9', path.read_text(), count=1))
    assert command.main([str(path)]) == 1
    assert re.search(r"rows\[0\]\.macro: 9\S* is now [3-6]\.", capsys.readouterr().out)
    board._replace(header=board.header | {"detectors": ["mine"]}).to_json(path)
    with pytest.raises(SystemExit):
        command.main([str(path)])

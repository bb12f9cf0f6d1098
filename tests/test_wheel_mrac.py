"""The wheel test bed: its parts' laws, a plain NumPy oracle of the loop, the paper's and the reference's numbers."""

import jax

jax.config.update("jax_enable_x64", True)

import inspect  # noqa: E402
import warnings  # noqa: E402

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
from made_up import repeated, tallied  # noqa: E402
from scipy.stats import norm  # noqa: E402

import jaxatt  # noqa: E402
from experiments.wheel_mrac import HARDWARE, HARDWARE_DAY, normals_of  # noqa: E402
from jaxatt import scores  # noqa: E402
from jaxatt.contract import Now  # noqa: E402
from jaxatt.controllers import Adaptation, Mrac, mrac_flow, mrac_input, mrac_sampled_bound, mrac_step  # noqa: E402
from jaxatt.faults import Fault, Reading  # noqa: E402
from jaxatt.loops import wheel_mrac as wm  # noqa: E402
from jaxatt.observers import LeastSquares, least_squares  # noqa: E402
from jaxatt.sweeping import varied  # noqa: E402
from jaxatt.wheels import Wheel, wheel_acceleration  # noqa: E402

TICKS = 4501  # 0 to 90 s
QUIET = wm.scenario._replace(noise=0.0)
SILENCE = jnp.zeros((TICKS, 3))


def uniform(seed, amplitude=0.05, ticks=TICKS):
    """Uniform attitude noise of NumPy's generator as a noise array for one scenario."""
    return normals_of(np.random.default_rng(seed).uniform(-amplitude, amplitude, ticks), amplitude)


def portable(ticks, amplitude=0.05, seed=12345):
    """The reference's linear congruential noise."""
    v = []
    for _ in range(ticks):
        seed = (1103515245 * seed + 12345) % 2**31
        v.append(amplitude * (2 * seed / 2**31 - 1))
    return np.array(v)


EIGHT, FIVE = wm.system_of(substeps=8), wm.system_of(substeps=5)


def together(pairs, noise, system=EIGHT):
    """Logs, as NumPy arrays (runs, ticks), of up to six (params, scenario) that meet the same noise.

    Always six: one program serves all.
    """
    run = lambda p, s: jaxatt.simulate(system, p, s, noise, ticks=TICKS)
    six = side_by_side(*pairs, *[pairs[-1]] * (6 - len(pairs)))
    return jax.tree.map(lambda a: np.asarray(a)[: len(pairs)], jax.vmap(run)(*six))


def short(params, scenario, noise=SILENCE, ticks=1000):
    """The log, as NumPy arrays, of the first ticks, up to a thousand; one program serves all."""
    noise = jnp.zeros((1000, 3)).at[:ticks].set(noise[:ticks])
    log = jaxatt.simulate(FIVE, params, scenario, noise, ticks=1000)
    return jax.tree.map(lambda a: np.asarray(a)[:ticks], log)


def side_by_side(*trees):
    """Several scenarios, or pairs of params and scenario, as one tree whose leaves lead with them."""
    return jax.tree.map(lambda *leaves: np.array(leaves, float), *trees)


def rms(a):
    return np.sqrt(np.mean(np.square(a), axis=-1))


def peak(a):
    return np.abs(a).max(axis=-1)


# adaptive control


@pytest.mark.parametrize("b_p", [20.0, -20.0])
def test_lyapunov_identity(b_p):
    """V = e^2/2 + |b_p| / (2 gamma) (a_r~^2 + a_y~^2) falls as -a_m e^2, for either sign of b_p."""
    a_p, a_m, b_m = 8.0, 10.0, 10.0
    law = Adaptation(gamma=1e-6, sign=np.sign(b_p))
    r, y, y_m, a_r, a_y = np.random.default_rng(1).normal(size=(5, 100)) * [[1e4], [1e4], [1e4], [1], [1]]
    mrac = Mrac(y_m, a_r, a_y)
    rate = mrac_flow(mrac, law, r, y, a_m, b_m)
    y_rate = wheel_acceleration(Wheel(a=a_p, b=b_p), y, mrac_input(mrac, r, y))
    e = y - y_m
    off_r, off_y = a_r - b_m / b_p, a_y - (a_p - a_m) / b_p
    v_rate = e * (y_rate - rate.y_m) + abs(b_p) / law.gamma * (off_r * rate.a_r + off_y * rate.a_y)
    np.testing.assert_allclose(v_rate, -a_m * e * e, rtol=1e-9, atol=1e-3)


def test_options_of_the_adaptation():
    mrac, r, y = Mrac(90.0, 1.0, -2.0), 300.0, 100.0
    plain = mrac_flow(mrac, Adaptation(), r, y, 10.0, 10.0)
    np.testing.assert_allclose([plain.a_r, plain.a_y], [-1e-6 * 10 * 300, -1e-6 * 10 * 100])
    slower = mrac_flow(mrac, Adaptation(normalise=1e-4), r, y, 10.0, 10.0)
    np.testing.assert_allclose(slower.a_r, plain.a_r / (1 + 1e-4 * 1e5))
    leaky = mrac_flow(mrac, Adaptation(leak=0.1), r, y, 10.0, 10.0)
    np.testing.assert_allclose([leaky.a_r - plain.a_r, leaky.a_y - plain.a_y], [-0.1, 0.2])
    walled = mrac_flow(mrac, Adaptation(limit=1.0), r, y, 10.0, 10.0)
    np.testing.assert_allclose([walled.a_r, walled.a_y], [plain.a_r, 0.0])  # one falls from its wall, one would leave
    stepped = mrac_step(mrac, Adaptation(), r, y, 0.02)
    np.testing.assert_allclose(stepped, [90.0, 1 + 0.02 * plain.a_r, -2 + 0.02 * plain.a_y])
    assert mrac_step(Mrac(0.0, 1.0, -1.0), Adaptation(gamma=1.0, limit=1.0), -r, y, 1.0).a_r == 1.0


def spectral_radius(speed, gamma=1e-6, dt=wm.DT):
    """Of one tick of the sampled loop at y = y_m = r = speed on the matching line; without the neutral direction."""
    law = Adaptation(gamma=gamma)

    def one_tick(v):
        y, a_r, a_y = v
        mrac = Mrac(speed, a_r, a_y)
        u = mrac_input(mrac, speed, y)
        step = lambda y, _: (jaxatt.rk4(lambda t, y: wheel_acceleration(Wheel(), y, u), 0.0, y, dt / 20), None)
        y, _ = jax.lax.scan(step, y, None, length=20)
        mrac = mrac_step(mrac, law, speed, v[0], dt)
        return jnp.array([y, mrac.a_r, mrac.a_y])

    values = np.linalg.eigvals(np.asarray(jax.jit(jax.jacfwd(one_tick))(jnp.array([speed, 0.5, 0.0]))))
    neutral = np.argmin(np.abs(values - 1))  # a_r r + a_y y stays
    np.testing.assert_allclose(values[neutral], 1, atol=1e-9)
    return np.abs(np.delete(values, neutral)).max()


def test_bound_of_sampled_adaptation():
    radii = [spectral_radius(3500.0), spectral_radius(3540.0), spectral_radius(19257.0)]
    assert np.all(np.abs(np.array(radii) - [0.9982, 1.0002, 2.49]) <= [1e-4, 1e-4, 5e-3])
    law = Adaptation(gamma=1e-6)
    limits = [np.sqrt(mrac_sampled_bound(law, wm.DT, 10.0, 20.0, a_y) / 2) for a_y in (0.0, -0.2)]
    np.testing.assert_allclose(limits, [3535.5, 4183.3], atol=0.1)
    assert abs(spectral_radius(limits[0]) - 1) < 1e-3 > abs(spectral_radius(limits[0] * 10, 1e-8) - 1)
    normalised = Adaptation(gamma=1e-6, normalise=1e-8)
    bound = mrac_sampled_bound(normalised, wm.DT, 10.0, 20.0)
    np.testing.assert_allclose(1e-6 / (1 + 1e-8 * bound) * bound * wm.DT, 0.5, rtol=1e-12)
    assert mrac_sampled_bound(Adaptation(gamma=1e-6, normalise=1e-6), wm.DT, 10.0, 20.0) == np.inf


# least squares


def test_least_squares_solves_its_equations_exactly():
    """For a constant regressor one long step, many short ones and the closed form agree."""
    start, W, y, t = LeastSquares(-1.4e-4, 1e-6), 4e4, -5.0, 3.0
    once = least_squares(start, W, y, t)
    many = start
    for _ in range(300):
        many = least_squares(many, W, y, t / 300)
    decay = 1 / (1 + start.P * W**2 * t)
    np.testing.assert_allclose(once, [y / W + (start.a - y / W) * decay, start.P * decay], rtol=1e-12)
    np.testing.assert_allclose(many, once, rtol=1e-12)
    assert least_squares(start, 1e9, y, t).P > 0  # forward Euler: -2e6
    assert least_squares(start, 0.0, y, t) == start


def test_least_squares_is_weighted_regression():
    """With forgetting the estimate minimises the exponentially weighted squares, prior included."""
    rng = np.random.default_rng(3)
    W, dt, forget = rng.normal(size=40), 0.1, 0.7
    y = 2 * W + rng.normal(size=40)
    estimate = LeastSquares(0.5, 4.0)
    for w, v in zip(W, y):
        estimate = least_squares(estimate, w, v, dt, forget)
    age = np.arange(40)[::-1]
    weight = dt * np.exp(-forget * dt * age)
    prior = np.exp(-forget * dt * 40) / 4.0
    expected = (prior * 0.5 + weight @ (W * y)) / (prior + weight @ W**2)
    np.testing.assert_allclose(estimate.a, expected, rtol=1e-12)
    np.testing.assert_allclose(estimate.P, 1 / (prior + weight @ W**2), rtol=1e-12)


@pytest.mark.parametrize(
    ("regressor", "P0", "J"),
    [
        ("attitude", 1e-6, 5.42099997),
        ("attitude", 1e-6 * wm.PER_RAD2, 5.420912),
        ("rate", 1e-6, 5.420949),
        ("rate", 1e-6 * wm.PER_RAD2, 5.300715),
    ],
)
def test_closed_form_of_the_estimate(regressor, P0, J):
    """a~ = a~(0) / (1 + P0 int W^2) over the slew, by the estimator itself on noise-free data."""
    t = (np.arange(4500) + 0.5) * wm.DT
    a = -wm.J_WHEEL / 5.421
    W = (np.asarray(wm.slew(wm.params, t)[0]) if regressor == "attitude" else wm.slew(wm.params, t)[1]) / a

    def step(estimate, w):
        return least_squares(estimate, w, w * a, wm.DT), None

    estimate, _ = jax.lax.scan(step, LeastSquares(jnp.asarray(-wm.J_WHEEL / 5), jnp.asarray(P0)), jnp.asarray(W))
    np.testing.assert_allclose(-wm.J_WHEEL / estimate.a, J, atol=1e-5)
    start = 1 / 5 - 1 / 5.421
    np.testing.assert_allclose(1 / (1 / 5.421 + start / (1 + P0 * np.sum(W**2) * wm.DT)), J, atol=1e-5)


# the loop against a plain oracle


def oracle(params, scenario, v, ticks, substeps, sampled):
    """The loop of the reference written down once more, in plain floats. Rows: theta, y, a_r, a_y, r, a, P."""
    p, s, dt = params, scenario, wm.DT
    a_z = -s.J_w / s.J_z
    theta_w = y = y_m = predicted = then = read_then = 0.0
    ar, ay, a_hat, P = p.a_r, p.a_y, -p.J_w / p.J_hat, p.P0
    rows = []
    for k in range(ticks):
        t = k * dt
        measured = a_z * theta_w + v[k]
        if p.ope and k:
            w, z = ((theta_w - then) / dt, (measured - read_then) / dt) if p.differenced else (theta_w, measured)
            P = P / (np.exp(-p.forget * dt) + P * w**2 * dt)
            a_hat, P = min(a_hat - P * w * (w * a_hat - z) * dt, -p.J_w / p.J_most), min(P, p.P0)
        arg = 5 * (t - p.duration / 2) / p.duration
        target = p.turn / 2 * (np.tanh(arg) / np.tanh(2.5) + 1)
        rate = p.turn / 2 * 5 / p.duration / np.cosh(arg) ** 2 / np.tanh(2.5)
        predicted, then = (predicted + a_hat * (theta_w - then) if p.differenced else a_hat * theta_w), theta_w
        read_then = measured
        feedback = predicted + p.blend * (measured - predicted) if p.ope else measured
        r = (p.forward * rate + p.K * (target - feedback)) / a_hat
        rows.append([a_z * theta_w, y, ar, ay, r, a_hat, P])
        held = ar * r + ay * y

        def f(state, r=r, held=held):
            y, y_m, _, ar, ay = state
            u = held if sampled else ar * r + ay * y
            fade = np.exp(-((y / s.wheel.slow) ** 2)) * np.tanh(y / s.wheel.creep)
            slope = 0.0 if sampled else -p.law.gamma * (y - y_m)
            y_rate = -s.wheel.a * y + s.wheel.b * u - s.wheel.friction * fade
            return np.array([y_rate, -p.a_m * y_m + p.b_m * r, y, slope * r, slope * y])

        euler = -p.law.gamma * (y - y_m) * dt if sampled else 0.0
        state, h = np.array([y, y_m, theta_w, ar + euler * r, ay + euler * y]), dt / substeps
        for _ in range(substeps):
            k1 = f(state)
            k2 = f(state + h / 2 * k1)
            k3 = f(state + h / 2 * k2)
            k4 = f(state + h * k3)
            state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        y, y_m, theta_w, ar, ay = state
    return np.array(rows)


@pytest.mark.parametrize(
    ("params", "scenario", "sampled"),
    [
        (wm.mrac_only, wm.scenario, False),
        (wm.params, wm.scenario, False),
        (wm.params._replace(differenced=1.0, blend=0.3, forward=0.9, turn=-60.0, forget=0.1), wm.scenario, False),
        (HARDWARE, HARDWARE_DAY._replace(noise=0.05), True),
    ],
)
def test_loop_agrees_with_the_oracle(params, scenario, sampled):
    ticks, v = 400, portable(400)
    np.testing.assert_allclose(v[:3], [0.0155154048, -0.0195185677, 0.0174960634], atol=1e-10)
    if sampled:
        system, noise = wm.system_of(sampled=True, substeps=5), normals_of(v, 0.05)
        log = jaxatt.simulate(system, params, scenario, noise, ticks=ticks)
    else:
        log = short(params, scenario, normals_of(v, 0.05), ticks)
    ours = np.stack([log.theta, log.y, log.a_r, log.a_y, log.r, -params.J_w / log.J_hat, log.P], axis=1)
    np.testing.assert_allclose(log.step, np.diff(log.r, prepend=log.r[0]), atol=1e-9)
    theirs = oracle(params, scenario, v, ticks, 5, sampled)
    scale = np.abs(theirs).max(0)
    np.testing.assert_allclose(ours / scale, theirs / scale, atol=1e-10)


# the reference's numbers


@pytest.fixture(scope="module")
def noise_free():
    return together([(wm.mrac_only, QUIET), (wm.params, QUIET)], SILENCE)


def test_noise_free_paper_case(noise_free):
    """Spec, 8.1."""
    log = noise_free
    np.testing.assert_allclose(peak(log.error), [0.21402, 0.03614], atol=1e-4)
    np.testing.assert_allclose([log.a_r[0, -1], log.a_y[0, -1]], [0.70477, -0.20253], atol=1e-4)
    np.testing.assert_allclose(log.J_hat[1, [1000, 4500]], [5.42091, 5.42100], atol=1e-4)
    np.testing.assert_allclose(log.target[0, [0, -1]], [0, 90], atol=1e-12)
    np.testing.assert_allclose(log.target_rate[0, [0, 2250, -1]], [0.0673825, 2.5339183, 0.0673825], atol=1e-7)
    ideal = -log.r_ideal[0, [0, 1000, 2250, 3000]] * 1.0
    np.testing.assert_allclose(ideal, [512.10, 4245.15, 19257.49, 10293.49], atol=0.01)


@pytest.mark.slow
def test_integration_has_converged():
    """Spec, 1.2: 20 against 40 substeps, 6e-13 deg and 3.5e-7 deg/s there; the order of the method besides."""
    ends = [
        jaxatt.simulate(wm.system_of(substeps=n), wm.params, QUIET, SILENCE[:2300], ticks=2300) for n in (10, 20, 40)
    ]
    coarse, fine = (np.abs(ends[i].y - ends[2].y).max() for i in (0, 1))
    assert fine < 1e-6 and 12 < coarse / fine < 22
    assert np.abs(ends[1].theta - ends[2].theta).max() < 1e-11


def test_uniform_noise():
    """Spec, 8.2, with NumPy's generator, seed 1."""
    log = together([(wm.mrac_only, wm.scenario), (wm.params, wm.scenario)], uniform(1))
    assert 0.255 < peak(log.measured[0]) < 0.272
    peaks, levels = peak(log.measured[:, 500:]), rms(log.measured[:, 500:])
    assert 0.22 < peaks[1] / peaks[0] < 0.25
    assert abs(levels[1] / levels[0] - 0.25) < 0.01
    np.testing.assert_allclose(log.J_hat[1, -1], 5.4210, atol=2e-4)
    assert np.all(np.abs(rms(np.diff(log.r[:, 500:])) - [287, 10.5]) <= [10, 0.2])
    np.testing.assert_allclose([log.a_r[0, -1], log.a_y[0, -1]], [0.670, -0.169], atol=1e-3)


def test_the_estimate_from_rates_finds_the_inertia():
    differenced = wm.params._replace(differenced=1.0)
    log = short(differenced, QUIET)
    assert log.J_hat[0] == pytest.approx(5.0) and log.J_hat[-1] == pytest.approx(QUIET.J_z, rel=1e-3)


def test_scores_are_those_of_the_log():
    onset = 14.0
    scenarios = repeated(wm.scenario._replace(drive=Fault(onset=onset, scale=0.05)), 2)
    got = jaxatt.sweep(FIVE, wm.params, scenarios, jax.random.key(3), ticks=TICKS, score=wm.score)
    log = jaxatt.rerun(FIVE, wm.params, scenarios, jax.random.key(3), 1, ticks=TICKS)
    off = np.abs(np.asarray(log.J_hat) - wm.scenario.J_z) > 0.005 * wm.scenario.J_z
    assert off[0] and not off[-1] and got.J_settling[1] == pytest.approx(wm.DT * np.nonzero(off)[0][-1])
    windows = slice(0, 1000), slice(1000, 3000), slice(3000, None)
    for i, window in enumerate(windows):
        np.testing.assert_allclose(got.spans[i][1], np.ptp((log.r - log.r_ideal)[window]))
        np.testing.assert_allclose(got.peaks[i][1], np.abs(log.error[window]).max())
    t = wm.DT * np.arange(TICKS)
    late, faulty = t >= 10, t >= onset
    error, measured = np.abs(log.error), np.abs(log.measured)
    assert (
        got.settling_faulty[1] == pytest.approx(t[faulty & (error > 0.05)][-1] - onset) and got.settling_faulty[1] > 0
    )
    assert got.delay[1] == pytest.approx(t[faulty & log.alarm][0] - onset) and got.delay[1] < 1
    found = {
        "peak": error.max(), "peak_late": error[late].max(), "rms": rms(error), "rms_late": rms(error[late]),
        "peak_measured": measured.max(), "peak_measured_late": measured[late].max(), "rms_measured_late": rms(measured[late]),
        "mean_measured": measured.mean(), "chatter": rms(log.step[late]), "peak_speed": np.abs(log.y).max(), "a_y": log.a_y[-1],
        "a_r": log.a_r[-1], "false_alarms": log.alarm[late & ~faulty].mean(), "peak_residual_faulty": np.abs(log.residual[faulty]).max(),
        "peak_faulty": error[faulty].max(),
    }  # fmt: skip
    for name, value in found.items():
        np.testing.assert_allclose(getattr(got, name)[1], value, rtol=1e-9, err_msg=name)
    some, dt = jax.tree.map(lambda a: a[:700:10], log), 10 * wm.DT  # before the fault, r is close to y
    t, squares = dt * np.arange(70), np.stack([some.r**2, some.y**2])
    wheel = wm.scenario.wheel
    bound = lambda gamma: mrac_sampled_bound(Adaptation(gamma=gamma), dt, wheel.a, wheel.b, some.a_y)
    gamma = 1.25e-6 / np.max(squares.sum(axis=0)[t >= 10] / bound(1e-6)[t >= 10])  # the sum passes the bound
    over = (t >= 10) & (squares.sum(axis=0) >= bound(gamma))
    fast = wm.params._replace(law=Adaptation(gamma=gamma))
    assert tallied(wm.score, fast, wm.scenario, some, dt).unstable_at == pytest.approx(t[over][0])
    first = np.argmax(over)
    assert (squares[:, first] < bound(gamma)[first]).all()


@pytest.mark.slow
def test_gaussian_noise():
    """Spec, 3.2: a standard deviation of 0.05/3 fits the paper (0.259 deg), one of 0.05 does not (0.355)."""
    n = 128
    spread = np.where(np.arange(n) < n // 2, 0.05 / 3, 0.05)
    scenarios = repeated(wm.scenario, n)._replace(uniform=np.zeros(n), noise=spread)
    got = jaxatt.sweep(FIVE, wm.mrac_only, scenarios, jax.random.key(0), ticks=TICKS, score=wm.score)
    assert got.ok.all() and np.isinf(got.failed_at).all() and np.isinf(got.flipped_at).all()
    small, large = got.peak_measured[: n // 2], got.peak_measured[n // 2 :]
    assert abs(np.median(small) - 0.259) < 0.01 and abs(np.median(large) - 0.355) < 0.03


@pytest.mark.parametrize(
    ("onset", "residual", "error", "settling"),
    [
        (45.0, [259.8, 1009.8, 2294.9, 5643.8], [0.01395, 0.01395, 0.01395, 0.05922], [0, 0, 0, 0.16]),
        (15.0, [205.7, 634.9, 1411.8, 2370.3], [0.01395, 0.01986, 0.05897, 0.16528], [0, 0, 0.66, 2.22]),
    ],
)
def test_loss_of_effectiveness(onset, residual, error, settling):
    """Spec, 6, first table; NumPy's generator, seed 1."""
    scales = [1.0, 0.8, 0.5, 0.2, 0.05]
    pairs = [(wm.params, wm.scenario._replace(drive=Fault(onset=onset, scale=s))) for s in scales]
    bounded = wm.scenario._replace(drive=Fault(onset=onset, scale=0.5), wheel=Wheel(u_max=10000.0))
    log = together([*pairs, (wm.params, bounded)], uniform(1))
    # half of 20 * 10000 cannot hold 10 * 19257: the wheel falls short, and the attitude with it
    assert peak(log.y[5, 2500:]) < 10000 * 1.01 and peak(log.error[5]) > 5
    log = jax.tree.map(lambda a: a[:5, round(onset / wm.DT) :], log)
    np.testing.assert_allclose(peak(log.residual)[1:], residual, rtol=0.02)
    np.testing.assert_allclose(peak(log.error)[1:], error, rtol=0.02)
    np.testing.assert_allclose((log.a_r + log.a_y)[1:, -1], [0.62660, 0.99985, 2.4942, 9.9702], rtol=0.02)
    assert not log.alarm[0].any() and np.all(np.argmax(log.alarm[1:], axis=1) == 1)  # 0.02 s
    outside = np.abs(log.error) > 0.05
    last = [wm.DT * np.nonzero(o)[0][-1] if o.any() else 0.0 for o in outside[1:]]
    np.testing.assert_allclose(last, settling, rtol=0.02, atol=1e-9)


def test_friction_growth():
    """Spec, 6: friction that comes at 60 s is seen only once the wheel is slow."""
    sizes = np.array([1e4, 3e4, 1e5, 3e5])
    params = HARDWARE._replace(J_hat=5.0, ope=1.0)
    pairs = [
        (params, wm.scenario._replace(wheel=Wheel(creep=max(100.0, F / 300)), friction=Fault(onset=60.0, bias=F)))
        for F in sizes
    ]
    log = together(pairs, uniform(1), wm.sampled)
    np.testing.assert_allclose(np.argmax(log.alarm[:, 3000:], axis=1) * wm.DT, [15.38, 13.74, 12.38, 11.38], rtol=0.02)
    np.testing.assert_allclose(peak(log.error[:, 3000:]), [0.082, 0.205, 0.473, 0.667], rtol=0.02)


def test_hardware():
    """Spec, 4 and 8.5: hunting at both ends, quiet between."""
    variants = [
        (HARDWARE, HARDWARE_DAY),
        (HARDWARE, HARDWARE_DAY._replace(wheel=Wheel())),
        (HARDWARE, HARDWARE_DAY._replace(wheel=Wheel(weakness=0.98))),
        (HARDWARE, HARDWARE_DAY._replace(wheel=Wheel(dead_drive=3e4))),
    ]
    log = together(variants, uniform(1, 0.01), wm.sampled)
    windows = [slice(0, 1000), slice(1000, 3000), slice(3000, None)]
    peaks = np.array([peak(log.error[:, w]) for w in windows]).T
    spans = np.array([np.ptp((log.r - log.r_ideal)[:, w], axis=1) for w in windows]).T
    assert peaks[0].max() < 0.25 and spans[0, 0] >= 3 * spans[0, 1] <= spans[0, 2]
    np.testing.assert_allclose(spans[0], [2329, 445, 1469], rtol=2e-3)
    expected = [[0.235, 0.028, 0.163], [0.006, 0.013, 0.012], [0.087, 0.013, 0.012], [0.280, 0.013, 0.241]]
    np.testing.assert_allclose(peaks, expected, atol=6e-4)


def test_disturbance_that_the_prediction_does_not_see():
    """Spec, 3.2: an attitude ramp of 0.01 deg/s; the error of MRAC only is small, that with estimation is not."""
    params = [wm.mrac_only._replace(J_hat=5.421), wm.params._replace(J_hat=5.421)]
    blended = params[1]._replace(blend=1.0)
    log = together([(p, QUIET._replace(momentum=0.01 * 5.421)) for p in (*params, blended)], SILENCE)
    np.testing.assert_allclose(peak(log.error)[:2], [0.043, 0.202], atol=5e-4)
    np.testing.assert_allclose(log.J_hat[1, -1], 5.373, atol=5e-4)
    assert peak(log.error[2]) < 0.1  # measured attitude in the feedback


def test_momentum_and_torque():
    """J_z w_z + J_w w_w = h + int tau, the balance behind eq. (1)."""
    scenario = QUIET._replace(momentum=0.3, torque=1e-3)
    log = short(wm.params, scenario, ticks=500)
    total = 5.421 * np.asarray(log.rate) + wm.J_WHEEL * np.asarray(log.y)
    np.testing.assert_allclose(total, 0.3 + np.rad2deg(1e-3) * np.arange(500) * wm.DT, atol=1e-12)


# failures


@pytest.mark.slow
def test_divergence_is_flagged_and_stays_in_its_scenario():
    """Spec, 8.4: at 50 Hz gamma = 1e-6 diverges, 1e-8 does not; a mis-set sign diverges at once."""
    gains = [Adaptation(gamma=1e-6), Adaptation(gamma=1e-8), Adaptation(gamma=1e-8, sign=-1.0)]
    pairs = [(wm.mrac_only._replace(law=law), QUIET) for law in gains]
    log = together(pairs, SILENCE, wm.sampled)
    failed = log.failed
    assert failed[:, -1].tolist() == [True, False, True]
    assert 30 < np.argmax(failed[0]) * wm.DT < 40
    assert np.isnan(log.error[0, failed[0]]).all() and np.isfinite(log.error[0, ~failed[0]]).all()
    words = r"gamma` = 1e-06 s/deg\^2, sampled every 0.02 s, .* up to 3536 .* needs 19257"
    with pytest.warns(UserWarning, match=words) as warned:
        got = jaxatt.sweep(
            varied(wm.sampled), (), side_by_side(*pairs[:2]), jax.random.key(0), ticks=2000, score=varied(wm.score)
        )
    assert warned[0].filename == __file__
    assert got.ok.tolist() == [False, True] and np.isinf(got.failed_at[1]) and np.isinf(got.unstable_at[1])
    np.testing.assert_allclose(got.failed_at[0], np.argmax(failed[0]) * wm.DT, atol=1e-9)
    assert 15 < got.unstable_at[0] < 25.96


@pytest.mark.short
@pytest.mark.slow
def test_gradient_past_a_divergence_is_finite():
    system = wm.system_of(sampled=True, substeps=2)

    def cost(log_gamma):
        params = wm.mrac_only._replace(law=Adaptation(gamma=jnp.exp(log_gamma)))
        log = jaxatt.simulate(system, params, QUIET, SILENCE[:1900], ticks=1900)
        return jnp.sum(jnp.where(log.failed, 0, log.error) ** 2), log.failed[-1]

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        (value, failed), gradient = jax.value_and_grad(cost, has_aux=True)(jnp.log(1e-6))
    assert failed and np.isfinite(value) and np.isfinite(gradient)


def test_sign_flip_of_the_estimate_is_flagged_and_undone():
    """An estimator whose first readings are noise would turn the sign of a; the command never does."""
    params = wm.params._replace(P0=1e3)
    log = short(params, wm.scenario, uniform(2), 500)
    assert log.flipped.any() and np.all(log.J_hat > 0) and log.J_hat.max() <= 1e3 * (1 + 1e-9)
    assert np.isfinite(log.r).all()


def test_known_negative_gain_is_no_failure(noise_free):
    params = wm.mrac_only._replace(a_r=-1.0, a_y=-0.5, law=Adaptation(sign=-1.0))
    log = together([(params, QUIET._replace(wheel=Wheel(b=-20.0)))], SILENCE)
    np.testing.assert_allclose(log.error[0], noise_free.error[0], atol=1e-9)


BAD = [
    (wm.params._replace(J_hat=0.0), wm.scenario, "`params.J_hat` must be a positive number, but it is 0."),
    (wm.params._replace(P0=-1e-6), wm.scenario, "`params.P0` must be a positive number, but it is -1e-06."),
    (
        wm.params._replace(law=Adaptation(gamma=-1e-6)),
        wm.scenario,
        "`params.law.gamma` must not be negative, but it is -1e-06.",
    ),
    (
        wm.params._replace(law=Adaptation(sign=0.5)),
        wm.scenario,
        "`params.law.sign` must be one of (-1, 1), but it is 0.5.",
    ),
    (
        wm.params._replace(J_most=4.0),
        wm.scenario,
        "`params.J_most` must be greater than params.J_hat, but it is 4.",
    ),
    (wm.params._replace(turn=np.nan), wm.scenario, "`params.turn` must be finite, but it is nan."),
    (wm.params, wm.scenario._replace(J_z=-1.0), "`scenario.J_z` must be a positive number, but it is -1."),
    (wm.params, wm.scenario._replace(J_w=0.0), "`scenario.J_w` must be a positive number, but it is 0."),
    (
        wm.params,
        wm.scenario._replace(wheel=Wheel(b=0.0)),
        "`scenario.wheel.b` must not be zero (no command could turn the wheel), but it is 0.",
    ),
    (
        wm.params,
        wm.scenario._replace(wheel=Wheel(friction=-1.0)),
        "`scenario.wheel.friction` must not be negative, but it is -1.",
    ),
    (
        wm.params,
        wm.scenario._replace(wheel=Wheel(weakness=1.5)),
        "`scenario.wheel.weakness` must lie in [0, 1], but it is 1.5.",
    ),
    (wm.params, wm.scenario._replace(delay=0.3), "`scenario.delay` must lie in 0 to 0.2 s, but it is 0.3."),
    (wm.params, wm.scenario._replace(noise=-0.1), "`scenario.noise` must not be negative, but it is -0.1."),
]


@pytest.mark.parametrize(("params", "scenario", "words"), BAD)
def test_bad_input_is_refused_in_one_line(params, scenario, words):
    with pytest.raises(ValueError) as caught:
        jaxatt.simulate(wm.system, params, scenario, SILENCE[:5], ticks=5)
    assert str(caught.value) == words


def test_a_bad_loop_is_refused():
    for dt in (0.0, -0.02):
        with pytest.raises(ValueError, match="`dt` must be a positive number, but it is"):
            wm.system_of(dt=dt)
    with pytest.raises(ValueError, match="`substeps` must be a whole number of at least 1, but it is 0"):
        wm.system_of(substeps=0)
    assert wm.system_of(sampled=True, substeps=10) is wm.system_of(substeps=10, sampled=True, dt=0.02) is wm.sampled
    assert wm.system_of() is wm.system


def test_adaptation_too_fast_for_the_integration_is_warned_of():
    """sqrt(b gamma (r^2 + y^2)) = 122 rad/s at the peak with the paper's gamma."""
    fast = wm.mrac_only._replace(law=Adaptation(gamma=1e-4))
    platform = wm.params.turn / 2 * 5 / (wm.params.duration * np.tanh(2.5))  # [deg/s] at its fastest
    wheel = platform * wm.scenario.J_z / wm.scenario.J_w
    words = (
        rf"gamma` = 0.0001 .* in steps of 0.005 s, is stable only .* up to 6325 deg/s, but the slew needs {wheel:.0f} "
    )
    check = wm.system_of(substeps=4).check
    with pytest.warns(UserWarning, match=words):
        check(fast, QUIET)
    softened = Adaptation(gamma=1e-4, normalise=1e-8)
    limit = 14142  # [deg/s] there b gamma 2 y^2 / (1 + 2e-8 y^2) = (2 / 0.005 s)^2
    np.testing.assert_allclose(np.sqrt(20 * 2e-4 * limit**2 / (1 + 2e-8 * limit**2)), 2 / 0.005, rtol=1e-4)
    with pytest.warns(UserWarning, match=rf"only .* up to {limit} deg/s"):
        check(fast._replace(law=softened), QUIET)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(wm.mrac_only, QUIET)


# sensors


def test_sensors():
    """Supplied noise arrives as given; readings may be late, coarse, or noisy and held between ticks."""
    v, ticks = portable(300), 300
    normals = np.random.default_rng(4).normal(size=ticks)
    noise = SILENCE.at[:ticks].set(normals_of(v, 0.05).at[:, 1].set(normals))
    days = [wm.scenario, QUIET._replace(delay=0.06), QUIET._replace(tacho_step=64.0), QUIET._replace(tacho_noise=20.0)]
    log = jax.tree.map(lambda a: a[:, :ticks], together([(wm.mrac_only, day) for day in days], noise))
    np.testing.assert_allclose((log.error - log.measured)[0], v, atol=1e-15)
    np.testing.assert_allclose((log.target - log.measured)[1, 3:], log.theta[1, :-3], atol=1e-12)
    read = log.residual + log.y_m
    np.testing.assert_allclose(read[2], 64 * np.round(read[2] / 64), atol=1e-9)
    np.testing.assert_array_less(np.abs(read - log.y)[2], 32.0001)
    np.testing.assert_allclose((read - log.y)[3], 20 * normals, atol=1e-9)


@pytest.mark.parametrize("uniform, unit", [(0.0, 0.3), (1.0, 2 * norm.cdf(0.3) - 1)])
def test_one_tick_draws_and_holds_what_the_channels_say(uniform, unit):
    noise, last = jnp.array([0.3, -0.7, 1.1]), 100.0 + np.arange(wm.DELAYS + 1)
    day = wm.scenario._replace(
        uniform=uniform, tacho_noise=2.0, delay=0.06, wheel=wm.scenario.wheel._replace(friction=10.0),
        drive=Fault(onset=0.5, random=3.0, scale=0.8), friction=Fault(onset=0.5, bias=30.0, scale=0.5),
    )  # fmt: skip
    x, z = jax.tree.map(jnp.asarray, wm.init(wm.params, day))
    x = x._replace(theta=jnp.asarray(5.0), y=jnp.asarray(7.0))
    readings = wm.Readings(Reading(jnp.asarray(99.0), True), Reading(jnp.asarray(55.0), True))
    assert z.sensors.line.value.shape == z.sensors.line.valid.shape == last.shape
    line = z.sensors.line._replace(value=jnp.asarray(last))
    z = z._replace(sensors=z.sensors._replace(line=line, readings=readings))
    now = Now(jnp.asarray(50), jnp.asarray(1.0), wm.DT)
    _, after, _ = wm.system.tick(wm.params, day, now, x, z, noise)
    np.testing.assert_allclose(after.sensors.line.value, [5 + 0.05 * unit, *last[:-1]], rtol=1e-12)
    told = lambda after: [reading.value for reading in after.sensors.readings]
    np.testing.assert_allclose(told(after), [last[2], 7 - 2 * 0.7], rtol=1e-12)  # three ticks ago
    np.testing.assert_allclose(after.drive, [0.8, 3 * 1.1], rtol=1e-12)
    np.testing.assert_allclose(after.friction, 0.5 * 10 + 30, rtol=1e-12)
    stuck = Fault(onset=0.5, stuck=1.0)
    day = day._replace(delay=wm.DELAYS * wm.DT, attitude=stuck, tacho=stuck, drive=stuck)
    _, after, _ = wm.system.tick(
        wm.params, day, now, x, z._replace(memory=z.memory._replace(u=jnp.asarray(44.0))), noise
    )
    np.testing.assert_allclose(after.sensors.line.value[0], last[0])
    np.testing.assert_allclose(told(after), [last[-2], 55.0])  # as late as can be
    np.testing.assert_allclose(after.drive, [0.0, 44.0])
    wm.system.check(wm.params, day._replace(delay=(1 + 1e-12) * wm.DELAYS * wm.DT))  # no more than rounding: it passes


def test_on_board_code_gets_no_truth():
    assert list(inspect.signature(wm.decide).parameters) == ["params", "now", "computer", "readings"]
    assert list(inspect.signature(wm.decide_sampled).parameters) == ["params", "now", "computer", "readings"]


# many runs, gradients


def test_sweep_and_single_runs_agree():
    rng = np.random.default_rng(5)
    n, ticks, key = 3, 1000, jax.random.key(4)
    scenarios = repeated(wm.scenario, n)._replace(
        J_z=5 + rng.random(n), noise=0.05 * rng.random(n), delay=0.1 * rng.random(n)
    )
    swept = jaxatt.sweep(FIVE, wm.params, scenarios, key, ticks=ticks, score=wm.score)
    for i in range(n):
        noise = jaxatt.noise_of(FIVE, key, i, ticks)
        single = short(wm.params, jax.tree.map(lambda a, i=i: a[i], scenarios), noise)
        np.testing.assert_allclose(swept.rms[i], rms(single.error), rtol=1e-9)


def objective(theta, noise, ticks, system):
    """The reference's cost over a batch of losses of effectiveness."""
    log_K, log_gamma, log_P0 = theta
    params = wm.params._replace(K=jnp.exp(log_K), law=Adaptation(gamma=jnp.exp(log_gamma)), P0=jnp.exp(log_P0))

    def run(scale):
        scenario = wm.scenario._replace(drive=Fault(onset=4.0, scale=scale))
        return jaxatt.simulate(system, params, scenario, noise, ticks=ticks)

    log = jax.vmap(run)(jnp.array([1, 0.8, 0.5, 0.2]))
    return jnp.mean(log.error**2) + 1e-8 * jnp.mean(log.step**2)


@pytest.mark.short
@pytest.mark.slow
def test_gradient_is_the_central_difference():
    """Spec, 8.6."""
    ticks, system = 500, EIGHT
    noise = uniform(1, ticks=ticks)
    theta = jnp.log(jnp.array([1.0, 1e-6, 1e-6]))
    both = jax.jit(jax.value_and_grad(lambda theta: objective(theta, noise, ticks, system)))
    gradient = np.asarray(both(theta)[1])
    h = 1e-4
    difference = [(both(theta.at[i].add(h))[0] - both(theta.at[i].add(-h))[0]) / (2 * h) for i in range(3)]
    np.testing.assert_allclose(gradient, difference, rtol=1e-5)
    assert np.all(np.abs(gradient) > 0)


@pytest.mark.slow
def test_single_precision_runs():
    single = lambda tree: jax.tree.map(lambda a: np.float32(a), tree)
    log = jaxatt.simulate(EIGHT, single(wm.params), single(wm.scenario), uniform(1).astype(jnp.float32), ticks=TICKS)
    assert log.error.dtype == jnp.float32
    assert abs(np.abs(log.error).max() - 0.0362) < 2e-3 and abs(float(log.J_hat[-1]) - 5.421) < 2e-3


def test_span_of_a_window():
    parts = [
        scores.span(jnp.asarray(v), jnp.asarray(inside)) for v, inside in ((3.0, True), (9.0, False), (-1.0, True))
    ]
    assert (parts[0] + parts[1] + parts[2]).value() == 4.0
    assert np.isnan(parts[1].value())


@pytest.mark.parametrize("gone", [Reading(np.nan, True), Reading(999.0, False)])
def test_what_is_missing_moves_no_parameter_and_raises_no_alarm(gone):
    """The attitude is expected from the wheel's turns, the wheel speed from the reference model."""
    p = wm.params._replace(blend=0.3, forget=0.1)
    mrac, dt = Mrac(700.0, 0.9, 0.3), wm.DT
    memory = wm.Memory(LeastSquares(-1e-4, 1e-7), 650.0, 0.0, 12.0, True, -1000.0, 0.1)
    computer, now = wm.Computer(mrac, -1010.0, memory), Now(jnp.asarray(9), 0.18, dt)
    blind, (residual, alarmed, flipped) = wm.decide_sampled(p, now, computer, wm.Readings(gone, gone))
    known = blind.memory
    assert residual == 0 and not alarmed and not flipped and not known.fresh
    np.testing.assert_allclose(known.estimate, [-1e-4, 1e-7 * np.exp(0.1 * dt)], rtol=1e-12)  # it forgets, no more
    np.testing.assert_allclose([known.theta, known.predicted], [12.0 + 1e-3, 0.101], rtol=1e-12)
    np.testing.assert_allclose([blind.mrac.a_r, blind.mrac.a_y], [0.9, 0.3], rtol=1e-12)
    np.testing.assert_allclose(known.u, 0.9 * known.r + 0.3 * 700.0, rtol=1e-12)
    for flow in (wm.computer_flow, wm.computer_flow_sampled):
        rate = flow(p, blind, wm.Readings(gone, gone))
        assert rate["turns"] == 700.0 and rate["mrac"].a_r == 0 == rate["mrac"].a_y
    rated = p._replace(differenced=1.0)
    read = wm.Readings(Reading(12.5, True), Reading(700.0, True))
    again = wm.decide(rated, now, blind, read)[0].memory  # no rate of readings over a gap
    assert again.fresh and again.theta == 12.5 and again.estimate.a == known.estimate.a
    assert (
        wm.decide(rated, now, blind._replace(memory=again, turns=-1030.0), read)[0].memory.estimate.a
        != again.estimate.a
    )


def test_a_late_reading_is_missing_when_it_was_taken_in_the_gap():
    day = wm.scenario._replace(delay=2.5 * wm.DT, attitude=Fault(onset=1.0, end=1.0 + wm.DT, missing=1.0))
    x, z = wm.init(wm.params, day)
    there = []
    for k in range(48, 56):
        sensors = wm.sense(wm.params, day, Now(k, k * wm.DT, wm.DT), x, z, np.zeros(3))
        z = z._replace(sensors=sensors)
        there.append(bool(sensors.readings.theta.valid))
    assert there == [True, True, True, True, False, False, True, True]  # ticks 52 and 53 read between 49.5 and 50.5


@pytest.mark.parametrize("differenced", [0.0, 1.0])
@pytest.mark.parametrize("turns", [-2, 1])
def test_a_sensor_that_starts_anew_at_a_turn_changes_nothing(differenced, turns):
    p = wm.params._replace(blend=0.3, differenced=differenced)
    memory = wm.Memory(LeastSquares(-1e-4, 1e-7), 650.0, 0.0, 179.9, True, -1000.0, 0.1)
    computer, now = wm.Computer(Mrac(700.0, 0.9, 0.3), -1010.0, memory), Now(jnp.asarray(9), 0.18, wm.DT)
    read = lambda theta: wm.Readings(Reading(theta, True), Reading(700.0, True))
    for a, b in zip(
        jax.tree.leaves(wm.decide(p, now, computer, read(180.2))),
        jax.tree.leaves(wm.decide(p, now, computer, read(180.2 + 360 * turns))),
        strict=True,
    ):
        np.testing.assert_allclose(b, a, rtol=1e-9)

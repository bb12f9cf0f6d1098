"""Abuse of what shares a torque and of friction: any rank of the axes, any subset, any speed and size.

50 examples an entry, ``JAXATT_FUZZ=2000`` for the long run. Every example has its right value: NumPy's pseudo-inverse, or
a law that holds for all numbers.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from abuse import fuzzed
from hypothesis import given
from hypothesis import strategies as st

from jaxatt.vec import Vec3
from jaxatt.wheels import Friction, TorqueWheel, Wheel, allocation, held_torque, minimax, null_part, wheel_acceleration

N = 4
angle = st.floats(-3.2, 3.2, allow_subnormal=False)
size = st.sampled_from([0.0, 1e-300, 1e-12, 1e-6, 0.1, 1.0, 3.0, 1e3, 1e6])
signed = st.builds(lambda a, sign: a * sign, size, st.sampled_from([1.0, -1.0]))


@st.composite
def axes(draw):
    """W (3, 4) of unit axes, of rank one, two or three and all between."""
    rows = []
    for _ in range(N):
        kind = draw(st.sampled_from(["free", "same", "opposite", "near", "in plane"]))
        a, b = draw(angle), draw(angle)
        w = np.array([np.cos(a) * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)])
        if rows and kind == "same":
            w = rows[draw(st.integers(0, len(rows) - 1))]
        elif rows and kind == "opposite":
            w = -rows[-1]
        elif rows and kind == "near":
            w = rows[-1] + draw(st.sampled_from([1e-3, 1e-6])) * w
        elif len(rows) > 1 and kind == "in plane":
            w = a * rows[0] + rows[1]
        length = np.linalg.norm(w)
        rows.append(w / length if length > 0.1 else np.array([0.0, 0, 1]))
    return np.array(rows).T


ups = st.lists(st.sampled_from([0.0, 1.0]), min_size=N, max_size=N).map(np.array)
torques = st.lists(st.floats(-1, 1, allow_subnormal=False), min_size=3, max_size=3).map(np.array)


@jax.jit
def shared(T, W, up):
    """Allocation, minimax, null part of ones, and the gradient of the allocation by the axes."""
    T = Vec3.of(T)
    slope = jax.grad(lambda W: jnp.sum(allocation(T, W, up)))(W)
    return allocation(T, W, up), minimax(T, W, up), null_part(jnp.ones(N), W, up), slope


@fuzzed
@given(torques, axes(), ups)
def test_a_torque_is_shared_at_any_rank(T, W, up):
    u, least, null, slope = map(np.asarray, shared(T, W, up))
    sigma = np.linalg.svd(W * up, compute_uv=False)
    cut = N * np.finfo(float).eps * sigma[0]
    assert np.isfinite(slope).all() and not u[up == 0].any() and not least[up == 0].any()
    if ((sigma > cut / 100) & (sigma < 1e3 * cut)).any():
        return  # the rank itself is a matter of rounding
    kept = sigma[sigma > cut]
    exact = np.linalg.pinv(W * up, rcond=2 * N * np.finfo(float).eps)
    spread = 1e-13 * (kept[0] / kept[-1] if kept.size else 1) * (1 + np.abs(exact).max())
    np.testing.assert_allclose(u, exact @ T, atol=spread)
    np.testing.assert_allclose(W @ null, 0, atol=spread)
    if kept.size == 3:
        np.testing.assert_allclose(W @ least, T, atol=10 * spread * (1 + np.abs(least).max()))


@jax.jit
def rubbed(wheel, y, u):
    """dy/dt with and without friction, and the gradient of the first."""
    free = wheel._replace(friction=0.0, stiction=0.0, viscous=0.0)
    slope = jax.grad(wheel_acceleration, argnums=(0, 1, 2))(wheel, y, u)
    return wheel_acceleration(wheel, y, u), wheel_acceleration(free, y, u), slope


@fuzzed
@given(signed, signed, size, size, st.sampled_from([0.0, 0.5]), st.sampled_from([0.0, 10.0]))
def test_friction_in_the_flow_gives_no_power(y, u, friction, stiction, viscous, a):
    wheel = Wheel(a=a, friction=friction, stiction=stiction, viscous=viscous, slow=1e4)
    with_friction, without, slope = rubbed(jax.tree.map(float, wheel), y, u)
    assert np.isfinite(jax.tree.leaves(slope)).all()
    given_power = (float(with_friction) - float(without)) * y
    assert given_power <= 1e-14 * abs(float(without) * y)
    if y == 0 and stiction > 0 and abs(float(without)) <= max(friction, stiction):
        assert with_friction == 0


@partial(jax.jit, static_argnums=3)
def coasting(wheel, y, h, steps):
    one = lambda y: y + h * wheel_acceleration(wheel, y + h / 2 * wheel_acceleration(wheel, y, 0.0), 0.0)
    return jax.lax.scan(lambda y, _: (one(y),) * 2, y, length=steps)[1]


@fuzzed
@given(st.floats(-500, 500), st.floats(50, 1000), st.floats(50, 1000), st.sampled_from([1e-4, 1e-3, 1e-2]))
def test_a_coasting_wheel_slows_down_and_stops(y, friction, stiction, h):
    wheel = Wheel(a=0.0, friction=friction, stiction=stiction, slow=np.inf)
    speed = np.abs(np.append(y, coasting(jax.tree.map(float, wheel), y, h, 2000)))
    assert (np.diff(speed) <= 1e-12 * speed[:-1]).all()
    if 2000 * h > abs(y) / friction + 0.5:
        assert speed[-1] < 1e-6


@jax.jit
def held(motor, speed, dt, friction):
    wheel = TorqueWheel(J=1e-3, friction=friction)
    return held_torque(wheel, motor, speed, dt), jax.grad(held_torque, argnums=(1, 2))(wheel, motor, speed, dt)


@fuzzed
@given(signed, signed, st.sampled_from([1e-3, 0.1, 1.0]), size, size, st.sampled_from([0.0, 1e-6, 1.0]))
def test_friction_held_over_a_tick_gives_no_power(motor, speed, dt, coulomb, more, viscous):
    n, slope = held(motor, speed, dt, Friction(coulomb, coulomb + more, 3.0, viscous))
    assert np.isfinite(slope).all()
    after = speed + dt * float(n) / 1e-3
    free = speed + dt * motor / 1e-3
    scale = abs(speed) + abs(dt * motor / 1e-3)
    assert (after - free) * free <= 1e-12 * scale**2 and abs(after) <= abs(free) + 1e-12 * scale  # it only brakes

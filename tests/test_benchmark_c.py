"""The benchmark's C program, and its plain loops, compute what the system computes."""

import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import observer_pd as bench
from benchmarks.measure import c_library
from jaxatt import noise_of, sweep
from jaxatt.loops.observer_pd import params, score
from jaxatt.vec import Vec3

jax.config.update("jax_enable_x64", True)

TICKS = 300
P = params._replace(q_d=Vec3(0.1, -0.2, 0.3), w_d=Vec3(0.0, 0.0, 0.01), u_max=60.0)


@pytest.fixture(scope="module")
def libraries():
    if shutil.which("gcc") is None:
        pytest.skip("no gcc")
    source = Path(bench.__file__).with_suffix(".c")
    quick = "-O1", "-DINLINE=static"  # -O3 of vectors wider than the machine's takes gcc minutes
    return {np.float64: c_library(source, "double", *quick), np.float32: c_library(source, "float", *quick)}


def test_a_loaded_library_leaves_small_numbers_alone(libraries):
    tiny = np.array([5e-324, 1e-45])
    assert np.all(tiny * 1 > 0) and np.all(tiny.astype(np.float32)[1:] * np.float32(1) > 0)


def agree(a, b, tolerance):
    """Scores agree in every scenario; in float32, where single scenarios amplify rounding, in their median."""
    for name, x, y in zip(a._fields, a, b):
        x, y = np.asarray(x, float), np.asarray(y, float)
        if tolerance > 1e-6:
            assert (np.isfinite(x) == np.isfinite(y)).all(), name
            x, y = x[np.isfinite(x)], y[np.isfinite(x)]
            error = np.abs(x - y) / np.abs(x).clip(1e-30)
            assert error.size == 0 or np.median(error) <= tolerance, name
        else:
            np.testing.assert_allclose(x, y, tolerance, err_msg=name)


@pytest.mark.parametrize(
    ("form", "dtype", "tolerance"), [("shipped", np.float64, 1e-9), ("one-step", np.float32, 1e-5)]
)
def test_c_gives_the_scores_of_a_sweep_without_noise(libraries, form, dtype, tolerance):
    loop, s = bench.FORMS[form], bench.scenarios(40, dtype)
    p = jax.tree.map(lambda a: np.asarray(a, dtype), P)
    ours = sweep(bench.quiet(loop), p, s, jax.random.key(0), ticks=TICKS, score=score)
    c = bench.c_scores(libraries[dtype], p, s, ticks=TICKS, dt=loop.dt, substeps=loop.substeps)
    agree(ours, c, tolerance)


def test_c_gives_the_scores_of_a_sweep_with_its_noise(libraries):
    loop, s, key = bench.FORMS["shipped"], bench.scenarios(8, np.float64), jax.random.key(0)
    noise = np.stack([noise_of(loop, key, i, TICKS) for i in range(8)], axis=-1)
    ours = sweep(loop, P, s, key, ticks=TICKS, score=score)
    c = bench.c_scores(libraries[np.float64], P, s, ticks=TICKS, dt=loop.dt, substeps=loop.substeps, noise=noise)
    agree(ours, c, 1e-9)


def test_c_draws_standard_normal_noise(libraries):
    s = bench.scenarios(256, np.float64)
    loop = bench.FORMS["shipped"]
    run = lambda seed: bench.c_scores(
        libraries[np.float64], params, s, ticks=TICKS, dt=loop.dt, substeps=loop.substeps, noise="drawn", seed=seed
    )
    one, other = run(1), run(2)
    ours = sweep(loop, params, s, jax.random.key(0), ticks=TICKS, score=score)
    assert np.all(one.ok == 1) and np.any(one.rms_w != other.rms_w)
    for name in ("rms_q_faulty", "rms_w_faulty", "rms_u_faulty", "miss"):
        a, b, c = (np.nanmean(getattr(x, name)) for x in (one, other, ours))
        assert abs(a - c) < 0.05 * c and abs(b - c) < 0.05 * c, name


def test_plain_loops_give_the_scores_of_a_sweep():
    loop, s = bench.FORMS["shipped"], bench.scenarios(16, np.float64)
    ours = sweep(bench.quiet(loop), params, s, jax.random.key(0), ticks=TICKS, score=score)
    agree(ours, bench.numpy(loop, s, TICKS, noisy=False)(), 1e-9)
    agree(ours, jax.tree.map(jnp.asarray, bench.naive(loop, s, TICKS, noisy=False)()), 1e-9)

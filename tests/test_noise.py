import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.special import ndtri
from toy import SYSTEM

from jaxatt.noise import BLOCK, _normal, block_key, chunk_noise, noise_of, one_key

KEY = jax.random.key(5)


@pytest.fixture(scope="module")
def noise():
    """Scenarios of four blocks, shape (4, 4000, 2)."""
    return np.stack([noise_of(SYSTEM, KEY, i, 4000) for i in (0, 1, BLOCK, 5 * BLOCK + 3)])


def test_it_is_standard_normal(noise):
    assert noise.shape == (4, 4000, 2) and noise.dtype == np.float32
    assert stats.kstest(noise.ravel(), "norm").pvalue > 1e-3


def test_every_scenario_tick_and_number_has_its_own(noise):
    assert len(np.unique(noise)) > 0.99 * noise.size
    series = np.concatenate([noise[:, 1:, 0], noise[:, :-1, 0], noise[:, 1:, 1]])  # one of them a tick earlier
    correlation = np.corrcoef(series) - np.eye(len(series))
    assert np.abs(correlation).max() < 5 / np.sqrt(4000)


def test_the_noise_of_a_tick_does_not_depend_on_how_many_there_are(noise):
    np.testing.assert_array_equal(noise_of(SYSTEM, KEY, BLOCK, 7), noise[2, :7])


def test_it_is_drawn_alike_in_chunks_from_any_tick_on(noise):
    key = block_key(one_key(KEY), 0)
    chunk = chunk_noise(SYSTEM, key, jnp.asarray(13), 5, (BLOCK,), jnp.float32)
    np.testing.assert_allclose(np.asarray(chunk)[..., 1], noise[1, 13:18], rtol=3e-7)


def test_another_key_gives_other_noise_a_raw_key_the_same(noise):
    raw = noise_of(SYSTEM, jax.random.PRNGKey(5), 0, 7)
    np.testing.assert_array_equal(raw, noise[0, :7])
    assert not np.isin(noise_of(SYSTEM, jax.random.key(6), 0, 7), noise[0, :7]).any()


def test_a_loop_without_noise_gets_an_empty_array():
    assert noise_of(SYSTEM._replace(normals=0), KEY, 3, 7).shape == (7, 0)


def test_the_normal_quantile_is_exact_to_float32_rounding_over_its_range():
    words = jnp.concatenate([jnp.arange(200), 2**22 + jnp.arange(-100, 100), 2**23 - 1 - jnp.arange(200)])
    words = jnp.concatenate([words, jax.random.bits(KEY, (10_000,), jnp.uint32) >> 9]).astype(jnp.uint32)
    u = (np.asarray(words, float) + 0.5) / 2**23
    np.testing.assert_allclose(_normal(words << 9), ndtri(u), rtol=2e-6)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (dict(key=7), TypeError, r"`key` must be a key of jax\.random\.key\(seed\), but it is 7"),
        (dict(key=np.zeros(2)), TypeError, r"`key` must be a key .* of shape \(2,\) and type float64"),
        (dict(key=jax.random.key(0, impl="rbg")), TypeError, "`key` must be a threefry key, "),
        (dict(key=jax.random.split(KEY, 3)), ValueError, r"`key` must be one key, but it is of shape \(3,\)"),
        (dict(index=-1), ValueError, "`index` must be a whole number of at least 0, but it is -1"),
        (dict(ticks=0), ValueError, "`ticks` must be a whole number of at least 1, but it is 0"),
        (dict(ticks=10**9), ValueError, "`ticks` = 1000000000 takes 1.02e.03 GB, but .* GB of memory are free: ask for fewer"),
    ],
)  # fmt: skip
def test_bad_input_is_refused(change, error, message):
    with pytest.raises(error, match=f"^{message}"):
        noise_of(**dict(system=SYSTEM, key=KEY, index=0, ticks=10) | change)


@pytest.mark.parametrize("kind", ["rbg", "unsafe_rbg"])
def test_a_key_of_another_generator_is_told_apart(kind):
    with pytest.raises(
        TypeError, match=rf"`key` must be a threefry key, jax\.random\.key\(seed\), but it is one of {kind}\."
    ):
        one_key(jax.random.key(5, impl=kind))

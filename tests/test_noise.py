import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.special import ndtr, ndtri
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


def exact(word, partner):
    """The normal number of a word and its partner in float64: the quantile of p = (m + (v + 1/2) / 2^16) / 2^32."""
    m, v = (np.asarray(word, np.int64) & 0x7FFFFFFF), np.asarray(partner, np.int64) & 0xFFFF
    size = -ndtri((m + (v + 0.5) / 65536) / 2.0**32)
    return np.where(np.asarray(word, np.int64) >> 31, -size, size)


def drawn(word, partner):
    return np.asarray(jax.jit(_normal)(jnp.asarray(word, jnp.uint32), jnp.asarray(partner, jnp.uint32)), float)


def test_the_normal_quantile_is_exact_to_float32_rounding_over_its_range():
    words = np.asarray(jax.random.bits(KEY, (2, 2_000_000), jnp.uint32))
    tails = np.stack([np.arange(4096), np.arange(4096) * 40503 % 65536])
    for word, partner in (words, tails, tails + np.array([[2**31], [0]]), 2**31 - 1 - tails):
        found, true = drawn(word, partner), exact(word, partner)
        np.testing.assert_allclose(found, true, rtol=5e-7)


@pytest.mark.parametrize(
    ("word", "partner", "number"),
    [
        (0, 0, 7.86978),
        (0, 0xFFFF, 6.230261),
        (1, 0, 6.230258),
        (0x40000000, 0, 0.6744897),
        (12345, 54321, 4.535416),
        (0x80000000, 0, -7.86978),
    ],
)
def test_numbers_worked_out_by_hand(word, partner, number):
    assert drawn(word, partner) == pytest.approx(number, abs=3e-6)


@pytest.mark.parametrize(("beyond", "rtol"), [(5, 1e-3), (6, 1e-3), (6.5, 1e-3), (7, 2e-3)])
def test_the_tails_hold_their_mass(beyond, rtol):
    """Counted over all words and partners: the number falls with m + v / 2^16, so one cell holds the edge."""
    edge = ndtr(-beyond) * 2.0**32
    m = np.arange(int(edge) + 2)[-3:]
    v = np.arange(65536)
    count = int(m[0]) * 65536 + sum(int((drawn(np.full(65536, k), v) > beyond).sum()) for k in m)
    assert count / 2.0**48 == pytest.approx(ndtr(-beyond), rel=rtol)


def test_the_number_falls_with_its_probability():
    m = np.repeat(np.arange(4097), 2)
    v = np.tile([0, 65535], 4097)
    steps = np.diff(drawn(m, v))
    assert np.all(steps <= np.spacing(np.float32(8)))


def test_moments_of_four_million():
    x = drawn(*np.asarray(jax.random.bits(jax.random.key(9), (2, 4_000_000), jnp.uint32)))
    n = len(x)
    for power, mean, variance in ((1, 0, 1), (2, 1, 2), (4, 3, 96)):
        assert abs(np.mean(x**power) - mean) < 4 * np.sqrt(variance / n)


def test_partners_are_uncorrelated_where_they_share_bits():
    """The words of one block refine each other: in the far tail, where it matters, a number tells nothing of its partner."""
    v = np.asarray(jax.random.bits(jax.random.key(8), (400_000,), jnp.uint32))
    for m in (0, 1, 10):
        x, y = drawn(np.full(len(v), m), v), drawn(v, np.full(len(v), m))
        for of in (np.positive, np.abs, np.square):
            assert abs(np.corrcoef(x, of(y))[0, 1]) < 4 / np.sqrt(len(v))


@pytest.mark.parametrize("normals", [1, 3])
def test_one_run_of_few_numbers_has_tails_too(normals):
    """A single scenario draws an odd number of words: the one too many is drawn, not left at zero."""
    x = np.asarray(chunk_noise(SYSTEM._replace(normals=normals), one_key(KEY), jnp.asarray(0), 20_000, (), jnp.float32))
    assert x.shape == (20_000, normals) and len(np.unique(x)) > 0.99 * x.size
    assert stats.kstest(x.ravel(), "norm").pvalue > 1e-3


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

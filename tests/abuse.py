"""What the abuse of public entries shares: how an answer is judged, and what a user may hand in.

What meets a user's data answers with a result or with one line that names the argument, raised by our own code with no
word from inside JAX. Parts of loops have no such duty: there JAX and Python say, with the traceback, what went wrong.
50 examples per entry in ``test_fuzz*.py``; ``JAXATT_FUZZ=2000 pytest -n 2 tests/test_fuzz*.py`` is the long run.
"""

import os
import re
import traceback
import warnings
from pathlib import Path
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

import jaxatt
from jaxatt import check
from jaxatt.faults import Fault
from jaxatt.vec import Vec3

EXAMPLES = int(os.environ.get("JAXATT_FUZZ", "50"))
HOME = str(Path(jaxatt.__file__).parent)
fuzzed = settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),  # pyright: ignore[reportArgumentType]
)


def tidy():
    """Forget the programs of one entry: those of every shape of 2000 examples of all entries fill the memory."""
    if EXAMPLES > 50:
        jax.clear_caches()


def judged(f, names, /, *args, also=(), **kwargs):
    """Call f; the words of a refusal that is as it must be, or none for a result."""
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"), patch.object(check, "free_memory", lambda: 4e9):
            warnings.simplefilter("ignore")
            jax.block_until_ready(jax.tree.leaves(f(*args, **kwargs)))
        return ""
    except (ValueError, TypeError, *also) as error:
        said = str(error)
        assert "\n" not in said and len(said) < 1000, said
        named = {word for words in re.findall(r"`([^`]+)`", said) for word in re.findall(r"\w+", words)}
        assert named & {*names, *(name.removesuffix("s") for name in names)}, (
            said,
            names,
        )  # one of the faults is a fault
        assert traceback.extract_tb(error.__traceback__)[-1].filename.startswith(HOME), said
        assert error.__suppress_context__ or error.__context__ is None, said
        return said


# what a user may hand in

ODD = [
    float("nan"), float("inf"), -float("inf"), 0.0, -0.0, 1e308, -1e308, 5e-324, 1e-200, 1.0, -1.0, 0.5, 2.0, 1, 0, -3, True,
    10**400, np.float32(1e38), np.float64(3.0), np.int8(7),
]  # fmt: skip
JUNK = [
    "a", None, 1j, b"x", {}, [], object(), np.array("a"), np.array([1j, 2]), np.zeros((0,)), np.array([None, 1]),
    np.float16(1.0), np.zeros((2, 3, 4)), [1.0, "b"], {"q": 1.0}, jnp.zeros(2, jnp.complex64), jax.random.key(0),
    np.array(["2020-01-01"], "datetime64[D]"), lambda x: x,
]  # fmt: skip
SHAPES = [(), (1,), (2,), (3,), (2, 3)]
odd = st.sampled_from(ODD)
junk = st.sampled_from(JUNK)


@st.composite
def arrays(draw, shapes=None):
    shape = draw(st.sampled_from(SHAPES if shapes is None else shapes))
    kind = draw(st.sampled_from(["float64", "float64", "float32", "int32", "bool", "float16"]))
    values = [0.3, -1.2, 1.0, 0.0, 2.5, float("nan"), float("inf"), 1e30]
    size = int(np.prod(shape))
    flat = draw(st.lists(st.sampled_from(values), min_size=size, max_size=size))
    with np.errstate(all="ignore"):
        return np.asarray(flat, float).reshape(shape).astype(kind)


def plain(shapes=None):
    """A number or an array, now and then something else."""
    return st.one_of(arrays(shapes), odd, arrays(shapes), junk)


def good(low, high):
    return st.floats(low, high, allow_nan=False, allow_subnormal=False)  # which XLA flushes to zero


def tuples(kind, part=None, n=None):
    part = plain() if part is None else part
    n = len(kind._fields) if n is None else n
    whole = st.tuples(*[part] * n).map(lambda parts: kind(*parts))
    same = arrays([(n,), (n, 2)]).map(lambda a: kind(*a))  # fields of one shape
    return st.one_of(same, whole, same, junk)


@st.composite
def nearly(draw, good, wild):
    """Arguments by name: those of ``good``, which fit each other, none, one or two of them spoiled."""
    made = {name: good[name] if name in good else draw(strategy) for name, strategy in wild.items()}
    for name in draw(st.lists(st.sampled_from(list(wild)), max_size=2)):
        made[name] = draw(wild[name])
    return made


vectors = tuples(Vec3)
whole = st.one_of(st.integers(-3, 6), st.sampled_from([2**31, 10**30, 2.0, 1.5, True, "3", None, np.int64(2), np.nan]))
fault = st.one_of(tuples(Fault), st.tuples(plain(), plain()).map(lambda a: Fault(onset=a[0], bias=a[1])), junk)

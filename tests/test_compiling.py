"""What is handed to the compiler: values computed once, settings, and the cache between processes."""

import gc
import json
import os
import subprocess
import sys
import weakref
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxatt
from jaxatt.compiling import allowed_cores, compiled, in_threads, jitted, programs_at_once, shared, traced

ROOT = Path(__file__).parents[1]


def long(x):
    for _ in range(3):
        x = jnp.sin(x)
    return x


def six(x, once):
    """Six outputs, each large enough to be a kernel of its own, that use one value."""
    y = once(long, x)
    return [y[i::6] * i for i in range(6)]


# several programs at once


@pytest.mark.parametrize("jobs", [1, 3])
def test_results_come_in_order_and_no_more_is_begun_than_asked_for(jobs):
    begun = []

    def f(i):
        begun.append(i)
        return i * i

    found = in_threads(f, iter(range(50)), jobs)
    assert [next(found) for _ in range(3)] == [0, 1, 4]
    assert len(begun) <= 3 + 2 * jobs
    found.close()
    settled = len(begun)
    assert settled < 50 and list(in_threads(f, range(5), jobs)) == [0, 1, 4, 9, 16]


def test_threads_work_with_the_settings_of_their_caller():
    for wide in (False, True):
        with jax.enable_x64(wide), jax.numpy_dtype_promotion("strict"):
            kinds = list(in_threads(lambda _: jnp.zeros(1).dtype, range(3), 2))
            with pytest.raises(Exception, match="promotion"):
                list(in_threads(lambda _: jnp.zeros(1, int) + jnp.zeros(1), range(3), 2))
        assert kinds == [np.float64 if wide else np.float32] * 3


def test_cores_are_counted_and_refused():
    jaxatt.configure(cores=3)
    assert programs_at_once() == 6
    jaxatt.configure(cores=1)
    assert programs_at_once() == 1
    jaxatt.configure()
    assert programs_at_once() >= allowed_cores() >= 1
    with pytest.raises(ValueError, match=r"`cores` must be .*, but it is 0"):
        jaxatt.configure(cores=0)


# values computed once


def test_a_shared_value_is_its_value():
    x = jnp.linspace(0, 1, 12)
    for f in (lambda x: shared(long, x), jax.jit(lambda x: shared(long, x)), jax.vmap(lambda x: shared(long, x))):
        np.testing.assert_allclose(f(x), long(x), rtol=1e-14)
    assert shared(lambda a, b: a + b, 2, 3) == 5  # nothing is traced: a plain call


def test_a_shared_value_can_be_differentiated_both_ways():
    f = lambda x: shared(long, x) * x
    expected = jax.grad(lambda x: long(x) * x)(0.7)
    assert jax.grad(f)(0.7) == pytest.approx(float(expected), rel=1e-14)
    assert jax.jacfwd(jax.jit(f))(0.7) == pytest.approx(float(expected), rel=1e-14)
    assert jax.jit(jax.grad(jax.grad(f)))(0.7) == pytest.approx(float(jax.grad(jax.grad(lambda x: long(x) * x))(0.7)))


def test_a_shared_value_is_computed_once():
    sines = lambda f: str(jax.jit(f).lower(jnp.zeros(60)).compile().as_text()).count(" sine(")
    assert sines(lambda x: six(x, shared)) == 3


def test_what_a_shared_function_returns_as_it_got_it_goes_around():
    lanes = partial(jax.vmap, in_axes=-1, out_axes=-1)
    f = lanes(lambda held, a: shared(lambda held, a: dict(held=held, more=a + held[0]), held, a))
    held, a = np.arange(6.0).reshape(2, 3), np.arange(3.0)
    program = jax.make_jaxpr(f)(held, a).jaxpr
    assert program.outvars[0] is program.invars[0]
    out = f(held, a)
    assert np.array_equal(out["held"], held) and np.array_equal(out["more"], a + held[0])


def test_a_shared_value_may_be_a_tree_of_several_operands():
    f = jax.jit(lambda a, b: shared(lambda a, b: dict(sum=a["x"] + b, whole=jnp.arange(3)), a, b))
    assert jax.tree.map(lambda a: a.tolist(), f(dict(x=1.0), 2.0)) == dict(sum=3.0, whole=[0, 1, 2])


# jitted functions


def test_traced_tells_whether_something_is_being_traced():
    seen = []
    note = lambda x: seen.append((traced(x), traced(np.ones(2)))) or x
    note(1.0)
    jax.jit(note)(1.0)
    jax.grad(note)(1.0)
    assert seen == [(False, False), (True, True), (True, False)]


def cubed(n, x):
    return x**n


def test_compiled_is_one_function_with_static_arguments_also_inside_jit():
    assert compiled(cubed, 1, 2.0) is compiled(cubed, 1, 3.0)
    assert compiled(cubed, 1, 2.0)(3, 2.0) == 8
    assert jax.jit(lambda x: compiled(cubed, 1, x)(3, x))(2.0) == 8
    assert jax.grad(lambda x: compiled(cubed, 1, x)(3, x))(2.0) == 12


class Held:
    """Something that a closure holds."""


def test_nothing_is_kept_of_a_closure_once_it_and_its_program_are_gone():
    def made(held):
        return jitted(lambda x: x + len(str(held)))

    held = Held()
    alive, f = weakref.ref(held), made(held)
    f(1.0)
    del held
    assert alive() is not None
    del f
    gc.collect()
    assert alive() is None


# settings of the process: every test a process of its own


RUN = """
import sys, json, os, warnings
sys.path.insert(0, "tests")
import jax, jaxatt
from toy import SYSTEM, Params, Scenario
import numpy as np

hits = []
jax.monitoring.register_event_listener(lambda event, **_: hits.append(event) if event.endswith("/cache_hits") else None)
misses = []
jax.monitoring.register_event_listener(lambda event, **_: misses.append(event) if event.endswith("/cache_misses") else None)


def told(late=False, **how):
    if late:
        jax.numpy.zeros(()).block_until_ready()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        folder = jaxatt.configure(**how)
    return dict(folder=str(folder), said=[str(w.message) for w in said], lines=[w.filename for w in said],
                flags=os.environ.get("XLA_FLAGS", ""))


def ran():
    scenarios = Scenario(np.linspace(-1, 1, 9), np.ones(9))
    found = jaxatt.sweep(SYSTEM, Params(), scenarios, jax.random.key(1), ticks=7,
                         score=lambda p, s, now, log: jaxatt.scores.final(log.position))
    return dict(bits=found.tobytes().hex(), hits=len(hits), misses=len(misses))


print(json.dumps({code}))
"""


def process(code, cache_home, **environment):
    base = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_"))}
    environment = base | {"XDG_CACHE_HOME": str(cache_home), "PYTHONPATH": str(ROOT)} | environment
    run = subprocess.run(
        [sys.executable, "-c", RUN.replace("{code}", code)], env=environment, cwd=ROOT, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


NEEDS_FLAGS = jax.__version_info__ < (0, 13)


def test_a_second_process_takes_its_programs_from_the_cache_and_gets_the_same_bits(tmp_path):
    first, second = (process("told() | ran()", tmp_path) for _ in range(2))
    assert first["misses"] > 0 and first["hits"] == 0
    assert second["hits"] >= first["misses"]  # every program that the first stored
    assert second["bits"] == first["bits"]
    folder = Path(first["folder"])
    assert folder.parent == tmp_path / "jaxatt" and f"jax-{jax.__version__}-" in folder.name and any(folder.iterdir())


def test_configure_twice_is_configure_once(tmp_path):
    first, second = process("[told(), told(cache='elsewhere')]", tmp_path)
    assert first == second and first["said"] == []
    assert ("xla_cpu_prefer_vector_width" in first["flags"]) == (jax.__version_info__ < (0, 12))
    assert first["flags"].count("-vectorize-memory-check-threshold") == NEEDS_FLAGS


def test_configure_after_the_first_computation_warns_once_and_switches_the_cache_on(tmp_path):
    found = process("told(late=True) | ran()", tmp_path)
    assert [said.split(" comes")[0] for said in found["said"]] == ["`jaxatt.configure`"] * NEEDS_FLAGS
    assert found["lines"] == ["<string>"] * NEEDS_FLAGS  # the caller's
    assert found["flags"] == "" and any(Path(found["folder"]).iterdir())


def test_a_folder_of_ones_own_and_what_the_environment_says_are_kept(tmp_path):
    own = process(f"told(cache={str(tmp_path / 'own')!r})", tmp_path, XLA_FLAGS="--xla_cpu_prefer_vector_width=256")
    assert Path(own["folder"]).parent == tmp_path / "own"
    assert own["flags"].count("xla_cpu_prefer_vector_width") == 1
    said = process("told(cache='other')", tmp_path, JAX_COMPILATION_CACHE_DIR=str(tmp_path / "said"))
    assert said["folder"] == str(tmp_path / "said")


def test_a_folder_that_is_none_is_refused(monkeypatch):
    before = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    try:
        jax.config.update("jax_compilation_cache_dir", None)
        monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_prefer_vector_width --xla_backend_extra_options")
        with pytest.raises(TypeError, match=r"^`cache` must be a path, but it is 3\.$"):
            jaxatt.configure(cache=3)  # pyright: ignore[reportArgumentType]
    finally:
        jax.config.update("jax_compilation_cache_dir", before)

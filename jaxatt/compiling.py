"""What the compiler needs: values computed once, jitted functions with CPU settings, the compilation cache.

May import: check.
"""

from __future__ import annotations

import hashlib
import logging
import os
import platform
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import Var, jaxpr_as_fun

from jaxatt import check


def shared(f: Callable, *operands):
    """f(*operands), computed once for all that use it.

    XLA's CPU compiler repeats a shared subexpression in every output that uses it, unless a control-flow boundary
    keeps them apart. This boundary is always taken, but the compiler does not know it.
    """
    traced_operands = [leaf for leaf in jax.tree.leaves(operands) if isinstance(leaf, Tracer)]
    if not traced_operands or jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        return f(*operands)
    program, shapes = jax.make_jaxpr(f, return_shape=True)(*operands)
    given, results = [jnp.asarray(a) for a in jax.tree.leaves(operands)], program.jaxpr.outvars
    # tied to an operand, lest reverse mode on JAX 0.10 takes the branch apart before the operand is known
    always, _ = jax.lax.optimization_barrier((jnp.asarray(True), jax.lax.stop_gradient(traced_operands[0])))
    out = jax.lax.cond(always, jaxpr_as_fun(program), lambda *_: jax.tree.leaves(zeros(shapes)), *given)
    # what f returns as it got it goes around the boundary, where a batch would be turned to lead and back
    place = {variable: i for i, variable in enumerate(program.jaxpr.invars)}
    kept = [given[place[v]] if isinstance(v, Var) and v in place else a for v, a in zip(results, out)]
    return jax.tree.unflatten(jax.tree.structure(shapes), kept)


def zeros(shapes):
    """A tree of zeros of the shapes and types given."""
    return jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)


_NOTHING = np.zeros((), np.float32)


def traced(*operands) -> bool:
    """Whether the caller, or one of the operands, is being traced by jit, grad or vmap."""
    nothing = jnp.add(_NOTHING, _NOTHING)  # inside jit even 0 + 0 is a tracer
    return not check.concrete((operands, nothing))


def compiled(f: Callable, static: int, *operands) -> Callable:
    """The module-level function f jitted, its first ``static`` arguments static, with our settings for the CPU.

    A jit inside another may carry no settings, hence the look at the operands. Every f is kept for the life of the
    process: hand closures to `jitted`.
    """
    return _jitted_once(f, static, traced(*operands))


@cache
def _jitted_once(f: Callable, static: int, plain: bool):
    return jax.jit(f, static_argnums=tuple(range(static))) if plain else jitted(f, static)


def jitted(f: Callable, static: int = 0) -> Callable:
    """f jitted with our settings for the CPU; nothing is kept once f and the result are gone."""
    options = {"xla_cpu_prefer_vector_width": 512} if jax.default_backend() == "cpu" else None
    return jax.jit(f, static_argnums=tuple(range(static)), compiler_options=options)


_cores: int | None = None  # what `configure` was told


def programs_at_once() -> int:
    """How many compiled programs keep this machine busy: 1 on one core, else two a core or device, one of them waiting."""
    devices = jax.local_devices()
    if len(devices) > 1 or devices[0].platform != "cpu":
        return 2 * len(devices)
    cores = _cores or allowed_cores()
    return 2 * cores if cores > 1 else 1


def allowed_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_threads(f: Callable, items: Iterable, jobs: int | None = None) -> Generator:
    """f(item) of all items, in order, with ``jobs`` threads at work; None for `programs_at_once`, 1 for this thread.

    A device runs the programs of one thread one after the other, but those of several threads side by side.
    """
    jobs = programs_at_once() if jobs is None else jobs
    if jobs == 1 or jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        yield from map(f, items)
        return
    # settings that `with` makes hold in one thread only
    wide, promotion = jax.config.jax_enable_x64, jax.config.jax_numpy_dtype_promotion  # pyright: ignore[reportAttributeAccessIssue]

    def there(item):
        with jax.enable_x64(wide), jax.numpy_dtype_promotion(promotion):
            return f(item)

    pool, under_way = ThreadPoolExecutor(jobs), deque()
    try:
        for item in items:
            under_way.append(pool.submit(there, item))
            if len(under_way) == 2 * jobs:
                yield under_way.popleft().result()
        while under_way:
            yield under_way.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


# A loop with many results runs on vectors only after each is checked against each operand for overlap. By default more
# than eight checks are too many, and the loop runs on single numbers (`jaxatt.one_loop`).
OVERLAP_CHECKS = "-vectorize-memory-check-threshold=100000"
_OPTIONS = f"-runtime-memory-check-threshold=100000,{OVERLAP_CHECKS}"
_FLAGS: dict[str, str] = {}
if jax.__version_info__ < (0, 12):
    _FLAGS = {
        "--xla_cpu_prefer_vector_width": "512",
        # loops of up to 20 MB become one compiled function; larger ones, of gradients, would take minutes to compile
        "--xla_backend_extra_options": f"xla_cpu_small_while_loop_byte_threshold=20000000,{_OPTIONS}",
    }
elif jax.__version_info__ < (0, 13):  # a compiler that does not know one of its flags ends the process
    _FLAGS = {"--xla_backend_extra_options": _OPTIONS}


def configure(cache: str | Path | None = None, cores: int | None = None) -> Path:
    """Switch on JAX's persistent compilation cache and the CPU compiler's flags for loops.

    With the cache a program is compiled once per machine, not once per process: the first sweep of a second process
    takes about a second. With the flags sweeps run up to a third faster, on JAX 0.10 two to three times as fast. Call it once at the start of a script or notebook; a second call changes nothing. Nothing else in jaxatt
    changes a setting of the process.

    Args:
        cache: folder of compiled programs; None for ``jaxatt`` in the user's cache folder. Processors and releases of
            JAX get folders of their own in it, for a program compiled for one fails on another. What
            JAX_COMPILATION_CACHE_DIR or jax.config says already stays.
        cores: how many cores `sweep`, campaigns and `rare` keep busy; None for all that the process may use, as they do
            without this call too. The numbers are the same.

    Returns:
        The folder in use.

    Warns:
        UserWarning if JAX has run a computation already, so that the flags come too late; the cache still works.

    Example:
        >>> import jaxatt
        >>> folder = jaxatt.configure()
    """
    global _cores
    _cores = None if cores is None else check.whole("cores", cores)
    present = os.environ.get("XLA_FLAGS", "")
    wanted = [f"{name}={value}" for name, value in _FLAGS.items() if name not in present]
    if wanted and _has_run():
        check.warn(
            "`jaxatt.configure` comes after the first computation of JAX: the compiler's flags have no effect any "
            "more, and sweeps run a third slower, on JAX 0.10 two to three times. Call it first."
        )
    elif wanted:
        os.environ["XLA_FLAGS"] = " ".join([present, *wanted]).strip()
    if not jax.config.jax_compilation_cache_dir:  # pyright: ignore[reportAttributeAccessIssue]
        place = _cache_home() if cache is None else check.place("cache", cache)
        folder = place / f"jax-{jax.__version__}-{_processor()}"
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
        if jax.__version_info__ < (0, 12):
            _quiet_loader()
    return Path(jax.config.jax_compilation_cache_dir)  # pyright: ignore[reportAttributeAccessIssue]


def _quiet_loader() -> None:
    """Silence what JAX 0.10 prints at every program it loads: that its own tuning hints are no features of the machine.

    It comes from C++, whose level is set by jax_logging_level alone; the Python loggers keep theirs.
    """
    loggers = [logging.getLogger(name) for name in ("jax", "jaxlib")]
    before = [logger.level for logger in loggers]
    asked = jax.config.jax_logging_level  # pyright: ignore[reportAttributeAccessIssue]
    if asked in (None, "", "NOTSET"):
        jax.config.update("jax_logging_level", "CRITICAL")
        jax.config.update("jax_logging_level", asked)
        for logger, level in zip(loggers, before):
            logger.setLevel(level)


def _has_run() -> bool:
    """Whether JAX has started its backend; False where this release does not say."""
    bridge = getattr(getattr(jax, "_src", None), "xla_bridge", None)
    return bool(getattr(bridge, "backends_are_initialized", lambda: False)())


def _cache_home() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxatt"


def _processor() -> str:
    """Kind of processor: its architecture and a checksum of its model and instruction sets."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        kind = sorted({line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part"))})
    except OSError:
        kind = [platform.processor()]
    return f"{platform.machine()}-{hashlib.sha256(' '.join(kind).encode()).hexdigest()[:8]}"

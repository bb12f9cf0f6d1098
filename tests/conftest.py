import gc
import os

import jax
import matplotlib
import pytest

import jaxatt

# Large programs compile in two thirds of the time with the CPU flags of JAX than with those of `jaxatt.configure`, which
# keeps what it finds set, and on JAX 0.10 in half of it without the newer emitters. Check cases and experiments run as
# users do.
if jax.__version_info__ < (0, 12):
    flags = (
        "--xla_cpu_prefer_vector_width=256",
        "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1024",
        "--xla_cpu_use_fusion_emitters=false",
    )
    os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *flags])
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_traceback_filtering", "off")  # else JAX adds a line to every message that passes through it
jaxatt.configure()  # workers and later runs share compiled programs
matplotlib.use("Agg")
gc.set_threshold(50_000, 20, 50)  # programs and traces are many objects that stay

# XLA's optimisations take longer than they save where runs are short: the programs of these modules, and of tests marked
# short, go without most of them. All others, with long runs or with bits to compare, are compiled as a user's are: JAX
# keeps programs of another matmul precision apart, which means nothing on a CPU, but not those of other optimisations.
SHORT = {
    "test_attitude", "test_bodies", "test_controllers", "test_detection", "test_engine", "test_environment", "test_filters",
    "test_flags", "test_guidance", "test_gyro_ekf", "test_linear", "test_mekf", "test_replay", "test_soft_scores",
    "test_star_isolation", "test_torque_matrix", "test_tuning_star_isolation", "test_usque", "test_wheels",
}  # fmt: skip


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Before the fixtures, which compile too."""
    short = item.module.__name__ in SHORT or item.get_closest_marker("short") is not None
    jax.config.update("jax_disable_most_optimizations", short)
    jax.config.update("jax_default_matmul_precision", "highest" if short else None)

import gc
import os
from pathlib import Path

import jax
import matplotlib

# Most of a test's time is compilation. JAX's plain settings take two thirds of the time that those of `jaxatt.configure`
# take, and on JAX 0.10 without its newer emitters half of that; the check cases and experiments run as users do.
if jax.__version_info__ < (0, 12):
    os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_use_fusion_emitters=false"
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_traceback_filtering", "off")  # else JAX adds a line to every message that passes through it
# workers and later runs share compiled programs
jax.config.update("jax_compilation_cache_dir", str(Path.home() / ".cache" / "jaxatt" / f"tests-{jax.__version__}"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
matplotlib.use("Agg")
gc.set_threshold(50_000, 20, 50)  # programs and traces are many objects that stay

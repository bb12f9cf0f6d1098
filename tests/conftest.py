import jax
import matplotlib

import jaxatt

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_traceback_filtering", "off")  # else JAX adds a line to every message that passes through it
jaxatt.configure()  # workers and later runs share compiled programs
matplotlib.use("Agg")

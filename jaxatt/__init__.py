"""jaxatt: a differentiable, vectorised simulator of spacecraft attitude control that survives faults.

Three verbs over a closed loop: `simulate` one run, `sweep` thousands of scenarios, `tune` numbers by gradient.
Published loops are in `jaxatt.systems`; parts to build one's own are in the modules beside this one.
"""

from jaxatt.attitude import mrp_error, mrp_rate
from jaxatt.engine import Now, System, every, fast_cpu, noise_of, rk4, simulate, vmapped
from jaxatt.faults import Fault, Reading, dead, on_axes
from jaxatt.study import rerun, sweep
from jaxatt.tuning import tune
from jaxatt.vec import Mat3, Quat, Vec3

__all__ = [
    "Fault",
    "Mat3",
    "Now",
    "Quat",
    "Reading",
    "System",
    "Vec3",
    "dead",
    "every",
    "fast_cpu",
    "mrp_error",
    "mrp_rate",
    "noise_of",
    "on_axes",
    "rerun",
    "rk4",
    "simulate",
    "sweep",
    "tune",
    "vmapped",
]

__version__ = "0.1.0"

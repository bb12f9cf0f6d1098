"""jaxatt: a differentiable, vectorised simulator of spacecraft attitude control that survives faults.

State a closed loop once as a `System`: pure functions of one scenario. Then `simulate` one run, `sweep` thousands, `rerun`
one of them, `tune` numbers by gradient. Published loops are in `jaxatt.loops`; parts to build one's own are in the
modules beside this one; `jaxatt.campaign`, `jaxatt.plot`, `jaxatt.replay` and the like load when they are first named.
"""

import importlib
from pkgutil import iter_modules

from jaxatt.attitude import mrp_error, mrp_rate
from jaxatt.compiling import configure
from jaxatt.contract import Now, System
from jaxatt.engine import every, rk4, simulate
from jaxatt.faults import Fault, Reading, dead, on_axes
from jaxatt.noise import noise_of
from jaxatt.sweeping import rerun, sweep, varied
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
    "configure",
    "dead",
    "every",
    "mrp_error",
    "mrp_rate",
    "noise_of",
    "on_axes",
    "rerun",
    "rk4",
    "simulate",
    "sweep",
    "tune",
    "varied",
]

__version__ = "0.1.0"

_MODULES = {module.name for module in iter_modules(__path__)}


def __getattr__(name: str):
    if name in _MODULES:
        return importlib.import_module(f"jaxatt.{name}")
    raise AttributeError(f"module 'jaxatt' has no attribute {name!r}")


def __dir__():
    return sorted({*__all__, *_MODULES})

"""Tuning: the numbers of a closed loop, found by gradient of a cost over sampled scenarios.

A cost is a function (theta, key) -> scalar: theta is any pytree of numbers, and everything random, scenarios and noise,
comes from the key. Fixed scenarios are a cost that does not draw any. What a cost is made of is in `jaxatt.soft_scores`;
numbers that must stay positive or within bounds are tuned through `bounded`.

Its modules may import: tuning, check, compiling, noise, resuming, sweeping.
"""

from jaxatt.tuning.bounds import Bounds, bounded
from jaxatt.tuning.gradient import FEW, GradientCheck, gradient_check, value_and_gradient
from jaxatt.tuning.search import History, averaged, best_of, multi_start, tune, worst_case

__all__ = [
    "FEW",
    "Bounds",
    "GradientCheck",
    "History",
    "averaged",
    "best_of",
    "bounded",
    "gradient_check",
    "multi_start",
    "tune",
    "value_and_gradient",
    "worst_case",
]

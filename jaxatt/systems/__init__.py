"""Published closed loops, one module each: ``system``, ``params`` and ``scenario`` are the paper's.

Each may import: check, vec, attitude, faults, mounting, scores, bodies, sensors, estimators, kalman, lmmse,
controllers, detection, singularity, engine.
"""

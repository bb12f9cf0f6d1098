"""Closed loops, one module each: ``system``, ``params`` and ``scenario``, the paper's where there is one.

Each may import: check, fields, vec, attitude, faults, delays, sensors, torque_matrix, wheels, cmg, bodies, observers,
filters, star_filters, mekf, controllers, guidance, detection, singularity, orbit, environment, scores, contract,
compiling, engine.
"""

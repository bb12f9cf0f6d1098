"""Published closed loops, one module each: ``system``, ``params`` and ``scenario`` are the paper's.

Each may import: check, fields, vec, attitude, faults, delays, sensors, torque_matrix, wheels, cmg, bodies, observers,
filters, star_filters, controllers, detection, singularity, scores, contract, compiling, engine.
"""

"""How fast, as ratios in one run: one module per closed loop, ``rows(quick)`` in each; ``python -m benchmarks``."""

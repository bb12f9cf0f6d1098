"""The papers reproduced: one module per closed loop, ``run(report)`` in each; ``python -m experiments`` runs them."""

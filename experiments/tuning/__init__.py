"""Gains tuned by gradient, one module per closed loop."""

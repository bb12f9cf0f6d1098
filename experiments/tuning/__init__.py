"""Gains by gradient: for each paper's loop a study of what tuning buys, ``python -m experiments NAME tune``."""

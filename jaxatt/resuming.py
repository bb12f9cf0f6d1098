"""Files of a long computation that may be killed: one whole file at any time, and a mark of what it belongs to.

May import: nothing of ours.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import jax
import numpy as np


def mark_of(lowered: Iterable, numbers) -> str:
    """What tells one computation from another: its lowered programs, constants included, and a tree of numbers."""
    mark = hashlib.sha256()
    for program in lowered:
        mark.update(program.as_text().encode())
    for leaf in jax.tree.leaves(numbers):
        mark.update(np.asarray(leaf).tobytes())
    return mark.hexdigest()


def replaced(path: Path, arrays: Mapping) -> None:
    """Write arrays beside the file (.npz), then rename it: whenever the power fails, one whole file is there."""
    beside = path.with_name(path.name + f".{os.getpid()}")
    with beside.open("wb") as file:
        np.savez(file, **arrays)
        file.flush()
        os.fsync(file.fileno())
    os.replace(beside, path)

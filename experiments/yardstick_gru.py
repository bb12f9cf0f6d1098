"""Train the learned row of the yardstick: ``python -m experiments.yardstick_gru [--save FILE] [--out FILE] [--rounds N]``.

Writes the numbers that `jaxatt.yardstick.gru` ships, unless ``--out`` says another file, and says how far they are from
those that were there. Killed and started again with the same ``--save`` it goes on, with the same numbers.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import jax
import numpy as np

import jaxatt
from jaxatt.resuming import replaced
from jaxatt.yardstick.gru import WEIGHTS
from jaxatt.yardstick.learning import SHIPPED, train


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m experiments.yardstick_gru", description=__doc__)
    parser.add_argument("--save", type=Path, help="file that holds the training after each round")
    parser.add_argument("--out", type=Path, default=WEIGHTS, help="file of the numbers; default: that of the package")
    parser.add_argument(
        "--rounds", type=int, default=SHIPPED.rounds, help="of the training; default: those of the package"
    )
    args = parser.parse_args(arguments)
    jaxatt.configure()
    started = time.process_time()
    found = train(jax.random.key(0), SHIPPED._replace(rounds=args.rounds), save=args.save, progress=True)
    print(f"{(time.process_time() - started) / 60:.1f} core-minutes; loss by rounds {np.round(found.loss, 4)}")
    if args.out.exists():
        with np.load(args.out, allow_pickle=False) as held:
            pairs = [(held[name], new) for name, new in found.params._asdict().items()]
        apart = max(float(np.max(np.abs(old - new))) if old.shape == new.shape else np.inf for old, new in pairs)
        print(f"largest difference to the numbers that were there: {apart:.3g}")
    replaced(args.out, {**found.params._asdict(), "loss": found.loss})
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Make the recorded data of notebook `recorded_data`: ``python -m notebooks.telemetry``.

Three minutes of a geostationary satellite's day (`jaxatt.loops.gyro_ekf`), as a ground station would have it: 8 Hz
with jitter, the earth sensor at half that rate, one row in a hundred lost and three seconds without contact. One of
the four gyros fails; `truth` says which, when and how, and the file does not.
"""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np

import jaxatt
from jaxatt.loops import gyro_ekf as loop
from jaxatt.replay import EXAMPLE

SECONDS = 180
GAP = (61.0, 64.0)  # [s] no contact


def truth() -> tuple[int, float, float]:
    """Which gyro (0 to 3) has a jump of its bias, when [s], and of what size [rad/s]."""
    rng = np.random.default_rng(2005)
    return int(rng.integers(4)), float(np.round(rng.uniform(90, 150), 1)), 1e-5


def scenario() -> loop.Scenario:
    """The day: as in the paper's Table 6, with the fault, of which nobody tells the computer."""
    who, onset, size = truth()
    here = np.arange(4) == who
    return loop.scenario._replace(
        gyro=jaxatt.Fault(onset=np.where(here, onset, np.inf), bias=np.where(here, size, 0.0)), announced=0.0
    )


def recorded() -> dict[str, np.ndarray]:
    """Columns of the file."""

    def tick(params, scenario, now, x, z, noise):
        x, z, _ = loop.tick(params, scenario, now, x, z, noise)
        return x, z, (z.readings, z.computer.u)

    ticks = round(SECONDS / loop.DT)
    params = loop.consistent(loop.params)
    y, u = jaxatt.simulate(loop.system._replace(tick=tick), params, scenario(), jax.random.key(7), ticks=ticks)
    rng = np.random.default_rng(8)
    t = loop.DT * np.arange(ticks)
    angle = np.where(y.angle.valid, y.angle.value, np.nan)
    columns = {"time [s]": t + rng.uniform(-0.02, 0.02, ticks) * (t > 0)}
    columns |= {f"angle_{name} [rad]": angle[:, i] for i, name in enumerate("xyz")}
    columns |= {f"gyro_{name} [rad/s]": np.asarray(y.gyro.value)[:, i] for i, name in enumerate("abcd")}
    columns |= {f"wheel_{i + 1} [in-lbf s]": np.asarray(y.tacho.value)[:, i] for i in range(4)}
    columns |= {f"command_{i + 1} [in-lbf]": np.asarray(u)[:, i] for i in range(4)}
    kept = (rng.random(ticks) > 0.01) & ~((t >= GAP[0]) & (t < GAP[1]))
    kept[0] = True
    return {name: a[kept] for name, a in columns.items()}


def write(path: Path = EXAMPLE) -> None:
    """Write the file; an empty cell is no sample."""
    columns = recorded()
    lines = [",".join(columns)]
    for row in zip(*columns.values()):
        lines.append(",".join("" if np.isnan(a) else f"{a:.3f}" if i == 0 else f"{a:.7g}" for i, a in enumerate(row)))
    path.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    jaxatt.configure()
    write()

"""What an experiment leaves behind: checks against the paper, printed as a table, figures, and metrics.json."""

from __future__ import annotations

import json
import platform
from pathlib import Path

import jax
import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from jaxatt.evaluation import interval as interval
from jaxatt.evaluation import quantile_interval


class Report:
    """Collects checks and figures of one experiment. quick: shrink Monte Carlo sizes only."""

    def __init__(self, out: Path, quick: bool, experiment: str):
        self.out, self.quick, self.experiment = Path(out), quick, experiment
        self.checks: list[dict] = []
        self.figures: list[str] = []
        print(f"\n{experiment}\n{'check':58} {'paper or reference':>26} {'ours':>26} {'tolerance':>12}  ok", flush=True)

    def check(self, name: str, expected, measured, tolerance, source: str) -> bool:
        """measured, a number or a list, must equal expected within +-tolerance (a number or a list)."""
        difference = np.abs(np.asarray(measured, float) - np.asarray(expected, float))
        return self._add(name, _plain(expected), measured, tolerance, source, bool(np.all(difference <= tolerance)))

    def relative(self, name: str, expected, measured, tolerance: float, source: str) -> bool:
        """measured must equal expected within tolerance times expected."""
        return self.check(name, expected, measured, (tolerance * np.abs(np.asarray(expected))).tolist(), source)

    def within(self, name: str, low, high, measured, source: str) -> bool:
        """measured, a number or a list, must lie in [low, high]; None leaves a side open."""
        a = np.asarray(measured, float)
        ok = (low is None or np.all(a >= low)) and (high is None or np.all(a <= high))
        expected = f">= {low:g}" if high is None else f"<= {high:g}" if low is None else f"{low:g} to {high:g}"
        return self._add(name, expected, measured, 0, source, bool(ok))

    def note(self, text: str) -> None:
        """Print a result that has no reference to be checked against."""
        print(f"  {text}", flush=True)

    def figure(self, name: str, fig) -> None:
        """Save a figure as PNG under the experiment's name and close it."""
        path = self.out / self.experiment / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        fig.savefig(path, dpi=150, bbox_inches="tight")
        plt.close(fig)
        self.figures.append(str(path.relative_to(self.out)))

    def found(self) -> dict:
        """Checks and figures as plain values, for `written`."""
        return {"checks": self.checks, "figures": self.figures}

    def _add(self, name, expected, measured, tolerance, source, ok) -> bool:
        name = f"{self.experiment}: {name}"
        measured, tolerance = _plain(measured), _plain(tolerance)
        self.checks.append(
            dict(name=name, expected=expected, measured=measured, tolerance=tolerance, source=source, ok=ok)
        )
        row = f"{name.split(': ', 1)[1]:58} {_short(expected):>26} {_short(measured):>26} {_short(tolerance):>12}"
        print(row, " ok" if ok else " NOT OK", flush=True)
        return ok


def written(out: Path, parts: list[dict]) -> bool:
    """Write metrics.json of what several reports found, and print the sum; whether every check is ok."""
    checks, figures = ([item for part in parts for item in part[kind]] for kind in ("checks", "figures"))
    versions = {"python": platform.python_version(), "jax": jax.__version__, "numpy": np.__version__}
    out.mkdir(parents=True, exist_ok=True)
    metrics = {"checks": checks, "figures": figures, "versions": versions}
    (out / "metrics.json").write_text(json.dumps(metrics, indent=1) + "\n")
    bad = [c["name"] for c in checks if not c["ok"]]
    print(f"\n{len(checks) - len(bad)} of {len(checks)} checks ok, {len(figures)} figures; written to {out}", end="")
    print("".join(f"\nnot ok: {name}" for name in bad))
    return not bad


def quantile(values, share: float, digits: int = 3) -> str:
    """A quantile of independent values, those that are NaN left out, with its 95 % confidence interval, in words."""
    values = np.ravel(values)
    values = values[~np.isnan(values)]
    if not values.size:
        return "none"
    low, high = quantile_interval(values, share)
    return f"{np.quantile(values, share, method='inverted_cdf'):.{digits}g} ({low:.{digits}g} to {high:.{digits}g})"


def _plain(a):
    return a if isinstance(a, str) else np.asarray(a).tolist()


def _short(a) -> str:
    if isinstance(a, (list, tuple)):
        text = ", ".join(_short(b) for b in a)
        return text if len(text) <= 26 else f"{_short(a[0])} ... ({len(a)})"
    return a if isinstance(a, str) else f"{a:.6g}" if isinstance(a, float) else str(a)

"""Who may import whom."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "jaxatt"
PLAIN = {"vec", "check"}
ALGEBRA = {"attitude", "faults", "mounting", "scores"}
PARTS = {"bodies", "sensors", "estimators", "kalman", "lmmse", "controllers", "detection", "singularity"}
MAY = {
    "check": set(),
    "vec": {"check"},
    **{name: PLAIN for name in ALGEBRA},
    **{name: PLAIN | ALGEBRA for name in PARTS},
    "controllers": PLAIN | ALGEBRA | {"singularity"},
    "engine": {"check", "scores", "vec"},
    "linear": PLAIN | {"engine"},
    "study": {"check", "engine"},
    "designs": {"check"},
    "summary": {"check"},
    "store": set(),
    "campaign": {"check", "engine", "study", "store", "summary"},
    "tuning": {"check", "engine", "study"},
    "objectives": PLAIN | ALGEBRA,
    "replay": PLAIN | {"faults", "engine"},
    "plot": PLAIN | ALGEBRA | PARTS,
    "systems": PLAIN | ALGEBRA | PARTS | {"engine"},
}


def imported(path):
    """Modules of jaxatt that a file imports."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "jaxatt":
            parts = node.module.split(".")
            yield from [parts[1]] if len(parts) > 1 else [alias.name for alias in node.names]
        elif isinstance(node, ast.Import):
            yield from (a.name.split(".")[1] for a in node.names if a.name.startswith("jaxatt."))
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else [getattr(node, "module", None)]
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            assert not {str(n).split(".")[0] for n in names} & {"experiments", "benchmarks", "tests"}, path


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda p: p.stem)
def test_a_module_imports_only_what_lies_below_it(path):
    name = "systems" if path.parent.name == "systems" else path.stem
    if path.stem == "__init__":
        return
    assert name in MAY, f"{path.name} has no place in the order of the house"
    assert set(imported(path)) <= MAY[name]


def test_the_package_imports_with_its_dependencies_alone():
    code = (
        "import sys; sys.modules.update({m: None for m in ('scipy.optimize', 'pandas', 'xarray', 'hypothesis', 'pytest')});"
        "import jaxatt, jaxatt.systems.observer_pd, experiments.report, experiments.observer_pd"
    )
    subprocess.run([sys.executable, "-c", code], cwd=PACKAGE.parent, check=True)


def test_importing_computes_nothing_and_changes_no_global_setting():
    everything = ", ".join(
        ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
        for path in sorted(PACKAGE.rglob("*.py"))
        if path.stem not in ("__init__", "plot")
    )
    code = (
        f"import os, jax; flags = os.environ.get('XLA_FLAGS'); import {everything};"
        "assert os.environ.get('XLA_FLAGS') == flags and not jax.config.jax_enable_x64;"
        "import sys; assert 'matplotlib' not in sys.modules; jaxatt.fast_cpu()"
    )
    subprocess.run([sys.executable, "-c", code], cwd=PACKAGE.parent, check=True)

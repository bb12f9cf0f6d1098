"""Who may import whom."""

import ast
import graphlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "jaxatt"
MODULES = sorted(PACKAGE.rglob("*.py"))


def may_import(path):
    """Modules that a file may import, by the last words of its docstring; a loop's are those of its package."""
    rule = path.with_name("__init__.py") if path.parent != PACKAGE else path
    said = re.search(r"ay import: ([\w, \n]+)\.$", ast.get_docstring(ast.parse(rule.read_text())) or "")
    assert said, f"{path.name} does not say what it may import"
    return set() if said[1] == "nothing of ours" else set(re.findall(r"\w+", said[1]))


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


@pytest.mark.parametrize("path", [p for p in MODULES if p.stem != "__init__"], ids=lambda p: p.stem)
def test_a_module_imports_only_what_it_says(path):
    assert set(imported(path)) <= may_import(path)


def test_the_modules_are_in_an_order_with_loops_and_figures_on_top():
    may = {path.stem: may_import(path) for path in PACKAGE.glob("*.py") if path.stem != "__init__"}
    assert set().union(*may.values(), may_import(PACKAGE / "systems" / "__init__.py")) <= set(may)
    tuple(graphlib.TopologicalSorter(may).static_order())  # raises where they go in a circle
    assert not any({"plot", "systems"} & below for below in may.values())
    assert may["engine"] <= {"check", "vec", "scores"}  # it knows no spacecraft


def test_the_package_imports_with_its_dependencies_alone():
    code = (
        "import sys; sys.modules.update({m: None for m in ('scipy.optimize', 'pandas', 'xarray', 'hypothesis', 'pytest')});"
        "import jaxatt, jaxatt.systems.observer_pd, experiments.report, experiments.observer_pd"
    )
    subprocess.run([sys.executable, "-c", code], cwd=PACKAGE.parent, check=True)


def test_importing_computes_nothing_and_changes_no_global_setting():
    everything = ", ".join(
        ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
        for path in MODULES
        if path.stem not in ("__init__", "plot")
    )
    code = (
        f"import os, jax; flags = os.environ.get('XLA_FLAGS'); import {everything};"
        "assert os.environ.get('XLA_FLAGS') == flags and not jax.config.jax_enable_x64;"
        "import sys; assert 'matplotlib' not in sys.modules; jaxatt.fast_cpu()"
    )
    subprocess.run([sys.executable, "-c", code], cwd=PACKAGE.parent, check=True)

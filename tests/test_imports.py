"""Rooms and who may enter: the last words of a module's docstring say what it may import."""

import ast
import graphlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "jaxatt"
FILES = sorted(PACKAGE.rglob("*.py"))


def name_of(path):
    """jaxatt/campaign/store.py is campaign.store, jaxatt/campaign/__init__.py is campaign, the root is ''."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


MODULES = {name_of(path): path for path in FILES}


def resolved(word, name):
    """What a word of the docstring of ``name`` means: a module beside it, all that it imports of them, one at the root."""
    package = name.rpartition(".")[0]
    if word == package:
        return {other for other in ours(MODULES[name]) if other.startswith(f"{package}.")}
    return {f"{package}.{word}" if f"{package}.{word}" in MODULES else word}


def may_import(name):
    """What a module says it may import; a loop, and a module that does not say, abides by its package."""
    said = None
    for of in (name, name.rpartition(".")[0]):
        text = ast.get_docstring(ast.parse(MODULES[of].read_text())) or ""
        said = said or (of and re.search(r"ay import: ([\w., \n]+)\.$", text))
    assert said, f"{name} does not say what it may import"
    words = [] if said[1] == "nothing of ours" else re.findall(r"[\w.]+", said[1])
    return set().union(*(resolved(word, name) for word in words))


def imported(path):
    """Every module that a file imports, by its full name, at the top or within a function."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert not node.level, f"{path} imports by dots"
            within = node.module.removeprefix("jaxatt").lstrip(".")
            here = [f"{within}.{alias.name}".lstrip(".") for alias in node.names]
            modules = [f"jaxatt.{name}" for name in here if name in MODULES]
            yield from modules if node.module.startswith("jaxatt") and modules else [node.module]


def ours(path):
    return {name.removeprefix("jaxatt.") for name in imported(path) if name.startswith("jaxatt.")}


LEAVES = [name for name, path in MODULES.items() if path.stem != "__init__"]
PACKAGES = [name for name, path in MODULES.items() if name and path.stem == "__init__"]


@pytest.mark.parametrize("name", LEAVES)
def test_a_module_imports_only_what_it_says(name):
    assert ours(MODULES[name]) <= may_import(name)


@pytest.mark.parametrize("name", PACKAGES)
def test_a_package_hands_out_its_own_modules_alone(name):
    assert {module.split(".")[0] for module in ours(MODULES[name])} <= {name}


def test_what_a_module_may_import_exists_and_there_are_no_circles():
    may = {name: may_import(name) for name in LEAVES}
    for name in PACKAGES:
        may[name] = {other for other in LEAVES if other.startswith(f"{name}.")}
    for name, below in may.items():
        assert below <= set(may), f"{name} may import what is not there: {below - set(may)}"
    tuple(graphlib.TopologicalSorter(may).static_order())  # raises where they go in a circle


def test_figures_and_loops_are_on_top_and_the_engine_knows_no_spacecraft():
    for name in LEAVES:
        top = {module.split(".")[0] for module in may_import(name)}
        assert ("plot" not in top or name == "view") and "view" not in top, name
        assert "loops" not in top or name.startswith("yardstick.microsat"), name  # a world of the yardstick is a loop
    kernel = {"check", "clock", "fields", "contract", "compiling", "noise", "one_loop"}
    assert may_import("engine") <= kernel and may_import("sweeping") <= kernel | {"engine", "scores"}


def test_nothing_private_of_jax_is_imported_and_nothing_outside_the_package():
    for path in FILES:
        for name in imported(path):
            assert not name.startswith("jax._src") and name.split(".")[0] not in ("experiments", "benchmarks", "tests"), path  # fmt: skip


def test_only_the_engine_and_the_kernels_know_of_lanes():
    known = {"engine", "one_loop", "sweeping", "noise", "compiling", "filters", "mekf", "usque", "batching", "check"}
    assert {name for name, path in MODULES.items() if re.search(r"\blanes\b", path.read_text())} <= known


# what an import does, each in a process of its own


def process(code):
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


def test_the_package_imports_with_its_dependencies_alone():
    process(
        "import sys; sys.modules.update({m: None for m in ('scipy', 'pandas', 'xarray', 'zarr', 'hypothesis', 'pytest')});"
        "import jaxatt, jaxatt.loops.observer_pd, experiments.report, experiments.observer_pd"
    )


def test_importing_computes_nothing_and_changes_no_setting():
    everything = ", ".join(f"jaxatt.{name}" for name in MODULES if name not in ("", "plot", "view"))
    process(
        f"import os, sys, jax; flags = os.environ.get('XLA_FLAGS'); import {everything};"
        "assert os.environ.get('XLA_FLAGS') == flags and not jax.config.jax_enable_x64;"
        "assert 'matplotlib' not in sys.modules;"
        "from jax._src.xla_bridge import backends_are_initialized; assert not backends_are_initialized()"
    )


def test_modules_load_when_they_are_first_named():
    process(
        "import sys, jaxatt\n"
        "names = ('campaign', 'plot', 'replay', 'linear', 'evaluation', 'singularity', 'loops')\n"
        "assert set(names) <= set(dir(jaxatt)) and not {f'jaxatt.{name}' for name in names} & set(sys.modules)\n"
        "assert all(getattr(jaxatt, name) is sys.modules[f'jaxatt.{name}'] for name in names)\n"
        "assert not hasattr(jaxatt, 'nothing')"
    )

"""Do the tests see wrong physics? ``python -m benchmarks.mutants [--count 60] [--seed 0] [--module NAME ...]``.

Mutants of the physics modules are made mechanically from the syntax tree: a sign flipped, a term dropped, an axis
swapped, an index changed. ``count`` of them, drawn by ``seed``, meet a subset of the tests in a copy of the tree,
tests of the mutated module first, to the first failure; a mutant that fails no test, or hangs beyond the time limit,
is said so. Prints the share that was caught and the survivors, each with its line before and after.

Results are kept as they come, one line each: a run that was stopped goes on where it was, and survivors are tried
again once a test has changed. Compiled programs are kept between mutants, so that what a mutant does not touch costs
little.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

ROOT = Path(__file__).parents[1]
PHYSICS = (
    "attitude", "bodies", "controllers", "detection", "estimators", "faults", "kalman", "linear", "lmmse", "mounting", "sensors",
    "singularity", "vec", "systems/cmg_loss", "systems/gyro_ekf", "systems/observer_pd", "systems/star_isolation",
    "systems/wheel_mrac",
)  # fmt: skip
TESTS = (
    "test_attitude", "test_vec", "test_faults", "test_detection", "test_theory", "test_observer_pd", "test_singularity",
    "test_gyro_ekf", "test_cmg_loss", "test_star_isolation", "test_wheel_mrac",
)  # fmt: skip
LONG: tuple[str, ...] = ()  # tests that cost more than they see
LIMIT = 600  # [s] wall time of one mutant


class Mutant(NamedTuple):
    """One change of one module."""

    module: str
    number: int  # among those of the module
    line: int
    kind: str
    before: str
    after: str


def _spared(tree: ast.Module) -> set[int]:
    """Nodes that are no physics: annotations, and what words are made of."""
    spared: set[int] = set()
    for node in ast.walk(tree):
        words = [getattr(node, "annotation", None), getattr(node, "returns", None)]
        if isinstance(node, (ast.JoinedStr, ast.Raise)):
            words.append(node)
        if isinstance(node, ast.BinOp) and any(
            isinstance(part, ast.JoinedStr) or (isinstance(part, ast.Constant) and isinstance(part.value, str))
            for part in (node.left, node.right)
        ):
            words.append(node)
        for word in filter(None, words):
            spared |= {id(n) for n in ast.walk(word)}
    return spared


def _changes(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """What may go wrong at a node: kind and replacement."""
    signs = {ast.Add: ast.Sub, ast.Sub: ast.Add}
    match node:
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub() as op, right=right):
            yield "sign", ast.BinOp(left, signs[type(op)](), right)
            yield "term", left
            yield "term", right if isinstance(op, ast.Add) else ast.UnaryOp(ast.USub(), right)
        case ast.AugAssign(target=target, op=ast.Add() | ast.Sub() as op, value=value):
            yield "sign", ast.AugAssign(target, signs[type(op)](), value)
            yield "term", ast.Pass()
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            yield "sign", operand
        case ast.Call(func=ast.Name(id="cross"), args=[a, b]):
            yield "sign", ast.Call(node.func, [b, a], [])
        case ast.Attribute(value=value, attr="x" | "y" | "z" as axis, ctx=ast.Load()):
            yield "axis", ast.Attribute(value, "yzx"["xyz".index(axis)], ast.Load())
        case ast.Subscript(value=value, slice=index, ctx=ast.Load()):
            for other in _other_indices(index):
                yield "index", ast.Subscript(value, other, ast.Load())


def _other_indices(index: ast.expr) -> Iterator[ast.expr]:
    match index:
        case ast.Constant(value=int(k)) if not isinstance(k, bool):
            yield ast.Constant(k - 1 if k > 0 else 1)
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int(k))):
            yield ast.Constant(k - 1)
        case ast.Slice(lower=lower, upper=upper, step=step):
            for other in _other_indices(lower) if lower else ():
                yield ast.Slice(other, upper, step)
            for other in _other_indices(upper) if upper else ():
                yield ast.Slice(lower, other, step)
        case ast.Tuple(elts=parts):
            for i, part in enumerate(parts):
                for other in _other_indices(part):
                    yield ast.Tuple([*parts[:i], other, *parts[i + 1 :]], ast.Load())


def _sites(tree: ast.Module) -> Iterator[tuple[ast.AST, str, ast.AST]]:
    """Node, kind and replacement of all changes of a module, in the order of its lines."""
    spared = _spared(tree)
    sites = [node for node in ast.walk(tree) if id(node) not in spared and isinstance(node, (ast.expr, ast.stmt))]
    for node in sorted(sites, key=lambda n: (n.lineno, n.col_offset, n.end_lineno or 0, n.end_col_offset or 0)):
        for kind, new in _changes(node):
            yield node, kind, new


def all_mutants() -> list[Mutant]:
    """Those of all physics modules."""
    found = []
    for module in PHYSICS:
        if (path := _path(ROOT, module)).exists():
            for i, (node, kind, new) in enumerate(_sites(ast.parse(path.read_text()))):
                line = getattr(node, "lineno", 0)
                found.append(Mutant(module, i, line, kind, ast.unparse(node), ast.unparse(new)))
    return found


def _path(root: Path, module: str) -> Path:
    return root / "jaxatt" / f"{module}.py"


def mutated(mutant: Mutant) -> str:
    """The mutant's module."""
    tree = ast.parse(_path(ROOT, mutant.module).read_text())
    old, _, new = next(islice(_sites(tree), mutant.number, None))

    class Swap(ast.NodeTransformer):
        def visit(self, node):
            return new if node is old else self.generic_visit(node)

    return ast.unparse(ast.fix_missing_locations(Swap().visit(tree)))


def ordered_tests(module: str) -> list[str]:
    """The test files, those that name the module first."""
    name = module.rsplit("/", maxsplit=1)[-1]

    def far(test: str) -> int:
        text = (ROOT / "tests" / f"{test}.py").read_text()
        named = f"jaxatt.{name} " in text or f"import {name}" in text or f"jaxatt.systems.{name}" in text
        return 0 if test == f"test_{name}" else 1 if named else 2

    there = [test for test in TESTS if (ROOT / "tests" / f"{test}.py").exists()]
    return [f"tests/{test}.py" for test in sorted(there, key=far)]


class Copy:
    """A copy of the tree in which one module at a time is wrong."""

    def __init__(self, folder: Path, cache: Path):
        self.root = folder / "tree"
        wanted = shutil.ignore_patterns(".git", ".*cache", "__pycache__", "results", "docs", "notebooks")
        shutil.copytree(ROOT, self.root, ignore=wanted)
        self.environment = {
            **os.environ, "PYTHONPATH": str(self.root), "PYTHONDONTWRITEBYTECODE": "1",
            "JAX_COMPILATION_CACHE_DIR": str(cache), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }  # fmt: skip

    def tests(self, module: str) -> tuple[str, float]:
        """What the tests say: "passed", the first failure, or "hung"; and their CPU seconds."""
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-o", "addopts=", "-p", "no:cacheprovider", "--tb=no"]
        command += [*ordered_tests(module), *(f"--deselect=tests/{test}" for test in LONG)]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        try:
            done = subprocess.run(
                command, cwd=self.root, env=self.environment, capture_output=True, text=True, timeout=LIMIT
            )
            failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
            verdict = "passed" if done.returncode == 0 else failed[0].split(" - ")[0] if failed else "did not start"
        except subprocess.TimeoutExpired:
            verdict = "hung"
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return verdict, after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime

    def write(self, module: str, source: str) -> None:
        _path(self.root, module).write_text(source)


def _digest(*texts: str) -> str:
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:16]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.mutants", description=__doc__)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--module", nargs="*", help="draw from these alone, for instance systems/gyro_ekf")
    parser.add_argument("--out", type=Path, default=Path("results/mutants.jsonl"), help="where results are kept")
    args = parser.parse_args()
    population = [m for m in all_mutants() if not args.module or m.module in args.module]
    drawn = random.Random(args.seed).sample(population, min(args.count, len(population)))
    tests = _digest(*((ROOT / "tests" / f"{t}.py").read_text() for t in TESTS if (ROOT / "tests" / f"{t}.py").exists()))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    known: dict[str, dict] = {}
    for line in args.out.read_text().splitlines() if args.out.exists() else ():
        row = json.loads(line)
        known[row["digest"]] = row
    stale = lambda row: row is None or (row["verdict"] == "passed" and row["tests"] != tests)
    results = []
    with tempfile.TemporaryDirectory() as folder:
        cache = args.out.parent.resolve() / "compiled"
        copy = None
        for mutant in tqdm(drawn, unit=" mutants"):
            source = mutated(mutant)
            digest = _digest(mutant.module, source)
            row = known.get(digest)
            if stale(row):
                if copy is None:
                    copy = Copy(Path(folder), cache)
                    begin = time.perf_counter()
                    verdict, spent = copy.tests("vec")
                    wall = time.perf_counter() - begin
                    print(f"the right physics: {verdict}, {wall:.0f} s, {spent:.0f} s of CPU time", flush=True)
                    if verdict != "passed":
                        raise SystemExit("The tests must pass before mutants mean anything.")
                copy.write(mutant.module, source)
                verdict, spent = copy.tests(mutant.module)
                copy.write(mutant.module, _path(ROOT, mutant.module).read_text())
                row = {**mutant._asdict(), "digest": digest, "tests": tests, "verdict": verdict, "cpu": spent}
                with args.out.open("a") as file:
                    file.write(json.dumps(row) + "\n")
            results.append(row)
    survivors = [row for row in results if row["verdict"] == "passed"]
    caught = len(results) - len(survivors)
    print(f"{len(population)} mutants in all, {len(results)} drawn by seed {args.seed}")
    print(f"caught: {caught} of {len(results)}, {100 * caught / len(results):.1f} %")
    for row in survivors:
        print(f"survived: jaxatt/{row['module']}.py:{row['line']} ({row['kind']}): {row['before']}  ->  {row['after']}")


if __name__ == "__main__":
    main()

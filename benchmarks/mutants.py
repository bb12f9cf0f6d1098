"""Do the tests see wrong physics? ``python -m benchmarks.mutants [--count 60] [--seed 0] [--module NAME ...]``.

Mutants of the physics modules are made mechanically from the syntax tree: a sign flipped, a term dropped, an axis
swapped, an index changed. ``count`` of them, drawn by ``seed``, meet a subset of the tests in a copy of the tree,
tests of the mutated module first, to the first failure; a mutant that fails no test, or hangs beyond the time limit,
is said so. Prints the share that was caught and the survivors, each with its line before and after.

Results are kept as they come, one line each: a run that was stopped goes on where it was, and survivors are tried
again once a test has changed. Compiled programs are kept between mutants, so that what a mutant does not touch costs
little. The right physics goes first: if a test fails on that, nothing can be said of mutants, and the exit status is 1.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import multiprocessing
import os
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from queue import Queue
from typing import NamedTuple

from tqdm import tqdm

ROOT = Path(__file__).parents[1]
PHYSICS = (
    "attitude", "bodies", "cmg", "controllers", "delays", "detection", "faults", "filters", "linear", "observers", "sensors",
    "singularity", "star_filters", "vec", "wheels", "loops/cmg_loss", "loops/gyro_ekf", "loops/observer_pd",
    "loops/star_isolation", "loops/wheel_mrac",
)  # fmt: skip
TESTS = (
    "test_attitude", "test_vec", "test_bodies", "test_cmg", "test_controllers", "test_delays", "test_detection", "test_faults",
    "test_filters", "test_linear", "test_observers", "test_sensors", "test_singularity", "test_star_filters", "test_wheels",
    "test_theory", "test_observer_pd", "test_gyro_ekf", "test_cmg_loss", "test_star_isolation", "test_wheel_mrac",
    "test_soft_scores",
)  # fmt: skip
FRESH = multiprocessing.get_context("forkserver")  # processes that need not import JAX again
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
    """Nodes that are no physics: annotations, what words are made of, and what only lends its shape or type."""
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
        if _lends_its_shape(node):
            words += node.args  # pyright: ignore[reportAttributeAccessIssue]
        if isinstance(node, ast.Attribute) and node.attr in ("shape", "dtype"):
            words.append(node.value)
        if isinstance(node, ast.BinOp) and (_lends_its_shape(node.left) or _lends_its_shape(node.right)):
            spared.add(id(node))
        for word in filter(None, words):
            spared |= {id(n) for n in ast.walk(word)}
    return spared


def _lends_its_shape(node: ast.AST) -> bool:
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "zeros_like"


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
    """The test files, those that import most of the module first."""
    dotted = f"jaxatt.{module.replace('/', '.')}"

    def named(test: str) -> int:
        text = (ROOT / "tests" / f"{test}.py").read_text()
        count = 1000 * (test == f"test_{module.rsplit('/', maxsplit=1)[-1]}")
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom) and node.module:
                count += sum(dotted in (node.module, f"{node.module}.{alias.name}") for alias in node.names)
        return count

    there = [test for test in TESTS if (ROOT / "tests" / f"{test}.py").exists()]
    return [f"tests/{test}.py" for test in sorted(there, key=named, reverse=True)]


HEAVY = ["jax", "jax.numpy", "jax.experimental", "scipy.stats", "scipy.linalg", "hypothesis", "optax", "pytest"]


def _pytest(root: str, files: list[str], out: str) -> None:
    """Run in a fresh process, into which only what every test imports has been loaded."""
    os.chdir(root)
    sys.dont_write_bytecode = True
    sys.path = [root, *(p for p in sys.path if p and Path(p).resolve() != ROOT)]
    import pytest

    handle = os.open(out, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(handle, 1)
    os.dup2(handle, 2)
    quiet = ["-x", "-q", "-o", "addopts=", "-p", "no:cacheprovider", "--tb=no", "-rfE", "-m", "not slow"]
    code = pytest.main([*quiet, *files])
    sys.stdout.flush()
    os._exit(int(code))


class Copy:
    """A copy of the tree in which one module at a time is wrong."""

    def __init__(self, folder: Path):
        self.root = folder
        wanted = shutil.ignore_patterns(
            ".git", ".*cache", "__pycache__", "results", "docs", "notebooks", "build", "dist"
        )
        shutil.copytree(ROOT, self.root, ignore=wanted)

    def tests(self, module: str) -> str:
        """What the tests say: "passed", the first failure, or "hung". The two most related files run first."""
        ordered = ordered_tests(module)
        for files in (ordered[:2], ordered[2:]):
            verdict = self.some(files)
            if verdict != "passed":
                return verdict
        return "passed"

    def some(self, files: list[str]) -> str:
        out = self.root / "said.txt"
        process = FRESH.Process(target=_pytest, args=(str(self.root), files, str(out)))
        process.start()
        process.join(LIMIT)
        if process.is_alive():
            process.kill()
            process.join()
            return "hung"
        said = out.read_text(errors="replace").splitlines() if out.exists() else []
        failed = [line for line in said if line.startswith(("FAILED", "ERROR"))]
        return "passed" if process.exitcode == 0 else failed[0].split(" - ")[0] if failed else "did not start"

    def write(self, module: str, source: str) -> None:
        _path(self.root, module).write_text(source)


def _digest(*texts: str) -> str:
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:16]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.mutants", description=__doc__)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--module", nargs="*", help="draw from these alone, for instance loops/gyro_ekf")
    parser.add_argument("--jobs", type=int, default=2, help="mutants at a time")
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
    with tempfile.TemporaryDirectory() as folder:
        copies: Queue[Copy] = Queue()
        for i in range(args.jobs):
            copies.put(Copy(Path(folder) / str(i)))
        os.environ |= {
            "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",  # compiling takes longer than running; physics is the same
            "JAX_COMPILATION_CACHE_DIR": str(args.out.parent.resolve() / "compiled"),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
            "TF_CPP_MIN_LOG_LEVEL": "3",
        }
        FRESH.set_forkserver_preload(HEAVY)

        def right(files: list[str]) -> str:
            copy = copies.get()
            verdict = copy.some(files)
            copies.put(copy)
            return verdict

        def judged(mutant: Mutant):
            source = mutated(mutant)
            digest = _digest(mutant.module, source)
            row = known.get(digest)
            if row is None or (row["verdict"] == "passed" and row["tests"] != tests):
                copy = copies.get()
                copy.write(mutant.module, source)
                verdict = copy.tests(mutant.module)
                copy.write(mutant.module, _path(ROOT, mutant.module).read_text())
                copies.put(copy)
                row = {**mutant._asdict(), "digest": digest, "tests": tests, "verdict": verdict}
                with args.out.open("a") as file:
                    file.write(json.dumps(row) + "\n")
            return row

        with ThreadPoolExecutor(args.jobs) as pool:
            begin = time.perf_counter()
            files = ordered_tests("vec")
            verdicts = set(pool.map(right, [files[i :: args.jobs] for i in range(args.jobs)]))
            print(f"the right physics: {', '.join(verdicts)}, {time.perf_counter() - begin:.0f} s", flush=True)
            if verdicts != {"passed"}:  # a test that fails already would catch everything
                raise SystemExit(1)
            results = list(tqdm(pool.map(judged, drawn), total=len(drawn), unit=" mutants"))
    survivors = [row for row in results if row["verdict"] == "passed"]
    caught = len(results) - len(survivors)
    print(f"{len(population)} mutants in all, {len(results)} drawn by seed {args.seed}")
    print(f"caught: {caught} of {len(results)}, {100 * caught / len(results):.1f} %")
    for row in survivors:
        print(f"survived: jaxatt/{row['module']}.py:{row['line']} ({row['kind']}): {row['before']}  ->  {row['after']}")


if __name__ == "__main__":
    main()

"""What is said about the code is complete, and what it points to exists."""

import importlib
import inspect
import os
import pkgutil
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml

import jaxatt
from experiments.running import LOOPS, NAMES
from jaxatt import fields

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
MODULES = sorted(m.name for m in pkgutil.walk_packages(jaxatt.__path__, "jaxatt."))
# what the reference shows of each module: the names listed, or all public ones
SHOWN = {
    name: re.findall(r"\w+", members) if members else None
    for page in ROOT.glob("docs/api/*.md")
    for name, members in re.findall(r"automodule:: (jaxatt[\w.]*)\n(?: +:members: (.*)\n)?", page.read_text())
}
INTERNAL = {
    f"jaxatt.{name}"
    for name in (
        "batching",
        "headers",
        "logfiles",
        "normal_space",
        "one_loop",
        "resuming",
        "stamps",
        "stepping",
        "subset",
        "units",
    )
}
INTERNAL |= {"jaxatt.loops"}  # how it works inside, and the folder of the loops
# words of the house, defined where the reference begins (docs/api/index.md)
HOUSE = set(re.findall(r"^\| `(\w+)`", (ROOT / "docs/api/index.md").read_text(), re.M))
PLAIN = (inspect.Parameter.empty, "Any", "int", "float", "str", "bool")


def public(module):
    """Names, with their objects, that the reference shows of a module: of those it defines or, by __all__, hands on."""
    names = SHOWN[module.__name__] or getattr(module, "__all__", vars(module))
    for name in names:
        thing = getattr(module, name)
        own = getattr(thing, "__module__", "").startswith(module.__name__)
        if not name.startswith("_") and callable(thing) and own:
            yield name, thing


def says(text: str, word: str) -> bool:
    return re.search(rf"(?<![A-Za-z]){re.escape(word)}(?![A-Za-z])", text) is not None


@pytest.mark.parametrize("name", SHOWN)
def test_public_names_and_their_parameters_are_documented(name):
    module = importlib.import_module(name)
    assert module.__doc__, name
    for label, thing in public(module):
        doc = thing.__doc__
        assert doc and doc != tuple.__doc__ and not doc.startswith(f"{label}("), f"{label} has no docstring"
        if not inspect.isfunction(thing):
            continue
        parameters = inspect.signature(thing).parameters
        if len(parameters) == 1:
            continue  # the docstring is about it
        for word, parameter in parameters.items():
            known = word in HOUSE or says(doc, word) or says(module.__doc__, word)
            assert known or parameter.annotation not in PLAIN, f"{label} does not say what {word} is"


@pytest.mark.parametrize("name", SHOWN)
def test_fields_say_their_shape_or_unit(name):
    for label, thing in public(importlib.import_module(name)):
        if not hasattr(thing, "_fields") or "shape" in str(thing.__doc__):
            continue
        lines = inspect.getsource(thing).splitlines()
        for field, known in fields.of(thing).items():
            *_, line = [line for line in lines if re.match(rf"    {field}: ", line)]
            comment = line.partition("# ")[2]
            said = re.search(r"\[[^]]+\]|\([^)]*\)|\bbool\b|`[\w.]+`", comment)
            plain = re.match(r"    \w+: (?:Any|Annotated\[Any)\b", line) is None
            assert said or known.unit or plain, f"{label}.{field} says neither shape nor unit nor type"


def test_every_module_stands_in_the_reference():
    parts = {
        name for name in MODULES if re.match(r"jaxatt\.(campaign|tuning|yardstick)\.", name)
    }  # their packages hand them on
    assert set(MODULES) - parts <= {*SHOWN, *INTERNAL} and not INTERNAL & set(SHOWN)


def numbered(page: Path) -> dict[str, set[int]]:
    """The numbers under the headings of a loop's page."""
    parts = re.split(r"^## (.+)$", page.read_text(), flags=re.M)
    return {
        head: {int(n) for n in re.findall(r"^(\d+)\. ", body, re.M)} for head, body in zip(parts[1::2], parts[2::2])
    }


@pytest.mark.parametrize("path", sorted((ROOT / "jaxatt").rglob("*.py")), ids=lambda p: p.stem)
def test_choices_and_errata_that_the_code_cites_exist(path):
    text = re.sub(r"\s*\n\s*", " ", path.read_text())
    cited = re.findall(r"docs/loops/(\w+)\.md, (choice|erratum) (\d+)", text)
    if path.parent.name == "loops" and path.stem != "__init__":
        assert f"docs/loops/{path.stem}.md" in text
        own = re.sub(r"docs/loops/\w+\.md, (choice|erratum) \d+", "", text)
        cited += [(path.stem, *c) for c in re.findall(r"\b(choice|erratum) (\d+)", own)]
    for loop, what, number in cited:
        heads = numbered(ROOT / "docs/loops" / f"{loop}.md")
        assert int(number) in heads[{"choice": "Choices", "erratum": "Errata"}[what]], (loop, what, number)
    assert not re.search(r"\bspec\b", text), "readers have no spec: cite the loop's page"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_somewhere_and_pictures_are_described(page):
    text = re.sub(r"^```\w+\n.*?^```$", "", page.read_text(), flags=re.M | re.S)
    for mark, label, target in re.findall(r"(!?)\[([^]]*)\]\(([^)\s]+)\)", text):
        assert label.strip(), f"{page.name}: {target} has no words"
        if not re.match(r"https?://|#|doi:", target):
            path = page.parent / target.partition("#")[0]
            assert any(p.exists() for p in (path, Path(f"{path}.md"), Path(f"{path}.ipynb"))), f"{page.name}: {target}"
        assert not mark or len(label) > 20, f"{page.name}: {label} does not describe the picture"
    for body in re.findall(r"^```\{toctree\}\n(.*?)^```", text, re.M | re.S):
        for entry in (line for line in body.splitlines() if line and not line.startswith(":")):
            found = [*page.parent.glob(f"{entry}.md"), *page.parent.glob(f"{entry}.ipynb")]
            assert found, f"{page.name}: {entry}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_commands_name_what_exists(page):
    text = page.read_text()
    for name in re.findall(r"python -m ((?:experiments|benchmarks|notebooks)[\w.]*)", text):
        assert find_spec(name.rstrip(".")), f"{page.name}: {name}"
    for name in re.findall(r"python -m experiments (\w+)", text):
        assert name in (*NAMES, "NAME"), f"{page.name}: no experiment {name}"
    for name in re.findall(r"pytest (tests/\w+\.py)", text):
        assert (ROOT / name).exists(), f"{page.name}: {name}"


def test_pictures_stay_light():
    assert sum(p.stat().st_size for p in (ROOT / "docs/figures").iterdir()) < 1.5e6


@pytest.mark.parametrize("page", sorted(ROOT.glob("docs/**/*.md")), ids=lambda p: str(p.relative_to(ROOT)))
def test_code_of_the_pages_runs_as_printed(page):
    blocks = re.findall(r"^```python\n(.*?)^```", page.read_text(), re.M | re.S)
    if not blocks:
        return
    code = "\n".join(blocks).replace("n=3000", "n=1024")  # of credibility.md, whose bounds need 852 runs
    environment = dict(os.environ)
    if page.stem not in ("credibility", "rare_events"):  # whose runs are long
        environment["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"  # as for tests marked short
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_citation_is_one():
    cff = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors", "license"} <= set(cff)
    papers = set(LOOPS) - {"microsat"}  # which follows none
    assert cff["version"] == jaxatt.__version__ and len(cff["references"]) == len(papers)
    for work in [cff, *cff["references"]]:
        assert work["title"] and all({"name", "family-names"} & set(a) for a in work["authors"])

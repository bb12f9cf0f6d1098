"""The site: ``python -m sphinx -W --keep-going docs docs/_build/html``, offline; notebooks run once and are cached."""

import inspect
import os
import re
import sys
from pathlib import Path

from docutils.nodes import SkipNode
from latex2mathml.converter import convert

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))  # for their kernels
import jaxatt  # noqa: E402
import jaxatt.fields  # noqa: E402

project, author, release = "jaxatt", "the jaxatt authors", jaxatt.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["_build", "**/.ipynb_checkpoints"]
default_role = "py:obj"
suppress_warnings = ["mystnb.unknown_mime_type"]

html_theme = "furo"
html_title = f"jaxatt {release}"
html_show_copyright = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {"top_of_page_buttons": []}
html_math_renderer = "mathml"
templates_path: list[str] = []

myst_enable_extensions = ["dollarmath", "amsmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
nb_execution_mode = "cache"
nb_execution_timeout = 900
nb_execution_raise_on_error = True
nb_output_stderr = "remove"  # progress bars

autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True, "undoc-members": False}


BAR = '<mo lspace="0" rspace="0" stretchy="false">|</mo>'  # of a norm, not of a relation


def math(display):
    """LaTeX to MathML: browsers draw it and screen readers read it, without scripts and without a network."""

    def visit(translator, node):
        latex = node.astext().strip()
        html = convert(latex, display=display).replace("<mo>&#x0007C;</mo>", BAR).replace("<mo>|</mo>", BAR)
        if display == "block":
            number = f'<span class="eqno">({node["number"]})</span>' if node.get("number") else ""
            ids = "".join(f'<span id="{i}"></span>' for i in node["ids"])
            html = f'<div class="math" tabindex="0" role="group" aria-label="equation">{ids}{html}{number}</div>'
        translator.body.append(html)
        raise SkipNode

    return visit, None


def plain(text: str) -> str:
    """A docstring's text with what reStructuredText would take for markup, outside of code, escaped."""
    parts = re.split(r"(``.*?``|`[^`]*`)", text)
    return "".join(p if p.startswith("`") else re.sub(r"([*|])|(?<=\w)_(?!\w)", r"\\\g<0>", p) for p in parts)


def fields(cls) -> list[str]:
    """The fields of a NamedTuple: unit and shape by their annotation, meaning by their comment."""
    known, found = jaxatt.fields.of(cls), []
    for line in inspect.getsource(cls).splitlines():
        match = re.match(r"    (\w+): (.+?)(?: = (.*?))?\s*(?:  # (.*))?$", line)
        if match and match[1] in cls._fields:
            name, _, default, comment = match.groups()
            unit, kind_of, shapes = known[name].unit, known[name].kind, known[name].shapes
            words = [f"[{unit}]"] if unit else []
            words += ["or".join(f" ({', '.join(map(str, shape))}) " for shape in shapes).strip()] if shapes else []
            words += [plain(comment)] if comment else [f"`{kind_of.__name__}`"] if kind_of else []
            found.append(f"* **{name}**: {' '.join(words)}" + (f" (default ``{default}``)" if default else ""))
    return found


def is_record(obj) -> bool:
    return inspect.isclass(obj) and hasattr(obj, "_fields")


def docstring(app, what, name, obj, options, lines):
    text = plain("\n".join(lines)).splitlines()
    lines[:] = [*text, "", *fields(obj)] if is_record(obj) else text


def signature(app, what, name, obj, options, sig, returns):
    return ("", None) if is_record(obj) else (sig, returns)


def skip(app, what, name, obj, skipped, options):
    """Fields of a NamedTuple stand in its list, not one by one."""
    return True if type(obj).__name__ in ("_tuplegetter", "member_descriptor") or name.startswith("_") else None


def landmarks(app, exception):
    """Headings get their level, landmarks their names, and what scrolls sideways the keyboard's focus."""
    names = {
        "<pre>": '<pre tabindex="0">',
        '<div class="table-wrapper': '<div tabindex="0" role="group" aria-label="table" class="table-wrapper',
        'role="heading">': 'role="heading" aria-level="2">',
        '<aside class="sidebar-drawer">': '<aside class="sidebar-drawer" aria-label="Site">',
        '<aside class="toc-drawer">': '<aside class="toc-drawer" aria-label="Page">',
    }
    for page in Path(app.outdir).rglob("*.html"):
        text = page.read_text()
        for old, new in names.items():
            text = text.replace(old, new)
        page.write_text(text)


def setup(app):
    app.add_html_math_renderer("mathml", inline_renderers=math("inline"), block_renderers=math("block"))
    app.connect("autodoc-process-docstring", docstring)
    app.connect("autodoc-process-signature", signature)
    app.connect("autodoc-skip-member", skip)
    app.connect("build-finished", landmarks)

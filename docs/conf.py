"""How the site is made: `python -m sphinx -W --keep-going -c docs . site`, from the top of the repository.

The pages and their links are those that a code host shows: the source folder is the repository, of which the pages
below are taken. The contents of the site are the links of docs/README.md, by its headings: there is no second list of
pages, and one that it leaves out is a warning, which is an error. Nothing is fetched, while building or reading.
"""

from __future__ import annotations

import re
import sys
import tomllib
from importlib import import_module
from pathlib import Path

from docutils import nodes
from pygments.lexers.special import TextLexer
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util import logging

LONGEST_VALUE = 60
ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))  # the reference is of this very tree
busmaster = import_module("busmaster")
for public in busmaster.__all__:
    setattr(busmaster, public, getattr(busmaster, public))  # imported when asked for: autodoc does not ask

project = "busmaster"
release = version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
html_title = f"busmaster {release}"
html_copy_source = False
html_show_copyright = False
html_theme = "furo"

root_doc = "docs/README"
include_patterns = ["docs/**.md", "README.md", "CONTRIBUTING.md", "CHANGELOG.md", "benchmarks/README.md"]
include_patterns += ["CODE_OF_CONDUCT.md", "SECURITY.md"]
exclude_patterns = [".*", "build", "dist", "busmaster", "examples", "tests"]  # not walked through at all
extensions = ["myst_parser", "sphinx.ext.autodoc"]
myst_heading_anchors = 4  # a heading is linked to as on a code host
autodoc_member_order = "bysource"
toc_object_entries = False  # else every page would have the whole API beside it
default_role = "py:obj"  # what docstrings have in `backquotes`, linked to where it is on a page


def add_contents(_app: Sphinx, name: str, text: list[str]) -> None:
    """Give the first page the site's contents: the pages that it links to, once each, by its headings."""
    if name != root_doc:
        return
    folder, known = (ROOT / name).parent, set[str]()
    for part in re.split(r"^## ", text[0], flags=re.MULTILINE):
        caption, _, body = part.partition("\n")
        paths = [(folder / link).resolve() for link in re.findall(r"\]\(([^)#:]+\.md)\)", body)]
        pages = [f"/{path.relative_to(ROOT).with_suffix('')}" for path in paths if path.suffix == ".md"]
        own = [page for page in dict.fromkeys(pages) if page not in known]
        known.update(own)
        heading = "" if caption.startswith("# ") else f":caption: {caption}\n"
        text[0] += f"\n\n```{{toctree}}\n:hidden:\n{heading}\n" + "\n".join(own) + "\n```\n"


def show_programs(_app: Sphinx, what: str, _name: str, _thing: object, _options: object, lines: list[str]) -> None:
    """Have what a docstring indents shown as the program that it is; leave out a module's own, which explains code."""
    if what == "module":
        lines.clear()
    for number in range(len(lines) - 1, 0, -1):
        above = next((line for line in reversed(lines[:number]) if line), "")
        if lines[number].startswith("    ") and not lines[number - 1] and not above.startswith("    "):
            lines[number:number] = ["::", ""]


def leave_out_long_values(_app: Sphinx, tree: nodes.document) -> None:
    """Leave out values of attributes that nobody would read: a profile, or all elements of a drive."""
    for annotation in list(tree.findall(addnodes.desc_annotation)):
        if annotation.astext().lstrip().startswith("=") and len(annotation.astext()) > LONGEST_VALUE:
            annotation.parent.remove(annotation)


def check_names(_app: Sphinx, environment: BuildEnvironment) -> None:
    """Hold that every public name is on the page, constants where they are made."""
    known = environment.domains.python_domain.objects
    for name in busmaster.__all__:
        if callable(getattr(busmaster, name)) and f"busmaster.{name}" not in known:
            logging.getLogger(__name__).warning("the public name %s is not on the page of the API", name)


def send_to_contents(app: Sphinx, error: Exception | None) -> None:
    """Have the top of a site that is served lead to its first page."""
    if error is None and app.builder.format == "html":
        head = f'<meta charset="utf-8"><title>{project}</title>'
        refresh = f'<meta http-equiv="refresh" content="0; url={root_doc}.html">'
        (Path(app.outdir) / "index.html").write_text(f"<!doctype html>{head}{refresh}\n")


def setup(app: Sphinx) -> None:
    """Add what is above to Sphinx, which calls this."""
    app.add_lexer("telegrams", TextLexer)
    app.connect("source-read", add_contents)
    app.connect("autodoc-process-docstring", show_programs)
    app.connect("doctree-read", leave_out_long_values)
    app.connect("env-check-consistency", check_names)
    app.connect("build-finished", send_to_contents)

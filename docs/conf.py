"""How the site is made: `python -m sphinx -W --keep-going -c docs . site`, from the top of the repository.

The pages and their links are those that a code host shows: the source folder is the repository, of which the pages
below are taken. The contents of the site are the links of docs/README.md, by its headings: there is no second list of
pages, and one that it leaves out is a warning, which is an error. Nothing is fetched, while building or reading.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx

ROOT = Path(__file__).parent.parent

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
extensions = ["myst_parser"]
myst_heading_anchors = 4  # a heading is linked to as on a code host


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
    app.connect("build-finished", send_to_contents)

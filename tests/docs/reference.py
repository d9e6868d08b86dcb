"""Generates the reference of LINE.toml, the bounds, the command line and the API, the schemas, and the manual page.

`python -m tests.docs.reference` writes the files. A test verifies that they are current.
"""

from __future__ import annotations

import ast
import json
import tomllib
from collections.abc import Callable, Iterator
from importlib import import_module
from itertools import pairwise

from busmaster.app.config.keys import MILLION, Key
from busmaster.app.config.schema import json_schema, tables
from busmaster.app.service.schema import service_schema
from tests.docs.api import api
from tests.docs.command_line import manual, page
from tests.docs.pages import ROOT


def line_toml() -> str:
    """The reference of LINE.toml, in Markdown."""
    return "\n".join(_line_toml())


def _line_toml() -> Iterator[str]:
    yield """# LINE.toml

One file describes a line: its port, its nodes, its poll groups and its outputs. This page is generated from the
declarations with which the program reads the file: each key with its type, unit, range, default and meaning. Any other
key is an error. The error names the line in the file and the most similar key.
[examples/line.toml](../../examples/line.toml) is a complete file with comments.

All times are in seconds. A key without a default is optional; its meaning describes the behaviour without it.

## In an editor

Editors with support for JSON Schema complete keys, show these texts, and mark errors while you type. In Visual Studio
Code, install the extension "Even Better TOML" and write the schema to a file:

```sh
busmaster check --schema > line.schema.json
```

Then begin LINE.toml with the path of that file, relative to the folder of LINE.toml:

```toml
#:schema ./line.schema.json
```

The schema contains the options of every installed protocol. [docs/line.schema.json](../line.schema.json) is the schema
without other packages. It checks single values. Only `busmaster check` checks rules that depend on several values or on
other files.
"""
    for table in tables():
        yield f"## {_titled(table.header)}\n\n{table.about}\n"
        yield "| key | type | default | meaning |\n|---|---|---|---|"
        for key in table.keys:
            yield f"| `{key.name}` | {key.form.shown} | {_default(key)} | {key.about} |"
        yield ""


def _titled(header: str) -> str:
    """A header as a title, with what is code in backquotes."""
    code, closing, rest = header.partition("]")
    return f"`{code}]`{rest}" if closing else f"`{header}`" if "=" in header else header


def _default(key: Key) -> str:
    if key.required:
        return "required"
    match key.default:
        case None | "":
            return ""
        case bool():
            return f"`{str(key.default).lower()}`"
        case float() | int():
            return f"`{key.default:_}`" if key.default >= MILLION else f"`{key.default:g}`"
    return f'`"{key.default}"`'


def bounds() -> str:
    """The reference of the bounds, in Markdown, from the module that declares them."""
    return "\n".join(_bounds())


def _bounds() -> Iterator[str]:
    yield """# Bounds

The bounds of all input from files and clients. Input beyond a bound is rejected, and the error names the bound. They
are not settings: a line and its views are tested with these values. Each bound is declared once, in
`busmaster/contract/bounds.py` or `busmaster/app/bounds.py`, from which this page is generated. Times are in seconds.
"""
    for module in ("busmaster.contract.bounds", "busmaster.app.bounds"):
        yield from _bounds_of(module)


def _bounds_of(module: str) -> Iterator[str]:
    text = ROOT.joinpath(*module.split(".")).with_suffix(".py").read_text()
    titles = {number: line[2:] for number, line in enumerate(text.splitlines(), 1) if line.startswith("# ")}
    body = ast.parse(text).body
    for node, about in pairwise(body):
        if not isinstance(node, ast.Assign):
            continue
        while titles and min(titles) < node.lineno:
            yield f"\n## {titles.pop(min(titles))}\n\n| bound | value | meaning |\n|---|---|---|"
        [name] = (target.id for target in node.targets if isinstance(target, ast.Name))
        assert isinstance(about, ast.Expr), f"{name} has no text"
        assert isinstance(about.value, ast.Constant), f"{name} has no text"
        value = getattr(import_module(module), name)
        shown = f"{int(value):_d}".replace("_", " ") if value == int(value) and value < 1e9 else f"{value:g}"
        yield f"| `{name}` | {shown} | {' '.join(str(about.value.value).split())} |"


def our_manual() -> str:
    """The manual page of this version."""
    return manual(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"])


FILES: dict[str, Callable[[], str]] = {
    "docs/reference/line-toml.md": line_toml,
    "docs/line.schema.json": lambda: json.dumps(json_schema(), indent=1) + "\n",
    "docs/service.schema.json": lambda: json.dumps(service_schema(), indent=1) + "\n",
    "docs/reference/command-line.md": page,
    "docs/reference/bounds.md": lambda: bounds() + "\n",
    "docs/reference/api.md": api,
    "share/man/man1/busmaster.1": our_manual,
}
"""Every file that is made, by its path, with what makes its text."""


def main() -> None:
    """Write them."""
    for name, text in FILES.items():
        path = ROOT / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text())


if __name__ == "__main__":
    main()

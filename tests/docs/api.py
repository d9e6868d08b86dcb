"""The reference of the API in Markdown: each public name with its signature and its docstring, by module.

docs/public-api.md lists the modules. A name that several modules have is described once: in `busmaster`, else in the
module that defines it, else in the first that has it.
"""

from __future__ import annotations

import ast
import enum
import inspect
import re
import sys
from collections.abc import Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from importlib import import_module
from inspect import Parameter, Signature
from pathlib import Path
from textwrap import indent
from typing import Any, ForwardRef, NamedTuple

import busmaster
from tests.docs.pages import ROOT

APART = {"busmaster.app.bounds": "[Bounds](bounds.md) lists them with their values."}
"""Modules whose names have a page of their own."""
LONGEST_SIGNATURE = 100
LONGEST_VALUE = 60
CLASS = re.compile(r"`([A-Z][A-Za-z0-9]*[a-z][A-Za-z0-9]*)(?:\.\w+)*(?:\(.*\))?`$")
"""What is a link in a docstring if it is described: a class, or what it offers."""
INTRODUCTION = """# API

Every public name with its signature and its docstring. The [public API policy](../public-api.md) lists the modules and
how names change. Times are in seconds and baud rates in bits per second, unless the text states otherwise. A wrong
argument raises `InvalidCommand` before anything is sent. `help(busmaster.Bus)` prints the same text.
"""


class Name(NamedTuple):
    """A public name, where it is described, and the link to its heading ("" for a constant)."""

    module: str
    name: str
    link: str


def api() -> str:
    return "\n".join(_page()) + "\n"


def _page() -> Iterator[str]:
    yield INTRODUCTION
    for module, who in modules().items():
        yield f"- [{module}](#{_slug(module)}): {who}"
    for module, who in modules().items():
        yield f"\n## {module}\n\nFor {who}.\n"
        if module in APART:
            yield APART[module]
            continue
        own = [name for name in import_module(module).__all__ if home(module, name).module == module]
        yield from (_constant(module, name) for name in own if not home(module, name).link)
        if links := [f"[`{name}`](#{home(module, name).link})" for name in own if home(module, name).link]:
            yield f"\nClasses and functions: {', '.join(links)}."
        if others := _elsewhere(module):
            yield f"\nAlso in this module, described elsewhere: {others}."
        for name in own:
            if home(module, name).link:
                yield f"\n### {name}\n"
                yield from _described(module, name)


@cache
def modules() -> dict[str, str]:
    """The public modules, and for whom each is."""
    table = (ROOT / "docs" / "public-api.md").read_text()
    found = re.findall(r"^\| `(busmaster\.[\w.]+)` \| (.*) \|$", table, re.MULTILINE)
    return {"busmaster": "applications", **dict(found)}


@cache
def homes() -> dict[tuple[str, str], Name]:
    """Where each name of each module is described."""
    places: dict[tuple[str, str], str] = {}
    firsts: dict[int, str] = {}
    for module in modules():
        for name in import_module(module).__all__:
            thing = getattr(import_module(module), name)
            defined = _source(module, name)[0] if not _has_heading(thing) else getattr(thing, "__module__", "")
            root = name in busmaster.__all__ and getattr(busmaster, name) is thing
            public = defined in modules() and name in import_module(defined).__all__
            first = firsts.setdefault(id(thing), module) if _has_heading(thing) else module
            places[module, name] = "busmaster" if root else defined if public else first
    seen = dict.fromkeys(map(_slug, ("api", *modules())), 0)
    links: dict[tuple[str, str], str] = {}
    for module in modules():
        for name in import_module(module).__all__ if module not in APART else ():
            if places[module, name] == module and _has_heading(getattr(import_module(module), name)):
                slug = _slug(name)
                times = seen[slug] = seen.get(slug, -1) + 1
                links[module, name] = f"{slug}-{times}" if times else slug
    return {(module, name): Name(place, name, links.get((place, name), "")) for (module, name), place in places.items()}


def home(module: str, name: str) -> Name:
    return homes()[module, name]


def _slug(heading: str) -> str:
    """The anchor of a heading, as code hosts and the site make it."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def _has_heading(thing: object) -> bool:
    return inspect.isclass(thing) or inspect.isroutine(thing)


def _elsewhere(module: str) -> str:
    names = [home(module, name) for name in import_module(module).__all__]
    return ", ".join(f"[`{one.name}`](#{one.link or _slug(one.module)})" for one in names if one.module != module)


# the text of one name


def _described(module: str, name: str) -> Iterator[str]:
    thing = getattr(import_module(module), name)
    if not isinstance(thing, type):
        yield _code(_function(name, thing))
        yield _text(thing, module)
        return
    bases = [_linked(f"`{base.__name__}`", module) for base in thing.__bases__]
    described = [base for base in bases if base.startswith("[")]
    yield _code(f"class {name}{_parameters(thing)}")
    if described:
        yield f"Inherits from {', '.join(described)}.\n"
    yield _text(thing, module)
    for number, (label, text) in enumerate(_members(thing)):
        yield f"{'' if number else chr(10)}- **`{label}`**{_member_text(text, module)}"


def _members(owner: type) -> Iterator[tuple[str, str]]:
    """What a class offers, with its text: fields that have one, values, methods, properties. Inherited ones are listed
    unless their class is described itself."""
    described = {id(getattr(import_module(one.module), one.name)) for one in homes().values() if one.link}
    seen = set[str]()
    for cls in owner.__mro__:
        if not cls.__module__.startswith("busmaster") or (cls is not owner and id(cls) in described):
            continue
        fields = _field_texts(cls)
        for name in [*inspect.get_annotations(cls), *vars(cls)]:
            if name.startswith("_") or name in seen:
                continue
            member = inspect.getattr_static(owner, name, None)
            text = inspect.getdoc(member) if _is_called(member) else fields.get(name)
            if text is None and not isinstance(member, enum.Enum):
                continue
            seen.add(name)
            yield _label(owner, cls, name, member), text or ""


def _is_called(member: object) -> bool:
    return isinstance(member, property | classmethod | staticmethod) or inspect.isfunction(member)


def _label(owner: type, cls: type, name: str, member: object) -> str:
    match member:
        case property():
            return f"{name}: {_annotation(inspect.signature(member.fget).return_annotation)}" if member.fget else name
        case classmethod() | staticmethod():
            return f"{type(member).__name__} {_function(name, getattr(owner, name))}"
        case enum.Enum():
            return f"{name} = {member.value!r}"
    if inspect.isfunction(member):
        return _function(name, member)
    annotation = inspect.get_annotations(cls).get(name)
    return name if annotation is None else f"{name}: {_annotation(annotation)}"


def _function(name: str, function: Any) -> str:
    is_async = inspect.iscoroutinefunction(function) or inspect.isasyncgenfunction(function)
    return f"{'async ' if is_async else ''}{name}{_parameters(function)}"


def _parameters(called: Any) -> str:
    """The parameters and the result, as they are written in a program; for a class, what it inherits if that is all."""
    if isinstance(called, type) and (issubclass(called, enum.Enum) or getattr(called, "_is_protocol", False)):
        return f"({called.__bases__[0].__name__})" if issubclass(called, enum.Enum) else "(Protocol)"
    try:
        signature = inspect.signature(called)
        if is_dataclass(called) and list(signature.parameters) == ["args", "named"]:  # old names are accepted too
            signature = Signature([_parameter(each) for each in fields(called) if each.init])
        if getattr(getattr(called, "__init__", None), "__name__", "").startswith("_no_init"):
            signature = Signature()  # `typing` replaces this `__init__` of protocols when the first instance is made
    except (TypeError, ValueError):
        return ""
    parts: list[str] = []
    kind: Any = None
    for parameter in signature.parameters.values():
        if parameter.name in ("self", "cls"):
            continue
        if kind is parameter.POSITIONAL_ONLY is not parameter.kind:
            parts.append("/")
        if parameter.kind is parameter.KEYWORD_ONLY and kind not in (parameter.KEYWORD_ONLY, parameter.VAR_POSITIONAL):
            parts.append("*")
        kind = parameter.kind
        stars = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}.get(kind, "")
        text = f"{stars}{parameter.name}"
        if parameter.annotation is not parameter.empty:
            text += f": {_annotation(parameter.annotation)}"
        if parameter.default is not parameter.empty:
            text += f" = {_default(parameter.default)}"
        parts.append(text)
    if kind is Parameter.POSITIONAL_ONLY:
        parts.append("/")
    result = "" if isinstance(called, type) else _annotation(signature.return_annotation)
    arrow = f" -> {result}" if result else ""
    return f"({', '.join(parts)}){arrow}" if parts or not isinstance(called, type) else "()"


def _parameter(field: Field[Any]) -> Parameter:
    default = field.default
    if field.default is MISSING and field.default_factory is not MISSING:
        default = field.default_factory  # it is shown as "..."
    kind = Parameter.KEYWORD_ONLY if field.kw_only else Parameter.POSITIONAL_OR_KEYWORD
    return Parameter(
        field.name, kind, default=Parameter.empty if default is MISSING else default, annotation=field.type
    )


def _annotation(annotation: Any) -> str:
    if annotation is Signature.empty:
        return ""
    if isinstance(annotation, ForwardRef):
        annotation = annotation.__forward_arg__
    text = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
    return text.replace(", self_checked=True", "").strip("'")


def _default(value: object) -> str:
    match value:
        case enum.Enum():
            return f"{type(value).__name__}.{value.name}"
        case None | bool() | int() | float() | str() | bytes() | ():
            return repr(value)
        case type():
            return value.__name__
    return "..."


def _code(signature: str) -> str:
    """A signature in a block; a long one with a parameter a line."""
    if len(signature) > LONGEST_SIGNATURE:
        head, _, rest = signature.partition("(")
        depth, start, parts = 0, 0, list[str]()
        for place, character in enumerate(rest):
            depth += (character in "([{") - (character in ")]}")
            if depth < 0 or (depth == 0 and character == ","):
                parts.append(rest[start:place].strip())
                start = place + 1
            if depth < 0:
                break
        signature = f"{head}(\n" + "".join(f"    {part},\n" for part in parts if part) + f"){rest[start:]}"
    return f"```py\n{signature}\n```\n"


def _text(thing: object, module: str) -> str:
    return _linked(inspect.getdoc(thing) or "", module)


def _member_text(text: str, module: str) -> str:
    head, _, rest = _linked(text, module).partition("\n\n")
    more = f"\n\n{indent(rest, '  ')}" if rest else ""
    return f": {' '.join(head.split())}{more}" if head else ""


def _linked(text: str, module: str) -> str:
    """A docstring as Markdown: names that this page describes are links. An indented program stays as it is."""
    return "\n".join(line if line.startswith("    ") else _line(line, module) for line in text.splitlines())


def _line(line: str, module: str) -> str:
    parts = re.split(r"(`[^`]+`)", line)
    for place, part in enumerate(parts):
        if place % 2 == 0:
            parts[place] = part.replace("<", "&lt;").replace("*", "\\*")
        elif (found := CLASS.match(part)) and (link := _link(found[1], module)):
            parts[place] = f"[{part}](#{link})"
    return "".join(parts)


def _link(name: str, module: str) -> str:
    """The link to a name: that of the same module, else the first."""
    found = [one.link for (where, each), one in homes().items() if each == name and one.link and where == module]
    found += [one.link for (_, each), one in homes().items() if each == name and one.link]
    return found[0] if found else ""


# what only the source says


def _constant(module: str, name: str) -> str:
    value = getattr(import_module(module), name)
    where, node, text = _source(module, name)
    if inspect.ismodule(value):
        summary, _, _ = (inspect.getdoc(value) or "").partition("\n\n")
        return f"- **`{name}`**{_member_text(f'A module. {summary}', module)}"
    if isinstance(value, enum.Enum):
        shown = f"{type(value).__name__}.{value.name}"
    elif node is None or node.value is None:
        shown = ""
    elif isinstance(value, int | float | str | bytes) and not isinstance(node.value, ast.Constant):
        shown = repr(value)  # it is calculated
    else:
        shown = ast.get_source_segment(_text_of(where), node.value) or ""
    label = f"{name} = {shown}" if 0 < len(shown) <= LONGEST_VALUE and "\n" not in shown else name
    return f"- **`{label}`**{_member_text(text, where)}"


@cache
def _text_of(module: str) -> str:
    return Path(inspect.getsourcefile(sys.modules[module]) or "").read_text()


@cache
def _tree(module: str) -> ast.Module:
    return ast.parse(_text_of(module))


def _source(module: str, name: str) -> tuple[str, ast.Assign | ast.AnnAssign | None, str]:
    """The module in which a constant is made, the statement that makes it, and the text below that."""
    import_module(module)
    for node in _tree(module).body:
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("busmaster"):
            for alias in node.names:
                if name == (alias.asname or alias.name) and f"{node.module}.{alias.name}" not in sys.modules:
                    return _source(node.module, alias.name)
    found = _texts(_tree(module).body)
    return (module, *found[name]) if name in found else (module, None, "")


def _texts(body: list[ast.stmt]) -> dict[str, tuple[ast.Assign | ast.AnnAssign, str]]:
    """Assignments with the text below each, "" where there is none."""
    found: dict[str, tuple[ast.Assign | ast.AnnAssign, str]] = {}
    for node, after in zip(body, [*body[1:], None], strict=True):
        if not isinstance(node, ast.Assign | ast.AnnAssign):
            continue
        text = ""
        if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            text = inspect.cleandoc(str(after.value.value))
        for target in [node.target] if isinstance(node, ast.AnnAssign) else node.targets:
            for each in target.elts if isinstance(target, ast.Tuple) else [target]:
                if isinstance(each, ast.Name):
                    found[each.id] = node, text
    return found


def _field_texts(cls: type) -> dict[str, str]:
    """The text below each field of a class."""
    for node in ast.walk(_tree(cls.__module__)):
        if isinstance(node, ast.ClassDef) and node.name == cls.__qualname__.rpartition(".")[2]:
            return {name: text for name, (_, text) in _texts(node.body).items() if text}
    return {}

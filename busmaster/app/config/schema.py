"""All tables and keys of a LINE.toml: for its reference and as JSON Schema, for editors."""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import Any

from busmaster import Meaning, Rfc2217Port, Rs485, SerialPort, TcpPort
from busmaster.app.config.emulator import EmulatedSection, EmulatorSection
from busmaster.app.config.keys import Key, keys_of, names_of
from busmaster.app.config.options import keys_of_options
from busmaster.app.config.point_section import PointSection
from busmaster.app.config.ports import ByRfc2217, rfc2217_keys, serial_keys, tcp_keys
from busmaster.app.config.safe import SafeSection
from busmaster.app.config.sections import GroupSection, LineFile, NodeSection, ProtocolSection
from busmaster.app.config.service import RoleSection, ServiceSection
from busmaster.app.config.templates import Template
from busmaster.app.config.timing import TimesSection, TimingSection
from busmaster.app.outputs.kinds import kinds as output_kinds
from busmaster.emulator import Faults
from busmaster.ext import NodeKind, Option, kinds


@dataclass(frozen=True, slots=True)
class TableKeys:
    """One table of the reference: its header in a file, its purpose, and its keys.

    `definition` is its name in the JSON Schema, "" for a part of another table.
    """

    header: str
    about: str
    keys: tuple[Key, ...]
    definition: str = ""


def tables() -> Iterator[TableKeys]:
    """Yield every table of a file, in the order of the reference."""
    yield _table("The top", "Keys at the top of the file, before the first table.", LineFile, "")
    serial = _described(serial_keys(), SerialPort)
    yield TableKeys("[port]", "A serial port as a table.", serial, "serial_port")
    switched = "How RTS switches the transmitter of a serial port, in [port]."
    yield _table("rs485 = {}", switched, Rs485, "rs485")
    tcp = _described(tcp_keys(), TcpPort, ByRfc2217)
    yield TableKeys("[port] with host", "A serial server as a table.", _required_first(tcp), "tcp_port")
    remote = _described(rfc2217_keys(), Rfc2217Port, ByRfc2217)
    about = "A serial server whose line settings are set by RFC 2217."
    yield TableKeys("[port] with rfc2217 = true", about, _required_first(remote), "rfc2217_port")
    common = "Defaults for all nodes of one protocol. Its options are permitted here too."
    yield _table("[protocols.NAME]", common, ProtocolSection, "")
    yield _table("[nodes.NAME]", "A node; several where NAME is a range, as drive4-7.", NodeSection, "")
    yield from _options("[nodes.NAME]", "nodes", lambda kind: kind.options)
    yield _table("timing = {}", "Reply times, from the last byte of a request on the wire.", TimingSection, "timing")
    points = described(PointSection) + described(Meaning)
    yield TableKeys("[nodes.NAME.points]", "Each key is a point, and its value a table of these.", points, "point")
    yield _table(
        "[groups.NAME]", "A poll group: points that are read together, on a fixed grid.", GroupSection, "group"
    )
    for kind in output_kinds():
        keys = tuple(key for key in described(kind.settings) if key.name not in kind.without)
        yield TableKeys(f"[outputs.{kind.name}]", kind.about, _required_first(keys), f"output_{kind.name}")
    yield _table("[safe]", "Writes that are sent when the program ends.", SafeSection, "safe")
    yield _table("[service]", "Which other programs can use the line, and how they connect.", ServiceSection, "service")
    roles = "A role; so too [service.groups.NAME], [service.tokens.NAME]."
    yield _table("[service.users.NAME]", roles, RoleSection, "role")
    yield _table("[emulator]", "How the line is emulated.", EmulatorSection, "emulator")
    every = "Settings for one node, or a range. The options of its kind follow."
    yield _table("[emulator.nodes.NAME]", every, EmulatedSection, "")
    yield from _options("[emulator.nodes.NAME]", "emulated nodes", lambda kind: kind.emulated)
    yield _table("faults = {}", "The probability per frame of each fault; 0 by default.", Faults, "faults")
    yield _table("A template", "A separate file, which `template` names.", Template, "")


def _table(header: str, about: str, section: type, definition: str) -> TableKeys:
    return TableKeys(header, about, _required_first(described(section)), definition)


def _required_first(keys: Iterable[Key]) -> tuple[Key, ...]:
    return tuple(sorted(keys, key=lambda key: not key.required))


def described(section: type) -> tuple[Key, ...]:
    """Return the keys of a section with their descriptions."""
    return _described(keys_of(section), section)


def _described(keys: Iterable[Key], *sections: type) -> tuple[Key, ...]:
    classes = [kind for section in sections for kind in reversed(section.__mro__[:-1])]
    about = {name: text for kind in classes for name, text in attribute_docs(kind).items()}
    return tuple(replace(key, about=about.get(key.field, "")) for key in keys)


def attribute_docs(kind: type) -> dict[str, str]:
    """Return the docstring of each attribute of a class, by name."""
    docs = {}
    for statement, text in pairwise(_definitions(kind.__module__)[kind.__qualname__].body):
        match statement, text:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(about))):
                docs[name] = " ".join(about.split())
    return docs


@cache
def _definitions(module: str) -> dict[str, ast.ClassDef]:
    """Return the classes of a module by name. `inspect.getsource` of a class would parse the module each time."""
    parsed = ast.parse(inspect.getsource(sys.modules[module]))
    return {node.name: node for node in parsed.body if isinstance(node, ast.ClassDef)}


def _options(header: str, nodes: str, options_of: Callable[[NodeKind], Sequence[Option]]) -> Iterator[TableKeys]:
    for kind in kinds().values():
        keys = tuple(_flat(options_of(kind)))
        if keys:
            yield TableKeys(f"{header} of {kind.name}", f"Only for {nodes} of {kind.name}.", keys)


def _flat(options: Sequence[Option], before: str = "") -> Iterator[Key]:
    """Yield options as keys; those of tables as `parameters.NAME.low`."""
    for option, key in zip(options, keys_of_options(options), strict=True):
        yield replace(key, name=before + key.name)
        yield from _flat(option.fields, f"{before}{key.name}.NAME.")


# JSON Schema


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of a LINE.toml, with the options of every protocol that is installed.

    Editors know different drafts of JSON Schema. This uses what draft 7 and draft 2020-12 have in common: a table
    forbids other keys by `additionalProperties`, and so names the options of all protocols.
    """
    known = kinds().values()
    shared, node, emulated = described(ProtocolSection), described(NodeSection), described(EmulatedSection)
    common = {kind.name: [option for option in kind.options if option.common] for kind in known}
    outputs = {kind.name: {"$ref": f"#/$defs/output_{kind.name}"} for kind in output_kinds()}
    number_or_flag = {"type": ["number", "boolean"]}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "LINE.toml of busmaster",
        **_object(described(LineFile)),
        "$defs": {
            **{table.definition: _object(table.keys) for table in tables() if table.definition},
            "times": _object(described(TimesSection)),
            "values": {"anyOf": [number_or_flag, {"type": "array", "items": number_or_flag}]},
            "protocol_name": {"enum": [kind.name for kind in known]},
            "protocols": _closed(
                {name: _object((*shared, *keys_of_options(options))) for name, options in common.items()}
            ),
            "node": {**_object(node, _any_of_options(lambda kind: kind.options)), "allOf": [*map(_only_own, known)]},
            "emulated_node": _object(emulated, _any_of_options(lambda kind: kind.emulated)),
            "outputs": _closed(outputs),
        },
    }


def _object(keys: Iterable[Key], more: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the schema of a table with these keys, and `more` properties."""
    keys = tuple(keys)
    schema = _closed({**{key.name: _property(key) for key in keys}, **(more or {})})
    required = [key.name for key in keys if key.required]
    return {**schema, "required": required} if required else schema


def _closed(properties: Mapping[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "additionalProperties": False}


def _property(key: Key) -> dict[str, Any]:
    about = {"description": key.about} if key.about else {}
    default = {} if key.default in (None, "") else {"default": key.default}
    return {**about, **key.form.schema, **default}


def _any_of_options(options_of: Callable[[NodeKind], Sequence[Option]]) -> dict[str, Any]:
    """Return the properties that nodes of any kind have; a name that several kinds use takes what any of them does."""
    found: dict[str, list[Any]] = {}
    for kind in kinds().values():
        for key in keys_of_options(options_of(kind)):
            schemas = found.setdefault(key.name, [])
            if _property(key) not in schemas:
                schemas.append(_property(key))
    return {name: schemas[0] if len(schemas) == 1 else {"anyOf": schemas} for name, schemas in found.items()}


def _only_own(kind: NodeKind) -> dict[str, Any]:
    """Return the schema by which a node of one kind has its own options alone."""
    own = keys_of_options(kind.options)
    names = names_of((*keys_of(NodeSection), *own))
    return {
        "if": {"properties": {"protocol": {"const": kind.name}}, "required": ["protocol"]},
        "then": {"propertyNames": {"enum": [*names]}, "properties": {key.name: dict(key.form.schema) for key in own}},
    }

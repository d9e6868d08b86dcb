"""docs/service.schema.json is a schema, has all that docs/service.md tells of, and refuses what it does not."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import pytest
from jsonschema import Draft202012Validator

from busmaster.registry import Protocol, protocols
from tests.app.service import schema

PAGE = (schema.PATH.parent / "service.md").read_text()
READ = {"command": "read", "element": 1}
REQUEST: dict[str, Any] = {"protocol": "hcp2", "address": 5, "command": READ}


def parts(kind: str) -> set[str]:
    return {name.removesuffix(f"_{kind}") for name in schema.DEFINED if name.endswith(f"_{kind}")}


def told(head: str) -> set[str]:
    """The first column of the table of the page that begins so."""
    rows = PAGE.partition(f"| {head} |")[2].partition("\n\n")[0]
    return set(re.findall(r"^\| `(\w+)` \|", rows, re.MULTILINE))


def test_it_is_a_schema_and_each_of_its_references_leads_somewhere() -> None:
    Draft202012Validator.check_schema(schema.SCHEMA)
    for name in schema.DEFINED:
        Draft202012Validator.check_schema(schema.DEFINED[name])
    text = schema.PATH.read_text()
    assert set(re.findall(r'"#/\$defs/([^"]+)"', text)) <= set(schema.DEFINED)


def test_it_has_the_messages_that_the_page_tells_of() -> None:
    assert parts("params") == parts("result") == told("request")
    assert parts("from_client") == told("notification of a client")
    assert parts("from_owner") == told("notification to a client")


@pytest.mark.parametrize(
    ("said", "right"),
    [
        ({"jsonrpc": "2.0", "id": 1, "method": "request", "params": REQUEST}, True),
        ({"jsonrpc": "2.0", "id": 1, "method": "request", "params": {**REQUEST, "stop": 1}}, False),
        ({"jsonrpc": "2.0", "id": 1, "method": "request", "params": {**REQUEST, "priority": 0}}, False),
        ({"jsonrpc": "2.0", "id": 1, "method": "request", "params": {**REQUEST, "command": {}}}, False),
        ({"jsonrpc": "2.0", "id": "1", "method": "request", "params": REQUEST}, False),
        ({"id": 1, "method": "request", "params": REQUEST}, False),
        ({"jsonrpc": "2.0", "method": "request", "params": REQUEST}, False),
        ({"jsonrpc": "2.0", "method": "cancel", "params": {"id": 1}}, True),
        ({"jsonrpc": "2.0", "id": 1, "method": "gather", "params": {"stream": 1, "points": [REQUEST]}}, True),
        ({"jsonrpc": "2.0", "id": 1, "method": "gather", "params": {"stream": 1, "points": [{"key": "5/1"}]}}, False),
        ({"jsonrpc": "2.0", "id": 1, "method": "shutdown", "params": {}}, False),
        ({"jsonrpc": "2.0", "id": 1, "method": "statistics", "params": {}}, True),
        ({"jsonrpc": "2.0", "id": 1, "method": "statistics", "params": {"all": True}}, False),
    ],
)
def test_what_a_program_says_is_one_of_its_messages(said: dict[str, Any], right: bool) -> None:
    if right:
        schema.check_program(said)
    else:
        with pytest.raises(schema.ValidationError):
            schema.check_program(said)


@pytest.mark.parametrize(
    ("said", "right"),
    [
        ({"jsonrpc": "2.0", "id": 1, "result": [1, {"float": "nan"}]}, True),
        ({"jsonrpc": "2.0", "id": None, "error": {"code": -32700, "message": "not valid JSON"}}, True),
        ({"jsonrpc": "2.0", "id": 1, "error": {"code": -1, "message": "no"}}, False),
        ({"jsonrpc": "2.0", "id": 1, "error": {"code": -32000, "message": "no", "data": {"error": "NoReply"}}}, False),
        ({"jsonrpc": "2.0", "method": "stops", "params": {"protocol": "hcp2", "address": 5, "stops": 1}}, True),
        ({"jsonrpc": "2.0", "method": "ended", "params": {"stream": 1, "dropped": 0, "body": {"why": ""}}}, False),
        ({"jsonrpc": "2.0", "method": "hello", "params": {}}, False),
    ],
)
def test_what_an_owner_says_is_one_of_its_messages(said: dict[str, Any], right: bool) -> None:
    if right:
        schema.check_owner(said)
    else:
        with pytest.raises(schema.ValidationError):
            schema.check_owner(said)


@pytest.mark.parametrize("protocol", protocols(), ids=lambda protocol: protocol.name)
def test_the_page_has_the_commands_of_every_protocol_with_their_arguments(protocol: Protocol) -> None:
    said = []
    for name, kind in protocol.commands.items():
        arguments = [part for part in dataclasses.fields(kind) if part.init]  # type: ignore[arg-type]  # every command is a dataclass
        needless = [part.default is not dataclasses.MISSING for part in arguments]
        shown = [f"[{part.name}]" if left else part.name for part, left in zip(arguments, needless, strict=True)]
        said.append(f"`{' '.join([name, *shown])}`")
    assert f"| {protocol.name} | {', '.join(said)} |" in PAGE

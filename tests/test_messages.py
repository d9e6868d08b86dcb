"""The form and the vocabulary of messages: errors with their hints, and notes and log lines of the program.

A message begins with the event, in lower case, and ends without a full stop. A hint is an instruction or a fact that
helps. Both are joined with a semicolon, as `BusError.__str__` does. The packages in `tests.language.CLEAN` are checked.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from typing import NamedTuple

import pytest

from tests.language import CLEAN, ROOT, RULES, files

PLACE = "X"
"""Stands for an inserted value."""
CLICK = {"UsageError", "ClickException", "BadParameter"}
ENDINGS = {"fail", "lost", "_end"}
"""Methods that end a request with an error: its class, its message and its hint."""
LOGS = {"debug", "info", "warning", "error", "exception", "critical", "log"}
NOTES = {
    "note",
    "complain",
    "tell",
    "_tell",
    "say",
    "_say",
    "report",
    "_report",
    "_report_event",
    "_report_once",
    "show",
    "notify",
}
"""Functions and methods that print a line, or pass it on to be printed."""
NAMES = {"Modbus", "Python"}
"""First words with a capital."""
INSTRUCTIONS = re.compile(
    r"(?:add|ask|call|check|choose|close|create|decide|delete|give|increase|install|leave|look|make|name|open|pass|put|"
    r"read|remove|rename|run|see|select|send|set|start|stop|try|update|upgrade|use|wait|write)\b(?! [a-z]+ed\b)"
)
"""Beginning of a message that states only what to do, and not what happened."""


class Message(NamedTuple):
    """A text in the source. `is_hint`: it is the `hint` of an error."""

    place: str
    text: str
    is_hint: bool = False


def error_names(trees: dict[str, ast.Module]) -> set[str]:
    """Return the names of the error classes of the package: the subclasses of exceptions, directly or not."""
    bases = {
        node.name: {ast.unparse(base).rpartition(".")[2] for base in node.bases}
        for tree in trees.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    }
    found = {"Exception", "ValueError", "ConnectionError", "OSError", "click.ClickException"}
    while more := {name for name, own in bases.items() if own & found} - found:
        found |= more
    return found - {"Exception", "OSError"} | CLICK


def texts(node: ast.expr | None) -> Iterator[str]:
    """Yield the texts that an expression can give, with `PLACE` for inserted values."""
    match node:
        case ast.Constant(value=str(text)):
            yield text
        case ast.JoinedStr(values=values):
            yield "".join(str(one.value) if isinstance(one, ast.Constant) else PLACE for one in values)
        case ast.IfExp(body=body, orelse=orelse):
            yield from texts(body)
            yield from texts(orelse)
        case ast.BinOp(left=left, op=ast.Add()):
            yield from texts(left)  # the rest continues the message


def messages_of(place: str, tree: ast.Module, errors: set[str]) -> Iterator[Message]:
    """Yield the messages of one module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef) and node.name in errors:
            hints = [line.value for line in node.body if isinstance(line, ast.Assign) and "hint" in ast.unparse(line)]
            yield from (Message(f"{place}:{hint.lineno}", text, True) for hint in hints for text in texts(hint))
        if not isinstance(node, ast.Call):
            continue
        where, name = f"{place}:{node.lineno}", ast.unparse(node.func).rpartition(".")[2]
        hints = [keyword.value for keyword in node.keywords if keyword.arg == "hint"]
        if name in ENDINGS and len(node.args) > 1:
            yield from (Message(where, text) for text in texts(node.args[1]))
            hints += node.args[2:3]
        elif name in errors or name in NOTES or (isinstance(node.func, ast.Attribute) and name in LOGS):
            found = ([text for text in texts(one) if len(text.split()) > 2] for one in node.args[:3])
            yield from (Message(where, text) for text in next(filter(None, found), []))
        else:
            continue
        # An empty hint is none: it replaces the default of the class.
        yield from (Message(where, text, True) for hint in hints for text in texts(hint) if text)


@cache
def messages() -> tuple[Message, ...]:
    """Return all messages of the revised packages."""
    trees = {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text()) for path in files(["busmaster"])}
    errors = error_names(trees)
    revised = {path.relative_to(ROOT).as_posix() for path in files(CLEAN.split())}
    return tuple(one for place in sorted(revised & trees.keys()) for one in messages_of(place, trees[place], errors))


def faults(message: Message) -> Iterator[str]:
    """Yield the violations of form and vocabulary."""
    text = re.sub(r"`[^`]+`", "CODE", message.text.strip())
    yield from (f"{rule}: {found[0]}" for rule, pattern in RULES.items() if (found := re.search(pattern, text, re.I)))
    if text.endswith((".", "!")) and not text.endswith("..."):
        yield "ends with a full stop"
    if message.text != message.text.strip() or "  " in text:
        yield "has needless spaces"
    if re.search(r"\b(?:please|sorry|oops)\b", text, re.I):
        yield "has filler words"
    if not text:
        if not message.is_hint:  # an empty hint switches off that of the error class
            yield "is empty"
        return
    first = text.split()[0]
    if re.fullmatch(r"[A-Z][a-z]+", first) and first not in NAMES:
        yield f"begins with a capital: {first}"
    if message.is_hint and len(text.split()) < 2:
        yield "is too short for a hint"
    if not message.is_hint and INSTRUCTIONS.match(text):
        yield f"begins with an instruction: {first}"


def test_messages_have_the_form_and_the_vocabulary() -> None:
    found = [f"{one.place}: {fault}: {one.text!r}" for one in messages() for fault in faults(one)]
    assert found == []


def test_all_kinds_of_messages_are_collected() -> None:
    texts = {one.text for one in messages()}
    assert "check whether that program is running" in texts  # the hint of a request that is lost
    assert any("is not a list of tokens" in text for text in texts)  # InvalidCommand
    assert any("must be finite" in text for text in texts)  # Table.error
    assert any("--allow and --read-only exclude each other" in text for text in texts)  # click
    assert any("the page is at" in text for text in texts)  # note
    assert "a stream ended" in texts  # a log
    assert len(texts) > 500


@pytest.mark.parametrize(
    ("text", "is_hint", "fault"),
    [
        ("nobody can be reached", False, "person: nobody"),
        ("the port is lost.", False, "ends with a full stop"),
        ("retry", True, "is too short for a hint"),
        (" the port is lost", False, "has needless spaces"),
        ("the port is lost, sorry", False, "has filler words"),
        ("The port is lost", False, "begins with a capital: The"),
        ("use another port", False, "begins with an instruction: use"),
    ],
)
def test_each_fault_is_found(text: str, is_hint: bool, fault: str) -> None:
    assert list(faults(Message("module.py:1", text, is_hint))) == [fault]


@pytest.mark.parametrize(
    ("text", "is_hint"),
    [("use another port", True), ("LINE.toml has no nodes", False), ("OPC UA is not installed; `ask` for it", False)],
)
def test_good_messages_have_no_fault(text: str, is_hint: bool) -> None:
    assert list(faults(Message("module.py:1", text, is_hint))) == []


def test_messages_are_found_in_conditions_and_sums() -> None:
    source = (
        "class Bad(ValueError): ...\n"
        "raise Bad('no such port' if one else f'{two} is not a port', hint='')\n"
        "raise Bad(f'{one} is not a number' + why, hint='use a number')\n"
        "asked.lost(Bad, 'no reply arrived', 'check the port')\n"
        "self._log.warning('the port %s was lost', port)\n"
    )
    found = list(messages_of("module.py", ast.parse(source), {"Bad"}))
    assert [(one.text, one.is_hint) for one in found] == [
        ("no such port", False),
        ("X is not a port", False),
        ("X is not a number", False),
        ("use a number", True),
        ("no reply arrived", False),
        ("check the port", True),
        ("the port %s was lost", False),
    ]

"""How each command ends: its status, its one line, and what the group of commands offers."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import logging
import sys
import warnings
from importlib.metadata import EntryPoint
from typing import Any

import click
import pytest

from busmaster.app.cli import app, main
from busmaster.app.cli.app import COMMANDS, cli, show_warning, status_of
from busmaster.app.cli.output import Level
from busmaster.errors import InvalidCommand, LineDown, NoReply
from tests.app.cli.conftest import Command


def no_reply(**known: Any) -> NoReply:
    error = NoReply("no reply within 100 ms")
    for name, value in known.items():
        setattr(error, name, value)
    return error


def test_all_libraries_that_are_missing_are_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *_: None)
    assert main(["--version"]) == 2
    assert capsys.readouterr().err == (
        "busmaster: the command line needs click, rich; install the extra cli: pip install 'busmaster[cli]'\n"
    )


def test_installed_interfaces_are_listed_by_name_and_replace_no_command(monkeypatch: pytest.MonkeyPatch) -> None:
    entries = [EntryPoint(name, "nowhere:command", app.INTERFACES) for name in ("zinc", "read", "alloy")]
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda *, group: entries if group == app.INTERFACES else [])
    assert cli.list_commands(click.Context(cli, **cli.context_settings)) == [*COMMANDS, "alloy", "zinc"]


def test_a_mistyped_interface_has_its_suggestion(busmaster: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    entry = EntryPoint("profinet", "nowhere:command", app.INTERFACES)
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda *, group: [entry] if group == app.INTERFACES else [])
    ran = busmaster("profinte")
    assert (ran.status, ran.out) == (2, "")
    assert ran.err == "busmaster: no such command 'profinte'; did you mean 'profinet'?\n"


@pytest.mark.parametrize(
    ("place", "why"),
    [
        ("nowhere:command", "No module named 'nowhere'"),
        ("json:dumps", "expected a click command, not a function"),
    ],
)
def test_an_interface_that_cannot_be_used_is_named_with_its_error_in_the_help_too(
    busmaster: Command, monkeypatch: pytest.MonkeyPatch, place: str, why: str
) -> None:
    entry = EntryPoint("profinet", place, app.INTERFACES)
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda *, group: [entry] if group == app.INTERFACES else [])
    text = f"the interface 'profinet' cannot be used: {why}; fix or uninstall that package"
    ran = busmaster("profinet")
    assert (ran.status, ran.out) == (2, "")
    assert ran.err.startswith(f"busmaster: {text}")
    listed = busmaster("--help")
    assert listed.status == 0
    assert text in " ".join(listed.out.split())


def test_completion_has_the_line_of_each_command() -> None:
    offered = {item.value: item.help for item in cli.shell_complete(click.Context(cli, **cli.context_settings), "re")}
    assert offered == {name: COMMANDS[name] for name in ("read", "replay")}


@pytest.mark.parametrize("arguments", [("-h",), ("read", "-h")])
def test_h_is_help(busmaster: Command, arguments: tuple[str, ...]) -> None:
    ran = busmaster(*arguments)
    assert (ran.status, ran.err) == (0, "")
    assert ran.out.startswith("Usage: busmaster")


def test_without_a_command_the_help_goes_to_standard_error(busmaster: Command) -> None:
    ran = busmaster()
    assert (ran.status, ran.out) == (2, "")
    assert "Commands:" in ran.err


def test_wrong_usage_refers_to_the_help_of_its_command(busmaster: Command) -> None:
    assert busmaster("scan", "PORT").err.endswith("; see busmaster scan --help\n")
    assert busmaster("items").err.endswith("; see busmaster items --help\n")


def test_a_mistyped_option_has_its_suggestion_and_no_reference_to_the_help(busmaster: Command) -> None:
    assert busmaster("read", "PORT", "--protocl", "hcp2").err.endswith("did you mean '--protocol'?\n")


def test_version_of_a_tree_that_is_not_installed(busmaster: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(_: str) -> str:
        raise importlib.metadata.PackageNotFoundError

    monkeypatch.setattr(importlib.metadata, "version", missing)
    ran = busmaster("--version")
    assert (ran.status, ran.out, ran.err) == (0, "busmaster (not installed)\n", "")


@pytest.mark.parametrize(
    ("error", "status", "text"),
    [
        (KeyboardInterrupt(), 130, ""),
        (SystemExit(143), 143, ""),
        (SystemExit("it has ended"), 1, ""),
        (InvalidCommand("no such\nitem"), 2, "no such item"),
        (click.UsageError("give  one"), 2, "give one"),
        (LineDown("port lost", hint="plug it in"), 1, "port lost; plug it in"),
        (no_reply(label="node 5", attempts=1, hint=""), 1, "node 5: no reply within 100 ms, 1 attempt"),
        (
            no_reply(label="node 5", attempts=3, hint="check it"),
            1,
            "node 5: no reply within 100 ms, 3 attempts; check it",
        ),
        (no_reply(label="", attempts=0, hint=""), 1, "no reply within 100 ms"),
        (FileNotFoundError(2, "No such file or directory", "a.csv"), 1, "a.csv: No such file or directory"),
        (OSError(5, "Input/output error"), 1, "Input/output error"),
        (OSError("the far end is gone"), 1, "the far end is gone"),
        (
            RuntimeError("never"),
            1,
            "internal error: RuntimeError: never; set BUSMASTER_DEBUG=1 to see where",
        ),
        (ExceptionGroup("a", [ExceptionGroup("b", [InvalidCommand("inner")])]), 2, "inner"),
        (BaseExceptionGroup("a", [LineDown("lost"), BaseExceptionGroup("b", [KeyboardInterrupt()])]), 130, ""),
    ],
)
def test_each_error_has_its_status_and_one_line(
    capfd: pytest.CaptureFixture[str], error: BaseException, status: int, text: str
) -> None:
    assert status_of(error) == status
    assert capfd.readouterr() == ("", f"busmaster: {text}\n" if text else "")


def test_a_line_for_an_error_has_the_level_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    notes: list[tuple[str, Level]] = []
    monkeypatch.setattr(app, "note", lambda text, level=Level.INFO: notes.append((text, level)))
    status_of(LineDown("lost", hint="plug it in"))
    assert notes == [("lost; plug it in", Level.ERROR)]


def test_an_internal_error_is_raised_where_debugging_is_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BUSMASTER_DEBUG", "1")
    with pytest.raises(RuntimeError, match="never"):
        status_of(RuntimeError("never"))
    assert status_of(LineDown("lost")) == 1


def test_logs_and_warnings_are_shown_only_where_debugging_is_on(
    busmaster: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    configured: list[dict[str, object]] = []
    monkeypatch.setattr(logging, "basicConfig", lambda **options: configured.append(options))
    assert busmaster("--version").status == 0
    assert configured == []
    assert warnings.showwarning is show_warning
    monkeypatch.setattr(warnings, "showwarning", print)
    monkeypatch.setenv("BUSMASTER_DEBUG", "1")
    assert busmaster("--version").status == 0
    assert configured == [{"level": logging.DEBUG}]
    assert warnings.showwarning is print


def test_logs_of_libraries_are_not_printed(busmaster: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logging.getLogger(), "handlers", [])  # those of pytest, which hide what is printed without one
    monkeypatch.delenv("BUSMASTER_DEBUG", raising=False)
    assert busmaster("--version").status == 0
    logging.getLogger("asyncio").warning("slow callback")
    assert busmaster("--version").err == ""


def test_a_reader_that_has_closed_the_pipe_is_no_error(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    forgotten: list[bool] = []
    monkeypatch.setattr(app, "forget_standard_output", lambda: forgotten.append(True))
    assert status_of(BrokenPipeError(32, "Broken pipe")) == 0
    assert forgotten == [True]
    assert capfd.readouterr() == ("", "")


def test_a_disk_that_is_full_under_the_version_is_one_line(busmaster: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    with open("/dev/full", "w", encoding="utf-8") as full:
        monkeypatch.setattr(sys, "stdout", full)
        ran = busmaster("--version")
    assert (ran.status, ran.err) == (1, "busmaster: No space left on device\n")


def test_only_warnings_for_the_user_are_printed(capfd: pytest.CaptureFixture[str]) -> None:
    show_warning(DeprecationWarning("old"), DeprecationWarning, "a.py", 1)
    show_warning("port is slow", UserWarning, "a.py", 1)
    assert capfd.readouterr() == ("", "busmaster: warning: port is slow\n")

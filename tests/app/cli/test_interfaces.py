"""The common part of the commands that open an interface: their line, its token, and the reports of it."""

from __future__ import annotations

from typing import Any

import click
import pytest
from click.testing import CliRunner

from busmaster.app.cli import interfaces
from busmaster.app.cli.interfaces import following, interface_options, place_of
from busmaster.app.cli.output import Level
from busmaster.app.interfaces.following import Connected, Following, Lost
from busmaster.errors import InvalidCommand, LineDown


@pytest.fixture
def notes(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Level]]:
    """The lines on standard error."""
    found: list[tuple[str, Level]] = []
    monkeypatch.setattr(interfaces, "note", lambda text, level=Level.INFO: found.append((text, level)))
    return found


@pytest.fixture
def running(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The addresses of the lines that run, the only one of which is meant by None."""
    found: list[str] = []

    def address_of(line: str | None) -> str:
        if line is not None:
            return line
        if not found:
            raise LineDown("no running line of this user", hint="start one")
        if len(found) > 1:
            raise click.UsageError("several lines are running")
        return found[0]

    monkeypatch.setattr(interfaces, "address_of", address_of)
    return found


def test_options_are_line_address_and_read_only() -> None:
    seen: list[dict[str, Any]] = []

    @click.command()
    @interface_options("127.0.0.1:4840")
    def command(**given: Any) -> None:
        seen.append(given)

    for arguments in ((), ("slitter", "--bind", "0.0.0.0:1", "--read-only")):
        assert CliRunner().invoke(command, arguments).exit_code == 0
    assert seen == [
        {"line": None, "bind": "127.0.0.1:4840", "read_only": False},
        {"line": "slitter", "bind": "0.0.0.0:1", "read_only": True},
    ]


def test_place_of_an_address() -> None:
    assert place_of("[::1]:4840") == ("::1", 4840)
    with pytest.raises(click.UsageError, match=r"^--bind: "):
        place_of("here")


def test_a_line_that_does_not_run_yet_is_waited_for_with_a_warning(
    notes: list[tuple[str, Level]], running: list[str]
) -> None:
    assert isinstance(following(None, read_only=False), Following)
    [(text, level)] = notes
    assert text.endswith("; the interface starts, and waits for the line")
    assert text.startswith("no running line of this user")
    assert level is Level.WARNING
    running.extend(("unix:/a", "unix:/b"))
    with pytest.raises(click.UsageError, match="several lines"):
        following(None, read_only=False)


@pytest.mark.usefixtures("running")
def test_token_and_read_only_reach_the_follower(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[dict[str, Any]] = []

    class Noted(Following):
        def __init__(self, address: Any, **options: Any) -> None:
            given.append({"address": address(), **options})
            super().__init__(address, **options)

    monkeypatch.setattr(interfaces, "Following", Noted)
    monkeypatch.setenv("BUSMASTER_TOKEN", "a-token")
    following("tcp://127.0.0.1:7420", read_only=True)
    following("unix:/a", read_only=False)
    assert given == [
        {"address": "tcp://127.0.0.1:7420", "token": "a-token", "read_only": True},
        {"address": "unix:/a", "token": None, "read_only": False},
    ]


def connected(read_only: bool) -> Connected:
    return Connected({"line": "slitter", "read_only": read_only})


@pytest.mark.usefixtures("running")
def test_it_is_reported_when_the_line_comes_and_goes(notes: list[tuple[str, Level]]) -> None:
    for role, option, text in ((False, False, ""), (True, False, " (read-only)"), (False, True, " (read-only)")):
        followed = following("unix:/a", read_only=option)
        followed._change(connected(role))
        assert notes == [(f"connected to line slitter{text}", Level.INFO)]
        notes.clear()
        followed._change(Lost("its program has ended"))
        assert notes == [("its program has ended", Level.WARNING)]
        notes.clear()


def test_a_line_that_is_not_named_stays_the_same_once_there_is_one(running: list[str]) -> None:
    meant = interfaces._Meant(None)
    with pytest.raises(LineDown):
        meant()
    running.extend(("unix:/a", "unix:/b"))
    with pytest.raises(InvalidCommand, match="several lines"):
        meant()
    running.remove("unix:/b")
    assert meant() == "unix:/a"
    running[:] = ["unix:/b"]
    assert meant() == "unix:/a"


def test_a_line_that_is_named_is_looked_for_again_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    addresses = iter(("unix:/a", "unix:/b"))
    monkeypatch.setattr(interfaces, "address_of", lambda line: f"{line} at {next(addresses)}")
    meant = interfaces._Meant("slitter")
    assert [meant(), meant()] == ["slitter at unix:/a", "slitter at unix:/b"]

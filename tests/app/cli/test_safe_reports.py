"""`busmaster safe` and the service of a line: their reports, and the keys of the file that have an effect."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import click
import pytest

from busmaster.app.cli import run, safe
from busmaster.app.cli.output import Level
from busmaster.app.config import load
from busmaster.app.line import ConfiguredLine
from busmaster.errors import BusError, InvalidCommand, NoReply
from busmaster.events import LineChange, LineChanged, PortFailed


@pytest.fixture
def reported(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Level]]:
    """The lines on standard error, each with its level."""
    found: list[tuple[str, Level]] = []

    def note(text: str, level: Level = Level.INFO) -> None:
        found.append((text, level))

    monkeypatch.setattr(safe, "note", note)
    monkeypatch.setattr(run, "note", note)
    return found


LOST = NoReply("no reply")


@pytest.mark.parametrize(
    ("outcomes", "out", "unsafe", "status"),
    [
        ({"a/1": None, "b/1": None}, "a/1 ok\nb/1 ok\n", [], 0),
        ({"a/1": LOST, "b/1": None, "c/1": LOST}, "b/1 ok\n", ["a/1", "c/1"], 1),
        ({"a/1": LOST}, "", ["a/1"], 1),
    ],
)
def test_each_point_is_confirmed_or_named_and_one_that_is_not_makes_the_status_1(
    capsys: pytest.CaptureFixture[str],
    reported: list[tuple[str, Level]],
    outcomes: dict[str, BusError | None],
    out: str,
    unsafe: list[str],
    status: int,
) -> None:
    assert safe.print_outcomes(outcomes) == status
    assert capsys.readouterr().out == out
    assert reported == [(f"safe state of {name} not confirmed: {LOST}", Level.CRITICAL) for name in unsafe]


def test_each_failure_of_the_port_is_reported_and_no_other_event(reported: list[tuple[str, Level]]) -> None:
    async def events() -> AsyncIterator[Any]:
        yield PortFailed("it is not there")
        yield LineChanged(LineChange.DOWN, "it hung up")
        yield PortFailed("it is in use")

    stream: Any = events()
    anyio.run(safe.print_port_events, stream)
    assert [text.partition("; ")[0] for text, _ in reported] == [
        "cannot connect: it is not there",
        "cannot connect: it is in use",
    ]
    assert {level for _, level in reported} == {Level.ERROR}


def test_the_recording_is_that_of_the_port_and_what_fails_of_it_is_a_warning(
    monkeypatch: pytest.MonkeyPatch, reported: list[tuple[str, Level]]
) -> None:
    endpoint: Any = SimpleNamespace(name="/dev/ttyUSB0", echo=True)
    requested: dict[str, Any] = {}

    @contextmanager
    def capturing(capture: str | None, **options: Any) -> Iterator[str]:
        requested.update(capture=capture, **options)
        if capture == "bad":
            raise click.UsageError("no such folder")
        yield "the recorder"

    monkeypatch.setattr(safe, "capturing", capturing)
    recorder: Any
    with safe.recorded("x.pcapng", endpoint) as recorder:
        assert recorder == "the recorder"
    assert requested == {"capture": "x.pcapng", "port": "/dev/ttyUSB0", "echo": True}
    assert reported == []
    with safe.recorded("bad", endpoint) as recorder:
        assert recorder is None
    assert reported == [("no such folder", Level.WARNING)]


# the service of a line


def test_each_key_of_the_section_reaches_the_service(
    file: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    tokens = tmp_path / "tokens"
    tokens.write_text("hmi a-token-of-the-hmi-0001\n")
    tokens.chmod(0o600)
    section = (
        '[service]\nmode = "0660"\ngroup = "root"\nshare = 0.5\nlisten = "127.0.0.1:7420"\n'
        f'token_file = "{tokens}"\n[service.tokens.hmi]\nrole = "read"\n'
    )
    text = file.read_text()
    path = file.with_name("the slitter.toml")
    path.write_text(text + section)
    made: dict[str, Any] = {}
    monkeypatch.setattr(run, "Service", lambda bus, **options: made.update(bus=bus, **options))
    line = ConfiguredLine(load(path), outputs=False)
    run.service_of(line)
    assert made == {
        "bus": line.bus,
        "authorisation": line.authorisation,
        "name": "the-slitter",
        "mode": line.file.service.mode,
        "group": line.file.service.group,
        "share": 0.5,
        "listen": line.file.service.listen,
        "title": "Slitter",
    }
    assert made["mode"] == 0o660
    assert made["listen"] is not None
    assert made["group"] is not None
    assert set(run.secrets_of(line.file)) == {"hmi"}
    path.write_text(text + section.replace("[service]\n", "[service]\nenabled = false\n"))
    made.clear()
    disabled = ConfiguredLine(load(path), outputs=False)
    assert run.service_of(disabled) is None
    assert made == {}
    tokens.unlink()
    assert run.secrets_of(disabled.file) == {}  # no program can use them


class FakeService:
    """A service that keeps whether it runs."""

    def __init__(self, tcp: str | None = None, error: Exception | None = None) -> None:
        self.line = SimpleNamespace(title="Slitter")
        self.address, self.tcp_address = "unix:/run/slitter.sock", tcp
        self.calls: list[str] = []
        self._error = error

    async def __aenter__(self) -> FakeService:
        self.calls.append("begin")
        if self._error is not None:
            raise self._error
        return self

    async def __aexit__(self, *_: object) -> None:
        self.calls.append("end")


def served(service: Any, *, announce: bool, error: Exception | None = None) -> Any:
    async def ran() -> Any:
        async with run.served(service, announce=announce) as found:
            if error is not None:
                raise error
            return found

    return anyio.run(ran)


def test_where_a_line_is_served_is_announced_and_it_ends_with_the_run(reported: list[tuple[str, Level]]) -> None:
    service = FakeService()
    assert served(service, announce=False) is service
    assert (service.calls, reported) == (["begin", "end"], [])
    served(service, announce=True)
    both = FakeService("tcp://127.0.0.1:7420")
    served(both, announce=True)
    assert reported == [
        ("Slitter is served at unix:/run/slitter.sock", Level.NOTICE),
        ("Slitter is served at unix:/run/slitter.sock and tcp://127.0.0.1:7420", Level.NOTICE),
    ]
    failing = FakeService()
    with pytest.raises(ZeroDivisionError):
        served(failing, announce=True, error=ZeroDivisionError())
    assert failing.calls == ["begin", "end"]


def test_a_line_that_cannot_be_served_runs_in_any_case(reported: list[tuple[str, Level]]) -> None:
    assert served(None, announce=True) is None
    assert reported == []
    service = FakeService(error=InvalidCommand("it is served already"))
    assert served(service, announce=True) is None
    assert service.calls == ["begin"]
    assert reported == [("no other program can use this line: it is served already", Level.WARNING)]

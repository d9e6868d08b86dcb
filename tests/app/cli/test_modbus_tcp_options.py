"""`busmaster modbus-tcp`: each option reaches the server, its rules or its map. Nothing is served."""

from __future__ import annotations

import ipaddress
from typing import Any

import pytest

from busmaster.app.cli import modbus_tcp
from busmaster.app.cli.output import Level
from busmaster.app.interfaces.following import Following
from busmaster.app.interfaces.modbus_tcp import IDLE, Rules, Values
from tests.app.cli.conftest import Command

LINE = ("modbus-tcp", "unix:/nobody")


class Served:
    """The lines that were served, with their address."""

    rules: Rules
    listen: tuple[str, int]
    idle: float
    line: Following
    values: dict[str, Any]


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> type[Served]:
    """What the last command served."""

    class Last(Served):
        """Of this test."""

    class Noted(Values):
        def __init__(self, line: Following, fixed: Any, **options: Any) -> None:
            warn = options["warn"]
            Last.line, Last.values = line, {"fixed": fixed, **options}
            del Last.values["warn"]
            super().__init__(line, fixed, **options)
            warn("a point is left out")

    async def serve(
        values: Values, rules: Rules, listen: tuple[str, int], opened: Any, report: Any, idle: float = IDLE
    ) -> None:
        Last.rules, Last.listen, Last.idle = rules, listen, idle
        opened("127.0.0.1:40123")

    monkeypatch.setattr(modbus_tcp, "Values", Noted)
    monkeypatch.setattr(modbus_tcp, "serve", serve)
    return Last


def test_by_default_all_points_are_served_to_this_machine_and_none_is_written(
    busmaster: Command, served: type[Served], monkeypatch: pytest.MonkeyPatch
) -> None:
    notes: list[tuple[str, Level]] = []
    monkeypatch.setattr(modbus_tcp, "note", lambda text, level=Level.INFO: notes.append((text, level)))
    assert busmaster(*LINE).status == 0
    assert notes == [
        ("a point is left out", Level.WARNING),
        ("serving Modbus TCP at 127.0.0.1:40123", Level.INFO),
    ]
    assert (served.listen, served.idle, served.line.read_only) == (("127.0.0.1", 1502), IDLE, False)
    assert served.rules == Rules()
    assert served.values == {"fixed": None, "type_": "float64", "last": False}


def test_each_option_of_the_rules_reaches_them_with_all_its_values(busmaster: Command, served: type[Served]) -> None:
    options = (
        *("--allow", "winder/*", "--allow", "oven/set", "--pass-through", "--allow-unit", "3", "--allow-unit", "247"),
        *("--allow-from", "10.0.0.0/24", "--allow-from", "::1", "--idle", "5", "--bind", "0.0.0.0:502"),
    )
    assert busmaster(*LINE, *options).status == 0
    assert (served.listen, served.idle) == (("0.0.0.0", 502), 5.0)
    assert served.rules == Rules(
        allow=("winder/*", "oven/set"),
        units=frozenset({3, 247}),
        peers=(ipaddress.ip_network("10.0.0.0/24"), ipaddress.ip_network("::1/128")),
        pass_through=True,
    )


@pytest.mark.parametrize("options", [("--pass-through",), ("--pass-through", "--read-only")])
def test_units_are_read_without_being_written(
    busmaster: Command, served: type[Served], options: tuple[str, ...]
) -> None:
    assert busmaster(*LINE, *options).status == 0
    assert served.rules == Rules(pass_through=True)
    assert served.line.read_only is ("--read-only" in options)


def test_units_are_written_from_the_named_addresses_alone_without_any_point(
    busmaster: Command, served: type[Served]
) -> None:
    options = ("--pass-through", "--allow-unit", "3", "--allow-from", "10.0.0.1", "--bind", "0.0.0.0:502")
    assert busmaster(*LINE, *options).status == 0
    peers = (ipaddress.ip_network("10.0.0.1/32"),)
    assert served.rules == Rules(units=frozenset({3}), peers=peers, pass_through=True)


def test_type_and_last_are_those_of_the_automatic_map(busmaster: Command, served: type[Served]) -> None:
    assert busmaster(*LINE, "--type", "int16", "--last").status == 0
    assert served.values == {"fixed": None, "type_": "int16", "last": True}


def test_a_map_file_is_read(busmaster: Command, served: type[Served], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modbus_tcp, "read_map", lambda path: f"the map of {path}")
    assert busmaster(*LINE, "--map", "map.toml").status == 0
    assert served.values["fixed"] == "the map of map.toml"


def test_the_printed_map_has_what_may_be_written(
    busmaster: Command, served: type[Served], monkeypatch: pytest.MonkeyPatch
) -> None:
    async def text(values: Values, allow: tuple[str, ...]) -> str:
        return f"{','.join(allow)}\n"

    monkeypatch.setattr(modbus_tcp, "map_text", text)
    ran = busmaster(*LINE, "--print-map", "--allow", "a/*", "--allow", "b/*")
    assert (ran.status, ran.out) == (0, "a/*,b/*\n")
    assert not hasattr(served, "rules"), "nothing is served"


@pytest.mark.usefixtures("served")
@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("--read-only", "--allow-unit", "3", "--pass-through"), "exclude each other"),
        (("--map", "absent.toml", "--type", "int16"), "--type and --last are for the automatic map"),
        (("--pass-through", "--allow-unit", "0"), "--allow-unit"),
        (("--pass-through", "--allow-unit", "248"), "--allow-unit"),
        (("--idle", "0.5"), "--idle"),
        (("--idle", "86401"), "--idle"),
        (("--type", "float16"), "--type"),
        (("--allow", "*", "--allow-from", "::1", "--allow-from", "here"), "--allow-from: 'here'"),
        (("--allow-unit", "3", "--allow-from", "::1"), "needs --pass-through"),
        (("--bind", "0.0.0.0:0", "--allow", "*"), "needs --allow-from"),
        (("--bind", "[::]:0", "--pass-through", "--allow-unit", "3"), "needs --allow-from"),
        (("--bind", "192.0.2.1:502", "--pass-through", "--allow", "*", "--allow-unit", "3"), "needs --allow-from"),
        (("--allow-from", "::1"), "needs points that may be written"),
        (("--bind", "0.0.0.0:0", "--pass-through", "--allow-from", "::1"), "needs points that may be written"),
    ],
)
def test_what_would_open_more_than_is_meant_is_wrong_usage(
    busmaster: Command, options: tuple[str, ...], complaint: str
) -> None:
    ran = busmaster(*LINE, *options)
    assert (ran.status, ran.out) == (2, "")
    assert complaint in ran.err


@pytest.mark.usefixtures("served")
def test_units_that_may_be_written_are_reason_enough_for_a_list_of_clients(busmaster: Command) -> None:
    assert busmaster(*LINE, "--pass-through", "--allow-unit", "3", "--allow-from", "::1").status == 0


@pytest.mark.parametrize("missing", ["msgspec", "websockets"])
def test_a_missing_library_is_named_with_its_extra(
    busmaster: Command, monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    monkeypatch.setattr(modbus_tcp, "find_spec", lambda name: None if name == missing else object())
    ran = busmaster(*LINE)
    assert ran.status == 2
    assert "pip install 'busmaster[modbus-tcp]'" in ran.err

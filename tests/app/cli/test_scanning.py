"""`busmaster scan`: its report of each reply, and the silent nodes that it tries in other protocols."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import anyio
import pytest

from busmaster import Priority
from busmaster.app.cli import scan
from busmaster.emulator.serve import TcpServer
from busmaster.errors import GarbledReply, NodeDown, NoReply, Refused
from tests.app.cli.conftest import Command


class Node:
    """A node that replies so to one request after another."""

    def __init__(self, *replies: Any) -> None:
        self.replies = list(replies)
        self.requested: list[dict[str, Any]] = []
        self.profile = SimpleNamespace(probe="read element 1")

    async def request(self, command: Any, **options: Any) -> Any:
        self.requested.append({"command": command, **options})
        reply = self.replies.pop(0)
        if isinstance(reply, Exception):
            raise reply
        return reply


def error(kind: type[Any]) -> Any:
    return kind("it was so", hint="do this")


@pytest.mark.parametrize(
    ("replies", "found"),
    [
        ((5,), (5, "read element 1: 5")),
        ((error(NoReply),), None),
        ((error(NodeDown),), None),
        ((error(Refused),), (None, "replies; refuses to read element 1")),
        ((error(GarbledReply), 7), (7, "read element 1: 7")),
        ((error(GarbledReply), error(NoReply)), None),
        ((error(GarbledReply), error(Refused)), (None, "replies; refuses to read element 1")),
        ((error(GarbledReply), error(GarbledReply)), (None, "read element 1: it was so; do this")),
    ],
)
def test_each_kind_of_reply_is_reported(replies: tuple[Any, ...], found: tuple[Any, str] | None) -> None:
    node: Any = Node(*replies)
    assert anyio.run(scan.ask, node) == found
    assert node.replies == []
    # one attempt, behind the requests of other programs: a missing node takes its whole reply window
    assert all(
        one == {"command": "read element 1", "retries": 0, "priority": Priority.BACKGROUND} for one in node.requested
    )


class Protocol:
    """A protocol for some addresses, which may share a line or not."""

    def __init__(self, name: str, addresses: range, *, shares: bool) -> None:
        self.profile = SimpleNamespace(
            name=name,
            title=name.upper(),
            addresses=addresses,
            may_share_with=lambda other: shares,
            label=lambda address: f"node {address}",
        )
        self.kinds = (SimpleNamespace(name=f"{name}-drive"), SimpleNamespace(name="another"))


def others(
    monkeypatch: pytest.MonkeyPatch, silent: list[int], replying: int
) -> tuple[list[tuple[str, int]], list[str]]:
    """The nodes that are tried in each protocol, and the reports."""
    own = Protocol("own", range(256), shares=True)
    offered = [own, Protocol("far", range(256), shares=False), Protocol("near", range(100), shares=True)]
    tried: list[tuple[str, int]] = []

    async def ask(node: tuple[str, int]) -> Any:
        tried.append(node)
        return (0, "it replies") if node[1] == replying else None

    monkeypatch.setattr(scan, "protocols", lambda: offered)
    monkeypatch.setattr(scan, "ask", ask)
    bus: Any = SimpleNamespace(node=lambda profile, address: (profile.name, address))

    async def run() -> list[str]:
        return [line async for line in scan.in_other_protocols(bus, own.profile, silent)]  # type: ignore[arg-type]

    return tried, anyio.run(run)


def test_silent_nodes_are_tried_in_the_protocols_that_may_share_the_line(monkeypatch: pytest.MonkeyPatch) -> None:
    tried, lines = others(monkeypatch, [1, 2, 200], replying=2)
    assert tried == [("near", 1), ("near", 2)]
    assert lines == ["node 2 replies in NEAR; use --protocol near-drive"]


def test_only_some_silent_nodes_are_tried_and_only_those_that_the_protocol_can_have(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    silent = [*range(200, 220), *range(30)]
    tried, _ = others(monkeypatch, silent, replying=-1)
    assert tried == [("near", address) for address in range(scan.STRANGERS)]


@pytest.mark.slow
def test_what_replies_in_another_protocol_is_reported(
    busmaster: Command, controllers: TcpServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def in_other_protocols(bus: Any, profile: Any, silent: list[int]) -> AsyncIterator[str]:
        for address in silent:
            yield f"node {address} replies in HCP1; use --protocol hcp"

    monkeypatch.setattr(scan, "in_other_protocols", in_other_protocols)
    ran = busmaster("scan", controllers.path, "--protocol", "hcp2", "--nodes", "8-10", "--timeout", "50")
    assert [line.split()[0] for line in ran.lines] == ["8"]
    for address in (9, 10):
        assert f"busmaster: node {address} replies in HCP1; use --protocol hcp\n" in ran.err


def test_the_reply_window_of_the_option_is_that_of_each_node(
    busmaster: Command, controllers: TcpServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    windows: list[float] = []

    async def ask(node: Any) -> tuple[object, str]:
        windows.append(node.timings.read.window)
        return 0, "it replies"

    monkeypatch.setattr(scan, "ask", ask)
    busmaster("scan", controllers.path, "--protocol", "hcp2", "--nodes", "7-8", "--timeout", "50")
    assert windows == [0.05, 0.05]


def test_the_bar_counts_each_node_and_is_hidden_while_a_reply_is_printed(
    busmaster: Command, controllers: TcpServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    happened: list[str | int] = []

    @contextmanager
    def hidden(_: object) -> Iterator[None]:
        happened.append("hidden")
        yield
        happened.append("shown")

    async def ask(node: Any) -> tuple[object, str] | None:
        return None if node.address == 2 else (0, "it replies")

    monkeypatch.setattr("busmaster.app.cli.progress.Bar.advance", lambda _, count=1: happened.append(count))
    monkeypatch.setattr("busmaster.app.cli.progress.Bar.hidden", hidden)
    monkeypatch.setattr(scan, "emit", happened.append)
    monkeypatch.setattr(scan, "ask", ask)
    busmaster("scan", controllers.path, "--protocol", "hcp2", "--nodes", "1-3", "--timeout", "50")
    assert happened == ["hidden", "1 it replies", "shown", 1, 1, "hidden", "3 it replies", "shown", 1]


@pytest.mark.parametrize("replying", [(1, 3), (1, 2, 3, 4)])
def test_late_replies_are_waited_for_before_all_silent_nodes_are_tried_in_other_protocols(
    busmaster: Command, controllers: TcpServer, monkeypatch: pytest.MonkeyPatch, replying: tuple[int, ...]
) -> None:
    happened: list[Any] = []

    async def ask(node: Any) -> tuple[object, str] | None:
        return (0, "it replies") if node.address in replying else None

    async def sleep(seconds: float) -> None:
        happened.append(round(seconds, 3))

    async def in_other_protocols(bus: Any, profile: Any, silent: list[int]) -> AsyncIterator[str]:
        happened.append(silent)
        yield "that is all"

    monkeypatch.setattr(scan, "ask", ask)
    monkeypatch.setattr(scan, "anyio", SimpleNamespace(sleep=sleep))
    monkeypatch.setattr(scan, "in_other_protocols", in_other_protocols)
    busmaster("scan", controllers.path, "--protocol", "hcp2", "--nodes", "1-4", "--timeout", "200")
    assert happened == ([[]] if len(replying) == 4 else [round(0.2 + scan.SILENCE, 3), [2, 4]])

"""What errors carry as values, and that they can be sent to another process."""

from __future__ import annotations

import asyncio
import copy
import pickle
from collections.abc import Callable
from typing import Any

import pytest

from busmaster import (
    Bus,
    BusClosed,
    BusError,
    Hcp2Controller,
    HoldEnded,
    LineDown,
    NoReply,
    NotStarted,
    Refused,
    SerialPort,
    WriteUnconfirmed,
)
from busmaster import errors as public
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.transaction import Transaction, make_error
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.transport.kernel import cause_text
from tests.stories import on_a_bus

KINDS = [
    thing
    for thing in vars(public).values()
    if isinstance(thing, type) and issubclass(thing, BusError) and thing.__module__ == public.__name__
]
COPIES: list[Callable[[BusError], BusError]] = [lambda error: pickle.loads(pickle.dumps(error)), copy.copy]


def made(kind: type[BusError]) -> BusError:
    node = NodeRecord(hcp2.PROFILE, 5, hcp2.PROFILE.timings, 2, "/dev/ttyUSB0")
    transaction = Transaction(node, hcp2.Read(1))
    transaction.attempts = 3
    return make_error(kind, "it went wrong", transaction)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("copied", COPIES, ids=["pickle", "copy"])
def test_an_error_that_was_sent_is_the_same_error(kind: type[BusError], copied: Callable[[BusError], BusError]) -> None:
    error = made(kind)
    error.hint = "try this"
    found = copied(error)
    assert type(found) is kind
    assert str(found) == str(error) == "node 5: it went wrong, 3 attempts (read element 1); try this"
    assert vars(found) == vars(error)
    assert (found.line, found.label, found.address, found.attempts) == ("/dev/ttyUSB0", "node 5", 5, 3)


def test_what_a_refusal_says_of_confirming_is_sent_with_it() -> None:
    assert not pickle.loads(pickle.dumps(Refused("no", confirm=False))).confirm


def test_a_cause_of_the_lines_is_sent_and_of_any_other_its_text() -> None:
    error, cause = made(BusError), made(NoReply)
    error.__cause__ = cause
    found = pickle.loads(pickle.dumps(error))
    assert (type(found.__cause__), str(found.__cause__)) == (NoReply, str(cause))
    error.__cause__ = ValueError(lambda: "cannot be pickled")
    found = pickle.loads(pickle.dumps(error))
    assert str(found.__cause__).startswith("ValueError: <function")


def test_errors_of_a_running_bus_say_which_line_and_which_node() -> None:
    async def story(bus: Bus) -> None:
        away = Hcp2Controller(bus, 9)
        group = bus.poll_group("g", period=0.5, points=[away.element(1)])
        with pytest.raises(NoReply) as caught:
            await away.read(1)
        assert (caught.value.line, caught.value.label, caught.value.address) == (bus.endpoint.name, "node 9", 9)
        async for snapshot in group:
            error = snapshot[away.element(1)].error
            assert error is not None
            assert (error.line, error.address) == (bus.endpoint.name, 9)
            break
        await bus.__aexit__(None, None, None)
        with pytest.raises(BusClosed) as closed:
            await away.read(1)
        assert (closed.value.line, closed.value.address) == (bus.endpoint.name, 9)

    on_a_bus(story, EmulatedMint(1))


def test_a_port_that_cannot_be_opened_is_named() -> None:
    async def opening() -> None:
        async with Bus(SerialPort("/dev/no-such-port", baudrate=57600)):
            pass

    with pytest.raises(LineDown) as caught:
        asyncio.run(opening())
    assert (caught.value.line, caught.value.label, caught.value.address) == ("/dev/no-such-port", None, None)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({}, "it went wrong; read the value back before you write again"),
        ({"hint": ""}, "it went wrong"),
        ({"attempts": 1, "hint": "wait"}, "it went wrong, 1 attempt; wait"),
        ({"attempts": 2, "command": "read 1", "hint": ""}, "it went wrong, 2 attempts (read 1)"),
        ({"command": "read 1", "hint": ""}, "it went wrong (read 1)"),
    ],
)
def test_the_text_of_an_error_has_what_is_known(options: dict[str, Any], text: str) -> None:
    error = WriteUnconfirmed("it went wrong", **options)
    assert str(error) == text
    assert (error.line, error.label, error.address) == (None, None, None)
    assert WriteUnconfirmed.hint == "read the value back before you write again", "a hint of one error is its own"


def test_a_node_without_a_line_gives_an_error_without_a_line() -> None:
    error = Refused(node=NodeRecord(hcp2.PROFILE, 5, hcp2.PROFILE.timings, 2, ""))
    assert (error.what, error.line, error.label, error.address) == ("refused", None, "node 5", 5)
    assert (error.confirm, error.temporary) == (True, False)


def test_what_a_refusal_says_of_its_time_is_sent_with_it() -> None:
    found = pickle.loads(pickle.dumps(Refused("busy", temporary=True, hint="wait")))
    assert (found.temporary, found.confirm, found.hint) == (True, True, "wait")


@pytest.mark.parametrize(
    ("kind", "standard"),
    [(NoReply, TimeoutError), (NotStarted, TimeoutError), (HoldEnded, NotStarted), (LineDown, ConnectionError)],
)
def test_an_error_is_also_one_of_the_standard_library(kind: type[BusError], standard: type[Exception]) -> None:
    assert issubclass(kind, standard)


@pytest.mark.parametrize(
    ("cause", "text"),
    [
        (None, "closed by the other end"),
        (LineDown("unplugged"), "unplugged"),
        (OSError(5, "Input/output error"), "Input/output error"),
        (OSError("no number"), "no number"),
        (ValueError("odd"), "odd"),
        (EOFError(), "EOFError"),
    ],
)
def test_the_cause_of_a_lost_connection_has_a_text(cause: Exception | None, text: str) -> None:
    assert cause_text(cause, "closed by the other end") == text

"""Handles of one address: they share a node, and what the first was asked with is never replaced behind its back."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from busmaster import (
    LEARNED,
    Bus,
    Hcp2Controller,
    HcpController,
    InvalidCommand,
    LineSettings,
    MemoryPort,
    MentorDrive,
    MicroFlexDrive,
    MscController,
    ReplyTiming,
    Timings,
)
from busmaster.bus.handle import Handle
from busmaster.bus.node import Node
from busmaster.contract.learning import Learned
from busmaster.emulator.line import Line
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.msc import codec as msc

SLOW = Timings.uniform(ReplyTiming(0.1, 0.2, 0.3, 0.02))
Make = Callable[[Bus], Handle]


@pytest.fixture
def bus() -> Bus:
    """Not entered: what nodes there are is known before that."""
    return Bus(MemoryPort(Line(LineSettings(9600))))


ALIKE: dict[str, tuple[Make, Make]] = {
    "twice the same": (lambda bus: Hcp2Controller(bus, 5), lambda bus: Hcp2Controller(bus, 5)),
    "two kinds of one protocol": (lambda bus: Hcp2Controller(bus, 5), lambda bus: MicroFlexDrive(bus, 5)),
    "the same timings": (
        lambda bus: Hcp2Controller(bus, 5, timings=SLOW, retries=1),
        lambda bus: MicroFlexDrive(bus, 5, timings=SLOW, retries=1),
    ),
    "the protocol's timings, said": (
        lambda bus: Hcp2Controller(bus, 5),
        lambda bus: Hcp2Controller(bus, 5, timings=hcp2.PROFILE.timings, retries=hcp2.PROFILE.retries),
    ),
    "timings left out": (lambda bus: Hcp2Controller(bus, 5, timings=SLOW), lambda bus: Hcp2Controller(bus, 5)),
    "learned, twice": (
        lambda bus: Hcp2Controller(bus, 5, timings=LEARNED),
        lambda bus: MicroFlexDrive(bus, 5, timings=LEARNED),
    ),
    "learned, and the times that it stands for": (
        lambda bus: Hcp2Controller(bus, 5, timings=LEARNED),
        lambda bus: MicroFlexDrive(bus, 5, timings=Learned(hcp2.PROFILE.timings)),
    ),
    "chained, twice": (lambda bus: MentorDrive(bus, 12, chained=True), lambda bus: MentorDrive(bus, 12, chained=True)),
    "chained left out": (lambda bus: MentorDrive(bus, 12, chained=True), lambda bus: MentorDrive(bus, 12)),
    "other symbols": (
        lambda bus: MscController(bus, 3, symbols={"a": 1}, address_step=4),
        lambda bus: MscController(bus, 3, symbols={"b": 2}, address_step=4),
    ),
    "a step left out": (lambda bus: MscController(bus, 3, address_step=4), lambda bus: MscController(bus, 3)),
    "another model of the same kind": (
        lambda bus: MscController(bus, 3, model="MSC-250"),
        lambda bus: MscController(bus, 3, model="MSC-850/32"),
    ),
}


@pytest.mark.parametrize(("first", "second"), ALIKE.values(), ids=ALIKE.keys())
def test_handles_that_say_the_same_or_nothing_share_the_node_as_it_was(bus: Bus, first: Make, second: Make) -> None:
    node = Node.of(first(bus))
    before = (node.profile, node.profile.merge, node.timings, node._record.retries)
    assert second(bus).node is node
    assert (node.profile, node.profile.merge, node.timings, node._record.retries) == before
    assert bus.nodes == (node,)


UNLIKE: dict[str, tuple[Make, Make, str]] = {
    "timings": (lambda b: Hcp2Controller(b, 5), lambda b: MicroFlexDrive(b, 5, timings=SLOW), "other timings"),
    "timings back": (
        lambda b: Hcp2Controller(b, 5, timings=SLOW),
        lambda b: Hcp2Controller(b, 5, timings=hcp2.PROFILE.timings),
        "other timings",
    ),
    "a window": (
        lambda b: Hcp2Controller(b, 5),
        lambda b: MicroFlexDrive(b, 5, timings=SLOW),
        r"other timings \(a reply window of 200 ms, not 100 ms\)",
    ),
    "learned": (
        lambda b: Hcp2Controller(b, 5),
        lambda b: Hcp2Controller(b, 5, timings=LEARNED),
        r"other timings \(a reply window of the learned time, not 100 ms\)",
    ),
    "no longer learned": (
        lambda b: Hcp2Controller(b, 5, timings=LEARNED),
        lambda b: Hcp2Controller(b, 5, timings=SLOW),
        r"other timings \(a reply window of 200 ms, not the learned time\)",
    ),
    "another delay with the same window": (
        lambda b: Hcp2Controller(b, 5, timings=SLOW),
        lambda b: Hcp2Controller(b, 5, timings=SLOW.with_max_reply_delay(0.5)),
        r"other timings\.",
    ),
    "retries": (lambda b: Hcp2Controller(b, 5), lambda b: Hcp2Controller(b, 5, retries=0), "other retries"),
    "chained": (lambda b: MentorDrive(b, 12), lambda b: MentorDrive(b, 12, chained=True), "another profile"),
    "a step": (lambda b: MscController(b, 3), lambda b: MscController(b, 3, address_step=4), "another profile"),
    "another step": (
        lambda b: MscController(b, 3, address_step=4),
        lambda b: MscController(b, 3, address_step=1),
        "another profile",
    ),
    "a model": (
        lambda b: MscController(b, 3, address_step=4),
        lambda b: MscController(b, 3, address_step=4, model="MSC-250"),
        "another profile",
    ),
}


@pytest.mark.parametrize(("first", "second", "what"), UNLIKE.values(), ids=UNLIKE.keys())
def test_a_handle_that_says_something_else_is_refused_and_replaces_nothing(
    bus: Bus, first: Make, second: Make, what: str
) -> None:
    node = Node.of(first(bus))
    before = (node.profile, node.profile.merge, node.timings, node._record.retries)
    with pytest.raises(InvalidCommand, match=f"already in use, and was requested again with {what}"):
        second(bus)
    assert (node.profile, node.profile.merge, node.timings, node._record.retries) == before
    assert bus.nodes == (node,)


def test_another_protocol_at_the_same_address_is_another_node(bus: Bus) -> None:
    nodes = [HcpController(bus, 5).node, Hcp2Controller(bus, 5).node]
    assert len(set(nodes)) == 2
    assert bus.nodes == tuple(nodes)


def test_another_profile_of_one_protocol_is_refused_by_the_bus_itself(bus: Bus) -> None:
    node = bus.node(mentor.PROFILE, 12)
    with pytest.raises(InvalidCommand, match="another profile"):
        bus.node(mentor.CHAINED, 12)
    assert node.profile is mentor.PROFILE


def test_an_address_step_that_is_found_is_known_to_all_handles_of_the_unit(bus: Bus) -> None:
    first, second = MscController(bus, 3, model="MSC-250"), MscController(bus, 3)
    first.address_step = 4
    assert second.address_step == 4
    assert MscController(bus, 3).address_step == 4
    assert first.node.profile.merge == msc.Merging(4, all_flags=True)
    with pytest.raises(InvalidCommand, match="address_step must be"):
        first.address_step = 0
    assert second.address_step == 4

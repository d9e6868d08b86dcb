"""A world: arbiter, line and devices in virtual time."""

from __future__ import annotations

from collections.abc import Callable
from random import Random

import pytest

from busmaster.arbiter.events import CameUnexpected, Event, LineChange, LineChanged, Polled
from busmaster.arbiter.transaction import Poll, Priority, Transaction
from busmaster.contract.tap import Attempt
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.emulator.device import Delay
from busmaster.emulator.faults import Faults
from busmaster.emulator.line import Echo, Line
from busmaster.emulator.traceable import TraceableMemory, traceable_value
from busmaster.emulator.world import StuckWorldError, World
from busmaster.errors import BacklogFull, LineDown, NoReply
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2 import codec as hcp2
from tests.emulator.lines import SETTINGS, TAU, hexed
from tests.stories import in_use

IN_SYNC = 0.2


def world_of(*devices: EmulatedMint, seed: int = 1, **options: object) -> World:
    line = Line(SETTINGS, devices, chance=Random(seed), **options)  # type: ignore[arg-type]  # options of Line
    world = World(line)
    world.run(IN_SYNC)
    in_use(world)
    return world


def test_a_read_takes_as_long_as_its_bytes_and_the_devices_delay() -> None:
    mint = EmulatedMint(2, delay=Delay(0.002))
    mint.comms[1] = 123.456
    world = world_of(mint)
    read = world.request(world.node(hcp2.PROFILE, 2), hcp2.Read(1))
    world.run(1.0)
    assert read.value == 123.456
    assert read.ended_at - IN_SYNC == pytest.approx(8 * TAU + 0.002 + 12 * TAU)


def test_a_node_that_is_not_there_fails_after_its_attempts() -> None:
    world = world_of()
    read = world.request(world.node(hcp2.PROFILE, 2), hcp2.Read(1))
    assert world.run_until(lambda: read.ended_at > 0, 5.0)
    assert isinstance(read.error, NoReply)
    assert read.attempts == 3
    assert world.now < IN_SYNC + (3 + 1) * 0.16  # a check behind the first (R15)


def test_a_node_has_the_timings_and_the_retries_that_are_given() -> None:
    world = world_of()
    quick = Timings.uniform(ReplyTiming(0.01, 0.02, 0.03, 0.005))
    read = world.request(world.node(hcp2.PROFILE, 2, timings=quick, retries=0), hcp2.Read(1))
    assert world.run_until(lambda: read.ended_at > 0, 5.0)
    assert read.attempts == 1
    assert str(read.error).startswith("node 2: no reply within 30 ms, 1 attempt ")


def test_a_world_begins_at_its_time_and_takes_as_many_requests_as_it_has_room_for() -> None:
    world = World(Line(SETTINGS), now=100.0, capacity=1)
    node = world.node(hcp2.PROFILE, 2)
    reads = [world.request(node, hcp2.Read(1)) for _ in range(2)]
    assert [type(read.error) for read in reads] == [type(None), BacklogFull]
    world.run(100.5)
    assert world.now == 100.5


def test_a_reply_that_lies_in_an_adapter_is_waited_for_as_long_as_the_line_holds_bytes_back() -> None:
    """It begins within its window of 100 ms on the wire, and reaches the host behind its maximum reply delay of 150
    ms."""
    mint = EmulatedMint(2, delay=Delay(0.08))
    mint.comms[1] = 123.456
    world = world_of(mint, latency=0.2)
    read = world.request(world.node(hcp2.PROFILE, 2), hcp2.Read(1))
    world.run(2.0)
    assert (read.value, read.attempts) == (123.456, 1)


def test_run_until_gives_up_at_its_limit() -> None:
    world = world_of()
    assert not world.run_until(lambda: False, 2.0)
    assert world.now == pytest.approx(IN_SYNC + 2.0)


def test_an_action_happens_at_its_time_and_events_reach_their_listener() -> None:
    events: list[tuple[float, Event]] = []
    line = Line(SETTINGS, [EmulatedMint(2)])
    world = World(line, on_event=lambda event: events.append((world.now, event)))
    in_use(world)
    node = world.node(hcp2.PROFILE, 2)
    world.at(0.5, lambda: world.request(node, hcp2.Write(1, (5.0,))))
    world.run(1.0)
    [(when, event)] = [entry for entry in events if isinstance(entry[1], Transaction)]
    assert isinstance(event, Transaction)
    assert event.error is None
    assert when == pytest.approx(0.5 + 11 * TAU + 0.002, abs=2 * TAU)


def test_a_listener_may_submit_the_next_request() -> None:
    done: list[Transaction] = []

    def on_event(event: Event) -> None:
        if isinstance(event, Transaction):
            done.append(event)
            if len(done) < 100:
                world.request(node, hcp2.Read(len(done)))

    world = World(Line(SETTINGS, [EmulatedMint(2)]), on_event=on_event)
    world.run(IN_SYNC)
    node = world.node(hcp2.PROFILE, 2)
    world.request(node, hcp2.Read(100))
    world.run(2.0)
    assert len(done) == 100
    assert world.line.collisions == 0


def test_unplugging_fails_what_waits_and_plugging_in_lets_it_go_on() -> None:
    changes: list[LineChange] = []

    def on_event(event: Event) -> None:
        if isinstance(event, LineChanged):
            changes.append(event.change)

    world = World(Line(SETTINGS, [EmulatedMint(2, delay=Delay(0.02))]), on_event=on_event)
    node = world.node(hcp2.PROFILE, 2)
    world.run(IN_SYNC)
    first = world.request(node, hcp2.Read(1))
    world.at(IN_SYNC + 0.01, world.unplug)
    world.run(IN_SYNC + 0.02)
    assert isinstance(first.error, LineDown)
    world.plug()
    world.run(1.0)
    assert world.request(node, hcp2.Read(1)).phase.value == "on wire"
    world.run(2.0)
    assert changes == [LineChange.UP, LineChange.DOWN, LineChange.UP]


def transcript(seed: int) -> list[str]:
    mint = EmulatedMint(2, delay=Delay(0.001, 0.01), traceable=TraceableMemory(2))
    mint.faults = Faults.parse(["lost=0.1", "flip=0.1", "late=0.2", "trailing=0.1", "split=0.3", "babble=0.05"])
    lines: list[str] = []
    world = World(Line(SETTINGS, [mint, EmulatedMint(3)], chance=Random(seed)), record=lines.append)
    for address in (2, 3):
        poll = Poll(f"node {address}", 0.05)
        node = world.node(hcp2.PROFILE, address)
        poll.results = [
            Transaction(node, hcp2.Read(element), priority=Priority.POLL, poll=poll) for element in (1, 100, 255)
        ]
        world.arbiter.add_poll(poll, 0.0)
        world.at(1.0, lambda node=node: world.request(node, hcp2.Write(1, (5.0,))))  # type: ignore[misc]  # bound now
    world.run(5.0)
    return lines


def test_the_same_seed_gives_the_same_transcript_and_another_another() -> None:
    first = transcript(1)
    assert len(first) > 200
    assert transcript(1) == first
    assert transcript(2) != first


def test_a_write_whose_value_is_far_from_its_turn_is_counted_as_foreign() -> None:
    memory = TraceableMemory(2)
    for count in range(100):
        memory.write(5, traceable_value(2, 5, count))
    memory.write(5, traceable_value(2, 5, 100 - 64))
    memory.write(5, traceable_value(2, 5, 101 + 64))
    assert memory.foreign_writes == 0
    memory.write(5, traceable_value(2, 5, 102 - 65))
    assert memory.foreign_writes == 1
    memory.write(5, traceable_value(2, 5, 103 + 65))
    assert memory.foreign_writes == 2


def test_a_value_of_elsewhere_is_that_of_another_node() -> None:
    assert TraceableMemory(2, 10**4).elsewhere() == traceable_value(3, 0, 0, 10**4)


def element_of(read: Transaction) -> int:
    assert isinstance(read.command, hcp2.Read)
    return read.command.element


def test_faults_inside_the_assumption_give_no_wrong_value_and_progress_goes_on() -> None:
    wrong: list[str] = []
    good = 0

    def on_event(event: Event) -> None:
        nonlocal good
        if isinstance(event, Polled):
            for read in event.poll.results:
                if read.error is None:
                    good += 1
                    if read.value != traceable_value(read.node.address, element_of(read), 0):
                        wrong.append(f"{world.now}: {read.node.label}, {read.command} = {read.value}")

    devices = [EmulatedMint(address, traceable=TraceableMemory(address)) for address in range(1, 5)]
    faults = ["lost=.05", "late=.05", "late_by=.14", "flip=.05", "truncated=.05", "doubled=.05", "wrong=.05"]
    faults += ["leading=.05", "trailing=.05", "babble=.02", "split=.05", "nak=.05"]
    for device in devices:
        device.faults = Faults.parse(faults)
    world = World(Line(SETTINGS, devices, chance=Random(3)), on_event=on_event)
    for device in devices:
        poll = Poll(repr(device), 0.1)
        node = world.node(hcp2.PROFILE, device.address)
        poll.results = [Transaction(node, hcp2.Read(n), priority=Priority.POLL, poll=poll) for n in (1, 2, 100, 200)]
        world.arbiter.add_poll(poll, 0.0)
    world.run(60.0)
    assert wrong == []
    for device in devices:
        device.faults = Faults()
    world.run(120.0)
    before = good
    world.run(130.0)
    assert good - before >= 4 * 4 * 99


def test_an_echo_is_stripped() -> None:
    world = World(Line(SETTINGS, [EmulatedMint(2)], echo=Echo()))
    world.run(IN_SYNC)
    read = world.request(world.node(hcp2.PROFILE, 2), hcp2.Read(1))
    world.run(1.0)
    assert read.value == 0
    assert read.attempts == 1


def test_a_world_that_turns_in_circles_says_so() -> None:
    world = world_of()
    world.arbiter.poll_timeout = lambda: 0.5  # type: ignore[method-assign]  # a bug, planted
    with pytest.raises(StuckWorldError, match=r"arbiter 0\.5"):
        world.run(1.0)


def test_bytes_that_arrive_while_the_port_is_away_are_lost() -> None:
    causes: list[tuple[LineChange, str]] = []
    unexpected: list[bytes] = []

    def on_event(event: Event) -> None:
        if isinstance(event, LineChanged):
            causes.append((event.change, event.cause))
        elif isinstance(event, CameUnexpected):
            unexpected.append(event.data)

    world = World(Line(SETTINGS, [EmulatedMint(2, delay=Delay(0.02))]), on_event=on_event)
    node = world.node(hcp2.PROFILE, 2)
    world.plug()  # it is there
    world.run(IN_SYNC)
    world.request(node, hcp2.Read(1))
    world.run(IN_SYNC + 8 * TAU)
    world.unplug("pulled out")
    world.unplug()
    world.run(IN_SYNC + 1.0)
    assert causes == [(LineChange.UP, ""), (LineChange.DOWN, "pulled out")]
    world.plug()
    world.run(IN_SYNC + 2.0)
    assert unexpected == []


def test_actions_of_one_moment_come_in_their_order_and_none_in_the_past() -> None:
    world = world_of()
    done: list[tuple[str, float]] = []

    def act(name: str) -> Callable[[], None]:
        return lambda: done.append((name, world.now))

    now = world.now
    world.at(now + 0.5, act("second"))
    world.at(now + 0.5, act("third"))
    world.at(now - 0.1, act("first"))
    world.run(now + 0.4)
    assert done == [("first", now)]
    assert world.run_until(lambda: len(done) == 3, 1.0)
    assert done == [("first", now), ("second", now + 0.5), ("third", now + 0.5)]
    assert world.now == now + 0.5


class Taps:
    def __init__(self) -> None:
        self.seen: list[tuple[str, str]] = []

    def transmitted(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        self.seen.append(("sent", hexed(data)))
        assert attempt is not None

    def received(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        self.seen.append(("received", hexed(data)))
        assert attempt is not None

    def attempted(self, attempt: Attempt, /) -> None:
        self.seen.append(("ended", f"{attempt.command} {attempt.result}"))


def test_a_tap_and_a_record_of_a_world_have_every_byte_and_every_end() -> None:
    tap, record = Taps(), list[str]()
    world = World(Line(SETTINGS, [EmulatedMint(2)]), tap=tap, record=record.append)
    in_use(world)
    world.run(IN_SYNC)
    world.request(world.node(hcp2.PROFILE, 2), hcp2.Read(1))
    world.run(1.0)
    assert tap.seen == [
        ("sent", "07 30 32 02 30 31 05 04"),
        ("received", "02 30 31 30 03 32"),
        ("ended", "read element 1 0.0"),
    ]
    assert [line.partition(" ")[2] for line in record] == [
        "line up",
        "> 07 30 32 02 30 31 05 04",
        "< 02 30 31 30 03 32",
        "node 2: unknown -> up",
        "node 2: read element 1 -> 0.0",
    ]


def test_a_record_names_every_kind_of_event() -> None:
    record: list[str] = []
    world = World(Line(SETTINGS, [EmulatedMint(2, delay=Delay(0.09))]), record=record.append)
    in_use(world)
    world.run(IN_SYNC)
    world.request(world.node(hcp2.PROFILE, 2), hcp2.Write(1, (5.0,)), finish_by=world.now + 0.05)
    world.request(world.node(hcp2.PROFILE, 3), hcp2.Read(1), retries=0)
    world.run(1.0)
    world.unplug()
    world.run(1.0)
    told = [line.partition(" ")[2] for line in record]
    events = [line for line in told if line[0] not in "<>"]
    assert events[:5] == [
        "line up",
        "node 2: write element 1 = 5 -> WriteUnconfirmed('sent, but not answered within its time: 50 ms')",
        "node 2: unknown -> up",
        "node 3: unknown -> down",
        "node 3: read element 1 -> NoReply('no reply within 150 ms')",
    ]
    assert "line down unplugged" in events[5:]

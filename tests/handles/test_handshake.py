"""The command handshake of the Mint notes (AN00110, AN00129) through handles."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Generator
from typing import Any

import pytest

from busmaster import Bus, Hcp2Controller, InvalidCommand, MicroFlexDrive, NoReply, NotStarted, VerifyFailed
from busmaster.contract.exchange import Command
from busmaster.emulator.faults import Faults
from busmaster.errors import BusClosed, WriteUnconfirmed
from busmaster.protocols._comms.codec import ReadElement, WriteElements
from busmaster.protocols._comms.mint import EmulatedMint, command_handshake
from tests.handles.fake_bus import FakeBus
from tests.stories import on_a_bus

MOVE_ABSOLUTE = 1
SPEED, TARGET = 10.0, 5.0


def careful(mint: EmulatedMint) -> Generator[int, None, None]:
    """The note's program, with its last line inside the condition: no command is lost."""
    comms, axis = mint.comms, mint.axes[1]
    while True:
        yield 1
        if round(comms[1]) == MOVE_ABSOLUTE:
            axis.speed = comms[2]
            axis.move(comms[3], mint.now)
            while not axis.idle(mint.now):
                yield 2
            comms[1] = 0


def test_a_command_ends_when_the_program_reports_it() -> None:
    mint = EmulatedMint(1, program=careful)

    async def story(bus: Bus) -> None:
        began = bus.now()
        await Hcp2Controller(bus, 1).execute(MOVE_ABSOLUTE, SPEED, TARGET, finish_within=5)
        assert TARGET / SPEED < bus.now() - began < 2 * TARGET / SPEED
        assert mint.axes[1].position(bus.now()) == TARGET

    on_a_bus(story, mint)


def test_of_two_commands_at_once_one_is_given_and_keeps_its_data() -> None:
    mint = EmulatedMint(1, program=careful)

    async def story(bus: Bus) -> None:
        controllers = Hcp2Controller(bus, 1), Hcp2Controller(bus, 1)
        moves = (
            controller.execute(MOVE_ABSOLUTE, SPEED, target, finish_within=5)
            for controller, target in zip(controllers, (TARGET, 9.0), strict=True)
        )
        first, second = await asyncio.gather(*moves, return_exceptions=True)
        assert first is None
        assert isinstance(second, NotStarted)
        assert "still carries out a command" in str(second)
        assert mint.axes[1].position(bus.now()) == TARGET

    on_a_bus(story, mint)


def test_a_command_that_ends_sooner_than_it_can_is_not_taken_for_done() -> None:
    """The note's own program loses commands that come between its read and its clear."""
    mint = EmulatedMint(1, program=command_handshake)

    async def story(bus: Bus) -> None:
        controller, lost, done = Hcp2Controller(bus, 1), 0, 0
        for number in range(1, 31):
            target, before = float(number % 2 * 4), mint.axes[1].position(bus.now())
            if target == before:
                continue
            try:
                await controller.execute(MOVE_ABSOLUTE, SPEED, target, finish_within=5, takes=0.3)
            except VerifyFailed:
                assert mint.axes[1].position(bus.now()) == before
                lost += 1
            else:
                assert mint.axes[1].position(bus.now()) == target
                done += 1
        assert (lost > 0, done > 0) == (True, True)

    on_a_bus(story, mint)


def test_commands_are_carried_out_once_though_every_tenth_reply_is_lost() -> None:
    mint = EmulatedMint(1, program=careful)
    mint.faults = Faults(lost=0.1)
    given: list[float] = []
    write = mint.write_element

    def counted(element: int, value: float, now: float) -> bool:
        given.extend([value] if element == 1 else [])
        return write(element, value, now)

    mint.write_element = counted  # type: ignore[method-assign]

    async def story(bus: Bus) -> None:
        controller = Hcp2Controller(bus, 1)
        for number in range(40):
            target = TARGET * (number % 2)
            await controller.execute(MOVE_ABSOLUTE, SPEED, target, finish_within=5)
            assert mint.axes[1].position(bus.now()) == target
        assert given == [MOVE_ABSOLUTE] * 40

    on_a_bus(story, mint)


def test_a_command_that_is_not_reported_in_time_is_unconfirmed() -> None:
    mint = EmulatedMint(1)  # it runs no program

    async def story(bus: Bus) -> None:
        began = bus.now()
        with pytest.raises(WriteUnconfirmed, match="element 1 did not become 0 in time: it read 3 last"):
            await Hcp2Controller(bus, 1).execute(3, finish_within=1.5)
        assert 1.5 <= bus.now() - began < 1.6

    on_a_bus(story, mint)


# the same over a table


class Program(FakeBus):
    """Elements, and what happens at each read of element 1: an element's value, or an error."""

    def __init__(self, *reads: float | Exception, write: Callable[[], Exception | None] = lambda: None) -> None:
        super().__init__(self.obey)
        self.reads = list(reads)
        self.write = write
        self.elements: dict[int, float] = {}

    def obey(self, command: Command[Any]) -> float | None:
        if isinstance(command, WriteElements):
            self.elements |= dict(enumerate(command.values, command.element))
            if command.element == 1 and (error := self.write()) is not None:
                raise error
            return None
        assert isinstance(command, ReadElement)
        if command.element != 1:
            return self.elements.get(command.element, 0.0)
        found = self.reads.pop(0)
        if isinstance(found, Exception):
            raise found
        return found


@pytest.mark.asyncio
async def test_the_data_go_first_and_the_command_alone() -> None:
    bus = Program(0, 7, 0)
    await Hcp2Controller(bus, 1).execute(7, 1.5, -2, finish_within=1)
    assert bus.asked == [
        "read element 1",
        "write elements 2-3 = 1.5,-2",
        "write element 1 = 7",
        "read element 1",
        "read element 1",
    ]


@pytest.mark.asyncio
async def test_another_element_may_take_the_command() -> None:
    bus = Program()
    bus.elements[20] = 0
    bus.answer = lambda command: None if command.writes else 0.0
    await Hcp2Controller(bus, 1).execute(7, 4, finish_within=1, element=20)
    assert bus.asked == ["read element 20", "write element 21 = 4", "write element 20 = 7", "read element 20"]


@pytest.mark.asyncio
async def test_a_command_that_was_not_acknowledged_is_awaited_if_it_arrived() -> None:
    bus = Program(0, 7, 7, 0, write=lambda: WriteUnconfirmed("no reply"))
    await Hcp2Controller(bus, 1).execute(7, finish_within=1)
    assert bus.reads == []


@pytest.mark.asyncio
@pytest.mark.parametrize("after", [0.0, 8.0, NoReply("no reply")])
async def test_a_command_that_was_not_acknowledged_and_is_not_there_is_unconfirmed(after: float | Exception) -> None:
    bus = Program(0, after, 0, write=lambda: WriteUnconfirmed("no acknowledgement"))
    with pytest.raises(WriteUnconfirmed, match="no acknowledgement"):
        await Hcp2Controller(bus, 1).execute(7, finish_within=1)
    assert bus.asked.count("write element 1 = 7") == 1


@pytest.mark.asyncio
async def test_data_that_were_not_acknowledged_are_read_back_and_never_written_twice() -> None:
    stored = {2: 5.0, 3: 6.0}
    for arrived in (True, False):
        bus = Program(0, 7, 0)
        bus.elements = dict(stored) if arrived else {2: 5.0}
        right = bus.answer

        def answer(command: Command[Any], right: Callable[[Command[Any]], Any] = right) -> Any:
            if str(command) == "write elements 2-3 = 5,6":
                raise WriteUnconfirmed("no reply")
            return right(command)

        bus.answer = answer
        executing = Hcp2Controller(bus, 1).execute(7, 5, 6, finish_within=1)
        if arrived:
            await executing
        else:
            with pytest.raises(WriteUnconfirmed):
                await executing
        assert bus.asked.count("write elements 2-3 = 5,6") == 1
        assert ("write element 1 = 7" in bus.asked) is arrived


@pytest.mark.asyncio
async def test_a_read_that_fails_meanwhile_is_made_again() -> None:
    bus = Program(0, 7, NoReply("no reply"), 7, NoReply("no reply"), 0)
    await Hcp2Controller(bus, 1).execute(7, finish_within=1)
    assert bus.reads == []


@pytest.mark.asyncio
async def test_nothing_is_awaited_on_a_bus_that_was_closed() -> None:
    bus = Program(0, 7, BusClosed("the bus was closed"), 0)
    with pytest.raises(BusClosed):
        await Hcp2Controller(bus, 1).execute(7, finish_within=1)
    assert bus.reads == [0]


def test_the_time_that_a_command_takes_counts_from_when_it_was_sent_also_without_an_acknowledgement() -> None:
    """The acknowledgement is lost: that the command has arrived is known only some 0.15 s later."""
    mint = EmulatedMint(1, program=careful)
    write, read = mint.write_element, mint.read_element

    def write_element(element: int, value: float, now: float) -> bool:
        mint.faults.lost = float(element == 1)
        return write(element, value, now)

    def read_element(element: int, now: float) -> float | None:
        mint.faults.lost = 0.0
        return read(element, now)

    mint.write_element, mint.read_element = write_element, read_element  # type: ignore[method-assign]

    async def story(bus: Bus) -> None:
        await Hcp2Controller(bus, 1).execute(MOVE_ABSOLUTE, SPEED, TARGET, finish_within=5, takes=0.9 * TARGET / SPEED)
        assert mint.axes[1].position(bus.now()) == TARGET

    on_a_bus(story, mint)


def test_no_data_are_written_for_a_command_beyond_a_limit() -> None:
    mint = EmulatedMint(1, program=careful)

    async def story(bus: Bus) -> None:
        controller = Hcp2Controller(bus, 1)
        controller.element(1).limit(maximum=5)
        with pytest.raises(InvalidCommand, match="1 = 7 is above its maximum of 5"):
            await controller.execute(7, SPEED, TARGET, finish_within=5)
        assert mint.comms[2:4] == [0.0, 0.0]

    on_a_bus(story, mint)


@pytest.mark.asyncio
async def test_a_command_that_another_has_replaced_is_reported() -> None:
    bus = Program(0, 7, 2)
    with pytest.raises(VerifyFailed, match="element 1 reads 2 after command 7"):
        await Hcp2Controller(bus, 1).execute(7, finish_within=1)


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("values", "options"),
    [
        ((0,), {}),
        ((0.00001,), {}),  # it is sent as 0
        ((float("nan"),), {}),
        ((1, float("inf")), {}),
        ((1, *range(99)), {}),
        ((1,), {"element": 0}),
        ((1,), {"finish_within": float("nan")}),
        ((1,), {"takes": -1}),
    ],
)
async def test_what_is_no_command_is_refused_before_anything_is_sent(
    values: tuple[float, ...], options: dict[str, Any]
) -> None:
    bus = Program()
    controller = Hcp2Controller(bus, 1)
    with pytest.raises(InvalidCommand):
        await controller.execute(*values, **{"finish_within": 1.0, **options})
    assert bus.asked == []


def test_a_drive_without_a_program_has_no_handshake() -> None:
    assert not hasattr(MicroFlexDrive, "execute")

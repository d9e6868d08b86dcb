"""MicroFlexDrive: what it promises about the command word, request by request (AN00129, "MicroFlex Command Word")."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from itertools import chain, count
from typing import Any

import anyio
import pytest

from busmaster.bus.bus import Bus
from busmaster.bus.node import Priority
from busmaster.contract.exchange import Command
from busmaster.errors import (
    BusClosed,
    BusError,
    InvalidCommand,
    NoReply,
    Refused,
    Superseded,
    VerifyFailed,
    WriteUnconfirmed,
)
from busmaster.protocols.hcp2 import microflex_handle as module
from busmaster.protocols.hcp2.codec import Read, Write
from busmaster.protocols.hcp2.microflex import CommandWord, StatusWord
from busmaster.protocols.hcp2.microflex_device import EmulatedMicroFlex
from busmaster.protocols.hcp2.microflex_handle import MicroFlexDrive
from busmaster.testing.virtual_time import run_in_virtual_time
from tests.handles.fake_bus import FakeBus
from tests.stories import on_a_bus

READY = StatusWord.HARDWARE_ENABLE
ENABLE, CANCEL = CommandWord.ENABLE, CommandWord.CANCEL


class Drive(FakeBus):
    """Command word, status word, references. `failures` are raised by the next writes of the command word."""

    def __init__(self) -> None:
        super().__init__(self.obey)
        self.command = 0
        self.status = READY
        self.obeys = True
        self.failures: Iterator[Exception | None] = iter(())
        self.words: list[int] = []
        self.elements: dict[int, float] = {239: 5221.0}

    def obey(self, command: Command[Any]) -> float | None:
        if isinstance(command, Read):
            known = {108: float(self.command), 109: float(self.status)}
            return {**self.elements, **known}[command.element]
        assert isinstance(command, Write)
        value = command.values[0]
        if command.element != 108:
            self.elements[command.element] = value
            return None
        assert command.idempotent
        failure = next(self.failures, None)
        self.words.append(int(value))
        if not isinstance(failure, Superseded):
            self.command = int(value)
            if self.obeys:
                self.status = READY | StatusWord.ENABLED if self.command & ENABLE else READY
        if failure is not None:
            raise failure
        return None


@pytest.fixture
def line() -> Drive:
    return Drive()


@pytest.fixture
def drive(line: Drive, monkeypatch: pytest.MonkeyPatch) -> MicroFlexDrive:
    monkeypatch.setattr(module, "LOOK_AGAIN", 0)
    monkeypatch.setattr(module, "CLEAR_WITHIN", 60)
    return MicroFlexDrive(line, 7)


@pytest.mark.asyncio
async def test_enable_sets_bit_7_and_looks_whether_it_took(drive: MicroFlexDrive, line: Drive) -> None:
    assert StatusWord.ENABLED in await drive.enable()
    assert line.asked == ["write element 108 = 128", "read element 109"]


@pytest.mark.parametrize(
    ("status", "why"),
    [
        (StatusWord(0), "hardware enable input is not active"),
        (READY | StatusWord.ASYNCHRONOUS_ERROR, "it has an error"),
        (READY | StatusWord.STOP_INPUT, "stop input is active"),
        (READY, "gives no reason"),
    ],
)
@pytest.mark.asyncio
async def test_a_drive_that_does_not_enable_says_why(
    drive: MicroFlexDrive, line: Drive, status: StatusWord, why: str
) -> None:
    line.obeys = False
    line.status = status
    with pytest.raises(VerifyFailed, match=why):
        await drive.enable(within=0.005)


@pytest.mark.asyncio
async def test_enable_gives_the_drive_time(drive: MicroFlexDrive, line: Drive) -> None:
    line.obeys = False

    def slowly(command: Command[Any]) -> float | None:
        if len(line.log) == 4:
            line.status = READY | StatusWord.ENABLED
        return line.obey(command)

    line.answer = slowly
    assert StatusWord.ENABLED in await drive.enable()
    assert line.asked[1:] == ["read element 109"] * 3


@pytest.mark.asyncio
async def test_disable_goes_first_and_is_verified(drive: MicroFlexDrive, line: Drive) -> None:
    await drive.enable()
    line.log.clear()
    assert StatusWord.ENABLED not in await drive.disable()
    assert line.log == [
        (7, "write element 108 = 0", Priority.URGENT),
        (7, "read element 109", Priority.URGENT),
    ]


@pytest.mark.asyncio
async def test_a_drive_that_stays_enabled_is_told(drive: MicroFlexDrive, line: Drive) -> None:
    await drive.enable()
    line.obeys = False
    with pytest.raises(VerifyFailed, match="still enabled"):
        await drive.disable(within=0.005)


@pytest.mark.parametrize("word", [0, 128])
@pytest.mark.asyncio
async def test_cancel_errors_keeps_the_enable_bit_and_clears_the_cancel_bit(
    drive: MicroFlexDrive, line: Drive, word: int
) -> None:
    line.command = word
    await drive.cancel_errors()
    assert line.words == [word | 64, word]
    assert line.asked[0] == "read element 108"


@pytest.mark.asyncio
async def test_bits_that_the_document_does_not_define_are_not_written_back(drive: MicroFlexDrive, line: Drive) -> None:
    line.command = 128 | 64 | 31
    await drive.cancel_errors()
    assert line.words == [192, 128]


@pytest.mark.parametrize("failure", [WriteUnconfirmed("?"), NoReply("?"), InvalidCommand("?")])
@pytest.mark.asyncio
async def test_the_cancel_bit_is_cleared_even_if_setting_it_failed(
    drive: MicroFlexDrive, line: Drive, failure: Exception
) -> None:
    line.command = 128
    line.failures = iter([failure])
    with pytest.raises(type(failure)):
        await drive.cancel_errors()
    assert line.words == [192, 128]


@pytest.mark.asyncio
async def test_clearing_is_tried_again_until_it_is_acknowledged(drive: MicroFlexDrive, line: Drive) -> None:
    line.failures = iter([None, WriteUnconfirmed("?"), NoReply("?"), None])
    await drive.cancel_errors()
    assert line.words == [64, 0, 0, 0]


def test_a_cancel_bit_that_cannot_be_cleared_is_told(line: Drive) -> None:
    line.failures = chain([None], (WriteUnconfirmed("no answer") for _ in count()))
    with pytest.raises(WriteUnconfirmed, match="no answer"):
        run_in_virtual_time(MicroFlexDrive(line, 7).cancel_errors())


def test_the_failure_to_set_the_cancel_bit_is_reported_and_not_that_to_clear_it(line: Drive) -> None:
    line.failures = chain([NoReply("first")], (WriteUnconfirmed("second") for _ in count()))
    with pytest.raises(NoReply, match="first"):
        run_in_virtual_time(MicroFlexDrive(line, 7).cancel_errors())


def test_a_clear_that_never_gets_its_turn_is_told(line: Drive, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = MicroFlexDrive(line, 7)
    monkeypatch.setattr(drive.node, "request", hang_at_third(drive.node.request))
    with pytest.raises(WriteUnconfirmed, match="may still be set"):
        run_in_virtual_time(drive.cancel_errors())


def hang_at_third(request: Any) -> Any:
    asked = 0

    async def hanging(*args: Any, **options: Any) -> Any:
        nonlocal asked
        asked += 1
        return await (anyio.sleep_forever() if asked == 3 else request(*args, **options))

    return hanging


@pytest.mark.asyncio
async def test_the_first_failure_is_the_one_that_is_told(drive: MicroFlexDrive, line: Drive) -> None:
    line.failures = iter([NoReply("first"), BusClosed("closed")])
    with pytest.raises(NoReply, match="first"):
        await drive.cancel_errors()


@pytest.mark.asyncio
async def test_a_closed_bus_is_not_asked_again(drive: MicroFlexDrive, line: Drive) -> None:
    line.failures = iter([None, BusClosed("closed")])
    with pytest.raises(BusClosed):
        await drive.cancel_errors()
    assert len(line.words) == 2


@pytest.mark.parametrize("after", range(1, 6))
@pytest.mark.asyncio
async def test_a_cancelled_caller_leaves_no_cancel_bit_behind(drive: MicroFlexDrive, line: Drive, after: int) -> None:
    line.command = 128
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(drive.cancel_errors)
        await line.requests(min(after, 4))
        tasks.cancel_scope.cancel()
    assert line.command == 128
    assert line.words in ([], [128], [192, 128])  # a write that was cancelled may not have been made


@pytest.mark.parametrize("after", range(1, 5))
@pytest.mark.asyncio
async def test_a_cancelled_task_leaves_no_cancel_bit_behind(drive: MicroFlexDrive, line: Drive, after: int) -> None:
    task = asyncio.ensure_future(drive.cancel_errors())
    await line.requests(after)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert not line.command & CANCEL


@pytest.mark.asyncio
async def test_a_task_that_is_cancelled_again_and_again_still_clears_the_bit(
    drive: MicroFlexDrive, line: Drive
) -> None:
    line.failures = iter([None, WriteUnconfirmed("?"), BusClosed("closed")])
    task = asyncio.ensure_future(drive.cancel_errors())
    for requests in (3, 4):
        await line.requests(requests)
        task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert line.words[-1] == 0


@pytest.mark.parametrize("at", range(1, 4))
@pytest.mark.asyncio
async def test_a_disable_in_between_is_not_undone(drive: MicroFlexDrive, line: Drive, at: int) -> None:
    """Through another handle of the same drive, at each moment of cancel_errors."""
    await drive.enable()
    line.log.clear()
    other = MicroFlexDrive(line, 7)
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(drive.cancel_errors)
        await line.requests(at)
        await other.disable()
    assert line.command == 0
    assert StatusWord.ENABLED not in line.status


@pytest.mark.asyncio
async def test_a_clear_that_a_disable_dropped_is_decided_anew(drive: MicroFlexDrive, line: Drive) -> None:
    await drive.enable()
    line.words.clear()

    def overtaken(command: Command[Any]) -> float | None:
        if str(command) == "write element 108 = 128" and len(line.words) == 1:
            drive.node.note_stop()
            line.failures = iter([Superseded("overtaken")])
        return line.obey(command)

    line.answer = overtaken
    await drive.cancel_errors()
    assert line.words == [192, 128, 0]


@pytest.mark.asyncio
async def test_references_are_levels_in_percent(drive: MicroFlexDrive, line: Drive) -> None:
    await drive.set_speed_reference(-25.5)
    await drive.set_torque_reference(10)
    assert line.asked == ["write element 118 = -25.5", "write element 116 = 10"]


@pytest.mark.asyncio
async def test_status_is_a_set_of_flags(drive: MicroFlexDrive, line: Drive) -> None:
    line.status = StatusWord(192)
    assert await drive.status() == StatusWord.ENABLED | StatusWord.HARDWARE_ENABLE


@pytest.mark.asyncio
async def test_a_firmware_without_the_map_is_told(drive: MicroFlexDrive, line: Drive) -> None:
    assert await drive.check_firmware() == 5221
    line.elements[239] = 5220.0
    with pytest.raises(VerifyFailed, match="5220 is older than 5221"):
        await drive.check_firmware()


@pytest.mark.asyncio
async def test_read_only_names_are_refused_before_anything_is_sent(drive: MicroFlexDrive, line: Drive) -> None:
    for item in ("status_word", "outputs", "temperature"):
        with pytest.raises(InvalidCommand, match="read-only"):
            await drive.write(item, 1)
    assert line.asked == []


@pytest.mark.asyncio
async def test_by_number_too_since_every_drive_has_the_same_map(drive: MicroFlexDrive, line: Drive) -> None:
    for element, name in ((109, "status_word"), (222, "outputs"), (119, "speed_demand")):
        with pytest.raises(InvalidCommand, match=f"{name} is read-only"):
            await drive.write(element, 1)
        with pytest.raises(InvalidCommand, match=f"{element} is read-only"):
            await drive.point(str(element)).write(1)
        assert not drive.element(element).writable
    assert line.asked == []
    for element in (118, 50):  # 50 is not in the map: the drive's to refuse
        assert drive.element(element).writable
        assert [str(command) for command in drive._writes(element, (5,))] == [f"write element {element} = 5"]


@pytest.mark.asyncio
async def test_no_value_of_a_list_may_go_to_a_read_only_name(drive: MicroFlexDrive, line: Drive) -> None:
    with pytest.raises(InvalidCommand, match="speed_demand is read-only"):
        await drive.write("speed_reference", 10, 20)
    assert line.asked == []


def test_a_refused_reference_names_mode_and_source() -> None:
    async def story(bus: Bus) -> None:
        drive = MicroFlexDrive(bus, 7)
        with pytest.raises(Refused, match="only in speed control mode with SPEEDRESOURCE set to host"):
            await drive.set_speed_reference(10)
        with pytest.raises(Refused, match="only in current control mode with TORQUERESOURCE set to host"):
            await drive.write(116, 10)
        with pytest.raises(Refused, match="within the node's limits"):
            await drive.write(50, 10)

    on_a_bus(story, EmulatedMicroFlex(7, host_reference=False))


def test_the_errors_of_these_tests_are_bus_errors() -> None:
    assert issubclass(VerifyFailed, BusError)

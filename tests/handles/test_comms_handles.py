"""HcpController and Hcp2Controller over a node that keeps a comms array."""

from __future__ import annotations

from ctypes import c_float
from typing import Any

import pytest

from busmaster.bus.node import Priority
from busmaster.contract.exchange import Command
from busmaster.errors import InvalidCommand, VerifyFailed
from busmaster.protocols._comms.codec import ReadElement, WriteElements
from busmaster.protocols._comms.handle import CommsHandle
from busmaster.protocols.hcp.handle import HcpController
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2 import comms_array, microflex
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.protocols.hcp2.microflex_handle import MicroFlexDrive
from tests.handles.fake_bus import FakeBus


class CommsArray(FakeBus):
    """Elements as a controller keeps them: in single precision, shown with 4 decimals."""

    def __init__(self) -> None:
        super().__init__(self.obey)
        self.elements: dict[int, float] = {}

    def obey(self, command: Command[Any]) -> float | None:
        if isinstance(command, WriteElements):
            for offset, text in enumerate(command.text.split(",")):
                self.elements[command.element + offset] = round(c_float(float(text)).value, 4)
            return None
        assert isinstance(command, ReadElement)
        return self.elements.get(command.element, 0.0)


@pytest.fixture
def line() -> CommsArray:
    return CommsArray()


@pytest.fixture(params=[HcpController, Hcp2Controller])
def controller(request: pytest.FixtureRequest, line: CommsArray) -> CommsHandle:
    handle: CommsHandle = request.param(line, 5)
    return handle


@pytest.mark.asyncio
async def test_a_written_element_is_read_back(controller: CommsHandle, line: CommsArray) -> None:
    await controller.write(1, 123.456)
    assert await controller.read(1) == pytest.approx(123.456)
    assert line.asked == ["write element 1 = 123.456", "read element 1"]


@pytest.mark.asyncio
async def test_several_values_go_in_one_telegram(controller: CommsHandle, line: CommsArray) -> None:
    await controller.write(10, 10, 20, 30)
    assert line.asked == ["write elements 10-12 = 10,20,30"]


@pytest.mark.asyncio
async def test_a_list_of_more_than_60_characters_goes_in_several(controller: CommsHandle, line: CommsArray) -> None:
    await controller.write(1, *range(10001, 10025))
    assert [line.elements[n] for n in range(1, 25)] == [float(10000 + n) for n in range(1, 25)]
    assert [asked.split(" = ")[0] for asked in line.asked] == [
        "write elements 1-10",
        "write elements 11-20",
        "write elements 21-24",
    ]


@pytest.mark.asyncio
async def test_nothing_is_sent_of_a_list_that_cannot_be_sent_whole(controller: CommsHandle, line: CommsArray) -> None:
    for values in ((), (1.0, float("nan")), (*range(10001, 10020), 1e20)):
        with pytest.raises(InvalidCommand):
            await controller.write(1, *values)
    with pytest.raises(InvalidCommand):
        await controller.write(controller._read_command.last - 10, *range(10001, 10013))
    assert line.asked == []


@pytest.mark.asyncio
async def test_a_verified_write_reads_every_element_back(controller: CommsHandle, line: CommsArray) -> None:
    await controller.write(10, 0.12345, 16777217.0, verify=True)
    assert line.asked[1:] == ["read element 10", "read element 11"]


@pytest.mark.asyncio
async def test_a_write_that_reads_back_otherwise_is_told(controller: CommsHandle, line: CommsArray) -> None:
    line.answer = lambda command: None if command.writes else 5.0
    with pytest.raises(VerifyFailed, match=r"node 5: element 11 reads 5\.0 after 6 was written") as caught:
        await controller.write(10, 5, 6, verify=True)
    assert (caught.value.line, caught.value.label, caught.value.address) == ("a fake line", "node 5", 5)


@pytest.mark.asyncio
async def test_priority_and_idempotence_are_handed_on(controller: CommsHandle, line: CommsArray) -> None:
    seen: list[Command[Any]] = []
    line.answer = seen.append
    await controller.write(1, 5, idempotent=True, priority=Priority.URGENT)
    await controller.write(1, 5)
    assert [options.get("idempotent") for options in line.options] == [True, None]
    assert [priority for _, _, priority in line.log] == [Priority.URGENT, None]


@pytest.mark.asyncio
async def test_an_element_can_be_given_by_its_number_as_text(controller: CommsHandle, line: CommsArray) -> None:
    await controller.write("7", 12.5, 13.5)
    assert await controller.read("7") == await controller.read(7) == 12.5
    assert await controller.read("7", 2) == (12.5, 13.5)
    with pytest.raises(InvalidCommand, match="no such item '7x'"):
        await controller.read("7x")


@pytest.mark.asyncio
async def test_a_number_is_a_point(controller: CommsHandle, line: CommsArray) -> None:
    point = controller.point("7")
    await point.write(2.5)
    assert await point.read() == 2.5
    assert point == controller.element(7)
    assert point.key == "5/7"


def test_hcp_knows_no_names(line: CommsArray) -> None:
    controller = HcpController(line, 5)
    assert controller.items() == ()
    for item in ("position", "0", "100", "1.5", "-1", "", "\u0661"):
        with pytest.raises(InvalidCommand):
            controller.point(item)


def test_a_node_of_hcp_is_at_most_15(line: CommsArray) -> None:
    with pytest.raises(InvalidCommand):
        HcpController(line, 16)


# names


def test_every_name_of_the_extended_comms_array_is_a_point(line: CommsArray) -> None:
    controller = Hcp2Controller(line, 5)
    for name in controller.items():
        point = controller.point(name)
        assert point.command == hcp2.Read(comms_array.ELEMENTS[name].number)
        assert point.writable is (name == "outputs")


def test_axes_and_io_are_the_same_points_as_their_names(line: CommsArray) -> None:
    controller = Hcp2Controller(line, 5)
    for number in range(8):
        axis = controller.axis(number)
        for name in ("position", "velocity", "mode", "axis_error", "demand", "encoder", "idle", "following_error"):
            assert getattr(axis, name) == controller.point(f"axis{number}.{name}")
        assert controller.io.adc(number) == controller.point(f"adc{number}")
    for name in ("inputs", "outputs", "error", "error_line", "error_axis", "running", "line_number", "firmware"):
        assert getattr(controller.io, name) == controller.point(name)
    assert repr(controller.axis(3)) == "<Axis 3 of node 5>"


@pytest.mark.parametrize("number", [-1, 8])
def test_there_are_8_axes_and_8_analogue_channels(line: CommsArray, number: int) -> None:
    controller = Hcp2Controller(line, 5)
    with pytest.raises(InvalidCommand, match="must be 0 to 7"):
        controller.axis(number)
    with pytest.raises(InvalidCommand, match="must be 0 to 7"):
        controller.io.adc(number)


def test_a_mistyped_name_gets_the_nearest_one(line: CommsArray) -> None:
    with pytest.raises(InvalidCommand, match=r"did you mean 'axis0\.position'"):
        Hcp2Controller(line, 5).point("axis0.positon")


@pytest.mark.asyncio
async def test_elements_are_read_and_written_by_name(line: CommsArray) -> None:
    controller = Hcp2Controller(line, 5)
    line.elements[105] = 4096.0
    assert await controller.read("axis0.encoder") == 4096.0
    await controller.write("outputs", 5)
    assert await controller.io.outputs.read() == 5
    assert line.asked[1] == "write element 222 = 5"


@pytest.mark.asyncio
async def test_a_name_that_is_read_only_is_refused_and_its_number_is_sent(line: CommsArray) -> None:
    controller = Hcp2Controller(line, 5)
    with pytest.raises(InvalidCommand, match="read-only"):
        await controller.write("inputs", 1)
    with pytest.raises(InvalidCommand, match="read-only"):
        await controller.io.inputs.write(1)
    assert line.asked == []
    await controller.write(220, 1)
    assert line.asked == ["write element 220 = 1"]


@pytest.mark.asyncio
async def test_an_item_that_is_a_number_is_named_as_such(line: CommsArray) -> None:
    controller = Hcp2Controller(line, 5)
    with pytest.raises(InvalidCommand, match=r"an item is text, such as '1', not 1"):
        controller.point(1)  # type: ignore[arg-type]  # a caller without a type checker
    with pytest.raises(InvalidCommand, match="no such item"):
        await controller.read(1.0)  # type: ignore[call-overload]  # likewise
    assert line.asked == []


def test_named_levels_may_be_repeated_and_numbers_not(line: CommsArray) -> None:
    controller = Hcp2Controller(line, 5)
    assert controller.io.outputs.encode is not None
    assert controller.io.outputs.encode(5).idempotent
    number = controller.element(222)
    assert number.encode is not None
    assert not number.encode(5).idempotent


def test_every_name_of_microflex_is_an_attribute(line: CommsArray) -> None:
    drive = MicroFlexDrive(line, 7)
    for name in drive.items():
        assert getattr(drive, name) == drive.point(name)
    assert MicroFlexDrive.bus_voltage.element is microflex.BUS_VOLTAGE
    assert drive.bus_voltage.unit == "V"

"""MscController over a controller whose data area knows how its addresses count."""

from __future__ import annotations

from typing import Any

import pytest

from busmaster.bus.node import Priority
from busmaster.contract.exchange import Command
from busmaster.errors import InvalidCommand, Refused, VerifyFailed
from busmaster.protocols.msc.codec import (
    BlockRead,
    BlockWrite,
    ClearFlag,
    DataRead,
    DataWrite,
    ReadFlag,
    ReadFlags,
    ReadStatus,
    SetFlag,
)
from busmaster.protocols.msc.handle import MscController
from busmaster.protocols.msc.status import ProgramStatus
from tests.handles.fake_bus import FakeBus

FIRST = 2000


class Controller(FakeBus):
    """Values from address 2000 on, `step` addresses each; what lies outside, or between, is refused."""

    def __init__(self, size: int = 1200, step: int = 4) -> None:
        super().__init__(self.obey)
        self.step = step
        self.data = [0] * size
        self.flags: set[int] = set()
        self.stuck: int | None = None

    def index(self, address: int, count: int = 1) -> int:
        index, between = divmod(address - FIRST, self.step)
        if between or not 0 <= index <= len(self.data) - count:
            raise Refused("refused 4 times", confirm=False)
        return index

    def obey(self, command: Command[Any]) -> Any:
        match command:
            case DataRead(address):
                return self.data[self.index(address)]
            case DataWrite(address, value):
                self.data[self.index(address)] = value
            case BlockRead(address):
                start = self.index(address, 32)
                return tuple(self.data[start : start + 32])
            case BlockWrite(address, values):
                start = self.index(address, 32)
                self.data[start : start + 32] = values
            case SetFlag(flag):
                self.flags.add(flag)
            case ClearFlag(flag):
                self.flags.discard(flag)
            case ReadFlag(flag):
                return flag in self.flags
            case ReadFlags():
                return frozenset(self.flags)
            case ReadStatus():
                return ProgramStatus(65)
        if self.stuck is not None:
            self.data[self.stuck] = -1
        return None


@pytest.fixture
def line() -> Controller:
    return Controller()


@pytest.fixture
def press(line: Controller) -> MscController:
    return MscController(line, 3, symbols={"count": 2008, "cam": 2000}, address_step=4)


# single values


@pytest.mark.asyncio
async def test_a_value_is_written_and_read_by_address_or_symbol(press: MscController, line: Controller) -> None:
    await press.write("count", 1234, verify=True)
    assert await press.read(2008) == await press.read("count") == await press.read("2008") == 1234
    assert line.asked[:2] == ["write data 2008 = 1234", "read data 2008"]


@pytest.mark.asyncio
async def test_a_write_that_does_not_stick_fails_its_verification(press: MscController, line: Controller) -> None:
    line.stuck = 2
    with pytest.raises(VerifyFailed, match="value 0 from data 2008 on reads -1 after 5 was written"):
        await press.write("count", 5, verify=True)


@pytest.mark.asyncio
async def test_an_unknown_symbol_is_never_asked_for(press: MscController, line: Controller) -> None:
    with pytest.raises(InvalidCommand, match="did you mean 'count'"):
        await press.read("coumt")
    assert line.asked == []


@pytest.mark.parametrize(
    "symbols",
    [{name: 1} for name in ("", "flags", "12", "a:b", "a=b", "a,b", "a b")] + [{"a": 1, "": 1}, {"count": 65536}],
)
def test_a_symbol_that_could_not_be_told_from_an_item_is_refused(line: Controller, symbols: dict[str, int]) -> None:
    with pytest.raises(InvalidCommand):
        MscController(line, 3, symbols=symbols)


def test_there_are_fifteen_units_and_a_step_of_at_least_one(line: Controller) -> None:
    for unit, step in ((0, 4), (16, 4), (1, 0)):
        with pytest.raises(InvalidCommand):
            MscController(line, unit, address_step=step)


# blocks


@pytest.mark.asyncio
@pytest.mark.parametrize("count", [1, 2, 31, 32, 33, 64, 100])
async def test_any_number_of_values_is_written_and_read(press: MscController, line: Controller, count: int) -> None:
    line.data = [-7] * 1200
    values = tuple(range(count))
    await press.write_block("cam", values, verify=True)
    assert line.data[:count] == list(values)
    assert line.data[count:] == [-7] * (1200 - count)
    assert await press.read("cam", count) == values


@pytest.mark.asyncio
async def test_whole_blocks_are_one_exchange_and_the_rest_is_written_value_by_value(
    press: MscController, line: Controller
) -> None:
    await press.write_block(2000, range(34))
    assert line.asked == ["write 32 values from data 2000", "write data 2128 = 32", "write data 2132 = 33"]


@pytest.mark.asyncio
async def test_while_the_step_is_unknown_only_what_needs_no_step_is_sent(line: Controller) -> None:
    press = MscController(line, 3)
    await press.write_block(2000, range(32), verify=True)
    await press.write(2000, 5, verify=True)
    assert await press.read(2000, 5) == (5, 1, 2, 3, 4)
    asked = len(line.asked)
    with pytest.raises(InvalidCommand, match="address_step"):
        await press.write_block(2000, range(33))
    with pytest.raises(InvalidCommand, match="address_step"):
        await press.write_block(2000, range(5))
    with pytest.raises(InvalidCommand, match="address_step"):
        await press.read(2000, 33)
    assert len(line.asked) == asked


@pytest.mark.asyncio
async def test_the_last_values_of_the_data_area_are_read_one_by_one(line: Controller) -> None:
    line.data = list(range(40))
    press = MscController(line, 3, address_step=4)
    assert await press.read(2000, 40) == tuple(range(40))
    assert line.asked[1:3] == ["read 32 values from data 2128", "read data 2128"]


@pytest.mark.asyncio
async def test_a_refusal_that_no_single_read_would_fix_is_the_callers(line: Controller) -> None:
    known, unknown = MscController(line, 3, address_step=4), MscController(line, 4)
    with pytest.raises(Refused):
        await known.read(1000, 32)
    assert line.asked == ["read 32 values from data 1000"]
    with pytest.raises(Refused):
        await known.read(1000, 1)
    with pytest.raises(Refused):
        await unknown.read(1000, 5)


@pytest.mark.asyncio
async def test_a_transfer_that_cannot_end_is_not_begun(press: MscController, line: Controller) -> None:
    for values in ([], [0] * 32 + [2**31], [0] * 20000):
        with pytest.raises(InvalidCommand):
            await press.write_block(2000, values)
    for count in (0, 20000):
        with pytest.raises(InvalidCommand):
            await press.read(2000, count)
    assert line.asked == []


# CAM tables


@pytest.mark.asyncio
async def test_a_cam_table_is_written_verified_and_shows_its_progress(press: MscController, line: Controller) -> None:
    table = [round(1000 * (i % 360) ** 0.5) for i in range(1000)]
    progress: list[tuple[int, int]] = []
    await press.load_cam("cam", table, progress=lambda done, total: progress.append((done, total)))
    assert line.data[:1000] == table
    assert progress[0] == (32, 2000)
    assert progress[-1] == (2000, 2000)
    assert progress == sorted(progress)
    assert {priority for _, _, priority in line.log} == {Priority.BACKGROUND}
    assert len(line.asked) == 31 + 8 + 1 + 32
    writes = [options for command, options in zip(line.asked, line.options, strict=True) if "write" in command]
    assert {options.get("idempotent") for options in writes} == {True}


@pytest.mark.asyncio
async def test_a_cam_table_is_loaded_with_another_priority_if_one_is_given(
    press: MscController, line: Controller
) -> None:
    await press.load_cam("cam", range(33), priority=Priority.URGENT)
    assert {priority for _, _, priority in line.log} == {Priority.URGENT}


@pytest.mark.asyncio
@pytest.mark.parametrize(("step", "given"), [(1, 4), (4, 8), (4, 16), (2, 1), (8, 4)])
async def test_a_wrong_address_step_never_verifies(step: int, given: int) -> None:
    """Blocks too far apart leave gaps that reading the same blocks back would not show."""
    line = Controller(size=5000, step=step)
    press = MscController(line, 3, address_step=given)
    with pytest.raises((VerifyFailed, Refused)):
        await press.load_cam(2000, range(1, 101))


# the address step


@pytest.mark.asyncio
@pytest.mark.parametrize("step", [1, 4])
async def test_the_address_step_is_found_on_values_that_differ(step: int) -> None:
    line = Controller(step=step)
    line.data = [3 * i * i for i in range(1200)]
    press = MscController(line, 3, symbols={"table": 2000})
    assert await press.find_address_step("table") == step
    assert await press.read("table", 100) == tuple(line.data[:100])
    assert all(asked.startswith("read") for asked in line.asked)


@pytest.mark.asyncio
@pytest.mark.parametrize(("step", "values"), [(1, [5] * 40), (1, [0, 1, 2, 3, 1, *range(50)]), (2, list(range(40)))])
async def test_values_that_do_not_tell_the_step_leave_it_unknown(step: int, values: list[int]) -> None:
    line = Controller(step=step)
    line.data = values
    press = MscController(line, 3)
    with pytest.raises(InvalidCommand, match="do not show the address step"):
        await press.find_address_step(2000)
    assert press.address_step is None


@pytest.mark.asyncio
async def test_values_that_change_while_the_step_is_searched_leave_it_unknown() -> None:
    line = Controller(step=1)
    line.data = [3 * i * i for i in range(1200)]
    known = line.answer

    def answer(command: Command[Any]) -> Any:
        found = known(command)
        line.data[4] = 7
        return found

    line.answer = answer
    press = MscController(line, 3)
    with pytest.raises(InvalidCommand, match="do not show the address step"):
        await press.find_address_step(2000)
    assert press.address_step is None


# flags and status


@pytest.mark.asyncio
async def test_flags_are_set_cleared_and_read(press: MscController) -> None:
    await press.set_flag(5)
    await press.set_flag(255)
    await press.clear_flag(5)
    assert (await press.flag(5), await press.flag(255)) == (False, True)


@pytest.mark.asyncio
@pytest.mark.parametrize(("model", "exchanges"), [("MSC-250", 1), ("MSC-850/32", 1), ("MSC-850", 256), (None, 256)])
async def test_all_flags_take_one_exchange_where_the_model_can(
    line: Controller, model: str | None, exchanges: int
) -> None:
    line.flags = {0, 9, 255}
    assert await MscController(line, 3, model=model).flags() == {0, 9, 255}
    assert len(line.asked) == exchanges


@pytest.mark.asyncio
async def test_the_status_has_names(press: MscController) -> None:
    assert await press.status() == ProgramStatus.PROGRAM_RUNNING | ProgramStatus.AUTO_START_ENABLED


# points


@pytest.mark.asyncio
async def test_every_item_of_the_command_line_is_a_point(press: MscController, line: Controller) -> None:
    line.data[2] = 1234
    line.flags = {0, 5}
    assert await press.point("2008").read() == await press.point("count").read() == 1234
    assert await press.point("2008:3").read() == (1234, 0, 0)
    assert await press.point("flag:5").read() is True
    assert await press.point("flags").read() == {0, 5}
    assert await press.point("status").read() == 65
    assert press.items() == ("flags", "status")


@pytest.mark.asyncio
async def test_what_may_be_written_is_written_through_its_point(press: MscController, line: Controller) -> None:
    await press.point("count").write(7)
    await press.point("cam:2").write((1, 2))
    await press.point("flag:9").write(True)
    await press.point("flag:8").write(1)
    await press.point("flag:8").write(0)
    assert (line.data[:3], line.flags) == ([1, 2, 7], {9})
    assert press.point("cam:2").writable
    for item in ("flags", "status"):
        assert not press.point(item).writable
    for item, value in (("cam:2", (1,)), ("flag:9", 2), ("flag:9", 0.5), ("count", 1.5)):
        with pytest.raises(InvalidCommand):
            await press.point(item).write(value)


@pytest.mark.parametrize("item", ["", "x", "flag", "flag:", "flag:256", "flag:x", "2008:", "2008:0", "65536", "statu"])
def test_what_is_no_item_is_refused(press: MscController, item: str) -> None:
    with pytest.raises(InvalidCommand):
        press.point(item)


@pytest.mark.asyncio
async def test_a_run_of_more_than_a_block_is_read_and_written_and_cannot_be_polled(
    press: MscController, line: Controller
) -> None:
    point = press.point("cam:100")
    await point.write(tuple(range(100)))
    assert await point.read() == tuple(range(100))
    assert line.asked.count("read 32 values from data 2000") == 1
    assert str(point.command) == "read 100 values from data 2000"
    assert (point.command.writes, point.command.idempotent) == (False, True)
    with pytest.raises(InvalidCommand, match="at most 32 values, not 100"):
        point.command.open(3, press.profile.timings)
    with pytest.raises(InvalidCommand, match="address_step"):
        MscController(line, 4).point("2000:100")


def test_points_are_equal_if_they_ask_the_same(press: MscController) -> None:
    assert press.point("2008:32") == press.point("2008:32")
    assert len({press.point("2008:32"), press.point("2008:32"), press.point("2008:31"), press.point("2008")}) == 3


def test_each_value_of_a_run_has_a_name(press: MscController, line: Controller) -> None:
    assert press._run_items("cam:3", 3) == ("2000", "2004", "2008")
    assert MscController(line, 4)._run_items("2000:2", 2) == ("2000[0]", "2000[1]")


def test_poll_groups_merge_by_what_is_known(line: Controller) -> None:
    press = MscController(line, 3, model="MSC-250")
    commands: list[Command[Any]] = [DataRead(2000), DataRead(2004), ReadFlag(1), ReadFlag(2)]

    def served() -> list[tuple[int, ...]]:
        assert press.node.profile.merge is not None
        return [batch.serves for batch in press.node.profile.merge(commands)]

    assert served() == [(2, 3)]
    press.address_step = 4
    assert served() == [(0, 1), (2, 3)]

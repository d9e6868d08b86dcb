"""MentorDrive over a node that keeps a table of parameters."""

from __future__ import annotations

from typing import Any

import pytest

from busmaster.contract.exchange import Command
from busmaster.errors import InvalidCommand, VerifyFailed
from busmaster.protocols.mentor.codec import CHAINED, PROFILE, Read, ReadRun, Write
from busmaster.protocols.mentor.handle import MentorDrive, from_line, to_line
from tests.handles.fake_bus import FakeBus


class Parameters(FakeBus):
    """Parameters as a drive keeps them: whole numbers; high resolution loses its last digit when read."""

    def __init__(self) -> None:
        super().__init__(self.obey)
        self.table: dict[tuple[int, int], int] = {}

    def obey(self, command: Command[Any]) -> int | tuple[int, ...] | None:
        if isinstance(command, Write):
            number = int(command.text)
            self.table[command.menu, command.number] = int(number / 10) if command.high_resolution else number
            return None
        if isinstance(command, Read):
            return self.table.get((command.menu, command.number), 0)
        assert isinstance(command, ReadRun)
        return tuple(self.table.get((command.menu, command.number + command.step * i), 0) for i in range(command.count))


@pytest.fixture
def line() -> Parameters:
    return Parameters()


@pytest.fixture
def drive(line: Parameters) -> MentorDrive:
    return MentorDrive(line, 14, decimals={"1.17": 1, "01.18": 0})


@pytest.mark.asyncio
async def test_a_value_is_in_the_parameters_own_unit(drive: MentorDrive, line: Parameters) -> None:
    await drive.write("1.17", -47.6)
    assert line.asked == ["write 01.17 = -0476"]  # the guide's example
    assert await drive.read("01.17") == -47.6


@pytest.mark.asyncio
async def test_a_value_of_a_parameter_without_decimals_is_rounded_if_that_is_declared(
    drive: MentorDrive, line: Parameters
) -> None:
    await drive.write("1.18", 2.5)
    assert line.asked == ["write 01.18 = +0003"]


@pytest.mark.asyncio
async def test_high_resolution_adds_a_decimal(drive: MentorDrive, line: Parameters) -> None:
    await drive.write("1.17", 47.65, high_resolution=True)
    assert line.asked == ["write 01.17 = +04765"]
    assert await drive.read("1.17") == 47.6
    assert await drive.point("1.17:hires").read() == 47.6


@pytest.mark.asyncio
async def test_without_decimals_a_value_is_the_number_on_the_line(drive: MentorDrive, line: Parameters) -> None:
    await drive.write("4.26", True)
    await drive.write("2.10", 12)
    await drive.write("2.11", 13.0)
    await drive.write("15.60", 54321, wide=True)
    assert line.asked == ["write 04.26 = 1", "write 02.10 = +0012", "write 02.11 = +0013", "write 15.60 = 54321"]
    bit = await drive.read("4.26")
    assert bit == 1
    assert isinstance(bit, int)


@pytest.mark.asyncio
async def test_a_value_that_does_not_fit_is_refused_before_anything_is_sent(
    drive: MentorDrive, line: Parameters
) -> None:
    for parameter, value in (("2.10", 1.5), ("2.10", 10000), ("1.17", 1000.0), ("1.17", float("nan")), ("1.17", 1e300)):
        with pytest.raises(InvalidCommand):
            await drive.write(parameter, value)
    for wrong in ("117", 1.17, None):
        with pytest.raises(InvalidCommand, match="as text"):
            await drive.write(wrong, 1)  # type: ignore[arg-type]  # a caller without a type checker
    assert line.asked == []


@pytest.mark.asyncio
async def test_a_verified_write_is_read_back(drive: MentorDrive, line: Parameters) -> None:
    await drive.write("1.17", -47.6, verify=True)
    await drive.write("1.17", -47.65, high_resolution=True, verify=True)
    line.answer = lambda command: None if command.writes else 475
    with pytest.raises(VerifyFailed, match=r"node 14: 1\.17 reads 475 after \+0476"):
        await drive.write("1.17", 47.6, verify=True)
    with pytest.raises(VerifyFailed, match=r"reads 475 after \+04765"):
        await drive.write("1.17", 47.65, high_resolution=True, verify=True)
    with pytest.raises(VerifyFailed, match=r"reads 475 after \+04760"):  # an ordinary step, and not its tenths
        await drive.write("1.17", 47.60, high_resolution=True, verify=True)
    await drive.write("1.17", 47.59, high_resolution=True, verify=True)


@pytest.mark.asyncio
async def test_a_run_is_read_singly_or_in_one_exchange(drive: MentorDrive, line: Parameters) -> None:
    line.table = {(1, 17): 476, (1, 18): 5, (1, 19): 7}
    assert await drive.read("1.17", 3) == (47.6, 5, 7)
    assert line.asked == ["read 01.17", "read 01.18", "read 01.19"]
    line.log.clear()
    assert await drive.read("1.17", 3, chain=True) == (47.6, 5, 7)
    assert line.asked == ["read 01.17 to 01.19"]


@pytest.mark.asyncio
async def test_a_run_goes_back_or_stays_where_that_is_asked(drive: MentorDrive, line: Parameters) -> None:
    line.table = {(1, 17): 476, (1, 16): 5, (1, 15): 7}
    assert await drive.read("1.17", 3, step=-1) == (47.6, 5, 7)
    assert line.asked == ["read 01.17", "read 01.16", "read 01.15"]
    line.log.clear()
    assert await drive.read("1.17", 2, step=0) == (47.6, 47.6)
    await drive.read("1.17", 3, step=-1, chain=True)
    assert line.asked == ["read 01.17", "read 01.17", "read 01.17 to 01.15"]
    with pytest.raises(InvalidCommand, match="last parameter number"):
        await drive.read("1.01", 3, step=-1)


@pytest.mark.asyncio
async def test_what_the_guide_calls_wide_is_written_so_by_itself(drive: MentorDrive, line: Parameters) -> None:
    for parameter in ("13.14", "15.60", "15.61", "15.62", "15.63"):
        await drive.write(parameter, 54321)
        await drive.point(parameter).write(7)
    await drive.write_all("15.60", 7)
    assert [command.partition(" = ")[2] for command in line.asked] == ["54321", "00007"] * 5 + ["00007"]
    for parameter in ("13.13", "13.15", "15.59", "15.64"):
        with pytest.raises(InvalidCommand, match="not declared wide"):
            await drive.write(parameter, 54321)
    with pytest.raises(InvalidCommand, match="0 to 65535"):
        await drive.write("15.60", -1)
    await drive.write("15.60", 7, high_resolution=True)
    assert line.asked[-1] == "write 15.60 = +00007"


@pytest.mark.asyncio
async def test_a_parameter_that_the_guide_names_goes_by_its_name(line: Parameters) -> None:
    drive = MentorDrive(line, 14)
    await drive.write("speed_reference_1", -47.6, verify=True)
    assert line.asked == ["write 01.17 = -0476", "read 01.17"]
    assert await drive.read("speed_reference_1") == -47.6
    assert await drive.read("1.17") == -476
    point = drive.point("speed_reference_1")
    assert (point.unit, await point.read()) == ("%", -47.6)
    fine = drive.point("speed_reference_1:hires")
    await fine.write(47.65)
    assert line.asked[-1] == "write 01.17 = +04765"
    assert await fine.read() == 47.6
    assert drive.items() == ("speed_reference_1", "serial_address", "serial_mode")
    with pytest.raises(InvalidCommand, match="did you mean 'speed_reference_1'"):
        drive.point("speed_reference")


def test_declared_decimals_go_before_the_guides_and_must_agree(line: Parameters) -> None:
    drive = MentorDrive(line, 14, decimals={"speed_reference_1": 2})
    assert drive.point("1.17").value_of(4765) == drive.point("speed_reference_1").value_of(4765) == 47.65
    with pytest.raises(InvalidCommand, match=r"01\.17 has 1 decimals by another name, not 2"):
        MentorDrive(line, 14, decimals={"1.17": 1, "01.17": 2})


@pytest.mark.asyncio
async def test_all_drives_are_written_at_address_0(drive: MentorDrive, line: Parameters) -> None:
    await drive.write_all("1.17", 0)
    await MentorDrive(line, 0).write("1.17", 0)
    assert [(address, command) for address, command, _ in line.log] == [(0, "write 01.17 = +0000")] * 2


@pytest.mark.asyncio
async def test_all_drives_are_never_read(line: Parameters) -> None:
    everyone = MentorDrive(line, 0)
    with pytest.raises(InvalidCommand, match="all drives"):
        await everyone.read("1.17")
    with pytest.raises(InvalidCommand, match="all drives"):
        await everyone.read("1.17", 2)
    with pytest.raises(InvalidCommand, match="a write to all cannot be verified"):
        await everyone.write("1.17", 0, verify=True)
    assert line.asked == []


@pytest.mark.asyncio
async def test_items_of_the_command_line_are_points(drive: MentorDrive, line: Parameters) -> None:
    for item in ("1.17", "01.17"):
        await drive.point(item).write(47.6)
        assert await drive.point(item).read() == 47.6
    await drive.point("15.60:wide").write(54321)
    assert await drive.point("15.60:wide").read() == 54321
    run = drive.point("1.17:2")
    assert await run.read() == (47.6, 0)
    assert not run.writable
    assert line.asked == [
        *["write 01.17 = +0476", "read 01.17"] * 2,
        "write 15.60 = 54321",
        "read 15.60",
        "read 01.17 to 01.18",
    ]


@pytest.mark.asyncio
async def test_a_high_resolution_point_reads_in_the_unit_in_which_it_is_written(
    drive: MentorDrive, line: Parameters
) -> None:
    point = drive.point("2.10:hires")
    await point.write(4765)
    [send] = drive._prepare_write("2.10:hires", [4766])
    await send()
    assert line.asked == ["write 02.10 = +04765", "write 02.10 = +04766"]
    assert await point.read() == 4760


@pytest.mark.parametrize("item", ["117", "1.17:", "1.17:narrow", "1.17:0", "1.17:84", "1.17:-1", "speed", ""])
def test_other_items_do_not_exist(drive: MentorDrive, item: str) -> None:
    with pytest.raises(InvalidCommand):
        drive.point(item)


@pytest.mark.parametrize("address", [1, 9, 10, 90])
def test_an_address_that_later_products_take_for_a_group_warns(line: Parameters, address: int) -> None:
    with pytest.warns(UserWarning, match="mean groups to later"):
        MentorDrive(line, address)


@pytest.mark.parametrize("address", [0, 11, 99])
def test_other_addresses_do_not(line: Parameters, address: int) -> None:
    MentorDrive(line, address)


def test_runs_in_poll_groups_are_opted_into(line: Parameters) -> None:
    assert MentorDrive(line, 14).node.profile is PROFILE
    assert MentorDrive(line, 15, chained=True).node.profile is CHAINED


@pytest.mark.parametrize(
    ("value", "decimals", "number"),
    [(47.65, 1, 477), (-47.65, 1, -477), (47.65, 2, 4765), (5, 0, 5), (0.1 + 0.2, 1, 3), (7, None, 7)],
)
def test_a_value_rounds_half_away_from_zero_to_its_decimals(value: float, decimals: int | None, number: int) -> None:
    assert to_line(value, decimals) == number


@pytest.mark.parametrize("number", [-9999, -1, 0, 1, 476, 65535])
@pytest.mark.parametrize("decimals", [None, 0, 1, 2, 3])
def test_every_number_on_the_line_comes_back(number: int, decimals: int | None) -> None:
    assert to_line(from_line(number, decimals), decimals) == number

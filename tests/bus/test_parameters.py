"""Parameter sets through handles: saved, compared, loaded and undone on emulated devices, in virtual time."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from math import inf

import pytest

from busmaster import Bus, Dc104Drive, InvalidCommand, MemoryPort, MentorDrive, ModbusUnit, NoReply, NotStarted, Point
from busmaster.bus.handle import Handle, Send
from busmaster.bus.node import Node, Priority
from busmaster.bus.parameters import FIRST, LAST, Change, Entry, Found, Parameter, ParameterLoad, ParameterSet, Result
from busmaster.emulator.device import Device
from busmaster.emulator.faults import Faults
from busmaster.emulator.line import Line
from busmaster.protocols.dc104.device import READ, EmulatedDc104
from busmaster.protocols.ei_bisynch.handle import BisynchInstrument
from busmaster.protocols.mentor.device import EmulatedMentor
from busmaster.protocols.modbus.device import EmulatedModbus
from busmaster.registry import find, make_device
from busmaster.wire.checks import sum8
from tests.stories import in_virtual_time


class OddDrive(EmulatedDc104):
    """A drive with parameters that behave in an unusual way, each named in one of these sets."""

    no_read: frozenset[int] = frozenset()
    """They do not reply to a read."""
    halved: frozenset[int] = frozenset()
    """They store half of a value that is written."""
    no_ack: frozenset[int] = frozenset()
    """They store a value, but do not acknowledge it."""
    lost: frozenset[int] = frozenset()
    """They neither store nor acknowledge the next value."""
    ignored: frozenset[int] = frozenset()
    """They acknowledge a value, but keep the one before."""
    writes = 0

    def _handle(self, frame: bytes, now: float) -> None:
        parameter, value = frame[2], int.from_bytes(frame[3:5], "big")
        if frame[1] == READ and parameter in self.no_read:
            return
        if frame[1] != READ:
            self.writes += 1
            if parameter in self.lost:
                self.lost -= {parameter}
                return
            if parameter in self.ignored:
                frame = frame[:3] + self.registers[parameter].to_bytes(2, "big") + frame[5:-1]
                frame += bytes((sum8(frame[1:]),))
            if parameter in self.no_ack:
                self._write(parameter, value)
                return
        super()._handle(frame, now)

    def _write(self, parameter: int, value: int) -> None:
        super()._write(parameter, value // 2 if parameter in self.halved else value)


def bus_of(handle: type[Handle], *devices: Device) -> Bus:
    return Bus(MemoryPort(Line(handle.profile.line, devices, chance=random.Random(1))))


def changed(one: ParameterSet, **values: float) -> ParameterSet:
    entries = {item: Entry(entry.parameter, values.get(f"p{item}", entry.value)) for item, entry in one.entries.items()}
    return ParameterSet(protocol=one.protocol, address=one.address, saved=one.saved, entries=entries)


async def written(load: ParameterLoad) -> list[Result]:
    return [outcome.result async for outcome in load.write()]


@in_virtual_time
async def test_a_set_is_saved_loaded_and_undone_though_two_in_a_hundred_replies_are_lost() -> None:
    device = EmulatedDc104()
    device.faults = Faults(lost=0.02)
    async with bus_of(Dc104Drive, device) as bus:
        drive = Dc104Drive(bus)
        saved = await drive.save_parameters()
        assert len(saved.entries) == 255
        load = await drive.prepare_load(changed(saved, p5=7, p9=8))
        assert await written(load) == [Result.WRITTEN] * 2
        assert (device.registers[5], device.registers[9], load.equal) == (7, 8, 253)
        assert await written(await drive.prepare_load(load.undo)) == [Result.WRITTEN] * 2
        assert drive.differences(saved, await drive.save_parameters()) == ()


@in_virtual_time
async def test_a_refusal_is_reported_and_the_others_are_written() -> None:
    device = EmulatedDc104(read_only=frozenset({5}))
    async with bus_of(Dc104Drive, device) as bus:
        drive = Dc104Drive(bus)
        saved = await drive.save_parameters(drive.parameters(["4:3"]))
        load = await drive.prepare_load(changed(saved, p5=7, p6=8))
        assert await written(load) == [Result.REFUSED, Result.WRITTEN]


@in_virtual_time
async def test_gaps_are_left_out_and_the_address_of_a_drive_is_never_written() -> None:
    async with bus_of(MentorDrive, EmulatedMentor(11)) as bus:
        drive = MentorDrive(bus, 11, decimals={"1.17": 1})
        found: list[Found] = []
        saved = await drive.save_parameters(drive.parameters(["1.15:4", "11.11"]), progress=found.append)
        assert {one.parameter.item: one.why for one in found if one.gap} == dict.fromkeys(
            ("1.15", "1.16"), "no such parameter"
        )
        assert list(saved.entries) == ["1.17", "1.18", "11.11"]
        wanted = changed(saved, **{"p1.18": 3, "p11.11": 12})
        load = await drive.prepare_load(wanted)
        assert [change.parameter.item for change in load.changes] == ["1.18"]
        assert [left.parameter.item for left in load.left] == ["11.11"]


@in_virtual_time
async def test_each_parameter_that_is_not_read_is_reported_with_its_reason_and_the_others_are_saved() -> None:
    device = OddDrive(maximum=6)
    device.no_read = frozenset({4})
    found: list[Found] = []
    async with bus_of(Dc104Drive, device) as bus:
        drive = Dc104Drive(bus, retries=0)
        saved = await drive.save_parameters(drive.parameters(["3:6"]), progress=found.append, by="ada")
    assert (list(saved.entries), saved.by) == (["3", "5", "6"], "ada")
    assert [(one.parameter.item, one.gap) for one in found] == [
        ("3", False),
        ("4", False),
        ("5", False),
        ("6", False),
        ("7", True),
        ("8", True),
    ]
    assert found[1].why == "no reply within 200 ms, though the node replies to other reads"
    assert found[4].why


@in_virtual_time
async def test_a_read_without_a_reply_is_repeated_while_the_node_replies_to_its_probe() -> None:
    device = OddDrive()
    device.no_read = frozenset({4})
    async with bus_of(Dc104Drive, device) as bus:
        drive = Dc104Drive(bus, retries=0)
        await drive.save_parameters([Parameter(item="4")])
        # Three rounds, each of one read and one probe.
        assert Node.of(drive).statistics().attempts == 6
        device.faults = Faults(dead=1.0)
        with pytest.raises(NoReply):
            await drive.save_parameters([Parameter(item="4"), Parameter(item="5")])
        assert Node.of(drive).statistics().attempts == 8  # of a dead node one read and one probe


@in_virtual_time
async def test_neighbouring_parameters_are_read_in_one_exchange_and_by_themselves_where_one_does_not_exist() -> None:
    async with bus_of(ModbusUnit, EmulatedModbus(17, range(100, 110))) as bus:
        unit = ModbusUnit(bus, 17)
        saved = await unit.save_parameters(unit.parameters(["holding:0:10"]))
        assert {item: entry.value for item, entry in saved.entries.items()} == {
            f"holding:{place}": 100 + place for place in range(10)
        }
        assert Node.of(unit).statistics().attempts == 1
        beyond = await unit.save_parameters(unit.parameters(["holding:7:5"]))
        assert [(item, entry.value) for item, entry in beyond.entries.items()] == [
            ("holding:7", 107),
            ("holding:8", 108),
            ("holding:9", 109),
        ]


@in_virtual_time
async def test_a_parameter_is_saved_as_one_finite_number() -> None:
    device, found = make_device("modbus", 17), list[Found]()
    for item, value in (("holding:0:float32", inf), ("holding:2:float32", 0.5), ("coil:0", 1)):
        device.preset(item, value)
    async with bus_of(ModbusUnit, device) as bus:
        items = ("holding:0:float32", "holding:2:float32", "coil:0")
        saved = await ModbusUnit(bus, 17).save_parameters(
            [Parameter(item=item) for item in items], progress=found.append
        )
    assert {item: entry.value for item, entry in saved.entries.items()} == {"holding:2:float32": 0.5, "coil:0": True}
    assert saved.entries["coil:0"].value is True, "a bit, and not the number 1"
    [left] = [one for one in found if one.value is None]
    assert (left.why, left.gap) == ("it holds inf, which is not one finite number", False)


@in_virtual_time
async def test_a_set_names_the_node_its_line_and_what_identifies_it() -> None:
    async with bus_of(BisynchInstrument, make_device("ei-bisynch", 1)) as bus:
        instrument = BisynchInstrument(bus, 1)
        Node.of(instrument)._rename("oven")
        saved = await instrument.save_parameters([])
        assert (saved.protocol, saved.address, saved.label) == ("ei-bisynch", 1, "oven")
        assert saved.line == bus.endpoint.name
        assert saved.identity == {item: await instrument.read(item) for item in ("II", "V0")}


@pytest.mark.parametrize("kind", ["hcp2", "microflex"])
@in_virtual_time
async def test_the_firmware_identifies_a_controller_or_a_drive_with_hcp2(kind: str) -> None:
    handle = find(kind).handle
    async with bus_of(handle, make_device(kind, 7, firmware=5300)) as bus:
        assert (await handle(bus, 7).save_parameters([])).identity == {"firmware": 5300}


@in_virtual_time
async def test_sets_of_different_kinds_of_node_are_neither_compared_nor_loaded() -> None:
    async with bus_of(Dc104Drive, EmulatedDc104()) as bus:
        drive = Dc104Drive(bus)
        own = await drive.save_parameters([Parameter(item="4")])
        other = replace(own, protocol="mentor")
        for pair in ((own, other), (other, own)):
            with pytest.raises(InvalidCommand, match="a set of a mentor cannot be compared with one of a dc104"):
                drive.differences(*pair)
        with pytest.raises(InvalidCommand, match=f"{drive.node.label} is a dc104: a set of a mentor is not for it"):
            await drive.prepare_load(other)


@in_virtual_time
async def test_a_parameter_that_one_of_two_sets_does_not_have_differs() -> None:
    async with bus_of(Dc104Drive, EmulatedDc104()) as bus:
        drive = Dc104Drive(bus)
        saved = await drive.save_parameters(drive.parameters(["4:3"]))
    first = replace(saved, entries={item: saved.entries[item] for item in ("4", "5")})
    second = changed(replace(saved, entries={item: saved.entries[item] for item in ("5", "6")}), p5=9)
    assert [(one.parameter.item, one.one, one.other) for one in drive.differences(first, second)] == [
        ("4", 0, None),
        ("5", 0, 9),
        ("6", None, 0),
    ]


@in_virtual_time
async def test_a_load_states_why_it_does_not_write_a_parameter() -> None:
    async with bus_of(Dc104Drive, OddDrive(maximum=8)) as bus:
        drive = Dc104Drive(bus)
        saved = await drive.save_parameters(drive.parameters(["3:5"]))
        drive.point("4").limit(maximum=50)
        drive.point("5").limit(maximum=50)
        wanted = changed(saved, p3=7, p4=51, p5=50, p6=7, p7=7)
        wanted.entries["9"] = Entry(Parameter(item="9"), 7)  # type: ignore[index]  # a dictionary
        described = [Parameter(item="6", access="read"), Parameter(item="7", kept="it is the address")]
        load = await drive.prepare_load(wanted, parameters=described, by="ada")
        assert [(change.parameter.item, change.before, change.value) for change in load.changes] == [
            ("3", 0, 7),
            ("5", 0, 50),
        ]
        left = {one.parameter.item: (one.before, one.value, one.why, one.expected) for one in load.left}
        assert left["4"][2:] == (f"{drive.node.label}: 4 = 51 is above its maximum of 50", False)
        assert left["6"] == (0, 7, "it is read-only", True)
        assert left["7"] == (0, 7, "it is the address", True)
        assert (left["9"][:2], left["9"][3]) == ((None, 7), False)
        assert {item: entry.value for item, entry in load.undo.entries.items()} == {"3": 0, "5": 0}
        assert load.undo.by == "ada"


@in_virtual_time
async def test_a_load_writes_in_the_order_of_the_document_except_what_must_be_first_or_last() -> None:
    async with bus_of(Dc104Drive, EmulatedDc104()) as bus:
        drive = Dc104Drive(bus)
        saved = await drive.save_parameters([Parameter(item=item) for item in ("6", "5", "4", "3")])
        described = [Parameter(item="3", stage=LAST), Parameter(item="6", stage=FIRST)]
        load = await drive.prepare_load(changed(saved, p3=1, p4=1, p5=1, p6=1), parameters=described)
        assert [change.parameter.item for change in load.changes] == ["6", "4", "5", "3"]
        saved = await drive.save_parameters([Parameter(item="4"), Parameter(item="5")])


async def outcomes(device: EmulatedDc104, *items: int, retries: int | None = None) -> tuple[list[Result], list[str]]:
    """The results and reasons of a load that writes 100 to each of these parameters."""
    async with bus_of(Dc104Drive, device) as bus:
        drive = Dc104Drive(bus, retries=retries)
        saved = await drive.save_parameters([Parameter(item=str(item)) for item in items])
        load = await drive.prepare_load(changed(saved, **{f"p{item}": 100 for item in items}))
        found = [outcome async for outcome in load.write()]
    return [one.result for one in found], [one.why for one in found]


@in_virtual_time
async def test_a_value_that_is_stored_differently_is_reported_and_the_others_are_written() -> None:
    device = OddDrive()
    device.halved = frozenset({4})
    results, reasons = await outcomes(device, 3, 4, 5)
    assert results == [Result.WRITTEN, Result.DIFFERS, Result.WRITTEN]
    assert reasons == ["", "it reads 50 after 100 was written", ""]
    assert device.writes == 3


@in_virtual_time
async def test_a_write_without_an_acknowledgement_is_decided_by_the_value_that_is_read_back() -> None:
    device = OddDrive()
    device.no_ack = frozenset({4})
    assert await outcomes(device, 3, 4, 5, retries=0) == ([Result.WRITTEN] * 3, [""] * 3)
    assert device.writes == 3
    device = OddDrive()
    device.lost = frozenset({4})
    assert await outcomes(device, 3, 4, 5, retries=0) == ([Result.WRITTEN] * 3, [""] * 3)
    assert (device.writes, device.registers[4]) == (4, 100)


@in_virtual_time
async def test_an_acknowledged_write_that_is_not_stored_is_reported_and_not_repeated() -> None:
    device = OddDrive()
    device.ignored = frozenset({4})
    results, reasons = await outcomes(device, 3, 4, 5)
    assert results == [Result.WRITTEN, Result.DIFFERS, Result.WRITTEN]
    assert reasons[1] == "it reads 0 after 100 was written"
    assert device.writes == 3


@in_virtual_time
async def test_a_repeated_write_that_is_acknowledged_and_not_stored_is_reported_and_not_repeated_again() -> None:
    device = OddDrive()
    device.lost = device.ignored = frozenset({4})
    results, reasons = await outcomes(device, 3, 4, 5, retries=0)
    assert results == [Result.WRITTEN, Result.DIFFERS, Result.WRITTEN]
    assert reasons[1] == "it reads 0 after 100 was written"
    assert device.writes == 4


@in_virtual_time
async def test_values_that_differ_only_by_the_conversion_of_a_unit_are_equal() -> None:
    async with bus_of(ModbusUnit, make_device("modbus", 17)) as bus:
        saved = await ModbusUnit(bus, 17).save_parameters([Parameter(item="holding:0:float64")])
    one, other, third = (changed(saved, **{"pholding:0:float64": value}) for value in (0.3, 0.1 + 0.2, 0.3000001))
    assert ModbusUnit.differences(one, other) == ()
    assert len(ModbusUnit.differences(one, third)) == 1


@in_virtual_time
async def test_reads_and_writes_of_a_load_go_in_the_background_of_other_traffic() -> None:
    async with bus_of(Dc104Drive, EmulatedDc104()) as bus:
        drive = Dc104Drive(bus)
        saved = await drive.save_parameters([Parameter(item="4")])
        assert await written(await drive.prepare_load(changed(saved, p4=7))) == [Result.WRITTEN]
        waits = (await bus.statistics()).waits
        assert (waits[Priority.BACKGROUND].count, waits[Priority.COMMAND].count) == (4, 0)


@in_virtual_time
async def test_a_node_that_refuses_its_probe_replies() -> None:
    device = OddDrive()
    device.parameters = range(2, 256)
    device.no_read = frozenset({4})
    found: list[Found] = []
    async with bus_of(Dc104Drive, device) as bus:
        drive = Dc104Drive(bus, retries=0)
        saved = await drive.save_parameters([Parameter(item="4"), Parameter(item="5")], progress=found.append)
    assert list(saved.entries) == ["5"]
    assert found[0].why.endswith("though the node replies to other reads")


@in_virtual_time
async def test_of_reads_that_overlap_the_largest_serves() -> None:
    async with bus_of(ModbusUnit, EmulatedModbus(17, range(100, 110))) as bus:
        unit = ModbusUnit(bus, 17)
        usual = unit.node.profile.merge
        assert usual is not None
        unit.node.merge_reads(lambda commands: [*usual(commands[:2]), *usual(commands)])
        saved = await unit.save_parameters(unit.parameters(["holding:0:4"]))
        assert [entry.value for entry in saved.entries.values()] == [100, 101, 102, 103]
        assert Node.of(unit).statistics().attempts == 1


@in_virtual_time
async def test_nothing_is_written_after_a_write_whose_outcome_is_unknown() -> None:
    class Vanishing(OddDrive):
        def _write(self, parameter: int, value: int) -> None:
            super()._write(parameter, value)
            self.faults.dead = float(parameter == 4)

    device = Vanishing()
    results, reasons = await outcomes(device, 3, 4, 5, 6, retries=0)
    assert results == [Result.WRITTEN, Result.UNCONFIRMED, Result.NOT_WRITTEN, Result.NOT_WRITTEN]
    assert reasons[1].startswith("sent, and not answered: ")
    assert reasons[2:] == ["nothing is written after 4, whose write did not succeed"] * 2
    assert (device.registers[5], device.registers[6]) == (0, 0)


@in_virtual_time
async def test_nothing_is_written_after_a_write_that_cannot_be_sent_and_each_is_within_its_context() -> None:
    seen: list[str] = []

    @contextmanager
    def recorded(change: Change) -> Iterator[None]:
        seen.append(change.parameter.item)
        try:
            yield
        except NotStarted:
            seen.append("not started")
            raise

    async with bus_of(Dc104Drive, EmulatedDc104()) as bus:
        drive = Dc104Drive(bus)

        def prepare(change: Change, item: str) -> Send:
            async def send() -> None:
                if item == "4":
                    raise NotStarted("not in time")
                await drive.write(int(item), int(change.value))

            return send

        saved = await drive.save_parameters(drive.parameters(["3:3"]))
        load = await drive.prepare_load(changed(saved, p3=1, p4=1, p5=1), prepare=prepare)
        found = [outcome async for outcome in load.write(around=recorded)]
    assert [one.result for one in found] == [Result.WRITTEN, Result.NOT_WRITTEN, Result.NOT_WRITTEN]
    assert [one.why for one in found][1] == "not in time"
    assert seen == ["3", "4", "not started"]


@in_virtual_time
async def test_a_value_that_cannot_be_read_back_is_unconfirmed() -> None:
    class Hiding(OddDrive):
        def _write(self, parameter: int, value: int) -> None:
            super()._write(parameter, value)
            self.no_read = frozenset({4} if parameter == 4 else ())

    results, reasons = await outcomes(Hiding(), 4, 5, retries=0)
    assert results == [Result.UNCONFIRMED, Result.NOT_WRITTEN]
    assert reasons[0].startswith("it cannot be read back: no reply within")


class LosesRuns(EmulatedModbus):
    """A unit that replies to reads of one register only."""

    def _read(self, function: int, first: int, count: int, now: float) -> bytes:
        self.silent = count > 1
        return super()._read(function, first, count, now)

    def _reply(self, answer: bytes, now: float) -> None:
        if not self.silent:
            super()._reply(answer, now)


@in_virtual_time
async def test_parameters_are_read_one_by_one_if_a_merged_read_has_no_reply_and_the_node_replies_to_its_probe() -> None:
    async with bus_of(ModbusUnit, LosesRuns(17, range(100, 110))) as bus:
        unit = ModbusUnit(bus, 17, retries=0)
        saved = await unit.save_parameters(unit.parameters(["holding:2:3"]))
        assert [(item, entry.value) for item, entry in saved.entries.items()] == [
            ("holding:2", 102),
            ("holding:3", 103),
            ("holding:4", 104),
        ]


@in_virtual_time
async def test_each_of_hundreds_of_merged_parameters_has_its_own_value() -> None:
    found: list[Found] = []
    async with bus_of(ModbusUnit, EmulatedModbus(17, range(1000, 1300))) as bus:
        unit = ModbusUnit(bus, 17)
        saved = await unit.save_parameters(unit.parameters(["holding:0:300"]), progress=found.append)
        assert Node.of(unit).statistics().attempts <= 8
    assert {item: entry.value for item, entry in saved.entries.items()} == {
        f"holding:{place}": 1000 + place for place in range(300)
    }
    assert sorted(one.parameter.item for one in found) == sorted(saved.entries)


@in_virtual_time
async def test_a_value_that_cannot_be_decoded_is_not_a_parameter_that_the_node_lacks() -> None:
    class Coded(Dc104Drive):
        def point(self, item: str) -> Point[int]:
            def decode(raw: int) -> int:
                raise ValueError("not a code")

            return replace(super().point(item), decode=decode)

    found: list[Found] = []
    async with bus_of(Dc104Drive, EmulatedDc104()) as bus:
        saved = await Coded(bus).save_parameters([Parameter(item="4")], progress=found.append)
    assert (dict(saved.entries), [(one.value, one.gap) for one in found]) == ({}, [(None, False)])
    assert found[0].why == "0 is not a value of 4: not a code"


@in_virtual_time
async def test_a_garbled_reply_to_one_parameter_is_reported_and_the_others_are_saved() -> None:
    class Garbling(OddDrive):
        def _handle(self, frame: bytes, now: float) -> None:
            self.faults.flip = float(frame[2] == 4)
            super()._handle(frame, now)

    found: list[Found] = []
    async with bus_of(Dc104Drive, Garbling()) as bus:
        saved = await Dc104Drive(bus, retries=0).save_parameters(
            [Parameter(item=item) for item in ("3", "4", "5")], progress=found.append
        )
    assert list(saved.entries) == ["3", "5"]
    assert "though the node replies to other reads" in found[1].why


@in_virtual_time
async def test_a_set_has_the_time_in_utc_and_only_the_identity_that_the_node_has() -> None:
    class Anonymous(Dc104Drive):
        _identity = ("3", "7")

    before = datetime.now(UTC).replace(microsecond=0)
    async with bus_of(Dc104Drive, EmulatedDc104(maximum=6)) as bus:
        saved = await Anonymous(bus).save_parameters([])
    assert saved.identity == {"3": 0}
    assert before <= saved.saved <= datetime.now(UTC)
    assert (saved.saved.utcoffset(), saved.saved.microsecond) == (timedelta(0), 0)


@in_virtual_time
async def test_parameters_that_the_document_does_not_list_are_written_after_those_that_it_lists() -> None:
    class Short(Dc104Drive):
        def _listed(self) -> list[Parameter]:
            return [Parameter(item=item) for item in ("5", "3")]

    async with bus_of(Dc104Drive, EmulatedDc104()) as bus:
        drive = Short(bus)
        saved = await drive.save_parameters([Parameter(item=item) for item in ("4", "3", "2", "5")])
        load = await drive.prepare_load(changed(saved, p2=1, p3=1, p4=1, p5=1))
        assert [change.parameter.item for change in load.changes] == ["5", "3", "4", "2"]


@in_virtual_time
async def test_a_limit_that_is_set_after_a_load_was_prepared_refuses_its_write_and_the_others_are_written() -> None:
    async with bus_of(Dc104Drive, EmulatedDc104()) as bus:
        drive = Dc104Drive(bus)
        saved = await drive.save_parameters(drive.parameters(["3:3"]))
        load = await drive.prepare_load(changed(saved, p3=7, p4=51, p5=7))
        drive.point("4").limit(maximum=50)
        found = [outcome async for outcome in load.write()]
    assert [one.result for one in found] == [Result.WRITTEN, Result.REFUSED, Result.WRITTEN]
    assert found[1].why.endswith("4 = 51 is above its maximum of 50")


@in_virtual_time
async def test_an_acknowledged_write_that_could_not_be_read_back_is_unconfirmed() -> None:
    class Vanishing(OddDrive):
        def _handle(self, frame: bytes, now: float) -> None:
            if frame[1] == READ and self.registers[4]:
                self.faults.dead = 1.0
            super()._handle(frame, now)

    results, reasons = await outcomes(Vanishing(), 3, 4, 5, retries=0)
    assert results == [Result.WRITTEN, Result.UNCONFIRMED, Result.NOT_WRITTEN]
    assert reasons[1].startswith("acknowledged, but not read back: ")


def test_parameters_are_counted_each_once_and_known_by_any_form_of_their_item() -> None:
    drive = MentorDrive(Bus(MemoryPort(Line(MentorDrive.profile.line))), 11)
    listed = {one.item: one for one in drive.parameters()}
    assert drive.parameters(["1.1", "1.01:2"]) == (listed["1.01"], listed["1.02"])
    with pytest.raises(InvalidCommand, match="modbus: this protocol documents no list of parameters: name the items"):
        ModbusUnit(Bus(MemoryPort(Line(ModbusUnit.profile.line))), 17).parameters()


@pytest.mark.slow
def test_a_set_has_a_bounded_number_of_parameters() -> None:
    unit = ModbusUnit(Bus(MemoryPort(Line(ModbusUnit.profile.line))), 17)
    assert len(unit.parameters(["coil:0:20000"])) == 20_000
    with pytest.raises(InvalidCommand, match="a parameter set has 20000 parameters at most"):
        unit.parameters(["coil:0:20000", "coil:20000"])
    with pytest.raises(InvalidCommand, match="the count of coil:0"):
        unit.parameters(["coil:0:20001"])

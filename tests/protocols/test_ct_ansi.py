"""CT-ANSI with decimal points: frames that the UD70 and UD78 guides print, and those of x328."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from busmaster import Bus, CtAnsiDrive, InvalidCommand, MemoryPort, NoSuchParameter, Refused, VerifyFailed
from busmaster.contract.exchange import Done, FrameError
from busmaster.contract.frames import Kind
from busmaster.emulator.line import Line
from busmaster.protocols.ct_ansi.codec import PROFILE, Read, ReadRun, Write
from busmaster.protocols.ct_ansi.device import EmulatedCtAnsi
from busmaster.registry import find
from busmaster.testing import Case, RoundTrip, answers_of, check_protocol
from busmaster.testing.virtual_time import run_in_virtual_time
from tests.capture.hearing import hear, said
from tests.emulator.lines import ask, line_of

ACK, NAK, EOT = b"\x06", b"\x15", b"\x04"
UD70_REPLY = bytes.fromhex("02 30 31 32 31 2D 34 37 2E 36 03 37")  # 01.21 = -47.6, as the UD70 guide prints it


def parameter_named(command: Any, address: int) -> object:
    """A telegram names its parameter and no drive."""
    return "ACK" if command.writes else (command.menu, command.number)


def test_ct_ansi_keeps_the_contract() -> None:
    second = bytes.fromhex("02 30 31 32 32 35 03 37")
    check_protocol(
        PROFILE,
        [
            Case(Read(1, 21), 12, [UD70_REPLY], -47.6, request=bytes.fromhex("04 31 31 32 32 30 31 32 31 05")),
            Case(Read(12, 34), 43, [bytes.fromhex("02 31 32 33 34 31 32 33 34 35 03 36")], 12345),
            Case(Read(17, 23), 12, [EOT], raises=NoSuchParameter),
            Case(Read(1, 19), 12, [NAK], raises=Refused),
            Case(ReadRun(1, 21, 2), 12, [UD70_REPLY, second], (-47.6, 5)),
            Case(
                Write(1, 25, -34.5),
                12,
                [ACK],
                request=bytes.fromhex("04 31 31 32 32 02 30 31 32 35 2D 33 34 2E 35 03 34"),
            ),
            Case(Write(12, 34, 56), 43, [ACK], request=bytes.fromhex("04 34 34 33 33 02 31 32 33 34 2B 35 36 03 2F")),
            Case(Write(1, 21, 9999), 14, [NAK], raises=Refused),
            Case(Write(1, 21, 0.0), 0, []),
        ],
        names=parameter_named,
        invalid=[
            lambda: Read(100, 1),
            lambda: Write(1, 100, 0),
            lambda: Write(1, 21, math.nan),
            lambda: Write(1, 21, 1e12),
            lambda: Write(1, 21, -99999999999.5),
            lambda: Write(1, 21, 123456789012),
            lambda: Write(1, 21, "1"),  # type: ignore[arg-type]  # that is what is refused
            lambda: Read(1, 17).open(0, PROFILE.timings),
        ],
        round_trips=[
            RoundTrip(14, lambda value: Write(1, 21, value), Read(1, 21), [i / 10 for i in range(-1000, 1001, 7)]),
            RoundTrip(14, lambda value: Write(15, 60, value), Read(15, 60), [0, 9999, 10000, 65535]),
            RoundTrip(14, lambda value: Write(4, 26, value), Read(4, 26), [True, False]),
        ],
        device=answers_of(EmulatedCtAnsi(14)),
    )


def reply_with(data: str) -> bytes:
    """Return the reply of a drive that sends these characters as the value of 01.21."""
    covered = b"0121" + data.encode() + b"\x03"
    check = 0
    for byte in covered:
        check ^= byte
    return b"\x02" + covered + bytes((check if check >= 0x20 else check + 0x20,))


@pytest.mark.parametrize(
    ("data", "value"),
    [
        ("-47.6", -47.6),
        ("-0047.6", -47.6),
        ("+0476", 476),
        ("  12.5", 12.5),
        ("5", 5),
        ("5.", 5.0),
        (".5", 0.5),
        ("X1F", 31),
        ("-1234567.891", -1234567.891),
    ],
)
def test_data_have_a_decimal_point_or_none(data: str, value: float) -> None:
    step = Read(1, 21).open(12, PROFILE.timings).feed(reply_with(data))
    assert step == Done(value)
    assert isinstance(step, Done)
    assert type(step.value) is type(value)


@pytest.mark.parametrize(
    "data", ["12.5.7", "1 2", "12 ", "-47.6-", "--5", "+ 5", "5A", ".", "-", "", " ", "X", "X1G", "X1F ", "-X1F"]
)
def test_data_of_which_only_a_part_is_a_number_are_no_value(data: str) -> None:
    for command in (Read(1, 21), ReadRun(1, 21, 2)):
        with pytest.raises(FrameError, match=re.escape(f"{data.encode()!r} is not a number")):
            command.open(12, PROFILE.timings).feed(reply_with(data))


@pytest.mark.parametrize(
    ("value", "text"),
    [(-47.6, "-47.6"), (5, "+5"), (5.0, "+5"), (-0.0, "+0"), (100, "+100"), (0.001, "+0.001"), (1e6, "+1000000")],
)
def test_a_value_is_written_shortest_exact(value: float, text: str) -> None:
    assert Write(1, 21, value).text == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (44.400000000000006, "+44.4"),
        (-0.1 - 0.2, "-0.3"),
        (0.12345678901, "+0.123456789"),
        (-0.1234567895, "-0.12345679"),  # half away from zero
        (1 / 3, "+0.333333333"),
        (123456789.25, "+123456789.3"),
        (12345678901.5, "+12345678902"),
        (-9999999999.96, "-10000000000"),
        (1e-17, "+0"),
    ],
)
def test_a_value_with_too_many_decimals_is_rounded_to_those_that_fit(value: float, text: str) -> None:
    write = Write(1, 21, value)
    assert write.text == text
    assert write.changes(PROFILE) == {(1, 21): float(text)}
    assert write.rounded == f"write 01.21 = {text} is rounded from {value!r}, which has more digits than a telegram"


@pytest.mark.parametrize("value", [44.4, -47.6, 5, True, 0.0, 123456789.5, 0.123456789])
def test_a_value_that_fits_is_not_rounded(value: float) -> None:
    assert Write(1, 21, value).rounded == ""
    assert float(Write(1, 21, value).text) == value


def test_a_rounded_write_is_logged_once_for_each_parameter(caplog: pytest.LogCaptureFixture) -> None:
    async def story(drive: CtAnsiDrive) -> None:
        for value in (44.400000000000006, 44.400000000000006, 44.4):
            await drive.write("1.21", value, verify=True)
        await drive.point("1.22").write(0.1 + 0.2)
        assert await drive.read("1.21", 2) == (44.4, 0.3)

    told(story)
    logged = [record.getMessage() for record in caplog.records if "rounded" in record.getMessage()]
    assert [text.partition("node 12: ")[2].partition(" is")[0] for text in logged] == [
        "write 01.21 = +44.4",
        "write 01.22 = +0.3",
    ]
    assert "rounded from 44.400000000000006" in logged[0]


@pytest.mark.parametrize(("menu", "number"), [(0, 0), (99, 99)])
def test_menus_and_their_parameters_go_from_0_to_99(menu: int, number: int) -> None:
    for command in (Read(menu, number), Write(menu, number, 5)):
        assert b"%02d%02d" % (menu, number) in command.open(12, PROFILE.timings).request


def told(story: Callable[[CtAnsiDrive], Coroutine[Any, Any, None]], **options: Any) -> None:
    async def main() -> None:
        async with Bus(MemoryPort(Line(PROFILE.line, [EmulatedCtAnsi(12), EmulatedCtAnsi(13)]))) as bus:
            await story(CtAnsiDrive(bus, 12, **options))

    run_in_virtual_time(main())


def test_values_are_read_and_written_in_their_own_unit() -> None:
    async def story(drive: CtAnsiDrive) -> None:
        await drive.write("1.21", -47.64, verify=True)  # one decimal is declared
        assert await drive.read("1.21") == -47.6
        await drive.point("1.22").write(12.5)
        assert await drive.read("1.21", 2) == await drive.read("1.21", 2, chain=True) == (-47.6, 12.5)
        for chain in (False, True):
            assert await drive.read("1.22", 2, step=-1, chain=chain) == (12.5, -47.6)
        assert await drive.point("1.21:2").read() == (-47.6, 12.5)
        assert await drive._read_item("1.21:2") == (-47.6, 12.5)
        with pytest.raises(NoSuchParameter):
            await drive.read("17.23")
        with pytest.raises(Refused):
            await drive.write("1.21", 100.1)
        with pytest.raises(Refused):
            await drive.write("1.22", 1.25)  # finer than the parameter, and no decimals declared
        everyone = CtAnsiDrive(drive.bus, 0)
        await everyone.write("1.23", 1.5)
        assert await drive.read("1.23") == 1.5

    told(story, decimals={"1.21": 1})


@pytest.mark.parametrize(
    ("value", "text"), [(47.65, "+47.7"), (-47.65, "-47.7"), (0.25, "+0.3"), (3, "+3"), (True, "1"), (False, "0")]
)
def test_a_value_is_rounded_half_away_from_zero_to_its_declared_decimals(value: float, text: str) -> None:
    async def story(drive: CtAnsiDrive) -> None:
        sent: list[str] = []

        async def request(command: Write, **options: Any) -> None:
            sent.append(command.text)

        drive.node.request = request  # type: ignore[method-assign, assignment]  # to see what is sent
        await drive.write("1.21", value)
        await drive.point("1.21").write(value)
        assert sent == [text] * 2

    told(story, decimals={"1.21": 1})


def test_a_value_with_more_decimals_than_fit_is_verified_as_it_was_sent() -> None:
    async def story(drive: CtAnsiDrive) -> None:
        sent: list[float] = []

        async def request(command: Any, **options: Any) -> Any:
            if not command.writes:
                return sent[-1]
            sent.append(float(command.text))
            return None

        drive.node.request = request  # type: ignore[method-assign]  # a drive that stores what it takes
        await drive.write("1.22", 1 / 3, verify=True)
        assert sent != [1 / 3]

    told(story)


def test_a_value_that_differs_after_writing_is_told() -> None:
    async def story(drive: CtAnsiDrive) -> None:
        answers = iter((Done(None), Done(5.0)))

        async def request(command: Any, **options: Any) -> Any:
            return next(answers).value

        drive.node.request = request  # type: ignore[method-assign]  # a drive that limits what it takes
        with pytest.raises(VerifyFailed, match=r"1.21 reads 5.0 after \+6 was written"):
            await drive.write("1.21", 6, verify=True)

    told(story)


@pytest.mark.parametrize("item", ["1", "1.2.3", "1.21:", "1.21:wide", "1.21:x", "1.21:200"])
def test_an_item_that_does_not_exist_is_refused(item: str) -> None:
    async def story(drive: CtAnsiDrive) -> None:
        with pytest.raises(InvalidCommand):
            drive.point(item)

    told(story)


@pytest.mark.parametrize("address", [1, 9, 10, 20, 90, 100])
def test_an_address_that_means_a_group_or_nothing_is_no_drives_own(address: int) -> None:
    with pytest.raises(InvalidCommand, match="use 11 to 99 without 20, 30, 40, 50, 60, 70, 80, 90, or 0"):
        PROFILE.check_address(address)
    with pytest.raises(InvalidCommand):
        EmulatedCtAnsi(address)


def test_an_emulated_drive_sends_as_the_guides_print_it() -> None:
    filled = bytes.fromhex("02 30 31 32 31 2D 30 30 34 37 2E 36 03 37")  # "-0047.6", as the UD78 guide has it
    for width, wanted in ((0, UD70_REPLY), (7, filled)):
        drive = EmulatedCtAnsi(12, width=width)
        drive.set_value(121, -476, 0.0)
        assert bytes.fromhex(ask(line_of(drive), "04 31 31 32 32 30 31 32 31 05", 1.0)) == wanted
    drive = EmulatedCtAnsi(12, plus=True)
    assert bytes.fromhex(ask(line_of(drive), "04 31 31 32 32 30 34 32 36 05", 1.0)) == b"\x020426+0\x038"


def selection(text: str) -> str:
    """A write to drive 12 of "0121-47.6", in hexadecimal."""
    body = text.encode() + b"\x03"
    check = 0
    for byte in body:
        check ^= byte
    return (b"\x041122\x02" + body + bytes((check if check >= 32 else check + 32,))).hex()


@pytest.mark.parametrize(
    ("text", "stored"),
    [
        ("012147.6", 476),
        ("0121-0.3", -3),
        ("0121.5", 5),
        ("0121+5", 50),
        ("0121 5", 50),
        ("0121000000047.60", 476),
        ("04261.0", 1),
        ("012147.65", None),  # finer than a tenth
        ("0121000000047.600", None),  # 13 characters
        ("0121100.1", None),
        ("0121-100.1", None),
        ("04260.5", None),
        ("0121", None),
        ("01211.2.3", None),
        ("03021", None),  # read-only
    ],
)
def test_an_emulated_drive_stores_what_its_parameter_can_hold(text: str, stored: int | None) -> None:
    drive = EmulatedCtAnsi(12)
    assert bytes.fromhex(ask(line_of(drive), selection(text))) == (NAK if stored is None else ACK)
    assert drive.value(int(text[:4]), 1.0) == (stored or 0)


def test_an_emulated_drive_sends_signs_and_zeros_by_option() -> None:
    for options, value, sent in (
        ({"plus": True}, 0, b"+0.0"),
        ({"plus": True}, -5, b"-0.5"),
        ({"width": 6}, 476, b"0047.6"),
        ({"width": 6, "plus": True}, 476, b"+047.6"),
        ({}, -15, b"-1.5"),
    ):
        drive = EmulatedCtAnsi(12, **options)
        drive.set_value(121, value, 0.0)
        assert bytes.fromhex(ask(line_of(drive), "04 31 31 32 32 30 31 32 31 05"))[5:-2] == sent


def test_initial_values_of_an_emulated_drive_have_its_decimals() -> None:
    drive = EmulatedCtAnsi(12)
    drive.preset("1.21", 30.3, 0.1)
    drive.preset("3.2", 12.5)
    drive.preset("4.26", 1)
    assert [drive.value(parameter, 0.0) for parameter in (121, 122, 302, 426)] == [303, 1, 125, 1]
    for item, value in (("1.21", 0.05), ("1.21", 100.1), ("4.26", 0.5)):
        with pytest.raises(InvalidCommand, match="without its decimals"):
            drive.preset(item, value)


def test_values_of_an_emulated_drive_have_12_characters_at_most() -> None:
    EmulatedCtAnsi(12, width=12)
    with pytest.raises(InvalidCommand, match="12 characters at most, not 13"):
        EmulatedCtAnsi(12, width=13)


def test_a_listener_hears_decimal_points_and_makes_commands_of_this_protocol() -> None:
    frames = hear(
        "ct-ansi",
        "04 31 31 32 32 02 30 31 32 35 2D 33 34 2E 35 03 34",
        "06",
        "04 31 31 32 32 30 31 32 31 05",
        UD70_REPLY.hex(),
    )
    assert said(frames) == [
        "host 12 write 01.25 = -34.5",
        "node 12 ACK",
        "host 12 read 01.21",
        "node 12 01.21 = -47.6",
    ]
    dialect = find("ct-ansi").protocol.dialect()
    commands = [dialect.command(frame, ()) for frame in frames if frame.kind in (Kind.READ, Kind.WRITE)]
    assert commands == [Write(1, 25, -34.5), Read(1, 21)]


@pytest.mark.parametrize("value", [True, False, 1.0, -34.5, 12])
def test_a_listener_makes_a_command_that_sends_the_same_bytes_of_a_write(value: float) -> None:
    request = Write(1, 25, value).open(12, PROFILE.timings).request
    [frame] = hear("ct-ansi", request.hex())
    assert find("ct-ansi").protocol.dialect().command(frame, ()).open(12, PROFILE.timings).request == request

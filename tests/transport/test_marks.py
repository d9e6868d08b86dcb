"""What a UART flags: bytes with parity or framing errors and breaks, marked by the tty and told from data."""

from __future__ import annotations

import asyncio
import fcntl
import os
import select
import struct
import termios
from collections.abc import Iterator
from typing import Any

import pytest

from busmaster import Bus, GarbledReply, Hcp2Controller, MscController, SerialPort, ext
from busmaster.arbiter.counters import Mark
from busmaster.contract.tap import Attempt
from busmaster.emulator.line import Line
from busmaster.emulator.serve import serve_pty
from busmaster.protocols.msc import codec as msc
from busmaster.registry import make_device
from busmaster.transport.marks import Unescape
from busmaster.transport.serial_port import PortTransport
from busmaster.wire.checks import xor
from tests.patience import PATIENCE
from tests.transport.fakes import PtyMaster, Recorder, closed, opened, plugged

HEARD = [
    (b"a\xffb", None),
    (b"\x41", Mark.DAMAGED),
    (b"\x00", Mark.BREAK),
    (b"\xff", Mark.DAMAGED),
    (b"\xff\x00c", None),
]
SAID = b"a\xff\xffb" + b"\xff\x00\x41" + b"\xff\x00\x00" + b"\xff\x00\xff" + b"\xff\xff\x00c"
"""The same, as a tty that marks says it."""

TCGETS2 = 0x802C542A
RAW = termios.INPCK | termios.PARMRK


@pytest.fixture
def pty_master() -> Iterator[PtyMaster]:
    with plugged() as end:
        yield end


class Marked(Recorder):
    """Notes sound and damaged bytes in order."""

    def __init__(self) -> None:
        super().__init__()
        self.pieces: list[tuple[bytes, Mark | None]] = []

    def data_received(self, data: bytes) -> None:
        self.pieces.append((data, None))
        super().data_received(data)

    def byte_marked(self, byte: bytes, mark: Mark) -> None:
        self.pieces.append((byte, mark))
        super().data_received(b"")


def joined(pieces: list[tuple[bytes, Mark | None]]) -> list[tuple[bytes, Mark | None]]:
    """Sound pieces that follow each other are one: how they were cut does not matter."""
    whole: list[tuple[bytes, Mark | None]] = []
    for piece, mark in pieces:
        if whole and mark is None and whole[-1][1] is None:
            whole[-1] = (whole[-1][0] + piece, None)
        else:
            whole.append((piece, mark))
    return whole


def input_flags(descriptor: int) -> int:
    return int(termios.tcgetattr(descriptor)[0])


def set_input_flags(descriptor: int, flags: int) -> None:
    settings = termios.tcgetattr(descriptor)
    settings[0] = flags
    termios.tcsetattr(descriptor, termios.TCSANOW, settings)


def readable(descriptor: int) -> None:
    """Return when what was written at the other end has come through."""
    poller = select.poll()
    poller.register(descriptor, select.POLLIN)
    assert poller.poll(PATIENCE * 1000)


# -- telling marks from data -----------------------------------------------------------------------------------------


def test_marks_are_told_from_data_however_they_are_split() -> None:
    for first in range(len(SAID) + 1):
        for second in range(first, len(SAID) + 1):
            unescape = Unescape()
            chunks = (SAID[:first], SAID[first:second], SAID[second:])
            assert joined([piece for chunk in chunks for piece in unescape.take(chunk)]) == HEARD
            assert unescape.begun == b""


def test_byte_by_byte_every_value_comes_through() -> None:
    said = b"".join(bytes((byte,)) * (2 if byte == 0xFF else 1) for byte in range(256)) * 2
    unescape = Unescape()
    pieces = [piece for byte in said for piece in unescape.take(bytes((byte,)))]
    assert joined(pieces) == [(bytes(range(256)) * 2, None)]


def test_a_lone_ff_from_a_tty_that_marks_no_more_is_a_byte() -> None:
    assert Unescape().take(b"\xffab\xff\x01") == [(b"\xffab\xff\x01", None)]


# -- on a pty ---------------------------------------------------------------------------------------------------------


@pytest.mark.asyncio
async def test_the_tty_doubles_ff_and_the_protocol_never_sees_that(pty_master: PtyMaster) -> None:
    transport, recorder = await opened(pty_master.path)
    device = transport.get_extra_info("serial")
    transport.pause_reading()
    pty_master.write(bytes.fromhex("01 ff 00 ff ff"))
    readable(device.fileno())
    assert os.read(device.fileno(), 100) == bytes.fromhex("01 ff ff 00 ff ff ff ff")
    transport.resume_reading()
    pty_master.write(bytes.fromhex("01 ff 00 ff ff"))
    await recorder.until(lambda r: len(r.received) == 5)
    assert recorder.received == bytes.fromhex("01 ff 00 ff ff")
    await closed(transport, recorder)


async def marked(pty_master: PtyMaster) -> tuple[PortTransport, Marked]:
    """A port whose pty lets through what is written into it: its own PARMRK is cleared behind the port's back."""
    recorder = Marked()
    transport = await SerialPort(pty_master.path, baudrate=57600).open(lambda: recorder)
    set_input_flags(transport.get_extra_info("serial").fileno(), 0)
    return transport, recorder


@pytest.mark.asyncio
async def test_errors_and_breaks_come_in_order_with_the_data(pty_master: PtyMaster) -> None:
    transport, recorder = await marked(pty_master)
    pty_master.write(SAID)
    await recorder.until(lambda _: joined(recorder.pieces) == HEARD)
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_a_mark_split_over_reads_is_put_together(pty_master: PtyMaster) -> None:
    transport, recorder = await marked(pty_master)
    transport.pause_reading()
    for byte in SAID:
        pty_master.write(bytes((byte,)))
        readable(transport.get_extra_info("serial").fileno())
        transport._read_ready()
    assert joined(recorder.pieces) == HEARD
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_a_protocol_that_knows_no_marks_takes_a_damaged_byte_for_data(pty_master: PtyMaster) -> None:
    transport, recorder = await opened(pty_master.path)
    set_input_flags(transport.get_extra_info("serial").fileno(), 0)
    pty_master.write(SAID)
    await recorder.heard(b"c")
    assert recorder.received == b"".join(piece for piece, _ in HEARD)
    await closed(transport, recorder)


# -- the flags --------------------------------------------------------------------------------------------------------


@pytest.mark.asyncio
async def test_whatever_another_program_left_set_is_cleared(pty_master: PtyMaster) -> None:
    bystander = os.open(pty_master.path, os.O_RDWR | os.O_NOCTTY)
    left = ("BRKINT", "IGNBRK", "IGNPAR", "IMAXBEL", "ISTRIP", "INLCR", "IGNCR", "ICRNL", "IXON", "IXOFF", "IXANY")
    iuclc = 0o001000
    set_input_flags(bystander, iuclc | sum(getattr(termios, name) for name in left))
    transport, recorder = await opened(pty_master.path)
    assert input_flags(bystander) == RAW
    await closed(transport, recorder)
    os.close(bystander)


@pytest.mark.asyncio
async def test_a_port_that_is_closed_marks_no_more_for_whoever_opens_it_next(pty_master: PtyMaster) -> None:
    bystander = os.open(pty_master.path, os.O_RDWR | os.O_NOCTTY)
    for exclusive, left in ((True, 0), (False, RAW)):
        transport, recorder = await opened(pty_master.path, exclusive=exclusive)
        assert input_flags(bystander) == RAW
        await closed(transport, recorder)
        assert input_flags(bystander) == left
    os.close(bystander)


@pytest.mark.asyncio
async def test_a_port_that_is_configured_anew_still_marks(pty_master: PtyMaster) -> None:
    transport, recorder = await opened(pty_master.path)
    device = transport.get_extra_info("serial")
    await asyncio.to_thread(device.apply_settings, {"baudrate": 9600})
    assert input_flags(device.fileno()) == RAW
    pty_master.write(bytes.fromhex("ff 41"))
    await recorder.heard(b"\xff\x41")
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_a_rate_that_only_this_system_has_survives(pty_master: PtyMaster) -> None:
    recorder = Recorder()
    transport = await SerialPort(pty_master.path, baudrate=250_000).open(lambda: recorder)
    settings = bytearray(44)
    fcntl.ioctl(transport.get_extra_info("serial").fileno(), TCGETS2, settings)
    assert struct.unpack_from("II", settings, 36) == (250_000, 250_000)
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_where_the_driver_refuses_to_mark_data_passes_as_before(
    pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    really_set = termios.tcsetattr

    def refuse(descriptor: int, when: int, settings: list[Any]) -> None:
        really_set(descriptor, when, [settings[0] & ~termios.PARMRK, *settings[1:]])

    monkeypatch.setattr(termios, "tcsetattr", refuse)
    transport, recorder = await opened(pty_master.path)
    assert not transport.get_extra_info("serial").marks
    pty_master.write(SAID)
    await recorder.heard(b"c")
    assert recorder.received == SAID
    await closed(transport, recorder)


# -- up to the caller -------------------------------------------------------------------------------------------------


def reply(value: int, element: bytes = b"01") -> bytes:
    body = element + f"{value}".encode() + b"\x03"
    return b"\x02" + body + bytes([xor(body)])


class Tap:
    """Keeps the received bytes."""

    def __init__(self) -> None:
        self.heard = b""

    def transmitted(self, now: float, data: bytes, attempt: Attempt | None, /) -> None: ...

    def received(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        self.heard += data

    def attempted(self, attempt: Attempt, /) -> None: ...


@pytest.mark.asyncio
async def test_a_reply_with_a_damaged_byte_fails_the_attempt_and_is_counted(pty_master: PtyMaster) -> None:
    """Two flipped bits in two bytes pass any exclusive-or: only the UART knows."""

    async def node() -> None:
        """Answers what it is asked: the first time with a mark within."""
        damage = b"\xff\x00"
        while True:
            if request := await asyncio.to_thread(pty_master.read, 0.02):
                good = reply(234, request[4:6])
                pty_master.write(good[:3] + damage + good[3:])
                damage = b""

    async with Bus(SerialPort(pty_master.path, baudrate=57600)) as bus:
        transport = bus._pump._transport
        assert transport is not None
        set_input_flags(transport.get_extra_info("serial").fileno(), 0)
        answering = asyncio.ensure_future(node())
        axis, tap = Hcp2Controller(bus, 1), Tap()
        ext.add_tap(bus, tap)
        with pytest.raises(GarbledReply, match="parity"):
            await axis.read(1, retries=0)
        assert tap.heard.startswith(reply(234)[:4]), "the damaged byte is recorded too"
        assert await axis.read(1) == 234
        line = await bus.statistics()
        assert (line.damaged, line.breaks, line.driver) == (1, 0, None)
        answering.cancel()


@pytest.mark.slow
@pytest.mark.asyncio
async def test_binary_data_full_of_ff_comes_through_a_pty() -> None:
    with serve_pty(Line(msc.PROFILE.line, [make_device("msc", 3)], paced=False)) as server:
        async with Bus(SerialPort(server.path, baudrate=9600)) as bus:
            press = MscController(bus, 3)
            for value in (-1, 0x00FF00FF, -65281, 0xFF):
                await press.write(2008, value)
                assert await press.read(2008) == value

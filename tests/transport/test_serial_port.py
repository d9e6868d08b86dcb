"""SerialPort on real ptys: writing, losing and closing, and every trap of pyserial-asyncio there."""

from __future__ import annotations

import asyncio
import errno
import os
import termios
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import serial

from busmaster.contract.profile import LineSettings
from busmaster.errors import InvalidCommand, LineDown
from busmaster.transport import serial_port
from busmaster.transport.endpoints import is_paced
from busmaster.transport.rs485 import Rs485
from busmaster.transport.serial_port import SerialPort
from tests.transport.fakes import PtyMaster, closed, opened, plugged


@pytest.fixture
def pty_master() -> Iterator[PtyMaster]:
    with plugged() as end:
        yield end


# -- what it is ------------------------------------------------------------------------------------------------------


def test_a_port_is_a_value() -> None:
    assert SerialPort("/dev/ttyUSB0", baudrate=9600) == SerialPort("/dev/ttyUSB0", baudrate=9600)
    assert SerialPort("/dev/ttyUSB0", baudrate=9600, parity="E", bytesize=7).settings.framing == "7E1"
    assert SerialPort("/dev/ttyUSB0", baudrate=9600, stopbits=2).settings == LineSettings(9600, stopbits=2)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"baudrate": 0}, "baudrate"),
        ({"bytesize": 9}, "framing"),
        ({"parity": "X"}, "framing"),
        ({"stopbits": 3}, "framing"),
        ({"receive_latency": -0.1}, "receive_latency"),
        ({"receive_latency": float("nan")}, "receive_latency"),
        ({"receive_latency": float("inf")}, "receive_latency"),
        ({"rtscts": True, "rs485": True}, "exclude each other"),
        ({"path": ""}, "path"),
    ],
)
def test_values_that_no_port_can_have_are_refused_when_it_is_built(options: dict[str, Any], says: str) -> None:
    values: dict[str, Any] = {"path": "/dev/ttyUSB0", "baudrate": 9600} | options
    with pytest.raises(InvalidCommand, match=says):
        SerialPort(**values)


def test_a_link_shows_what_it_leads_to_now(pty_master: PtyMaster, tmp_path: Path) -> None:
    port = SerialPort(str(tmp_path / "line"), baudrate=57600)
    assert port.presence() is None
    with plugged(tmp_path / "line") as other:
        seen = port.presence()
        assert seen == SerialPort(other.path, baudrate=57600).presence()
        assert seen != SerialPort(pty_master.path, baudrate=57600).presence()
    assert port.presence() is None


@pytest.mark.asyncio
async def test_bytes_go_both_ways_unchanged(pty_master: PtyMaster) -> None:
    transport, recorder = await opened(pty_master.path)
    assert recorder.connections == 1
    every_byte = bytes(range(256))
    transport.write(every_byte)
    assert pty_master.read() == every_byte
    pty_master.write(every_byte)
    await recorder.until(lambda r: len(r.received) == 256)
    assert recorder.received == every_byte
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_a_pty_is_unpaced_unless_told(pty_master: PtyMaster) -> None:
    for told, expected in ((None, False), (True, True), (False, False)):
        transport, recorder = await opened(pty_master.path, paced=told)
        assert transport.get_extra_info("paced") is expected
        assert is_paced(SerialPort(pty_master.path, baudrate=57600, paced=told), transport) is expected
        await closed(transport, recorder)


@pytest.mark.asyncio
async def test_a_serial_device_is_paced_unless_told(pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_port, "is_pty", lambda device: False)
    for told, expected in ((None, True), (False, False)):
        transport, recorder = await opened(pty_master.path, paced=told)
        assert is_paced(SerialPort(pty_master.path, baudrate=57600, paced=told), transport) is expected
        await closed(transport, recorder)


@pytest.mark.asyncio
async def test_rate_framing_and_flow_control_reach_the_driver(
    pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pseudo-terminal would not keep all of them."""
    configured: list[serial.Serial] = []

    def refuse(device: serial.Serial, path: str) -> None:
        assert path == device.port == pty_master.path
        configured.append(device)
        raise OSError(errno.ENXIO, "nothing")

    monkeypatch.setattr(serial_port, "_names_pty", lambda path: False)
    monkeypatch.setattr(serial_port, "_open_device", refuse)
    for options in ({"parity": "E", "bytesize": 7, "stopbits": 2, "rtscts": True}, {"exclusive": False}):
        with pytest.raises(LineDown, match="no hardware behind"):
            await opened(pty_master.path, **options)
    assert [
        (one.baudrate, one.bytesize, one.parity, one.stopbits, one.rtscts, one.exclusive, one.timeout)
        for one in configured
    ] == [(57600, 7, "E", 2, True, True, 0), (57600, 8, "N", 1, False, None, 0)]


@pytest.mark.asyncio
async def test_an_open_port_can_be_tuned_and_a_refusal_names_what_it_does_not_take(
    pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    transport, recorder = await opened(pty_master.path)

    def found() -> tuple[int, bool, bool]:
        settings = termios.tcgetattr(pty_master.fd)
        return settings[5], bool(settings[2] & termios.PARODD), bool(settings[2] & termios.CSTOPB)

    assert found() == (termios.B57600, False, False)
    await transport.tune(LineSettings(9600, 7, "O", 2))
    assert found() == (termios.B9600, True, True)
    await transport.tune(LineSettings(19200, 7, "E"))  # even parity and 7 bits are ignored
    assert found() == (termios.B19200, False, False)

    def refuse(device: serial.Serial, wanted: dict[str, object]) -> None:
        asked.append(wanted)
        raise ValueError("Failed to set custom baud rate")

    asked: list[dict[str, object]] = []
    monkeypatch.setattr(serial.Serial, "apply_settings", refuse)
    monkeypatch.setattr(serial_port, "is_pty", lambda device: False)
    with pytest.raises(LineDown, match=f"{pty_master.path} does not take 1200 baud, 7E1"):
        await transport.tune(LineSettings(1200, 7, "E"))
    assert asked == [{"baudrate": 1200, "bytesize": 7, "parity": "E", "stopbits": 1}]
    monkeypatch.undo()
    await closed(transport, recorder)


@pytest.mark.parametrize(
    ("rs485", "delay"),
    [
        (None, 0.0),
        (True, 0.0),
        (Rs485(delay_before=0.005, delay_after=0.01), 0.005),
        (Rs485(by="software", delay_before=0.0004), 0.0004),
    ],
)
def test_the_delay_of_each_frame_is_that_before_its_first_byte(rs485: Rs485 | bool | None, delay: float) -> None:
    assert SerialPort("/dev/ttyS0", baudrate=9600, rs485=rs485).send_delay == delay


# -- writing ---------------------------------------------------------------------------------------------------------


@pytest.mark.asyncio
async def test_a_write_on_an_empty_buffer_leaves_in_the_same_call(pty_master: PtyMaster) -> None:
    transport, recorder = await opened(pty_master.path)
    transport.write(bytes.fromhex("07 30 35"))
    assert pty_master.read() == bytes.fromhex("07 30 35")  # the loop has not turned since
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_what_the_driver_does_not_take_follows_in_order(pty_master: PtyMaster) -> None:
    transport, recorder = await opened(pty_master.path)
    flood = b"".join(b"%07d\n" % n for n in range(40_000))
    transport.write(flood[:300_000])
    transport.write(flood[300_000:])
    arrived = b""
    while len(arrived) < len(flood):
        arrived += pty_master.read(patience=0.001)
        await asyncio.sleep(0)
    assert arrived == flood
    transport.write(b"next")
    assert pty_master.read() == b"next"
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_a_single_byte_that_has_not_left_pauses_the_protocol_until_it_has(pty_master: PtyMaster) -> None:
    transport, recorder = await opened(pty_master.path)
    while not recorder.flow:
        transport.write(b"x")
    assert transport.get_write_buffer_size() == 1
    transport.write(b"y")
    assert recorder.flow == ["pause"]
    while "resume" not in recorder.flow:
        pty_master.read(patience=0.001)
        await asyncio.sleep(0)
    assert recorder.flow == ["pause", "resume"]
    assert transport.get_write_buffer_size() == 0
    await closed(transport, recorder)


# -- losing it -------------------------------------------------------------------------------------------------------


@pytest.mark.asyncio
async def test_a_hang_up_is_reported_at_once_and_once(pty_master: PtyMaster) -> None:
    transport, recorder = await opened(pty_master.path)
    pty_master.unplug()
    await recorder.lost()
    assert isinstance(recorder.losses[0], LineDown)
    assert str(recorder.losses[0]) == f"{pty_master.path} was lost: it hung up"
    transport.write(b"x")
    transport.close()
    transport.abort()
    await asyncio.sleep(0.01)
    assert len(recorder.losses) == 1


@pytest.mark.asyncio
async def test_another_error_than_a_hang_up_is_the_reason_of_the_loss(
    pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_descriptor: int, _data: bytes) -> int:
        raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))

    transport, recorder = await opened(pty_master.path)
    with monkeypatch.context() as patch:
        patch.setattr(os, "write", fail)
        transport.write(b"x")
    await recorder.lost()
    assert str(recorder.losses[0]) == f"{pty_master.path} was lost: Cannot allocate memory"


@pytest.mark.asyncio
async def test_a_write_to_a_lost_port_reports_the_loss_and_not_from_within_the_write(pty_master: PtyMaster) -> None:
    transport, recorder = await opened(pty_master.path)
    pty_master.unplug()
    transport.write(b"x")
    assert recorder.losses == []
    assert transport.is_closing()
    transport.write(b"y")
    await recorder.lost()
    await asyncio.sleep(0.01)
    assert len(recorder.losses) == 1
    assert isinstance(recorder.losses[0], LineDown)


@pytest.mark.asyncio
async def test_a_port_lost_with_output_waiting_reports_the_loss(pty_master: PtyMaster) -> None:
    transport, recorder = await opened(pty_master.path)
    transport.write(bytes(300_000))
    pty_master.unplug()
    await recorder.lost()
    assert isinstance(recorder.losses[0], LineDown)


@pytest.mark.asyncio
async def test_a_loss_is_found_by_writing_while_reading_is_paused(pty_master: PtyMaster) -> None:
    transport, recorder = await opened(pty_master.path)
    transport.pause_reading()
    transport.write(bytes(300_000))
    pty_master.unplug()
    await recorder.lost()
    assert isinstance(recorder.losses[0], LineDown)


@pytest.mark.asyncio
async def test_being_woken_with_nothing_to_read_is_no_loss(pty_master: PtyMaster) -> None:
    transport, recorder = await opened(pty_master.path)
    transport._read_ready()  # as when another program reads the port too, and was quicker
    await asyncio.sleep(0)
    assert recorder.losses == []
    await closed(transport, recorder)


# -- closing ---------------------------------------------------------------------------------------------------------


@pytest.mark.asyncio
async def test_closing_a_stopped_line_does_not_wait_for_its_output(pty_master: PtyMaster) -> None:
    transport, recorder = await opened(pty_master.path)
    transport.write(bytes(300_000))
    await closed(transport, recorder)
    assert recorder.losses == [None]


@pytest.mark.asyncio
async def test_closing_discards_what_has_not_left(pty_master: PtyMaster) -> None:
    transport, recorder = await opened(pty_master.path)
    transport.write(bytes(300_000))
    await closed(transport, recorder)
    assert len(pty_master.rest()) < 5000  # of some 70,000 that the pty had taken: what lay ready to be read


@pytest.mark.asyncio
@pytest.mark.parametrize("end", ["close", "abort", "loss"])
async def test_a_port_that_has_ended_with_unsent_bytes_leaves_nothing_in_the_event_loop(
    pty_master: PtyMaster, end: str
) -> None:
    transport, recorder = await opened(pty_master.path)
    descriptor = transport.get_extra_info("serial").fileno()
    transport.write(bytes(300_000))
    if end == "loss":
        pty_master.unplug()
        await recorder.lost()
    else:
        getattr(transport, end)()
    loop = asyncio.get_running_loop()
    assert (loop.remove_reader(descriptor), loop.remove_writer(descriptor)) == (False, False)
    await recorder.lost()


@pytest.mark.asyncio
async def test_an_abort_is_a_close_from_here(pty_master: PtyMaster) -> None:
    transport, recorder = await opened(pty_master.path)
    transport.abort()
    await recorder.lost()
    assert recorder.losses == [None]
    assert repr(transport) == f"<PortTransport {pty_master.path} closing>"


@pytest.mark.asyncio
async def test_a_driver_that_never_lets_go_delays_a_close_by_its_deadline_alone(
    pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    transport, recorder = await opened(pty_master.path)
    letting_go = threading.Event()
    monkeypatch.setattr(termios, "tcflush", lambda *_: letting_go.wait())
    monkeypatch.setattr(serial_port, "CLOSE_DEADLINE", 0.02)
    transport.close()
    assert recorder.losses == []
    await recorder.lost()
    letting_go.set()
    await asyncio.sleep(0.02)
    assert recorder.losses == [None]


@pytest.mark.asyncio
async def test_an_abort_does_not_wait_for_the_driver(pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch) -> None:
    transport, recorder = await opened(pty_master.path)
    letting_go = threading.Event()
    monkeypatch.setattr(termios, "tcflush", lambda *_: letting_go.wait())
    transport.close()
    transport.abort()
    await asyncio.sleep(0)
    assert recorder.losses == [None]
    letting_go.set()

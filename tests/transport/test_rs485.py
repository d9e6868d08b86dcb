"""RS-485 direction by RTS: the driver's mode on a made-up ioctl, and software on a pty with its modem lines recorded.

A pty has neither the ioctl nor modem lines. What is answered here is what linux/serial.h and serial_core.c say.
"""

from __future__ import annotations

import array
import asyncio
import errno
import itertools
import os
import termios
import threading
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from serial.rs485 import RS485Settings

from busmaster import Bus, Hcp2Controller, Rs485
from busmaster.emulator.line import Line
from busmaster.emulator.serve import serve_pty
from busmaster.errors import InvalidCommand, LineDown
from busmaster.registry import make_device
from busmaster.transport import rs485
from busmaster.transport.kernel import open_port
from busmaster.transport.serial_port import SerialPort
from tests.patience import PATIENCE
from tests.transport.fakes import PtyMaster, Recorder, closed, opened, plugged
from tests.transport.rs485_driver import TERMINATE, FakeDriver

BAUDRATE = 57600
SOFTWARE = Rs485(by="software")
pytestmark = pytest.mark.filterwarnings("ignore:.*RTS is switched by software")


@pytest.fixture
def pty_master() -> Iterator[PtyMaster]:
    with plugged() as end:
        yield end


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> FakeDriver:
    return FakeDriver(monkeypatch)


# -- values ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"by": "hardware"}, "by must be driver or software, not 'hardware'"),
        ({"level": True}, "level must be high or low, not True"),
        ({"delay_before": -0.001}, "delay_before must be 0 to 0.1 s, not -0.001"),
        ({"delay_after": 0.2}, "delay_after must be 0 to 0.1 s, not 0.2"),
        ({"delay_after": float("nan")}, "delay_after must be 0 to 0.1 s, not nan"),
        ({"delay_after": True}, "delay_after must be 0 to 0.1 s, not True"),
        ({"delay_after": "1"}, "delay_after must be 0 to 0.1 s, not '1'"),
        ({"delay_before": 0.0004}, "delay_before must be a whole number of milliseconds, such as 0.001, not 0.0004"),
        ({"rx_during_tx": 1}, "rx_during_tx must be true or false, not 1"),
        ({"by": "software", "rx_during_tx": True}, 'rx_during_tx must be false with by = "software"'),
    ],
)
def test_a_wrong_value_is_an_error_that_names_key_value_and_what_is_possible(values: dict[str, Any], says: str) -> None:
    with pytest.raises(InvalidCommand, match=f"^rs485: {says}"):
        Rs485(**values)


def test_software_has_delays_shorter_than_a_millisecond() -> None:
    assert Rs485(by="software", delay_before=0.0004).delay_before == 0.0004


def test_every_whole_millisecond_is_taken() -> None:
    for milliseconds in range(101):
        assert Rs485(delay_after=milliseconds / 1000).delay_after == milliseconds / 1000


def test_the_settings_of_pyserial_are_the_same_value() -> None:
    theirs = RS485Settings(False, True, loopback=True, delay_before_tx=0.002, delay_before_rx=0.003)
    ours = Rs485(level="low", delay_before=0.002, delay_after=0.003, rx_during_tx=True)
    assert SerialPort("/dev/x", baudrate=9600, rs485=theirs) == SerialPort("/dev/x", baudrate=9600, rs485=ours)
    assert SerialPort("/dev/x", baudrate=9600, rs485=RS485Settings()).rts == Rs485()
    with pytest.raises(InvalidCommand, match="rts_level_for_tx and rts_level_for_rx must differ"):
        SerialPort("/dev/x", baudrate=9600, rs485=RS485Settings(True, True))


@pytest.mark.parametrize("value", [1, "software", {"by": "software"}])
def test_another_type_is_refused_and_named(value: Any) -> None:
    with pytest.raises(InvalidCommand, match="rs485 must be true, false, an Rs485 or pyserial's"):
        SerialPort("/dev/x", baudrate=9600, rs485=value)


# -- by the driver ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "flags", "delays"),
    [
        (True, rs485.RTS_ON_SEND, [0, 0]),
        (Rs485(level="low"), rs485.RTS_AFTER_SEND, [0, 0]),
        (Rs485(delay_before=0.009 - 0.003, delay_after=0.057), rs485.RTS_ON_SEND, [6, 57]),
        (Rs485(rx_during_tx=True), rs485.RTS_ON_SEND | rs485.RX_DURING_TX, [0, 0]),
    ],
)
@pytest.mark.asyncio
async def test_the_driver_gets_each_setting_and_keeps_its_other_flags(
    pty_master: PtyMaster, driver: FakeDriver, settings: Any, flags: int, delays: list[int]
) -> None:
    await closed(*await opened(pty_master.path, rs485=settings))
    assert driver.state == [TERMINATE | rs485.ENABLED | flags, *delays]
    assert driver.rts is (flags & rs485.RTS_AFTER_SEND > 0), "the transmitter is off before the mode is on"


@pytest.mark.asyncio
async def test_a_flag_that_another_program_left_is_cleared(pty_master: PtyMaster, driver: FakeDriver) -> None:
    driver.state = [rs485.RX_DURING_TX | rs485.RTS_AFTER_SEND, 50, 50]
    await closed(*await opened(pty_master.path, rs485=Rs485()))
    assert driver.state == [rs485.ENABLED | rs485.RTS_ON_SEND, 0, 0]


@pytest.mark.asyncio
async def test_a_setting_that_the_driver_replaces_is_an_error_that_names_it(
    pty_master: PtyMaster, driver: FakeDriver
) -> None:
    driver.most_delay = 5
    driver.can_receive_while_sending = False
    for settings, says in (
        (Rs485(delay_before=0.006), "mode: delay_before 0.006: it has 0.005; leave that setting out, or use by"),
        (Rs485(delay_after=0.02), "mode: delay_after 0.02: it has 0.005"),
        (Rs485(rx_during_tx=True), "mode: rx_during_tx true; leave"),
    ):
        with pytest.raises(LineDown, match=f"the driver of {pty_master.path} does not take this setting .*{says}"):
            await opened(pty_master.path, rs485=settings)
    await closed(*await opened(pty_master.path, rs485=Rs485(delay_before=0.005)))


@pytest.mark.parametrize(("flag", "says"), [(rs485.ENABLED, "it stays off"), (rs485.RTS_ON_SEND, "level high")])
@pytest.mark.asyncio
async def test_a_driver_that_drops_a_flag_without_an_error_is_refused(
    pty_master: PtyMaster, driver: FakeDriver, monkeypatch: pytest.MonkeyPatch, flag: int, says: str
) -> None:
    mode = driver._mode

    def drops(request: int, argument: array.array[int]) -> int:
        result = mode(request, argument)
        driver.state[0] &= ~flag
        return result

    monkeypatch.setattr(driver, "_mode", drops)
    with pytest.raises(LineDown, match=f"mode: {says}"):
        await opened(pty_master.path, rs485=True)


@pytest.mark.asyncio
async def test_a_driver_without_the_mode_points_to_software(pty_master: PtyMaster) -> None:
    with pytest.raises(LineDown, match=r'has no RS-485 mode; leave rs485 out: .* by = "software"'):
        await opened(pty_master.path, rs485=Rs485(delay_before=0.001))


@pytest.mark.asyncio
async def test_rts_is_left_alone_without_rs485(pty_master: PtyMaster, driver: FakeDriver) -> None:
    await closed(*await opened(pty_master.path))
    assert driver.log == ["RTS high"]  # by pyserial, which always did
    assert driver.state == [TERMINATE, 7, 7]


@pytest.mark.asyncio
async def test_a_delay_of_the_driver_makes_the_port_one_that_holds_bytes(
    pty_master: PtyMaster, driver: FakeDriver
) -> None:
    for settings, holds in ((Rs485(delay_before=0.001), True), (Rs485(delay_after=0.001), False), (None, False)):
        transport, recorder = await opened(pty_master.path, rs485=settings)
        assert open_port(transport).flow_controlled is holds
        await closed(transport, recorder)


# -- by software -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("level", "on", "off"), [("high", "RTS high", "RTS low"), ("low", "RTS low", "RTS high")])
@pytest.mark.asyncio
async def test_rts_is_switched_before_and_after_each_frame(
    pty_master: PtyMaster, driver: FakeDriver, level: Any, on: str, off: str
) -> None:
    transport, recorder = await opened(pty_master.path, rs485=Rs485(by="software", level=level))
    assert set(driver.log) == {off}, "the transmitter is never on before the first frame"
    driver.log.clear()
    transport.write(b"\x01\x02")
    await driver.until(on, "write 01 02", "drained", off)
    transport.write(b"\x03")
    await driver.until(on, "write 03", "drained", off)
    arrived = pty_master.read()
    while len(arrived) < 3:
        arrived += pty_master.read()
    assert arrived == b"\x01\x02\x03"
    await closed(transport, recorder)
    assert driver.log[-1] == off


@pytest.mark.asyncio
async def test_frames_written_at_once_leave_in_order_each_with_its_own_switching(
    pty_master: PtyMaster, driver: FakeDriver
) -> None:
    transport, recorder = await opened(pty_master.path, rs485=SOFTWARE)
    driver.log.clear()
    for number in range(3):
        transport.write(bytes([number]))
    await driver.until("RTS high", "write 02", "drained", "RTS low")
    assert driver.log == [
        step for number in range(3) for step in ("RTS high", f"write 0{number}", "drained", "RTS low")
    ]
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_the_line_is_released_only_after_the_transmitter_is_empty(
    pty_master: PtyMaster, driver: FakeDriver
) -> None:
    driver.empty = [False, False, True]
    transport, recorder = await opened(pty_master.path, rs485=SOFTWARE)
    driver.log.clear()
    transport.write(b"\x01")
    await driver.until("RTS high", "write 01", "sending", "sending", "empty", "RTS low")
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_a_driver_whose_transmitter_never_is_empty_is_drained_instead(
    pty_master: PtyMaster, driver: FakeDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rs485, "LATE_EMPTY", 0.001)
    driver.empty = [False] * 100_000
    transport, recorder = await opened(pty_master.path, rs485=SOFTWARE)
    transport.write(b"\x01")
    await driver.until("sending", "drained", "RTS low")
    driver.log.clear()
    transport.write(b"\x02")
    await driver.until("RTS high", "write 02", "drained", "RTS low")  # it is not asked again
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_the_transmitter_is_on_for_the_frame_by_its_baud_rate_and_for_both_delays(
    pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    driver, times = FakeDriver(monkeypatch), list[float]()
    note = driver._note

    def note_time(what: str) -> None:
        times.append(time.monotonic())
        note(what)

    monkeypatch.setattr(driver, "_note", note_time)
    settings = Rs485(by="software", delay_before=0.02, delay_after=0.03)
    transport, recorder = await opened(pty_master.path, rs485=settings, paced=True)
    times.clear()
    transport.write(bytes(48))  # 480 bits: 8.3 ms
    await driver.until("drained", "RTS low")
    on, written, drained, off = times
    assert written - on >= 0.02
    assert drained - written >= 480 / BAUDRATE
    assert off - drained >= 0.03
    (released,) = transport.get_extra_info("released")
    assert released >= 0.03
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_another_baud_rate_changes_the_time_of_a_frame(pty_master: PtyMaster, driver: FakeDriver) -> None:
    transport, recorder = await opened(pty_master.path, rs485=SOFTWARE, paced=True)
    await transport.tune(SerialPort("/dev/x", baudrate=1200).settings)
    began = time.monotonic()
    transport.write(bytes(6))
    await driver.until("drained", "RTS low")
    assert time.monotonic() - began >= 60 / 1200
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_bytes_count_as_unsent_until_the_delay_is_over(pty_master: PtyMaster, driver: FakeDriver) -> None:
    """R2: no reply window may begin before that."""
    transport, recorder = await opened(pty_master.path, rs485=Rs485(by="software", delay_before=0.05))
    switch, waits = transport._switch, list[tuple[float | None, int]]()
    assert switch is not None

    class Waits(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            waits.append((timeout, transport.get_write_buffer_size()))
            return super().wait(timeout)

    switch._stopped = Waits()
    transport.write(b"\x01\x02\x03")
    await recorder.until(lambda r: r.flow == ["pause", "resume"])
    assert waits[0] == (0.05, 3)
    assert transport.get_write_buffer_size() == 0
    assert pty_master.read() == b"\x01\x02\x03"
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_a_frame_that_waits_is_not_sent_after_a_close(pty_master: PtyMaster, driver: FakeDriver) -> None:
    transport, recorder = await opened(pty_master.path, rs485=Rs485(by="software", delay_before=0.1))
    transport.write(b"\x01")
    transport.write(b"\x02")
    await driver.until("RTS high")
    await closed(transport, recorder)
    assert driver.log[-1] == "RTS low"
    assert not any(what.startswith("write") for what in driver.log)
    assert pty_master.rest() == b""


@pytest.mark.asyncio
async def test_a_line_that_cannot_be_released_during_a_close_is_no_second_loss(
    pty_master: PtyMaster, driver: FakeDriver
) -> None:
    transport, recorder = await opened(pty_master.path, rs485=Rs485(by="software", delay_before=0.1))
    transport.write(b"\x01")
    await driver.until("RTS high")
    driver.has_lines = False
    await closed(transport, recorder)
    assert recorder.losses == [None]


@pytest.mark.asyncio
async def test_a_lost_port_is_reported_once_and_its_thread_ends(pty_master: PtyMaster, driver: FakeDriver) -> None:
    transport, recorder = await opened(pty_master.path, rs485=SOFTWARE)
    driver.has_lines = False
    transport.write(b"\x01")
    await recorder.lost()
    [cause] = recorder.losses
    assert f"{pty_master.path} was lost" in str(cause)
    assert transport._switch is not None
    await asyncio.to_thread(transport._switch.join)
    transport.write(b"\x02")  # nothing is sent any more
    await closed(transport, recorder)
    assert len(recorder.losses) == 1


@pytest.mark.asyncio
async def test_a_driver_that_takes_a_frame_in_pieces_gets_all_of_it(
    pty_master: PtyMaster, driver: FakeDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    transport, recorder = await opened(pty_master.path, rs485=SOFTWARE)
    is_full = itertools.cycle([False, True])

    def write(descriptor: int, data: bytes) -> int:
        if descriptor != transport._fd:
            return driver.write(descriptor, data)
        if next(is_full):
            raise BlockingIOError
        return driver.write(descriptor, data[:2])

    monkeypatch.setattr(os, "write", write)
    driver.log.clear()
    transport.write(bytes.fromhex("01 02 03 04 05"))
    await driver.until("RTS low")
    assert driver.log == ["RTS high", "write 01 02", "write 03 04", "write 05", "drained", "RTS low"]
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_a_port_that_is_lost_while_it_is_drained_is_reported(
    pty_master: PtyMaster, driver: FakeDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: int) -> None:
        raise termios.error(errno.EIO, "Input/output error")

    transport, recorder = await opened(pty_master.path, rs485=SOFTWARE)
    monkeypatch.setattr(termios, "tcdrain", fail)
    transport.write(b"\x01")
    assert transport._switch is not None
    await asyncio.to_thread(transport._switch.join)
    await asyncio.sleep(0.01)
    assert [str(loss) for loss in recorder.losses] == [f"{pty_master.path} was lost: it hung up"]
    assert driver.log[-1] == "RTS low"


@pytest.mark.asyncio
async def test_a_close_discards_bytes_whose_end_the_switch_waits_for(
    pty_master: PtyMaster, driver: FakeDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A driver that is stopped would drain them never, and the port would stay open."""
    begun, discarded, in_time = threading.Event(), threading.Event(), list[bool]()
    really_flush = termios.tcflush

    def flush(descriptor: int, which: int) -> None:
        if which == termios.TCOFLUSH:
            discarded.set()
        really_flush(descriptor, which)

    def drain(_: int) -> None:
        begun.set()
        in_time.append(discarded.wait(1.0))

    transport, recorder = await opened(pty_master.path, rs485=SOFTWARE)
    monkeypatch.setattr(termios, "tcflush", flush)
    monkeypatch.setattr(termios, "tcdrain", drain)
    transport.write(b"\x01")
    assert await asyncio.to_thread(begun.wait, PATIENCE)
    await closed(transport, recorder)
    assert in_time == [True]


@pytest.mark.asyncio
async def test_a_driver_without_rts_is_refused(pty_master: PtyMaster) -> None:
    with pytest.raises(LineDown, match=f"the driver of {pty_master.path} has no RTS line; leave rs485 out"):
        await opened(pty_master.path, rs485=SOFTWARE)
    await closed(*await opened(pty_master.path))


@pytest.mark.parametrize(("level", "hangs_up"), [("high", True), ("low", False)])
@pytest.mark.asyncio
async def test_a_closed_port_leaves_the_transmitter_off(
    pty_master: PtyMaster, driver: FakeDriver, level: Any, hangs_up: bool
) -> None:
    """At the last close the kernel sets RTS to low if HUPCL is set, which is the default."""
    settings = termios.tcgetattr(pty_master.fd)
    settings[2] |= termios.HUPCL
    termios.tcsetattr(pty_master.fd, termios.TCSANOW, settings)
    transport, recorder = await opened(pty_master.path, rs485=Rs485(by="software", level=level))
    await transport.tune(SerialPort("/dev/x", baudrate=9600).settings)
    assert bool(termios.tcgetattr(pty_master.fd)[2] & termios.HUPCL) is hangs_up
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_the_precision_of_software_is_warned_of(pty_master: PtyMaster, driver: FakeDriver) -> None:
    port = SerialPort(pty_master.path, baudrate=BAUDRATE, rs485=SOFTWARE)
    recorder = Recorder()
    with pytest.warns(
        UserWarning, match=f"{pty_master.path}: RTS is switched by software, which releases the line late"
    ):
        transport = await port.open(lambda: recorder)
    await closed(transport, recorder)


@pytest.mark.parametrize("by", ["driver", "software"])
@pytest.mark.asyncio
async def test_values_are_read_through_a_port_that_switches(driver: FakeDriver, by: Any) -> None:
    device = make_device("hcp2", 5)
    with serve_pty(Line(Hcp2Controller.profile.line, [device], paced=False)) as line:
        port = SerialPort(line.path, baudrate=BAUDRATE, rs485=Rs485(by=by, delay_before=0.002))
        async with Bus(port) as bus:
            node = Hcp2Controller(bus, 5)
            for value in range(20):
                await node.write(7, value)
                assert await node.read(7) == value
    if by == "software":
        assert driver.log.count("RTS high") >= 40
        assert driver.log[-1] == "RTS low"


def test_every_program_prints_the_warning_once(tmp_path: Path) -> None:
    """Python shows a warning once for each place and text; a port that is opened again and again is no new one."""
    shown: list[str] = []
    with warnings.catch_warnings():
        warnings.resetwarnings()
        warnings.simplefilter("default")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(warnings, "showwarning", lambda message, *_: shown.append(str(message)))
            for _ in range(3):
                with pytest.raises(LineDown):
                    asyncio.run(
                        SerialPort(str(tmp_path / "none"), baudrate=9600, rs485=SOFTWARE).open(asyncio.Protocol)
                    )
    assert len(shown) == 1

"""EI-Bisynch as EPICS reads and writes it: the protocol file `eurotherm2k` of StreamDevice, on the same instruments.

The client below is written from that file's behaviour, and shares nothing with the package: a read ends at ETX, and
its checksum is dropped; a write has six decimals, and anything but an ACK makes it read EE.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import reduce
from operator import xor

import pytest
import serial

from busmaster.bus.bus import Bus
from busmaster.emulator.line import Line
from busmaster.emulator.serve import serve_pty
from busmaster.errors import Refused
from busmaster.protocols.ei_bisynch import BisynchInstrument
from busmaster.protocols.ei_bisynch.codec import PROFILE, Read, Write
from busmaster.protocols.ei_bisynch.device import make_device
from busmaster.transport.serial_port import SerialPort
from tests.patience import PATIENCE

INSTRUMENTS = (1, 12, 99)
EOT, STX, ETX, ENQ, ACK = b"\x04", b"\x02", b"\x03", b"\x05", b"\x06"


def selected(address: int) -> bytes:
    group, unit = divmod(address, 10)
    return EOT + f"{group}{group}{unit}{unit}".encode()


def enquiry(address: int, mnemonic: str) -> bytes:
    return selected(address) + mnemonic.encode() + ENQ


def selection(address: int, mnemonic: str, value: float) -> bytes:
    """With the value as C prints a float, and the exclusive-or of all from the seventh byte on."""
    frame = selected(address) + STX + f"{mnemonic}{value:f}".encode() + ETX
    return frame + bytes((reduce(xor, frame[6:]),))


class StreamClient:
    """What StreamDevice does with a port: `refusals` has the codes that it read after a write."""

    def __init__(self, path: str) -> None:
        self._port = serial.Serial(path, 9600, timeout=PATIENCE)
        self.refusals: list[int] = []

    def __enter__(self) -> StreamClient:
        return self

    def __exit__(self, *_: object) -> None:
        self._port.close()

    def _read(self, address: int, mnemonic: str, value: bytes) -> str:
        self._port.write(enquiry(address, mnemonic))
        line = self._port.read_until(ETX)
        self._port.read(1)  # the checksum, which it waits for and drops
        found = re.fullmatch(STX + mnemonic.encode() + value + ETX, line)
        assert found is not None, line
        return found[1].decode()

    def read(self, address: int, mnemonic: str) -> float:
        return float(self._read(address, mnemonic, rb" *([+-]?\d*\.?\d*)"))

    def read_hex(self, address: int, mnemonic: str) -> int:
        return int(self._read(address, mnemonic, rb">([0-9A-F]+)"), 16)

    def write(self, address: int, mnemonic: str, value: float) -> None:
        self._port.write(selection(address, mnemonic, value))
        if self._port.read(1) != ACK:
            self.refusals.append(self.read_hex(address, "EE"))


@pytest.fixture
def line() -> Iterator[str]:
    devices = [make_device(address, lively=False) for address in INSTRUMENTS]
    with serve_pty(Line(PROFILE.line, devices, paced=False)) as server:
        yield server.path


def port(path: str) -> SerialPort:
    return SerialPort(path, baudrate=9600, bytesize=7, parity="E")


def test_every_instrument_gets_the_same_requests() -> None:
    for address in range(100):
        for mnemonic in ("PV", "SL", "OP", "EE", "II"):
            assert Read(mnemonic).open(address, PROFILE.timings).request == enquiry(address, mnemonic)
        for number in (0, 7, -40, 1200):
            ours = Write("SL", number).open(address, PROFILE.timings).request
            theirs = selection(address, "SL", number)
            assert ours[:8] == theirs[:8]
            # Both write numbers in free format: 7 and 7. are the same one.
            assert float(ours[8:-2]) == float(theirs[8:-2])
            assert ours[-1] == reduce(xor, ours[6:-1])


@pytest.mark.slow
@pytest.mark.asyncio
async def test_each_reads_what_the_other_has_written(line: str) -> None:
    for address in INSTRUMENTS:
        with StreamClient(line) as epics:
            epics.write(address, "SL", 450.5)
            epics.write(address, "TI", 120)
            assert epics.refusals == []
            assert epics.read(address, "SL") == 450.5
            identity = epics.read_hex(address, "II")
        async with Bus(port(line)) as bus:
            instrument = BisynchInstrument(bus, address)
            assert [await instrument.read(name) for name in ("SL", "TI", "II")] == [450.5, 120, identity]
            await instrument.write("SL", 300.5 + address)
        with StreamClient(line) as epics:
            assert epics.read(address, "SL") == 300.5 + address


@pytest.mark.slow
@pytest.mark.asyncio
async def test_each_gets_the_same_code_of_a_refusal(line: str) -> None:
    for name, value, code in (("PV", 3.0, 0x05C8), ("SL", 5000.0, 0x08C8)):
        with StreamClient(line) as epics:
            epics.write(1, name, value)
            assert epics.refusals == [code]
        async with Bus(port(line)) as bus:
            with pytest.raises(Refused, match=f"{code:04X}"):
                await BisynchInstrument(bus, 1).write(name, value)


def test_values_with_every_kind_of_checksum_are_read_one_after_the_other() -> None:
    devices = [make_device(address, lively=False) for address in INSTRUMENTS]
    with serve_pty(Line(PROFILE.line, devices, paced=False)) as server, StreamClient(server.path) as epics:
        for number in range(0, 1200, 7):
            device = devices[number % len(devices)]
            device.values[b"SL"] = number / 10
            assert epics.read(INSTRUMENTS[number % len(devices)], "SL") == number / 10

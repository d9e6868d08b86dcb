"""Questions to ask, with their bytes and the right answers: HCP2 reads of numbers, MSC reads of data, Modbus reads of
registers."""

from __future__ import annotations

from functools import reduce
from operator import xor

from benchmarks.masters import Question
from busmaster import LineSettings
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.modbus import codec as modbus
from busmaster.protocols.msc import codec as msc
from busmaster.protocols.msc.exchange import packet

STX, ETX, ACK = b"\x02", b"\x03", b"\x06"
NODES = (2, 3, 4, 5)
ELEMENTS = (1, 2, 100)


def telegram(content: bytes) -> bytes:
    """Return a reply in HCP2 with its checksum, built apart from the code that is measured."""
    return STX + content + ETX + bytes((reduce(xor, content + ETX),))


def hcp2_questions() -> list[Question]:
    """Three elements of four nodes; replies of 13 bytes, as a position in user units has them."""
    questions = []
    for address in NODES:
        for element in ELEMENTS:
            value = 1000.25 + 100 * address + element
            command = hcp2.Read(element)
            request = command.open(address, hcp2.PROFILE.timings).request
            questions.append(Question(command, address, request, (telegram(b"%02X%.2f" % (element, value)),), value))
    return questions


def msc_questions() -> list[Question]:
    """One data address of four units: an ACK, a packet, and the host's ACK."""
    questions = []
    for unit in NODES:
        value = -1000 * unit
        command = msc.DataRead(2000 + unit)
        request = command.open(unit, msc.PROFILE.timings).request
        reply = packet(unit, b"DREAD," + value.to_bytes(4, "big", signed=True))
        questions.append(Question(command, unit, request, (ACK, reply), value, closing=ACK))
    return questions


def modbus_questions() -> list[Question]:
    """One holding register of four units."""
    questions = []
    for unit in NODES:
        value = 1000 * unit
        command = modbus.ReadRegisters(unit)
        request = command.open(unit, modbus.PROFILE.timings).request
        reply = modbus.with_crc(bytes((unit, 3, 2)) + value.to_bytes(2, "big"))
        questions.append(Question(command, unit, request, (reply,), (value,)))
    return questions


def wire_time(ask: Question, settings: LineSettings, delay: float) -> float:
    """Seconds that the bits of this transaction, the device's reply time and the protocol's silence behind it take."""
    bits = len(ask.request) + sum(map(len, ask.reply)) + len(ask.closing)
    silence = modbus.SILENCE if isinstance(ask.command, modbus.ReadRegisters) else 0.0
    return bits * settings.byte_time + delay + silence

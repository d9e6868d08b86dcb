"""A Mentor II drive (ANSI x3.28-2.5-A4): a few parameters, a speed that follows its reference, and short commands.

    read    EOT a a a a m m p p ENQ                 ->  STX m m p p data ETX BCC, or EOT: there is no such parameter
    write   EOT a a a a STX m m p p data ETX BCC    ->  ACK or NAK; nothing, if it went to address 0
    then    ACK, NAK or BS alone                    ->  the next, same or previous parameter, as if it had been read

Characters have 7 bits. If a line carries 8, bit 7 may contain even parity: it is dropped, and sent if it was received.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from busmaster.emulator.chance import Chance
from busmaster.emulator.device import NAK, Delay, Device, held
from busmaster.emulator.motion import Ramp
from busmaster.emulator.traceable import TraceableMemory
from busmaster.errors import InvalidCommand
from busmaster.wire.checks import bcc

STX, ETX, EOT, ENQ = 0x02, 0x03, 0x04, 0x05
ACK, NO_SUCH_PARAMETER = b"\x06", b"\x04"
STEPS = {0x06: 1, 0x15: 0, 0x08: -1}
"""ACK, NAK and BS as short commands."""
IDLE = (0x00, 0x7F)
"""Bytes that are not characters: from a line that is released, or from hosts that pad their frames."""
FIRST_PRINTABLE = 0x20
DIGITS = b"0123456789"
BROADCAST = b"\x040000"
TEXT_AT = 5
"""Position of the parameter of a read, and of the STX of a write."""
READ_SIZE = 10
SHORTEST_WRITE = 12
KEPT = 32
"""Stored bytes of a frame: a longer one is refused."""
ITEM = re.compile(r"(\d{1,2})\.(\d{1,2})(?::wide|:\d+)?", re.ASCII)
VALUE = re.compile(rb"[+-]?\d{1,5}", re.ASCII)
LONGEST_VALUE = 5
HIGH_RESOLUTION = re.compile(rb"[+-]\d{5}", re.ASCII)
SEVEN_BITS = bytes(byte & 0x7F for byte in range(256))
EVEN_PARITY = bytes(byte & 0x7F | (byte & 0x7F).bit_count() % 2 << 7 for byte in range(256))
FINE = 10
"""Steps of the high resolution per ordinary step."""

SPEED_REFERENCE, SPEED_FEEDBACK, SERIAL_ADDRESS = 117, 302, 1111
FULL_SPEED = 1000
"""100.0 %."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """Its limits. `wide`: sent as five digits without a sign. `fine`: may be written in high resolution."""

    low: int
    high: int
    writable: bool = True
    wide: bool = False
    fine: bool = False


PLAIN = Parameter(-9999, 9999)
REFERENCE = Parameter(-FULL_SPEED, FULL_SPEED, fine=True)
PARAMETERS = {
    **dict.fromkeys(range(SPEED_REFERENCE, 137), REFERENCE),
    SPEED_FEEDBACK: Parameter(-FULL_SPEED, FULL_SPEED, writable=False),
    426: Parameter(0, 1),
    SERIAL_ADDRESS: Parameter(0, 99, writable=False),
    **dict.fromkeys((1314, 1560, 1561, 1562, 1563), Parameter(0, 65535, wide=True)),
}
"""By menu x 100 + number. The numbers are those of the document; the effect of most of them is not emulated."""


class EmulatedMentor(Device):
    """Addresses 1 to 99. The speed feedback 03.02 follows the speed reference 01.17, both in 0.1 %.

    `acceleration` is in 0.1 % per second. `ripple`: share, 0 to 1, by which the feedback varies with the shaft.
    `short_after_write`: short commands work after a write too. `refuse_malformed`: the reply to a malformed read
    request is a NAK, not silence. With a `traceable`, it provides every parameter.
    """

    def __init__(
        self,
        address: int,
        *,
        acceleration: float = 500.0,
        ripple: float = 0.0,
        short_after_write: bool = False,
        refuse_malformed: bool = False,
        delay: Delay | None = None,
        traceable: TraceableMemory | None = None,
    ) -> None:
        super().__init__(address, delay=delay)
        if not 1 <= address <= 99:
            raise InvalidCommand(f"a Mentor II has an address from 1 to 99, not {address}")
        if traceable is not None and traceable.modulus > 10**4:
            raise InvalidCommand(f"a Mentor II carries 10**4 traceable values, not {traceable.modulus}")
        self.parameters = dict(PARAMETERS)
        self.ripple = ripple
        self.short_after_write = short_after_write
        self.refuse_malformed = refuse_malformed
        self.traceable = traceable
        tens, units = divmod(address, 10)
        self._prefix = b"\x04%d%d%d%d" % (tens, tens, units, units)
        plain = (self._prefix, BROADCAST)
        self.routes = (*plain, *(route.translate(EVEN_PARITY) for route in plain))
        self._motor = Ramp(acceleration)
        self._fine: dict[int, int] = {}
        """The written values, in steps of the high resolution."""
        self._last: int | None = None
        """The parameter from which short commands start."""
        self._frame = bytearray()
        self._check_due = False
        self._parity = False
        self._known_reads: dict[bytes, int] = {}

    # Values

    def preset(self, item: str, *values: float) -> None:
        """Set a parameter ("1.17") and those after it. Missing parameters are added, as plain integers."""
        match = ITEM.fullmatch(item)
        if match is None:
            raise InvalidCommand(f"an emulated drive has no {item!r}: use a parameter such as 1.17")
        for name, value in enumerate(values, int(match[1]) * 100 + int(match[2])):
            parameter = self.parameters.setdefault(name, PLAIN)
            if name == SERIAL_ADDRESS:
                raise InvalidCommand(f"{item} is the drive's address: it cannot be given")
            number = held(self.steps(name, value), parameter.low, parameter.high, f"{item}, without its decimals,")
            self.set_value(name, number, 0.0)
            if name == SPEED_FEEDBACK:
                self._motor.speed = number

    def steps(self, parameter: int, value: float) -> float:
        """Return the whole number for a value on the line."""
        return value

    def value(self, parameter: int, now: float) -> int:
        """Return the value of parameter menu x 100 + number. Raises KeyError for one that does not exist."""
        if parameter not in self.parameters:
            raise KeyError(parameter)
        if self.traceable is not None:
            return self.traceable.read(parameter)
        if parameter == SPEED_FEEDBACK:
            return self._feedback(now)
        if parameter == SERIAL_ADDRESS:
            return self.address
        return math.trunc(self._fine.get(parameter, 0) / FINE)

    def set_value(self, parameter: int, value: float, now: float) -> None:
        """Set a value, in units of the ordinary resolution, without regard to the limits."""
        self._fine[parameter] = round(value * FINE)
        if parameter == SPEED_REFERENCE:
            self._motor.advance(now)
            self._motor.target = self._fine[parameter] / FINE

    def _feedback(self, now: float) -> int:
        motor = self._motor
        motor.advance(now)
        speed = motor.speed * (1 + self.ripple * math.sin(motor.position / FULL_SPEED * math.tau))
        return max(-FULL_SPEED, min(round(speed), FULL_SPEED))

    def restart(self, now: float) -> None:
        super().restart(now)
        self._ground()
        self._last = None
        self._fine.clear()
        self._motor = Ramp(self._motor.rate, now=now)

    # Receiving

    def take(self, frame: bytes, now: float) -> bool:
        if self._frame:
            return False
        known = self._known_reads.get(frame)
        if known is not None:
            self._parity = frame[0] != EOT
            self._answer_read(known, now)
        else:
            plain = frame.translate(SEVEN_BITS)
            reads = _is_read(plain)
            if not reads and not _is_write(plain):
                return False
            self._parity = frame[0] != EOT
            if reads and self._is_mine(plain):
                self._known_reads[frame] = int(plain[TEXT_AT:-1])
            self._handle(plain, now)
        self.attentive = self._last is not None
        return True

    def hear(self, data: bytes, start: float) -> None:
        if not self._frame and _is_read(data) and not self._is_mine(data):
            self._last = None
            self.attentive = False
        else:
            super().hear(data, start)

    def hear_byte(self, byte: int, now: float) -> None:
        character = byte & 0x7F
        if self._check_due:  # this character is the checksum, even if it is EOT
            self._frame.append(character)
            self._handle(bytes(self._frame), now)
            self._ground()
        elif character == EOT:
            self._ground()
            self._last = None
            self._parity = byte != EOT
            self._frame.append(EOT)
        elif self._frame:
            if len(self._frame) < KEPT:
                self._frame.append(character)
            self._go_on(character, now)
        elif self._last is not None and character not in IDLE:
            self._step(character, now)
        self.attentive = bool(self._frame) or self._last is not None

    def _go_on(self, character: int, now: float) -> None:
        frame = self._frame
        length = len(frame)
        if length <= TEXT_AT:
            legal = frame == self._prefix[:length] or frame == BROADCAST[:length]
        elif frame[TEXT_AT] == STX:
            self._check_due = character == ETX and length > READ_SIZE
            legal = length == TEXT_AT + 1 or character >= FIRST_PRINTABLE or self._check_due
        elif length < READ_SIZE:
            legal = character in DIGITS
        else:
            legal = False
            if character == ENQ:
                self._handle(bytes(frame), now)
                self._ground()
                return
        if not legal:
            malformed = length > TEXT_AT and frame[TEXT_AT] != STX
            if malformed and self.refuse_malformed and self._is_mine(frame):
                self._reply(NAK, now)
            self._ground()

    def _is_mine(self, frame: bytes | bytearray) -> bool:
        return frame.startswith(self._prefix)

    def _ground(self) -> None:
        self._frame.clear()
        self._check_due = False

    # Replying

    def _step(self, character: int, now: float) -> None:
        """Reply to a short command. Any other character ends them."""
        step = STEPS.get(character)
        if step is None or self._last is None:
            self._last = None
        else:
            # The guide does not define the next parameter at the end of a menu: here the number plus one.
            self._answer_read(self._last + step, now)

    def _handle(self, frame: bytes, now: float) -> None:
        """Execute a complete request, to this drive or to all."""
        self._last = None
        # The damaged checksum of a write may be ENQ: that does not make it a read.
        if frame[-1] == ENQ and len(frame) == READ_SIZE:
            if self._is_mine(frame):
                self._answer_read(int(frame[TEXT_AT:-1]), now)
            return
        taken = bcc(frame[TEXT_AT + 1 : -1]) == frame[-1] and self._write(frame[6:10], frame[10:-2], now)
        if not self._is_mine(frame):
            return
        # The guide does not define whether short commands work after a write. By default they do not.
        if taken and self.short_after_write:
            self._last = int(frame[6:10])
        self._reply(ACK if taken else NAK, now)

    def _answer_read(self, parameter: int, now: float) -> None:
        """Reply to a read. Short commands start from this parameter, even if it does not exist."""
        self._last = parameter
        if parameter not in self.parameters:
            self._reply(NO_SUCH_PARAMETER, now)
        else:
            self._reply(self._telegram(parameter, now), now)

    def _write(self, name: bytes, data: bytes, now: float) -> bool:
        parameter = self.parameters.get(int(name)) if name.isdigit() else None
        if parameter is None or not parameter.writable:
            return False
        fine = self._fine_of(parameter, data)
        if fine is None:
            return False
        if self.traceable is not None:
            self.traceable.write(int(name), fine / FINE)
        elif parameter.low * FINE <= fine <= parameter.high * FINE:
            self.set_value(int(name), fine / FINE, now)
        else:
            return False
        return True

    def _telegram(self, parameter: int, now: float) -> bytes:
        """Return the reply to a read of an existing parameter."""
        return telegram(parameter, self.value(parameter, now), self.parameters[parameter].wide)

    def _fine_of(self, parameter: Parameter, data: bytes) -> int | None:
        """Return the written value, in steps of the high resolution; None if it is not a value."""
        if HIGH_RESOLUTION.fullmatch(data):
            return int(data) if parameter.fine else None
        if VALUE.fullmatch(data) and len(data) <= LONGEST_VALUE:
            return int(data) * FINE
        return None

    def _reply(self, data: bytes, now: float) -> None:
        self.reply(data.translate(EVEN_PARITY) if self._parity else data, now)

    def disguise(self, reply: bytes, chance: Chance) -> bytes:
        if reply[0] & 0x7F != STX:
            return reply
        parameter = int(reply[1:5].translate(SEVEN_BITS))
        other = chance.randrange(0, 9999)
        data = reply[5:-2].translate(SEVEN_BITS) if self.traceable is None else b"%+05d" % self.traceable.elsewhere()
        summed = b"%04d" % (other + (other >= parameter)) + data + b"\x03"
        disguised = b"\x02" + summed + bytes((bcc(summed),))
        return disguised.translate(EVEN_PARITY) if reply[0] != STX else disguised


def _is_read(plain: bytes) -> bool:
    """Return True for a complete read request of 7-bit characters, to any drive."""
    return len(plain) == READ_SIZE and plain[0] == EOT and plain[-1] == ENQ and plain[1:-1].isdigit()


def _is_write(plain: bytes) -> bool:
    """Return True for a complete write request of 7-bit characters, to any drive.

    Faults in its text are detected by its checksum and by the drive.
    """
    return (
        len(plain) >= SHORTEST_WRITE
        and plain[0] == EOT
        and plain[TEXT_AT] == STX
        and plain[-2] == ETX
        and min(plain[TEXT_AT + 1 : -2]) >= FIRST_PRINTABLE
    )


@lru_cache(maxsize=4096)
def telegram(parameter: int, value: int, wide: bool = False) -> bytes:
    """Return a reply to a read: always five characters of data."""
    summed = b"%04d" % parameter + (b"%05d" if wide else b"%+05d") % value + b"\x03"
    return b"\x02" + summed + bytes((bcc(summed),))


def make_device(
    address: int,
    *,
    lively: bool,
    ripple: float | None = None,
    parameters: Mapping[str, Mapping[str, Any]] | None = None,
    device: type[EmulatedMentor] = EmulatedMentor,
    **options: Any,
) -> EmulatedMentor:
    """Make a drive with further parameters; if it is lively, it runs."""
    drive = device(address, ripple=(0.01 if lively else 0.0) if ripple is None else ripple, **options)
    for item, settings in (parameters or {}).items():
        match = ITEM.fullmatch(item)
        if match is None:
            raise InvalidCommand(f"{item!r} is not a parameter: write 7.05")
        drive.parameters[int(match[1]) * 100 + int(match[2])] = parameter_of(**settings)
    if lively:
        drive.set_value(SPEED_REFERENCE, 313 + 50 * (address % 8), 0.0)
    return drive


def parameter_of(
    low: float | None = None,
    high: float | None = None,
    *,
    read_only: bool = False,
    wide: bool = False,
    fine: bool = False,
) -> Parameter:
    """Return a parameter with these limits; by default the limits of its form."""
    least, most = (0, 65535) if wide else (PLAIN.low, PLAIN.high)
    low = least if low is None else held(low, least, most, "a lower limit")
    high = most if high is None else held(high, low, most, "an upper limit")
    return Parameter(low, high, writable=not read_only, wide=wide, fine=fine)

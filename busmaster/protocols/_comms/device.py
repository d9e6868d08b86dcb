"""The node's side of Host Comms Protocol (AN00110) and Host Comms Protocol 2 (AN00129): frames, numbers, ACK and NAK.

The kinds of device define the meaning of the elements: a Mint controller, a MicroFlex drive.
"""

from __future__ import annotations

import re
from abc import abstractmethod
from dataclasses import dataclass
from decimal import ROUND_HALF_UP, Context, Decimal
from functools import lru_cache

from busmaster.emulator.chance import Chance
from busmaster.emulator.device import NAK, Delay, Device
from busmaster.emulator.traceable import TraceableMemory
from busmaster.errors import InvalidCommand
from busmaster.wire.checks import xor

STX, ETX, EOT, ENQ, ACK, BEL = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07
FIRST_PRINTABLE = 0x20
LONGEST_WRITE = 60
LONGEST_REPLY_TEXT = 20
GREATEST = 1e9
"""Largest magnitude of an initial value."""
DECIMALS = Decimal("0.0001")
ROUNDING = Context(prec=LONGEST_WRITE + 20, rounding=ROUND_HALF_UP)
ELEMENT_AT = 4
"""Position of the element's two characters: after the reset byte, two node characters and STX."""
DATA_AT = 6
KEPT = 80
"""Stored bytes of a frame. A longer data field is only counted, and refused at its end."""
# A space behind digits ends a value, and the characters up to the next comma are skipped.
NUMBER = re.compile(rb" *([+-]?(?:\d+\.?\d*|\.\d+))(?: .*)?")


@dataclass(frozen=True, slots=True, eq=False)
class Framing:
    """The differences between the two protocols."""

    name: str
    reset: int
    base: int
    """Of the two digits of an element."""
    digits: bytes
    last_element: int
    check_from: int
    """Position of the first byte of a request that its checksum covers."""
    read_checked: bool
    """Whether a read carries a checksum."""

    def prefix(self, address: int) -> bytes:
        """Return the first bytes of a request to this node."""
        node = f"{address:X}" * 2 if self.base == 10 else f"{address:02X}"
        return bytes((self.reset,)) + node.encode()

    def element(self, number: int) -> bytes:
        """Return the two characters of an element number."""
        return (f"{number:02d}" if self.base == 10 else f"{number:02X}").encode()


HCP = Framing("hcp", EOT, 10, b"0123456789", 99, ELEMENT_AT, False)
HCP2 = Framing("hcp2", BEL, 16, b"0123456789ABCDEF", 255, 1, True)


def sendable(value: float, element: int) -> float:
    """Return the value. Raises InvalidCommand if a reply cannot carry it."""
    if not abs(value) <= GREATEST:
        raise InvalidCommand(f"element {element} holds {-GREATEST:g} to {GREATEST:g}, not {value:g}")
    return value


class HostCommsDevice(Device):
    """A node of either protocol. Each kind of device implements its elements: `read_element`, `write_element`.

    `fixed_decimals` sends "12.5000" instead of "12.5". `all_or_nothing` refuses a multi-value write before it stores
    any of it. With a `traceable`, it provides every element.
    """

    def __init__(
        self,
        address: int,
        framing: Framing = HCP2,
        *,
        delay: Delay | None = None,
        traceable: TraceableMemory | None = None,
        fixed_decimals: bool = False,
        all_or_nothing: bool = False,
    ) -> None:
        super().__init__(address, delay=delay)
        self.framing = framing
        self.traceable = traceable
        self.fixed_decimals = fixed_decimals
        self.all_or_nothing = all_or_nothing
        self._prefix = framing.prefix(address)
        self.routes = (self._prefix,)
        self._frame = bytearray()
        self._data_length = 0
        self._check_due = False
        self._known_reads: dict[bytes, int] = {}

    @abstractmethod
    def read_element(self, element: int, now: float) -> float | None:
        """Return its value, or None to refuse. The protocol can address `element`."""

    @abstractmethod
    def write_element(self, element: int, value: float, now: float) -> bool:
        """Store the value and return True, or return False to refuse it."""

    def writable(self, element: int) -> bool:
        """Return True if `write_element` would store a value for it now. Used only with `all_or_nothing`."""
        return True

    # Receiving

    def take(self, frame: bytes, now: float) -> bool:
        if self.attentive:
            return False
        element = self._known_reads.get(frame)
        if element is not None:
            self._answer_read(element, now)
            return True
        length = len(frame)
        if length <= DATA_AT or frame[3] != STX:
            return False
        if frame[DATA_AT] == ENQ:
            whole = length == DATA_AT + 1 + self.framing.read_checked
            printable = frame[ELEMENT_AT:DATA_AT]
        else:
            whole = length >= DATA_AT + 2 and frame[-2] == ETX
            printable = frame[ELEMENT_AT:-2]
        if not whole or min(printable) < FIRST_PRINTABLE:
            return False
        self._handle(frame, length - DATA_AT - 2, now)
        return True

    def hear_byte(self, byte: int, now: float) -> None:
        frame = self._frame
        if self._check_due:  # this byte is the checksum, even if it is the reset byte
            frame.append(byte)
            self._handle(bytes(frame), self._data_length, now)
            self._ground()
        elif byte == self.framing.reset:
            self._ground()
            frame.append(byte)
            self.attentive = True
        elif frame and not self._goes_on(byte, now):
            self._ground()

    def _goes_on(self, byte: int, now: float) -> bool:
        """Return True if `byte` continues the frame, and more bytes must follow."""
        frame = self._frame
        position = len(frame)
        if position < ELEMENT_AT - 1:
            legal = byte == self._prefix[position]
        elif position == ELEMENT_AT - 1:
            legal = byte == STX
        elif position < DATA_AT:
            legal = byte >= FIRST_PRINTABLE
        else:
            return self._data_goes_on(byte, now)
        frame.append(byte)
        return legal

    def _data_goes_on(self, byte: int, now: float) -> bool:
        frame = self._frame
        if byte >= FIRST_PRINTABLE:
            self._data_length += 1
            if len(frame) < KEPT:
                frame.append(byte)
            return True
        if byte == ENQ and not self._data_length:
            frame.append(byte)
            if self.framing.read_checked:
                self._check_due = True
                return True
            self._handle(bytes(frame), 0, now)
            return False
        frame.append(byte)
        self._check_due = byte == ETX
        return self._check_due

    def _ground(self) -> None:
        self._frame.clear()
        self._data_length = 0
        self._check_due = False
        self.attentive = False

    def restart(self, now: float) -> None:
        super().restart(now)
        self._ground()

    # Replying

    def _handle(self, frame: bytes, data_length: int, now: float) -> None:
        """Execute a complete request to this node, checksum included."""
        framing = self.framing
        reads = frame[DATA_AT] == ENQ
        name = frame[ELEMENT_AT:DATA_AT]
        checked = not reads or framing.read_checked
        right = not checked or xor(frame[framing.check_from : -1]) == frame[-1]
        # A lower-case digit in an element is refused like element 00. In a node address it has no reply.
        element = int(name, framing.base) if not name.strip(framing.digits) else 0
        if not right or not 1 <= element <= framing.last_element:
            self.reply(NAK, now)
        elif reads:
            self._known_reads[frame] = element
            self._answer_read(element, now)
        elif data_length <= LONGEST_WRITE and self._store(element, frame[DATA_AT:-2], now):
            self.reply(b"\x06", now)
        else:
            self.reply(NAK, now)

    def _answer_read(self, element: int, now: float) -> None:
        value = self.read_element(element, now) if self.traceable is None else self.traceable.read(element)
        text = None if value is None else number_text(value, self.fixed_decimals)
        if text is None or len(text) > LONGEST_REPLY_TEXT:
            self.reply(NAK, now)
        else:
            self.reply(telegram(self.framing, element, text), now)

    def _store(self, element: int, data: bytes, now: float) -> bool:
        """Store value by value and stop at the first bad one: the ACK or NAK is for the whole."""
        if not data[-1:].isdigit():  # the notes: the last character must be a digit
            return False
        values = numbers(data)
        elements = range(element, element + len(values))
        if self.all_or_nothing and (None in values or not all(map(self._may_write, elements))):
            return False
        for number, value in zip(elements, values, strict=True):
            if value is None or number > self.framing.last_element:  # the values before it stay stored (AN00129)
                return False
            if self.traceable is not None:
                self.traceable.write(number, value)
            elif not self.write_element(number, value, now):
                return False
        return True

    def _may_write(self, element: int) -> bool:
        return element <= self.framing.last_element and self.writable(element)

    def disguise(self, reply: bytes, chance: Chance) -> bytes:
        if reply[0] != STX:
            return reply
        element = int(reply[1:3], self.framing.base)
        other = chance.randrange(1, self.framing.last_element)
        text = reply[3:-2] if self.traceable is None else number_text(self.traceable.elsewhere())
        return telegram(self.framing, other + (other >= element), text)


@lru_cache(maxsize=4096)
def telegram(framing: Framing, element: int, text: bytes) -> bytes:
    """Return a reply to a read: STX, element, data, ETX, and the exclusive-or of all bytes after STX."""
    covered = framing.element(element) + text + b"\x03"
    return b"\x02" + covered + bytes((xor(covered),))


@lru_cache(maxsize=4096)
def numbers(data: bytes) -> tuple[float | None, ...]:
    """Return the values of a data field, rounded half up to 4 decimals. A malformed value ends the list as None."""
    values: list[float | None] = []
    for part in data.split(b","):
        match = NUMBER.fullmatch(part)
        if match is None:
            values.append(None)
            break
        values.append(float(Decimal(match[1].decode()).quantize(DECIMALS, context=ROUNDING)))
    return tuple(values)


@lru_cache(maxsize=4096)
def number_text(value: float, fixed_decimals: bool = False) -> bytes:
    """Return the text of a value: rounded half up to 4 decimals, without trailing zeros; never "-0"."""
    if fixed_decimals:
        return f"{_rounded(value) + 0:.4f}".encode()
    whole = int(value)
    if whole == value:
        return b"%d" % whole
    text = f"{_rounded(value):f}".rstrip("0").rstrip(".")
    return b"0" if text == "-0" else text.encode()


def _rounded(value: float) -> Decimal:
    return Decimal(repr(value)).quantize(DECIMALS, context=ROUNDING)

"""An instrument with EI-Bisynch: a loop whose process value follows its setpoint, words, tags, and the last error.

    read    EOT g g u u [channel] c1 c2 ENQ                     ->  STX [channel] c1 c2 data ETX BCC, or EOT
    write   EOT g g u u STX [channel] c1 c2 data ETX BCC        ->  ACK or NAK
    then    ACK or NAK alone, after a read that was answered    ->  the next parameter of the list, or the same again

Characters have 7 bits. If a line carries 8, bit 7 may contain even parity: it is dropped, and sent if it was received.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from busmaster.emulator.chance import Chance
from busmaster.emulator.device import NAK, Delay, Device, held
from busmaster.emulator.traceable import TraceableMemory
from busmaster.errors import InvalidCommand
from busmaster.wire.checks import bcc, xor

STX, ETX, EOT, ENQ, NEXT, AGAIN = 0x02, 0x03, 0x04, 0x05, 0x06, 0x15
ACK, NO_SUCH_PARAMETER = b"\x06", b"\x04"
IDLE = (0x00, 0x7F)
"""Bytes that are not characters: from a line that is released, or from hosts that pad their frames."""
SPACE, DELETE = 0x20, 0x7F
TEXT_AT = 5
"""Position of the mnemonic of a read, and of the STX of a write."""
READ_SIZES = (8, 9)
SHORTEST_WRITE = 11
KEPT = 32
"""Stored bytes of a frame: a longer one is refused."""
CHANNEL = ord("1")
"""Channel of an instrument with one loop. Optional in a request."""
SEVEN_BITS = bytes(byte & 0x7F for byte in range(256))
EVEN_PARITY = bytes(byte & 0x7F | (byte & 0x7F).bit_count() % 2 << 7 for byte in range(256))
NUMBER = re.compile(rb" *[+-]?(\d+\.?\d*|\.\d+) *", re.ASCII)
WORD = re.compile(rb">[0-9A-Fa-f]{1,4}")
LONGEST_VALUE = 12
MODULUS = 10**5
ITEM = re.compile(r"(?:tag(?P<tag>\d{1,4})|1?(?P<mnemonic>[!-~]{2}))(?::hex)?", re.ASCII)
LETTERS = b"abcdefghijklmnopqrstuvwxyz"
DIGITS = b"0123456789" + LETTERS
LAST_TAG = 1611

NO_ERROR, NO_MNEMONIC, BAD_CHECK = 0x00C0, 0x01C7, 0x02C2
WRITE_ONLY, READ_ONLY, BAD_DATA, OUT_OF_RANGE = 0x04C8, 0x05C8, 0x07C8, 0x08C8


@dataclass(frozen=True, slots=True)
class Parameter:
    """Its limits, its access, and whether it is a word that is sent as hexadecimal digits."""

    low: float = -99999
    high: float = 99999
    writable: bool = True
    readable: bool = True
    hexadecimal: bool = False


MEASURED = Parameter(writable=False)
WORD_READ_ONLY = Parameter(0, 0xFFFF, writable=False, hexadecimal=True)
PARAMETERS = {
    b"II": WORD_READ_ONLY,
    b"V0": WORD_READ_ONLY,
    b"EE": Parameter(0, 0xFFFF, hexadecimal=True),
    b"PV": MEASURED,
    b"SL": Parameter(0, 1200),
    b"SP": MEASURED,
    b"OP": Parameter(-100, 100),
    b"mA": Parameter(0, 1),
    b"LI": MEASURED,
    b"ID": Parameter(0, 9999),
    b"XP": Parameter(0, 999.9),
    b"TI": Parameter(0, 9999),
    b"TD": Parameter(0, 9999),
    b"RR": Parameter(0, 999.9),
    b"dm": Parameter(0, 7),
    b"fi": Parameter(0, 9),
}
"""In the order of the instrument's own list, through which a single ACK steps."""
INITIAL = {b"II": 0x2480, b"V0": 0x0302, b"EE": NO_ERROR, b"PV": 20.0, b"SL": 20.0, b"XP": 20.0, b"TI": 360, b"TD": 60}


class EmulatedBisynch(Device):
    """Addresses 0 to 99. The process value PV follows the setpoint SL within some `lag`s, in seconds.

    `fixed_width`: sent numbers are filled with zeros. `printable_check`: 32 is added to a BCC below 32. With a
    `traceable`, it provides every parameter.
    """

    def __init__(
        self,
        address: int,
        *,
        lag: float = 60.0,
        fixed_width: int = 0,
        printable_check: bool = False,
        delay: Delay | None = None,
        traceable: TraceableMemory | None = None,
    ) -> None:
        super().__init__(address, delay=delay)
        if not 0 <= address <= 99:
            raise InvalidCommand(f"an instrument has an address from 0 to 99, not {address}")
        if fixed_width > LONGEST_VALUE:
            raise InvalidCommand(f"a value has {LONGEST_VALUE} characters at most, not {fixed_width}")
        if traceable is not None and traceable.modulus > MODULUS:
            raise InvalidCommand(f"EI-Bisynch carries 10**5 traceable values, not {traceable.modulus}")
        self.parameters = dict(PARAMETERS)
        self.values: dict[bytes, float] = dict(INITIAL)
        self.traceable = traceable
        self._lag = lag
        self._width = fixed_width
        self._check = bcc if printable_check else xor
        group, unit = divmod(address, 10)
        self._prefix = b"\x04%d%d%d%d" % (group, group, unit, unit)
        self.routes = (self._prefix, self._prefix.translate(EVEN_PARITY))
        self._as_of: float | None = None
        """The time of the process value in `values`; None before it is first needed."""
        self._last: bytes | None = None
        """The name that was read last, from which short commands start."""
        self._frame = bytearray()
        self._check_due = False
        self._parity = False

    # Values

    def preset(self, item: str, *values: float) -> None:
        """Set a parameter ("SL", "tag247") and, for tags, those after it. Missing parameters are added."""
        for name, value in zip(run_of(item, len(values)), values, strict=True):
            parameter = self.parameters.setdefault(name, Parameter())
            if parameter.hexadecimal:
                value = held(value, 0, 0xFFFF, item)
            if not parameter.low <= value <= parameter.high:
                raise InvalidCommand(f"{item} holds {parameter.low:g} to {parameter.high:g}, not {value:g}")
            self.values[name] = value

    def value(self, name: bytes, now: float) -> float:
        """Return the value of a parameter that it has."""
        if self.traceable is not None:
            return self.traceable.read(int.from_bytes(name, "big"))
        if name in (b"PV", b"OP"):
            self._advance(now)
        if name == b"SP":
            name = b"SL"
        return self.values.get(name, 0)

    def _advance(self, now: float) -> None:
        """Update process value and output to the time `now`."""
        values = self.values
        setpoint = values[b"SL"]
        if self._as_of is None:
            self._as_of = now
        away = (values[b"PV"] - setpoint) * math.exp(-max(0.0, now - self._as_of) / self._lag)
        values[b"PV"], self._as_of = setpoint + away, now
        if not values.get(b"mA"):
            values[b"OP"] = max(-100.0, min(-100 * away / (values[b"XP"] or 1.0), 100.0))

    def restart(self, now: float) -> None:
        super().restart(now)
        self._ground()
        self._last = None
        self.values[b"EE"] = NO_ERROR

    # Receiving

    def take(self, frame: bytes, now: float) -> bool:
        if self._frame:
            return False
        plain = frame.translate(SEVEN_BITS)
        if not _is_read(plain) and not _is_write(plain):
            return False
        self._parity = frame[0] != EOT
        self._handle(plain, now)
        self.attentive = self._last is not None
        return True

    def hear_byte(self, byte: int, now: float) -> None:
        character = byte & 0x7F
        if self._check_due:  # a checksum may be any character, an EOT too
            self._frame.append(character)
            self._handle(bytes(self._frame), now)
            self._ground()
        elif character == EOT:
            self._ground()
            self._last = None
            self._parity = byte != EOT
            self._frame.append(EOT)
        elif self._frame:
            self._frame.append(character)
            self._go_on(character, now)
        elif self._last is not None and character not in IDLE:
            self._short(character, now)
        self.attentive = bool(self._frame) or self._last is not None

    def _go_on(self, character: int, now: float) -> None:
        frame = self._frame
        length = len(frame)
        if length <= TEXT_AT:
            legal = frame == self._prefix[:length]
        elif length > KEPT:
            legal = False
        elif frame[TEXT_AT] == STX:
            self._check_due = character == ETX and length > SHORTEST_WRITE - 2
            legal = length == TEXT_AT + 1 or SPACE <= character < DELETE or self._check_due
        elif character == ENQ and length in READ_SIZES:
            self._handle(bytes(frame), now)
            legal = False
        else:
            legal = SPACE < character < DELETE and length < READ_SIZES[-1]
        if not legal:
            self._ground()

    def _ground(self) -> None:
        self._frame.clear()
        self._check_due = False

    # Replying

    def _short(self, character: int, now: float) -> None:
        """Reply to a short command. Any other character ends them."""
        last, self._last = self._last, None
        assert last is not None
        if character == AGAIN:
            self._answer_read(last, now)
        elif character == NEXT:
            names = list(self.parameters)
            place = names.index(last[-2:]) + 1
            self._answer_read(last[:-2] + names[place] if place < len(names) else b"", now)

    def _handle(self, frame: bytes, now: float) -> None:
        """Execute a complete request to this instrument."""
        self._last = None
        if frame[TEXT_AT] != STX:
            self._answer_read(frame[TEXT_AT:-1], now)
            return
        error = BAD_CHECK
        if self._check(frame[TEXT_AT + 1 : -1]) == frame[-1]:
            error = self._write(frame[TEXT_AT + 1 : -2])
        if error:
            self.values[b"EE"] = error
        self._reply(NAK if error else ACK, now)

    def _answer_read(self, name: bytes, now: float) -> None:
        parameter = self._found(name)
        if parameter is None or not parameter.readable:
            self.values[b"EE"] = NO_MNEMONIC if parameter is None else WRITE_ONLY
            self._reply(NO_SUCH_PARAMETER, now)
            return
        self._last = name
        self._reply(self._telegram(name, self._text(parameter, self.value(name[-2:], now))), now)

    def _found(self, name: bytes) -> Parameter | None:
        """Return the parameter with this name, which may begin with the channel of its only loop."""
        if len(name) == 3 and name[0] != CHANNEL:
            return None
        return self.parameters.get(name[-2:]) if len(name) in (2, 3) else None

    def _write(self, text: bytes) -> int:
        """Store the value of a write. Returns the code of the error, 0 if it was stored."""
        size = 3 if text[0] == CHANNEL and text[1:3] in self.parameters else 2
        name, data = text[:size], text[size:]
        parameter = self._found(name)
        if parameter is None:
            return NO_MNEMONIC
        if not parameter.writable:
            return READ_ONLY
        if name[-2:] == b"EE" and self.traceable is None:
            self.values[b"EE"] = NO_ERROR
            return 0
        if len(data) > LONGEST_VALUE:
            return BAD_DATA
        if WORD.fullmatch(data):
            value: float = int(data[1:], 16)
        elif NUMBER.fullmatch(data):
            value = float(data)
        else:
            return BAD_DATA
        if self.traceable is not None:
            self.traceable.write(int.from_bytes(name[-2:], "big"), value)
        elif not parameter.low <= value <= parameter.high:
            return OUT_OF_RANGE
        else:
            self.values[name[-2:]] = value
        return 0

    def _text(self, parameter: Parameter, value: float) -> bytes:
        """Return a value as it is sent: in hexadecimal, or with a decimal point and without unnecessary zeros."""
        if parameter.hexadecimal and self.traceable is None:
            return b">%04X" % int(value)
        value = round(value, 4)  # never "-0."
        digits = b"%d." % value if value == int(value) else (b"%.4f" % value).rstrip(b"0")
        return digits.zfill(self._width)

    def _telegram(self, name: bytes, text: bytes) -> bytes:
        summed = name + text + b"\x03"
        return b"\x02" + summed + bytes((self._check(summed),))

    def _reply(self, data: bytes, now: float) -> None:
        self.reply(data.translate(EVEN_PARITY) if self._parity else data, now)

    def disguise(self, reply: bytes, chance: Chance) -> bytes:
        plain = reply.translate(SEVEN_BITS)
        if plain[0] != STX:
            return reply
        size = 3 if plain[1] == CHANNEL and plain[2:4] in self.parameters else 2
        others = [name for name in self.parameters if name != plain[size - 1 : size + 1]]
        name = plain[1 : size - 1] + others[chance.randrange(0, len(others))]
        data = plain[1 + size : -2] if self.traceable is None else b"%d." % self.traceable.elsewhere()
        disguised = self._telegram(name, data)
        return disguised.translate(EVEN_PARITY) if reply[0] != STX else disguised


def _is_read(plain: bytes) -> bool:
    """Return True for a complete read request of 7-bit characters, to any instrument."""
    size = len(plain)
    return size in READ_SIZES and plain[-1] == ENQ and plain[0] == EOT and all(map(_is_visible, plain[TEXT_AT:-1]))


def _is_visible(character: int) -> bool:
    return SPACE < character < DELETE


def _is_write(plain: bytes) -> bool:
    """Return True for a complete write request of 7-bit characters, to any instrument."""
    return (
        SHORTEST_WRITE <= len(plain) <= KEPT
        and plain[0] == EOT
        and plain[TEXT_AT] == STX
        and plain[-2] == ETX
        and all(SPACE <= character < DELETE for character in plain[TEXT_AT + 1 : -2])
    )


def run_of(item: str, count: int) -> list[bytes]:
    """Return the mnemonics of `count` parameters from an item on; several only from a tag on. Raises InvalidCommand."""
    match = ITEM.fullmatch(item)
    if match is None or (match["tag"] is None and count != 1):
        raise InvalidCommand(f"an emulated instrument has no {item!r}: use one value for a mnemonic, such as SL")
    if match["tag"] is None:
        return [match["mnemonic"].encode()]
    first = int(match["tag"])
    if first + count > LAST_TAG + 1:
        raise InvalidCommand(f"{item}: the last tag is {LAST_TAG}")
    return [mnemonic_of(tag) for tag in range(first, first + count)]


def mnemonic_of(tag: int) -> bytes:
    """Return the mnemonic of a tag number: two digits to the base 36 up to "zz", then to the base 26 as in "aA"."""
    if tag < len(LETTERS) * len(DIGITS):
        return bytes((LETTERS[tag // len(DIGITS)], DIGITS[tag % len(DIGITS)]))
    rest = tag - len(LETTERS) * len(DIGITS)
    return bytes((LETTERS[rest // len(LETTERS)], LETTERS.upper()[rest % len(LETTERS)]))


def make_device(
    address: int, *, lively: bool, parameters: Mapping[str, Mapping[str, Any]] | None = None, **options: Any
) -> EmulatedBisynch:
    """Make an instrument with further parameters; if it is lively, it heats up."""
    instrument = EmulatedBisynch(address, **options)
    for item, settings in (parameters or {}).items():
        instrument.parameters[run_of(item, 1)[0]] = parameter_of(**settings)
    if lively:
        instrument.values[b"SL"] = 200.0 + 10 * (address % 8)
    return instrument


def parameter_of(
    low: float = -99999,
    high: float = 99999,
    *,
    read_only: bool = False,
    write_only: bool = False,
    hexadecimal: bool = False,
) -> Parameter:
    """Return a parameter with these limits, or those of a word."""
    if hexadecimal:
        low, high = max(low, 0), min(high, 0xFFFF)
    if low > high:
        raise InvalidCommand(f"an upper limit is at least the lower one, {low:g}, not {high:g}")
    return Parameter(low, high, not read_only, not write_only, hexadecimal)

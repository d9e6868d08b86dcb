"""The telnet codec of RFC 2217: bytes and commands in both directions, without a socket or a clock.

A serial server sends data and commands in one stream. A command begins with IAC (255), and a data byte 255 is doubled.
RFC 854 defines the commands, RFC 856 binary transmission, RFC 2217 the subnegotiations of COM-PORT-OPTION.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Final, TypeAlias

from busmaster.contract.profile import LineSettings

IAC: Final = 255
DONT, DO, WONT, WILL, SB, SE = 254, 253, 252, 251, 250, 240
BINARY, SUPPRESS_GO_AHEAD, COM_PORT = 0, 3, 44
LONGEST_SUBNEGOTIATION = 256
"""Bytes of one subnegotiation with its framing. Those of RFC 2217 have up to 14; a signature text is longer."""
FROM_SERVER = 100
"""A server answers command N with N + 100."""
SIZES = {"N": 1, "O": 2, "E": 3, "M": 4, "S": 5}, {1: 1, 2: 2, 1.5: 3}
"""How SET-PARITY and SET-STOPSIZE write parities and stop bits."""


class Set(enum.IntEnum):
    """Commands of the client."""

    BAUDRATE = 1
    DATASIZE = 2
    PARITY = 3
    STOPSIZE = 4
    CONTROL = 5
    LINESTATE_MASK = 10


class Notice(enum.IntEnum):
    """Messages of the server that are not confirmations."""

    LINESTATE = 106
    MODEMSTATE = 107
    SUSPEND = 108
    RESUME = 109
    LINESTATE_MASK = 110


class Control(enum.IntEnum):
    """Values of SET-CONTROL."""

    NO_FLOW_CONTROL = 1
    XON_XOFF = 2
    RTS_CTS = 3
    DTR_ON = 8
    DTR_OFF = 9
    RTS_ON = 11
    RTS_OFF = 12


class LineError(enum.IntFlag):
    """Bits of NOTIFY-LINESTATE that are errors. The other bits report the state of its transmitter and receiver."""

    OVERRUN = 2
    PARITY = 4
    FRAMING = 8
    BREAK = 16


LINE_ERRORS = LineError.OVERRUN | LineError.PARITY | LineError.FRAMING | LineError.BREAK


class TelnetError(ValueError):
    """The stream breaks the rules of telnet, so that data and commands cannot be separated any more."""


@dataclass(frozen=True, slots=True)
class Negotiation:
    """WILL, WONT, DO or DONT, and the option."""

    verb: int
    option: int


@dataclass(frozen=True, slots=True)
class Subnegotiation:
    """A message of COM-PORT-OPTION: its code and its value."""

    code: int
    value: bytes


Piece: TypeAlias = bytes | Negotiation | Subnegotiation


class TelnetReader:
    """Splits a received stream into data and commands. A command can be split at any byte."""

    def __init__(self) -> None:
        self._begun = b""
        """The beginning of a command that is not complete; bounded by LONGEST_SUBNEGOTIATION."""

    def take(self, data: bytes) -> list[Piece]:
        """Return the data and commands that `data` completes, in order. Raises TelnetError."""
        data = self._begun + data
        self._begun = b""
        pieces: list[Piece] = []
        plain = bytearray()
        at = 0
        while (iac := data.find(IAC, at)) >= 0:
            plain += data[at:iac]
            command, at = self._command(data, iac)
            if command == b"":
                continue
            if isinstance(command, bytes):
                plain += command
                continue
            if plain:
                pieces.append(bytes(plain))
                plain.clear()
            pieces.append(command)
        plain += data[at:]
        if plain:
            pieces.append(bytes(plain))
        return pieces

    def _command(self, data: bytes, at: int) -> tuple[Piece, int]:
        """Return the command at this IAC and where it ends: b"" for one that is ignored or not complete."""
        verb = data[at + 1] if at + 1 < len(data) else None
        if verb == IAC:
            return b"\xff", at + 2
        if verb == SB:
            return self._subnegotiation(data, at)
        if verb in (WILL, WONT, DO, DONT) and at + 2 < len(data):
            return Negotiation(verb, data[at + 2]), at + 3
        if verb is None or verb in (WILL, WONT, DO, DONT):
            self._begun = data[at:]
            return b"", len(data)
        return b"", at + 2  # NOP, GO AHEAD and the like: nothing is due

    def _subnegotiation(self, data: bytes, begin: int) -> tuple[Piece, int]:
        body = bytearray()
        at, is_complete = begin + 2, False
        # An IAC at the very end is not decided yet: the next byte may double it.
        while not is_complete and 0 <= (iac := data.find(IAC, at)) < len(data) - 1:
            body += data[at:iac]
            at, is_complete = iac + 2, data[iac + 1] == SE
            if data[iac + 1] == IAC:
                body.append(IAC)
            elif not is_complete:
                raise TelnetError("a telnet subnegotiation is broken off by another command")
        # R12: a server that never ends a command must not fill the memory. The same however the stream is split.
        if (at if is_complete else len(data)) - begin > LONGEST_SUBNEGOTIATION:
            raise TelnetError(f"a telnet subnegotiation is longer than {LONGEST_SUBNEGOTIATION} bytes")
        if not is_complete:
            self._begun = data[begin:]
            return b"", len(data)
        # Another option, such as the terminal type: ignored, as telnet requires.
        if len(body) < 2 or body[0] != COM_PORT:
            return b"", at
        return Subnegotiation(body[1], bytes(body[2:])), at


def escaped(data: bytes) -> bytes:
    """Return data as it is sent: each byte 255 is doubled."""
    return data.replace(b"\xff", b"\xff\xff")


def negotiation(verb: int, option: int) -> bytes:
    """Return WILL, WONT, DO or DONT with an option as bytes."""
    return bytes((IAC, verb, option))


def subnegotiation(code: int, value: bytes) -> bytes:
    """Return a message of COM-PORT-OPTION as bytes."""
    return bytes((IAC, SB, COM_PORT)) + escaped(bytes((code,)) + value) + bytes((IAC, SE))


def values_of(settings: LineSettings) -> dict[Set, bytes]:
    """Return the values of the commands that set a remote port so."""
    parities, stop_bits = SIZES
    return {
        Set.BAUDRATE: settings.baudrate.to_bytes(4, "big"),
        Set.DATASIZE: bytes((settings.bytesize,)),
        Set.PARITY: bytes((parities[settings.parity],)),
        Set.STOPSIZE: bytes((stop_bits[settings.stopbits],)),
    }


def value_text(command: Set, value: bytes) -> str:
    """Return the value of a confirmation as text: "9600 baud", "parity E"."""
    number = int.from_bytes(value, "big")
    match command:
        case Set.BAUDRATE:
            return f"{number} baud"
        case Set.DATASIZE:
            return f"{number} data bits"
        case Set.PARITY:
            return f"parity {next((name for name, code in SIZES[0].items() if code == number), number)}"
        case Set.STOPSIZE:
            return f"stop bits {next((bits for bits, code in SIZES[1].items() if code == number), number)}"
    return next((one.name.replace("_", " ") for one in Control if one == number), str(number))

"""A DC104-SER drive: 255 registers of 16 bits behind packets without an address. Their meaning is not published.

    read   STX AA parameter sum              ->  STX parameter high low sum
    write  STX 55 parameter high low sum     ->  ACK once it is in the EEPROM, or NAK

The sum is that of all bytes between STX and itself, modulo 256.
"""

from __future__ import annotations

import math

from busmaster.contract.arguments import is_decimal
from busmaster.emulator.chance import Chance
from busmaster.emulator.device import NAK, Delay, Device, held
from busmaster.emulator.traceable import TraceableMemory
from busmaster.errors import InvalidCommand
from busmaster.wire.checks import sum8

STX, READ, WRITE = 0x02, 0xAA, 0x55
ACK = b"\x06"
SIZES = {READ: 4, WRITE: 6}
LAST_PARAMETER = 255
INTER_BYTE_TIMEOUT = 0.05  # the manual does not define how a drive finds the start of a packet again
"""Seconds after which an incomplete packet is dropped."""
LIVE = 1
"""The parameter that moves on a lively drive: a sine about the middle of its range."""
SWING, TURN = 10_000, 10.0


class EmulatedDc104(Device):
    """The drive of a line. Parameters 1 to `maximum`; `allow_zero`: 0 too. `read_only` ones refuse writes.

    `eeprom`: the time for storing a value. `silent`: a read of a missing parameter has no reply, instead of a NAK,
    because the document defines NAK only for writes. `lively`: parameter 1 moves. With a `traceable`, it
    provides every value.
    """

    def __init__(
        self,
        address: int = 0,
        *,
        maximum: int = LAST_PARAMETER,
        allow_zero: bool = False,
        read_only: frozenset[int] = frozenset(),
        eeprom: Delay | None = None,
        silent: bool = False,
        lively: bool = False,
        delay: Delay | None = None,
        traceable: TraceableMemory | None = None,
    ) -> None:
        super().__init__(address, delay=delay)
        if not 1 <= maximum <= LAST_PARAMETER:
            raise InvalidCommand(f"the last parameter is from 1 to {LAST_PARAMETER}, not {maximum}")
        if traceable is not None and traceable.modulus > 2**16:
            raise InvalidCommand(f"a DC104 carries 2**16 traceable values, not {traceable.modulus}")
        self.registers = [0] * (LAST_PARAMETER + 1)
        self.parameters = range(0 if allow_zero else 1, maximum + 1)
        self.read_only = read_only
        self.eeprom = Delay(0.01) if eeprom is None else eeprom
        self.silent = silent
        self.lively = lively
        self.traceable = traceable
        self.routes = (bytes((STX, READ)), bytes((STX, WRITE)))
        self._frame = bytearray()
        self._heard_at = 0.0

    def preset(self, item: str, *values: float) -> None:
        """Set values from a parameter on. A parameter that is set does not move."""
        if not is_decimal(item) or not {int(item), int(item) + len(values) - 1} <= set(self.parameters):
            last = self.parameters.stop - 1
            raise InvalidCommand(f"an emulated DC104 cannot store the values at {item!r}: its last parameter is {last}")
        for parameter, value in enumerate(values, int(item)):
            self.registers[parameter] = held(value, 0, 0xFFFF, f"parameter {parameter}")
            self.lively &= parameter != LIVE

    def restart(self, now: float) -> None:
        """Restart with the same parameters, which are in the EEPROM; an incomplete frame is dropped."""
        super().restart(now)
        self._frame.clear()

    # Receiving

    def take(self, frame: bytes, now: float) -> bool:
        if self._frame or len(frame) != SIZES[frame[1]]:
            return False
        self._handle(frame, now)
        return True

    def hear_byte(self, byte: int, now: float) -> None:
        frame = self._frame
        if frame and now - self.tau - self._heard_at > INTER_BYTE_TIMEOUT:
            frame.clear()
        self._heard_at = now
        if len(frame) == 1 and byte not in SIZES:
            frame.clear()
        if frame or byte == STX:
            frame.append(byte)
        if len(frame) > 1 and len(frame) == SIZES[frame[1]]:
            self._handle(bytes(frame), now)
            frame.clear()
        self.attentive = bool(frame)

    # Replying

    def _handle(self, frame: bytes, now: float) -> None:
        parameter = frame[2]
        right = sum8(frame[1:-1]) == frame[-1] and parameter in self.parameters
        if frame[1] == READ:
            if right:
                self.reply(packet(parameter, self._read(parameter, now)), now)
            elif not self.silent:
                self.reply(NAK, now)
        elif right and parameter not in self.read_only:
            self._write(parameter, int.from_bytes(frame[3:5], "big"))
            self.reply(ACK, now + self.eeprom.draw(self.chance))
        else:
            self.reply(NAK, now)

    def _read(self, parameter: int, now: float) -> int:
        if self.traceable is not None:
            return self.traceable.read(parameter)
        if self.lively and parameter == LIVE:
            return 2**15 + round(SWING * math.sin(now / TURN * math.tau))
        return self.registers[parameter]

    def _write(self, parameter: int, value: int) -> None:
        self.registers[parameter] = value
        if self.traceable is not None:
            self.traceable.write(parameter, value)

    def disguise(self, reply: bytes, chance: Chance) -> bytes:
        if reply[0] != STX:
            return reply
        other = chance.randrange(0, LAST_PARAMETER)
        value = int.from_bytes(reply[2:4], "big") if self.traceable is None else self.traceable.elsewhere()
        return packet(other + (other >= reply[1]), value)


def packet(parameter: int, value: int) -> bytes:
    """Return a reply to a read. It has no direction byte."""
    summed = bytes((parameter, value >> 8, value & 0xFF))
    return bytes((STX,)) + summed + bytes((sum8(summed),))


make_device = EmulatedDc104

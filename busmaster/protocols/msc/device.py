"""An MSC controller (IB-11A002 rev E): packets, data variables, flags, a program that counts, retransmission.

    packet    STX unit length16 sequence16 body checksum16    big-endian; the sum of all bytes from unit to body

It replies with an ACK, or with a NAK if the packet is damaged, unknown or refers to a missing address. A packet with
data follows its ACK, and is sent again until the host ACKs it, five times at most ("Data transfer sequence").
"""

from __future__ import annotations

from typing import Any

from busmaster.contract.arguments import is_decimal
from busmaster.emulator.chance import Chance
from busmaster.emulator.device import NAK, NEVER, Delay, Device, held
from busmaster.emulator.traceable import TraceableMemory
from busmaster.errors import InvalidCommand
from busmaster.wire.checks import sum16

# Nothing here is shared with the codec: otherwise the same misinterpretation on both sides would not be noticed.
STX, ACK_BYTE, NAK_BYTE = 0x02, 0x06, 0x15
ACK = b"\x06"
UNITS = range(1, 16)
HEADER, FRAMING = 6, 8
LONGEST_BODY = 240
RETRANSMISSIONS = 5
COMPLETION = 0.5
"""Seconds from a packet's first byte in which it must be complete."""
PATIENCE = 1.0
"""Seconds from a packet's last byte in which the host must have ACKed it."""
FLAGS = 256
BLOCK = 32
VALUE = 4
"""Bytes of a data value."""
MODELS = {"MSC-250": True, "MSC-850": False, "MSC-850/32": True}
"""Whether each model has RFLAGS."""
OPERANDS = {
    b"DREAD,": 2,
    b"DWRITE,": 2 + VALUE,
    b"BREAD,": 2,
    b"BWRITE,": 2 + VALUE * BLOCK,
    b"SFLAG,": 2,
    b"CFLAG,": 2,
    b"RFLAG,": 2,
    b"RFLAGS,": 0,
    b"RQSTAT,": 0,
}
"""Number of bytes after each command's name."""
REPLIES = {b"DREAD,": VALUE, b"BREAD,": VALUE * BLOCK, b"RFLAGS,": FLAGS // 8, b"RQSTAT,": 8}
"""The same in its reply, if it differs. A packet with this length is a reply, not a request."""

RUNNING, RAM_NOT_RELIABLE, SYSTEM_RESET, AUTO_START = 1, 4, 8, 64
RUN_FLAG = 200
"""The user flag with which the program counts. Chosen here, like the address: the document has no program."""
SHORTEST_COUNT_PERIOD = 0.001
FORM = "an existing data address, flag:5, flags (the numbers of those that are on), or status"
COUNT = 2000
"""The data address at which it counts."""


class EmulatedMsc(Device):
    """One unit, 1 to 15. Its macroprogram is running: while flag 200 is on it adds 1 to the value at 2000, once every
    `period` seconds.

    `address_step`: difference of the data addresses of two consecutive 32-bit values, 4, 2 or 1. The document does not
    define whether addresses count bytes. `addresses`: how many exist. `read_only_flags` (inputs, timers) cannot be set
    or cleared. `battery`: data survives a power failure, and the program starts again. `packet_delay`: time from the
    end of an ACK to the packet after it. With a `traceable`, it provides every data value.

    For tests: `naks_ahead` of the next requests are refused without effect. `missing_acks_ahead` of the next ACKs are
    omitted. `bad_packets_ahead` of the next packets have a wrong bit.

    Raises InvalidCommand for a unit, model or step that does not exist.
    """

    def __init__(
        self,
        address: int,
        *,
        model: str = "MSC-250",
        address_step: int = 4,
        addresses: int = 0x8000,
        read_only_flags: frozenset[int] = frozenset(),
        battery: bool = False,
        period: float = 0.1,
        delay: Delay | None = None,
        packet_delay: Delay | None = None,
        traceable: TraceableMemory | None = None,
    ) -> None:
        super().__init__(address, delay=delay)
        if address not in UNITS or model not in MODELS or address_step not in (1, 2, 4):
            raise InvalidCommand(
                f"no MSC is unit {address}, an {model!r} or has addresses {address_step} apart: use units 1 to 15, "
                f"{', '.join(MODELS)}, and steps of 1, 2 or 4"
            )
        if period < SHORTEST_COUNT_PERIOD:
            raise InvalidCommand(f"its program counts every {SHORTEST_COUNT_PERIOD} s at most, not every {period:g} s")
        if traceable is not None and traceable.modulus > 2**31:
            raise InvalidCommand(f"an MSC carries 2**31 traceable values, not {traceable.modulus}")
        self.model = model
        self.address_step = address_step
        self.read_only_flags = read_only_flags
        self.battery = battery  # the manual does not define which data survives without power
        self.period = period
        self.packet_delay = Delay() if packet_delay is None else packet_delay
        self.traceable = traceable
        self.flags: set[int] = set()
        """The numbers, 0 to 255, of those that are on."""
        self.status = RUNNING | AUTO_START
        self.naks_ahead = self.missing_acks_ahead = self.bad_packets_ahead = 0
        self.retransmitted = 0
        """Packets that were sent again."""
        self.routes = (bytes((STX, address)),)
        self._width = VALUE // address_step
        """Bytes per address."""
        self._memory = bytearray(addresses * self._width)
        self._counted_until = NEVER
        self._frame = bytearray()
        self._size = FRAMING
        self._complete_by = NEVER
        self._packet = b""
        """The packet that the host has not ACKed yet."""
        self._retransmissions = 0
        self._retransmit_at = NEVER

    # Values

    def preset(self, item: str, *values: float) -> None:
        """Set values from a data address on ("2008"), 0 or 1 in "flag:5" and those after it, or the word in "status".

        "flags" has the numbers of those that are on.
        """
        name, _, number = item.partition(":")
        if item == "flags":
            self.flags = {held(value, 0, FLAGS - 1, "a flag") for value in values}
        elif item == "status" and len(values) == 1:
            self.status = held(values[0], 0, 0xFFFF, item)
        elif name == "flag" and is_decimal(number) and int(number) + len(values) <= FLAGS:
            for flag, on in enumerate(values, int(number)):
                (self.flags.add if held(on, 0, 1, "a flag") else self.flags.discard)(flag)
        elif is_decimal(name) and int(name) * self._width + len(values) * VALUE <= len(self._memory):
            self.set_value(int(name), *(held(value, -(2**31), 2**31 - 1, "a data address") for value in values))
        else:
            raise InvalidCommand(f"an emulated MSC cannot store the values at {item!r}: use {FORM}")

    @property
    def unacknowledged(self) -> bool:
        """It has sent a packet and waits for the host's ACK."""
        return bool(self._packet)

    def value(self, address: int) -> int:
        """Return the signed 32-bit value at a data address. Raises KeyError for one that does not exist."""
        return int.from_bytes(self._memory[self._bytes_of(address, 1)], "big", signed=True)

    def set_value(self, address: int, *values: int) -> None:
        """Set consecutive values from a data address on. Raises KeyError, and OverflowError beyond 32 bits."""
        data = b"".join(value.to_bytes(VALUE, "big", signed=True) for value in values)
        self._memory[self._bytes_of(address, len(values))] = data

    def _bytes_of(self, address: int, count: int) -> slice:
        start = address * self._width
        end = start + count * VALUE
        if end > len(self._memory):
            raise KeyError(address)
        return slice(start, end)

    def restart(self, now: float) -> None:
        super().restart(now)
        self._frame.clear()
        self._packet = b""
        self._counted_until = NEVER
        self.flags.clear()
        if not self.battery:
            self._memory = bytearray(len(self._memory))
            self.status = SYSTEM_RESET | RAM_NOT_RELIABLE

    # Receiving

    def take(self, frame: bytes, now: float) -> bool:
        if self._frame or len(frame) < FRAMING or len(frame) != int.from_bytes(frame[2:4], "big") + FRAMING:
            return False
        self._handle(frame, now)
        self._settle(now)
        return True

    def hear_byte(self, byte: int, now: float) -> None:
        if now > self.wakeup:
            self.wake(now)
        frame = self._frame
        if frame:
            frame.append(byte)
            self._go_on(now)
        elif byte == STX:
            frame.append(STX)
            self._size = FRAMING
            self._complete_by = now + COMPLETION
        elif self._packet and byte == ACK_BYTE:
            self._packet = b""
        elif self._packet and byte == NAK_BYTE:
            self._transmit_again(now)
        self._settle(now)

    def _go_on(self, now: float) -> None:
        """Execute the packet that the last byte completed, if it is for this unit.

        Any byte can occur anywhere in a packet, so only its length shows its end, also for packets to other units.
        """
        frame = self._frame
        length = len(frame)
        if length == 2 and frame[1] not in UNITS:
            frame.clear()
        elif length == 4:
            self._size = int.from_bytes(frame[2:4], "big") + FRAMING
        elif length == self._size:
            whole = bytes(frame)
            frame.clear()
            if whole[1] == self.address:  # packets to other units are counted too: their data may contain an STX
                self._handle(whole, now)

    def wake(self, now: float) -> None:
        if self._frame:
            mine = self._frame.startswith(self.routes)
            self._frame.clear()
            if mine:
                self.reply(NAK, now)
        else:
            self._transmit_again(now)
        self._settle(now)

    def _settle(self, now: float) -> None:
        """Decide whether it must receive every byte from now on, and when `wake` is due."""
        if self._frame:
            self.attentive = True
            self.wakeup = self._complete_by
        elif self._packet:
            self.attentive = True
            self.wakeup = self._retransmit_at = max(self._retransmit_at, now)
        else:
            self.attentive = False
            self.wakeup = NEVER

    # Replying

    def _handle(self, frame: bytes, now: float) -> None:
        """Reply to a complete packet to this unit. The host does not ACK an earlier packet any more."""
        body = frame[HEADER:-2]
        name = body[: body.find(b",") + 1]
        operand = body[len(name) :]
        if len(operand) == REPLIES.get(name):  # on two wires it may receive its own packet
            return
        self._packet = b""  # the manual does not define this case: here the packet is dropped
        if self.naks_ahead:
            self.naks_ahead -= 1
            self.reply(NAK, now)
            return
        sound = sum16(frame[1:-2]) == int.from_bytes(frame[-2:], "big")
        answer = None
        if sound and len(body) <= LONGEST_BODY and len(operand) == OPERANDS.get(name):
            answer = self._perform(name, operand, now)
        if answer is None:
            self.reply(NAK, now)
            return
        heard_at = now
        if self.missing_acks_ahead:
            self.missing_acks_ahead -= 1
        else:
            heard_at = self.reply(ACK, now)
            self.lag = 0.0  # if a reply is late, only its ACK is
        if answer:
            self._packet = packet(self.address, name + answer)
            self._retransmissions = 0
            self._transmit(heard_at, self.packet_delay)

    def _transmit(self, now: float, delay: Delay) -> None:
        data = self._packet
        if self.bad_packets_ahead:
            self.bad_packets_ahead -= 1
            data = data[:-1] + bytes((data[-1] ^ 1,))
        self._retransmit_at = self.reply(data, now, delay.draw(self.chance)) + PATIENCE

    def _transmit_again(self, now: float) -> None:
        if self._retransmissions == RETRANSMISSIONS:
            self._packet = b""
            return
        self._retransmissions += 1
        self.retransmitted += 1
        self._transmit(now, self.delay)

    def _perform(self, name: bytes, operand: bytes, now: float) -> bytes | None:
        """Return the data of its reply: empty for a write, None to refuse."""
        if RUN_FLAG in self.flags:
            self._count(now)
        if name == b"RQSTAT,":
            return self.status.to_bytes(2, "big") + bytes(6)
        if name == b"RFLAGS,":
            if not MODELS[self.model]:
                return None
            return sum(1 << flag for flag in self.flags).to_bytes(FLAGS // 8, "little")
        number = int.from_bytes(operand[:2], "big")
        if name in (b"SFLAG,", b"CFLAG,", b"RFLAG,"):
            return self._perform_on_flag(name, number)
        try:
            place = self._bytes_of(number, 1 if name[0] == ord("D") else BLOCK)
        except KeyError:
            return None
        if len(operand) > 2:
            self._store(number, place, operand[2:])
            return b""
        if self.traceable is None:
            return bytes(self._memory[place])
        numbers = range(number, number + (place.stop - place.start) // self._width, self.address_step)
        return b"".join(self.traceable.read(at).to_bytes(VALUE, "big") for at in numbers)

    def _store(self, address: int, place: slice, data: bytes) -> None:
        self._memory[place] = data
        if self.traceable is not None:
            for index in range(len(data) // VALUE):
                value = int.from_bytes(data[index * VALUE : (index + 1) * VALUE], "big", signed=True)
                self.traceable.write(address + index * self.address_step, value)

    def _perform_on_flag(self, name: bytes, flag: int) -> bytes | None:
        if flag >= FLAGS:
            return None
        if name == b"RFLAG,":
            return (flag in self.flags).to_bytes(2, "big")
        if flag in self.read_only_flags:
            return None
        if name == b"SFLAG,":
            self.flags.add(flag)
        else:
            self.flags.discard(flag)
        if flag == RUN_FLAG:
            self._counted_until = NEVER
        return b""

    def _count(self, now: float) -> None:
        """Count the steps of the program since the last request. Its time begins with the first request."""
        if self._counted_until == NEVER or not self.status & RUNNING:
            self._counted_until = now
        steps = int((now - self._counted_until) / self.period)
        if steps > 0:
            self._counted_until += steps * self.period
            self.set_value(COUNT, (self.value(COUNT) + steps + 2**31) % 2**32 - 2**31)

    def disguise(self, reply: bytes, chance: Chance) -> bytes:
        if reply[0] != STX:
            return reply
        other = chance.randrange(UNITS.start, UNITS.stop - 1)
        body = reply[HEADER:-2]
        if self.traceable is not None and body.startswith(b"DREAD,"):
            body = body[:-VALUE] + self.traceable.elsewhere().to_bytes(VALUE, "big")
        return packet(other + (other >= self.address), body)


def packet(unit: int, body: bytes) -> bytes:
    """Return `body` as a packet. The block sequence number is "not presently used": 0."""
    summed = bytes((unit,)) + len(body).to_bytes(2, "big") + bytes(2) + body
    return bytes((STX,)) + summed + sum16(summed).to_bytes(2, "big")


def make_device(
    address: int, *, delay: Delay, traceable: TraceableMemory | None, lively: bool, **options: Any
) -> EmulatedMsc:
    """Make a unit; if it is lively, its program counts."""
    controller = EmulatedMsc(address, delay=delay, traceable=traceable, **options)
    if lively:
        controller.flags.add(RUN_FLAG)
    return controller

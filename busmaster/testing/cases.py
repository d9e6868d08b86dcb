"""What a tester says of a protocol, and what the conformance kit answers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from busmaster.contract.exchange import Command
from busmaster.emulator.device import Device
from busmaster.errors import Refused


@dataclass(frozen=True)
class Case:
    """One exchange as the protocol's document has it.

    `steps` is what the node says, one item a step: one for most protocols; in MSC the ACK and the packet; none for a
    broadcast. A node that has to be asked again (a NAK that the reader answers by itself) says one step each time.
    It ends with `value`, or `raises` Refused or its subclass. `request` is what must be sent, if that is to be checked.
    """

    command: Command[Any]
    address: int
    steps: Sequence[bytes]
    value: Any = None
    raises: type[Refused] | None = None
    request: bytes | None = None

    def __str__(self) -> str:
        return f"{self.command} of {self.address}"


@dataclass(frozen=True)
class Foreign:
    """Bytes that `command` to `address` must not accept, and why they might come."""

    command: Command[Any]
    address: int
    heard: bytes
    why: str


@dataclass(frozen=True)
class Unseen:
    """A flipped bit that the protocol itself cannot see: `heard` in place of `reply`, accepted for the reason `why`."""

    reply: bytes
    heard: bytes
    why: str


@dataclass(frozen=True)
class RoundTrip:
    """Each of `values`, written by `write(value)` to `address` of the device, is what `read` then reads.

    `read_back` makes the value that must be read of the one that was written (a rounded one, for example).
    """

    address: int
    write: Callable[[Any], Command[Any]]
    read: Command[Any]
    values: Iterable[Any]
    read_back: Callable[[Any], Any] = field(default=lambda value: value)


class NotConformant(AssertionError):
    """The protocol breaks its contract. `findings` has one sentence for each place."""

    def __init__(self, name: str, findings: Sequence[str]) -> None:
        super().__init__(f"{name}: {len(findings)} findings\n" + "\n".join(f"- {finding}" for finding in findings))
        self.findings = tuple(findings)


Tally = Counter[str]
"""How much was tried, by kind: "splits", "truncations", "flips", "foreign", "garbage", "round trips"."""


def answers_of(device: Device) -> Callable[[bytes], bytes]:
    """Return an emulated device, alone on a line on which nothing takes time, as what `round_trips` ask."""

    def answer(heard: bytes) -> bytes:
        device.hear(heard, 0.0)
        replies = b"".join(data for _, data in device.outbox)
        device.outbox.clear()
        return replies

    return answer

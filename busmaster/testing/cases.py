"""The input of the conformance kit for a protocol, and its results."""

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
    """One exchange from the protocol's document.

    `steps`: the node's transmissions, one item per step: one for most protocols; in MSC the ACK and the packet; none
    for a broadcast. If the reader repeats a request itself (after a NAK), the node transmits one step each
    time. The exchange ends with `value`, or `raises` Refused or its subclass. `request`: the bytes that must be sent,
    if they are to be checked.
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
    """Bytes that `command` to `address` must not accept, and why they might arrive."""

    command: Command[Any]
    address: int
    heard: bytes
    why: str


@dataclass(frozen=True)
class Unseen:
    """A flipped bit that the protocol cannot detect: `heard` instead of `reply`, accepted for the reason `why`."""

    reply: bytes
    heard: bytes
    why: str


@dataclass(frozen=True)
class RoundTrip:
    """Each of `values`, written by `write(value)` to `address` of the device, must be what `read` then returns.

    `read_back` calculates the expected value from the written one, for example by rounding.
    """

    address: int
    write: Callable[[Any], Command[Any]]
    read: Command[Any]
    values: Iterable[Any]
    read_back: Callable[[Any], Any] = field(default=lambda value: value)


class NotConformant(AssertionError):
    """The protocol breaks its contract. `findings` has one sentence for each fault."""

    def __init__(self, name: str, findings: Sequence[str]) -> None:
        super().__init__(f"{name}: {len(findings)} findings\n" + "\n".join(f"- {finding}" for finding in findings))
        self.findings = tuple(findings)


Tally = Counter[str]
"""Number of tests by kind: "splits", "truncations", "flips", "foreign", "garbage", "round trips"."""


def answers_of(device: Device) -> Callable[[bytes], bytes]:
    """Return an emulated device, alone on a line without delays, as a function for `round_trips`."""

    def answer(heard: bytes) -> bytes:
        device.hear(heard, 0.0)
        replies = b"".join(data for _, data in device.outbox)
        device.outbox.clear()
        return replies

    return answer

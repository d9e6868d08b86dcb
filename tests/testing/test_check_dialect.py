"""The conformance kit: what a listener gets wrong is found, and said in one sentence each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest

from busmaster.contract.exchange import Command
from busmaster.contract.frames import Dialect, Direction, Frame, Kind
from busmaster.errors import InvalidCommand, Refused
from busmaster.protocols.hcp import PROTOCOL as HCP
from busmaster.protocols.hcp.capture import HcpDialect
from busmaster.protocols.hcp.codec import Read, Write
from busmaster.registry import NodeKind, Protocol
from busmaster.testing import Case, NotConformant, check_dialect

READ = Case(Read(1), 2, [bytes.fromhex("02 30 31 31 32 33 2E 34 35 36 03 2B")])
WRITE = Case(Write(1, (5,)), 2, [b"\x06"])
REFUSAL = Case(Read(99), 2, [b"\x15"], raises=Refused)
CASES = [READ, WRITE, REFUSAL]


def with_dialect(dialect: Callable[[], Dialect], commands: dict[str, Any] | None = None) -> Protocol:
    [kind] = HCP.kinds
    own = NodeKind("heard-wrongly", kind.handle, kind.make_device, items="")
    return Protocol(HCP.profile, (own,), HCP.commands if commands is None else commands, dialect)


def findings(protocol: Protocol, cases: Sequence[Case] = CASES) -> str:
    with pytest.raises(NotConformant) as caught:
        check_dialect(protocol, cases)
    return "\n".join(caught.value.findings)


class CutsTooSoon(HcpDialect):
    """Where the check has not come yet, it takes the frame to be whole."""

    def size(self, data: bytes, sender: Direction, /, *, quiet: bool = False) -> int:
        return super().size(data, sender, quiet=quiet) or (len(data) if data.endswith(b"\x03") else 0)


class SwallowsWhatFollowsNoise(HcpDialect):
    def size(self, data: bytes, sender: Direction, /, *, quiet: bool = False) -> int:
        return -len(data) if self._swallows(data) else super().size(data, sender, quiet=quiet)

    def _swallows(self, data: bytes) -> bool:
        self.deaf = getattr(self, "deaf", False) or data[0] == 0xFF
        return self.deaf


class TakesWritesForReads(HcpDialect):
    def explain(self, raw: bytes, sender: Direction, /) -> Frame:
        frame = super().explain(raw, sender)
        if frame.kind is Kind.WRITE:
            frame.kind = Kind.READ
        return frame


class FindsFaultWithRequests(HcpDialect):
    def _request(self, raw: bytes) -> Frame:
        frame = super()._request(raw)
        frame.fault = "bad checksum"
        return frame


class FindsFaultWithReplies(HcpDialect):
    def explain(self, raw: bytes, sender: Direction, /) -> Frame:
        frame = super().explain(raw, sender)
        if frame.answers:
            frame.fault = "bad checksum"
        return frame


class ReadsTheNextNode(HcpDialect):
    def node(self, field: bytes) -> int | None:
        return (super().node(field) or 0) + 1


class SpeaksOfTheNextElement(HcpDialect):
    def command(self, request: Frame, continued: Sequence[Frame], /) -> Command[Any]:
        return Read(int(request.item) + 1)


class SpeaksOfNothing(HcpDialect):
    def command(self, request: Frame, continued: Sequence[Frame], /) -> Command[Any]:
        raise InvalidCommand("no command of ours")


class ForgetsWhatWasAsked(HcpDialect):
    def _request(self, raw: bytes) -> Frame:
        frame = super()._request(raw)
        self._asked = None
        return frame


class TakesRefusalsForAcknowledgements(HcpDialect):
    def explain(self, raw: bytes, sender: Direction, /) -> Frame:
        frame = super().explain(raw, sender)
        if frame.kind is Kind.NAK:
            frame.kind = Kind.VALUE
        return frame


def test_a_dialect_that_reads_rightly_passes() -> None:
    check_dialect(HCP, CASES)


@pytest.mark.parametrize(
    ("dialect", "finding"),
    [
        (CutsTooSoon, "one byte at a time it is"),
        (SwallowsWhatFollowsNoise, "after noise it is"),
        (TakesWritesForReads, "not a write of the host"),
        (FindsFaultWithRequests, "[bad checksum], not a read of the host"),
        (FindsFaultWithReplies, "[bad checksum], which does not end the request"),
        (ReadsTheNextNode, "its request is decoded as one to 3"),
        (SpeaksOfTheNextElement, "is decoded as read element 2, which sends"),
        (SpeaksOfNothing, "gives no command"),
        (ForgetsWhatWasAsked, "which does not end the request"),
        (TakesRefusalsForAcknowledgements, "not a refusal"),
    ],
    ids=lambda value: value.__name__ if isinstance(value, type) else "",
)
def test_a_dialect_that_reads_wrongly_is_found(dialect: Callable[[], Dialect], finding: str) -> None:
    assert finding in findings(with_dialect(dialect))


def test_a_command_that_is_not_listed_is_found() -> None:
    assert "cannot be converted to JSON and back" in findings(with_dialect(HcpDialect, {"read": Read}), [WRITE])


def test_a_command_that_is_read_back_as_another_is_found() -> None:
    protocol = with_dialect(HcpDialect, {"read": Read, "write": Write})
    kept = Case(Write(1, (5,), idempotent=True), 2, [b"\x06"])
    check_dialect(protocol, [kept])

    class Forgetful(Protocol):
        __slots__ = ()

        def read_back(self, written: Any) -> Command[Any]:
            return super().read_back({key: value for key, value in written.items() if key != "idempotent"})

    forgetful = Forgetful(protocol.profile, protocol.kinds, protocol.commands, protocol.dialect)
    assert "and back to Write(element=1" in findings(forgetful, [kept])

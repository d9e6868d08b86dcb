"""A line under attack, recorded: its capture says of every exchange what the arbiter said; so does a replay of it."""

from __future__ import annotations

import io

import pytest

from busmaster.capture.assemble import Assembler
from busmaster.capture.pcapng import Outcome, PcapngWriter, read_packets
from busmaster.capture.replay import replay_packets
from busmaster.contract.frames import Direction
from busmaster.contract.tap import Attempt, Verdict
from tests.tiers import in_turn_by_default
from tests.verification.campaigns.hunt import Hunt
from tests.verification.campaigns.kinds import KINDS

MIXES = (
    *("calm", "cancelled", "garbled", "glued-bytewise", "refusals", "echo", "everything"),
    *("all stand still", "repeated"),
)
EACH = 300
"""Transactions of one campaign."""


class Tape:
    """A tap that writes a capture, and remembers how every attempt ended."""

    def __init__(self, echo: bool) -> None:
        self.file = io.BytesIO()
        self.ended: list[Attempt] = []
        self.begun: list[Attempt] = []
        self.assembler = Assembler(PcapngWriter(self.file).write, echo=echo)

    def transmitted(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        if attempt is not None and attempt not in self.begun[-1:]:
            self.begun.append(attempt)
        self.assembler.passed(now, data, Direction.HOST, attempt)

    def received(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        self.assembler.passed(now, data, Direction.NODE, attempt)

    def attempted(self, attempt: Attempt, /) -> None:
        self.ended.append(attempt)
        self.assembler.attempted(attempt)


def recorded(protocol: str, mix: str, seed: int) -> Tape:
    """A campaign on tape. Whether its line echoes is drawn from the seed, so it is asked first."""
    tape = Tape(Hunt(protocol, mix, seed).line.echo is not None)
    totals = Hunt(protocol, mix, seed, tap=tape).run(EACH)
    assert not totals.problems
    return tape


@pytest.mark.parametrize(("protocol", "mix"), in_turn_by_default(KINDS, MIXES))
def test_a_replay_says_what_the_arbiter_said(protocol: str, mix: str) -> None:
    tape = recorded(protocol, mix, 1)
    tape.assembler.finish(1e6)
    tape.file.seek(0)
    packets = list(read_packets(tape.file))
    assert [packet.micros for packet in packets] == sorted(packet.micros for packet in packets)
    assert tape.ended == tape.begun

    judged = [packet for packet in packets if packet.outcome not in (Outcome.NONE, Outcome.UNEXPECTED)]
    outcomes = {(packet.transaction, packet.attempt): packet.outcome for packet in judged}
    assert len(outcomes) == len(judged)
    assert outcomes == {(one.transaction, one.number): Outcome[one.verdict.name] for one in tape.ended if one.verdict}

    exchanges = list(replay_packets(packets))
    assert len(exchanges) == len(tape.ended)
    for one, attempt in zip(exchanges, tape.ended, strict=True):
        assert one.recorded.outcome.name == attempt.verdict.name if attempt.verdict else None
        assert not one.changed, f"packet {one.packet}: {one.command}: was {one.recorded}, is {one.now}"
        if attempt.verdict is Verdict.OK:
            assert one.now.text == ("ok" if attempt.result is None else repr(attempt.result))

"""A probe of `doctor` and `discover`, as a capture of it has it."""

from __future__ import annotations

import random

import pytest

from busmaster.app.diagnostics.probing import Outcome, Prober, opened
from busmaster.contract.profile import LineSettings
from busmaster.contract.tap import Attempt, Tap, Verdict
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Echo, Line
from busmaster.emulator.memory import MemoryPort
from busmaster.registry import find, make_device
from busmaster.testing.virtual_time import run_in_virtual_time

SETTINGS = LineSettings(57600)


class Attempts(Tap):
    """Keeps the attempts."""

    def __init__(self) -> None:
        self.ended: list[Attempt] = []
        self.of_bytes: list[Attempt | None] = []

    def transmitted(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        self.of_bytes.append(attempt)

    def received(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        self.of_bytes.append(attempt)

    def attempted(self, attempt: Attempt, /) -> None:
        self.ended.append(attempt)


@pytest.mark.parametrize(
    ("corrupt", "outcome", "verdict"),
    [(0.0, Outcome.ANSWERED, Verdict.OK), (1.0, Outcome.GARBLED, Verdict.SPOILT)],
)
def test_an_echo_that_differs_is_recorded_as_a_spoilt_exchange(
    corrupt: float, outcome: Outcome, verdict: Verdict
) -> None:
    """SPOILT: what came was not read. A damaged reply, which was read, is GARBLED."""
    profile, tap = find("hcp2").profile, Attempts()
    line = Line(SETTINGS, [make_device("hcp2", 3)], chance=random.Random(1), echo=Echo(corrupt=corrupt))

    async def ask() -> Outcome:
        async with opened(MemoryPort(line), tap) as wire:
            prober = Prober(wire, profile, profile.timings, SETTINGS.byte_time, echo=True)
            return (await prober.ask(3)).outcome

    assert run_in_virtual_time(ask()) is outcome
    assert [attempt.verdict for attempt in tap.ended] == [verdict]


def test_each_byte_of_a_probe_is_recorded_with_its_attempt_and_each_attempt_has_its_number() -> None:
    profile, tap = find("hcp2").profile, Attempts()
    line = Line(SETTINGS, [make_device("hcp2", 3)], chance=random.Random(1))

    async def ask() -> None:
        async with opened(MemoryPort(line), tap) as wire:
            prober = Prober(wire, profile, profile.timings, SETTINGS.byte_time, echo=False)
            for node in (3, 4):
                await prober.ask(node)
            assert wire.attempt is None

    run_in_virtual_time(ask())
    assert [(attempt.transaction, attempt.address, attempt.verdict) for attempt in tap.ended] == [
        (1, 3, Verdict.OK),
        (2, 4, Verdict.NO_REPLY),
    ]
    assert {attempt.purpose for attempt in tap.ended} == {"probe"}
    replied, silent = tap.ended
    assert [attempt is replied for attempt in tap.of_bytes] == [True] * (len(tap.of_bytes) - 1) + [False]
    assert len(tap.of_bytes) > 2, "the request of each, and a reply"
    assert tap.of_bytes[-1] is silent


@pytest.mark.parametrize(("delay", "outcome"), [(0.149, Outcome.ANSWERED), (0.17, Outcome.SILENT)])
def test_a_reply_within_its_time_is_waited_for_as_long_as_the_adapter_can_hold_it(
    delay: float, outcome: Outcome
) -> None:
    profile = find("hcp2").profile
    assert profile.timings.read.max_reply_delay == 0.15
    line = Line(SETTINGS, [make_device("hcp2", 3, delay=Delay(delay))], chance=random.Random(1), latency=0.016)

    async def ask() -> Outcome:
        async with opened(MemoryPort(line)) as wire:
            return (await Prober(wire, profile, profile.timings, SETTINGS.byte_time, echo=False).ask(3)).outcome

    assert run_in_virtual_time(ask()) is outcome

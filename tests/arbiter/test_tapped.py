"""What an arbiter tells whoever taps its line: which attempt is on the wire, and how each one ended."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from busmaster.arbiter.counters import Mark
from busmaster.arbiter.dispatcher import Dispatcher
from busmaster.contract.driver import EndlessExchange
from busmaster.contract.exchange import Expect, Sizes
from busmaster.contract.tap import Attempt, Verdict
from busmaster.contract.timing import Timings
from busmaster.errors import BusError
from busmaster.protocols.hcp2 import codec as hcp2
from tests.arbiter.bench import (
    BAD_CHECKSUM,
    FIVE,
    MAX_REPLY_DELAY,
    NAK,
    QUIET,
    READ_1_OF_NODE_1,
    Bench,
    up,
)
from tests.contract.test_driver import Odd


def ended(bench: Bench) -> list[Attempt]:
    return [event for event in bench.events if isinstance(event, Attempt)]


def said(bench: Bench) -> list[str]:
    """How each attempt ended: which request and attempt it was, the verdict, and what came of it in words."""
    verdicts = [(one, one.verdict) for one in ended(bench) if one.verdict is not None]
    return [f"{one.transaction}.{one.number} {verdict.value}: {one}" for one, verdict in verdicts]


def test_an_attempt_is_on_the_wire_from_its_request_to_its_end() -> None:
    bench = Bench(tapped=True)
    node = bench.node()
    bench.ask(node)
    attempt = bench.arbiter.attempt
    assert attempt is not None
    assert (attempt.protocol, attempt.address, attempt.verdict, attempt.late) == ("hcp2", 1, None, False)
    assert attempt.request == bytes.fromhex(READ_1_OF_NODE_1)
    bench.hear(FIVE, after=0.004)
    after = bench.arbiter.attempt
    assert after is None
    assert ended(bench) == [attempt]
    assert said(bench) == ["1.1 ok: read element 1: 5.0"]
    assert attempt.ended_at == bench.now


def test_the_end_is_told_before_the_transaction_and_the_next_one_is_on_the_wire_already() -> None:
    bench = Bench(tapped=True)
    node = bench.node()
    bench.ask(node)
    bench.ask(node)
    first = bench.arbiter.attempt
    bench.hear(FIVE, after=0.004)
    second = bench.arbiter.attempt
    assert first is not None
    assert second is not None
    assert (first.transaction, second.transaction) == (1, 2)
    assert first.verdict is Verdict.OK
    assert bench.events[0] is first


def test_each_attempt_of_a_request_has_its_own_verdict() -> None:
    bench = Bench(tapped=True)
    bench.ask(bench.node(), retries=1)
    bench.hear(BAD_CHECKSUM, after=0.004)
    bench.wait(QUIET + 0.152)
    assert [line.partition(":")[0] for line in said(bench)] == ["1.1 garbled", "1.2 no reply"]


def test_a_refusal_that_is_confirmed_is_two() -> None:
    bench = Bench(tapped=True)
    bench.ask(bench.node(), hcp2.Write(1, (5.0,)))
    bench.hear(NAK, after=0.004)
    bench.hear(NAK, after=0.004)
    assert said(bench) == ["1.1 refused: write element 1 = 5: refused", "1.2 refused: write element 1 = 5: refused"]


def test_what_is_not_read_is_spoilt() -> None:
    for paced, echo in ((False, False), (True, False), (False, True)):
        bench = Bench(tapped=True, paced=paced, echo=echo)
        bench.ask(bench.node(), retries=0)
        if paced:
            bench.hear(FIVE)
        elif echo:
            bench.hear("FF")
        else:
            bench.arbiter.byte_marked(Mark.DAMAGED, bench.now)
            bench.listen()
        (one,) = ended(bench)
        assert one.verdict is Verdict.SPOILT


def test_a_good_answer_that_may_be_anothers_is_ambiguous() -> None:
    bench = Bench(tapped=True)
    bench.ask(bench.node(), retries=0)
    bench.hear(f"{FIVE} {FIVE}", after=0.004)
    assert said(bench) == ["1.1 ambiguous: read element 1: two replies received, one expected"]


def test_the_loss_of_the_line_cuts_it_off() -> None:
    bench = Bench(tapped=True)
    bench.ask(bench.node())
    bench.arbiter.line_down("unplugged", bench.now)
    bench.listen()
    assert said(bench) == ["1.1 cut off: read element 1: the line is down: unplugged"]
    assert bench.arbiter.attempt is None


def test_one_whose_caller_has_gone_says_so() -> None:
    bench = Bench(tapped=True)
    transaction = bench.ask(bench.node())
    bench.arbiter.cancel(transaction, bench.now)
    bench.hear(FIVE, after=0.06)
    (one,) = ended(bench)
    assert (one.verdict, one.heard, one.late) == (Verdict.OK, False, True)


def test_polls_probes_and_checks_say_why_they_are_asked() -> None:
    bench = Bench(tapped=True)
    node = bench.node()
    bench.poll(node, 10.0, 1)
    bench.wait(0.0)
    bench.hear(FIVE, after=0.004)
    bench.ask(node, probe=True)
    bench.hear(FIVE, after=0.004)
    bench.ask(node)  # is not answered, so the next answer of its kind could be its
    bench.wait(0.1 + MAX_REPLY_DELAY)
    assert [one.purpose for one in ended(bench)] == ["poll group", "probe", ""]
    check = bench.arbiter.attempt
    assert check is not None
    assert (check.purpose, check.heard) == ("check", True)


def test_each_cycle_of_a_poll_is_a_request_of_its_own() -> None:
    bench = Bench(tapped=True)
    bench.poll(bench.node(), 1.0, 1)
    for _ in range(3):
        bench.hear(FIVE, after=0.004)
        bench.wait(1.0 - 0.004)
    assert [(one.transaction, one.number) for one in ended(bench)] == [(1, 1), (2, 1), (3, 1)]


def test_a_line_that_nobody_taps_tells_and_pays_nothing() -> None:
    bench = Bench()
    bench.ask(bench.node())
    assert bench.arbiter.attempt is None
    bench.hear(FIVE, after=0.004)
    assert ended(bench) == []
    assert type(bench.arbiter.dispatcher) is Dispatcher


@dataclass(frozen=True)
class Endless:
    """A command whose exchange wants one step after the other."""

    writes: bool = False
    idempotent: bool = True

    def open(self, _address: int, timings: Timings, /) -> Odd:
        return Odd(Expect(timings.read, Sizes(1, 1)))

    def __str__(self) -> str:
        return "turn in circles"


@pytest.mark.parametrize("tapped", [False, True])
def test_a_reader_that_turns_in_circles_is_a_bug_and_does_not_stop_the_process(tapped: bool) -> None:
    bench = Bench(tapped=tapped)
    transaction = bench.ask(bench.node(), Endless())
    bench.hear("31", after=0.004)
    assert type(transaction.error) is BusError
    assert isinstance(transaction.error.__cause__, EndlessExchange)
    assert [one.verdict for one in ended(bench)] == [Verdict.GARBLED] * tapped


def test_a_line_is_tapped_while_it_runs_and_no_more() -> None:
    bench = Bench()
    node = bench.node()
    before = bench.ask(node)
    bench.arbiter.set_tapped(True)
    bench.hear(FIVE, after=0.004)
    assert before.value == 5.0
    assert said(bench) == []  # it was on the wire before anybody listened
    bench.ask(node)
    bench.hear(FIVE, after=0.004)
    assert said(bench) == ["1.1 ok: read element 1: 5.0"]
    after = bench.ask(node)
    bench.arbiter.set_tapped(False)
    nothing = bench.arbiter.attempt
    assert nothing is None
    bench.hear(FIVE, after=0.004)
    assert after.value == 5.0
    assert len(said(bench)) == 1


def test_a_retry_of_a_request_that_began_before_anybody_listened_is_told() -> None:
    bench = Bench()
    bench.ask(bench.node(), retries=1)
    bench.arbiter.set_tapped(True)
    bench.hear(BAD_CHECKSUM, after=0.004)
    bench.wait(QUIET + 0.152)
    assert said(bench) == ["1.2 no reply: read element 1: no reply within 150 ms"]


def test_an_attempt_says_how_long_the_line_had_resynchronised() -> None:
    bench = Bench(tapped=True)
    bench.ask(bench.node(), retries=1)
    bench.hear(BAD_CHECKSUM, after=0.004)
    bench.wait(QUIET + 0.152)
    first, second = ended(bench)
    assert second.quiet_time - first.quiet_time == pytest.approx(QUIET, abs=0.01)


def test_each_cycle_of_a_poll_is_a_transaction_of_its_own() -> None:
    bench = Bench(tapped=True)
    node = up(bench)
    bench.poll(node, 0.1, 7, 8)
    bench.wait(0.0)
    for _ in range(6):
        bench.until_sent()
        bench.answer()
    numbers = [attempt.transaction for attempt in ended(bench) if attempt.command in (hcp2.Read(7), hcp2.Read(8))]
    assert len(numbers) == 6
    assert len(set(numbers)) == 6

"""A proof that finds nothing is worth what it would have found: bugs are planted in the master, and found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import inf
from typing import Any

import pytest

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.dispatcher import Dispatcher
from busmaster.arbiter.in_sync import InSync
from busmaster.arbiter.learned import LEAST
from busmaster.arbiter.on_wire import OnWire, Output, Step
from busmaster.arbiter.shared_backlog import SharedBacklog
from busmaster.arbiter.transaction import Transaction
from busmaster.contract.exchange import FrameError
from busmaster.wire import readers
from tests.planted import (
    with_a_cancellation_that_clears_the_exchange,
    without_max_reply_delay,
    without_the_adapter_in_the_max_reply_delay,
    without_the_adapter_in_the_silence,
    without_the_byte_time,
)
from tests.verification.proof.explore import Explorer
from tests.verification.proof.history import as_test, retell, told
from tests.verification.proof.instants import seconds, set_unit
from tests.verification.proof.kinds import KINDS, READ, READ_LIKE, WRITE, WRITE_THERE
from tests.verification.proof.setups import (
    CANCELS,
    FLIPS,
    FROZEN,
    HELD,
    LOSS,
    LOST,
    NAKS,
    STALLS,
    STRAYS,
    URGENT,
    Assumptions,
    Setup,
)
from tests.verification.proof.worlds import LEARNED

LIMIT = 300.0
"""Seconds: a few of an idle core, and a busy one is ten times slower."""
pytestmark = pytest.mark.timeout(LIMIT + 30)
LINE = Setup(commands=(READ, WRITE))
MSC = Setup(kind="msc", commands=(READ,), lapse=2.5)
LATE = replace(LINE, receive_latency=0.016)
LEARNS = Setup(commands=(READ,), in_sync=True, whole=True, lapse=0.2, beyond=0.15, retries=1, learned=LEARNED)
PAUSES = replace(
    LEARNS,
    kind="hcp2, tails alike",
    commands=(READ, READ_LIKE),
    pauses=(4,),
    max_reply_delay=0.012,
    beyond=0.012,
    lapse=0.033,
    learned=(LEAST, 0.008),
)
SEQUENCES = replace(LINE, commands=(READ,), longest_hold=0.3)
TURNS = replace(LINE, commands=(READ, WRITE_THERE), second_timing=True)


def tick() -> float:
    set_unit(KINDS["hcp2"]().profile.line.byte_time)
    return seconds(1)


def with_max_reply_delay_a_tick_short(patch: Any) -> None:
    right, short = Step._past, tick()
    patch.setattr(Step, "_past", lambda step, end, timing: right(step, end, timing) - short)


def with_a_silence_a_tick_short(patch: Any) -> None:
    right, short = Step.quiet, tick()
    patch.setattr(Step, "quiet", lambda step: right(step) - short)


def without_resynchronising_after_strays(patch: Any) -> None:
    patch.setattr(Arbiter, "_take_unexpected", lambda line, data, now: line._unexpected.note(data, now, 0.0))


def with_a_refused_read_that_releases(patch: Any) -> None:
    def refused(line: Arbiter, refusal: Any, now: float) -> None:
        transaction = line._wire.transaction
        assert transaction is not None
        line._end_exchange()
        line.dispatcher.refused(transaction, refusal, True, now)
        line._release(0.0, now)

    patch.setattr(Arbiter, "_refused", refused)


def without_resynchronising_at_the_start(patch: Any) -> None:
    right = Arbiter.line_up

    def line_up(line: Arbiter, now: float, *, paced: bool = False) -> None:
        right(line, now, paced=paced)
        line._quarantine = -inf
        line._resynchronise(now)

    patch.setattr(Arbiter, "line_up", line_up)


def with_a_whole_frame_that_releases(patch: Any) -> None:
    """As it was: a noise byte before the checksum makes a frame whole, and its true checksum is the next one's ACK."""
    right = Arbiter._resynchronise

    def resynchronise(line: Arbiter, now: float, begun: bool = False) -> None:
        right(line, now, begun)
        if begun:
            line._silent_at = line._deadlines.line = now

    patch.setattr(Arbiter, "_resynchronise", resynchronise)


def with_a_stray_that_uses_up_the_packet(patch: Any) -> None:
    """As it was: any stray was taken for the ACK, and what follows for over."""

    def strayed(step: Step, now: float) -> None:
        step._follows = None

    patch.setattr(Step, "came_unexpected", strayed)


def without_the_packet_behind_an_ack(patch: Any) -> None:
    patch.setattr(Step, "give_up", lambda step, later: None)


def with_a_damaged_ack_that_is_none(patch: Any) -> None:
    """As it was: what came in place of the ACK was not thought to be it."""
    right = Step.came_unexpected
    strayed = Arbiter._take_unexpected

    def in_resynchronising(line: Arbiter, data: bytes, now: float) -> None:
        patch.setattr(Step, "came_unexpected", right)
        strayed(line, data, now)
        patch.setattr(Step, "came_unexpected", lambda step, now: None)

    patch.setattr(Step, "came_unexpected", lambda step, now: None)
    patch.setattr(Arbiter, "_take_unexpected", in_resynchronising)


def with_a_nak_that_gives_nothing_up(patch: Any) -> None:
    """As it was: behind a NAK no ACK was thought to come, and no packet."""
    right = Arbiter._refused

    def refused(line: Arbiter, refusal: Any, now: float) -> None:
        with patch.context() as within:
            within.setattr(Step, "give_up", lambda step, later: None)
            right(line, refusal, now)

    patch.setattr(Arbiter, "_refused", refused)


def without_late_replies(patch: Any) -> None:
    """As it was: what had not begun in its window was given up, though the line waited on."""
    patch.setattr(Arbiter, "_awaits_late_reply", lambda line, now: False)


def with_late_replies_awaited_a_tick_less(patch: Any) -> None:
    right, short = Step.last_begin, tick()
    past = Step.past

    def shorter(step: Step) -> float:
        return right(step) - short

    def resynchronises_as_ever(step: Step) -> float:
        with patch.context() as within:
            within.setattr(Step, "last_begin", right)
            return past(step)

    patch.setattr(Step, "last_begin", shorter)
    patch.setattr(Step, "past", resynchronises_as_ever)


def with_an_end_that_any_answer_moves(patch: Any) -> None:
    """As it was: an answer that was not believed proved that its request had left."""
    right = Arbiter._complete

    def complete(line: Arbiter, progress: Any, now: float) -> None:
        step = line._step
        if step.end > step.begun_at:
            step.end = step.out = step.begun_at
        right(line, progress, now)

    patch.setattr(Arbiter, "_complete", complete)


def without_the_driver_release_time(patch: Any) -> None:
    right = Arbiter._release
    patch.setattr(Arbiter, "_release", lambda line, hold, now: right(line, 0.0, now))


def without_the_time_of_the_write(patch: Any) -> None:
    patch.setattr(Arbiter, "transmitted", lambda line, now: None)


def without_what_is_unsent(patch: Any) -> None:
    patch.setattr(Output, "unsent", lambda output, count, now: None)


def without_what_is_unread(patch: Any) -> None:
    right = Arbiter.handle_timeout

    def handle_timeout(line: Arbiter, now: float, *, unread: bool = False) -> None:
        right(line, now)

    patch.setattr(Arbiter, "handle_timeout", handle_timeout)


def without_unconfirmed_writes(patch: Any) -> None:
    """As it was: a write that was carried out and not confirmed ended as what came later."""
    right = Dispatcher._end

    def end(dispatcher: Dispatcher, transaction: Transaction, now: float, error: Any = None) -> None:
        transaction.unsure = False
        transaction.attempts, attempts = 0, transaction.attempts
        right(dispatcher, transaction, now, error)
        transaction.attempts = attempts

    patch.setattr(Dispatcher, "_end", end)


def with_a_request_that_is_forgotten(patch: Any) -> None:
    right = Dispatcher._requeue

    def requeue(dispatcher: Dispatcher, transaction: Transaction, now: float) -> None:
        if not transaction.refusals:
            right(dispatcher, transaction, now)

    patch.setattr(Dispatcher, "_requeue", requeue)


def with_no_deadline_behind_a_first_byte(patch: Any) -> None:
    patch.setattr(Step, "gap_over", lambda step, now: inf)


def with_a_deadline_that_is_past(patch: Any) -> None:
    """What is due before now leaves no time in which anything could happen."""
    right, short = Arbiter._resynchronise, tick()

    def resynchronise(line: Arbiter, now: float, begun: bool = False) -> None:
        right(line, now, begun)
        line._deadlines.line = now - short

    patch.setattr(Arbiter, "_resynchronise", resynchronise)


def with_damage_that_completes(patch: Any) -> None:
    """A checksum that is not looked at."""
    right = readers.find_field

    def find_field(buffer: bytes, header: bytes, longest: int, check: Callable[[bytes], int]) -> bytes | None:
        try:
            return right(buffer, header, longest, check)
        except FrameError as error:
            if error.what == "bad checksum":
                return buffer[len(header) : -2]
            raise

    patch.setattr(readers, "find_field", find_field)


def with_two_said_at_once(patch: Any) -> None:
    """The line is thought free while the port holds what was said."""
    right = OnWire.begin

    def begin(wire: OnWire, *arguments: Any) -> None:
        wire.output.held = False
        right(wire, *arguments)

    patch.setattr(OnWire, "begin", begin)
    patch.setattr(Output, "unsent", lambda output, count, now: None)


def without_sequences(patch: Any) -> None:
    """Whoever waits goes next, though the line is held."""
    patch.setattr(SharedBacklog, "_hold_for", lambda backlog, hold, priority: None)


def with_a_sequence_that_never_ends(patch: Any) -> None:
    right = SharedBacklog._hold_for

    def hold_for(backlog: SharedBacklog, *arguments: Any) -> None:
        right(backlog, *arguments)
        backlog._deadlines.hold = inf

    patch.setattr(SharedBacklog, "_hold_for", hold_for)


def with_what_a_sequence_leaves_behind(patch: Any) -> None:
    """As it was: what waits of a sequence that is left is taken out, and told to nobody."""

    def end_hold(dispatcher: Dispatcher, now: float, hold: Any = None) -> None:
        backlog = dispatcher.share()
        hold = hold or backlog.hold
        if hold is not None:
            backlog.end_hold(hold, now)

    patch.setattr(Dispatcher, "end_hold", end_hold)


def without_what_is_overdue(patch: Any) -> None:
    """Nothing is in the way of what could be an earlier request's answer, as where learned windows had no R15."""
    patch.setattr(InSync, "add_overdue", lambda in_sync, *arguments: None)


def with_a_last_attempt_that_is_not_waited_for(patch: Any) -> None:
    """Nobody waits until what is overdue is late: what is forgiven then may come all the same."""
    patch.setattr(InSync, "awaited_until", lambda in_sync, last_byte, answers=None: -inf)
    patch.setattr(InSync, "over", lambda in_sync, answers: -inf)


def with_a_silence_as_learned(patch: Any) -> None:
    """As it was: behind a part of a reply the line went on after a pause of the learned length (docs/proof.md, 23)."""

    def silent_at(step: Step, last_byte: float) -> float:
        pause = step.timing.inter_byte_timeout + step.latency + step.byte_time
        return max(last_byte, step.out) + pause

    patch.setattr(Step, "silent_at", silent_at)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plant", "setup", "rule"),
    [
        (without_max_reply_delay, LINE, "R2"),
        (with_max_reply_delay_a_tick_short, LINE, "R2"),
        (without_the_byte_time, LINE, "R2"),
        (without_the_adapter_in_the_max_reply_delay, LATE, "R1"),
        (without_the_adapter_in_the_silence, replace(LATE, adversary=(FLIPS,), kind="dc104", lapse=1.5), "R1"),
        (with_a_silence_a_tick_short, LINE, "R1"),
        (without_resynchronising_after_strays, replace(LINE, adversary=(STRAYS,)), "R1"),
        (with_a_refused_read_that_releases, replace(LINE, adversary=(STRAYS,)), "R1"),
        (without_resynchronising_at_the_start, replace(LINE, adversary=(LOSS,)), "R1"),
        (with_a_cancellation_that_clears_the_exchange, replace(LINE, adversary=(CANCELS,)), "R1"),
        (with_a_whole_frame_that_releases, replace(LINE, adversary=(STRAYS,)), "R1"),
        (with_a_stray_that_uses_up_the_packet, replace(MSC, adversary=(STRAYS,)), "R1"),
        (without_the_packet_behind_an_ack, replace(MSC, adversary=(FLIPS,)), "R1"),
        (with_a_damaged_ack_that_is_none, replace(MSC, adversary=(FLIPS,)), "R1"),
        (with_a_nak_that_gives_nothing_up, replace(MSC, adversary=(STRAYS, URGENT)), "R1"),
        (without_late_replies, LINE, "R2"),
        (without_late_replies, MSC, "R2"),
        (with_late_replies_awaited_a_tick_less, LINE, "R2"),
        (with_an_end_that_any_answer_moves, replace(LINE, adversary=(STRAYS,)), "R1"),
        (without_the_driver_release_time, TURNS, "R1"),
        (without_the_time_of_the_write, replace(LINE, adversary=(FROZEN,)), "R2"),
        (without_what_is_unsent, replace(LINE, adversary=(HELD,)), "R1"),
        (without_what_is_unread, replace(LINE, adversary=(STALLS,)), "R1"),
        (without_unconfirmed_writes, replace(LINE, adversary=(LOSS,)), "R7"),
        (with_a_request_that_is_forgotten, replace(LINE, adversary=(NAKS,)), "R8"),
        (with_no_deadline_behind_a_first_byte, LINE, "progress"),
        (with_a_deadline_that_is_past, LINE, "progress"),
        (with_damage_that_completes, replace(LINE, adversary=(FLIPS,)), "R5"),
        (with_two_said_at_once, replace(LINE, adversary=(HELD,)), "R1"),
        (without_sequences, SEQUENCES, "R9"),
        (with_a_sequence_that_never_ends, SEQUENCES, "progress"),
        (with_what_a_sequence_leaves_behind, SEQUENCES, "R8"),
        (without_what_is_overdue, LEARNS, "R3"),
        (with_a_last_attempt_that_is_not_waited_for, LEARNS, "R3"),
        (with_a_silence_as_learned, PAUSES, "R3"),
    ],
    ids=lambda value: value.__name__ if callable(value) else "",
)
def test_a_planted_bug_is_found(
    plant: Callable[[Any], None], setup: Setup, rule: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant(monkeypatch)
    found = Explorer(setup).run(LIMIT, violations=1)
    assert {problem.split(":")[0] for problem in found.violations} == {rule}


def test_lost_bytes_that_lengthen_a_pause_are_outside_what_is_assumed_and_would_be_found() -> None:
    line = replace(LATE, adversary=(LOST,), assumptions=Assumptions(pauses_hold_the_lost=False))
    assert Explorer(line).run(LIMIT, violations=1).violations


def test_output_that_is_let_go_unseen_is_outside_what_is_assumed_and_would_be_found() -> None:
    line = replace(LINE, adversary=(HELD,), assumptions=Assumptions(held_until_asked=False))
    assert Explorer(line).run(LIMIT, violations=1).violations


def test_a_violation_is_told_in_times_and_bytes_and_as_a_test_that_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    with_a_cancellation_that_clears_the_exchange(monkeypatch)
    setup = replace(LINE, adversary=(CANCELS,))
    (problem, histories), *_ = Explorer(setup).run(LIMIT, violations=1).violations.items()
    calls = retell(setup, histories, problem)
    assert calls is not None
    assert "says 07 30 31" in told(calls)
    assert "may still come until here" in told(calls)
    names: dict[str, Any] = {}
    exec(as_test(setup, calls, problem), names)
    with pytest.raises(AssertionError, match="R1"):
        names["test_found_by_the_proof"]()
    monkeypatch.undo()
    names["test_found_by_the_proof"]()

"""Callers: cancelled, retried, refused, overtaken, cut off; each transaction ends once (R6-R8, R12, R13)."""

from __future__ import annotations

import pytest

from busmaster.arbiter.counters import LineState
from busmaster.arbiter.health import Health
from busmaster.arbiter.transaction import Phase, Priority, Transaction
from busmaster.errors import (
    BacklogFull,
    BusClosed,
    GarbledReply,
    LineDown,
    NodeDown,
    NoReply,
    NotStarted,
    Superseded,
    WriteUnconfirmed,
)
from busmaster.protocols.hcp2 import codec as hcp2
from tests.arbiter.bench import ACK, FIVE, READ_1_OF_NODE_1, SEVEN, TAU, WRITE_5, Bench

WRITE_6 = "07 30 31 02 30 31 36 03 37"
WRITE_7 = "07 30 31 02 30 31 37 03 36"
READ_2 = "07 30 31 02 30 32 05 04"


def write(value: int, *, idempotent: bool = False) -> hcp2.Write:
    return hcp2.Write(1, (value,), idempotent=idempotent)


def test_r6_a_cancelled_request_that_waits_is_never_sent() -> None:
    bench = Bench()
    node = bench.node()
    bench.ask(node)
    waiting = bench.ask(node, hcp2.Read(2))
    bench.sent()
    bench.arbiter.cancel(waiting, bench.now)
    bench.hear(FIVE, after=0.004)
    bench.wait(1.0)
    assert bench.sent() == ""
    assert waiting.phase is Phase.ENDED
    assert bench.ended(waiting) == 0


def test_r6_a_cancelled_request_on_the_wire_runs_out_unheard_and_its_reply_goes_to_nobody() -> None:
    bench = Bench()
    node = bench.node()
    gone = bench.ask(node)
    following = bench.ask(node)
    bench.sent()
    bench.arbiter.cancel(gone, bench.now)
    assert bench.arbiter.state is LineState.EXCHANGE
    bench.hear(FIVE, after=0.004)
    assert bench.ended(gone) == 0
    assert bench.sent() == READ_1_OF_NODE_1
    bench.hear(SEVEN, after=0.004)
    assert following.value == 7.0
    assert node.counters.unheard == 1


def test_r6_an_unheard_request_is_not_retried() -> None:
    bench = Bench()
    gone = bench.ask(bench.node(), hcp2.Read(2))
    bench.sent()
    bench.arbiter.cancel(gone, bench.now)
    bench.wait(2.0)
    assert READ_2 not in bench.sent()
    assert gone.attempts == 1


def test_r7_a_read_is_retried_twice_at_the_back_of_its_class() -> None:
    bench = Bench()
    node = bench.node()
    first = bench.ask(node)
    bench.ask(node, hcp2.Read(2))
    bench.sent()
    bench.until_sent()
    assert bench.sent() == READ_2
    bench.hear("02 30 32 35 03 34", after=0.004)
    assert bench.sent() == READ_1_OF_NODE_1
    bench.until_sent()
    bench.sent()
    bench.wait(1.0)
    assert isinstance(first.error, NoReply)
    assert first.attempts == 3
    assert bench.ended(first) == 1


def test_r7_a_write_is_retried_if_the_caller_says_that_it_may_be_repeated() -> None:
    bench = Bench()
    repeated = bench.ask(bench.node(), write(5), idempotent=True, retries=1)
    bench.sent()
    assert bench.checked() == READ_1_OF_NODE_1
    assert bench.sent() == WRITE_5
    bench.hear(ACK, after=0.004)
    assert repeated.error is None


def test_r7_a_garbled_acknowledgement_leaves_a_write_unconfirmed() -> None:
    bench = Bench()
    unsure = bench.ask(bench.node(), write(5))
    bench.hear("FF", after=0.004)
    assert isinstance(unsure.error, WriteUnconfirmed)


def test_r7_writes_to_one_node_never_overtake_each_other_not_even_by_a_retry() -> None:
    bench = Bench()
    node = bench.node()
    bench.ask(node, write(5), idempotent=True, retries=1)
    bench.ask(node, write(6))
    bench.ask(node, write(7))
    assert bench.sent() == WRITE_5
    assert bench.checked() == READ_1_OF_NODE_1
    assert bench.sent() == WRITE_5
    bench.hear(ACK, after=0.004)
    assert bench.sent() == WRITE_6
    bench.hear(ACK, after=0.004)
    assert bench.sent() == WRITE_7


def test_r7_a_write_of_a_higher_class_lends_its_class_to_the_one_before_it() -> None:
    bench = Bench()
    node = bench.node()
    bench.ask(node)
    bench.sent()
    bench.ask(node, write(5), priority=Priority.BACKGROUND)
    bench.ask(node, hcp2.Read(2), priority=Priority.POLL)
    bench.ask(node, write(6))
    bench.hear(FIVE, after=0.004)
    assert bench.sent() == WRITE_5
    bench.hear(ACK, after=0.004)
    assert bench.sent() == WRITE_6
    bench.hear(ACK, after=0.004)
    assert bench.sent() == READ_2


def test_r7_an_urgent_write_supersedes_the_writes_that_it_overtakes() -> None:
    bench = Bench()
    node, other = bench.node(1), bench.node(2)
    bench.ask(other)
    overtaken = bench.ask(node, write(5))
    spared = bench.ask(other, write(5))
    urgent = bench.ask(node, write(6), priority=Priority.URGENT)
    assert isinstance(overtaken.error, Superseded)
    assert spared.error is None
    bench.sent()
    bench.hear(FIVE, after=0.004)
    assert bench.sent() == WRITE_6
    bench.hear(ACK, after=0.004)
    assert urgent.error is None


def test_r7_a_write_on_the_wire_that_an_urgent_one_overtakes_is_not_repeated_after_it() -> None:
    bench = Bench()
    node = bench.node()
    enable = bench.ask(node, write(5), idempotent=True, retries=2)
    bench.sent()
    bench.ask(node, write(6), priority=Priority.URGENT)
    bench.until_sent()
    assert bench.sent() == WRITE_6
    assert isinstance(enable.error, WriteUnconfirmed)


def test_r8_every_error_is_a_fresh_instance() -> None:
    bench = Bench()
    node = bench.node()
    first, second = bench.ask(node), bench.ask(node)
    bench.arbiter.line_down("unplugged", bench.now)
    assert isinstance(first.error, LineDown)
    assert isinstance(second.error, LineDown)
    assert first.error is not second.error


def test_r12_a_full_backlog_says_so_at_once() -> None:
    bench = Bench(capacity=2)
    node = bench.node()
    bench.ask(node)
    bench.ask(node)
    bench.ask(node)
    refused = bench.ask(node)
    assert isinstance(refused.error, BacklogFull)
    assert bench.ask(node, priority=Priority.URGENT).error is None


def test_r12_start_within_fails_a_request_without_touching_the_wire() -> None:
    bench = Bench()
    node = bench.node()
    bench.ask(node)
    bench.sent()
    waiting = bench.ask(node, start_by=bench.now + 0.030)
    bench.wait(0.029)
    assert not bench.ended(waiting)
    bench.wait(0.002)
    assert isinstance(waiting.error, NotStarted)
    bench.hear(FIVE)
    assert bench.sent() == ""


def test_r12_a_request_whose_time_to_start_is_over_is_not_sent_before_its_timer_is_looked_at_either() -> None:
    bench = Bench()
    node = bench.node()
    bench.ask(node)
    bench.sent()
    waiting = bench.ask(node, start_by=bench.now + 0.030)
    bench.arbiter.data_received(bytes.fromhex(FIVE), bench.now + 0.031)
    assert bench.sent() == ""
    assert isinstance(waiting.error, NotStarted)


def test_r12_start_within_does_not_end_a_request_that_has_started() -> None:
    bench = Bench()
    read = bench.ask(bench.node(), start_by=bench.now + 0.010)
    bench.until_sent()
    bench.until_sent()
    bench.hear(FIVE, after=0.004)
    assert read.value == 5.0


def test_r13_a_lost_port_fails_the_exchange_and_the_backlog_at_once() -> None:
    bench = Bench()
    node = bench.node()
    on_wire, waiting = bench.ask(node), bench.ask(node)
    bench.arbiter.line_down("unplugged", bench.now)
    bench.listen()
    assert isinstance(on_wire.error, LineDown)
    assert isinstance(waiting.error, LineDown)
    assert "unplugged" in str(waiting.error)
    assert (bench.ended(on_wire), bench.ended(waiting)) == (1, 1)
    assert isinstance(bench.ask(node).error, LineDown)
    assert bench.arbiter.statistics(bench.now).losses == 1


def test_r13_a_write_on_the_wire_of_a_lost_port_is_unconfirmed() -> None:
    bench = Bench()
    node = bench.node()
    on_wire, waiting = bench.ask(node, write(5)), bench.ask(node, write(6))
    bench.arbiter.line_down("unplugged", bench.now)
    assert isinstance(on_wire.error, WriteUnconfirmed)
    assert isinstance(waiting.error, LineDown)


def test_r13_after_the_port_is_back_everything_works_again() -> None:
    bench = Bench()
    node = bench.node()
    bench.ask(node)
    bench.arbiter.line_down("unplugged", bench.now)
    bench.arbiter.line_up(bench.now)
    bench.sent()
    again = bench.ask(node)
    bench.checked()
    assert bench.sent() == READ_1_OF_NODE_1
    bench.hear(FIVE, after=0.004)
    assert again.value == 5.0


def test_r13_polls_go_bad_while_the_port_is_lost_and_resume_on_the_grid() -> None:
    bench = Bench()
    poll = bench.poll(bench.node(), 0.1, 1)
    bench.arbiter.line_down("unplugged", bench.now)
    bench.wait(0.35)
    assert [type(poll.results[0].error) for _ in bench.cycles] == [LineDown] * len(bench.cycles)
    assert len(bench.cycles) >= 3
    bench.arbiter.line_up(bench.now)
    bench.until_sent()
    bench.hear(FIVE, after=0.004)
    assert poll.results[0].value == 5.0
    assert (poll.due - poll.base) / poll.period == pytest.approx(round((poll.due - poll.base) / poll.period))


def test_r8_close_ends_whatever_waits_and_lets_the_exchange_on_the_wire_finish() -> None:
    bench = Bench()
    node = bench.node()
    on_wire, waiting = bench.ask(node), bench.ask(node)
    poll = bench.poll(node, 0.1, 7)
    bench.arbiter.close(bench.now)
    bench.listen()
    assert isinstance(waiting.error, BusClosed)
    assert not poll.active
    bench.hear(FIVE, after=0.004)
    assert on_wire.value == 5.0
    assert bench.arbiter.state is LineState.OFFLINE
    assert isinstance(bench.ask(node).error, BusClosed)


def test_r8_close_ends_within_one_window() -> None:
    bench = Bench()
    on_wire = bench.ask(bench.node())
    bench.arbiter.close(bench.now)
    bench.wait(0.102)
    assert isinstance(on_wire.error, NoReply)
    assert bench.arbiter.state is LineState.OFFLINE


def test_a_garbled_reply_says_what_was_wrong_and_on_which_node() -> None:
    bench = Bench()
    read = bench.ask(bench.node(3), retries=0)
    bench.hear("02 30 32", after=0.004)
    assert isinstance(read.error, GarbledReply)
    assert str(read.error).startswith("node 3: ")


def test_early_and_repeated_timeouts_change_nothing() -> None:
    bench = Bench()
    read = bench.ask(bench.node(), retries=0)
    for step in range(100):
        bench.arbiter.handle_timeout(bench.now + step * 0.001)
    assert not bench.ended(read)
    assert bench.arbiter.state is LineState.EXCHANGE


def test_a_timeline_says_what_a_request_waited_for() -> None:
    bench = Bench()
    node = bench.node()
    bench.ask(node, retries=0)
    second = bench.ask(node)
    bench.sent()
    start = bench.now
    bench.hear("FF", after=8 * TAU + 0.100)
    bench.checked()
    bench.hear(FIVE, after=0.004)
    timeline = second.timeline()
    assert timeline.queued == start
    assert timeline.exchanges_ahead == 2, "the one that failed, and the check behind it"
    assert timeline.quiet_time_ahead == pytest.approx(0.050 + TAU)
    assert timeline.attempts == 1


def test_r7_a_number_of_retries_alone_does_not_make_a_write_repeatable() -> None:
    """Writing Comms 1 to 5 starts a Mint event even of an equal value (AN00110): only `idempotent` says it may be."""
    bench = Bench()
    asked = bench.ask(bench.node(), write(5), retries=2)
    assert bench.sent() == WRITE_5
    bench.wait(5.0)
    assert WRITE_5 not in bench.sent()
    assert asked.attempts == 1
    assert isinstance(asked.error, WriteUnconfirmed)


def test_r7_an_urgent_write_that_is_not_worth_line_time_still_supersedes_what_waits() -> None:
    """A disable that fails with NodeDown must not be followed by the enable that was asked before it."""
    bench = Bench()
    dead, other = bench.node(1), bench.node(2)
    bench.ask(dead, retries=0)
    bench.wait(0.2)
    assert dead.health is Health.DOWN
    bench.ask(other)
    enable = bench.ask(dead, write(5))
    bench.arbiter.dispatcher.probes.budget.tokens = 0.0
    disable = bench.ask(dead, write(0), priority=Priority.URGENT)
    assert isinstance(disable.error, NodeDown)
    assert isinstance(enable.error, Superseded)
    assert enable.attempts == 0


def test_a_value_that_came_in_time_is_not_late_because_an_earlier_attempt_was() -> None:
    bench = Bench()
    read = bench.ask(bench.node())
    bench.sent()
    bench.hear("02 30", after=0.080)
    bench.checked()
    bench.hear(FIVE, after=0.004)
    assert (read.value, read.attempts, read.late) == (5.0, 2, False)


def test_r12_a_request_that_is_to_start_at_once_starts_on_a_free_line() -> None:
    """The clock has gone on between the caller's look at it and the arbiter's."""
    bench = Bench()
    node = bench.node()
    bench.wait(1.0)
    first = bench.ask(node, start_by=bench.now - 1e-6)
    second = bench.ask(node, hcp2.Read(2), start_by=bench.now)
    assert bench.sent() == READ_1_OF_NODE_1
    bench.hear(FIVE, after=0.004)
    assert first.value == 5.0
    assert isinstance(second.error, NotStarted)


def test_a_timeline_that_spans_a_reset_of_the_statistics_counts_on() -> None:
    bench = Bench()
    node = bench.node()
    for _ in range(3):
        bench.ask(node, retries=0)
        bench.hear(FIVE, after=0.004)
    bench.ask(node, retries=0)
    waiting = bench.ask(node)
    bench.sent()
    bench.arbiter.reset_statistics(bench.now)
    bench.hear("FF", after=8 * TAU + 0.100)
    bench.checked()
    timeline = waiting.timeline()
    assert timeline.exchanges_ahead == 2, "the one that failed, and the check behind it"
    assert timeline.quiet_time_ahead == pytest.approx(0.050 + TAU)
    assert bench.arbiter.statistics(bench.now).exchanges == 2


def test_r11_whoever_looks_at_the_statistics_does_not_shorten_the_pauses_that_pay_for_probes() -> None:
    tokens = []
    for looks in (0, 40):
        bench = Bench()
        node = bench.node()
        bench.ask(node)
        bench.hear(FIVE, after=0.004)
        budget = bench.arbiter.dispatcher.probes.budget
        budget.tokens, budget.probe = 0.0, 0.150
        for _ in range(looks):
            bench.wait(0.05)
            bench.arbiter.statistics(bench.now)
        bench.to(3.1)
        bench.ask(node)
        tokens.append(budget.tokens)
    assert tokens[0] == pytest.approx(tokens[1])
    assert tokens[0] > 0.4


def test_r12_a_time_to_start_passes_even_on_a_clock_that_is_months_old() -> None:
    """There a nanosecond is less than the clock can tell: the deadline must lie behind the moment all the same."""
    bench = Bench()
    bench.to(3e7)
    node = bench.node()
    bench.ask(node)
    waiting = bench.ask(node, start_by=bench.now + 0.010)
    assert bench.arbiter.poll_timeout() > waiting.start_by


def heard_but_not_yet_told(bench: Bench) -> tuple[Transaction, Transaction]:
    """Two reads of a node that is UP: the first one's reply has come, and nobody has asked for events since."""
    node = bench.node()
    bench.ask(node)
    bench.hear(FIVE, after=0.004)
    first, second = bench.ask(node), bench.ask(node)
    bench.sent()
    bench.to(bench.now + 0.004)
    bench.arbiter.data_received(bytes.fromhex(FIVE), bench.now)
    assert bench.sent() == READ_1_OF_NODE_1
    assert second.phase is Phase.ON_WIRE
    return first, second


def test_r8_the_next_request_leaves_before_a_success_is_noted_and_what_is_noted_is_of_its_own_time() -> None:
    bench = Bench()
    first, _ = heard_but_not_yet_told(bench)
    assert first.node.counters.ok == 1
    came = bench.now
    bench.now += 0.001
    bench.listen()
    assert (first.value, first.ended_at, first.node.last_reply) == (5.0, came, came)
    assert first.node.counters.ok == 2
    assert bench.ended(first) == 1
    bench.listen()
    assert bench.ended(first) == 1


def test_r6_r8_a_caller_that_goes_before_it_is_told_is_not_told() -> None:
    bench = Bench()
    first, second = heard_but_not_yet_told(bench)
    bench.arbiter.cancel(first, bench.now)
    bench.hear(SEVEN, after=0.004)
    assert (bench.ended(first), bench.ended(second)) == (0, 1)
    assert (first.phase, first.node.counters.unheard) == (Phase.ENDED, 1)


def test_r13_a_line_that_is_lost_before_a_success_is_told_takes_nothing_back() -> None:
    bench = Bench()
    first, second = heard_but_not_yet_told(bench)
    bench.arbiter.line_down("unplugged", bench.now)
    bench.listen()
    assert (first.value, first.error, bench.ended(first)) == (5.0, None, 1)
    assert isinstance(second.error, LineDown)


def test_r11_a_success_that_changes_a_nodes_health_is_noted_before_the_next_request() -> None:
    bench = Bench()
    node = bench.node()
    first = bench.ask(node)
    bench.to(bench.now + 0.004)
    bench.arbiter.data_received(bytes.fromhex(FIVE), bench.now)
    assert (node.health, node.counters.ok, first.phase) == (Health.UP, 1, Phase.ENDED)


def test_submitting_says_whether_there_is_something_to_pump() -> None:
    """An owner that is told False neither sends, nor tells, nor sets its timer anew."""
    bench = Bench(capacity=4)
    node = bench.node()

    def submit(**how: float) -> bool:
        return bench.arbiter.submit(Transaction(node, hcp2.Read(1), **how), bench.now)  # type: ignore[arg-type]  # start_by

    assert submit(), "it is to be sent"
    assert not submit(), "it waits"
    assert submit(start_by=bench.now + 0.010), "its time to start is a deadline"
    assert bench.arbiter.submit(Transaction(node, write(5)), bench.now), "a write may overtake others"
    assert not submit()
    assert submit(), "the backlog is full: it has ended"


def test_while_the_line_is_down_a_request_fails_with_the_latest_reason_and_what_to_do_about_it() -> None:
    bench = Bench()
    node = bench.node()

    def error() -> str:
        asked = bench.ask(node)
        assert isinstance(asked.error, LineDown)
        return str(asked.error)

    bench.arbiter.still_down("another has its name", "name it")  # it is up, so that says nothing
    bench.arbiter.line_down("unplugged", bench.now)
    usual = LineDown.hint
    assert error() == f"node 1: the line is down: unplugged (read element 1); {usual}".removesuffix("; ")
    for reason in ("it does not exist", "another has its name"):
        bench.arbiter.still_down(reason, f"fix that {reason}")
        assert error() == f"node 1: the line is down: {reason} (read element 1); fix that {reason}"
    bench.arbiter.line_up(bench.now)
    bench.arbiter.line_down("unplugged", bench.now)
    assert error() == f"node 1: the line is down: unplugged (read element 1); {usual}".removesuffix("; ")


def test_the_timeline_of_a_request_that_was_never_sent_has_no_times_of_the_line() -> None:
    bench = Bench()
    node = bench.node()
    bench.ask(node)
    waiting = bench.ask(node, hcp2.Read(2))
    timeline = waiting.timeline()
    assert (timeline.started, timeline.first_byte, timeline.last_byte) == (None, None, None)

"""A caller that gives up knows what became of its request: nothing was sent, or it was and how it ends is not known."""

from __future__ import annotations

import random
from math import nextafter

import pytest

from busmaster.arbiter.deadlines import SLACK, Deadlines, Expiries
from busmaster.arbiter.events import Overdue
from busmaster.arbiter.health import Health, NodeRecord
from busmaster.arbiter.transaction import TOO_LATE, Phase, Priority, Transaction, too_late
from busmaster.emulator.device import Delay
from busmaster.emulator.faults import Faults
from busmaster.emulator.line import Line
from busmaster.emulator.world import World
from busmaster.errors import BusError, NoReply, NotStarted, WriteUnconfirmed
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2 import codec as hcp2
from tests.arbiter.bench import Bench, heard

ACK = "06"
REPEATED = hcp2.Write(1, (5,), idempotent=True)


def told(bench: Bench, transaction: Transaction) -> list[BusError]:
    """What its caller was told before the exchange was over."""
    return [e.error for e in bench.events if isinstance(e, Overdue) and e.transaction is transaction]


def test_r12_what_was_never_sent_is_not_started() -> None:
    bench = Bench()
    node = heard(bench)
    bench.ask(node)
    bench.sent()
    waiting = bench.ask(node, REPEATED, finish_by=bench.now + 0.030)
    bench.wait(0.029)
    assert bench.ended(waiting) == 0
    bench.to(waiting.finish_by)
    assert bench.ended(waiting) == 1
    assert isinstance(waiting.error, NotStarted)
    assert "not sent within its time: it waited 30 ms for the line" in str(waiting.error)
    bench.answer()
    assert bench.sent() == ""


def test_requests_that_end_in_time_do_not_pile_up_and_one_that_waits_is_not_forgotten() -> None:
    node, expiries = Bench().node(), Expiries(Deadlines())
    waiting = Transaction(node, hcp2.Read(1), start_by=5.0)
    expiries.expect(waiting, 1)
    for number in range(1000):
        ended = Transaction(node, hcp2.Read(1), start_by=1000.0 - number, finish_by=2000.0)
        expiries.expect(ended, 1)
        ended.phase = Phase.ENDED
        assert len(expiries._heap) <= 2 + SLACK + 2
    assert list(expiries.due(6.0)) == [waiting]


def test_r12_whoever_waited_in_vain_is_told_for_how_many_milliseconds() -> None:
    waiting = Transaction(Bench().node(), hcp2.Read(1))
    waiting.queued = 1.0
    assert "it waited 2500 ms" in str(too_late(waiting, 3.5))
    waiting.attempts = 1
    error = too_late(waiting, 3.5)
    assert "sent, but not answered within its time: 2500 ms" in str(error)
    assert error.hint == TOO_LATE


@pytest.mark.parametrize(("command", "kind"), [(hcp2.Read(1), NoReply), (REPEATED, WriteUnconfirmed)])
def test_r12_r6_what_is_on_the_wire_runs_out_unheard_and_is_not_repeated(
    command: hcp2.Read | hcp2.Write, kind: type[BusError]
) -> None:
    bench = Bench()
    node = heard(bench)
    asked = bench.ask(node, command, finish_by=bench.now + 0.030)
    assert bench.sent()
    after = bench.ask(node, hcp2.Read(2))
    bench.wait(0.031)
    [error] = told(bench, asked)
    assert isinstance(error, kind)
    assert (error.label, error.address, error.attempts) == ("node 1", 1, 1)
    assert "sent, but not answered within its time: 30 ms" in str(error)
    assert asked.phase is Phase.ON_WIRE
    assert bench.sent() == ""
    bench.until_sent()
    assert bench.now > asked.queued + 0.1  # its window ran out first
    bench.served(after)
    assert asked.attempts == 1
    assert bench.ended(asked) == 0
    assert (node.counters.unheard, bench.arbiter.statistics(bench.now).cancelled) == (1, 1)


def test_an_answer_to_a_caller_that_has_given_up_reaches_nobody() -> None:
    bench = Bench()
    asked = bench.ask(heard(bench), finish_by=bench.now + 0.030)
    bench.sent()
    bench.wait(0.040)
    bench.answer(7)
    other = bench.ask(asked.node, hcp2.Read(2))
    bench.answer(8)
    assert (bench.ended(asked), len(told(bench, asked)), other.value) == (0, 1, 8)


def test_an_answer_right_at_the_time_is_in_time() -> None:
    bench = Bench()
    asked = bench.ask(heard(bench), finish_by=bench.now + 0.030)
    bench.answer(7, after=0.030)
    assert (asked.value, asked.error, told(bench, asked)) == (7, None, [])


def test_an_answer_that_is_handed_over_before_the_timer_is_known_and_so_is_what_became_of_it() -> None:
    """A loop that stood still reads first, and then looks at the clock: in one turn."""
    bench = Bench()
    asked = bench.ask(heard(bench), REPEATED, finish_by=bench.now + 0.030)
    bench.sent()
    bench.now += 0.080
    bench.arbiter.data_received(bytes.fromhex(ACK), bench.now)
    bench.arbiter.handle_timeout(bench.now)
    bench.listen()
    assert (bench.ended(asked), asked.error, told(bench, asked)) == (1, None, [])


def test_an_answer_that_lies_unread_when_the_timer_comes_first_is_waited_for() -> None:
    bench = Bench()
    asked = bench.ask(heard(bench), REPEATED, finish_by=bench.now + 0.030)
    bench.sent()
    assert not bench.arbiter.answer_counts(bench.now)
    bench.now += 0.080
    assert bench.arbiter.answer_counts(bench.now)
    bench.arbiter.handle_timeout(bench.now, unread=True)
    bench.listen()
    assert (bench.ended(asked), told(bench, asked)) == (0, [])
    bench.arbiter.data_received(bytes.fromhex(ACK), bench.now)
    bench.listen()
    assert (bench.ended(asked), asked.error, told(bench, asked)) == (1, None, [])


def test_a_success_that_is_not_noted_yet_is_one() -> None:
    bench = Bench()
    asked = bench.ask(heard(bench), finish_by=bench.now + 0.030)
    reply = bytes.fromhex(bench.sent() and "02 31 31 37 03 34")
    assert reply
    bench.now += 0.040
    bench.arbiter.dispatcher.succeeded(asked, 7.0, bench.now)
    bench.arbiter.dispatcher.expire(bench.now)
    bench.listen()
    assert (bench.ended(asked), asked.value, told(bench, asked)) == (1, 7.0, [])


def test_a_request_whose_time_is_over_when_it_is_made_is_not_sent_and_one_with_a_moment_left_is() -> None:
    bench = Bench()
    node = heard(bench)
    over = bench.ask(node, REPEATED, finish_by=bench.now)
    assert (bench.ended(over), type(over.error), bench.sent()) == (1, NotStarted, "")
    left = bench.ask(node, REPEATED, finish_by=nextafter(bench.now, 9e9))
    assert bench.sent()
    bench.wait(1e-6)
    [error] = told(bench, left)
    assert isinstance(error, WriteUnconfirmed)


def test_what_the_port_holds_back_may_leave_yet_and_is_unconfirmed() -> None:
    bench = Bench(paced=True)
    node = heard(bench)
    asked = bench.ask(node, REPEATED, finish_by=bench.now + 0.5)
    assert bench.sent()
    bench.unsent = 8
    other = bench.ask(node, hcp2.Read(2))
    bench.wait(0.6)
    [error] = told(bench, asked)
    assert isinstance(error, WriteUnconfirmed)
    assert bench.sent() == "", "nothing else is said while it is held"
    bench.unsent = 0
    bench.until_sent()
    bench.unsent = None
    bench.served(other)
    assert bench.ended(asked) == 0


@pytest.mark.parametrize(("command", "kind"), [(hcp2.Read(1), NoReply), (REPEATED, WriteUnconfirmed)])
def test_a_retry_that_cannot_finish_is_not_sent(command: hcp2.Read | hcp2.Write, kind: type[BusError]) -> None:
    bench = Bench()
    asked = bench.ask(heard(bench), command, finish_by=bench.now + 0.165)
    assert bench.sent()
    bench.hear("FF", after=0.150)
    assert asked.phase is Phase.QUEUED  # failed once, while the line resynchronises
    bench.wait(0.014)
    bench.wait(0.002)
    assert (bench.ended(asked), type(asked.error), asked.attempts) == (1, kind, 1)
    bench.wait(1.0)
    assert bench.sent() == ""


def test_a_retry_whose_turn_comes_right_at_the_time_is_not_sent() -> None:
    turn = 0.0
    for finishing in (False, True):
        bench = Bench()
        node = heard(bench)
        times = {"finish_by": bench.now + turn} if finishing else {}
        asked = bench.ask(node, REPEATED, **times)
        bench.sent()
        if not finishing:
            turn = bench.until_sent()
    bench.wait(2.0)
    assert (type(asked.error), asked.attempts, bench.sent()) == (WriteUnconfirmed, 1, "")


def test_a_retry_whose_time_is_over_does_not_go_before_another_either() -> None:
    bench = Bench()
    asked = bench.ask(heard(bench), finish_by=bench.now + 0.5)
    bench.sent()
    bench.hear("FF", after=0.12)
    assert (asked.phase, asked.attempts) == (Phase.QUEUED, 1)
    asked.node.health = Health.UP
    proves = bench.arbiter.dispatcher.proves
    assert (proves(asked, bench.now), proves(asked, asked.finish_by)) == (True, False)


def test_a_retry_may_go_before_another_though_the_time_to_start_is_over() -> None:
    bench = Bench()
    asked = bench.ask(heard(bench), start_by=bench.now + 0.1)
    bench.sent()
    bench.hear("FF", after=0.12)
    assert (asked.phase, asked.attempts) == (Phase.QUEUED, 1)
    asked.node.health = Health.UP
    assert bench.arbiter.dispatcher.proves(asked, bench.now)


def test_an_urgent_write_that_comes_too_late_is_not_sent_and_what_it_overtook_is_not_either() -> None:
    bench = Bench()
    node = heard(bench)
    bench.ask(node)
    bench.sent()
    overtaken = bench.ask(node, REPEATED)
    urgent = bench.ask(node, hcp2.Write(2, (0,), idempotent=True), priority=Priority.URGENT, finish_by=bench.now + 0.01)
    bench.wait(0.011)
    assert isinstance(urgent.error, NotStarted)
    bench.answer()
    assert (bench.ended(overtaken), bench.sent()) == (1, "")


def test_an_urgent_write_on_the_wire_is_not_repeated_for_a_caller_that_has_gone() -> None:
    bench = Bench()
    urgent = bench.ask(heard(bench), REPEATED, priority=Priority.URGENT, finish_by=bench.now + 0.05)
    assert bench.sent()
    bench.wait(2.0)
    assert (len(told(bench, urgent)), urgent.attempts, bench.sent()) == (1, 1, "")


def test_a_write_behind_another_ends_alone_and_the_next_one_keeps_its_place() -> None:
    bench = Bench()
    node = heard(bench)
    first = bench.ask(node, hcp2.Write(1, (1,)))
    bench.sent()
    second = bench.ask(node, hcp2.Write(1, (2,)), finish_by=bench.now + 0.01)
    third = bench.ask(node, hcp2.Write(1, (3,)))
    bench.wait(0.02)
    assert isinstance(second.error, NotStarted)
    bench.hear(ACK)
    assert first.error is None
    bench.sent()
    bench.hear(ACK, after=0.004)
    assert (bench.ended(third), third.error) == (1, None)


def test_a_caller_that_was_cancelled_is_told_nothing_and_both_times_may_be_given() -> None:
    bench = Bench()
    node = heard(bench)
    gone = bench.ask(node, finish_by=bench.now + 0.030)
    bench.sent()
    bench.arbiter.cancel(gone, bench.now)
    late = bench.ask(node, start_by=bench.now + 0.01, finish_by=bench.now + 0.03)
    begun = bench.ask(node, hcp2.Read(2), start_by=bench.now + 0.2, finish_by=bench.now + 0.25)
    bench.wait(0.02)
    assert isinstance(late.error, NotStarted)
    bench.until_sent()
    bench.to(begun.start_by + 0.001)
    assert (begun.phase, told(bench, begun)) == (Phase.ON_WIRE, [])  # it was started in time
    bench.wait(0.2)
    assert (told(bench, gone), bench.ended(gone)) == ([], 0)
    assert [type(error) for error in told(bench, begun)] == [NoReply]


def test_an_answer_that_is_held_until_it_can_be_believed_is_not_waited_for_longer() -> None:
    bench = Bench(strict=True)
    node = heard(bench)
    bench.ask(node, hcp2.Read(3), retries=0)
    bench.sent()
    asked = bench.ask(node, hcp2.Read(3), finish_by=bench.now + 0.4)
    bench.wait(0.5)
    assert (type(asked.error), asked.attempts) == (NotStarted, 0) or len(told(bench, asked)) == 1


@pytest.mark.parametrize("seed", range(12))
def test_whatever_happens_each_caller_is_told_once_in_time_and_truly(seed: int) -> None:
    """Writes of a value each, on a line that loses, delays, cuts and goes away: what is not started was never sent."""
    chance = random.Random(seed)
    sent: list[str] = []
    faults = Faults(lost=0.1, late=0.1, truncated=0.05)
    devices = [EmulatedMint(address, delay=Delay(0.001, 0.06)) for address in (1, 2)]
    ended: dict[int, list[tuple[float, BusError | None]]] = {}

    def on_event(event: object) -> None:
        if isinstance(event, Transaction):
            ended.setdefault(id(event), []).append((world.now, event.error))
        elif isinstance(event, Overdue):
            ended[id(event.transaction)].append((world.now, event.error))

    world = World(Line(hcp2.PROFILE.line, devices, faults=faults, chance=chance), on_event=on_event, record=sent.append)
    nodes = [world.node(hcp2.PROFILE, address) for address in (1, 2)]
    asked: list[Transaction] = []

    def ask(number: int) -> None:
        command = hcp2.Write(1, (number,), idempotent=chance.random() < 0.5)
        priority = chance.choice((Priority.URGENT, Priority.COMMAND, Priority.COMMAND, Priority.BACKGROUND))
        finish_by = world.now + chance.choice((0.0, 0.005, 0.05, 0.2, 1.0))
        transaction = Transaction(chance.choice(nodes), command, priority=priority, finish_by=finish_by)
        asked.append(transaction)
        ended[id(transaction)] = []
        world.arbiter.submit(transaction, world.now)

    for number in range(400):
        world.at(1.0 + 0.05 * number, lambda number=number: ask(number))  # type: ignore[misc]  # bound now
    world.at(8.02, world.unplug)  # while something is on the wire, whether or not anybody waits for it
    world.at(8.5, world.plug)
    world.run(30.0)
    on_line = [line for line in sent if " > " in line]
    kinds = set()
    for transaction in asked:
        [(when, error)] = ended[id(transaction)]
        request = transaction.command.open(transaction.node.address, hcp2.PROFILE.timings).request.hex(" ")
        was_sent = any(line.endswith(request) for line in on_line)
        assert when <= nextafter(transaction.finish_by, 9e9)
        assert was_sent == (transaction.attempts > 0)
        if isinstance(error, NotStarted):
            assert not was_sent
        elif isinstance(error, WriteUnconfirmed) or error is None:
            assert was_sent
        kinds.add(type(error))
    assert {NotStarted, WriteUnconfirmed, type(None)} <= kinds


def test_r12_requests_with_a_deadline_that_have_ended_leave_no_memory_behind() -> None:
    expiries = Expiries(Deadlines())
    node = NodeRecord(hcp2.PROFILE, 1, hcp2.PROFILE.timings, 2)
    crowd = [Transaction(node, hcp2.Read(1), finish_by=1e6) for _ in range(5 * SLACK)]
    for waiting, transaction in enumerate(crowd):
        expiries.expect(transaction, waiting)
    for transaction in crowd:
        transaction.phase = Phase.ENDED
    for _ in range(5 * SLACK):
        transaction = Transaction(node, hcp2.Read(1), finish_by=1e6)
        expiries.expect(transaction, waiting=0)
        transaction.phase = Phase.ENDED
        assert len(expiries._heap) <= SLACK + 2  # each request has two entries

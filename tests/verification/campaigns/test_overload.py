"""More is asked than the line can carry: commands go through at once, and nothing starves (R9)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from busmaster.arbiter import learned
from busmaster.arbiter.choice import MOST_BEFORE
from busmaster.arbiter.transaction import Poll, Priority, Transaction
from busmaster.contract.exchange import Command
from busmaster.contract.learning import LEARNED
from busmaster.contract.profile import LineSettings, Profile
from busmaster.emulator.device import Delay, Device
from busmaster.emulator.faults import Faults
from busmaster.errors import BacklogFull
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.msc import codec as msc
from busmaster.protocols.msc.device import EmulatedMsc
from busmaster.registry import make_device
from busmaster.wire.checks import xor
from tests.tiers import one_by_default
from tests.verification.campaigns.loads import EXCHANGE, LINE, REPLY_TIME, Load, quantile

SPREAD = 0.3
LONGEST = 16 * LINE.byte_time + REPLY_TIME * (1 + SPREAD)
"""Seconds of the longest exchange of a healthy line."""
URGENT_TRIES = 10_000


def polled(load: float, *, background: bool = False, seed: int = 1) -> Load:
    """Groups at 0.25, 0.5, 1 and 5 s (and a tenth beside them in BACKGROUND) that ask for so much of the line."""
    line = Load(8, seed=seed, spread=SPREAD)
    for period in (0.25, 0.5, 1.0, 5.0):
        count = round(load / 4 * period / EXCHANGE)
        nodes = line.nodes
        line.poll_of(f"{period}", period, [Transaction(nodes[i % 8], hcp2.Read(i // 8 + 1)) for i in range(count)])
    if background:
        line.poll("background", 1.0, line.nodes, round(0.1 / 8 / EXCHANGE), priority=Priority.BACKGROUND)
    line.run(1.0)
    return line


def commanded(line: Load, load: float) -> tuple[list[float], list[Transaction]]:
    """Commands at random moments that ask for so much of the line: how long each waited, and those not taken."""
    waits: list[float] = []
    full: list[Transaction] = []

    def note(command: Transaction) -> None:
        if command.error is None:
            waits.append(command.started - command.queued)
        else:
            full.append(command)

    line.on_completed = note
    rate = load / EXCHANGE
    line.every(lambda: line.random.expovariate(rate), lambda: line.ask(line.random.choice(line.nodes)))
    return waits, full


def longest_wait(line: Load, poll: Poll) -> float:
    """From due to started, in seconds."""
    return max(begun - due for due, begun, _ in line.cycles[poll.name])


@pytest.mark.parametrize("seed", [1, 2])
def test_r9_at_200_percent_poll_load_commands_wait_for_two_exchanges_at_most(seed: int) -> None:
    line = polled(2.0, seed=seed)
    waits, full = commanded(line, 0.1)
    line.run(120.0)
    assert len(waits) > 2000
    assert not full
    assert quantile(waits, 0.99) <= 2 * LONGEST


@pytest.mark.parametrize("poll_load", one_by_default([2.0, 1.0]))
@pytest.mark.parametrize("command_load", one_by_default([1.2, 0.1]))
@pytest.mark.parametrize("background", [False, True])
def test_r9_no_poll_waits_longer_than_its_bound(poll_load: float, command_load: float, background: bool) -> None:
    """The bound calculated with the longest exchange that there was: the published one allows for far longer ones."""
    line = polled(poll_load, background=background)
    waits, _ = commanded(line, command_load)
    line.run(120.0)
    published = line.bounds()
    healthy = replace(published, hold=LONGEST)
    assert len(waits) > 2000
    for poll in line.polls:
        assert len(line.cycles[poll.name]) >= 2
        bound = healthy.wait(poll.priority, patience=poll.patience)
        assert longest_wait(line, poll) <= bound
        assert bound < published.wait(poll.priority, patience=poll.patience)


def test_r9_at_120_percent_command_load_the_polls_keep_their_eighth() -> None:
    line = polled(1.0)
    _, full = commanded(line, 1.2)
    line.run(60.0)
    before = sum(line.good.values())
    line.run(60.0)
    assert sum(line.good.values()) - before >= 0.95 * 60.0 / EXCHANGE / 8
    assert all(isinstance(command.error, BacklogFull) for command in full)
    assert full


# learned reply times


@pytest.mark.parametrize("profile", [hcp2.PROFILE, mentor.PROFILE])
@pytest.mark.parametrize("seed", [1, 2])
def test_r9_no_wait_exceeds_its_bound_whatever_was_learned_and_whenever_it_proves_wrong(
    seed: int, profile: Profile, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Windows are learned from a few replies, of nodes that turn slow and quick again, with one frame in ten lost."""
    monkeypatch.setattr(learned, "TRUSTED_AFTER", 3)
    monkeypatch.setattr(learned, "TRUSTED_AGAIN_AFTER", 3)
    monkeypatch.setattr(learned, "EPOCH", 10)
    devices = [make_device(profile.name, address) for address in profile.addresses[1:5]]
    line = Load(seed=seed, devices=devices, profile=profile, timings=LEARNED, faults=Faults(lost=0.1))
    reads = list(profile.sync_reads)[:2]
    for number, node in enumerate(line.nodes):
        line.poll_of(str(number), 0.2, [Transaction(node, command) for command in reads])
    line.run(2.0)
    times = [0.002, 0.002, 0.03, 0.09]

    def change() -> None:
        device = line.random.choice(devices)
        device.delay = Delay(line.random.choice(times))

    line.every(lambda: line.random.expovariate(2.0), change)
    written: Command[Any] = hcp2.Write(1, (1.0,)) if profile is hcp2.PROFILE else mentor.Write(1, 17, 1)
    ahead: dict[Transaction, int] = {}
    shares: list[float] = []

    def ask() -> None:
        backlog = line.world.arbiter.dispatcher.backlog
        priority = line.random.choice((Priority.URGENT, Priority.COMMAND, Priority.COMMAND))
        command: Command[Any] = line.random.choice([*reads, written, written])
        parked = sum(map(len, line.world.arbiter.dispatcher.writes.queues.values()))
        waiting = backlog.waiting(priority) + parked
        ahead[line.ask(line.random.choice(line.nodes), command, priority)] = waiting

    def note(transaction: Transaction) -> None:
        if transaction in ahead and transaction.attempts == 1:
            before = ahead.pop(transaction)
            bounds = line.bounds()  # a maximum reply delay that was raised meanwhile counts
            if transaction.priority is Priority.URGENT:
                bound = bounds.wait(Priority.URGENT, ahead=before) * (1 if transaction.writes else 1 + MOST_BEFORE)
            else:
                bound = bounds.wait(Priority.COMMAND, ahead=before)
            shares.append((transaction.started - transaction.queued) / bound)

    line.on_completed = note
    line.every(lambda: line.random.expovariate(1.0), ask)
    line.run(120.0)
    assert len(shares) > 60
    assert max(shares) > 0.05
    assert any(node.learning is not None and node.learning.returns > 5 for node in line.nodes), "it does prove wrong"
    assert max(shares) <= 1.0


# urgent


class Trickler(EmulatedMint):
    """Its replies come byte by byte, a pause of `pace` seconds between two."""

    pace = 0.015

    def take(self, frame: bytes, now: float) -> bool:
        body = frame[4:6] + b"123456\x03"
        for number, byte in enumerate(b"\x02" + body + bytes([xor(body)])):
            self.reply(bytes([byte]), now, REPLY_TIME + number * self.pace)
        return True


def urgent_waits(line: Load, tries: int, ask: Transaction, apart: float = 0.02) -> list[float]:
    """The waits of urgent requests like `ask`, one after the other, at random moments."""
    waits: list[float] = []
    current: list[Transaction] = []

    def issue() -> None:
        current[:] = [line.ask(ask.node, ask.command, Priority.URGENT, retries=0)]

    def note(transaction: Transaction) -> None:
        if transaction in current:
            waits.append(transaction.started - transaction.queued)
            line.world.at(line.now + line.random.expovariate(1 / apart), issue)

    line.on_completed = note
    issue()
    while len(waits) < tries:
        line.run(10.0)
    return waits


def saturated(devices: list[Device] | None = None) -> Load:
    """Eight nodes that are polled faster than the line can."""
    line = Load(8, spread=SPREAD, devices=devices)
    for node in line.nodes:
        line.poll(str(node.address), 0.03, [node])
    line.run(2.0)
    return line


@pytest.mark.slow
def test_r9_urgent_starts_within_one_exchange_on_a_healthy_busy_line() -> None:
    """Two, where it is like the 32 before it and has to wait for an unlike one (R15)."""
    line = saturated()
    waits = urgent_waits(line, URGENT_TRIES, Transaction(line.nodes[4], hcp2.Read(1)))
    assert max(waits) <= 2 * LONGEST
    assert quantile(waits, 0.97) <= LONGEST
    assert line.world.arbiter.statistics(line.now).utilisation > 0.99


@pytest.mark.slow
def test_r9_urgent_starts_within_its_bound_beside_a_dead_node() -> None:
    line = saturated()
    line.devices[1].faults.dead = 1.0
    line.every(lambda: 0.3, lambda: line.ask(line.nodes[0], priority=Priority.POLL, probe=True))
    waits = urgent_waits(line, 2000, Transaction(line.nodes[4], hcp2.Read(1)))
    assert line.nodes[0].counters.no_reply > 100
    assert max(waits) > 0.1
    assert max(waits) <= (1 + MOST_BEFORE) * line.bounds().wait(Priority.URGENT)  # of a write; these are reads (R15)


@pytest.mark.slow
@pytest.mark.parametrize("pace", [0.0199, 0.001, 0.010, 0.050])
def test_r9_urgent_starts_within_its_bound_beside_a_node_whose_bytes_trickle_in(pace: float) -> None:
    trickler = Trickler(1)
    trickler.pace = pace
    line = saturated([trickler, *(EmulatedMint(address, delay=Delay(REPLY_TIME)) for address in range(2, 9))])
    line.every(lambda: 0.3, lambda: line.ask(line.nodes[0], priority=Priority.POLL, probe=True))
    waits = urgent_waits(line, 1000, Transaction(line.nodes[4], hcp2.Read(1)))
    assert line.nodes[0].counters.attempts > 100
    assert max(waits) > 5 * pace
    assert max(waits) <= (1 + MOST_BEFORE) * line.bounds().wait(Priority.URGENT)  # of a write; these are reads (R15)


@pytest.mark.slow
@pytest.mark.parametrize(
    "trouble", ["naks_ahead", "bad_packets_ahead", "missing_acks_ahead", "flip", "truncated", "lost"]
)
def test_r9_urgent_starts_within_its_bound_beside_an_msc_that_must_be_asked_again_and_again(trouble: str) -> None:
    devices = [EmulatedMsc(1), EmulatedMsc(2)]
    line = Load(devices=devices, profile=msc.PROFILE, settings=LineSettings(9600))
    for node in line.nodes:
        line.poll_of(str(node.address), 0.1, [Transaction(node, c) for c in (msc.DataRead(2000), msc.BlockRead(2000))])
    line.run(2.0)
    if trouble.endswith("ahead"):
        line.every(lambda: 0.5, lambda: setattr(devices[0], trouble, line.random.randrange(1, 7)))
    else:
        setattr(devices[0].faults, trouble, 0.5)
    waits = urgent_waits(line, 500, Transaction(line.nodes[1], msc.DataRead(2000)), apart=0.2)
    assert max(waits) <= (1 + MOST_BEFORE) * line.bounds().wait(Priority.URGENT)  # of a write; these are reads (R15)

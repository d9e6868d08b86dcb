"""Sweeps one standstill of the way back over its length: `python -m tests.verification.campaigns.stalls --jobs 2`.

One request is damaged, so that its device refuses it, and the way back stands still from then on, once. No request
causes more than one reply, and nothing overtakes: all that R15 assumes. Reads, writes and writes that may be repeated
go on to several nodes; what the arbiter makes of them is compared with what the devices have sent and received.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import product
from math import inf
from multiprocessing import Pool
from pathlib import Path
from random import Random
from typing import Any

from busmaster.arbiter.events import Event
from busmaster.arbiter.transaction import Transaction
from busmaster.contract.exchange import Command
from busmaster.contract.learning import LEARNED
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.emulator.world import World
from busmaster.errors import WriteUnconfirmed
from tests.verification.campaigns.hunt import be_hasty
from tests.verification.campaigns.kinds import KINDS, Kind, elements_of, refused
from tests.verification.campaigns.ledger import Ledger, Written
from tests.verification.campaigns.mixes import Standstill
from tests.verification.campaigns.standing import Channel

NODES = 4
LENGTHS = tuple(round(0.010 + 0.010 * step, 3) for step in range(298))
"""Seconds: 10 ms to 2.98 s, beyond every window and maximum reply delay."""
STRUCK = ("read", "once", "repeat")
"""What is damaged: a read, a write, a write that may be repeated."""
PROMPT = Delay(0.002, 0.004)
WARM = 2.5
"""Seconds after which the line is in full swing, and reply times are learned, where they are."""
AFTERWARDS = 2.0
"""Seconds for which requests go on after the standstill."""
ALL_ENDED = 120.0
"""Seconds after which every request must have ended."""
PAUSES = (0.0, 0.0, 0.02, 0.1)
"""Seconds after which a client goes on: a line that is always busy never sends a check."""
GLUED = 0.25
"""Share of the cases in which frames that were held up together are read at once."""
SHOWN = 1.0
"""Seconds of the transcript that are kept of a failure."""
ROUNDING = 1e-6
"""Of the times in it."""


@dataclass(frozen=True)
class Case:
    """One standstill. `struck` is what is damaged."""

    protocol: str
    stall: float
    struck: str
    strict: bool = False
    learned: bool = False

    def __str__(self) -> str:
        return (
            f"{self.protocol}/{self.stall:.3f}/{self.struck}"
            f"/{'strict' if self.strict else 'normal'}/{'learned' if self.learned else 'documents'}"
        )

    @classmethod
    def parse(cls, text: str) -> Case:
        protocol, stall, struck, strict, learned = text.split("/")
        return cls(protocol, float(stall), struck, strict == "strict", learned == "learned")


@dataclass
class Outcome:
    """`wrong` has a line for each false confirmation, foreign value, untrue refusal or lost request."""

    transactions: int = 0
    confirmed: int = 0
    values: int = 0
    wrong: list[str] = field(default_factory=list)
    first_wrong: float = 0.0


class StallingLine(Line):
    """Four wires behind a network: requests take their time, and replies, which disturb nothing, are handed over whole.

    The way back can stand still. On two wires a reply that comes behind the next request would collide with it, which
    hides what R15 is for.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, paced=False, **options)
        self.there: deque[tuple[float, bytes]] = deque()
        self.back = Channel(0.0, Standstill(), Random(1))
        self.glued = False
        """What was held up together is read at once."""
        self.on_send: Callable[[bytes, float], bytes] = lambda data, now: data

    def send(self, data: bytes, now: float) -> None:
        data = self.on_send(data, now)
        begin = max(now, self.there[-1][0]) if self.there else now
        self.there.append((begin + len(data) * self.settings.byte_time, data))

    def receive(self, now: float) -> bytes:
        while self.there and self.there[0][0] <= now:
            super().send(self.there.popleft()[1], now)
        if data := super().receive(now):
            self.back.put(data, now)
        come = self.back.take(now) or b""  # a world asks again: each frame may be read by itself
        while self.glued and (data := self.back.take(now) or b""):
            come += data
        return come

    def next_event(self) -> float:
        there = self.there[0][0] if self.there else inf
        return min(super().next_event(), self.back.due(), there)


class StallSweep:
    """One case: `run` it once. `record` gets the transcript, line by line."""

    def __init__(self, case: Case, record: Callable[[str], None] | None = None) -> None:
        self.case = case
        self.kind: Kind = KINDS[case.protocol]
        self.outcome = Outcome()
        self.random = Random(str(case))
        self._note = record
        self._written: dict[Transaction, Written] = {}
        self._open: set[Transaction] = set()
        self._struck = False
        self._armed = False
        ledger = self.ledger = Ledger(self.kind.modulus, self.kind.step, problem=self._wrong)
        addresses = list(self.kind.addresses)[:NODES]
        devices = [self.kind.device(ledger, address) for address in addresses]
        for device in devices:
            device.delay = PROMPT
            self.kind.slow_down(device, PROMPT)
        self.line = StallingLine(self.kind.profile.line, devices, chance=Random(f"{case} line"))
        self.line.on_send = self._pass_on
        self.line.glued = self.random.random() < GLUED
        self.world = World(self.line, on_event=self._on_event, record=record, strict=case.strict)
        ledger.now = lambda: self.world.now
        timings = LEARNED if case.learned and self.kind.profile.checked_requests else None
        if case.learned:
            be_hasty()
        self.nodes = [self.world.node(self.kind.profile, address, timings=timings) for address in addresses]

    def run(self) -> Outcome:
        world, stall = self.world, self.case.stall
        for client in range(2 * len(self.nodes)):
            world.at(client * 0.003, lambda client=client: self._request(client, client))  # type: ignore[misc]
        world.at(WARM, self._arm)
        world.run(WARM + stall + AFTERWARDS)
        self._armed = False
        if not self._struck:
            self._wrong("nothing was damaged: the case shows nothing")
        if not world.run_until(lambda: not self._open, ALL_ENDED):
            self._wrong(f"{len(self._open)} requests never ended")
        return self.outcome

    def _wrong(self, what: str) -> None:
        if not self.outcome.wrong:
            self.outcome.first_wrong = self.world.now
        self.outcome.wrong.append(f"{self.world.now:.6f} {what}")
        if self._note is not None:
            self._note(f"{self.world.now:.6f} WRONG: {what}")

    # the line

    def _arm(self) -> None:
        self._armed = True

    def _pass_on(self, data: bytes, now: float) -> bytes:
        """Damage the first request of the kind that is to be struck, and stop the way back at that moment."""
        asked = self.world.arbiter._wire.transaction
        if not self._armed or self._struck or asked is None or len(data) < 2 or asked.tag is None:
            return data
        if asked.writes != (self.case.struck != "read") or asked.idempotent != (self.case.struck != "once"):
            return data
        damaged = refused(self.kind, data)
        self._struck = True
        self.line.back.still_until = now + self.case.stall
        if self._note is not None:
            node = asked.node.label
            self._note(f"{now:.6f} damaged, to {node}; the way back stands still for {self.case.stall:g} s")
        return damaged

    # clients

    def _request(self, client: int, turn: int) -> None:
        """Submit one request of a client, which goes on when that has ended."""
        node = self.nodes[client % len(self.nodes)]
        what = ("read", "once", "read", "repeat")[(turn + turn // 4) % 4]
        chance = self.random
        command: Command[Any]
        idempotent = what != "once"
        if what == "read":
            command = self._own_read(client)
        else:
            number = self.ledger.number()
            command = self.kind.write(chance, number, what == "repeat")
        transaction = Transaction(node, command, tag=(client, turn), idempotent=idempotent)
        if what != "read":
            self._written[transaction] = self.ledger.sending(number, node.address, elements_of(command))
        self._open.add(transaction)
        self.world.arbiter.submit(transaction, self.world.now)

    def _own_read(self, client: int) -> Command[Any]:
        """Every second client reads what all do; the others what they like."""
        reads = [read for read in self.kind.reads if elements_of(read) and elements_of(read) != (1560,)]
        return reads[0] if client % 2 else self.random.choice(reads)

    def _on_event(self, event: Event) -> None:
        if not isinstance(event, Transaction) or event.probe:
            return
        if event not in self._open:
            self._wrong(f"{event.command} ended twice")
            return
        self._open.discard(event)
        self._judge(event)
        client, turn = event.tag
        if self.world.now < WARM + self.case.stall + AFTERWARDS - 1.0:
            pause = self.random.choice(PAUSES)
            self.world.at(self.world.now + pause, lambda: self._request(client, turn + 1))

    # what is true

    def _judge(self, ended: Transaction) -> None:
        outcome = self.outcome
        outcome.transactions += 1
        what = f"{ended.node.label}: {ended.command}"
        written = self._written.pop(ended, None)
        if written is not None:
            if ended.error is None:
                outcome.confirmed += 1
                if not written.taken:
                    self._wrong(f"{what} was confirmed, and {ended.node.label} had not received it")
            elif written.taken and not isinstance(ended.error, WriteUnconfirmed) and len(written.elements) == 1:
                self._wrong(f"{what} was carried out, and ended with {ended.error!r}")
            if not ended.idempotent and written.taken > 1:
                self._wrong(f"{what} was carried out {written.taken} times")
        elif ended.error is None:
            outcome.values += 1
            numbers = ended.value if type(ended.value) is tuple else (ended.value,)
            for number, element in zip(numbers, elements_of(ended.command), strict=True):
                answer = self.ledger.said_for(int(number))
                if answer is None or answer[:2] != (ended.node.address, element) or answer.asked < ended.queued:
                    self._wrong(f"{what} brought {number}, which is {answer}")


def cases(
    protocols: list[str],
    lengths: tuple[float, ...] = LENGTHS,
    strict: tuple[bool, ...] = (False, True),
    learned: tuple[bool, ...] = (False, True),
) -> Iterator[Case]:
    """Yield every protocol, level of R15, kind of windows, kind of damaged request, and length."""
    for protocol, is_strict, is_learned, struck, stall in product(protocols, strict, learned, STRUCK, lengths):
        yield Case(protocol, stall, struck, is_strict, is_learned)


def run(case: Case) -> tuple[Case, Outcome]:
    """Run one case."""
    return case, StallSweep(case).run()


def transcript(case: Case, *, whole: bool = False) -> list[str]:
    """Return the transcript of a case: of the last second before the first failure, unless it is to be `whole`."""
    lines: list[str] = []
    outcome = StallSweep(case, lines.append).run()
    if whole or not outcome.wrong:
        return lines
    end = outcome.first_wrong + ROUNDING
    begin = max(WARM, end - SHOWN)
    return [line for line in lines if "damaged, to" in line or begin <= float(line.split()[0]) <= end]


def main() -> int:
    """Return exit status 1 if anything was wrong."""
    parser = argparse.ArgumentParser(prog="python -m tests.verification.campaigns.stalls", description=__doc__)
    parser.add_argument("--protocol", action="append", choices=list(KINDS), help="again for several; all by default")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="every Nth of the 298 lengths")
    parser.add_argument("--first", type=int, default=0, metavar="N", help="from this length on")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes")
    parser.add_argument("--seconds", type=float, default=inf, help="begin no case after so long")
    parser.add_argument("--findings", type=Path, metavar="FOLDER", help="write a transcript of each kind of failure")
    parser.add_argument("--replay", metavar="CASE", help="one case again, as it was shown, with its transcript")
    options = parser.parse_args()
    if options.replay:
        lines = transcript(Case.parse(options.replay), whole=True)
        sys.stdout.write("".join(f"{line}\n" for line in lines))
        return 1 if any(" WRONG: " in line for line in lines) else 0
    chosen = list(cases(options.protocol or list(KINDS), LENGTHS[options.first :: options.every]))
    sums: defaultdict[tuple[str, bool, bool], list[Outcome]] = defaultdict(list)
    failed: defaultdict[tuple[str, bool, bool, str], list[Case]] = defaultdict(list)
    end = time.monotonic() + options.seconds
    with Pool(options.jobs) as pool:
        for case, outcome in pool.imap(run, chosen, chunksize=4):
            sums[case.protocol, case.strict, case.learned].append(outcome)
            if outcome.wrong:
                sys.stdout.write(f"{case}: {outcome.wrong[0]}\n")
                known = failed[case.protocol, case.strict, case.learned, case.struck]
                known.append(case)
                if options.findings is not None and len(known) == 1:
                    name = f"sweep-{str(case).replace('/', '-')}.txt"
                    (options.findings / name).write_text("".join(f"{line}\n" for line in transcript(case)))
            if time.monotonic() > end:
                pool.terminate()
                break
    for (protocol, strict, learned), outcomes in sums.items():
        transactions = sum(outcome.transactions for outcome in outcomes)
        confirmed = sum(outcome.confirmed for outcome in outcomes)
        wrong = sum(bool(outcome.wrong) for outcome in outcomes)
        sys.stdout.write(
            f"{protocol:8}{'strict' if strict else 'normal':8}{'learned' if learned else 'documents':10}"
            f"{len(outcomes):6,} standstills {transactions:10,} transactions {confirmed:9,} writes confirmed "
            f"{wrong:5,} standstills with something wrong\n"
        )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())

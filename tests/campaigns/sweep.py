"""One standstill, of every length: `python -m tests.campaigns.sweep --jobs 2`.

One request is refused (its bytes were damaged), and the way back stands still at that moment, once, for so long. Each
request causes at most one reply, and the channel keeps order: all that R15 rests on. Reads, writes and writes that may
be repeated go on to several nodes. No value may be another's, and no write confirmed that no node has carried out.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from multiprocessing import Pool

from tests.campaigns.hunt import Hunt
from tests.campaigns.judge import Totals
from tests.campaigns.kinds import KINDS
from tests.campaigns.mixes import SWEPT
from tests.campaigns.standing import StandingLine

LENGTHS = tuple(round(0.010 * step, 3) for step in range(1, 299))
"""Seconds: up to three times the longest window of the protocols (MSC's)."""
BEGINS = 4.0
"""Seconds after which the line is busy, and its nodes' reply times are learned."""
TRANSACTIONS = 1000
SLOW = {"msc": 400}
"""Of slow protocols: as many as go on the line in about as long."""


class Sweep(Hunt):
    """One hunt with one standstill of `seconds`."""

    def __init__(
        self,
        protocol: str,
        seconds: float,
        *,
        strict: bool = False,
        learned: bool = False,
        record: Callable[[str], None] | None = None,
    ) -> None:
        super().__init__(protocol, SWEPT.name, round(seconds * 1000), record, strict=strict, learned=learned)
        self.seconds = seconds
        self.struck = False

    def _break(self) -> None:
        super()._break()
        self.world.at(BEGINS, self._refuse_one)

    def _refuse_one(self) -> None:
        """Have the next request refused, by whichever node it is sent to, and stand still then."""
        refusals = [device.faults for device in self.devices]
        for faults in refusals:
            faults.nak = 1.0
        line = self.line
        assert isinstance(line, StandingLine)
        put = line.back.put

        def stand_still(data: bytes, now: float) -> None:
            for faults in refusals:
                faults.nak = 0.0
            line.back.put = put  # type: ignore[method-assign]  # once
            line.back.still_until = now + self.seconds
            line.back.byte_time = line.tau
            self.struck = True
            self.note(f"the way back stands still for {self.seconds:g} s")
            put(data, now)

        line.back.put = stand_still  # type: ignore[method-assign]  # until the first reply


def cases(protocols: list[str], lengths: tuple[float, ...]) -> Iterator[tuple[str, float, bool, bool]]:
    """Every protocol and length, normal and strict, with the documents' windows and with learned ones."""
    for protocol in protocols:
        for strict in (False, True):
            for learned in (False, True):
                for seconds in lengths:
                    yield protocol, seconds, strict, learned


def run(case: tuple[str, float, bool, bool]) -> tuple[tuple[str, float, bool, bool], Totals]:
    protocol, seconds, strict, learned = case
    sweep = Sweep(protocol, seconds, strict=strict, learned=learned)
    totals = sweep.run(SLOW.get(protocol, TRANSACTIONS))
    if not sweep.struck:
        totals.problems.append("nothing stood still: nothing was asked")
    return case, totals


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--protocol", action="append", choices=tuple(KINDS), help="again for several; all by default")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="only every Nth length")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes")
    options = parser.parse_args()
    sums: dict[tuple[str, bool, bool], Totals] = {}
    with Pool(options.jobs) as pool:
        chosen = list(cases(options.protocol or list(KINDS), LENGTHS[:: options.every]))
        for case, totals in pool.imap(run, chosen, chunksize=8):
            protocol, seconds, strict, learned = case
            sums.setdefault((protocol, strict, learned), Totals()).add(totals)
            if totals.confused or totals.lost or totals.problems:
                sys.stdout.write(f"{protocol}, {seconds:g} s, strict={strict}, learned={learned}: {totals.problems}\n")
    for (protocol, strict, learned), total in sums.items():
        sys.stdout.write(
            f"{protocol:8}{'strict' if strict else 'normal':8}{'learned' if learned else 'document':10}"
            f"{total.hunts:5} standstills {total.transactions:8,} transactions {total.confused:4} confused "
            f"{total.lost:4} lost {len(total.problems):4} rules broken\n"
        )


if __name__ == "__main__":
    main()

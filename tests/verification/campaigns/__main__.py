"""Hunts for wrong values, in virtual time: `python -m tests.verification.campaigns --transactions 10_000_000 --seed 1`.

Each seed is a hunt for every protocol and every mix of faults, until so many transactions were on the wire. Inside R3's
assumption any wrong value that is not the checksum's, and any broken rule, ends it with the command that replays it.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import nullcontext
from itertools import count
from multiprocessing import Pool

from tests.verification.campaigns.hunt import Hunt
from tests.verification.campaigns.judge import Totals
from tests.verification.campaigns.kinds import KINDS
from tests.verification.campaigns.mixes import BEYOND, MIXES, WITHIN

EACH = 5000
"""Transactions of one hunt."""
Pair = tuple[str, str]
Found = Mapping[Pair, Totals]
COLUMNS = (
    *("transactions", "values", "writes", "good", "failed", "cancelled", "confused", "unseen", "heard_twice", "untrue"),
    *("unseen_writes", "unexpected", "seconds", "recovery", "worst"),
)
"""Those of `Totals` that are shown for each protocol and mix."""


def main() -> int:
    """Exit status 1 if a promise was broken."""
    arguments = _parse()
    if arguments.replay is not None:
        return _replay(arguments.replay, arguments.each, arguments.strict, arguments.learned)
    pairs = [(protocol, mix) for protocol in arguments.protocol for mix in arguments.mix]
    found: defaultdict[Pair, Totals] = defaultdict(Totals)
    begun, done = time.perf_counter(), 0
    with Pool(arguments.jobs) if arguments.jobs > 1 else nullcontext() as pool:
        for seed in count(arguments.seed):
            how = (arguments.each, arguments.strict, arguments.learned)
            hunts = [(protocol, mix, seed, *how) for protocol, mix in pairs]
            for (protocol, mix), totals in map(_hunt, hunts) if pool is None else pool.imap_unordered(_hunt, hunts):
                found[protocol, mix].add(totals)
                done += totals.transactions
                if totals.problems:
                    _say(f"{protocol}/{mix}/{seed}: {totals.problems[0]}")
                    options = f"--each {arguments.each}{' --strict' * arguments.strict}"
                    options += " --learned" * arguments.learned
                    _say(f"  python -m tests.verification.campaigns --replay '{protocol}/{mix}/{seed}' {options}")
            sys.stderr.write(f"seed {seed}: {done:,} transactions, {time.perf_counter() - begun:.0f} s\n")
            if seed - arguments.seed + 1 == arguments.seeds or (not arguments.seeds and done >= arguments.transactions):
                break
    _report(found, f"seeds {arguments.seed} to {seed}", time.perf_counter() - begun)
    if arguments.beyond:
        _report_beyond(found)
    return 1 if any(totals.problems for totals in found.values()) else 0


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.verification.campaigns", description=__doc__)
    parser.add_argument("--transactions", type=int, default=1_000_000, metavar="N", help="about so many")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="the first seed")
    parser.add_argument("--seeds", type=int, default=0, metavar="N", help="so many seeds, however many transactions")
    parser.add_argument("--protocol", action="append", choices=list(KINDS), help="again for several; all by default")
    parser.add_argument("--mix", action="append", choices=list(MIXES), help="again for several")
    parser.add_argument("--beyond", action="store_true", help="the mixes beyond R3's assumption, not those inside it")
    parser.add_argument("--strict", action="store_true", help="the strict level of R15")
    parser.add_argument("--learned", action="store_true", help="reply times are learned, and trusted at once")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes")
    parser.add_argument("--each", type=int, default=EACH, metavar="N", help="transactions of one hunt")
    parser.add_argument("--replay", metavar="PROTOCOL/MIX/SEED", help="one hunt again, with its transcript")
    arguments = parser.parse_args()
    arguments.protocol = arguments.protocol or list(KINDS)
    arguments.mix = arguments.mix or [mix.name for mix in (BEYOND if arguments.beyond else WITHIN)]
    return arguments


def _hunt(what: tuple[str, str, int, int, bool, bool]) -> tuple[Pair, Totals]:
    protocol, mix, seed, transactions, strict, learned = what
    return (protocol, mix), Hunt(protocol, mix, seed, strict=strict, learned=learned).run(transactions)


def _replay(name: str, transactions: int, strict: bool, learned: bool) -> int:
    protocol, mix, seed = name.split("/")
    totals = Hunt(protocol, mix, int(seed), _say, strict=strict, learned=learned).run(transactions)
    return 1 if totals.problems else 0


def _report(found: Found, seeds: str, seconds: float) -> None:
    _say(f"{'':8}{'':24}{''.join(column.rjust(14) for column in COLUMNS)}")
    for (protocol, mix), totals in [*sorted(found.items()), *_sums(found)]:
        numbers = [getattr(totals, column) for column in COLUMNS]
        cells = [f"{n:.1f}" if isinstance(n, float) else f"{n:,}" for n in numbers]
        _say(f"{protocol:8}{mix:24}{''.join(cell.rjust(14) for cell in cells)}")
    total = _sum(found.values())
    _say(f"{seeds}: {total.hunts:,} hunts, {total.transactions:,} transactions on the wire, in {seconds:,.0f} s")
    _say(f"{total.seconds / 3600:,.0f} h of lines; {total.attempts:,} attempts, {total.bad_attempts:,} of them failed")
    _say(f"{total.confused:,} confused, {total.lost:,} lost, {len(total.problems):,} rules broken")
    _say(f"{total.unseen:,} wrong that no checksum shows, {total.unseen_writes:,} writes of nobody's likewise")


def _sums(found: Found) -> Iterator[tuple[Pair, Totals]]:
    for protocol in sorted({protocol for protocol, _ in found}):
        yield (protocol, "all"), _sum(totals for pair, totals in found.items() if pair[0] == protocol)


def _sum(many: Iterable[Totals]) -> Totals:
    total = Totals()
    for one in many:
        total.add(one)
    return total


def _report_beyond(found: Found) -> None:
    """Wrong values and acknowledgements per million transactions, and what was noticed, as the documentation has it;
    then writes that a drive heard twice, per million, right outcomes per thousand, and milliseconds of line time
    each."""
    protocols = sorted({protocol for protocol, _ in found})
    _say(f"\n| what happens | {' | '.join(protocols)} | noticed | heard twice | good | ms each |")
    _say(f"| --- |{' ---: |' * (len(protocols) + 4)}")
    for mix in dict.fromkeys(mix for _, mix in found):
        all_of_it = _sum(totals for pair, totals in found.items() if pair[1] == mix)
        cells = [_per_million(found[protocol, mix], found[protocol, mix].wrong) for protocol in protocols]
        cells += [_per_million(all_of_it, of) for of in (all_of_it.bad_attempts, all_of_it.heard_twice)]
        cells += [f"{1000 * all_of_it.good / max(1, all_of_it.transactions):.0f}"]
        cells += [f"{1000 * all_of_it.seconds / max(1, all_of_it.good):.1f}"]
        _say(f"| {MIXES[mix].says} | {' | '.join(cells)} |")


def _per_million(totals: Totals, count_of: int) -> str:
    return f"{1e6 * count_of / max(1, totals.transactions):,.0f}"


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")


if __name__ == "__main__":
    sys.exit(main())

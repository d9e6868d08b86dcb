"""Digests of campaign transcripts: does the core still do, byte for byte and moment for moment, what it did?

    python -m tests.verification.campaigns.digests --jobs 2           # compare them; exit status 1 if one is another
    python -m tests.verification.campaigns.digests --jobs 2 --write   # keep those of this core

Every protocol under every mix of faults, three seeds, with the documents' windows and with learned ones. A change that
is only mechanical (a module moved, a class merged, a name changed) leaves each of them as it is. A change of behaviour
writes new digests, and its commit says which differ and why.

A digest covers every byte on the wire with its time, and of every other line the time and all numbers (nodes, items,
values, counts). Words are left out, so that a new name for an event or an error changes nothing.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import sys
from collections.abc import Iterable, Iterator
from dataclasses import astuple
from multiprocessing import Pool
from pathlib import Path

from tests.verification.campaigns.hunt import Hunt
from tests.verification.campaigns.kinds import KINDS
from tests.verification.campaigns.mixes import MIXES

KEPT = Path(__file__).with_name("digests.json")
SEEDS = (1, 2, 3)
EACH = 200
"""Transactions of one hunt: enough for every fault of its mix, few enough that all hunts take some minutes."""
LENGTH = 16
"""Hexadecimal digits of a digest that are kept."""
ON_THE_WIRE = re.compile(r"[0-9.]+ [<>] ")
NUMBER = re.compile(r"-?[0-9]+(?:\.[0-9]+)?(?:e-?[0-9]+)?")


def names() -> Iterator[str]:
    """Yield the name of every hunt: protocol, mix, seed, and the windows."""
    for protocol in KINDS:
        for mix in MIXES:
            for seed in SEEDS:
                for windows in ("documents", "learned"):
                    yield f"{protocol}/{mix}/{seed}/{windows}"


def digest(name: str) -> str:
    """Return the digest of one hunt's transcript and of how it ended."""
    protocol, mix, seed, windows = name.split("/")
    transcript = hashlib.sha256()

    def record(line: str) -> None:
        counted = line if ON_THE_WIRE.match(line) else " ".join(NUMBER.findall(line))
        transcript.update(counted.encode() + b"\n")

    totals = Hunt(protocol, mix, int(seed), record, learned=windows == "learned").run(EACH)
    transcript.update(repr(astuple(totals)).encode())
    return transcript.hexdigest()[:LENGTH]


def kept() -> dict[str, str]:
    """Return the digests that were kept."""
    found: dict[str, str] = json.loads(KEPT.read_text())
    return found


def changed(found: Iterable[tuple[str, str]], before: dict[str, str]) -> list[str]:
    """Return the hunts whose digest is another than before, or was not kept."""
    return [name for name, digest in found if before.get(name) != digest]


def _of(name: str) -> tuple[str, str]:
    return name, digest(name)


def main() -> int:
    """Exit status 1 if a digest is another."""
    parser = argparse.ArgumentParser(prog="python -m tests.verification.campaigns.digests", description=__doc__)
    parser.add_argument("--write", action="store_true", help="keep the digests of this core")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes")
    options = parser.parse_args()
    with Pool(options.jobs) as pool:
        found = dict(pool.imap(_of, names(), chunksize=8))
    before = kept() if KEPT.exists() else {}
    others = changed(found.items(), before)
    gone = sorted(set(before) - set(found))
    for name in others:
        sys.stdout.write(f"{name}: {before.get(name, 'not kept')}, now {found[name]}\n")
    for name in gone:
        sys.stdout.write(f"{name}: kept, but there is no such hunt\n")
    sys.stderr.write(f"{len(found)} hunts, {len(others)} with another digest, {len(gone)} gone\n")
    if options.write:
        KEPT.write_text(json.dumps(found, indent=0) + "\n")
        return 0
    return 1 if others or gone else 0


if __name__ == "__main__":
    sys.exit(main())

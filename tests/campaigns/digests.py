"""Digests of campaign transcripts: does the core still do, byte for byte and moment for moment, what it did?

    python -m tests.campaigns.digests --jobs 2           # compare with digests.json; exit status 1 if one is another
    python -m tests.campaigns.digests --jobs 2 --write   # keep those of this core

Every protocol under every mix of faults, three seeds, with the documents' windows and with learned ones. A change that
is only mechanical (a module moved, a class merged, a name changed) leaves each of them as it is. A change of behaviour
writes them anew, and its commit says which differ and why.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Iterable, Iterator
from multiprocessing import Pool
from pathlib import Path

from tests.campaigns.hunt import Hunt
from tests.campaigns.kinds import KINDS
from tests.campaigns.mixes import MIXES

KEPT = Path(__file__).with_name("digests.json")
SEEDS = (1, 2, 3)
EACH = 200
"""Transactions of one hunt: enough for every fault of its mix, few enough that all hunts take some minutes."""
LENGTH = 16
"""Hexadecimal digits of a digest that are kept."""


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
    said = hashlib.sha256()

    def record(line: str) -> None:
        said.update(line.encode() + b"\n")

    totals = Hunt(protocol, mix, int(seed), record, learned=windows == "learned").run(EACH)
    said.update(repr(totals).encode())
    return said.hexdigest()[:LENGTH]


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
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns.digests", description=__doc__)
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

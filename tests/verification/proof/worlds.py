"""The worlds that are explored: every feature of the adversary with every other, and every kind of line.

Not the full product: all features at once do not close.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

from busmaster.arbiter.learned import LEAST
from tests.verification.proof.kinds import READ, READ_LIKE, READ_THERE, READ_UNLIKE, WRITE, WRITE_THERE
from tests.verification.proof.setups import (
    ALL,
    BEYOND,
    CANCELS,
    ECHO_FAULTS,
    FLIPS,
    HEALTH,
    HELD,
    HOLDS,
    IDLE,
    LOSS,
    LOST,
    MARKS,
    NAKS,
    NOISE,
    RAISED,
    STALLS,
    STRAYS,
    URGENT,
    Assumptions,
    Setup,
)
from tests.verification.registered import registered

CHOSEN = ("hcp", "hcp2", "microflex", "mentor", "ct-ansi", "dc104", "modbus", "msc")
EVERY_KIND = (*CHOSEN, *(one.name for one in registered(CHOSEN)))
"""Every protocol of the registry, and what speaks one of them otherwise."""
LAPSES = {"dc104": 1.5, "mentor": 0.8, "msc": 2.5}
"""In place of LAPSE: longer than the longest maximum reply delay."""
LEARNED = (LEAST, 0.1)
"""Seconds: the least window that is ever learned, and the document's."""
SHORT = {"mentor": 0.018, "ct-ansi": 0.018, "msc": 0.036}
"""Seconds: a maximum reply delay in which a whole reply has room at these lines' rates, where windows are learned."""
DAMAGE: tuple[tuple[int, int | None], ...] = ((0, 0), (1, 1), (3, 0), (6, 5), (13, 0), (17, 0), (9, None))
"""Of an MSC's packet of 18 bytes: STX, unit, length, name, data and checksum hit, and a byte lost."""


def _line(kind: str = "hcp2", *adversary: str, commands: tuple[int, ...] = (READ, WRITE)) -> Setup:
    lapse = next((seconds for name, seconds in LAPSES.items() if kind.startswith(name)), 0.4)
    return Setup(kind=kind, commands=commands, adversary=adversary, lapse=lapse)


def _late(kind: str, *adversary: str, commands: tuple[int, ...], retries: int = 0) -> Setup:
    """A world of R15 in which replies come up to a fifth after their maximum reply delay. That is a short one, of every
    node: so few replies are overdue at a time."""
    line = _line(kind, BEYOND, *adversary, commands=commands)
    return replace(line, in_sync=True, whole=True, retries=retries, max_reply_delay=0.15, beyond=0.18, lapse=0.19)


def _learning(kind: str, *adversary: str, commands: tuple[int, ...] = (READ,), max_reply_delay: float) -> Setup:
    """A world of R15 in which the line goes on after a learned window, and replies come within their maximum reply
    delay."""
    line = replace(_line(kind, *adversary, commands=commands), in_sync=True, whole=True, retries=1)
    lapse, learned = max_reply_delay * 4 / 3, (LEAST, max_reply_delay * 2 / 3)
    return replace(line, max_reply_delay=max_reply_delay, beyond=max_reply_delay, lapse=lapse, learned=learned)


def _pausing(kind: str, commands: tuple[int, ...]) -> Setup:
    """Such a world in which a reply may pause, and its rest may come in the reply of the next request."""
    one = _learning(kind, commands=commands, max_reply_delay=SHORT.get(kind, 0.012))
    return replace(one, pauses=(4,), lapse=0.033)


def quick() -> Iterator[Setup]:
    """What continuous integration explores: each kind of line, and each feature that breaks a wire, alone; and R15 for
    each protocol, where replies come late and refuse, and where windows are learned."""
    for kind in ("hcp", "mentor", "dc104", "msc"):
        yield _line(kind)
    for feature in (LOST, MARKS, CANCELS, STRAYS, FLIPS, HELD):
        yield _line("hcp2", feature)
    for feature in (FLIPS, MARKS, STRAYS):
        yield _line("msc", feature)
    for lost in ((), (LOST,)):  # a reply that was lost holds the line as long as one that was heard
        yield replace(_line("hcp2", *lost, commands=(READ, WRITE_THERE)), second_timing=True)
    yield replace(_line("dc104"), receive_latency=0.016)
    yield _line("hcp2", URGENT, HEALTH, commands=(WRITE,))
    yield replace(_line("hcp2", ECHO_FAULTS), echo=True)
    yield replace(_line("hcp2", STRAYS, commands=(WRITE,)), paced=True)
    yield replace(_line("msc"), lost_acknowledgements=1)
    yield replace(_line(commands=(WRITE,)), clients=1, depth=1)
    yield replace(_line("hcp2", LOST, commands=(WRITE,)), clients=1, depth=1, retries=1)
    for kind in ("hcp", "microflex", "mentor", "ct-ansi", "dc104", "msc"):
        yield _late(kind, commands=(READ,))
    for kind in ("hcp2", "modbus", "msc"):  # with refusals: a NAK, an exception, and a resend within the exchange
        yield _late(kind, NAKS, commands=(WRITE,))
    yield _learning("hcp2", max_reply_delay=0.015)


def lines() -> Iterator[Setup]:
    """Every kind of line, each with what breaks a wire."""
    for kind in ("hcp2", "hcp2, other checksums", "hcp", "mentor", "dc104", "dc104, other checksums", "msc"):
        hit = MARKS if kind == "mentor" else FLIPS  # its parity tells
        for adversary in ((), (hit,), (LOST,), (NAKS,), (STRAYS,)):
            yield _line(kind, *adversary)
    for kind in ("hcp2", "mentor", "dc104", "msc"):
        for adversary in ((), (STRAYS,), (LOST,)):
            yield replace(_line(kind, *adversary), paced=True)
            yield replace(_line(kind, *adversary), receive_latency=0.016)
        hit = MARKS if kind == "mentor" else FLIPS
        for faults in ((), (ECHO_FAULTS,), (ECHO_FAULTS, hit)):
            yield replace(_line(kind, *faults), echo=True)
        yield replace(_line(kind, ECHO_FAULTS, STRAYS), echo=True)
        yield replace(_line(kind, ECHO_FAULTS), echo=True, receive_latency=0.016)
        yield replace(_line(kind, hit), assumptions=Assumptions("received byte", "received byte"))
    for kind in ("hcp2", "mentor", "msc"):
        for adversary in ((), (LOST,), (NAKS,)):
            yield _line(kind, *adversary, commands=(READ, WRITE_THERE))
    yield replace(_line(commands=(WRITE,)), receive_latency=0.016, cuts=True)
    yield replace(_line("dc104"), receive_latency=0.016, cuts=True)
    yield replace(_line(commands=(READ, WRITE_THERE)), second_timing=True)
    yield replace(_line("hcp2", LOST, commands=(READ, WRITE_THERE)), second_timing=True)
    yield replace(_line("hcp2", NAKS, commands=(READ, WRITE, READ_UNLIKE)), retries=1)
    yield replace(_line("hcp2", IDLE), depth=2)


def shared() -> Iterator[Setup]:
    """Lines that programs share, and hold for sequences of requests."""
    one = replace(_line(commands=(WRITE,)), clients=1, depth=1)
    for feature in (NAKS, CANCELS, URGENT, LOSS, FLIPS):
        yield replace(one, adversary=(feature,))
    yield replace(one, commands=(READ, WRITE), depth=2)
    for commands in ((READ,), (WRITE,)):
        held = replace(_line(commands=commands), longest_hold=0.3)
        for adversary in ((), (LOST,), (NAKS,), (CANCELS,), (URGENT,), (LOSS,)):
            yield replace(held, adversary=adversary)
    yield replace(held, clients=1)
    yield replace(held, retries=1, adversary=(LOST,))


def packets() -> Iterator[Setup]:
    """MSC: packets damaged, said again, and the host's ACK lost."""
    yield replace(_line("msc"), damage=DAMAGE)
    yield replace(_line("msc"), bytewise=True)
    yield replace(_line("msc"), lost_acknowledgements=1)
    yield replace(_line("msc", FLIPS), damage=DAMAGE, lost_acknowledgements=1)
    yield replace(_line("msc", LOST), damage=DAMAGE)
    yield replace(_line("msc", STRAYS), damage=DAMAGE)
    yield replace(_line("msc"), damage=DAMAGE, lost_acknowledgements=1, receive_latency=0.016)
    yield replace(_line("msc", URGENT), damage=DAMAGE)


def pairs() -> Iterator[Setup]:
    """HCP2, one node: each feature, and each two of them."""
    for one in ALL:
        yield _line("hcp2", one)
    for two in combinations(ALL, 2):
        yield _line("hcp2", *two)


def msc_pairs() -> Iterator[Setup]:
    """MSC: each two features that need no long silence of the port."""
    for two in combinations((FLIPS, LOST, MARKS, NAKS, STRAYS, CANCELS, URGENT, LOSS, HOLDS, NOISE), 2):
        yield _line("msc", *two)


def in_sync() -> Iterator[Setup]:
    """What is overdue told by the shipping code, and replies that come after their maximum reply delay, in order (R15);
    or within it, where the line goes on after a learned window."""
    for commands in ((READ,), (WRITE,), (READ, READ_UNLIKE), (READ, WRITE), (READ, READ_THERE)):
        one = replace(_line("hcp2", BEYOND, commands=commands), in_sync=True, whole=True, lapse=0.25, beyond=0.24)
        yield one
        if READ in commands:  # where nothing is repeated, nothing is awaited for a learned time
            yield replace(one, adversary=(), retries=1, learned=LEARNED, lapse=0.2, beyond=0.15)
    for kind in EVERY_KIND:
        for commands in ((READ,), (WRITE,)):
            yield _late(kind, NAKS, commands=commands)
        yield _learning(kind, max_reply_delay=SHORT.get(kind, 0.012))
    for kind in ("hcp2", "msc"):  # replies that say whose element they answer, and phases
        yield _late(kind, commands=(READ, WRITE))
        yield _late(kind, commands=(WRITE, WRITE_THERE))
        yield _late(kind, NAKS, commands=(WRITE,), retries=1)
        yield replace(_late(kind, NAKS, commands=(WRITE,)), strict=True)
        yield _learning(kind, NAKS, max_reply_delay=SHORT.get(kind, 0.012))
    for commands in ((READ,), (READ, READ_LIKE)):
        yield _pausing("hcp2, tails alike", commands)
    yield _learning("mentor", commands=(READ, READ_THERE), max_reply_delay=SHORT["mentor"])


GROUPS = {
    "quick": quick,
    "lines": lines,
    "shared": shared,
    "packets": packets,
    "pairs": pairs,
    "msc pairs": msc_pairs,
    "in sync": in_sync,
}
LARGE = (HEALTH, HELD, LOSS, RAISED, STALLS, STRAYS, BEYOND)
"""Features whose worlds are large: they come last, so that what is not closed within the time is theirs."""


def worlds(groups: list[str]) -> list[Setup]:
    """Return the worlds of these groups, each once, small ones first."""
    found = {setup.name: setup for group in groups for setup in GROUPS[group]()}
    return sorted(found.values(), key=_size)


def _size(setup: Setup) -> float:
    large = sum(map(setup.may, LARGE)) + 2 * (setup.receive_latency > 0) + 4 * setup.in_sync
    return large + 0.5 * len(setup.adversary) + 3 * (setup.longest_hold > 0)

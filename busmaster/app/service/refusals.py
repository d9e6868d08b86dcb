"""Connections and logins that a line or one of its interfaces refuses: counted, reported, and slowed down.

A refusal can occur a thousand times a second. So each kind is reported at once, then at most once a minute with a
count, and the history of each peer is bounded.
"""

from __future__ import annotations

import asyncio
import ipaddress
import re
from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf

from busmaster.app.bounds import (
    FREE_LOGINS,
    LOGINS_FORGOTTEN,
    LONGEST_LOGIN_PAUSE,
    MOST_LOGIN_PEERS,
    MOST_REPORTED,
    SHORTEST_LOGIN_PAUSE,
)

REPORT_EVERY = 60.0
"""Seconds from one report of a kind to the next."""
NAMED = 3
"""Peers that one report names."""
OTHERS = "others"
TOO_FAST = "unknown"
"""The role of connections that are closed before they show who they are."""
SERVICE = "service"
"""The line's own socket, beside the interfaces, which name themselves."""
KINDS = ("logins", "connections", "requests")
"""What an interface can refuse."""
INTERFACE_NAME = re.compile(r"[a-z][a-z0-9_-]{0,31}")
MOST_INTERFACES = 16
"""Names under which refusals are counted; those of further ones are counted as OTHERS."""
MOST_GOOD = 16
"""Names of tokens that are remembered for one peer."""

Report = Callable[[str], None]


class LimitedReport:
    """Reports what happens often: the first time at once, then at most once in REPORT_EVERY, with the counts since.

    `text` makes a sentence of the counts. A report is given to `report`, on the running loop.
    """

    def __init__(self, report: Report, text: Callable[[Counter[str]], str]) -> None:
        self._deliver = report
        self._text = text
        self._counts: Counter[str] = Counter()
        self._timer: asyncio.TimerHandle | None = None

    def note(self, what: str = "", count: int = 1) -> None:
        """Count it; report it now if the last report is a minute old."""
        if what not in self._counts and len(self._counts) >= MOST_REPORTED:
            what = OTHERS
        self._counts[what] += count
        if self._timer is None:
            self._report()

    def _report(self) -> None:
        self._timer = None
        if self._counts:
            counts, self._counts = self._counts, Counter()
            self._deliver(self._text(counts))
            self._timer = asyncio.get_running_loop().call_later(REPORT_EVERY, self._report)


class Refusals:
    """The refusals of one line and its interfaces, for its log, its metrics and `status`.

    The functions in `on_report` are called with a sentence. Interfaces are not listed here: each reports its own name.
    """

    def __init__(self) -> None:
        self.connections: Counter[str] = Counter()
        """Connections for which no place was free, by the role of the program; of TOO_FAST, which came too fast."""
        self.logins: Counter[str] = Counter({SERVICE: 0})
        """Failed logins, by the interface."""
        self.at_interfaces: Counter[tuple[str, str]] = Counter()
        """Connections and requests that interfaces have refused, by the interface and the kind."""
        self.on_report: list[Report] = []
        self._reports: dict[str, LimitedReport] = {}

    def note_connection(self, role: str) -> None:
        """Count a program for which no place was free, and report it."""
        self.connections[role] += 1
        self._report("", _refused_text).note(role)

    def note_rate(self, peer: str) -> None:
        """Count a connection that was closed because its peer connects too fast, and report it."""
        self.connections[TOO_FAST] += 1
        self._report(TOO_FAST, _too_fast_text).note(peer)

    def note_login(self, interface: str, peer: str, count: int = 1) -> None:
        """Count failed logins of a peer, and report them."""
        self.logins[interface] += count
        # The key is not the name alone: an interface can have the name TOO_FAST.
        self._report(f"{interface} logins", lambda counts: failed_text(interface, counts)).note(peer, count)

    def begin(self, interface: str, kind: str) -> None:
        """Count a kind of refusals of an interface from 0 on, if it is not counted yet."""
        interface = self._counted_as(interface)
        if kind == "logins":
            self.logins[interface] += 0
        else:
            self.at_interfaces[interface, kind] += 0

    def note(self, interface: str, kind: str, peer: str, count: int = 1) -> None:
        """Count what an interface refused to a peer, and report it."""
        interface = self._counted_as(interface)
        if kind == "logins":
            self.note_login(interface, peer, count)
            return
        self.at_interfaces[interface, kind] += count
        self._report(f"{interface} {kind}", lambda counts: _at_interface_text(interface, kind, counts)).note(
            peer, count
        )

    def total(self, kind: str) -> int:
        """Return how many connections or requests were refused, at the service and at all interfaces."""
        at_interfaces = sum(count for (_, other), count in self.at_interfaces.items() if other == kind)
        return at_interfaces + (self.connections.total() if kind == "connections" else 0)

    def _counted_as(self, interface: str) -> str:
        known = {*self.logins, *(name for name, _ in self.at_interfaces)}
        return interface if interface in known or len(known) < MOST_INTERFACES else OTHERS

    def _report(self, kind: str, text: Callable[[Counter[str]], str]) -> LimitedReport:
        return self._reports.setdefault(kind, LimitedReport(self._deliver, text))

    def _deliver(self, text: str) -> None:
        for report in self.on_report:
            report(text)


def _refused_text(counts: Counter[str]) -> str:
    many = counts.total()
    roles = ", ".join(f"{count} of role {role}" for role, count in counts.most_common())
    return (
        f"{many} connection{'s were' if many > 1 else ' was'} refused, because no place was free: {roles}. "
        "`busmaster status` shows how many programs use the line"
    )


def _too_fast_text(counts: Counter[str]) -> str:
    many = counts.total()
    return (
        f"{many} connection{'s were' if many > 1 else ' was'} refused, because the program connects again and again: "
        f"{_peers_text(counts)}"
    )


def _at_interface_text(interface: str, kind: str, counts: Counter[str]) -> str:
    many = counts.total()
    refused = f"{kind} were" if many > 1 else f"{kind.removesuffix('s')} was"
    return f"{many} {refused} refused at {interface}: {_peers_text(counts)}"


def is_interface_name(name: str) -> bool:
    """Return whether an interface in another process can have this name."""
    return name != SERVICE and INTERFACE_NAME.fullmatch(name) is not None


def _peers_text(counts: Counter[str]) -> str:
    first = counts.most_common(NAMED)
    peers = ", ".join(f"{count} from {peer}" for peer, count in first)
    return peers + (f" and {len(counts) - len(first)} more" if len(counts) > len(first) else "")


def failed_text(interface: str, counts: Counter[str]) -> str:
    """Return the report of failed logins, whose counts are by peer."""
    many = counts.total()
    return f"{many} failed login{'s' * (many > 1)} at {interface}: {_peers_text(counts)}"


@dataclass(slots=True)
class _Peer:
    """The history of one peer. `until` is the time from which its next login is checked."""

    failures: int = 0
    last: float = -inf
    until: float = -inf
    good: dict[str, None] = field(default_factory=dict)
    """Names with which it has logged in: a guesser at the same address, or behind the same proxy, does not lock these
    out."""


class Logins:
    """Checks logins by token or password, and slows down a peer that guesses.

    After FREE_LOGINS failures a peer must wait after each further one: SHORTEST_LOGIN_PAUSE at first, then twice as
    long each time, up to LONGEST_LOGIN_PAUSE. An earlier login is refused, even with the right token, unless the peer
    has logged in with that name before. Other peers never wait. `failed` is called with the peer of each failed login.
    """

    def __init__(self, failed: Callable[[str], None], now: Callable[[], float]) -> None:
        self._failed = failed
        self._now = now
        self._peers: OrderedDict[str, _Peer] = OrderedDict()
        """The one that logged in, or failed to, longest ago first."""

    def judge(self, host: str, name: str | None) -> float | None:
        """Check a login of the peer at `host` as `name`, None if its token or password is wrong.

        Return None if it succeeds, else the seconds after which this peer can try again.
        """
        key, now = peer_of(host), self._now()
        peer = self._peers.pop(key, None) or _Peer()
        if now - peer.last > LOGINS_FORGOTTEN:
            peer.failures = 0
        self._peers[key] = peer
        if len(self._peers) > MOST_LOGIN_PEERS:
            self._peers.popitem(last=False)
        if name is not None and (now >= peer.until or name in peer.good):
            peer.good.setdefault(name)
            if len(peer.good) > MOST_GOOD:
                del peer.good[next(iter(peer.good))]
            return None
        self._failed(key)
        if now >= peer.until:
            peer.failures, peer.last = peer.failures + 1, now
            peer.until = now + pause_after(peer.failures)
        return peer.until - now


def pause_after(failures: int) -> float:
    """Return for how many seconds a peer waits after its last failure."""
    beyond = failures - FREE_LOGINS
    return 0.0 if beyond <= 0 else min(LONGEST_LOGIN_PAUSE, SHORTEST_LOGIN_PAUSE * 2.0 ** min(beyond - 1, 32))


def peer_of(host: str) -> str:
    """Return the key of a peer: its address; of IPv6 the network of 64 bits, which can be one machine's."""
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return host
    if isinstance(address, ipaddress.IPv4Address):
        return str(address)
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return str(address) if address.is_loopback else str(ipaddress.ip_network((address, 64), strict=False))


def wait_text(seconds: float) -> str:
    """Return the text for a peer whose login is not checked."""
    return f"too many failed logins from this address; try again in {max(1, round(seconds))} s"

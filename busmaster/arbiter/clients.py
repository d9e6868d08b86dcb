"""The programs that share a line, and exclusive sequences of their requests."""

from __future__ import annotations

from collections.abc import Hashable
from math import inf

from busmaster.arbiter.health import NodeRecord

LEAST_SHARE, MOST_SHARE = 0.1, 10.0


class Account:
    """Line time that a user has used, over all its connections (`clients`).

    `used_until`: until then the user has used its part and the owner goes first.
    """

    __slots__ = ("clients", "used_until")

    def __init__(self) -> None:
        self.clients = 0
        self.used_until = -inf


class LineClient:
    """One program that uses the line. `share`: weight of its line time; others have 1.

    `owner_time`: seconds of line time that the owner may use, while it has requests, per second of all clients with the
    same number together. 0: the client takes turns with the owner. `user`: clients with the same user share one part of
    the line; None: a part of its own.
    """

    __slots__ = ("account", "over", "owner_time", "role", "share", "user")

    def __init__(self, share: float = 1.0, owner_time: float = 0.0, user: Hashable = None) -> None:
        self.share = share
        self.owner_time = owner_time
        self.user = user
        self.account = Account()
        # Its own account until a client is admitted with an `owner_time`: then all of that role share one.
        self.role = self.account
        """Common account of all clients with its `owner_time`."""
        self.over = False
        """True if none of its requests is sent any more."""

    def is_entitled(self, now: float, urgent: bool) -> bool:
        """Return True if it may go before the owner: neither it nor (unless `urgent`) its role has used up its part."""
        # Without the check of the role, each of many users would have one exchange directly after the other.
        return self.account.used_until <= now and (urgent or self.role.used_until <= now)

    @property
    def turn(self) -> LineClient:
        """The client whose turn its requests use, and that is charged for them."""
        return self


class Hold(LineClient):
    """An exclusive sequence of requests of one client to one node. From its first request on, only URGENT goes between.

    It begins when its first request is sent, in its client's turn. It ends when it is released, after `longest` seconds
    at most, with the exchange that is then on the wire. Changed only by the line.
    """

    __slots__ = ("began", "client", "holds", "longest", "node", "priority")

    priority: int
    """Class of the request with which it began."""
    began: float
    """When it began to hold the line, in seconds, if its client has an `owner_time`."""

    def __init__(self, node: NodeRecord, client: LineClient, longest: float) -> None:
        super().__init__(client.share)
        self.node = node
        self.client = client
        self.longest = longest
        self.began = -inf
        self.holds = False
        """True while the line is held for it."""

    @property
    def turn(self) -> LineClient:
        """Itself while it holds the line; before that, its client."""
        return self if self.holds else self.client


OWN = LineClient()
"""The program that owns the line. Requests without a client, polls and probes belong to it."""


def turn_of(client: LineClient | None) -> LineClient:
    """Return the client whose turn a request uses; None is the program that owns the line."""
    return OWN if client is None else client.turn

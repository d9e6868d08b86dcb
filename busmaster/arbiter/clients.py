"""Who asks: the programs that share a line, and sequences of their requests that nobody comes between."""

from __future__ import annotations

from collections.abc import Hashable
from math import inf

from busmaster.arbiter.health import NodeRecord

LEAST_SHARE, MOST_SHARE = 0.1, 10.0


class Account:
    """What a user has used of its part of the line, with all its connections: `clients` is how many it has.

    `used_until`: until when it has used that part; until then the owner goes first.
    """

    __slots__ = ("clients", "used_until")

    def __init__(self) -> None:
        self.clients = 0
        self.used_until = -inf


class LineClient:
    """One program, as the line knows it. `share` weighs its line time against that of the others, who have 1 each.

    `owner_time`: seconds of the line that the owner may use, while it waits, for each second of all clients with the
    same number together. 0: the client takes turns with the owner. `user`: clients with the same one have one part of
    the line together; None: the client has a part of its own.
    """

    __slots__ = ("account", "over", "owner_time", "role", "share", "user")

    def __init__(self, share: float = 1.0, owner_time: float = 0.0, user: Hashable = None) -> None:
        self.share = share
        self.owner_time = owner_time
        self.user = user
        self.account = Account()
        # Its own account until a client is admitted with an `owner_time`: then all of that role share one.
        self.role = self.account
        """The account of all clients with its `owner_time`."""
        self.over = False
        """Whether nothing of it is sent any more."""

    def is_entitled(self, now: float, urgent: bool) -> bool:
        """Return whether it may go before the owner, if that is its turn: it has not used up its part of the line, nor
        have the others of its role used up theirs, unless its request is `urgent`."""
        # Without the second, each of many users would have an exchange as it comes, one behind the other.
        return self.account.used_until <= now and (urgent or self.role.used_until <= now)

    @property
    def turn(self) -> LineClient:
        """Whose turn its requests take, and who pays for them."""
        return self


class Hold(LineClient):
    """A sequence of requests of one client to one node: from the first that is sent, nothing but URGENT goes between.

    It begins when that one leaves, in the turn of its client, and lasts until it is released, `longest` seconds at
    most, to the end of the exchange that is on the wire then. The line alone changes it.
    """

    __slots__ = ("began", "client", "holds", "longest", "node", "priority")

    priority: int
    """The class in which it has begun."""
    began: float
    """When it began to hold the line, in seconds, if its client has an `owner_time`."""

    def __init__(self, node: NodeRecord, client: LineClient, longest: float) -> None:
        super().__init__(client.share)
        self.node = node
        self.client = client
        self.longest = longest
        self.began = -inf
        self.holds = False
        """Whether the line is held for it."""

    @property
    def turn(self) -> LineClient:
        """Itself, while it holds the line; before, it waits among its client's requests."""
        return self if self.holds else self.client


OWN = LineClient()
"""The program that owns the line: what is asked for nobody in particular, polls and probes are its requests."""


def turn_of(client: LineClient | None) -> LineClient:
    """Return whose turn a request of this client takes; None is the program that owns the line."""
    return OWN if client is None else client.turn

"""Who asks: the programs that share a line, and sequences of their requests that nobody comes between."""

from __future__ import annotations

from busmaster.arbiter.health import NodeRecord

LEAST_SHARE, MOST_SHARE = 0.1, 10.0


class LineClient:
    """One program, as the line knows it. `share` weighs its line time against that of the others, who have 1 each."""

    __slots__ = ("over", "share")

    def __init__(self, share: float = 1.0) -> None:
        self.share = share
        self.over = False
        """Whether nothing of it is sent any more."""

    @property
    def turn(self) -> LineClient:
        """Whose turn its requests take, and who pays for them."""
        return self


class Hold(LineClient):
    """A sequence of requests of one client to one node: from the first that is sent, nothing but URGENT goes between.

    It begins when that one leaves, in the turn of its client, and lasts until it is released, `longest` seconds at
    most, to the end of the exchange that is on the wire then. The line alone changes it.
    """

    __slots__ = ("client", "holds", "longest", "node", "priority")

    priority: int
    """The class in which it has begun."""

    def __init__(self, node: NodeRecord, client: LineClient, longest: float) -> None:
        super().__init__(client.share)
        self.node = node
        self.client = client
        self.longest = longest
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

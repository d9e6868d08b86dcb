"""The run of answers that are alike, and when one too many would have shown in it (R15).

Where everything that is asked is answered alike, one doubled reply leaves every later answer one exchange behind: it is
taken for the answer to the next request, whose own is taken for that of the one after it, and so on, with nothing owed
and no unasked byte to be seen. A read whose answer is unlike shows it, and costs an exchange; a pause shows it.

Times show it too, on a port whose bytes leave at the baud rate. In step, a node has heard its request when it begins to
think of the answer. One exchange behind, what comes is the answer to the request before, and that node was free to
think of it no later than when the answer before was taken: at which moment this request began to leave. So what comes
is sooner than it would be in step, by the time that the request needs on the wire. Nodes with delays of their own show
each other's; over a run that cancels out, and the answers are sooner by that time on average.

So an answer is *untimely* if it differs from its node's usual one by more than half of that time. A run in which one
was is checked as if there were no times: one that came sooner may have been the one before's; one that came later says
that the usual times are not what they were, or that the process or a driver stood still, which hides how soon an answer
was. It hides that of one answer, not of those behind it: nothing is concluded from how long an answer took, and none
vouches for another. A run of timely answers alone is checked too, in the end: a device that waits for a silent line,
and only then begins to think, answers no sooner one exchange behind.
"""

from __future__ import annotations

from typing import Any

from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.on_wire import OnWire
from busmaster.contract.exchange import Exchange

LONGEST_ALIKE = 31
"""Answers alike behind a first one, some of them untimely, after which an unlike one is asked: 32 in all."""
LONGEST_STEADY = 127
"""As many where all of them were timely."""
USUAL_SHARE = 1 / 8
"""How much of a node's usual time the last answer is."""


class Alike:
    """Of one line. `node` is the one that was asked last."""

    __slots__ = ("_untimely", "_wire", "count", "node")

    def __init__(self, wire: OnWire) -> None:
        self._wire = wire
        self._untimely = False
        self.count = 0
        """Exchanges in a row, before the last, whose answers are like its."""
        self.node: NodeRecord | None = None

    def another(self, exchange: Exchange[Any], last_byte: float, now: float) -> bool:
        """Count one more exchange, and return whether one that is unlike is to go first.

        `last_byte` is when the last byte of the last answer came, in seconds.
        """
        leg = self._wire.leg
        # in a pause that is longer than its reply can be awaited an answer too many would have come
        if now - last_byte - leg.latency > exchange.timing.awaited:
            self.count = 0
            return False
        self.count += 1
        if not leg.paced:  # where bytes leave when they like, times show nothing
            return self.count >= LONGEST_ALIKE
        untimely = self._was_untimely(last_byte - leg.end, len(exchange.request) * leg.byte_time)
        if self.count == 1:  # the one before it was unlike: whatever its time, it was its own
            self._untimely = False
        elif untimely:
            self._untimely = True
        return self.count >= (LONGEST_ALIKE if self._untimely else LONGEST_STEADY)

    def _was_untimely(self, took: float, asking: float) -> bool:
        """Return whether times fail to show that the last answer was its own request's. It came `took` seconds after
        that request, which needed `asking` seconds on the wire."""
        node = self.node
        if node is None or took < 0:  # below 0: there was none
            return True
        usual = node.usual
        if usual is None:
            node.usual = took
            return True
        node.usual = usual + USUAL_SHARE * (took - usual)
        return abs(took - usual) > asking / 2

"""Values that show their origin: each encodes its node, its element and how often that element was written.

A campaign that reads such a value knows its origin, so that it recognises a wrong value regardless of the cause. It
writes such values too: a device counts the writes that it accepted, and those that were meant for another device.
"""

from __future__ import annotations

from collections import defaultdict

SPREAD = 10_007
"""A prime, so that values still lie far apart when they wrap in a narrow range. Counts up to it stay exact."""


def traceable_value(node: int, element: int, writes: int, modulus: int = 10**12) -> int:
    """Return a value, 0 to modulus - 1, from the node, the element and the number of its writes.

    `modulus`: number of values that the protocol can transfer: 10**12 for HCP and HCP2 (exact as text), 2**31 for MSC,
    10**4 for Mentor II, 2**16 for DC104.
    """
    return (((node << 16) + element) * SPREAD + writes) % modulus


class TraceableMemory:
    """The memory of one device in a campaign: in place of values it keeps the number of writes to each element."""

    def __init__(self, node: int, modulus: int = 10**12) -> None:
        self.node = node
        self.modulus = modulus
        self.writes: defaultdict[int, int] = defaultdict(int)
        self.foreign_writes = 0
        """Accepted writes whose value was meant for another node or element, or was corrupted without detection."""

    def read(self, element: int) -> int:
        """Return the value of an element after the writes to it so far."""
        return traceable_value(self.node, element, self.writes[element], self.modulus)

    def elsewhere(self) -> int:
        """Return a value of another node, for a reply with a wrong origin."""
        return traceable_value(self.node + 1, 0, 0, self.modulus)

    def write(self, element: int, value: float, slack: int = 64) -> None:
        """Count a write. The writer is to send `traceable_value(node, element, n)`, n within `slack` of the count."""
        count = self.writes[element]
        self.writes[element] = count + 1
        base = traceable_value(self.node, element, 0, self.modulus)
        sent = (round(value) - base) % self.modulus
        if abs(sent - count) > slack:
            self.foreign_writes += 1


__all__ = [
    "SPREAD",
    "TraceableMemory",
    "traceable_value",
]

"""Local echo: what was sent comes back before anything else does."""

from __future__ import annotations


class Echo:
    """Takes the echo of what was sent off the front of what comes, byte for byte, across exchanges.

    MSC's closing ACK echoes into the next exchange, so what is owed outlives an exchange.
    """

    __slots__ = ("astray", "declared", "owed")

    def __init__(self, declared: bool) -> None:
        self.declared = declared
        self.owed = b""
        self.astray = False
        """An echo did not come whole, nor did one after it: what comes may be our own words, which can look like
        somebody's reply."""

    def sent(self, data: bytes) -> None:
        """Expect what was sent to come back, if the line is `declared` to echo."""
        if self.declared:
            self.owed += data

    def strip(self, data: bytes) -> bytes | None:
        """Return what came after the echo; None where the echo differs from what was sent: a collision."""
        owed = self.owed
        length = min(len(owed), len(data))
        if data[:length] != owed[:length]:
            # Nothing after this can be told from echo: who else was talking changed, ate or added bytes. Looking for
            # where the echo goes on would be searching, and might find it in somebody's reply.
            self.forget()
            return None
        self.owed = owed[length:]
        if not self.owed:  # echoes come in order: nothing is to come of those before
            self.astray = False
        return data[length:]

    def forget(self) -> None:
        """Expect no more echo: the line settles, and what is still owed would be discarded anyway."""
        if self.owed:
            self.owed = b""
            self.astray = True

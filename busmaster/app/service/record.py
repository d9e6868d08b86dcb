"""The audit entry of a write: its source and its outcome."""

from __future__ import annotations

import getpass
import os
from enum import Enum
from typing import Any, NamedTuple

LONGEST_SHOWN = 200
"""Maximum number of characters of each part of an audit entry, such as a value or an error."""

RAW_COMMAND = "raw command"
"""Name of a write in the audit log if no point matches. The value describes the write."""


class Outcome(Enum):
    """The outcome of a write."""

    WRITTEN = "written"
    """The node confirmed it."""
    REFUSED = "refused"
    """Nothing was sent, or the node refused it."""
    NOT_STARTED = "not started"
    """Nothing was sent: it was too old, or the line could not take it."""
    UNCONFIRMED = "unconfirmed"
    """It was sent, and the result is unknown."""


class WriteRecord(NamedTuple):
    """One write. `time` is in seconds since 1970 and `took` in seconds; `before` is None if it was unknown.

    `interface` is the way of the request ("mqtt", "screen"), `by` its sender: an MQTT topic, a key. `user` and
    `process` are those of the program that writes. `id` is the command's own, "" if it has none.
    """

    time: float
    interface: str
    by: str
    user: str
    process: int
    point: str
    before: Any
    value: Any
    outcome: Outcome
    error: str
    took: float
    id: str

    @property
    def ok(self) -> bool:
        return self.outcome is Outcome.WRITTEN

    @property
    def text(self) -> str:
        """The entry in one line, for a log."""
        before = "" if self.before is None else f" (before: {self.before!r})"
        what = f"{self.point} = {self.value!r}{before} {self.outcome.value}"
        why = f": {self.error}" if self.error else ""
        mark = f" [{self.id}]" if self.id else ""
        return f"{what} in {self.took:.3f} s by {self.interface} {self.by}{mark}, {self.user} {self.process}{why}"


def cut(text: str) -> str:
    """Return a text for an audit entry: of a long one only the beginning, and its length."""
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}... ({len(text)} characters)"


def this_user() -> str:
    """Return the name of the user that this process runs as; the number of one without a name."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())

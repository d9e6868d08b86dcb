"""What passes on a line that another program owns."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any


class RemoteExchanges:
    """The exchanges of a line: they are told until `close`, or until the connection ends."""

    def __init__(self, hear: Callable[[Mapping[str, Any]], None], end: Callable[[], None]) -> None:
        self._hear = hear
        self._end = end

    def hear(self, method: str, params: Mapping[str, Any]) -> None:
        """Take what the line's owner says."""
        if method == "exchanges":
            self._hear(params["body"])

    def end(self) -> None:
        """Note that no more will come, of which its reader is told by what ends the connection."""

    def close(self) -> None:
        """Be told nothing more."""
        self._end()

"""What passes on a line that another program owns."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from busmaster.app.service.owner_messages import StreamMessage
from busmaster.app.service.typed import to_builtins


class RemoteExchanges:
    """The exchanges of a line, received until `close`, or until the connection ends."""

    def __init__(self, receive: Callable[[Mapping[str, Any]], None], end: Callable[[], None]) -> None:
        self._receive = receive
        self._end = end

    def receive(self, method: str, message: StreamMessage[Any]) -> None:
        """Handle a message of the line's owner."""
        if method == "exchanges":
            self._receive(to_builtins(message.body))

    def end(self) -> None:
        """Do nothing: the end of the connection is reported elsewhere."""

    def close(self) -> None:
        """End the stream."""
        self._end()

"""Connections of the service that leave every WebSocket frame to the library, to compare them with those that do not.

`busmaster.app.service.connection` reads and writes whole text frames itself. Each of these connections must talk to
another of its kind or to one of the service.
"""

from __future__ import annotations

from busmaster.app.service.connection import Connection, IncomingConnection, OutgoingConnection


class _LibraryConnection(Connection):
    def send(self, message: bytes) -> None:
        if self._talks and not self.transport.is_closing():
            self._core.send_text(message)
            self._write()

    def buffer_updated(self, count: int) -> None:
        self._silent = False
        self._feed(bytes(self._buffer[:count]))

    def _check_frame(self) -> None:
        """Permit any number of frames: here, each message is one."""


class LibraryIncomingConnection(_LibraryConnection, IncomingConnection):
    """The server's end."""


class LibraryOutgoingConnection(_LibraryConnection, OutgoingConnection):
    """The client's end."""

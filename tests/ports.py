"""TCP ports on which nobody listens yet, nor anybody else will."""

from __future__ import annotations

import socket

_reserved: list[socket.socket] = []


def free_port() -> int:
    """A port for this process and those that it starts to listen on, with SO_REUSEADDR, or for nobody to listen on.

    It stays bound, without listening, so that the system gives it to nobody else in between.
    """
    bound = socket.socket()
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    bound.bind(("127.0.0.1", 0))
    _reserved.append(bound)
    port: int = bound.getsockname()[1]
    return port

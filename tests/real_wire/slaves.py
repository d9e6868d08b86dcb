"""The slaves, in a process of their own: `python -m tests.real_wire.slaves PROTOCOL pty|tcp`.

Prints the port's path, then a line for each value that a device says and each write that it takes, with the time.
A line of input, `hold` or `release`, has a pseudo-terminal keep what its client sends, as XOFF would. Ends with its
input.
"""

from __future__ import annotations

import sys
import termios
import time

from busmaster.emulator.serve import PtyServer, serve_pty, serve_tcp
from tests.real_wire.kinds import make_line


def tell(what: str, node: int, element: int, value: int) -> None:
    """In one write: other threads tell too."""
    sys.stdout.write(f"{what} {node} {element} {value} {time.monotonic():.6f}\n")
    sys.stdout.flush()


def main(protocol: str, port: str) -> None:
    with (serve_pty if port == "pty" else serve_tcp)(make_line(protocol, tell)) as server:
        sys.stdout.write(f"{server.path}\n")
        sys.stdout.flush()
        for order in sys.stdin:
            assert isinstance(server, PtyServer)
            termios.tcflow(server._slave, termios.TCOOFF if order == "hold\n" else termios.TCOON)


if __name__ == "__main__":
    main(*sys.argv[1:])

"""A network that stands still when told to, in a process of its own: `python -m tests.real_wire.proxy HOST PORT`.

Prints its own path. Passes one client's bytes on, both ways, in order. A line of input, `requests`, `replies`, `both`
or `neither`, says what stands still from then on. Ends with its input.
"""

from __future__ import annotations

import select
import socket
import sys

from tests.patience import PATIENCE

CHUNK = 4096


def main(host: str, port: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        sys.stdout.write("socket://{}:{}\n".format(*listener.getsockname()[:2]))
        sys.stdout.flush()
        listener.settimeout(PATIENCE)
        client, _ = listener.accept()
    client.setblocking(True)
    server = socket.create_connection((host, int(port)))
    for end in (client, server):
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    ways = {client: server, server: client}
    still: tuple[socket.socket, ...] = ()
    while True:
        sources = [sys.stdin, *(source for source in ways if source not in still)]
        for source in select.select(sources, (), ())[0]:
            if isinstance(source, socket.socket):
                data = source.recv(CHUNK)
                if not data:
                    return
                ways[source].sendall(data)
                continue
            order = sys.stdin.readline()
            if not order:
                return
            still = {"requests": (client,), "replies": (server,), "both": (client, server)}.get(order.strip(), ())


if __name__ == "__main__":
    main(*sys.argv[1:])

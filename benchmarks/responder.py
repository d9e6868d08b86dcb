"""The other end of the line, as light as it can be: answers known requests from a table, on time.

Runs as a process of its own (`python -m benchmarks.responder`), so that what it costs is not counted as the
master's. Imports nothing of the package. It is told what to do in one line of JSON on standard input; for each
further line there it reports, in one line of JSON, how long each of its lines lay dead between a reply and the next
request. It ends when its standard input does.

A paced line takes `tau` seconds a byte: each part of a reply reaches the master when its last byte would have left
the wire. The clock is the kernel's high-resolution timer (a select() with the process's timer slack taken away), and
for the last `spin` seconds the clock itself: not milliseconds.
"""

from __future__ import annotations

import array
import ctypes
import heapq
import json
import os
import select
import socket
import sys
import time
from typing import Any

PR_SET_TIMERSLACK = 29
LONGEST_REQUEST = 300


class Wire:
    """One line: what it has heard, until when it is busy, and how long it lay dead before each request."""

    __slots__ = ("_listening", "buffer", "busy_until", "dead", "delay", "fd", "requests", "sent_at", "swallow", "tau")

    def __init__(self, fd: int, tau: float, delay: float, swallow: bytes, listening: bool) -> None:
        self.fd = fd
        self.tau = tau
        self.delay = delay
        self.swallow = swallow
        self.buffer = b""
        self.busy_until = 0.0
        self.sent_at = 0.0
        self.requests = 0
        self.dead = array.array("d")
        self._listening: socket.socket | None = socket.socket(fileno=fd) if listening else None

    def accept(self) -> int | None:
        """The descriptor of the connection, if `fd` is a listening socket; None once it is connected."""
        if self._listening is None:
            return None
        connection, _ = self._listening.accept()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._listening.detach()
        self._listening = None
        self.fd = connection.detach()
        return self.fd


class Responder:
    def __init__(self, order: dict[str, Any]) -> None:
        self._table = {
            bytes.fromhex(ask): tuple(bytes.fromhex(part) for part in say) for ask, say in order["table"].items()
        }
        swallow = bytes.fromhex(order.get("swallow", ""))
        self._epoll = select.epoll()
        self._wires: list[Wire] = []
        self._by_fd: dict[int, Wire] = {}
        self._due: list[tuple[float, int, Wire, bytes]] = []
        self._order = 0
        self._open = True
        self._spin: float = order["spin"]
        for line in order["lines"]:
            wire = Wire(line["fd"], line["tau"], line["delay"], swallow, line["listen"])
            self._wires.append(wire)
            self._watch(wire)
        self._epoll.register(0, select.EPOLLIN)

    def run(self) -> None:
        self._report()
        due, spin, clock = self._due, self._spin, time.monotonic
        while self._open:
            if not due:
                self._look(-1)
                continue
            left = due[0][0] - clock()
            if left > spin:
                select.select([self._epoll], [], [], left - spin)
            self._look(0)
            while due and due[0][0] <= clock():
                _, _, wire, reply = heapq.heappop(due)
                os.write(wire.fd, reply)
                wire.sent_at = clock()

    def _watch(self, wire: Wire) -> None:
        self._by_fd[wire.fd] = wire
        self._epoll.register(wire.fd, select.EPOLLIN)

    def _look(self, timeout: float) -> None:
        for fd, event in self._epoll.poll(timeout):
            if fd == 0:
                self._obey()
                continue
            wire = self._by_fd[fd]
            if wire.accept() is not None:
                self._epoll.unregister(fd)
                self._watch(wire)
            elif event & select.EPOLLIN:
                self._hear(wire)
            else:
                self._epoll.unregister(fd)

    def _hear(self, wire: Wire) -> None:
        heard = os.read(wire.fd, 4096)
        now = time.monotonic()
        if not heard:
            self._epoll.unregister(wire.fd)
            return
        buffer = wire.buffer + heard
        if wire.swallow and buffer.startswith(wire.swallow):
            buffer = buffer[len(wire.swallow) :]
            wire.busy_until = now + len(wire.swallow) * wire.tau
        reply = self._table.get(buffer)
        if reply is None:
            wire.buffer = buffer if len(buffer) < LONGEST_REQUEST else b""
            return
        wire.buffer = b""
        wire.requests += 1
        if wire.sent_at:
            wire.dead.append(now - wire.sent_at)
        if not wire.tau and not wire.delay:
            os.write(wire.fd, b"".join(reply))
            wire.sent_at = time.monotonic()
            return
        at = max(now, wire.busy_until) + len(buffer) * wire.tau + wire.delay
        for part in reply:
            at += len(part) * wire.tau
            self._order += 1
            heapq.heappush(self._due, (at, self._order, wire, part))
        wire.busy_until = at

    def _obey(self) -> None:
        word = os.read(0, 4096)
        if not word:
            self._open = False
        else:
            self._report()

    def _report(self) -> None:
        report = [{"requests": wire.requests, "dead": list(wire.dead)} for wire in self._wires]
        for wire in self._wires:
            wire.dead = array.array("d")
            wire.sent_at = 0.0
        sys.stdout.write(json.dumps(report) + "\n")
        sys.stdout.flush()


def main() -> None:
    try:
        ctypes.CDLL(None).prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0)
    except (OSError, AttributeError):
        pass  # not Linux: replies are some 50 us later
    order = bytearray()
    while not order.endswith(b"\n"):
        order += os.read(0, 1 << 16)
    Responder(json.loads(order)).run()


if __name__ == "__main__":
    main()

"""A loop that is blocked by other work must not take what lies unread for silence (R3)."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import threading
import time
import tty
from collections.abc import Callable, Coroutine
from typing import Any

import pytest
import uvloop

from busmaster import Bus, BusError, Hcp2Controller, LineState, NoReply, SerialPort
from busmaster.wire.checks import xor
from tests.patience import PATIENCE
from tests.transport.test_marks import readable

Runner = Callable[[Coroutine[Any, Any, bool]], bool]


def reply(value: int) -> bytes:
    body = f"01{value}".encode() + b"\x03"
    return b"\x02" + body + bytes([xor(body)])


class Withholding:
    """A node on the far end of a pty: it answers each request with its number, one of them not before it is told."""

    def __init__(self) -> None:
        self.fd, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self.withholds = threading.Event()
        """The next reply is kept back."""
        self.withheld: int | None = None
        self.may_answer = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        with contextlib.suppress(OSError):
            for number in itertools.count(100):
                os.read(self.fd, 100)
                if self.withholds.is_set() and self.withheld is None:
                    self.withheld = number
                    self.may_answer.wait()
                os.write(self.fd, reply(number))

    def close(self) -> None:
        self.may_answer.set()
        os.close(self._slave)
        self._thread.join(PATIENCE)
        os.close(self.fd)


class Order:
    """A tap that notes in which order the bus speaks and hears."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    def transmitted(self, *_: object) -> None:
        self.notes.append("spoke")

    def received(self, *_: object) -> None:
        self.notes.append("heard")

    def attempted(self, *_: object) -> None: ...


def run_on_uvloop(main: Coroutine[Any, Any, bool]) -> bool:
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        return runner.run(main)


@pytest.mark.parametrize("run", [asyncio.run, run_on_uvloop], ids=["asyncio", "uvloop"])
@pytest.mark.parametrize("waited", [0.0, 0.11], ids=["in its window", "after its window"])
def test_r3_a_late_reply_that_lies_unread_is_never_taken_for_the_next_one(run: Runner, waited: float) -> None:
    """The blocking work is due just before the bus's timer, so that the timer runs late, before anything is read."""

    async def main(node: Withholding) -> bool:
        """Whether the reply came while it was awaited, which it does not if the machine stood still before the work."""
        came, order = False, Order()

        def block() -> None:
            nonlocal came
            came = bus.state is LineState.EXCHANGE
            time.sleep(0.005)  # the timer is due first
            node.may_answer.set()
            readable(bus._pump._transport._fd)  # type: ignore[union-attr]  # it is open, and a PortTransport
            time.sleep(0.3)  # beyond window and maximum reply delay
            order.notes.clear()

        async with Bus(SerialPort(node.path, baudrate=57600), tap=order) as bus:
            axis = Hcp2Controller(bus, 1)
            await axis.read(1)
            node.withholds.set()
            first = asyncio.ensure_future(axis.read(1, retries=0))
            second = asyncio.ensure_future(axis.read(1, retries=0))
            while node.withheld is None:  # noqa: ASYNC110  # a thread
                await asyncio.sleep(0.001)
            await asyncio.sleep(waited)
            expiring = asyncio.ensure_future(axis.read(1, retries=0, start_within=0.005))
            await asyncio.sleep(0)
            asyncio.get_running_loop().call_at(bus._pump._armed - 0.0001, block)
            outcome, value, _ = await asyncio.gather(first, second, expiring, return_exceptions=True)
            if came:
                assert order.notes[0] == "heard"
                assert outcome == node.withheld or isinstance(outcome, NoReply)
                assert isinstance(value, BusError) or value != node.withheld
        return came

    came = False
    while not came:
        with contextlib.closing(Withholding()) as node:
            came = run(main(node))

"""A loop that is blocked by other work must not take what lies unread for silence (R3)."""

from __future__ import annotations

import asyncio
import os
import threading
import time
import tty
from collections.abc import Callable, Coroutine, Iterator
from typing import Any

import pytest
import uvloop

from busmaster import Bus, Hcp2Controller, LineState, NoReply, SerialPort
from busmaster.wire.checks import xor
from tests.patience import PATIENCE

Runner = Callable[[Coroutine[Any, Any, None]], None]


def reply(value: int) -> bytes:
    body = f"01{value}".encode() + b"\x03"
    return b"\x02" + body + bytes([xor(body)])


class LateThenPrompt:
    """A node on the far end of a pty: its second reply is late, beyond the window; the others come at once."""

    def __init__(self, delay: float) -> None:
        self.fd, slave = os.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        self.asked = threading.Event()
        self._slave = slave
        self._delay = delay
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            for value in (100, 111, 222, 333):
                os.read(self.fd, 100)
                if value == 111:
                    self.asked.set()
                time.sleep(self._delay if value == 111 else 0.002)
                os.write(self.fd, reply(value))
        except OSError:
            return

    def close(self) -> None:
        os.close(self._slave)
        os.close(self.fd)
        self._thread.join(PATIENCE)


@pytest.fixture
def node() -> Iterator[LateThenPrompt]:
    made = LateThenPrompt(0.120)
    yield made
    made.close()


def run_on_uvloop(main: Coroutine[Any, Any, None]) -> None:
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(main)


@pytest.mark.parametrize("run", [asyncio.run, run_on_uvloop], ids=["asyncio", "uvloop"])
@pytest.mark.parametrize("state", [LineState.EXCHANGE, LineState.SETTLING], ids=["in its window", "settling"])
def test_r3_a_late_reply_that_lies_unread_is_never_taken_for_the_next_one(
    node: LateThenPrompt, run: Runner, state: LineState
) -> None:
    """The blocking work is due just before the bus's timer, so that the timer runs late, before anything is read."""

    async def main() -> None:
        async with Bus(SerialPort(node.path, baudrate=57600)) as bus:
            axis = Hcp2Controller(bus, 1, retries=0)
            assert await axis.read(1) == 100
            first = asyncio.ensure_future(axis.read(1))
            second = asyncio.ensure_future(axis.read(1))
            while not node.asked.is_set() or bus.state is not state:  # noqa: ASYNC110  # a thread and the arbiter
                await asyncio.sleep(0.001)
            expiring = asyncio.ensure_future(axis.read(1, start_within=0.005))
            await asyncio.sleep(0)
            asyncio.get_running_loop().call_at(bus.pump._armed - 0.0001, time.sleep, 0.3)
            outcome = (await asyncio.gather(first, return_exceptions=True))[0]
            assert outcome == 111 or isinstance(outcome, NoReply)
            assert await second == 222
            await asyncio.gather(expiring, return_exceptions=True)

    run(main())

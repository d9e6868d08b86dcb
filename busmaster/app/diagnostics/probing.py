"""Sends requests to nodes and shows the raw bytes: a doctor needs the bytes that the arbiter discards.

It sends one request at a time, and no other master is on the port, so no arbiter is needed.
"""

from __future__ import annotations

import asyncio
import enum
from collections import Counter, deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from itertools import count
from typing import Any

import anyio

from busmaster import Endpoint, LineDown, LineSettings, Refused, Timings
from busmaster.app.service.values import value_text
from busmaster.ext import (
    QUIET,
    Attempt,
    Command,
    Driver,
    Echo,
    Exchange,
    FrameError,
    Mark,
    OpenPort,
    Profile,
    Tap,
    Verdict,
    cause_text,
    clock_of,
    is_paced,
    open_port,
)

BABBLE = 1.0
"""Seconds after which a line that does not fall silent is left alone."""
MUCH = 16384
"""Bytes after which it is as well: more than comes in that time at any usual rate."""


class Wire(asyncio.Protocol):
    """An open port: bytes go out, and come in with the time at which they came, in seconds of `clock`."""

    def __init__(self, endpoint: Endpoint, tap: Tap | None) -> None:
        self.clock = clock_of(asyncio.get_running_loop())
        self.latency = endpoint.receive_latency
        self.paced = False
        self.transport: asyncio.Transport | None = None
        self.port: OpenPort | None = None
        self.marked: Counter[Mark] = Counter()
        self.closed = anyio.Event()
        self.attempt: Attempt | None = None
        """The present attempt, for the tap."""
        self._tap = tap
        self._cause: Exception | None = None
        self._chunks: deque[tuple[float, bytes]] = deque()
        self._arrived = anyio.Event()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self.transport = transport
        self.port = open_port(transport)

    def byte_marked(self, byte: bytes, mark: Mark) -> None:
        """Keep damaged bytes too, because they are of interest in a search for faults."""
        self.marked[mark] += 1
        if byte:
            self.data_received(byte)

    def data_received(self, data: bytes) -> None:
        now = self.clock()
        if self._tap is not None:
            self._tap.received(now, data, self.attempt)
        self._chunks.append((now, data))
        self._arrived.set()

    def connection_lost(self, cause: Exception | None) -> None:
        self._cause = cause
        self.closed.set()
        self._arrived.set()

    def send(self, data: bytes) -> float:
        """Send `data`, and return when it was handed to the port. Raises LineDown if that is gone."""
        if self.transport is None or self.closed.is_set():
            raise self._loss()
        self.transport.write(data)
        now = self.clock()
        if self._tap is not None:
            self._tap.transmitted(now, data, self.attempt)
        return now

    @property
    def tunable(self) -> bool:
        """Return whether the port can be set to other rates: that of a serial server in raw TCP cannot, from here."""
        return hasattr(self.transport, "tune")

    async def tune(self, settings: LineSettings) -> None:
        """Set the open port to another rate and framing. Raises LineDown where it does not take them."""
        await self.transport.tune(settings)  # type: ignore[union-attr]  # of a tunable one, which is open

    def attempted(self, attempt: Attempt) -> None:
        """Report the end of this attempt to the tap."""
        self.attempt = None
        if self._tap is not None:
            self._tap.attempted(attempt)

    async def hear(self, until: float) -> tuple[float, bytes] | None:
        """Return the next bytes and their time; None if none came by `until`. Raises LineDown if the port is lost."""
        while not self._chunks:
            if self.closed.is_set():
                raise self._loss()
            left = until - self.clock()
            if left <= 0:
                return None
            self._arrived = anyio.Event()
            with anyio.move_on_after(left):
                await self._arrived.wait()
        return self._chunks.popleft()

    async def hear_all(self, within: float, quiet: float = QUIET) -> bytes:
        """Return the bytes that begin to arrive `within` so many seconds, up to a silence of `quiet` seconds.

        If there is no silence, it ends after BABBLE seconds or MUCH bytes.
        """
        heard = b""
        until = self.clock() + within
        end = until + BABBLE
        while len(heard) < MUCH and (chunk := await self.hear(min(until, end))) is not None:
            heard += chunk[1]
            until = chunk[0] + quiet
        return heard

    def _loss(self) -> LineDown:
        return LineDown(cause_text(self._cause, "it was closed by the other end"), hint="start again when it is back")


@asynccontextmanager
async def opened(endpoint: Endpoint, tap: Tap | None = None) -> AsyncIterator[Wire]:
    """Open the port until the end of the block. Raises LineDown."""
    wire = Wire(endpoint, tap)
    transport = await endpoint.open(lambda: wire)
    wire.paced = is_paced(endpoint, transport)
    try:
        yield wire
    finally:
        transport.close()
        with anyio.CancelScope(shield=True):
            await wire.closed.wait()


class Outcome(enum.Enum):
    """Result of a request. A refusal is a reply."""

    ANSWERED = "answered"
    SILENT = "silent"
    GARBLED = "garbled"


@dataclass(frozen=True, slots=True)
class Probe:
    """One request and its reply, without an echo.

    `start`: seconds from the request's end on the wire to the first byte, None if there was none. `text` is the command
    and its value, refusal or error. `raw` is all bytes, and `again` the bytes after the reply, which no node may send.
    `hint` is the advice of the reader, if it has any.
    """

    outcome: Outcome
    start: float | None = None
    text: str = ""
    raw: bytes = b""
    again: bytes = b""
    refused: bool = False
    hint: str | None = None


class Prober:
    """Sends a protocol's cheapest read. `byte_time` in seconds; `echo`: own transmissions are received too."""

    def __init__(self, wire: Wire, profile: Profile, timings: Timings, byte_time: float, echo: bool) -> None:
        self._wire = wire
        self._profile = profile
        self._timings = timings
        self.byte_time = byte_time
        self._echo = Echo(echo)
        self._numbers = count(1)

    async def ask(self, address: int, *, patience: float | None = None, alone: bool = False) -> Probe:
        """Send the probe to a node. `patience`: seconds to wait for the first byte, the maximum reply delay by
        default.

        Raises LineDown. `alone`: further bytes within the maximum reply delay belong to this node, and are not left for
        the next request.
        """
        profile, wire = self._profile, self._wire
        command = profile.probe
        hearing = _Hearing(command, command.open(address, self._timings))
        attempt = Attempt(
            profile.name, address, command, self._timings, transaction=next(self._numbers), purpose="probe"
        )
        self._echo.forget()
        wire.attempt = attempt
        hearing.asked = self._send(hearing.driver.exchange.request)
        wait = hearing.driver.timing.max_reply_delay if patience is None else patience
        until = hearing.asked + wait + wire.latency
        while (chunk := await wire.hear(until)) is not None:
            data = self._echo.strip(chunk[1])
            if data is None:
                hearing.collide(chunk[1])
            elif data:
                until = hearing.take(chunk[0], data, self._send) + wire.latency
            if hearing.driver.ending is not None:
                break
        attempt.end(*hearing.verdict(), wire.clock())
        wire.attempted(attempt)
        rest = b""
        if hearing.start is not None:
            rest = await wire.hear_all(wait if alone else max(QUIET, hearing.driver.timing.inter_byte_timeout))
        return hearing.probe(self._echo.strip(rest) or b"")

    def _send(self, data: bytes) -> float:
        """Send `data`, and return the time when it will have left: at once, if its duration is not known."""
        self._echo.sent(data)
        return self._wire.send(data) + (len(data) * self.byte_time if self._wire.paced else 0.0)


class _Hearing:
    """What an exchange makes of the bytes that come. `asked`: when its request had left."""

    def __init__(self, command: Command[Any], exchange: Exchange[Any]) -> None:
        self.driver = Driver(exchange)
        self.asked = 0.0
        self.start: float | None = None
        self._command = command
        self._raw = b""
        self._collided = False

    def take(self, now: float, data: bytes, send: Callable[[bytes], float]) -> float:
        """Take the next bytes, and return until when to wait for more."""
        driver = self.driver
        self._hear(now, data)
        driver.sent.clear()
        driver.feed(data)
        for part in driver.sent:
            now = send(part)
        # else the node would be left with something unacknowledged
        if driver.ending is not None and driver.ending.send:
            send(driver.ending.send)
        return now + (driver.timing.inter_byte_timeout if driver.begun else driver.timing.max_reply_delay)

    def collide(self, data: bytes) -> None:
        """Take it that this came in place of the echo."""
        self._hear(self.asked, data)
        self._collided = True
        self.driver.fail(FrameError("the echo differs from the sent bytes: a collision"))

    def verdict(self) -> tuple[Verdict, Any]:
        """Return how it ended, and the value or the error. Raises the exception of a bug in the protocol."""
        ending = self.driver.ending
        if ending is None:
            return (Verdict.NO_REPLY, "no reply") if self.start is None else (Verdict.GARBLED, "cut short")
        match ending.error:
            case None:
                return Verdict.OK, ending.value
            case Refused() as refusal:
                return Verdict.REFUSED, refusal.what
            case FrameError() as error:
                return (Verdict.SPOILT if self._collided else Verdict.GARBLED), error.what
            case bug:
                raise bug

    def probe(self, rest: bytes) -> Probe:
        """Return what came of the probe; `rest` came after all was over."""
        verdict, result = self.verdict()
        if self.start is None:
            return Probe(Outcome.SILENT)
        if verdict not in (Verdict.OK, Verdict.REFUSED):
            error = None if self.driver.ending is None else self.driver.ending.error
            hint = error.hint if isinstance(error, FrameError) else None
            return Probe(Outcome.GARBLED, self.start, result, self._raw + rest, hint=hint)
        # a refusal is a reply: a device without this item is as healthy as any
        text = value_text(result) if verdict is Verdict.OK else f"{result}; the device does not have this item"
        left_over = b"" if self.driver.ending is None else self.driver.ending.rest
        description = f"{self._command}: {text}"
        raw = self._raw + rest
        return Probe(Outcome.ANSWERED, self.start, description, raw, left_over + rest, verdict is Verdict.REFUSED)

    def _hear(self, now: float, data: bytes) -> None:
        if self.start is None:
            self.start = now - self.asked
        self._raw += data

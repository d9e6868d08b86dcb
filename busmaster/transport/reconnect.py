"""Keeps an endpoint connected (R13)."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Hashable
from typing import cast

from busmaster.errors import LineDown
from busmaster.transport.endpoints import Endpoint
from busmaster.transport.folder_watch import FolderWatch, watch_folders
from busmaster.transport.identity import Identity
from busmaster.transport.kernel import cause_text
from busmaster.transport.marks import taker_of_marked_bytes

FIRST_DELAY = 0.1
LONGEST_DELAY = 5.0
CLOSE_DEADLINE = 1.0
LOOK_EVERY = 0.2
"""Seconds between two checks whether the device is back, if folders are not watched."""
LOOK_ANYWAY = 1.0
"""Seconds between two checks if the folders are watched. In a container the kernel may describe a device whose node
existed all the time, and a folder of another machine's file system reports no changes."""
LOOK_PAUSE = 0.02
"""Minimum seconds between two checks, however many changes the folders report."""


class Connection:
    """Gives `protocol` one transport after another while `run` runs.

    The protocol gets `connection_made`, `data_received` and `connection_lost` like any asyncio protocol, the first and
    the last once per connection. `connection_lost(None)` means closed locally; else the cause is a LineDown. Between
    attempts it waits `first_delay` seconds, doubled up to `longest_delay` and varied by a quarter (`jitter` is the
    random source). The delay starts again after a connection that lasted longer than that. A device that returns is
    noticed immediately. Only the device of the first opening is reopened, even if another one has its name by then.

    Errors in the background never stop it: the attempt is repeated. `on_failed` gets the cause, once until it changes.
    A cause with a cause of its own is a bug.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        protocol: asyncio.Protocol,
        *,
        on_failed: Callable[[LineDown], None] | None = None,
        first_delay: float = FIRST_DELAY,
        longest_delay: float = LONGEST_DELAY,
        jitter: random.Random | None = None,
    ) -> None:
        self.endpoint = endpoint
        self._protocol = protocol
        self._on_failed = on_failed
        self._first_delay = first_delay
        self._longest_delay = longest_delay
        self._jitter = jitter or random.Random()
        self._link: _Link | None = None
        self._device: Identity | None = None
        self._seen: Hashable | None = None
        self._reported: dict[str, str] = {}
        self._closing = asyncio.Event()
        self._stirred = asyncio.Event()
        """Set if a device may have appeared: check now."""
        self._watch: FolderWatch | None = None

    async def open(self) -> None:
        """Open the endpoint once. Raises LineDown."""
        self._came_back()  # a device that is already present is not a return
        link = _Link(self.endpoint.name, self._protocol, self._closing)
        transport = await self.endpoint.open(lambda: link, self._device)
        # From this opening: the same device may have returned at another place, and is identified there from now on.
        # None behind a serial server: its address is its identity.
        self._device = transport.get_extra_info("identity")
        self._link = link
        self._reported.clear()  # it was open in the meantime: the same cause is reported again
        if self._closing.is_set():  # closed during the opening, when there was nothing to close
            await self.close()

    async def try_open(self) -> None:
        """Open the endpoint once, and report the cause if that fails: `run` tries again."""
        try:
            await self.open()
        except Exception as error:  # not only LineDown: another error would silently end the reconnecting
            self._report("open", error)

    def accept_device(self) -> None:
        """Accept any device that has the port's name at the next opening, which follows soon."""
        # `_seen` too, so that a device that is connected already counts as returned.
        self._device = self._seen = None
        self._stirred.set()

    async def run(self) -> None:
        """Stay connected, and reopen as often as needed, until `close` is called or this is cancelled."""
        delay = self._first_delay
        try:
            while True:
                lasted = await self._stay()
                if self._closing.is_set():
                    return
                # a port that opens and is lost immediately is not retried at the first delay
                if lasted > self._longest_delay:
                    delay = self._first_delay
                self._follow_folders()
                # After a return at once: the delay protects a device that is there but does not open.
                returned = await self._wait(delay)
                delay = self._first_delay if returned else min(2 * delay, self._longest_delay)
        finally:
            self._leave_folders()

    async def close(self) -> None:
        """Close the endpoint, within CLOSE_DEADLINE whatever the driver or the network does."""
        self._closing.set()
        self._stirred.set()
        link = self._link
        if link is None or link.transport is None or link.lost.is_set():
            return
        # Not `abort`, which does not wait until the device is free for the next program.
        link.transport.close()
        try:
            async with asyncio.timeout(CLOSE_DEADLINE):
                await link.lost.wait()
        except TimeoutError:
            pass
        finally:  # also after a cancellation: a closed bus must not hold its port
            if not link.lost.is_set():
                link.transport.abort()
        await asyncio.sleep(0)  # an aborted transport reports it at the next turn of the loop

    async def _stay(self) -> float:
        """Open the endpoint if necessary, and wait for its loss. Returns the seconds for which it was open."""
        loop = asyncio.get_running_loop()
        since = loop.time()
        if self._link is None:
            await self.try_open()
        if self._link is None:
            return 0.0
        self._leave_folders()
        await self._link.lost.wait()
        self._link = None
        return loop.time() - since

    async def _wait(self, delay: float) -> bool:
        """Wait `delay` seconds, varied by the jitter. Returns True, and earlier, if the device returns."""
        loop = asyncio.get_running_loop()
        # Varied: otherwise all lines of a server that was away would reconnect at the same moments.
        until = loop.time() + delay * self._jitter.uniform(0.75, 1.25)
        while (left := until - loop.time()) > 0:
            try:
                async with asyncio.timeout(min(left, LOOK_EVERY if self._watch is None else LOOK_ANYWAY)):
                    await self._stirred.wait()
            except TimeoutError:
                pass
            if self._closing.is_set():
                return False
            stirred = self._stirred.is_set()
            self._stirred.clear()
            if stirred and self._watch is not None:
                self._follow_folders()  # before the check: a later change triggers another one
            if self._came_back():
                return True
            if stirred:
                await asyncio.sleep(min(left, LOOK_PAUSE))
        return False

    def _follow_folders(self) -> None:
        """Watch the folders that lead to the device, if the endpoint and the system support it."""
        folders = getattr(self.endpoint, "folders", None)
        if folders is not None:
            self._watch = watch_folders(self._watch, folders, self._stirred.set)

    def _leave_folders(self) -> None:
        if self._watch is not None:
            self._watch.close()
            self._watch = None

    def _came_back(self) -> bool:
        """Return True if a device has appeared since the last check."""
        before = self._seen
        try:
            # Also while nothing is open, so that the next change is one against now.
            self._seen = self.endpoint.presence()
        except Exception as error:
            self._report("look", error)
        return self._seen is not None and self._seen != before

    def _report(self, doing: str, error: Exception) -> None:
        """Report why this failed, unless the cause is the same as at the last attempt."""
        cause = self._cause(error)
        # R14: a port that is missing for a night would fill the log with an attempt every 5 s.
        if self._on_failed is None or self._reported.get(doing) == str(cause):
            return
        self._reported[doing] = str(cause)
        try:
            self._on_failed(cause)
        except Exception as bug:
            context = {"message": f"on_failed of {self.endpoint.name} failed", "exception": bug}
            asyncio.get_running_loop().call_exception_handler(context)

    def _cause(self, error: Exception) -> LineDown:
        if isinstance(error, LineDown):
            return error
        if isinstance(error, OSError):
            return LineDown(f"cannot open {self.endpoint.name}: {error.strerror or str(error) or type(error).__name__}")
        cause = LineDown(
            f"cannot open {self.endpoint.name}: {type(error).__name__}: {error}",
            hint="this is a bug; report it with the text from the log",
        )
        cause.__cause__ = error
        return cause


class _Link(asyncio.Protocol):
    """Stands between a transport and the protocol, to notice the loss and to describe its cause."""

    def __init__(self, name: str, protocol: asyncio.Protocol, closing: asyncio.Event) -> None:
        self.lost = asyncio.Event()
        self.transport: asyncio.Transport | None = None
        self._name = name
        self._protocol = protocol
        self._closing = closing
        self.data_received = protocol.data_received  # type: ignore[method-assign]  # no additional call on the hot path
        self.byte_marked = taker_of_marked_bytes(protocol)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast("asyncio.Transport", transport)  # uvloop's transports do not inherit from asyncio's
        self._protocol.connection_made(transport)

    def pause_writing(self) -> None:
        self._protocol.pause_writing()

    def resume_writing(self) -> None:
        self._protocol.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        try:
            self._protocol.connection_lost(None if self._closing.is_set() else self._cause(exc))
        finally:
            self.lost.set()  # `run` waits for this, whatever the protocol raises

    def _cause(self, exc: Exception | None) -> LineDown:
        if isinstance(exc, LineDown):
            return exc
        if exc is None:
            return LineDown(f"{self._name} was closed by the other end", hint="")
        return LineDown(f"{self._name} was lost: {cause_text(exc, 'it was closed')}", hint="")

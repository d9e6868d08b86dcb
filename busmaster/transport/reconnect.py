"""Keeps one endpoint connected."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Hashable
from typing import cast

from busmaster.errors import LineDown, cause_text
from busmaster.transport.endpoints import Endpoint
from busmaster.transport.folder_watch import FolderWatch, watch_folders
from busmaster.transport.identity import Identity
from busmaster.transport.marks import taker_of_marked_bytes

FIRST_DELAY = 0.1
LONGEST_DELAY = 5.0
CLOSE_DEADLINE = 1.0
LOOK_EVERY = 0.2
"""Seconds between two looks at whether the device is back, where no folder tells it."""
LOOK_ANYWAY = 1.0
"""Seconds between two looks where the folders are watched. In a container the kernel may describe a device whose node
was there all the time, and a folder of another machine's file system tells nothing."""
LOOK_PAUSE = 0.02
"""Seconds between two looks at least, however much happens in the folders."""


class Connection:
    """Gives `protocol` one transport after another, for as long as `run` runs.

    The protocol hears `connection_made`, `data_received` and `connection_lost` as any asyncio protocol, the first and
    the last once per connection; `connection_lost(None)` means closed from here, else the cause is a LineDown.

    Between attempts it waits `first_delay` seconds, doubled up to `longest_delay` and spread by a quarter (`jitter`
    is where that comes from), and begins anew after a connection that lasted longer than that. A device that comes
    back is noticed at once. Only the device of the first opening is opened again, whatever has its name meanwhile.

    Whatever goes wrong in the background ends nothing: it is tried again. `on_failed` hears why, once until the
    reason changes; a cause that has a cause of its own is a bug.
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
        self._told: dict[str, str] = {}
        self._closing = asyncio.Event()
        self._stirred = asyncio.Event()
        """There may be something to see: look now."""
        self._watch: FolderWatch | None = None

    async def open(self) -> None:
        """Open it once, now. Raises LineDown."""
        self._came_back()  # what is there already is no return
        link = _Link(self.endpoint.name, self._protocol, self._closing)
        transport = await self.endpoint.open(lambda: link, self._device)
        # of this opening: the same device may have come back at another place, and is known from there on
        self._device = transport.get_extra_info("identity")
        self._link = link
        self._told.clear()  # it was open in between: the same reason is news again
        if self._closing.is_set():  # closed while it opened: until now there was nothing to close
            await self.close()

    async def try_open(self) -> None:
        """Open it once, now, and tell why where that fails: `run` goes on trying."""
        try:
            await self.open()
        except Exception as error:  # not LineDown alone: any other would end the reconnecting, unseen
            self._tell("open", error)

    def accept_device(self) -> None:
        """Take whatever device has the port's name at the next opening, which comes soon."""
        self._device = self._seen = None
        self._stirred.set()

    async def run(self) -> None:
        """Stay connected, opening as often as it takes, until `close` is called or this is cancelled."""
        delay = self._first_delay
        try:
            while True:
                lasted = await self._stay()
                if self._closing.is_set():
                    return
                if lasted > self._longest_delay:  # a port that opens and is lost at once is not hammered
                    delay = self._first_delay
                self._follow_folders()
                returned = await self._wait(delay)
                delay = self._first_delay if returned else min(2 * delay, self._longest_delay)
        finally:
            self._leave_folders()

    async def close(self) -> None:
        """Close it and return when that is done, within CLOSE_DEADLINE whatever the driver or the network does."""
        self._closing.set()
        self._stirred.set()
        link = self._link
        if link is None or link.transport is None or link.lost.is_set():
            return
        link.transport.close()
        try:
            async with asyncio.timeout(CLOSE_DEADLINE):
                await link.lost.wait()
        except TimeoutError:
            pass
        finally:  # when cancelled too: a bus that was left holds no port
            if not link.lost.is_set():
                link.transport.abort()
        await asyncio.sleep(0)  # an aborted transport says so at the next turn of the loop

    async def _stay(self) -> float:
        """Open it unless it is, and wait for the loss. Returns for how many seconds it was open."""
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
        """Wait that long, spread by the jitter. Returns True, and earlier, if the device is seen to come back."""
        loop = asyncio.get_running_loop()
        # spread, or all lines of a server that went away would come back to it at the same moments
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
                self._follow_folders()  # before the look: what comes after it stirs again
            if self._came_back():
                return True
            if stirred:
                await asyncio.sleep(min(left, LOOK_PAUSE))
        return False

    def _follow_folders(self) -> None:
        """Watch the folders that now lead to the device, if this endpoint tells them and this system watches any."""
        folders = getattr(self.endpoint, "folders", None)
        if folders is not None:
            self._watch = watch_folders(self._watch, folders, self._stirred.set)

    def _leave_folders(self) -> None:
        if self._watch is not None:
            self._watch.close()
            self._watch = None

    def _came_back(self) -> bool:
        """Return whether a device has come since the last look."""
        before = self._seen
        try:
            self._seen = self.endpoint.presence()
        except Exception as error:
            self._tell("look", error)
        return self._seen is not None and self._seen != before

    def _tell(self, doing: str, error: Exception) -> None:
        """Say why this failed, unless it was for the same reason as the last time that this was tried."""
        cause = self._cause(error)
        if self._on_failed is None or self._told.get(doing) == str(cause):
            return
        self._told[doing] = str(cause)
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
            hint="this is a bug: please report it with what the log says",
        )
        cause.__cause__ = error
        return cause


class _Link(asyncio.Protocol):
    """Stands between a transport and the protocol, to learn of the loss and to put it into words."""

    def __init__(self, name: str, protocol: asyncio.Protocol, closing: asyncio.Event) -> None:
        self.lost = asyncio.Event()
        self.transport: asyncio.Transport | None = None
        self._name = name
        self._protocol = protocol
        self._closing = closing
        self.data_received = protocol.data_received  # type: ignore[method-assign]  # no step more on the hot path
        self.byte_marked = taker_of_marked_bytes(protocol)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast("asyncio.Transport", transport)  # uvloop's are none by inheritance
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

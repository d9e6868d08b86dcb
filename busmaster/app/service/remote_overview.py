"""What a person sees of a line that another program owns, and may do there."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from typing import Any

from busmaster import BusError
from busmaster.app.service.client_messages import (
    DemandParams,
    DetailsParams,
    PauseParams,
    SuspendParams,
    WriteParams,
)
from busmaster.app.service.fields import OptionsForm
from busmaster.app.service.link import Link
from busmaster.app.service.messages import encode_value
from busmaster.app.service.owner_messages import StreamMessage
from busmaster.app.service.typed import Struct, to_builtins

SOON = 1.0
"""Seconds within which a user's write must begin. Later it may not be wanted any more."""


class RemoteOverview:
    """The pictures of a line. `receive` is called with the owner's messages until the stream or the connection ends."""

    def __init__(self, link: Link, now: Callable[[], float], receive: Callable[[str, Mapping[str, Any]], None]) -> None:
        self._link = link
        self._now = now
        self._receive = receive
        self._ended = asyncio.Event()

    def receive(self, method: str, message: StreamMessage[Any]) -> None:
        """Handle a message of the line's owner."""
        if method == "ended":
            self.end()
        else:
            self._receive(method, to_builtins(message.body))

    def end(self) -> None:
        """Wake the functions that wait for the end."""
        self._ended.set()

    async def over(self) -> None:
        """Wait for the end. Raises LineDown, BusClosed, or another BusError, with its cause."""
        await self._ended.wait()
        self._link.check()
        raise BusError("the program that owns the line shows it no more", hint="see its log")

    async def pause(self, group: str, paused: bool) -> None:
        """Have a poll group rest, or go on, for all who use the line. Raises InvalidCommand for one that is gone."""
        await self._ask("pause", PauseParams(group, paused))

    async def demand(self, group: str) -> None:
        """Have a poll group read now. Raises InvalidCommand for one that is gone."""
        await self._ask("demand", DemandParams(group))

    async def suspend(self, protocol: str, address: int, for_: float) -> None:
        """Let a node rest for so many seconds, 0 for no longer, for all who use the line."""
        await self._ask("suspend", SuspendParams(protocol, address, for_))

    async def details(self, group: str, key: str) -> Mapping[str, Any]:
        """Return what there is to know of one point of a group. Raises InvalidCommand for one that is gone."""
        details: Mapping[str, Any] = to_builtins(await self._ask("details", DetailsParams(group, key)))
        return details

    async def write(self, group: str, key: str, value: Any) -> None:
        """Write a point of a group. Raises BusError or InvalidCommand as `Point.write`; the owner's limits hold."""
        options = OptionsForm(start_within=SOON)
        params = WriteParams(group, key, encode_value(value), options, requested=self._now())
        asked = self._link.ask("write", params, writes=True)
        await self._link.answer(asked)

    async def _ask(self, method: str, params: Struct) -> Any:
        return await self._link.answer(self._link.ask(method, params))

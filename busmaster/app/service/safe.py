"""Sends the safe state of a line on request of another program."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import TypeAlias

from busmaster import BusError, InvalidCommand
from busmaster.app.service.authorisation import Authorisation, SafeWrites
from busmaster.app.service.failures import bus_error_of, error_data
from busmaster.app.service.fields import BusErrorData
from busmaster.app.service.peers import Peer
from busmaster.app.service.values import number_text

SafeResult: TypeAlias = dict[str, BusErrorData | None]
"""For each point why it is not confirmed, None if it is."""


class SafeStateRequests:
    """Sends the safe state. Once begun, it continues, even if the requesting program disconnects."""

    def __init__(self, authorisation: Authorisation) -> None:
        self._authorisation = authorisation
        self._sending: asyncio.Task[SafeResult] | None = None

    @property
    def under_way(self) -> bool:
        """Whether it is being sent."""
        return self._sending is not None and not self._sending.done()

    def begin(self, wanted: Mapping[str, float], peer: Peer) -> asyncio.Task[SafeResult]:
        """Send the safe state, if it is the expected one; the task returns the result of each point.

        A request while it is being sent joins that transmission. Raises InvalidCommand if the program may not do this,
        or expects another safe state.
        """
        state = self._authorisation.safe_state
        if state is None or not state.values:
            raise InvalidCommand("the program that owns this line has no safe state; stop it, then send yours")
        if dict(wanted) != dict(state.values):
            raise InvalidCommand(
                f"the program that owns this line has the safe state {_text(state.values)}, not {_text(wanted)}; "
                "reload its file (SIGHUP)"
            )
        refusal = (
            "this line is read-only"
            if self._authorisation.read_only
            else state.refusal(peer.permission(self._authorisation.access))
        )
        if refusal:
            raise InvalidCommand(refusal)
        if self._sending is None or self._sending.done():
            self._sending = asyncio.ensure_future(self._send(state, str(peer)))
        return self._sending

    async def close(self) -> None:
        """Cancel the transmission, because the program ends and sends the safe state itself."""
        if self._sending is not None:
            self._sending.cancel()
            await asyncio.wait([self._sending])

    async def _send(self, state: SafeWrites, by: str) -> SafeResult:
        outcomes = await state.enter(self._authorisation, by, leaving=False)
        return {name: None if error is None else error_data(error) for name, error in outcomes.items()}


def outcomes_of(decoded: SafeResult) -> dict[str, BusError | None]:
    """Return the result of each point in a message."""
    return {name: None if error is None else bus_error_of(error) for name, error in decoded.items()}


def _text(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name} = {number_text(value)}" for name, value in values.items()) or "nothing"

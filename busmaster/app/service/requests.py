"""The requests of one program that have no reply yet."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from functools import partial
from typing import Any

from busmaster import BacklogFull, BusClosed, BusError, InvalidCommand, Priority, WriteUnconfirmed
from busmaster.app.bounds import MOST_REQUESTS, MOST_URGENT
from busmaster.app.service.client_messages import RequestParams, SafeParams, WriteParams
from busmaster.app.service.client_requests import BY_OWNER, ClientRequest, RequestSender, Writing, client_request_of
from busmaster.app.service.failures import REFUSED, START_OWNER, refusal_of
from busmaster.app.service.line import ServedLine
from busmaster.app.service.messages import Malformed, encode_value
from busmaster.app.service.safe import SafeResult


class Requests:
    """Runs requests, and calls `answer` or `refuse` with the number that the program gave."""

    def __init__(
        self,
        sender: RequestSender,
        line: ServedLine,
        answer: Callable[[int, Any], object],
        refuse: Callable[[int, Exception], object],
    ) -> None:
        self._sender = sender
        self._line = line
        self._answer = answer
        self._refuse = refuse
        self._under_way: dict[int, ClientRequest | None] = {}
        """Requests without a reply, by number. None is the safe state, which is being sent."""
        self._log = logging.getLogger("busmaster.app.service")

    def check_number(self, number: int) -> None:
        """Raise Malformed if the number belongs to a request without a reply."""
        if number in self._under_way:
            raise Malformed(f"request {number} is already in progress; use another number")

    @property
    def unfinished(self) -> tuple[ClientRequest, ...]:
        """Return the requests at its nodes."""
        return tuple(request for request in self._under_way.values() if request is not None)

    @property
    def sends_safe_state(self) -> bool:
        """Return whether the safe state is being sent for this program."""
        return None in self._under_way.values()

    def begin(self, number: int, params: RequestParams | WriteParams) -> None:
        """Start a command. Raises Malformed if the number belongs to a request without a reply."""
        under_way = self._under_way
        if number in under_way:  # as check_number does: this is done for every request
            self.check_number(number)
        try:
            if len(under_way) >= MOST_REQUESTS:
                self._check_room(urgent=_is_urgent(params))
            under_way[number] = request = client_request_of(params, self._sender, self._line)
            request.begin(partial(self._ended, number))
        except REFUSED as error:
            under_way.pop(number, None)
            self._refuse(number, refusal_of("request", error))

    def begin_safe(self, number: int, params: SafeParams) -> None:
        """Start to send the safe state. Raises Malformed if the number belongs to a request without a reply."""
        self.check_number(number)
        try:
            self._check_room(urgent=True)  # ordinary requests that wait must not keep the safe state from the line
            sending = self._line.safe_writes.begin(params.writes, self._sender.peer)
        except REFUSED as error:
            self._refuse(number, refusal_of("safe", error))
        else:
            self._under_way[number] = None
            sending.add_done_callback(partial(self._safe_sent, number))

    def cancel(self, number: int) -> None:
        """Cancel a command; it gets no reply. An unknown number is ignored."""
        request = self._under_way.get(number)
        if request is not None:
            request.cancel()

    def end(self) -> None:
        """Send the result of all requests, because the service ends, and perhaps the bus too."""
        for number, request in list(self._under_way.items()):
            if request is not None:
                request.cancel(BY_OWNER)
                # The advice of BusClosed is for the program that has closed its bus.
                self._refuse(
                    number, _unreported(request, BusClosed, "the program that owns the line ends", START_OWNER)
                )

    async def give_up(self) -> None:
        """Cancel all requests, and return when they have ended. The safe state continues."""
        for request in self.unfinished:
            request.cancel()
        while doing := [
            request.doing for request in self.unfinished if isinstance(request, Writing) and request.doing is not None
        ]:
            await asyncio.wait(doing)

    # inside

    def _check_room(self, *, urgent: bool) -> None:
        waiting = len(self._under_way)
        if waiting >= MOST_REQUESTS + (MOST_URGENT if urgent else 0):
            raise BacklogFull(f"{waiting} requests of this program have no reply yet")

    def _ended(self, number: int, request: ClientRequest, value: Any, error: BaseException | None) -> None:
        del self._under_way[number]
        if request.given_up:
            return
        try:
            if error is not None:
                raise error
            self._answer(number, encode_value(value))
        except (BusError, InvalidCommand) as refusal:
            self._refuse(number, refusal)
        except Exception as bug:  # an error of a protocol: the client gets it, and the line continues
            self._log.exception("a request of %s failed", self._sender.peer)
            what = f"the program that owns the line failed: {type(bug).__name__}: {bug}"
            self._refuse(number, _unreported(request, BusError, what))

    def _safe_sent(self, number: int, sending: asyncio.Task[SafeResult]) -> None:
        del self._under_way[number]
        error = WriteUnconfirmed("the program that owns the line ends") if sending.cancelled() else sending.exception()
        if error is None:
            self._answer(number, sending.result())
        else:
            self._refuse(number, error if isinstance(error, Exception) else BusError(str(error)))


def _unreported(request: ClientRequest, kind: type[BusError], what: str, hint: str | None = None) -> BusError:
    """Return the error for a request whose result is unknown: `kind` with `hint`, unless it may have written."""
    if request.command.writes and request.sent:
        kind, hint = WriteUnconfirmed, None
    return kind(what, node=request.node, command=str(request.command), hint=hint)


def _is_urgent(params: RequestParams | WriteParams) -> bool:
    return params.options is not None and params.options.priority is Priority.URGENT

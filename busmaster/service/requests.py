"""What one program has asked of the line that is not answered yet."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from busmaster.bus.requester import Priority
from busmaster.errors import BacklogFull, BusClosed, BusError, InvalidCommand, WriteUnconfirmed
from busmaster.service.errands import Asker, Errand
from busmaster.service.failures import REFUSED, refusal_of
from busmaster.service.line import ServedLine
from busmaster.service.messages import MOST_REQUESTS, MOST_URGENT, Malformed
from busmaster.service.reads import PlainRead


class Requests:
    """Has it done, and told by `answer` or `refuse`, with the number that the program gave it."""

    def __init__(
        self,
        asker: Asker,
        line: ServedLine,
        answer: Callable[[int, Any], object],
        refuse: Callable[[int, Exception], object],
    ) -> None:
        self._asker = asker
        self._line = line
        self._answer = answer
        self._refuse = refuse
        self._errands: dict[int, Errand] = {}
        self._safe: set[int] = set()
        """Those that wait for the safe state to be sent."""
        self._log = logging.getLogger("busmaster.service")

    def check_number(self, number: int) -> None:
        """Raise Malformed for the number of something that is not answered yet."""
        if number in self._errands or number in self._safe:
            raise Malformed(f"request {number} is under way already")

    @property
    def errands(self) -> tuple[Errand, ...]:
        """Return what is to be done at its nodes."""
        return tuple(self._errands.values())

    def begin(self, number: int, said: Mapping[str, Any] | PlainRead) -> None:
        """Have a command carried out."""
        try:
            self._check_room(said)
            errand = Errand.of(said, self._asker, self._line)
            self._errands[number] = errand
            errand.begin(partial(self._ended, number))
        except REFUSED as error:
            self._errands.pop(number, None)
            self._refuse(number, refusal_of("request", error))

    def begin_safe(self, number: int, params: Mapping[str, Any]) -> None:
        """Have the safe state sent."""
        try:
            self._check_room({})
            sending = self._line.safe_wishes.begin(params["writes"], self._asker.peer)
        except REFUSED as error:
            self._refuse(number, refusal_of("safe", error))
        else:
            self._safe.add(number)
            sending.add_done_callback(partial(self._safe_sent, number))

    def cancel(self, number: object) -> None:
        """Give up a command: it is not answered. What is no number of one means nothing."""
        errand = self._errands.get(number)  # type: ignore[call-overload]  # whatever a program says
        if errand is not None:
            errand.cancel()

    def end(self) -> None:
        """Tell it truthfully what becomes of all that: the service ends, and the bus perhaps with it."""
        for number, errand in list(self._errands.items()):
            errand.cancel()
            unsure = errand.command.writes and errand.journey.sent
            kind: type[BusError] = WriteUnconfirmed if unsure else BusClosed
            self._refuse(number, kind("the program that owns the line ends", node=errand.node, command=errand.text))

    async def give_up(self) -> None:
        """Give up all of it, and return when nothing of it is under way. The safe state goes on."""
        for errand in self.errands:
            errand.cancel()
        while writing := [errand.writing for errand in self.errands if errand.writing is not None]:
            await asyncio.wait(writing)

    # inside

    def _check_room(self, said: Mapping[str, Any] | PlainRead) -> None:
        waiting = len(self._errands) + len(self._safe)
        if waiting >= MOST_REQUESTS and not (_is_urgent(said) and waiting < MOST_REQUESTS + MOST_URGENT):
            raise BacklogFull(f"{waiting} requests of this program are not answered yet")

    def _ended(self, number: int, errand: Errand, value: Any, error: BaseException | None) -> None:
        del self._errands[number]
        if errand.given_up:
            return
        try:
            if error is not None:
                raise error
            self._answer(number, value)
        except (BusError, InvalidCommand) as refusal:
            self._refuse(number, refusal)
        except Exception as bug:  # of a protocol: the client is told, and the line goes on
            self._log.exception("a request of %s failed", self._asker.peer)
            self._refuse(number, errand.unforeseen(bug))

    def _safe_sent(self, number: int, sending: asyncio.Task[dict[str, Any]]) -> None:
        self._safe.discard(number)
        error = WriteUnconfirmed("the program that owns the line ends") if sending.cancelled() else sending.exception()
        if error is None:
            self._answer(number, sending.result())
        else:
            self._refuse(number, error if isinstance(error, Exception) else BusError(str(error)))


def _is_urgent(said: Mapping[str, Any] | PlainRead) -> bool:
    return isinstance(said, Mapping) and bool(said.get("options", {}).get("priority") == Priority.URGENT)

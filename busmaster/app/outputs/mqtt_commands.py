"""Commands by MQTT: each is checked when it arrives, so that refused ones do not delay others."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import anyio

from busmaster import InvalidCommand, Point
from busmaster.app.bounds import LONGEST_COMMAND, LONGEST_NAME, LONGEST_SENDER, MOST_AT_ONCE, MOST_COMMANDS
from busmaster.app.service.authorisation import Authorisation, WriteRequest
from busmaster.app.service.payload import NoCommand, read_payload
from busmaster.app.service.record import WriteRecord

if TYPE_CHECKING:
    from aiomqtt import Message
    from paho.mqtt.client import MQTTMessage

LOOK = 0.02
"""Seconds between two readings of the clock and of the number of unread bytes."""
LEAST = 5
"""Bytes of a message beside its topic and its payload, at least."""
BREATH = 0.005
"""Seconds between two replies to refused commands: a flood of them costs the line nothing."""
REPORT_EVERY = 10.0
"""Minimum number of seconds between two messages about refusals that were only counted."""
EXPIRY = "MessageExpiryInterval"
PROPERTIES = "UserProperty"
SENDER = "by"
"""User property for the name of the sender, because brokers do not send it to subscribers. It is not verified."""
BEGINNING = 100
"""Bytes of a command that are stored if it is too long to be read."""


class Answer(NamedTuple):
    """The reply to a command on PREFIX/result/NAME; without a name, on PREFIX/result."""

    name: str
    ok: bool
    error: str
    id: str = ""

    @property
    def fields(self) -> dict[str, Any]:
        fields: dict[str, Any] = {"ok": True} if self.ok else {"ok": False, "error": self.error}
        return {**fields, "id": self.id} if self.id else fields


Write: TypeAlias = Callable[[WriteRequest], Awaitable[WriteRecord]]
Reply: TypeAlias = Callable[[Answer], Awaitable[None]]


class Commands:
    """The permitted points, by topic, and the queue of commands. All of it is on the thread of the output.

    `report` is called with the number of commands that were refused without a reply.
    """

    def __init__(
        self,
        prefix: str,
        authorisation: Authorisation,
        points: Mapping[str, Point[Any]],
        now: Callable[[], float],
        report: Callable[[str], object] = lambda _: None,
    ) -> None:
        self.refused = 0
        """Refused commands, including those without a reply."""
        self.unanswered = 0
        self.queued: deque[WriteRequest] = deque()
        self._report = report
        self._asked = f"{prefix}/set/"
        self._authorisation = authorisation
        self._points = points
        self._now = now
        self._looked = now()
        """Messages that are read from now on have arrived after this time."""
        self.bytes_read = 0
        """Bytes that were read, at least."""
        self._looks: deque[tuple[float, int]] = deque()
        """Later looks, each with what will have been read when all is that lay there then."""
        self._answers: deque[tuple[WriteRequest, Answer]] = deque()
        self._answering = 0
        """Commands that are neither waiting nor answered yet."""
        self._reported = 0
        self._closed = False
        self._something = asyncio.Event()

    def arrive(self, message: Message) -> None:
        """Accept one message in the order of the unread bytes. Never waits, never raises."""
        self.bytes_read += LEAST + len(str(message.topic)) + len(message.payload)
        self.take(message)

    def take(self, message: Message | MQTTMessage) -> None:
        """Take in one message, wherever it came. Never waits, never raises."""
        topic = str(message.topic)
        if self._closed:
            self._count_alone()
            return
        name = topic.removeprefix(self._asked)
        point = self._points.get(name)
        if point is None and len(self._answers) >= MOST_COMMANDS:
            self._count_alone()  # before it is decoded: a flood of commands must cost nothing
            return
        shown = name if len(name) <= LONGEST_NAME else ""
        request = WriteRequest(
            interface="mqtt",
            by=_sender(topic[:LONGEST_NAME], message),
            name=shown or name[:40],
            point=point,
            value=_as_it_came(message.payload),
            arrived=self._looked,
        )
        try:
            request = self._read(request, message)  # first: the reply to every command contains its value and its id
            if point is None:
                raise InvalidCommand(self._authorisation.refusal(request))
            if message.retain:
                raise InvalidCommand("a retained command is not accepted, because its age is unknown")
            if len(self.queued) >= MOST_COMMANDS:
                raise InvalidCommand(f"{MOST_COMMANDS} commands are already waiting; send fewer at a time")
        except NoCommand as error:
            self._refuse(replace(request, id=error.id), shown, str(error))
        except InvalidCommand as error:
            self._refuse(request, shown, str(error))
        else:
            self.queued.append(request)
        self._something.set()

    def _read(self, request: WriteRequest, message: Message | MQTTMessage) -> WriteRequest:
        payload = read_payload(message.payload)
        ends = [] if payload.expires is None else [payload.expires]
        interval = getattr(message.properties, EXPIRY, None)
        if interval is not None:
            ends.append(time.time() - (self._now() - self._looked) + interval)
        return replace(request, value=payload.value, expires=min(ends, default=None), id=payload.id)

    def _refuse(self, request: WriteRequest, name: str, error: str) -> None:
        if len(self._answers) < MOST_COMMANDS:
            self.refused += 1
            self._answers.append((request, Answer(name, False, error, request.id)))
        else:
            self._count_alone()

    def _count_alone(self) -> None:
        self.refused += 1
        self.unanswered += 1

    async def serve(
        self, write: Write, keep: Callable[[WriteRequest, str], object], reply: Reply, unread: Callable[[], int]
    ) -> None:
        """Write the permitted commands and reply to all, until cancelled.

        `keep` is called with refused commands and the reason. `unread` returns the number of unread bytes.
        """
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(self._keep_looking, unread)
            tasks.start_soon(self._answer_refusals, keep, reply)
            tasks.start_soon(self._report_regularly)
            for _ in range(MOST_AT_ONCE):
                tasks.start_soon(self._obey, write, reply)

    def look(self, unread: int) -> None:
        """Store the present time for the unread bytes: messages after them arrive later.

        Messages that waited during a standstill of the process or machine count as old as the last reading before it.
        """
        if not unread:
            self._looks.clear()
        self._looks.append((self._now(), self.bytes_read + unread))
        while self._looks and self._looks[0][1] <= self.bytes_read:
            self._looked, _ = self._looks.popleft()

    async def _keep_looking(self, unread: Callable[[], int]) -> None:
        while True:
            self.look(unread())
            await anyio.sleep(LOOK)

    async def _obey(self, write: Write, reply: Reply) -> None:
        while True:
            if self.queued:
                request = self.queued.popleft()
                with self._one_more():
                    record = await write(request)
                    await reply(Answer(request.name, record.ok, record.error, request.id))
            else:
                await self._wait()

    async def _answer_refusals(self, keep: Callable[[WriteRequest, str], object], reply: Reply) -> None:
        while True:
            if self._answers:
                request, answer = self._answers.popleft()
                with self._one_more():
                    keep(request, answer.error)
                    await reply(answer)
                await anyio.sleep(BREATH)
            else:
                await self._wait()

    @contextmanager
    def _one_more(self) -> Iterator[None]:
        self._answering += 1
        try:
            yield
        finally:
            self._answering -= 1

    async def answered(self) -> None:
        """Return when all that has come is answered."""
        while self.queued or self._answers or self._answering:  # noqa: ASYNC110  many have a hand in it
            await anyio.sleep(LOOK)

    def close(self, keep: Callable[[WriteRequest, str], object]) -> None:
        """Stop accepting commands. `keep` is called with those without a reply; later ones are only counted."""
        self._closed = True
        for request, answer in self._answers:
            keep(request, answer.error)
        for request in self.queued:
            keep(request, "the connection to the broker ended before it was its turn: nothing was sent")
        self.queued.clear()
        self._answers.clear()

    async def _report_regularly(self) -> None:
        while True:
            await anyio.sleep(REPORT_EVERY)
            self.report_unanswered()

    def report_unanswered(self) -> None:
        """Report the number of refusals that were only counted, if there are new ones."""
        if self.unanswered > self._reported:
            self._report(f"{self.unanswered - self._reported} refused commands got neither a reply nor an audit entry")
            self._reported = self.unanswered

    async def _wait(self) -> None:
        self._something.clear()
        await self._something.wait()


def _as_it_came(payload: bytes | bytearray) -> str:
    """Return a command in the form that is stored until it is read. Of one that is too long, only the beginning."""
    if len(payload) <= LONGEST_COMMAND:
        return bytes(payload).decode(errors="replace")
    return f"{bytes(payload[:BEGINNING]).decode(errors='replace')}... ({len(payload)} bytes)"


def _sender(topic: str, message: Message | MQTTMessage) -> str:
    """Return the source of a command: its topic, and the name in its user property, which is not verified."""
    sender = dict(getattr(message.properties, PROPERTIES, ())).get(SENDER, "")[:LONGEST_SENDER]
    return f"{topic}, sender {sender!r} (not verified)" if sender else topic


class Inbox(asyncio.Queue["Message"]):
    """What the client puts its messages into: nothing waits in it."""

    def __init__(self, commands: Commands, maxsize: int = 0) -> None:
        super().__init__(maxsize)
        self._commands = commands

    def put_nowait(self, item: Message) -> None:
        self._commands.arrive(item)

"""Commands that come by MQTT: each is judged as it arrives, so that those that are refused hold up nobody."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import anyio

from busmaster import Point
from busmaster.app.service.authorisation import Authorisation, Wish
from busmaster.app.service.payload import NoCommand, read_payload
from busmaster.app.service.record import WriteRecord
from busmaster.bounds import LONGEST_COMMAND, LONGEST_NAME, LONGEST_SENDER, MOST_AT_ONCE, MOST_COMMANDS
from busmaster.errors import InvalidCommand

if TYPE_CHECKING:
    from aiomqtt import Message
    from paho.mqtt.client import MQTTMessage

LOOK = 0.02
"""Seconds between two looks at the clock, and at what has come and is not read yet."""
LEAST = 5
"""Bytes of a message beside its topic and its payload, at least."""
BREATH = 0.005
"""Seconds between two refusals that are answered: a flood of them costs the line nothing."""
TOLD_EVERY = 10.0
"""Seconds, at least, between two lines that tell how many refusals were counted alone."""
EXPIRY = "MessageExpiryInterval"
PROPERTIES = "UserProperty"
SENDER = "by"
"""The user property in which a sender may say who it is: no broker tells a subscriber, and nobody checks it."""
BEGINNING = 100
"""Bytes of a command that are kept where it is too long to be read."""


class Answer(NamedTuple):
    """What is told of a command on PREFIX/result/NAME; without a name, on PREFIX/result."""

    name: str
    ok: bool
    error: str
    id: str = ""

    @property
    def fields(self) -> dict[str, Any]:
        fields: dict[str, Any] = {"ok": True} if self.ok else {"ok": False, "error": self.error}
        return {**fields, "id": self.id} if self.id else fields


Write: TypeAlias = Callable[[Wish], Awaitable[WriteRecord]]
Say: TypeAlias = Callable[[Answer], Awaitable[None]]


class Commands:
    """What may be written, by topic, and what waits to be. All of it is on the thread of the output.

    `tell` is told how many commands were refused without an answer.
    """

    def __init__(
        self,
        prefix: str,
        authorisation: Authorisation,
        points: Mapping[str, Point[Any]],
        now: Callable[[], float],
        tell: Callable[[str], object] = lambda _: None,
    ) -> None:
        self.refused = 0
        """Commands that were refused, those that nobody was told of included."""
        self.unanswered = 0
        self.queued: deque[Wish] = deque()
        self._tell = tell
        self._asked = f"{prefix}/set/"
        self._authorisation = authorisation
        self._points = points
        self._now = now
        self._looked = now()
        """What is read next came after this look."""
        self.bytes_read = 0
        """Bytes that were read, at least."""
        self._looks: deque[tuple[float, int]] = deque()
        """Later looks, each with what will have been read when all is that lay there then."""
        self._answers: deque[tuple[Wish, Answer]] = deque()
        self._answering = 0
        """Commands that are neither waiting nor answered yet."""
        self._told = 0
        self._closed = False
        self._something = asyncio.Event()

    def arrive(self, message: Message) -> None:
        """Take in one message that came in the order of what is unread. Never waits, never raises."""
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
            self._count_alone()  # before anything is made of it: what is in a flood is to cost nothing
            return
        shown = name if len(name) <= LONGEST_NAME else ""
        wish = Wish(
            interface="mqtt",
            by=_sender(topic[:LONGEST_NAME], message),
            name=shown or name[:40],
            point=point,
            value=_as_it_came(message.payload),
            arrived=self._looked,
        )
        try:
            wish = self._read(wish, message)  # first: whatever becomes of it, its value and its id are told
            if point is None:
                raise InvalidCommand(self._authorisation.refusal(wish))
            if message.retain:
                raise InvalidCommand("a retained command is not obeyed: nobody knows how old it is")
            if len(self.queued) >= MOST_COMMANDS:
                raise InvalidCommand(f"{MOST_COMMANDS} commands are waiting already")
        except NoCommand as error:
            self._refuse(replace(wish, id=error.id), shown, str(error))
        except InvalidCommand as error:
            self._refuse(wish, shown, str(error))
        else:
            self.queued.append(wish)
        self._something.set()

    def _read(self, wish: Wish, message: Message | MQTTMessage) -> Wish:
        said = read_payload(message.payload)
        ends = [] if said.expires is None else [said.expires]
        interval = getattr(message.properties, EXPIRY, None)
        if interval is not None:
            ends.append(time.time() - (self._now() - self._looked) + interval)
        return replace(wish, value=said.value, expires=min(ends, default=None), id=said.id)

    def _refuse(self, wish: Wish, name: str, error: str) -> None:
        if len(self._answers) < MOST_COMMANDS:
            self.refused += 1
            self._answers.append((wish, Answer(name, False, error, wish.id)))
        else:
            self._count_alone()

    def _count_alone(self) -> None:
        self.refused += 1
        self.unanswered += 1

    async def serve(
        self, write: Write, keep: Callable[[Wish, str], object], say: Say, unread: Callable[[], int]
    ) -> None:
        """Write what is allowed and answer everything, until cancelled.

        `keep` is told of what was refused, and why. `unread` returns how many bytes have come and are not read yet.
        """
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(self._keep_looking, unread)
            tasks.start_soon(self._answer_refusals, keep, say)
            tasks.start_soon(self._keep_telling)
            for _ in range(MOST_AT_ONCE):
                tasks.start_soon(self._obey, write, say)

    def look(self, unread: int) -> None:
        """Note when so many bytes had come and were not read yet: what is read behind them came later.

        What lies there after a standstill, ours or the machine's, is as old as the last look before it.
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

    async def _obey(self, write: Write, say: Say) -> None:
        while True:
            if self.queued:
                wish = self.queued.popleft()
                with self._one_more():
                    record = await write(wish)
                    await say(Answer(wish.name, record.ok, record.error, wish.id))
            else:
                await self._wait()

    async def _answer_refusals(self, keep: Callable[[Wish, str], object], say: Say) -> None:
        while True:
            if self._answers:
                wish, answer = self._answers.popleft()
                with self._one_more():
                    keep(wish, answer.error)
                    await say(answer)
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

    def close(self, keep: Callable[[Wish, str], object]) -> None:
        """Take in nothing any more. `keep` is told of what was not answered; what still comes is counted alone."""
        self._closed = True
        for wish, answer in self._answers:
            keep(wish, answer.error)
        for wish in self.queued:
            keep(wish, "the connection to the broker ended before it was its turn: nothing was sent")
        self.queued.clear()
        self._answers.clear()

    async def _keep_telling(self) -> None:
        while True:
            await anyio.sleep(TOLD_EVERY)
            self.tell_unanswered()

    def tell_unanswered(self) -> None:
        """Tell how many refusals were counted alone, if there are any that were not told."""
        if self.unanswered > self._told:
            self._tell(f"{self.unanswered - self._told} refused commands were neither answered nor put on record")
            self._told = self.unanswered

    async def _wait(self) -> None:
        self._something.clear()
        await self._something.wait()


def _as_it_came(payload: bytes | bytearray) -> str:
    """Return a command as it is kept until it is read; of one that is too long to be read its beginning."""
    if len(payload) <= LONGEST_COMMAND:
        return bytes(payload).decode(errors="replace")
    return f"{bytes(payload[:BEGINNING]).decode(errors='replace')}... ({len(payload)} bytes)"


def _sender(topic: str, message: Message | MQTTMessage) -> str:
    """Return by whom a command is: all that is known is its topic, and what its sender says of itself."""
    said = dict(getattr(message.properties, PROPERTIES, ())).get(SENDER, "")[:LONGEST_SENDER]
    return f"{topic}, says {said!r}" if said else topic


class Inbox(asyncio.Queue["Message"]):
    """What the client puts its messages into: nothing waits in it."""

    def __init__(self, commands: Commands, maxsize: int = 0) -> None:
        super().__init__(maxsize)
        self._commands = commands

    def put_nowait(self, item: Message) -> None:
        self._commands.arrive(item)

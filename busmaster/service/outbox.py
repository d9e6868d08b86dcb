"""What is to be said to one client, in its order: bounded, so that one that does not read loses its own messages."""

from __future__ import annotations

import asyncio
from collections import OrderedDict, deque
from collections.abc import Awaitable, Callable, Hashable

from busmaster.service.messages import MOST_UNREAD, MOST_WAITING


class _Letter:
    __slots__ = ("key", "text")

    def __init__(self, text: str, key: Hashable = None) -> None:
        self.text = text
        self.key = key


class Outbox:
    """Messages that wait until the one before them is sent.

    Answers are never dropped, but `room` says when a client may ask more; of news, which come unasked, the oldest are
    dropped beyond MOST_UNREAD. `on_drop` is told whose that was.
    """

    def __init__(self, send: Callable[[str], Awaitable[None]], on_drop: Callable[[Hashable], None]) -> None:
        self._send = send
        self._on_drop = on_drop
        self._letters: OrderedDict[_Letter, None] = OrderedDict()  # one that is dropped is taken out from between
        self._news: deque[_Letter] = deque()
        self._latest: dict[Hashable, _Letter] = {}
        self._something = asyncio.Event()
        self._flushed = asyncio.Event()
        self._sent = asyncio.Event()
        self._sending = False
        self._over = False
        """Whether nothing can be sent any more: nobody is to wait for that."""

    @property
    def empty(self) -> bool:
        """Whether all that was put in has been handed over."""
        return not (self._letters or self._sending)

    @property
    def waiting(self) -> int:
        """Return how many messages are not handed over yet."""
        return len(self._letters) + self._sending

    def put(self, text: str) -> None:
        """Say this: it is never dropped."""
        self._add(_Letter(text))

    def put_latest(self, key: Hashable, text: str) -> None:
        """Say this in place of what was to be said of the same thing, if that still waits."""
        letter = self._latest.get(key)
        if letter is not None:
            letter.text = text
            return
        self._latest[key] = letter = _Letter(text, key)
        self._add(letter)

    def put_news(self, key: Hashable, text: str) -> None:
        """Say this of one of its streams, unless it does not keep up."""
        while len(self._news) >= MOST_UNREAD:
            oldest = self._news.popleft()
            del self._letters[oldest]
            self._on_drop(oldest.key)
        letter = _Letter(text, key)
        self._news.append(letter)
        self._add(letter)

    def _add(self, letter: _Letter) -> None:
        self._letters[letter] = None
        self._something.set()

    async def room(self) -> None:
        """Return when not too much waits: what a client asks that does not read the answers is not read either."""
        while self.waiting >= MOST_WAITING and not self._over:
            self._sent.clear()
            await self._sent.wait()

    async def flushed(self) -> None:
        """Return when all that was put in has been handed over."""
        while not (self.empty or self._over):
            self._flushed.clear()
            await self._flushed.wait()

    async def run(self) -> None:
        """Send what is put in, one after the other, until the connection is lost."""
        try:
            await self._send_all()
        finally:
            self._over = True
            self._sent.set()
            self._flushed.set()

    async def _send_all(self) -> None:
        while True:
            while self._letters:
                letter, _ = self._letters.popitem(last=False)
                if self._news and self._news[0] is letter:
                    self._news.popleft()
                elif self._latest.get(letter.key) is letter:
                    del self._latest[letter.key]
                self._sending = True
                await self._send(letter.text)
                self._sending = False
                self._sent.set()
            self._flushed.set()
            self._something.clear()
            await self._something.wait()

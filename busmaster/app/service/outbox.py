"""The unsent messages of one client, in their order and bounded: a client that does not read loses its own messages."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Hashable
from typing import Protocol

from busmaster.bounds import MOST_UNREAD, MOST_WAITING


class Way(Protocol):
    """What takes messages to the client."""

    @property
    def full(self) -> bool:
        """Return whether earlier messages are still unsent."""
        ...

    def say(self, text: str, /) -> None: ...


class _Letter:
    __slots__ = ("key", "text")

    def __init__(self, text: str, key: Hashable = None) -> None:
        self.text = text
        self.key = key


class Outbox:
    """Sends messages at once while the connection is not full. Later ones wait here until `flush`.

    Replies are never dropped. If it is `crowded`, no further requests of the client must be read. Of the notifications,
    the oldest beyond MOST_UNREAD are dropped. `on_drop` is called with their stream.
    """

    def __init__(self, way: Way, on_drop: Callable[[Hashable], None]) -> None:
        self._way = way
        self._on_drop = on_drop
        self._letters: OrderedDict[_Letter, None] = OrderedDict()  # one that is dropped is taken out from between
        self._news: deque[_Letter] = deque()
        self._latest: dict[Hashable, _Letter] = {}

    @property
    def waiting(self) -> int:
        """Return how many messages are not handed over yet."""
        return len(self._letters)

    @property
    def crowded(self) -> bool:
        """Return whether so many replies wait that no further requests of this client must be read."""
        return len(self._letters) >= MOST_WAITING

    def put(self, text: str) -> None:
        """Send a message that is never dropped."""
        if self._letters or self._way.full:
            self._letters[_Letter(text)] = None
        else:
            self._way.say(text)

    def put_latest(self, key: Hashable, text: str) -> None:
        """Send a message that replaces an earlier unsent one with the same key."""
        letter = self._latest.get(key)
        if letter is not None:
            letter.text = text
        elif self._letters or self._way.full:
            self._latest[key] = letter = _Letter(text, key)
            self._letters[letter] = None
        else:
            self._way.say(text)

    def put_news(self, key: Hashable, text: str) -> None:
        """Send a notification of a stream, unless the client does not keep up."""
        if not self._letters and not self._way.full:
            self._way.say(text)
            return
        while len(self._news) >= MOST_UNREAD:
            oldest = self._news.popleft()
            del self._letters[oldest]
            self._on_drop(oldest.key)
        letter = _Letter(text, key)
        self._news.append(letter)
        self._letters[letter] = None

    def flush(self, *, last: bool = False) -> None:
        """Send waiting messages until the connection is full; with `last` all of them, because nothing follows."""
        while self._letters and (last or not self._way.full):
            letter, _ = self._letters.popitem(last=False)
            if self._news and self._news[0] is letter:
                self._news.popleft()
            elif self._latest.get(letter.key) is letter:
                del self._latest[letter.key]
            self._way.say(letter.text)

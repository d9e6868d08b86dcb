"""The unsent messages of one client, in their order and bounded: a client that does not read loses its own messages."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Hashable
from typing import Protocol

from busmaster.app.bounds import MOST_UNREAD, MOST_WAITING


class MessageSink(Protocol):
    """What takes messages to the client."""

    @property
    def full(self) -> bool:
        """Return whether earlier messages are still unsent."""
        ...

    def send(self, message: bytes, /) -> None: ...


class _Message:
    __slots__ = ("encoded", "key")

    def __init__(self, encoded: bytes, key: Hashable = None) -> None:
        self.encoded = encoded
        self.key = key


class Outbox:
    """Sends messages at once while the connection is not full. Later ones wait here until `flush`.

    Replies are never dropped. If it is `crowded`, no further requests of the client must be read. Of the notifications,
    the oldest beyond MOST_UNREAD are dropped. `on_drop` is called with their stream.
    """

    def __init__(self, sink: MessageSink, on_drop: Callable[[Hashable], None]) -> None:
        self._sink = sink
        self._on_drop = on_drop
        self._messages: OrderedDict[_Message, None] = OrderedDict()  # one that is dropped is taken out from between
        self._droppable: deque[_Message] = deque()
        self._latest: dict[Hashable, _Message] = {}

    @property
    def waiting(self) -> int:
        """Return how many messages are not handed over yet."""
        return len(self._messages)

    @property
    def crowded(self) -> bool:
        """Return whether so many replies wait that no further requests of this client must be read."""
        return len(self._messages) >= MOST_WAITING

    def put(self, encoded: bytes) -> None:
        """Send a message that is never dropped."""
        if self._messages or self._sink.full:
            self._messages[_Message(encoded)] = None
        else:
            self._sink.send(encoded)

    def put_latest(self, key: Hashable, encoded: bytes) -> None:
        """Send a message that replaces an earlier unsent one with the same key."""
        message = self._latest.get(key)
        if message is not None:
            message.encoded = encoded
        elif self._messages or self._sink.full:
            self._latest[key] = message = _Message(encoded, key)
            self._messages[message] = None
        else:
            self._sink.send(encoded)

    def put_droppable(self, key: Hashable, encoded: bytes) -> None:
        """Send a notification of a stream, unless the client does not keep up."""
        if not self._messages and not self._sink.full:
            self._sink.send(encoded)
            return
        while len(self._droppable) >= MOST_UNREAD:
            oldest = self._droppable.popleft()
            del self._messages[oldest]
            self._on_drop(oldest.key)
        message = _Message(encoded, key)
        self._droppable.append(message)
        self._messages[message] = None

    def flush(self, *, last: bool = False) -> None:
        """Send waiting messages until the connection is full; with `last` all of them, because nothing follows."""
        while self._messages and (last or not self._sink.full):
            message, _ = self._messages.popitem(last=False)
            if self._droppable and self._droppable[0] is message:
                self._droppable.popleft()
            elif self._latest.get(message.key) is message:
                del self._latest[message.key]
            self._sink.send(message.encoded)

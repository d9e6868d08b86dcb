"""All pages that look at one line: each picture is put into words once, and a page that is slow sees fewer of them."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

from busmaster import BusError
from busmaster.app.interfaces.following import Following, Lost
from busmaster.app.service.messages import encode_json
from busmaster.app.service.picture import old_after
from busmaster.app.service.remote_exchanges import RemoteExchanges

MOST_EXCHANGES = 50
"""Messages of exchanges that one page has not taken; of more, the oldest are dropped."""
PAST_VALUES = 60
"""Values of a point that a new page gets, for its trend."""
PAST_POINTS = 500
"""Number of points whose past values a new page gets."""

Key = tuple[str, int]
"""What a message replaces: the one before of the same method and part."""


class Seat:
    """One page, with its unsent messages."""

    def __init__(self) -> None:
        self.wants_exchanges = False
        self._latest: dict[Key, str] = {}
        self._count = 0
        self._something = asyncio.Event()

    def put(self, key: Key, text: str) -> None:
        """Add a message, which replaces an unsent one with the same key."""
        self._latest.pop(key, None)  # a key that stays would keep its old place, before messages that it depends on
        self._latest[key] = text
        self._something.set()

    def put_exchanges(self, text: str) -> None:
        """Add a message with exchanges on the line."""
        self._count += 1
        self._latest.pop(("exchanges", self._count - MOST_EXCHANGES), None)
        self.put(("exchanges", self._count), text)

    async def take(self) -> list[str]:
        """Return the unsent messages, once there are any."""
        await self._something.wait()
        self._something.clear()
        texts, self._latest = list(self._latest.values()), {}
        return texts


class Audience:
    """The pages of one line. Exchanges are requested only while a page wants them."""

    def __init__(self, line: Following) -> None:
        self._line = line
        self._seats: set[Seat] = set()
        self._sent: dict[Key, str] = {}
        """The first messages for a new page."""
        self._set = 0
        self._exchanges: RemoteExchanges | None = None
        self._asking: asyncio.Task[None] | None = None
        line.on_picture(self._receive)
        line.on_state(self._changed)

    def join(self) -> Seat:
        """Return a seat, which gets the whole present state."""
        seat = Seat()
        self._seats.add(seat)
        seat.put(("state", 0), self._state())
        for key, text in self._sent.items():
            seat.put(key, text)
        seat.put(("past", 0), self._past())
        return seat

    def leave(self, seat: Seat) -> None:
        """Remove this page."""
        self._seats.discard(seat)
        self.look_at_exchanges()

    def look_at_exchanges(self) -> None:
        """Start or stop to request the exchanges on the line, as the pages want them."""
        wanted = any(seat.wants_exchanges for seat in self._seats) and self._line.is_connected
        if wanted and self._exchanges is None and self._asking is None:
            self._asking = asyncio.ensure_future(self._ask())
        elif not wanted and self._exchanges is not None:
            self._exchanges.close()
            self._exchanges = None

    async def _ask(self) -> None:
        try:
            self._exchanges = await self._line.remote.exchanges(self._receive_exchanges)
        except BusError:
            pass  # the owner has gone: the request is repeated when it is back
        finally:
            self._asking = None
        self.look_at_exchanges()  # the pages may have gone meanwhile

    def _receive(self, method: str, params: Mapping[str, Any]) -> None:
        if params.get("set", 0) > self._set:
            self._set = params["set"]
            self._sent = {key: text for key, text in self._sent.items() if key[0] not in ("rows", "values")}
        if method == "groups":
            aged = [group | {"old_after": old_after(group["period"], group["achieved"])} for group in params["groups"]]
            params = {**params, "groups": aged}
        key = method, params.get("first", 0)
        self._sent[key] = text = encode_json({"method": method, "body": params})
        for seat in self._seats:
            seat.put(key, text)

    def _receive_exchanges(self, params: Mapping[str, Any]) -> None:
        text = encode_json({"method": "exchanges", "body": params})
        for seat in self._seats:
            if seat.wants_exchanges:
                seat.put_exchanges(text)

    def _changed(self) -> None:
        if not self._line.is_connected:  # the next messages may come from another owner
            self._set = 0
            self._exchanges = None
        for seat in self._seats:
            seat.put(("state", 0), self._state())
        self.look_at_exchanges()

    def _state(self) -> str:
        state = self._line.state
        body = {"connected": not isinstance(state, Lost), "why": "", "read_only": self._line.read_only}
        if isinstance(state, Lost):
            body["why"] = state.why
        else:
            body["name"] = state.about["name"]
        return encode_json({"method": "state", "body": body})

    def _past(self) -> str:
        rows = self._line.picture.rows[:PAST_POINTS]
        past = [list(map(list, list(row.past)[-PAST_VALUES:])) for row in rows]
        # after a failure the values of the picture are None: a new page shows these
        last = [[row.value, row.asked] for row in self._line.picture.rows]
        return encode_json({"method": "past", "body": {"set": self._set, "past": past, "last": last}})

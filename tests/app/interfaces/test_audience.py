"""What each page of a line is sent, without a server and without an owner."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any, cast

import pytest

from busmaster.app.interfaces import audience
from busmaster.app.interfaces.audience import MOST_EXCHANGES, Audience, Seat
from busmaster.app.interfaces.following import Connected, Following, Lost
from busmaster.errors import LineDown
from tests.app.interfaces.test_following import row


class Exchanges:
    """The exchanges that an owner was requested to send."""

    def __init__(self, receive: Callable[[Mapping[str, Any]], None]) -> None:
        self.receive = receive
        self.is_closed = False

    def close(self) -> None:
        self.is_closed = True


class Line:
    """A line that the test changes."""

    def __init__(self) -> None:
        self.state: Connected | Lost = Connected({"name": "slitter"})
        self.read_only = False
        self.picture = SimpleNamespace(rows=[])
        self.receive: Callable[[str, Mapping[str, Any]], None] = lambda *_: None
        self.changed: Callable[[], None] = lambda: None
        self.requests: list[Exchanges] = []
        self.answer = asyncio.Event()
        self.answer.set()
        self.remote = self

    @property
    def is_connected(self) -> bool:
        return isinstance(self.state, Connected)

    def on_picture(self, receive: Callable[[str, Mapping[str, Any]], None]) -> None:
        self.receive = receive

    def on_state(self, changed: Callable[[], None]) -> None:
        self.changed = changed

    async def exchanges(self, receive: Callable[[Mapping[str, Any]], None]) -> Exchanges:
        self.requests.append(Exchanges(receive))
        await self.answer.wait()
        if not self.is_connected:
            raise LineDown("gone")
        return self.requests[-1]

    @property
    def open(self) -> list[Exchanges]:
        return [one for one in self.requests if not one.is_closed]

    def become(self, state: Connected | Lost) -> None:
        self.state = state
        self.changed()


def pages_of(line: Line) -> Audience:
    return Audience(cast("Following", cast("Any", line)))


async def taken(seat: Seat) -> list[tuple[str, Any]]:
    """What a page is sent next, by method."""
    return [(said["method"], said["body"]) for said in map(json.loads, await seat.take())]


async def turns() -> None:
    """Let the tasks go on."""
    for _ in range(5):
        await asyncio.sleep(0)


@pytest.mark.asyncio
async def test_a_page_that_joins_gets_the_state_and_the_last_of_each_message() -> None:
    line = Line()
    pages = pages_of(line)
    early = pages.join()
    for body in ({"set": 1, "first": 0}, {"set": 1, "first": 500}):
        line.receive("rows", body)
        line.receive("values", body)
    line.receive("frame", {"now": 1})
    line.receive("frame", {"now": 2})
    late = pages.join()
    told = await taken(late)
    assert told[0] == ("state", {"connected": True, "why": "", "read_only": False, "name": "slitter"})
    assert [(method, body.get("first", body.get("now"))) for method, body in told[1:-1]] == [
        *(("rows", 0), ("values", 0), ("rows", 500), ("values", 500), ("frame", 2))
    ]
    assert told[-1] == ("past", {"set": 1, "past": [], "last": []})
    assert [method for method, _ in await taken(early)] == [
        *("state", "past", "rows", "values", "rows", "values", "frame")
    ]
    line.receive("rows", {"set": 2, "first": 0})  # other points: the rows and values before are of none
    told = await taken(pages.join())
    assert [(method, body.get("set")) for method, body in told[1:-1]] == [("frame", None), ("rows", 2)]


@pytest.mark.asyncio
async def test_a_page_is_told_from_which_age_the_values_of_a_group_are_old() -> None:
    line = Line()
    seat = pages_of(line).join()
    line.receive("groups", {"first": 0, "groups": [{"name": "axes", "period": 0.5, "achieved": 0.6}]})
    [body] = [body for method, body in await taken(seat) if method == "groups"]
    assert body["groups"] == [{"name": "axes", "period": 0.5, "achieved": 0.6, "old_after": pytest.approx(1.8)}]


@pytest.mark.asyncio
async def test_a_page_is_told_why_the_owner_is_away_and_what_may_not_be_written() -> None:
    line = Line()
    pages = pages_of(line)
    seat = pages.join()
    await taken(seat)
    line.read_only = True
    line.become(Lost("no program serves it"))
    [(method, body)] = await taken(seat)
    assert (method, body) == ("state", {"connected": False, "why": "no program serves it", "read_only": True})


@pytest.mark.asyncio
async def test_the_past_of_some_points_and_the_last_value_of_all_are_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(audience, "PAST_POINTS", 2)
    line = Line()
    for number in range(3):
        line.picture.rows.append(row(item=str(number), value=number, asked=10.0 + number))
        line.picture.rows[-1].past.append((10.0 + number, number))
    [_, (_, body)] = await taken(pages_of(line).join())
    assert body["past"] == [[[10, 0]], [[11, 1]]]
    assert body["last"] == [[0, 10], [1, 11], [2, 12]]


@pytest.mark.asyncio
async def test_exchanges_are_requested_once_and_sent_to_the_pages_that_want_them() -> None:
    line = Line()
    pages = pages_of(line)
    one, two, other = pages.join(), pages.join(), pages.join()
    for seat in (one, two, other):
        await taken(seat)
    for seat in (one, two):
        seat.wants_exchanges = True
        pages.look_at_exchanges()
    await turns()
    assert len(line.requests) == 1
    line.requests[0].receive({"exchanges": []})
    other.put(("frame", 0), '{"method": "frame", "body": {}}')
    told = [[method for method, _ in await taken(seat)] for seat in (one, two, other)]
    assert told == [["exchanges"], ["exchanges"], ["frame"]]
    pages.leave(one)
    assert line.open
    pages.leave(two)
    assert not line.open
    two.wants_exchanges = False
    one.wants_exchanges = True
    pages.look_at_exchanges()
    await turns()
    assert len(line.requests) == 1, "a page that has left wants nothing"


@pytest.mark.asyncio
async def test_exchanges_are_given_back_if_the_page_goes_before_they_come() -> None:
    line = Line()
    line.answer.clear()
    pages = pages_of(line)
    seat = pages.join()
    seat.wants_exchanges = True
    pages.look_at_exchanges()
    await turns()
    pages.leave(seat)
    line.answer.set()
    await turns()
    assert len(line.requests) == 1
    assert not line.open


@pytest.mark.asyncio
async def test_exchanges_whose_request_has_failed_are_requested_again(monkeypatch: pytest.MonkeyPatch) -> None:
    line = Line()
    request, errors = line.exchanges, [LineDown("gone")]

    async def fails_once(receive: Callable[[Mapping[str, Any]], None]) -> Exchanges:
        if errors:
            raise errors.pop()
        return await request(receive)

    monkeypatch.setattr(line, "exchanges", fails_once)
    pages = pages_of(line)
    seat = pages.join()
    seat.wants_exchanges = True
    pages.look_at_exchanges()
    await turns()
    assert len(line.open) == 1


@pytest.mark.asyncio
async def test_exchanges_are_requested_of_each_owner_and_of_none_while_there_is_none() -> None:
    line = Line()
    pages = pages_of(line)
    seat = pages.join()
    seat.wants_exchanges = True
    pages.look_at_exchanges()
    await turns()
    for count in (2, 3):
        line.become(Lost("gone"))
        pages.look_at_exchanges()
        await turns()
        line.become(Connected({"name": "slitter"}))
        await turns()
        assert len(line.requests) == count
    line.answer.clear()  # an owner that goes before it replies
    line.become(Lost("gone"))
    line.become(Connected({"name": "slitter"}))
    await turns()
    line.become(Lost("gone"))
    line.answer.set()
    await turns()
    line.become(Connected({"name": "slitter"}))
    await turns()
    assert len(line.requests) == 5


@pytest.mark.asyncio
async def test_of_exchanges_that_a_page_does_not_take_the_oldest_are_dropped() -> None:
    seat = Seat()
    for number in range(MOST_EXCHANGES + 3):
        seat.put_exchanges(str(number))
    assert await seat.take() == [str(number) for number in range(3, MOST_EXCHANGES + 3)]
    waiting = asyncio.ensure_future(seat.take())
    await turns()
    assert not waiting.done()
    waiting.cancel()

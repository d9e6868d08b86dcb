"""Connections that say nothing, half of something, or do not read: they neither stay nor keep others out."""

from __future__ import annotations

import asyncio
import contextlib
import resource
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import httpx2 as httpx
import pytest
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from busmaster.app.bounds import READ_AT_ONCE
from busmaster.app.interfaces import connections
from busmaster.app.interfaces.connections import FEWEST, RESERVED, Crowd, most_connections
from busmaster.app.interfaces.guard import Guard
from busmaster.app.interfaces.web import application, serving
from busmaster.app.service import refusals
from tests.app.interfaces.lines import HERE, ONE, followed, page, poll, shows
from tests.app.service.lines import served, until
from tests.patience import PATIENCE

End = tuple[asyncio.StreamReader, asyncio.StreamWriter]
SHORT = 0.2
JSON = "Content-Type: application/json\r\n"


async def end_of(url: str) -> End:
    return await asyncio.open_connection(*url.removeprefix("http://").strip("/").split(":"))


def _noted(crowds: list[Crowd]) -> Callable[[Crowd], dict[str, Any]]:
    """What a Crowd's `protocols` does, and notes which one it was."""
    protocols = Crowd.protocols

    def noted(crowd: Crowd) -> dict[str, Any]:
        crowds.append(crowd)
        return protocols(crowd)

    return noted


async def closed(end: End) -> bytes:
    """What came until the other side closed it."""
    with contextlib.suppress(ConnectionResetError):
        return await asyncio.wait_for(end[0].read(), PATIENCE)
    return b""


@pytest.mark.asyncio
@pytest.mark.parametrize(
    "said",
    [
        b"",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n",
        f"PUT {ONE} HTTP/1.1\r\nHost: 127.0.0.1\r\n{JSON}Content-Length: 9\r\n\r\n{{".encode(),
        b"GET /openapi.json HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\nGET /",
    ],
    ids=["nothing", "half a head", "half a body", "half of the second"],
)
async def test_a_request_that_does_not_come_whole_ends_its_connection(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(connections, "REQUEST_WITHIN", SHORT)
    async with served(tmp_path) as line, page(tmp_path) as of:
        poll(line)
        await shows(of.line)
        end = await end_of(of.url)
        end[1].write(said)
        assert (await closed(end)).startswith(b"HTTP/1.1 200" if b"openapi" in said else b"")
        end[1].close()
        with contextlib.suppress(ConnectionError):
            await end[1].wait_closed()
    assert not [record for record in caplog.records if record.levelname in ("ERROR", "CRITICAL")]


@pytest.mark.asyncio
async def test_requests_one_after_the_other_may_take_longer_than_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "REQUEST_WITHIN", SHORT)
    async with page(tmp_path) as of:
        loop = asyncio.get_running_loop()
        end, begun = await end_of(of.url), loop.time()
        while loop.time() < begun + 2 * SHORT:  # the connection would be over if the time began with it alone
            end[1].write(b"HEAD / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            assert b" 200 " in await asyncio.wait_for(end[0].readuntil(b"\r\n\r\n"), PATIENCE)
        end[1].close()


UPGRADE = (
    b"GET /api/stream HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
)


@pytest.mark.asyncio
@pytest.mark.parametrize("more", [b"", b"\xc1\x80" + bytes(4)], ids=["alone", "with a frame behind it"])
async def test_a_connection_that_became_a_pages_waits_for_no_request_and_is_not_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: bytes
) -> None:
    crowds: list[Crowd] = []
    waiting: list[Any] = []
    monkeypatch.setattr(connections.Crowd, "protocols", _noted(crowds))
    note_waiting = Crowd.note_waiting

    def noting(crowd: Crowd, connection: Any, count: int) -> None:
        waiting.append(connection)
        note_waiting(crowd, connection, count)

    monkeypatch.setattr(connections.Crowd, "note_waiting", noting)
    async with page(tmp_path) as of:
        end = await end_of(of.url)
        await until(lambda: len(waiting) == 1)  # it was made
        end[1].write(UPGRADE + more)
        assert await asyncio.wait_for(end[0].readuntil(b"\r\n\r\n"), PATIENCE)
        [connection] = waiting
        assert connection._request is None  # nothing closes it later
        assert not crowds[0]._waiting
        end[1].transport.abort()


@pytest.mark.asyncio
async def test_only_a_small_part_of_what_a_client_sends_is_handled_in_a_turn_of_the_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes: dict[type, list[int]] = {H11Protocol: [], WebSocketsSansIOProtocol: []}

    def note(library: type) -> None:
        data_received = library.data_received  # type: ignore[attr-defined]

        def noting(connection: Any, data: bytes) -> None:
            sizes[library].append(len(data))
            data_received(connection, data)

        monkeypatch.setattr(library, "data_received", noting)

    for library in sizes:
        note(library)
    pings, body = 2000, b" " * 20_000
    async with page(tmp_path) as of:
        reader, writer = await end_of(of.url)
        writer.write(b"PUT %b HTTP/1.1\r\nHost: 127.0.0.1\r\n" % ONE.encode())
        writer.write(b"Content-Type: application/json\r\nContent-Length: %d\r\n\r\n%b" % (len(body), body))
        assert await asyncio.wait_for(reader.readline(), PATIENCE)
        writer.transport.abort()
        reader, writer = await end_of(of.url)
        writer.write(UPGRADE)
        await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), PATIENCE)
        writer.write(b"\x89\x80\0\0\0\0" * pings)
        async with asyncio.timeout(PATIENCE):
            for _ in range(pings):
                await reader.readuntil(b"\x8a\0")
        writer.transport.abort()
    for received in sizes.values():
        assert max(received) <= READ_AT_ONCE


@pytest.mark.asyncio
async def test_a_connection_that_ends_before_its_request_no_longer_waits_for_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    crowds: list[Crowd] = []
    monkeypatch.setattr(connections.Crowd, "protocols", _noted(crowds))
    async with page(tmp_path) as of:
        end = await end_of(of.url)
        await until(lambda: len(crowds[0]._waiting) == 1)
        [connection] = crowds[0]._waiting
        end[1].transport.abort()
        await until(lambda: not crowds[0]._waiting)
        assert connection._request is None


@pytest.mark.slow
@pytest.mark.asyncio
async def test_a_client_that_does_not_read_its_replies_is_let_go(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "SEND_WITHIN", SHORT)
    async with page(tmp_path) as of:
        _, writer = end = await end_of(of.url)
        with contextlib.suppress(ConnectionError):
            async with asyncio.timeout(PATIENCE):
                while not end[
                    1
                ].is_closing():  # the transport's reader takes some; then nothing of the replies is read any more
                    end[0]._transport.pause_reading()  # type: ignore[attr-defined]
                    writer.write(b"GET /openapi.json HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n" * 50)
                    await writer.drain()
        assert (await of.client.get("/openapi.json")).status_code == 200


@contextlib.asynccontextmanager
async def crowded(folder: Path, most: int, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[tuple[str, list[str]]]:
    """The page of a server with so many connections at most: its URL, and what it tells."""
    monkeypatch.setattr(connections, "MOST_PAGE_CONNECTIONS", most)
    told: list[str] = []
    async with followed(folder) as line, serving(application(line, Guard(HERE, {})), HERE, told.append) as url:
        yield url, told


@pytest.mark.asyncio
async def test_beyond_the_bound_the_oldest_that_says_nothing_is_closed_and_that_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(refusals, "REPORT_EVERY", SHORT)
    async with crowded(tmp_path, 20, monkeypatch) as (url, told):
        ends = [await end_of(url) for _ in range(20)]
        async with httpx.AsyncClient(base_url=url, timeout=PATIENCE, trust_env=False) as client:
            assert (await client.get("/openapi.json")).status_code == 200
            assert await closed(ends[0]) == b""
            await until(lambda: told)
            held = "there are 20 connections to the page, and no more are held"
            assert told == [f"{held}: 1 that had sent no whole request was closed"]
            ends += [await end_of(url) for _ in range(30)]
            for end in ends[1:30]:
                await closed(end)
            assert (await client.get("/openapi.json")).status_code == 200
            await until(lambda: len(told) > 1 and sum(int(text.split(": ")[1].split()[0]) for text in told) >= 31)
        for _, writer in ends:
            writer.close()


@pytest.mark.asyncio
async def test_beyond_the_bound_a_connection_that_is_idle_after_its_requests_is_closed_for_a_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with crowded(tmp_path, FEWEST, monkeypatch) as (url, told):
        request = b"HEAD /docs HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"

        async def replied_to() -> End:
            end = await end_of(url)
            end[1].write(request)
            assert b" 200 " in await asyncio.wait_for(end[0].readuntil(b"\r\n\r\n"), PATIENCE)
            return end

        ends = [await replied_to() for _ in range(FEWEST + 1)]
        assert await closed(ends[0]) == b""
        assert told
        for _, writer in ends:
            writer.close()


def test_the_bound_leaves_descriptors_free(monkeypatch: pytest.MonkeyPatch) -> None:
    for soft, most in (
        (resource.RLIM_INFINITY, 512),
        (100_000, 512),
        (1024, 512),
        (512, 512 - RESERVED),
        (100, FEWEST),
    ):
        monkeypatch.setattr(resource, "getrlimit", lambda _, soft=soft: (soft, soft))
        assert Crowd(print).most == most, soft
    assert most_connections() == 100 - RESERVED


class Written:
    """What the library does with a connection."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.transport: Any = self

    def abort(self) -> None:
        self.calls.append("abort")

    def pause_writing(self) -> None:
        self.calls.append("pause")

    def resume_writing(self) -> None:
        self.calls.append("resume")

    def connection_lost(self, _: Exception | None) -> None:
        self.calls.append("lost")


class Reader(connections._Taken, Written):
    """A connection whose client reads, or does not."""

    def timer(self) -> asyncio.TimerHandle | None:
        return self._reading


@pytest.mark.asyncio
async def test_the_time_in_which_a_client_must_read_begins_once_and_ends_when_it_reads_or_leaves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(connections, "SEND_WITHIN", PATIENCE)
    for end in (Reader.resume_writing, lambda one: one.connection_lost(None)):
        one = Reader()
        one.pause_writing()
        timer = one.timer()
        one.pause_writing()
        assert timer is not None
        assert one.timer() is timer
        end(one)
        assert one.timer() is None
        assert timer.cancelled()
        end(one)
        assert "abort" not in one.calls
        assert one.calls[:3] == ["pause", "pause", one.calls[-1]]
    monkeypatch.setattr(connections, "SEND_WITHIN", 0.0)
    one = Reader()
    one.pause_writing()
    await until(lambda: "abort" in one.calls)

"""A server of one page for HTTP scrapers: few threads, few connections, short time limits.

An asyncio loop holds the connections, which needs no thread for each. The page is made in one thread of its own, one
scrape after the other, and a new page is sent to all that wait. Half-open connections are closed when their time is
over, or when there are too many.
"""

from __future__ import annotations

import asyncio
import gzip
import socket
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import TYPE_CHECKING

from busmaster.app.bounds import LONGEST_SCRAPE, MOST_ASKING, MOST_SILENT

if TYPE_CHECKING:
    from prometheus_client.core import CollectorRegistry

PATIENCE = 5.0
"""Seconds for a whole request, and for a whole answer to be taken."""
BACKLOG = 128
TICK = 0.05
END_OF_HEAD = b"\r\n\r\n"
BUSY = "503 Service Unavailable"

Page = tuple[str, bytes]
"""Content type and text."""


def listening(host: str, port: int) -> socket.socket:
    """Open a socket that listens on the port. Raises OSError where the port is taken."""
    family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    return socket.create_server(address, family=family, backlog=BACKLOG)


def page(registry: CollectorRegistry, accept: str) -> Page:
    """Return the content type and the text of the metrics, in the form that a scraper accepts."""
    from prometheus_client.exposition import choose_encoder

    encoder, content_type = choose_encoder(accept)
    return content_type, encoder(registry)


async def serve(listener: socket.socket, make: Callable[[str], Page], stop: threading.Event) -> None:
    """Answer scrapes until `stop` is set."""
    with ThreadPoolExecutor(1, "busmaster scrape") as maker:
        server = _Server(make, maker)
        serving = await asyncio.start_server(server.answer, sock=listener, limit=LONGEST_SCRAPE)
        while not stop.is_set():  # noqa: ASYNC110  # another thread sets it
            await asyncio.sleep(TICK)
        serving.close()
        server.close()
        maker.shutdown(wait=False, cancel_futures=True)


class _Server:
    def __init__(self, make: Callable[[str], Page], maker: ThreadPoolExecutor) -> None:
        self._make = make
        self._maker = maker
        self._making: dict[str, asyncio.Future[Page]] = {}
        self._silent: dict[asyncio.StreamWriter, None] = {}
        """The oldest first."""
        self._asking: set[asyncio.StreamWriter] = set()

    async def answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer one request and close its connection."""
        self._silent[writer] = None
        while len(self._silent) > MOST_SILENT:
            self._drop(next(iter(self._silent)))
        try:
            async with asyncio.timeout(PATIENCE):
                head = (await reader.readuntil(END_OF_HEAD)).decode("latin-1")
            self._silent.pop(writer, None)
            self._asking.add(writer)
            busy = len(self._asking) > MOST_ASKING
            writer.transport.set_write_buffer_limits(0)  # drain() waits until the system has taken everything
            reply = response(BUSY, "text/plain", b"too many ask at once\n") if busy else await self._reply(head)
            writer.write(reply[: reply.index(END_OF_HEAD) + len(END_OF_HEAD)] if head.startswith("HEAD ") else reply)
            async with asyncio.timeout(PATIENCE):
                await writer.drain()
        except (OSError, EOFError, TimeoutError, asyncio.LimitOverrunError):
            # The client is not a scraper, does not read, or has disconnected. close() would wait until it has read.
            writer.transport.abort()
        finally:
            self._drop(writer)

    def close(self) -> None:
        """Close every connection."""
        for writer in [*self._silent, *self._asking]:
            self._drop(writer)

    def _drop(self, writer: asyncio.StreamWriter) -> None:
        self._silent.pop(writer, None)
        self._asking.discard(writer)
        with suppress(OSError):
            writer.close()

    async def _reply(self, head: str) -> bytes:
        first, *lines = head.split("\r\n")
        fields = {name.strip().lower(): text.strip() for name, _, text in (line.partition(":") for line in lines)}
        words = first.split()
        if len(words) != 3 or not words[2].startswith("HTTP/"):
            return response("400 Bad Request", "text/plain", b"this is not HTTP\n")
        if words[0] not in ("GET", "HEAD"):
            return response("405 Method Not Allowed", "text/plain", b"only GET is answered\n", Allow="GET, HEAD")
        try:
            content_type, text = await self._page(fields.get("accept", ""))
        except TimeoutError:
            return response(BUSY, "text/plain", b"the line's loop is busy\n")
        except Exception as error:
            return response("500 Internal Server Error", "text/plain", f"{error!r}\n".encode())
        encoding: dict[str, str] = {}
        if accepts_gzip(fields.get("accept-encoding", "")):
            text, encoding = gzip.compress(text, 1), {"Content-Encoding": "gzip"}
        return response("200 OK", content_type, text, **encoding)

    async def _page(self, accept: str) -> Page:
        """Return the metrics; all requests while a page is being made wait for the same one."""
        making = self._making.get(accept)
        if making is None:
            making = asyncio.get_running_loop().run_in_executor(self._maker, self._make, accept)
            self._making[accept] = making
            making.add_done_callback(lambda _: self._making.pop(accept))
        return await asyncio.shield(making)  # one that goes away must not cancel it for the others


def accepts_gzip(header: str) -> bool:
    """Return True if this value of Accept-Encoding permits gzip: `gzip;q=0` rejects it."""
    for coding in header.lower().replace(" ", "").split(","):
        name, _, weight = coding.partition(";q=")
        if name == "gzip":
            return not weight or bool(weight.strip("0."))
    return False


def response(status: str, content_type: str, body: bytes, **headers: str) -> bytes:
    """Return an HTTP message after which the connection ends."""
    fields = {"Content-Type": content_type, "Content-Length": str(len(body)), "Connection": "close", **headers}
    lines = [f"HTTP/1.1 {status}", *(f"{name}: {text}" for name, text in fields.items())]
    return "\r\n".join([*lines, "", ""]).encode() + body

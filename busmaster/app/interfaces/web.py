"""A page for the operator and a REST API for one line, in a process of its own, described by openapi.json."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from functools import partial
from math import ceil
from pathlib import Path
from typing import Any, Protocol

import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import QueryParams
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from busmaster import BacklogFull, BusClosed, BusError, InvalidCommand, LineDown, NoReply, NotStarted, Refused
from busmaster.app.bounds import (
    HISTORY_THREADS,
    LONGEST_COMMAND,
    LONGEST_PAGE_MESSAGE,
    MOST_HISTORY,
    MOST_PAGES,
    MOST_SAMPLES,
)
from busmaster.app.interfaces.audience import Audience, Seat
from busmaster.app.interfaces.connections import Crowd
from busmaster.app.interfaces.following import Following, Lost
from busmaster.app.interfaces.guard import Guard, Guarded
from busmaster.app.interfaces.reported_refusals import FailedLogins
from busmaster.app.service.messages import encode_json
from busmaster.app.service.picture import Row
from busmaster.app.service.record import cut
from busmaster.app.service.refusals import Logins, wait_text
from busmaster.app.service.tcp import HostPort, address_text, listening

PAGE = Path(__file__).parent / "page"
NUMBER = re.compile(r"[-+]?[0-9]{1,20}(\.[0-9]{0,40})?([eE][-+]?[0-9]{1,3})?")
LARGEST_NUMBER = 1e11
"""Of a parameter of a request for history: the year 5138."""
DEFAULT_RANGE = 3600.0
"""Seconds of history, if a request has no `from`."""
DEFAULT_SAMPLES = 1000
CLOSE_WITHIN = 1
"""Seconds in which pages are let go at the end."""
STATUS: tuple[tuple[type[Exception], int], ...] = (
    (InvalidCommand, 400),
    (Refused, 409),
    (BacklogFull, 503),
    (NotStarted, 503),
    (LineDown, 503),
    (BusClosed, 503),
    (NoReply, 504),
    (BusError, 502),
)
"""HTTP statuses by error: the first that matches. The reply contains the error's class and text."""

Report = Callable[[str], None]


class PastValues(Protocol):
    """Where past values are read. `read` blocks; it raises OSError where they cannot be read."""

    def read(self, key: str, unit: str, begin: float, end: float, limit: int) -> Any:
        """Return `samples`, `parts` and `labels` of a point, from `begin` to `end` in seconds since 1970."""
        ...


class Api:
    """The replies of the REST API. `report` is called with a sentence for each requested write."""

    def __init__(self, line: Following, guard: Guard, report: Report, history: PastValues | None = None) -> None:
        self._line = line
        self._guard = guard
        self._report = report
        self._logins = Logins(FailedLogins("web", line, report).note, time.monotonic)
        self._audience = Audience(line)
        self._pages = 0
        self._history = history
        # Threads of its own: asyncio's are those by which the line is followed.
        self._readers = ThreadPoolExecutor(HISTORY_THREADS, "busmaster history")
        self._reading = 0

    async def line(self, _: Request) -> Response:
        """Answer what the line does."""
        state, frame = self._line.state, self._line.picture.frame
        lost = isinstance(state, Lost)
        why, since = "", None
        if isinstance(state, Lost):
            why, since = state.why, state.since
        elif frame is not None and frame.since is not None:
            why, since = frame.why, self._wall(frame.since)
        data: dict[str, Any] = {
            "connected": not lost,
            "why": why,
            "since": since,
            "read_only": not self._may_be_written(),
            "wants_token": self._guard.wants_token,
            "history": self._history is not None,
            "frame": None,
        }
        if frame is not None:
            left_out = ("events", "why", "since")
            data["frame"] = {name: value for name, value in asdict(frame).items() if name not in left_out}
        return _json(data)

    async def nodes(self, _: Request) -> Response:
        """Answer health and counts of all nodes."""
        return _json([_as_in_the_file(asdict(node)) for node in self._line.picture.nodes.values()])

    async def groups(self, _: Request) -> Response:
        """Answer all poll groups."""
        return _json([asdict(group) for group in self._line.picture.groups])

    async def events(self, _: Request) -> Response:
        """Reply with the last events, each with its time of day."""
        frame = self._line.picture.frame
        events = frame.events if frame is not None else ()
        return _json([{"time": self._wall(when), "text": text} for when, text in events])

    async def points(self, _: Request) -> Response:
        """Answer all points with their last values."""
        return _json([self._point(row) for row in self._line.picture.rows])

    async def point(self, request: Request) -> Response:
        """Answer one point, with what there is to know of it."""
        row = self._row(request)
        details = await self._line.details(row.group, row.key)
        past = [[self._wall(when), value] for when, value in row.past]
        return _json({**self._point(row), "past": past, "details": details})

    async def history(self, request: Request) -> Response:
        """Answer past values of a point, which the line lets this interface read."""
        if self._history is None:
            raise HTTPException(404, "no history is served here: start with --history FILE")
        row = self._row(request)
        begin, end, limit = _range(request)
        if self._reading >= MOST_HISTORY:
            raise HTTPException(503, f"{MOST_HISTORY} requests for history are being served already")
        self._reading += 1
        try:
            read = partial(self._history.read, row.key, row.unit, begin, end, limit)
            found = await asyncio.get_running_loop().run_in_executor(self._readers, read)
        except OSError as error:
            raise HTTPException(503, str(error)) from None
        finally:
            self._reading -= 1
        return _json(
            {
                "from": begin,
                "to": end,
                "unit": row.unit,
                "samples": [sample._asdict() for sample in found.samples],
                "parts": [part._asdict() for part in found.parts],
                "labels": dict(found.labels),
            }
        )

    async def read_or_write(self, request: Request) -> Response:
        """Answer one point, or write it. One route has both methods, so that a 405 names both in `Allow`."""
        return await (self.write(request) if request.method == "PUT" else self.point(request))

    async def write(self, request: Request) -> Response:
        """Write one point. The body must be declared as JSON, which a form of another site cannot do."""
        by = self._guard.writer(request.headers)
        client = request.client.host if request.client is not None else "?"
        if self._guard.wants_token and "authorization" in request.headers:
            wait = self._logins.judge(client, by)
            if wait:
                raise HTTPException(429, wait_text(wait), {"retry-after": str(ceil(wait))})
        if by is None:
            raise HTTPException(401 if self._guard.wants_token else 403, self._why_not())
        row, value = self._row(request), await _value(request)
        who = f"{f'token {by}' if by else 'a page'} from {client}"
        asked = f"{row.key} = {cut(repr(value))}, from {who}"
        try:
            await self._line.write(row.group, row.key, value)
        except (BusError, InvalidCommand) as error:
            self._report(f"{asked}: {cut(str(error))}")
            raise
        self._report(f"{asked}: written")
        return _json({"written": value})

    async def stream(self, socket: WebSocket) -> None:
        """Send all changes to a page, until it disconnects."""
        if self._pages >= MOST_PAGES:
            await socket.close(1013, "too many pages are open; close one")
            return
        await socket.accept()
        seat = self._audience.join()
        self._pages += 1
        sending = asyncio.ensure_future(_send_updates(socket, seat))
        try:
            await self._listen(socket, seat)
        except (WebSocketDisconnect, RuntimeError):  # RuntimeError: it disconnected during a message
            pass
        finally:
            self._pages -= 1
            self._audience.leave(seat)
            sending.cancel()
            await asyncio.wait([sending])

    async def _listen(self, socket: WebSocket, seat: Seat) -> None:
        """Receive whether the page wants the exchanges: {"exchanges": true}."""
        while True:
            text = await socket.receive_text()
            if text not in EXCHANGES_WANTED:
                await socket.close(1008, "invalid message; a page only sends whether it wants exchanges")
                return
            seat.wants_exchanges = EXCHANGES_WANTED[text]
            self._audience.look_at_exchanges()

    # inside

    def _may_be_written(self) -> bool:
        return self._guard.lets_write and not self._line.read_only

    def _why_not(self) -> str:
        if self._guard.wants_token:
            return "a write needs a known token"
        return "a write from the network needs a token; start with --token-file"

    def _wall(self, moment: float) -> float | None:
        """Return a time of the line as seconds since 1970, None while its owner, who has that clock, is away."""
        try:
            return self._line.wall_time(moment)
        except LineDown:
            return None

    def _row(self, request: Request) -> Row:
        group, key = request.path_params["group"], request.path_params["key"]
        if self._line.picture.frame is None:  # a request while the interface opens must not report an unknown point
            state = self._line.state
            why = state.why if isinstance(state, Lost) else "its program was found a moment ago"
            raise LineDown(f"the points of the line are not known yet: {why}", hint="try again in a moment")
        for row in self._line.picture.rows:
            if (row.group, row.key) == (group, key):
                return row
        raise HTTPException(404, f"there is no point {key!r} in a poll group {group!r}")

    def _point(self, row: Row) -> dict[str, Any]:
        named = (
            "group",
            "key",
            "node",
            "protocol",
            "kind",
            "address",
            "item",
            "unit",
            "precision",
            "writable",
            "value",
        )
        data = {name: getattr(row, name) for name in (*named, "quality", "error", "alarm")}
        time = None if row.asked is None else self._wall(row.asked)
        return _as_in_the_file(data) | {"current": self._line.is_current(row), "time": time}


def _as_in_the_file(data: dict[str, Any]) -> dict[str, Any]:
    """Return a description of a node or a point with its protocol as in LINE.toml: `microflex`, not `hcp2`."""
    kind = data.pop("kind")
    return data | {"protocol": kind or data["protocol"]}


def _range(request: Request) -> tuple[float, float, int]:
    """Return begin, end and limit of a request for history. Raises HTTPException for a wrong value."""
    query = request.query_params
    end = _number(query, "to", time.time())
    begin = _number(query, "from", end - DEFAULT_RANGE)
    limit = _number(query, "limit", DEFAULT_SAMPLES)
    if not begin < end:
        raise HTTPException(400, f"from ({begin:.14g}) must be less than to ({end:.14g})")
    if not 1 <= limit <= MOST_SAMPLES or limit != int(limit):
        raise HTTPException(400, f"limit must be a whole number from 1 to {MOST_SAMPLES}")
    return begin, end, int(limit)


def _number(query: QueryParams, name: str, default: float) -> float:
    texts = query.getlist(name)
    if not texts:
        return default
    if len(texts) > 1 or not NUMBER.fullmatch(texts[0]) or not 0 <= (number := float(texts[0])) <= LARGEST_NUMBER:
        raise HTTPException(
            400, f"{name} must be one number from 0 to {LARGEST_NUMBER:.0f}, not {cut(repr(', '.join(texts)))}"
        )
    return number


EXCHANGES_WANTED = {'{"exchanges":true}': True, '{"exchanges":false}': False}


async def _send_updates(socket: WebSocket, seat: Seat) -> None:
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        while True:
            for text in await seat.take():
                await socket.send_text(text)


async def _value(request: Request) -> float | str:
    """Return the value to write. Raises HTTPException for an invalid body."""
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
        raise HTTPException(415, 'the body must be JSON: {"value": NUMBER}, as application/json')
    body = b""
    try:
        async for part in request.stream():
            body += part
            if len(body) > LONGEST_COMMAND:
                raise HTTPException(413, f"the body has {LONGEST_COMMAND} bytes at most")
    except ClientDisconnect:
        raise HTTPException(400, "the connection ended before the body did") from None
    try:
        data = json.loads(body)
    except (ValueError, RecursionError):
        data = None
    match data:
        case {"value": bool() | int() | float() | str() as value, **rest} if not rest:
            return value
    raise HTTPException(400, 'the body is {"value": NUMBER}, {"value": true}, {"value": false} or {"value": "TEXT"}')


def application(
    line: Following, guard: Guard, report: Report = lambda _: None, history: PastValues | None = None
) -> Guarded:
    """Return the ASGI application that shows a line. `report` is called for each requested write."""
    api = Api(line, guard, report, history)
    one = "/api/points/{group}/{key:path}"
    routes = [
        Route("/", _page, methods=["GET"]),
        Route("/docs", _docs, methods=["GET"]),
        Route("/openapi.json", _schema, methods=["GET"]),
        Route("/api/line", api.line, methods=["GET"]),
        Route("/api/nodes", api.nodes, methods=["GET"]),
        Route("/api/groups", api.groups, methods=["GET"]),
        Route("/api/events", api.events, methods=["GET"]),
        Route("/api/points", api.points, methods=["GET"]),
        Route(one, api.read_or_write, methods=["GET", "PUT"]),
        Route("/api/history/{group}/{key:path}", api.history, methods=["GET"]),
        WebSocketRoute("/api/stream", api.stream),
        Mount("/page", StaticFiles(directory=PAGE)),
    ]
    handlers: Mapping[Any, Any] = {BusError: _explain, InvalidCommand: _explain, HTTPException: _explain_http}
    return Guarded(Starlette(routes=routes, exception_handlers=handlers), guard)


@contextlib.asynccontextmanager
async def serving(application: Any, listen: HostPort, report: Report = lambda _: None) -> AsyncIterator[str]:
    """Serve an application at an address, and yield its URL. `report` is called for connections that are closed.

    Raises InvalidCommand if it cannot listen there.
    """
    opened = await asyncio.to_thread(listening, listen)
    with opened:
        config = uvicorn.Config(
            application,
            log_config=None,
            access_log=False,
            lifespan="off",
            proxy_headers=False,
            server_header=False,
            timeout_graceful_shutdown=CLOSE_WITHIN,
            **Crowd(report).protocols(),
            ws_max_size=LONGEST_PAGE_MESSAGE,
            ws_per_message_deflate=False,  # it takes as long as everything else for a page
        )
        server = _Server(config)
        task = asyncio.ensure_future(server.serve(sockets=[opened]))
        host, port = opened.getsockname()[:2]
        try:
            yield f"http://{address_text(host, port)}/"
        finally:
            server.should_exit = True
            await task


class _Server(uvicorn.Server):
    """A server that leaves the signals to its command."""

    @contextlib.contextmanager
    def capture_signals(self) -> Any:
        yield


async def serve(
    line: Following,
    listen: HostPort,
    secrets: Mapping[str, bytes],
    hosts: Sequence[str],
    opened: Report,
    report: Report = lambda _: None,
    history: PastValues | None = None,
) -> None:
    """Follow a line and serve its page until cancelled. `opened` is called with the page's URL, `hosts` are further
    names of the page, `history` reads past values.

    Raises InvalidCommand if it cannot listen there.
    """
    async with serving(application(line, Guard(listen, secrets, hosts), report, history), listen, report) as url:
        opened(url)
        await line.follow()


async def _page(_: Request) -> Response:
    return FileResponse(PAGE / "index.html")


async def _docs(_: Request) -> Response:
    return FileResponse(PAGE / "docs.html")


async def _schema(_: Request) -> Response:
    return FileResponse(PAGE / "openapi.json", media_type="application/json")


async def _explain(_: Request, error: Exception) -> Response:
    status = next(status for kind, status in STATUS if isinstance(error, kind))
    return _json({"error": type(error).__name__, "what": str(error)}, status)


async def _explain_http(_: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    if error.status_code == 405 and not error.headers:
        error.headers = {"allow": "GET, HEAD"}  # of the page's files, for which Starlette names none (RFC 9110, 15.5.6)
    return _json({"error": "NotServed", "what": error.detail}, error.status_code, error.headers)


def _json(data: Any, status: int = 200, headers: Mapping[str, str] | None = None) -> Response:
    return Response(encode_json(data), status, headers, media_type="application/json")

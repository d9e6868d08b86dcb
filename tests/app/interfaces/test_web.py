"""The REST API and the stream of the page, by real sockets: what is answered, who is let in, what becomes of writes."""

from __future__ import annotations

import asyncio
import json
import os
import socket
import threading
import time
from collections.abc import AsyncIterator
from math import inf
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import httpx2 as httpx
import pytest
from jsonschema import Draft202012Validator
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from busmaster import Hcp2Controller, MicroFlexDrive
from busmaster.app.bounds import HISTORY_THREADS, LONGEST_COMMAND, MOST_HISTORY
from busmaster.app.interfaces import audience, following, web
from busmaster.app.interfaces.audience import MOST_EXCHANGES, Seat
from busmaster.app.interfaces.connections import Crowd
from busmaster.app.interfaces.following import Lost
from busmaster.app.interfaces.guard import Guard
from busmaster.app.interfaces.web import PAGE, application, serving
from busmaster.app.outputs.history import History, HistoryFile, PastSample
from busmaster.app.outputs.settings import SqliteSettings
from busmaster.app.outputs.sqlite import SqliteOutput
from busmaster.app.service.permission import Access, Permission, digest_of
from busmaster.app.service.picture import Row
from busmaster.app.service.rights import Role
from busmaster.bus.limits import Limit
from busmaster.errors import (
    BacklogFull,
    BusClosed,
    GarbledReply,
    InvalidCommand,
    LineDown,
    NoReply,
    NotStarted,
    Refused,
)
from busmaster.registry import kinds
from tests.app.interfaces.lines import HERE, ONE, READS, Page, Past, assert_goes_on_alone, page, poll, shows
from tests.app.interfaces.test_following import Remote, connected, row, shown_frame
from tests.app.service.lines import Served, served, until
from tests.app.service.test_interfaces import has_ipv6
from tests.patience import PATIENCE

NETWORK = ("192.0.2.7", 8420)
TOKEN = "0123456789abcdef"
SCHEMA = json.loads((PAGE / "openapi.json").read_text())


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test waits between two tries to connect."""
    monkeypatch.setattr(following, "FIRST_PAUSE", 0.001)
    monkeypatch.setattr(following, "LONGEST_PAUSE", 0.001)


def check(path: str, method: str, status: int, said: Any) -> None:
    """Raise ValidationError for an answer that is not as the schema has it."""
    answer = SCHEMA["paths"][path][method]["responses"][str(status)]
    if "$ref" in answer:
        answer = SCHEMA["components"]["responses"][answer["$ref"].rpartition("/")[2]]
    schema = answer["content"]["application/json"]["schema"]
    Draft202012Validator({**schema, "components": SCHEMA["components"]}).validate(said)


async def put(of: Page, value: Any, path: str = ONE, **headers: str) -> tuple[int, Any]:
    """Status and answer of a write, which the schema allows."""
    answer = await of.client.put(path, json={"value": value}, headers=headers)
    check("/api/points/{group}/{key}", "put", answer.status_code, answer.json())
    return answer.status_code, answer.json()


@pytest.mark.asyncio
async def test_all_that_it_answers_is_as_its_schema_says(tmp_path: Path) -> None:
    async with served(tmp_path) as line, page(tmp_path) as of:
        poll(line)
        await shows(of.line)
        for path in ("line", "nodes", "groups", "events", "points"):
            answer = await of.client.get(f"/api/{path}")
            assert answer.status_code == 200
            assert answer.json() or path == "events"
            check(f"/api/{path}", "get", 200, answer.json())
        answer = await of.client.get(ONE)
        check("/api/points/{group}/{key}", "get", 200, answer.json())
        assert answer.json()["details"]["command"] == "read element 10"
        answer = await of.client.get("/api/points/axes/5/11")
        assert answer.status_code == 404
        check("/api/points/{group}/{key}", "get", 404, answer.json())


@pytest.mark.asyncio
async def test_a_microflex_is_called_by_the_protocol_that_its_file_has(tmp_path: Path) -> None:
    async with served(tmp_path) as line, page(tmp_path) as of:
        poll(line, MicroFlexDrive(line.bus, 7).point("speed_measured"))
        await shows(of.line)
        for path in ("nodes", "points"):
            said = (await of.client.get(f"/api/{path}")).json()
            check(f"/api/{path}", "get", 200, said)
            assert {(one["address"], one["protocol"]) for one in said} == {(5, "hcp2"), (7, "microflex")}


def test_each_kind_of_node_is_called_by_its_own_name() -> None:
    for name, kind in kinds().items():
        assert kind.profile.kind_name == name


@pytest.mark.asyncio
async def test_a_point_that_is_not_known_yet_is_not_told_to_be_none(tmp_path: Path) -> None:
    async with page(tmp_path) as of:  # and nobody serves a line
        answer = await of.client.get(ONE)
        assert (answer.status_code, answer.json()["error"]) == (503, "LineDown")
        check("/api/points/{group}/{key}", "get", 503, answer.json())
        await until(lambda: "no program serves" in getattr(of.line.state, "why", ""))
        assert "not known yet: no program serves" in (await of.client.get(ONE)).json()["what"].replace("\n", " ")


@pytest.mark.asyncio
async def test_its_schema_has_every_path_and_is_served(tmp_path: Path) -> None:
    async with page(tmp_path) as of:
        assert (await of.client.get("/openapi.json")).json() == SCHEMA
    Draft202012Validator.check_schema({"$defs": SCHEMA["components"]["schemas"]})
    assert SCHEMA["openapi"].startswith("3.1")
    methods = {(path, method) for path, of in SCHEMA["paths"].items() for method in of if method != "parameters"}
    named = {"line", "nodes", "groups", "events", "points", "history/{group}/{key}"}
    one = "/api/points/{group}/{key}"
    assert methods == {(f"/api/{name}", "get") for name in named} | {(one, "get"), (one, "put")}


METHODS = ("GET", "HEAD", "PUT", "POST", "PATCH", "DELETE", "OPTIONS", "TRACE", "QUERY")


@pytest.mark.slow
@pytest.mark.asyncio
async def test_a_method_that_a_path_does_not_have_is_refused_with_those_that_it_has(tmp_path: Path) -> None:
    paths = {path: {method.upper() for method in of if method != "parameters"} for path, of in SCHEMA["paths"].items()}
    paths |= {path: {"GET"} for path in ("/", "/docs", "/openapi.json", "/page/page.js")}
    async with page(tmp_path) as of:
        for path, documented in paths.items():
            allowed = documented | {"HEAD"}
            for method in METHODS:
                answer = await of.client.request(method, path.format(group="axes", key="5/10"))
                if method in allowed:
                    assert answer.status_code != 405, (method, path)
                    continue
                assert answer.status_code == 405, (method, path)
                assert set(answer.headers["allow"].split(", ")) == allowed, (method, path)
                assert answer.json()["error"] == "NotServed"
                assert answer.headers["x-content-type-options"] == "nosniff"


@pytest.mark.asyncio
async def test_a_write_passes_the_owners_authorisation_and_its_limits_hold(tmp_path: Path) -> None:
    async with served(tmp_path) as line, page(tmp_path) as of:
        poll(line)
        point = Hcp2Controller(line.bus, 5).point("10")
        point.node.limit(Limit(name=point.key, read=point.command, decode=point.value_of, maximum=50))
        await shows(of.line)
        assert await put(of, 12.5) == (200, {"written": 12.5})
        status, said = await put(of, 51)
        assert (status, said["error"]) == (400, "InvalidCommand")
        assert "50" in said["what"]
        assert line.audit() == [("5/10", "written"), ("5/10", "refused")]
        assert of.writes[0] == "5/10 = 12.5, from a page from 127.0.0.1: written"
        assert len(of.writes) == 2


@pytest.mark.asyncio
async def test_of_nonsense_only_the_beginning_is_told(tmp_path: Path) -> None:
    async with served(tmp_path) as line, page(tmp_path) as of:
        poll(line)
        await shows(of.line)
        assert (await put(of, "x" * 4000))[0] == 400
        [told] = of.writes
        assert told.startswith("5/10 = 'xxx")
        assert told.count("... (40") == 2  # the value, and the error that has it
        assert len(told) < 600


@pytest.mark.asyncio
async def test_a_body_that_says_no_value_writes_nothing(tmp_path: Path) -> None:
    cases = [
        (b'{"value": null}', "application/json", 400),
        (b'{"value": [1]}', "application/json", 400),
        (b'{"value": 1, "also": 2}', "application/json", 400),
        (b"{", "application/json", 400),
        (b"[" * LONGEST_COMMAND, "application/json", 400),
        (b"\xff", "application/json", 400),
        (b" " * (LONGEST_COMMAND + 1), "application/json", 413),
        (b'{"value": 1}', "text/plain", 415),
        (b'{"value": 1}', "application/x-www-form-urlencoded", 415),
    ]
    async with served(tmp_path) as line, page(tmp_path) as of:
        poll(line)
        await shows(of.line)
        for body, kind, status in cases:
            answer = await of.client.put(ONE, content=body, headers={"Content-Type": kind})
            assert (body, kind, answer.status_code) == (body, kind, status)
            check("/api/points/{group}/{key}", "put", status, answer.json())
            assert line.records == []


@pytest.mark.asyncio
async def test_while_the_owner_is_away_it_says_so_and_writes_nothing(tmp_path: Path) -> None:
    async with page(tmp_path) as of:
        async with served(tmp_path) as line:
            poll(line)
            await shows(of.line)
        await until(lambda: not of.line.is_connected)
        said = (await of.client.get("/api/line")).json()
        assert not said["connected"]
        assert said["why"]
        check("/api/line", "get", 200, said)
        status, said = await put(of, 1)
        assert (status, said["error"]) == (503, "NotStarted")
        answer = await of.client.get(ONE)
        assert answer.status_code == 503


# history

PAST = "/api/history/axes/5/10"
FIRST = 1_700_000_000.0


async def past_of(of: Page, status: int = 200, path: str = PAST) -> Any:
    """The answer to a request for history, which the schema allows."""
    answer = await of.client.get(path)
    assert answer.status_code == status, answer.text
    check("/api/history/{group}/{key}", "get", status, answer.json())
    return answer.json()


@pytest.mark.asyncio
async def test_past_values_come_from_the_database_that_the_output_writes(tmp_path: Path) -> None:
    output = SqliteOutput("sqlite", SqliteSettings(path=str(tmp_path / "line.db")))
    output.start()
    history = HistoryFile(str(tmp_path / "line.db"))
    async with served(tmp_path) as line, page(tmp_path, history=history) as of:
        poll(line)
        [group] = line.bus.groups
        await shows(of.line)
        for _ in range(3):
            output.offer(await anext(aiter(group)))
        await asyncio.to_thread(output.close, PATIENCE)
        assert (await of.client.get("/api/line")).json()["history"]
        found = await past_of(of)
        assert [(sample["value"], sample["quality"]) for sample in found["samples"]] == 3 * [(0.0, "good")]
        assert found["from"] < found["samples"][0]["time"] < found["samples"][2]["time"] <= found["to"]
        found = await past_of(of, path=f"{PAST}?limit=2")
        assert found["samples"] == []
        assert sum(part["samples"] for part in found["parts"]) == 3


@pytest.mark.asyncio
async def test_history_is_read_in_the_range_that_is_requested_and_off_the_loop(tmp_path: Path) -> None:
    samples = (PastSample(FIRST, inf, "good", None), PastSample(FIRST + 1, None, "bad", "no reply"))
    past = Past(History(samples, labels=(("1", "jog"),)))
    async with served(tmp_path) as line, page(tmp_path, history=past) as of:
        poll(line)
        await shows(of.line)
        found = await past_of(of, path=f"{PAST}?from={FIRST}&to={FIRST + 10}&limit=7")
        assert past.requests == [("5/10", "", FIRST, FIRST + 10, 7)]
        assert threading.get_ident() not in past.threads
        assert (found["from"], found["to"], found["labels"]) == (FIRST, FIRST + 10, {"1": "jog"})
        assert [sample["value"] for sample in found["samples"]] == [{"float": "inf"}, None]
        await past_of(of, path=f"{PAST}?to={FIRST}")
        assert past.requests[1][2:] == (FIRST - 3600, FIRST, 1000)


@pytest.mark.asyncio
async def test_a_range_that_is_none_is_refused_before_anything_is_read(tmp_path: Path) -> None:
    cases = [
        ("from=yesterday", "from must be one number"),
        ("from=nan", "from must be one number"),
        ("to=1_0", "to must be one number"),
        ("to=-1", "to must be one number from 0"),
        ("to=1e300", "to must be one number from 0 to 100000000000"),
        ("from=1&from=2", "not '1, 2'"),
        ("from=10&to=10", "from (10) must be less than to (10)"),
        ("from=&to=10", "from must be one number"),
        ("limit=0", "limit must be a whole number from 1 to 10000"),
        ("limit=10001", "limit must be a whole number from 1 to 10000"),
        ("limit=1.5", "limit must be a whole number from 1 to 10000"),
    ]
    past = Past()
    async with served(tmp_path) as line, page(tmp_path, history=past) as of:
        poll(line)
        await shows(of.line)
        for query, why in cases:
            assert why in (await past_of(of, 400, f"{PAST}?{query}"))["what"], query
            assert past.requests == []


@pytest.mark.asyncio
async def test_history_is_authorised_as_reads_are(tmp_path: Path) -> None:
    past = Past()
    async with served(tmp_path) as line, page(tmp_path, history=past) as of:
        poll(line)
        await shows(of.line)
        assert (await of.client.get(PAST, headers={"Origin": "http://evil.example"})).status_code == 403
        assert "there is no point '5/11'" in (await past_of(of, 404, "/api/history/axes/5/11"))["what"]
        await past_of(of, 404, "/api/history/other/5/10")
        assert past.requests == []
    async with page(tmp_path, history=past) as of:  # and no line is served
        await past_of(of, 503)
        assert past.requests == []


@pytest.mark.asyncio
async def test_a_history_that_is_not_served_or_cannot_be_read_is_an_error_in_words(tmp_path: Path) -> None:
    past = Past(OSError("the history x.db cannot be read: disk I/O error"))
    async with served(tmp_path) as line:
        poll(line)
        async with page(tmp_path, history=past) as of:
            await shows(of.line)
            assert (await past_of(of, 503))["what"] == "the history x.db cannot be read: disk I/O error"
        async with page(tmp_path) as of:
            await shows(of.line)
            assert not (await of.client.get("/api/line")).json()["history"]
            assert "--history" in (await past_of(of, 404))["what"]


@pytest.mark.asyncio
async def test_requests_for_history_beyond_the_bound_are_refused_and_all_else_goes_on(tmp_path: Path) -> None:
    past = Past()
    past.held.clear()
    async with served(tmp_path) as line, page(tmp_path, history=past) as of:
        poll(line)
        await shows(of.line)
        requests = {asyncio.ensure_future(of.client.get(PAST)) for _ in range(MOST_HISTORY + 1)}
        try:
            [refused], waiting = await asyncio.wait(requests, return_when=asyncio.FIRST_COMPLETED)
            assert (await refused).status_code == 503
            assert len(past.requests) == HISTORY_THREADS
            assert (await of.client.get("/api/line")).status_code == 200
        finally:
            past.held.set()
        assert {answer.status_code for answer in await asyncio.gather(*waiting)} == {200}
        await past_of(of)  # their places are free again


@pytest.mark.asyncio
async def test_a_history_that_cannot_be_read_leaves_its_place_to_the_next_request() -> None:
    of = Local(history=Past(OSError("disk I/O error")))
    for _ in range(MOST_HISTORY + 1):
        answer = await of.client.get("/api/history/axes/winder/10")
        assert (answer.status_code, answer.json()["what"]) == (503, "disk I/O error")


# who is let in

EVIL = [
    {"Host": "evil.example"},
    {"Host": "localhost.evil.example"},
    {"Host": "127.0.0.1.evil.example:80"},
    {"Host": "192.0.2.7"},
    {"Host": ""},
    {"Origin": "http://evil.example"},
    {"Origin": "null"},
    {"Origin": "http://127.0.0.1:1"},
    {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors"},
]


@pytest.mark.asyncio
async def test_a_foreign_origin_and_a_rebound_host_are_refused(tmp_path: Path) -> None:
    async with served(tmp_path) as line, page(tmp_path) as of:
        poll(line)
        await shows(of.line)
        for headers in EVIL:
            for path in ("/", "/api/points", "/page/page.js", "/openapi.json"):
                assert (await of.client.get(path, headers=headers)).status_code == 403, (path, headers)
            answer = await of.client.put(ONE, json={"value": 1}, headers=headers)
            assert answer.status_code == 403, headers
            assert "access-control-allow-origin" not in answer.headers
            assert line.records == []


@pytest.mark.asyncio
async def test_a_websocket_of_another_sites_page_is_refused(tmp_path: Path) -> None:
    async with served(tmp_path), page(tmp_path) as of:
        for headers in [those for those in EVIL if those.get("Host") != ""]:
            host = headers.get("Host")
            more = {name: value for name, value in headers.items() if name != "Host"}
            port = int(of.url.rpartition(":")[2].strip("/"))
            url = of.url.replace("http", "ws", 1) if host is None else f"ws://{host.partition(':')[0]}:{port}/"
            with pytest.raises(InvalidStatus, match="403"):
                await connect(f"{url}api/stream", host="127.0.0.1", port=port, additional_headers=more, proxy=None)


@pytest.mark.asyncio
async def test_no_preflight_is_answered_and_no_page_may_hold_it_in_a_frame(tmp_path: Path) -> None:
    async with page(tmp_path) as of:
        answer = await of.client.request("OPTIONS", ONE, headers={"Access-Control-Request-Method": "PUT"})
        assert answer.status_code == 405
        answer = await of.client.get("/")
        assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]
        assert "default-src 'self'" in answer.headers["content-security-policy"]


@pytest.mark.asyncio
async def test_beyond_this_machine_nobody_writes_without_tokens_and_all_may_look(tmp_path: Path) -> None:
    async with served(tmp_path) as line, page(tmp_path, seen_at=NETWORK) as of:
        poll(line)
        await shows(of.line)
        assert (await of.client.get("/api/line")).json()["read_only"]
        status, said = await put(of, 1)
        assert (status, "--token-file" in said["what"]) == (403, True)
        assert line.records == []


@pytest.mark.parametrize("seen_at", [HERE, NETWORK])
@pytest.mark.asyncio
async def test_where_there_are_tokens_a_write_shows_one(tmp_path: Path, seen_at: tuple[str, int]) -> None:
    secrets = {"hmi": digest_of(TOKEN)}
    async with served(tmp_path) as line, page(tmp_path, seen_at=seen_at, secrets=secrets) as of:
        poll(line)
        await shows(of.line)
        said = (await of.client.get("/api/line")).json()
        assert (said["read_only"], said["wants_token"]) == (False, True)
        for shown in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": f"Basic {TOKEN}"}):
            assert (await put(of, 1, **shown))[0] == 401
        assert line.records == []
        assert (await put(of, 1, Authorization=f"Bearer {TOKEN}"))[0] == 200
        assert of.writes == [
            "1 failed login at web: 1 from 127.0.0.1",  # the others are reported a minute later
            "5/10 = 1, from token hmi from 127.0.0.1: written",
        ]


@pytest.mark.asyncio
async def test_an_interface_that_is_read_only_and_a_role_that_may_read_write_nothing(tmp_path: Path) -> None:
    async with served(tmp_path) as line, page(tmp_path, read_only=True) as of:
        poll(line)
        await shows(of.line)
        assert (await put(of, 1))[0] == 400
        assert line.records == []


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1", "[::1]"])
@pytest.mark.asyncio
async def test_this_machines_own_names_are_let_in_with_their_origin(tmp_path: Path, host: str) -> None:
    async with page(tmp_path) as of:
        port = of.url.rpartition(":")[2].strip("/")
        headers = {"Host": f"{host}:{port}", "Origin": f"http://{host}:{port}"}
        assert (await of.client.get("/api/line", headers=headers)).status_code == 200


# the stream


async def hear(stream: ClientConnection, *methods: str) -> dict[str, Any]:
    """The bodies of the next of these messages."""
    found: dict[str, Any] = {}
    while set(methods) - set(found):
        said = json.loads(await stream.recv())
        found[said["method"]] = said["body"]
    return found


def stream_of(of: Page) -> connect:
    return connect(f"{of.url.replace('http', 'ws', 1)}api/stream", proxy=None)


@pytest.mark.asyncio
async def test_a_page_that_comes_late_is_told_all_and_then_what_changes(tmp_path: Path) -> None:
    async with served(tmp_path) as line, page(tmp_path) as of:
        poll(line)
        await shows(of.line)
        async with stream_of(of) as stream:
            told = await hear(stream, "state", "rows", "values", "groups", "nodes", "frame", "past")
            assert told["state"]["connected"]
            assert [row["key"] for row in told["rows"]["rows"]] == ["5/10", "5/outputs"]
            assert told["past"]["past"][0]
            await put(of, 7)
            while (await hear(stream, "values"))["values"]["values"][0][0] != 7:
                pass


@pytest.mark.asyncio
async def test_a_page_is_told_the_latest_of_the_past_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(audience, "PAST_VALUES", 2)
    async with served(tmp_path) as line, page(tmp_path) as of:
        poll(line)
        await shows(of.line)
        await until(lambda: len(of.line.picture.rows[0].past) > 3)
        known = [time for time, _ in of.line.picture.rows[0].past]
        async with stream_of(of) as stream:
            past = (await hear(stream, "past"))["past"]["past"][0]
        assert len(past) == 2
        assert past[0][0] >= known[-2]


@pytest.mark.asyncio
async def test_rows_and_past_values_are_those_of_the_owner_that_came_last(tmp_path: Path) -> None:
    """The numbers of the sets of points begin again with each owner; a page shows a past of the set it has alone."""
    async with page(tmp_path) as of:
        for sets in (3, 1):
            async with served(tmp_path) as line:
                poll(line)
                for number in range(1, sets):
                    controller = Hcp2Controller(line.bus, 5)
                    await shows(of.line)
                    line.bus.poll_group(f"more {number}", period=0.02, points=[controller.point(str(20 + number))])
                    await until(lambda: len(of.line.picture.rows) == 1 + len(line.bus.groups))
                await shows(of.line)
                found = set()
                async with stream_of(of) as stream:
                    while (message := json.loads(await stream.recv()))["method"] != "past":
                        if message["method"] == "rows":  # in parts
                            found.add(message["body"]["set"])
                assert found == {message["body"]["set"]}
            await until(lambda: not of.line.is_connected)


@pytest.mark.asyncio
async def test_a_page_is_told_when_the_owner_goes_and_when_it_is_back(tmp_path: Path) -> None:
    async with page(tmp_path) as of, stream_of(of) as stream:
        for _ in range(3):
            async with served(tmp_path) as line:
                poll(line)
                while not (await hear(stream, "state"))["state"]["connected"]:
                    pass
                told = await hear(stream, "rows", "values")
                assert len(told["rows"]["rows"]) == 2
            while (await hear(stream, "state"))["state"]["connected"]:
                pass


@pytest.mark.asyncio
async def test_a_page_is_told_when_the_interfaces_role_is_changed_and_one_that_comes_then_all_else(
    tmp_path: Path,
) -> None:
    async with served(tmp_path) as line, page(tmp_path) as of:
        poll(line)
        await shows(of.line)
        async with stream_of(of) as stream:
            assert not (await hear(stream, "state"))["state"]["read_only"]
            line.authorisation.access = READS
            assert (await hear(stream, "state"))["state"]["read_only"]
            assert (await of.client.get("/api/line")).json()["read_only"]
            await hear(stream, "frame")
        async with stream_of(of) as stream:
            told = await hear(stream, "state", "rows", "frame")
            assert told["state"]["read_only"]
            assert [row["key"] for row in told["rows"]["rows"]] == ["5/10", "5/outputs"]


@pytest.mark.asyncio
async def test_the_wire_is_looked_at_only_while_a_page_wants_it(tmp_path: Path) -> None:
    async with served(tmp_path) as line, page(tmp_path) as of:
        poll(line)
        await shows(of.line)
        assert not tapped(line)
        async with stream_of(of) as one, stream_of(of) as other:
            await one.send('{"exchanges":true}')
            await other.send('{"exchanges":true}')
            told = (await hear(one, "exchanges"))["exchanges"]
            while not told["exchanges"]:
                told = (await hear(one, "exchanges"))["exchanges"]
            assert "ok" in told["exchanges"][0]
            await one.send('{"exchanges":false}')
            await hear(other, "exchanges")
            assert tapped(line)
        await until(lambda: not tapped(line))


@pytest.mark.asyncio
async def test_a_page_stops_and_resumes_the_exchanges(tmp_path: Path) -> None:
    async with served(tmp_path) as line, page(tmp_path) as of, stream_of(of) as stream:
        poll(line)
        await shows(of.line)
        for _ in range(2):
            await stream.send('{"exchanges":true}')
            await until(lambda: tapped(line))
            await stream.send('{"exchanges":false}')
            await until(lambda: not tapped(line))


def tapped(line: Served) -> bool:
    return line.bus._pump.tap is not None


@pytest.mark.asyncio
async def test_the_wire_is_looked_at_again_when_the_owner_is_back(tmp_path: Path) -> None:
    async with page(tmp_path) as of, stream_of(of) as stream:
        await stream.send('{"exchanges":true}')
        for _ in range(2):
            async with served(tmp_path) as line:
                poll(line)
                await hear(stream, "exchanges")
                assert tapped(line)


@pytest.mark.parametrize(("text", "code"), [("{", 1008), ('{"exchanges": 1}', 1008), ("x" * 2000, 1009)])
@pytest.mark.asyncio
async def test_a_page_that_says_anything_else_is_let_go(tmp_path: Path, text: str, code: int) -> None:
    async with page(tmp_path) as of, stream_of(of) as stream:
        await stream.send(text)
        with pytest.raises(ConnectionClosed):
            await hear(stream, "farewell")
        assert stream.close_code == code
        assert (await of.client.get("/api/line")).status_code == 200


@pytest.mark.asyncio
async def test_of_what_a_slow_page_has_not_taken_the_latest_of_each_is_told() -> None:
    seat = Seat()
    for number in range(1000):
        seat.put(("values", 0), f"values {number}")
        seat.put(("frame", 0), f"frame {number}")
        seat.put_exchanges(f"exchanges {number}")
    texts = await seat.take()
    assert texts[-3:-1] == ["values 999", "frame 999"]
    assert len(texts) == 2 + MOST_EXCHANGES
    waiting = asyncio.ensure_future(seat.take())
    await asyncio.sleep(0)
    assert not waiting.done()
    seat.put(("frame", 0), "frame")
    assert await waiting == ["frame"]


# the line beside it


@pytest.mark.slow
@pytest.mark.asyncio
async def test_interfaces_with_pages_that_come_and_go_leave_nothing_with_the_line(tmp_path: Path) -> None:
    async with served(tmp_path) as line:
        poll(line)
        for _ in range(20):
            async with page(tmp_path) as of, stream_of(of) as stream:
                await stream.send('{"exchanges":true}')
                await hear(stream, "state", "rows")
        await assert_goes_on_alone(line)


@pytest.mark.asyncio
async def test_a_port_that_is_taken_is_one_sentence() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as taken,
        pytest.raises(InvalidCommand, match="is in use by another program"),
    ):
        async with serving(None, taken.getsockname()):
            pass


@pytest.mark.skipif(not has_ipv6(), reason="this machine has no IPv6")
@pytest.mark.asyncio
async def test_the_url_of_an_ipv6_address_can_be_opened() -> None:
    line = connected(Remote())
    listen = ("::1", 0)
    async with serving(application(line, Guard(listen, {})), listen) as url:
        assert url.startswith("http://[::1]:")
        async with httpx.AsyncClient(base_url=url, timeout=PATIENCE, trust_env=False) as client:
            assert (await client.get("/api/line")).status_code == 200


@pytest.mark.asyncio
async def test_a_role_of_the_line_holds_for_its_page(tmp_path: Path) -> None:
    access = Access(users={os.getuid(): Permission("this user", Role.READ)})
    async with served(tmp_path, access=access) as line, page(tmp_path) as of:
        poll(line)
        await shows(of.line)
        assert (await of.client.get("/api/line")).json()["read_only"]
        status, said = await put(of, 1)
        assert (status, "may read this line, but not write" in said["what"]) == (400, True)
        assert line.audit() == [("5/10", "refused")]


@pytest.mark.asyncio
async def test_a_request_with_two_lengths_is_refused_and_its_connection_closed(tmp_path: Path) -> None:
    """A server before this one may take what follows for another request."""
    async with page(tmp_path) as of:
        host = of.url.removeprefix("http://").strip("/")
        reader, writer = await asyncio.open_connection(*host.split(":"))
        lengths = "Content-Length: 5\r\nTransfer-Encoding: chunked\r\n"
        smuggled = f"GET /openapi.json HTTP/1.1\r\nHost: {host}\r\n\r\n"
        writer.write(f"PUT {ONE} HTTP/1.1\r\nHost: {host}\r\n{lengths}\r\n0\r\n\r\n{smuggled}".encode())
        async with asyncio.timeout(PATIENCE):
            answer = (await reader.read()).decode()
        writer.close()
        assert answer.startswith("HTTP/1.1 400 ")
        assert "connection: close" in answer.lower()
        assert answer.count("HTTP/1.1") == 1
        assert "must not have both" in answer


# without a server, beside an owner that the test plays


class Overview:
    """What an owner knows of its points, and what becomes of writes to them."""

    def __init__(self) -> None:
        self.writes: list[tuple[str, str, Any]] = []
        self.error: Exception | None = None

    async def details(self, _group: str, key: str) -> dict[str, Any]:
        return {"command": f"read {key}"}

    async def write(self, *what: Any) -> None:
        self.writes.append(what)
        if self.error is not None:
            raise self.error


class Local:
    """The page of a line whose owner the test plays, requested without a connection."""

    def __init__(self, *rows: Row, secrets: dict[str, bytes] | None = None, history: Past | None = None) -> None:
        self.overview = Overview()
        self.line = connected(Remote())
        self.line._overview = cast("Any", self.overview)
        self.line.picture._rows = {0: list(rows or (row(value=7, writable=True),))}
        self.line.picture.frame = shown_frame(events=((90.0, "winder is down"),))
        self.reports: list[str] = []
        self.application = application(self.line, Guard(HERE, secrets or {}), self.reports.append, history)
        self.client = self.client_at("127.0.0.1")

    def client_at(self, address: str) -> httpx.AsyncClient:
        transport = httpx.ASGITransport(app=self.application, client=(address, 50_000))
        return httpx.AsyncClient(transport=transport, base_url="http://localhost")

    async def get(self, path: str) -> Any:
        answer = await self.client.get(f"/api/{path}")
        assert answer.status_code == 200, answer.text
        return answer.json()

    async def put(self, body: bytes = b'{"value": 1}', **headers: str) -> httpx.Response:
        headers = {"content-type": "application/json"} | {key.replace("_", "-"): text for key, text in headers.items()}
        return await self.client.put("/api/points/axes/winder/10", content=body, headers=headers)


@pytest.mark.asyncio
async def test_times_of_the_line_are_times_of_day_and_none_while_they_are_unknown(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(following, "time", SimpleNamespace(time=lambda: 1000.0))
    of = Local(row(value=7, asked=95.0), row(item="11", asked=None, quality=""))
    of.line.picture.rows[0].past.append((94.0, 6))
    assert await of.get("events") == [{"time": 990.0, "text": "winder is down"}]
    assert [one["time"] for one in await of.get("points")] == [995.0, None]
    one = await of.get("points/axes/winder/10")
    assert (one["past"], one["details"]) == ([[994.0, 6]], {"command": "read winder/10"})
    assert (await of.get("line"))["since"] is None
    of.line.picture.frame = shown_frame(state="offline", why="unplugged", since=80.0)
    said = await of.get("line")
    assert (said["connected"], said["since"], said["why"]) == (True, 980.0, "unplugged")
    assert not {"events", "why", "since"} & said["frame"].keys(), "no time of the line's own clock"
    of.line._remote = None
    assert [one["time"] for one in await of.get("points")] == [None, None]
    of.line.state = Lost("gone", since=900.0)
    said = await of.get("line")
    assert (said["connected"], said["since"], said["why"]) == (False, 900.0, "gone")


@pytest.mark.asyncio
async def test_a_point_is_current_while_its_quality_is_and_its_group_has_cycles() -> None:
    rows = {
        "good": row(asked=99.5),
        "late": row(asked=99.5, quality="late"),
        "of a paused group": row(asked=98.9),
        "stale": row(asked=99.5, quality="stale"),
        "bad": row(asked=99.5, quality="bad", error="no reply"),
        "not read yet": row(asked=None, quality=""),
    }
    of = Local(*rows.values())
    told = [one["current"] for one in await of.get("points")]
    assert {name for name, current in zip(rows, told, strict=True) if current} == {"good", "late"}
    of.line._remote = None  # the owner is away
    assert not any(one["current"] for one in await of.get("points"))


@pytest.mark.parametrize(
    ("method", "path", "allowed"),
    [
        ("POST", "/api/points/axes/winder/10", {"GET", "HEAD", "PUT"}),
        ("PUT", "/api/line", {"GET", "HEAD"}),
        ("POST", "/page/page.js", {"GET", "HEAD"}),
    ],
)
@pytest.mark.asyncio
async def test_another_method_is_refused_with_those_that_there_are(method: str, path: str, allowed: set[str]) -> None:
    answer = await Local().client.request(method, path)
    assert (answer.status_code, answer.json()["error"]) == (405, "NotServed")
    assert set(answer.headers["allow"].split(", ")) == allowed


@pytest.mark.asyncio
async def test_a_point_of_two_groups_is_found_by_its_group() -> None:
    of = Local(row(value=7), row(group="slow", value=8))
    assert [(await of.get(f"points/{group}/winder/10"))["value"] for group in ("axes", "slow")] == [7, 8]


@pytest.mark.parametrize(
    ("of_owner", "of_interface", "read_only"), [(False, False, False), (True, False, True), (False, True, True)]
)
@pytest.mark.asyncio
async def test_it_is_read_only_if_its_owner_or_the_interface_is(
    of_owner: bool, of_interface: bool, read_only: bool
) -> None:
    of = Local()
    of.line.picture.frame = shown_frame(read_only=of_owner)
    of.line._read_only = of_interface
    assert (await of.get("line"))["read_only"] is read_only


@pytest.mark.parametrize(
    ("body", "kind", "status"),
    [
        (b'{"value": 1}', "application/json; charset=utf-8", 200),
        (b'{"value": 1}', "Application/JSON", 200),
        (b'{"value": 1}'.ljust(LONGEST_COMMAND), "application/json", 200),
        (b'{"value": 1}'.ljust(LONGEST_COMMAND + 1), "application/json", 413),
        (b'{"value": true}', "application/json", 200),
        (b'{"value": "jog"}', "application/json", 200),
        (b'{"value": 1, "more": 2}', "application/json", 400),
        (b'["value"]', "application/json", 400),
    ],
)
@pytest.mark.asyncio
async def test_a_body_is_a_value_as_json_of_at_most_its_bound(body: bytes, kind: str, status: int) -> None:
    of = Local()
    assert (await of.put(body, content_type=kind)).status_code == status
    assert len(of.overview.writes) == (status == 200)


@pytest.mark.asyncio
async def test_the_parts_of_a_body_are_within_its_bound_together() -> None:
    async def parts() -> AsyncIterator[bytes]:
        yield b'{"value":'
        yield b" " * (LONGEST_COMMAND - 10)
        yield b"1}"

    of = Local()
    headers = {"content-type": "application/json"}
    answer = await of.client.put("/api/points/axes/winder/10", content=parts(), headers=headers)
    assert answer.status_code == 413
    assert of.overview.writes == []


@pytest.mark.asyncio
async def test_points_are_not_known_in_the_moment_in_which_the_owner_is_found() -> None:
    of = Local()
    of.line.picture.frame = None
    answer = await of.client.get("/api/points/axes/winder/10")
    assert answer.status_code == 503
    assert "not known yet: its program was found a moment ago" in answer.json()["what"]
    assert await of.get("events") == []
    said = await of.get("line")
    assert (said["connected"], said["since"], said["frame"]) == (True, None, None)


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (InvalidCommand("above its maximum"), 400),
        (Refused("refused"), 409),
        (BacklogFull("full"), 503),
        (NotStarted("busy"), 503),
        (LineDown("lost"), 503),
        (BusClosed("closed"), 503),
        (NoReply("no reply"), 504),
        (GarbledReply("garbled"), 502),
    ],
)
@pytest.mark.asyncio
async def test_a_write_that_fails_has_the_status_of_its_error_and_is_reported(error: Exception, status: int) -> None:
    of = Local()
    of.overview.error = error
    answer = await of.put()
    assert (answer.status_code, answer.json()["error"]) == (status, type(error).__name__)
    assert answer.json()["what"] == str(error)
    assert of.reports == [f"winder/10 = 1, from a page from 127.0.0.1: {error}"]


@pytest.mark.asyncio
async def test_who_guesses_tokens_is_told_how_many_whole_seconds_to_wait() -> None:
    of = Local(secrets={"hmi": digest_of(TOKEN)})
    said = await of.get("line")
    assert (said["wants_token"], said["read_only"], said["history"]) == (True, False, False)
    assert (await of.put()).status_code == 401
    for _ in range(100):
        answer = await of.put(authorization="Bearer wrong")
        if answer.status_code != 401:
            break
    assert answer.status_code == 429
    assert int(answer.headers["retry-after"]) >= 1
    assert of.overview.writes == []
    assert (await of.put(authorization=f"Bearer {TOKEN}")).status_code == 429
    of = Local(secrets={"hmi": digest_of(TOKEN)})
    assert (await of.put(authorization=f"Bearer {TOKEN}")).status_code == 200
    assert of.reports == ["winder/10 = 1, from token hmi from 127.0.0.1: written"]


@pytest.mark.asyncio
async def test_a_write_without_a_token_is_no_failed_login() -> None:
    of = Local(secrets={"hmi": digest_of(TOKEN)})
    for _ in range(100):
        assert (await of.put()).status_code == 401
    assert (await of.put(authorization=f"Bearer {TOKEN}")).status_code == 200
    assert of.reports == ["winder/10 = 1, from token hmi from 127.0.0.1: written"]


@pytest.mark.asyncio
async def test_who_waits_as_long_as_the_reply_advises_can_log_in(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [1000.0]
    monkeypatch.setattr(web, "time", SimpleNamespace(monotonic=lambda: now[0], time=time.time))
    of = Local(secrets={"hmi": digest_of(TOKEN)})
    while (await of.put(authorization="Bearer wrong")).status_code == 401:
        pass
    now[0] += 0.25
    answer = await of.put(authorization=f"Bearer {TOKEN}")
    assert answer.status_code == 429
    now[0] += int(answer.headers["retry-after"])
    assert (await of.put(authorization=f"Bearer {TOKEN}")).status_code == 200


@pytest.mark.asyncio
async def test_a_client_that_guesses_tokens_does_not_lock_out_another_address() -> None:
    of = Local(secrets={"hmi": digest_of(TOKEN)})
    while (await of.put(authorization="Bearer wrong")).status_code == 401:
        pass
    assert (await of.put(authorization=f"Bearer {TOKEN}")).status_code == 429
    of.client = of.client_at("10.0.0.2")
    assert (await of.put(authorization=f"Bearer {TOKEN}")).status_code == 200
    assert of.reports[-1] == "winder/10 = 1, from token hmi from 10.0.0.2: written"


@pytest.mark.asyncio
async def test_the_first_and_the_last_time_and_the_least_number_of_samples_can_be_requested() -> None:
    past = Past()
    of = Local(history=past)
    found = await of.get("history/axes/winder/10?from=0&to=100000000000&limit=1")
    assert past.requests == [("winder/10", "", 0.0, 1e11, 1)]
    assert (found["from"], found["to"]) == (0.0, 1e11)


@pytest.mark.asyncio
async def test_history_is_requested_in_the_unit_of_the_point_for_the_last_hour_unless_it_has_a_range() -> None:
    past = Past(History(labels=(("1", "jog"),)))
    of = Local(row(unit="mm"), history=past)
    before = time.time()
    found = await of.get("history/axes/winder/10?limit=10000")
    [(key, unit, begin, end, limit)] = past.requests
    assert (key, unit, limit) == ("winder/10", "mm", 10_000)
    assert end - begin == pytest.approx(3600)
    assert before <= end <= time.time()
    assert (found["unit"], found["labels"]) == ("mm", {"1": "jog"})
    assert (await of.get("line"))["history"]


@pytest.mark.asyncio
async def test_pages_beyond_the_bound_are_refused_until_another_one_has_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(web, "MOST_PAGES", 1)
    async with page(tmp_path) as of:
        for _ in range(2):
            stream = await joined(of)
            await hear(stream, "state")
            with pytest.raises(InvalidStatus, match="403"):
                await stream_of(of)
            await stream.close()


@pytest.mark.asyncio
async def test_a_page_that_has_left_leaves_no_task(tmp_path: Path) -> None:
    async with page(tmp_path) as of:
        await of.client.get("/api/line")
        before = len(asyncio.all_tasks())
        async with stream_of(of) as stream:
            await hear(stream, "state")
        await until(lambda: len(asyncio.all_tasks()) <= before)


@pytest.mark.asyncio
async def test_the_server_ends_though_a_reply_is_not_ready_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web, "CLOSE_WITHIN", 0.01)
    past = Past()
    past.held.clear()
    of = Local(history=past)
    try:
        async with (
            asyncio.timeout(PATIENCE),
            serving(of.application, HERE) as url,
            httpx.AsyncClient(base_url=url, timeout=PATIENCE, trust_env=False) as client,
        ):
            waiting = asyncio.ensure_future(client.get("/api/history/axes/winder/10"))
            await until(lambda: past.requests)
        await asyncio.gather(waiting, return_exceptions=True)
    finally:
        past.held.set()


async def joined(of: Page) -> ClientConnection:
    """A page's stream, as soon as there is a place for it."""
    while True:
        try:
            return await stream_of(of)
        except InvalidStatus:
            await asyncio.sleep(0.001)


@pytest.mark.asyncio
async def test_the_page_of_a_proxy_is_served_with_its_history_and_its_writes_are_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    crowds: list[Any] = []

    def crowd(report: Any) -> Crowd:
        crowds.append(report)
        return Crowd(report)

    monkeypatch.setattr(web, "Crowd", crowd)
    line = connected(Remote())
    line._overview = cast("Any", Overview())
    line.picture._rows = {0: [row(value=7, writable=True)]}
    line.picture.frame = shown_frame()
    urls: asyncio.Queue[str] = asyncio.Queue()
    reports: list[str] = []

    async def follow() -> None:
        await asyncio.Event().wait()

    line.follow = follow  # type: ignore[method-assign,assignment]  # replaced here
    secrets = {"hmi": digest_of(TOKEN)}
    serving_it = asyncio.ensure_future(
        web.serve(line, HERE, secrets, ("plant.example",), urls.put_nowait, reports.append, Past())
    )
    async with httpx.AsyncClient(base_url=await urls.get(), timeout=PATIENCE, trust_env=False) as client:
        headers = {"Host": "plant.example", "Authorization": f"Bearer {TOKEN}"}
        answer = await client.get("/api/line", headers=headers)
        assert (answer.status_code, answer.json()["history"]) == (200, True)
        assert "server" not in answer.headers
        spoofed = {**headers, "X-Forwarded-For": "10.0.0.9"}  # a client can name any address
        answer = await client.put("/api/points/axes/winder/10", json={"value": 1}, headers=spoofed)
        assert answer.status_code == 200
        answer = await client.get("/page/page.js")
        assert answer.status_code == 200
    assert reports == ["winder/10 = 1, from token hmi from 127.0.0.1: written"]
    assert crowds == [reports.append], "connections that are closed are reported, too"
    serving_it.cancel()
    await asyncio.gather(serving_it, return_exceptions=True)

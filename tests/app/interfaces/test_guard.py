"""Which requests the guard of the page accepts, and who may write, without a server."""

from __future__ import annotations

from typing import Any

import pytest

from busmaster.app.interfaces.guard import BOTH_LENGTHS, HEADERS, Guard, Guarded
from busmaster.app.service.permission import digest_of

HERE = ("127.0.0.1", 8420)
NETWORK = ("192.0.2.7", 8420)
PROXY = ("Plant.example",)
TOKEN = "0123456789abcdef"
SECRETS = {"hmi": digest_of(TOKEN)}
CROSS = {"sec-fetch-site": "cross-site"}


@pytest.mark.parametrize(
    ("listen", "hosts", "headers", "why"),
    [
        (HERE, (), {"host": "127.0.0.1:8420"}, ""),
        (HERE, (), {"host": "localhost"}, ""),
        (HERE, (), {"host": "[::1]:8420"}, ""),
        (HERE, (), {"host": "192.0.2.7:8420"}, "no such host"),
        (HERE, (), {}, "no such host"),
        (HERE, PROXY, {"host": "plant.EXAMPLE"}, ""),
        (HERE, PROXY, {"host": "plant.example:443", "origin": "https://plant.example:443"}, ""),
        (HERE, PROXY, {"host": "other.example"}, "name it with --host"),
        (NETWORK, (), {"host": "192.0.2.7:8420"}, ""),
        (NETWORK, (), {"host": "[2001:db8::7]:8420"}, ""),
        (NETWORK, (), {"host": "evil.example"}, "no such host"),
        (HERE, (), {"host": "localhost", "origin": ""}, "another site"),
        (HERE, (), {"host": "localhost", "origin": "http://localhost"}, ""),
        (HERE, (), {"host": "localhost", "origin": "http://localhost:1"}, "another site's page are not accepted"),
        (HERE, (), {"host": "localhost", **CROSS}, "another site's page may not come here"),
        (HERE, (), {"host": "localhost", **CROSS, "sec-fetch-mode": "navigate"}, ""),  # a link on it may lead here
        (HERE, (), {"host": "localhost", "sec-fetch-site": "same-origin", "sec-fetch-mode": "cors"}, ""),
        (HERE, (), {"host": "localhost", "transfer-encoding": "chunked"}, ""),
        (HERE, (), {"host": "localhost", "transfer-encoding": "chunked", "content-length": "5"}, BOTH_LENGTHS),
    ],
)
def test_a_request_is_accepted_by_its_host_and_origin(
    listen: tuple[str, int], hosts: tuple[str, ...], headers: dict[str, str], why: str
) -> None:
    refusal = Guard(listen, {}, hosts).refusal(headers)
    if why:
        assert why in refusal
    else:
        assert refusal == ""


@pytest.mark.parametrize("headers", [{"host": 1000 * "x"}, {"host": "localhost", "origin": "http://" + 1000 * "x"}])
def test_a_refusal_has_only_the_beginning_of_what_was_sent(headers: dict[str, str]) -> None:
    assert 60 < len(Guard(HERE, {}).refusal(headers)) < 200


@pytest.mark.parametrize(
    ("listen", "hosts", "secrets", "authorization", "writer"),
    [
        (HERE, (), {}, "", ""),
        (HERE, PROXY, {}, "", None),  # anyone who reaches the proxy would write
        (NETWORK, (), {}, "", None),
        (NETWORK, (), {}, f"Bearer {TOKEN}", None),
        (HERE, (), SECRETS, "", None),
        (HERE, (), SECRETS, f"Bearer {TOKEN}", "hmi"),
        (NETWORK, PROXY, SECRETS, f"bearer  {TOKEN} ", "hmi"),
        (HERE, (), SECRETS, f"Basic {TOKEN}", None),
        (HERE, (), SECRETS, "Bearer wrong", None),
        (HERE, (), SECRETS, TOKEN, None),
    ],
)
def test_who_may_write_is_known_by_its_token_where_others_can_come(
    listen: tuple[str, int], hosts: tuple[str, ...], secrets: dict[str, bytes], authorization: str, writer: str | None
) -> None:
    guard = Guard(listen, secrets, hosts)
    assert guard.writer({"authorization": authorization} if authorization else {}) == writer
    assert guard.wants_token is bool(secrets)
    assert guard.lets_write is (bool(secrets) or writer == "")


async def replied(kind: str, *headers: tuple[bytes, bytes]) -> list[dict[str, Any]]:
    """The messages of a guarded application for a request with these headers."""
    sent: list[dict[str, Any]] = []

    async def application(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": [(b"own", b"1")]})

    async def send(message: dict[str, Any]) -> None:
        sent.append(message)

    scope = {"type": kind, "method": "GET", "path": "/", "headers": headers}
    await Guarded(application, Guard(HERE, {}))(scope, None, send)
    return sent


@pytest.mark.asyncio
async def test_every_reply_has_the_headers_and_a_refusal_its_status() -> None:
    host = (b"Host", b"localhost")
    [accepted] = await replied("http", host)
    assert accepted["headers"] == [(b"own", b"1"), *HEADERS]
    foreign = await replied("http", (b"host", b"evil.example"))
    assert foreign[0]["status"] == 403
    assert set(HEADERS) <= set(foreign[0]["headers"])
    assert b"connection" not in dict(foreign[0]["headers"])
    assert b"no such host: 'evil.example'" in foreign[1]["body"]
    twice = await replied("http", host, (b"Content-Length", b"5"), (b"transfer-encoding", b"chunked"))
    assert (twice[0]["status"], dict(twice[0]["headers"])[b"connection"]) == (400, b"close")
    assert await replied("websocket", (b"host", b"evil.example")) == [{"type": "websocket.close"}]
    assert (await replied("lifespan"))[0]["headers"] == [(b"own", b"1")]


def test_the_headers_keep_other_content_and_frames_out_and_nothing_stale_in() -> None:
    headers = {name.decode(): value.decode() for name, value in HEADERS}
    policy = {part.strip() for part in headers.pop("content-security-policy").split(";")}
    assert policy == {"default-src 'self'", "frame-ancestors 'none'", "base-uri 'none'", "form-action 'none'"}
    assert headers == {
        "x-content-type-options": "nosniff",
        "referrer-policy": "no-referrer",
        "cross-origin-resource-policy": "same-origin",
        "cache-control": "no-cache",
    }


@pytest.mark.asyncio
@pytest.mark.parametrize("hosts", [(b"localhost", b"evil.example"), (b"evil.example", b"localhost")])
async def test_a_request_with_two_hosts_is_refused(hosts: tuple[bytes, bytes]) -> None:
    sent = await replied("http", *((b"host", host) for host in hosts))
    assert sent[0]["status"] == 403

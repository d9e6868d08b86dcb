"""Who may come to a page: no other site's page may read or write through a browser that can reach this one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from starlette.responses import PlainTextResponse

from busmaster.app.service.permission import Access
from busmaster.app.service.tcp import HostPort, is_loopback, is_our_name

HEADERS = (
    (b"content-security-policy", b"default-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cache-control", b"no-cache"),
)
"""Headers of all replies: no content from elsewhere runs in the page, and no other page shows it in a frame."""


BOTH_LENGTHS = "a request must not have both a Content-Length and a Transfer-Encoding"


class Guard:
    """Decides which requests are accepted: by Host and Origin, and by tokens if there are any.

    If other machines can connect, a write needs a token. `secrets` are the digests of tokens by name. `hosts` are the
    names under which a proxy passes requests on. Any client of the proxy uses these, so a write needs a token then.
    """

    def __init__(self, listen: HostPort, secrets: Mapping[str, bytes], hosts: Iterable[str] = ()) -> None:
        self._listen = listen
        self._hosts = frozenset(host.lower() for host in hosts)
        self._access = Access(secrets=secrets)

    @property
    def wants_token(self) -> bool:
        """Return whether a write needs a token."""
        return bool(self._access.secrets)

    @property
    def lets_write(self) -> bool:
        """Return whether writes are possible here, with a token or without."""
        return self.wants_token or (is_loopback(self._listen[0]) and not self._hosts)

    def refusal(self, headers: Mapping[str, str]) -> str:
        """Return why a request is refused, "" if it is not: the name must be ours, and the page must not be of
        another site.

        The Host or Origin shows a page of another site, or one whose name was redirected to this address. A program
        that is not a browser sends no Origin.
        """
        if "transfer-encoding" in headers and "content-length" in headers:
            # Two servers in a row may not agree where such a request ends (RFC 9112, 6.3): no client of ours sends it.
            return BOTH_LENGTHS
        host = headers.get("host", "")
        if not (host.partition(":")[0].lower() in self._hosts or self._is_our_name(host)):
            return f"no such host: {host[:60]!r}; of a proxy, name it with --host"
        origin = headers.get("origin")
        if origin is not None and origin.partition("://")[2] != host:
            return f"requests of another site's page are not accepted: {origin[:60]!r}"
        if headers.get("sec-fetch-site", "same-origin") == "cross-site" and headers.get("sec-fetch-mode") != "navigate":
            return "another site's page may not come here"
        return ""

    def _is_our_name(self, host: str) -> bool:
        """Return whether a Host header names us: where only this machine can come, as it calls itself."""
        if not is_loopback(self._listen[0]):
            return is_our_name(host, self._listen)
        name = host.rpartition("]")[0].lstrip("[") if host.startswith("[") else host.partition(":")[0]
        return is_loopback(name)

    def writer(self, headers: Mapping[str, str]) -> str | None:
        """Return who it is that may write: the name of its token, or "" where none is needed; None for who may not."""
        if not self.wants_token:
            return "" if self.lets_write else None
        kind, _, secret = headers.get("authorization", "").partition(" ")
        return self._access.token_name(secret.strip()) if kind.lower() == "bearer" else None


class Guarded:
    """An application whose guard rejects requests. All of its replies have `HEADERS`."""

    def __init__(self, application: Any, guard: Guard) -> None:
        self._application = application
        self._guard = guard

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Reply to one request, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._application(scope, receive, send)
            return

        async def send_with_headers(message: Any) -> None:
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message.get("headers", ()), *HEADERS]}
            await send(message)

        refusal = self._guard.refusal(_headers(scope))
        closing = {"connection": "close"} if refusal == BOTH_LENGTHS else {}
        if refusal and scope["type"] == "websocket":
            await send({"type": "websocket.close"})  # before it was accepted: it is refused with 403
        elif refusal:
            await PlainTextResponse(f"{refusal}\n", 400 if closing else 403, closing)(scope, receive, send_with_headers)
        else:
            await self._application(scope, receive, send_with_headers)


def _headers(scope: Any) -> dict[str, str]:
    """Return the headers; of one that is there twice, what no rule lets through."""
    found: dict[str, str] = {}
    for name, value in scope["headers"]:
        key = name.decode("latin-1").lower()
        found[key] = f"{found[key]}, {value.decode('latin-1')}" if key in found else value.decode("latin-1")
    return found

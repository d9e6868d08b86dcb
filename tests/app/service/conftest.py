"""Every message between a RemoteBus and an owner in these tests is one of docs/service.schema.json."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from busmaster.app.service import link
from tests.app.service import schema
from tests.patience import PATIENCE

HELLO = 0


@pytest.fixture(autouse=True)
def _unhurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine may take longer over a write than that is fresh: a test that asks for just this says its age."""
    for interface in ("busmaster.app.service.client_requests", "busmaster.app.service.authorisation"):
        monkeypatch.setattr(f"{interface}.FRESH", PATIENCE)
    monkeypatch.setattr("busmaster.app.service.remote_overview.SOON", PATIENCE)


@pytest.fixture(autouse=True)
def _by_the_schema(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Check the messages of every RemoteBus and its owner. Those that a test writes itself are not checked."""
    wrong: list[str] = []
    methods: dict[tuple[link.Link, int], str] = {}
    passes, receive = link.Link._passes, link.Link.received

    def note(check: Callable[[Any], None], message: Any) -> None:
        try:
            check(message)
        except schema.ValidationError as error:
            wrong.append(f"{message!r:.400}: {error.message:.400}")

    def checked_passes(self: link.Link, encoded: bytes) -> bool:
        message = json.loads(encoded)
        note(schema.check_program, message)
        if "id" in message:
            methods[self, message["id"]] = message["method"]
        return passes(self, encoded)

    def checked_receive(self: link.Link, text: str | bytes) -> None:
        message = json.loads(text)
        note(schema.check_owner, message)
        number = message.get("id")
        if number is not None and "result" in message:
            method = "hello" if number == HELLO else methods[self, number]
            note(lambda result: schema.check_result(method, result), message["result"])
        receive(self, text)

    monkeypatch.setattr(link.Link, "_passes", checked_passes)
    monkeypatch.setattr(link.Link, "received", checked_receive)
    yield
    assert not wrong

"""Every message that programs and owners exchange in these tests is one of docs/service.schema.json."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import pytest

from busmaster.app.service import link
from busmaster.app.service.messages import numbered, written
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
    """Hold what both sides say against the schema. What a test says by hand, rightly or not, is not held."""
    wrong: list[str] = []
    asked: dict[tuple[link.Link, int], str] = {}
    put, take = link.Link.put, link.Link._take

    def note(check: Callable[[Any], None], said: Any) -> None:
        try:
            check(said)
        except schema.ValidationError as error:
            wrong.append(f"{said!r:.400}: {error.message:.400}")

    def asked_for(self: link.Link, question: str, *arguments: Any, **options: Any) -> link.PendingRequest:
        request = put(self, question, *arguments, **options)
        asked[self, request.number] = schema.heard(numbered(question, request.number))["method"]
        return request

    def checked(text: str) -> str:
        note(schema.check_program, schema.heard(text))
        return text

    def receive(self: link.Link, said: Mapping[str, Any]) -> None:
        note(schema.check_owner, said)
        number = said.get("id")
        if number is not None and "result" in said:
            method = "hello" if number == HELLO else asked[self, number]
            note(lambda result: schema.check_result(method, result), said["result"])
        take(self, said)

    monkeypatch.setattr(link.Link, "put", asked_for)
    monkeypatch.setattr(link.Link, "_take", receive)
    monkeypatch.setattr("busmaster.app.service.link.written", lambda message: checked(written(message)))
    monkeypatch.setattr(
        "busmaster.app.service.link.numbered", lambda question, number: checked(numbered(question, number))
    )
    yield
    assert not wrong

"""The client's end of a connection, without a socket: the order of its messages, and how each request ends."""

from __future__ import annotations

import asyncio
import errno
import json
from types import SimpleNamespace
from typing import Any

import pytest

from busmaster import Bus, BusError, Hcp2Controller, MemoryPort, NoReply
from busmaster.app.service import link as links
from busmaster.app.service.client_messages import NoParams, StreamParams
from busmaster.app.service.link import GRACE, Link, PendingRequest
from busmaster.emulator.line import Line
from busmaster.errors import BusClosed, InvalidCommand, LineDown, NotStarted, WriteUnconfirmed
from busmaster.protocols.hcp2 import codec as hcp2
from tests.app.service.lines import until
from tests.stories import in_virtual_time

NODE = Hcp2Controller(Bus(MemoryPort(Line(Hcp2Controller.profile.line))), 5).node
READ = hcp2.Read(1)


@pytest.fixture(autouse=True)
def _by_the_schema() -> None:
    """Check nothing: the messages are those of this file, and some of them are invalid."""


class Way:
    """A connection that keeps its messages."""

    status, complaint, close_reason = None, None, ""

    def __init__(self) -> None:
        self.full = False
        self.sent: list[dict[str, Any]] = []
        self.owner_ended = False
        self.is_closed = self.is_over = False

    def send(self, message: bytes) -> None:
        self.sent.append(json.loads(message))

    def close(self) -> None:
        self.is_closed = True

    async def closed(self) -> None:
        assert self.is_closed
        self.is_over = True

    @property
    def methods(self) -> list[str]:
        """The methods of the messages; of a cancellation with the number of its request."""
        return [f"{one['method']}{one['params'].get('id', '')}" for one in self.sent]


class Opened:
    """A link that is connected by this way."""

    def __init__(self) -> None:
        self.notified: list[tuple[str, Any]] = []
        self.lost = 0
        self.way = Way()
        self.link = Link("unix:/a.sock", None, lambda *message: self.notified.append(message), self._lost)
        self.link._connection = self.way  # type: ignore[assignment]  # as much of one as a link uses
        self.link.opened()

    def _lost(self) -> None:
        self.lost += 1

    def ask(self, method: str = "now", **more: Any) -> PendingRequest:
        return self.link.ask(method, NoParams(), **more)

    def reply(self, number: int, result: object) -> None:
        self.link.received(json.dumps({"jsonrpc": "2.0", "id": number, "result": result}))


@in_virtual_time
async def test_messages_wait_for_a_full_connection_and_are_then_sent_in_their_order() -> None:
    opened = Opened()
    link, way = opened.link, opened.way
    way.full = True
    first = opened.ask("now")
    link.notify("end", StreamParams(7))
    given_up, last = opened.ask("statistics"), opened.ask("groups")
    waiting = asyncio.ensure_future(link.answer(given_up))
    await asyncio.sleep(0)
    waiting.cancel()
    await asyncio.gather(waiting, return_exceptions=True)
    assert (way.sent, first.handed, last.handed) == ([], False, False)
    way.full = False
    link.notify("end", StreamParams(8))  # behind the others
    assert way.sent == []
    link.writable()
    assert way.methods == ["now", "end", "groups", "end"]
    assert (first.handed, given_up.handed, last.handed) == (True, False, True)
    way.full = True
    opened.ask("now")
    opened.ask("now")
    way.send = lambda message: setattr(way, "full", True)  # type: ignore[method-assign]  # it is full again at once
    way.full = False
    link.writable()
    assert len(link._waiting) == 1


@in_virtual_time
async def test_a_request_that_is_cancelled_is_cancelled_at_the_line_unless_it_has_ended() -> None:
    opened = Opened()
    handed, ended = opened.ask(), opened.ask()
    opened.reply(ended.number, 5.0)
    for pending in (handed, ended):
        opened.link._drop(pending)
        opened.link._drop(pending)
    assert opened.way.methods == ["now", "now", f"cancel{handed.number}"]
    assert await opened.link.answer(ended) == 5.0
    awaited = opened.ask()
    waiting = asyncio.ensure_future(opened.link.answer(awaited))
    await asyncio.sleep(0)
    waiting.cancel()
    await asyncio.gather(waiting, return_exceptions=True)
    assert opened.way.methods[3:] == ["now", f"cancel{awaited.number}"]
    opened.reply(handed.number, 6.0)  # on its way already, and ignored
    opened.reply(4711, 6.0)
    assert opened.lost == 0


@pytest.mark.parametrize("safe_only", [False, True])
def test_the_first_message_names_the_program_whatever_was_sent_before(
    safe_only: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    @in_virtual_time
    async def run() -> None:
        way = Way()
        link = Link("unix:/a.sock", None, lambda *_: None, lambda: None, safe_only=safe_only)

        async def create(_: object, where: str) -> None:
            assert where == "/a.sock"
            link._connection = way  # type: ignore[assignment]  # as much of one as a link uses
            link.opened()

        monkeypatch.setattr(asyncio.get_running_loop(), "create_unix_connection", create)
        link.notify("end", StreamParams(7))
        opening = asyncio.ensure_future(link.open("mine"))
        await until(lambda: way.sent)
        assert way.methods == ["hello", "end"]
        assert way.sent[0]["id"] == 0
        given = {"versions": [3], "program": "mine"}
        assert way.sent[0]["params"] == ({**given, "safe_only": True} if safe_only else given)
        opening.cancel()
        with pytest.raises(asyncio.CancelledError):
            await opening
        assert way.is_over

    run()


@in_virtual_time
async def test_a_reply_after_the_end_of_its_request_is_ignored_and_its_number_forgotten() -> None:
    opened = Opened()
    pending = opened.ask()
    pending.future.cancel()
    opened.reply(pending.number, 5.0)
    assert opened.link._pending == {}
    assert opened.lost == 0


@in_virtual_time
async def test_a_request_ends_a_little_after_its_time_if_the_owner_does_not_reply() -> None:
    opened = Opened()
    loop = asyncio.get_running_loop()
    began = loop.time()
    late = opened.ask(node=NODE, command=READ)
    with pytest.raises(NoReply, match="the time of the request is over") as caught:
        await opened.link.answer(late, 1.0)
    assert loop.time() - began == pytest.approx(1.0 + GRACE)
    assert (caught.value.label, caught.value.command) == ("node 5", str(READ))
    assert caught.value.hint == "check whether that program is running"
    assert opened.way.methods == ["now", f"cancel{late.number}"]
    assert opened.link._pending == {}
    began = loop.time()
    with pytest.raises(NoReply):
        await opened.link.answer(opened.ask("statistics"), 0.0)
    assert loop.time() - began == pytest.approx(GRACE)
    opened.way.sent.clear()
    prompt = opened.ask()
    loop.call_later(0.5, opened.reply, prompt.number, 5.0)
    assert await opened.link.answer(prompt, 1.0) == 5.0
    await asyncio.sleep(10.0)
    assert opened.way.methods == ["now"]  # and no cancellation


@pytest.mark.parametrize(
    ("writes", "handed", "kind", "text", "hint"),
    [
        (False, True, LineDown, "it is lost", "connect again"),
        (False, False, LineDown, "it is lost", "connect again"),
        (True, True, WriteUnconfirmed, "it is lost; the write may have been sent", WriteUnconfirmed.hint),
        (True, False, NotStarted, "it is lost", "connect again"),
    ],
)
def test_a_lost_connection_ends_each_request_with_its_node_and_command(
    writes: bool, handed: bool, kind: type[BusError], text: str, hint: str
) -> None:
    @in_virtual_time
    async def run() -> None:
        opened = Opened()
        opened.way.full = not handed
        ended = opened.ask(writes=writes)
        ended.future.set_result(None)
        pending = [opened.ask(writes=writes, node=NODE, command=READ) for _ in range(2)]
        opened.link._end(LineDown, "it is lost", "connect again")
        opened.link._end(BusClosed, "it was closed", "open it")
        for request in pending:
            error = request.future.exception()
            assert isinstance(error, BusError)
            assert (type(error), error.what, error.hint) == (kind, text, hint)
            assert (error.label, error.address, error.command) == ("node 5", 5, str(READ))
        assert opened.lost == 1
        assert (opened.link._pending, len(opened.link._waiting)) == ({}, 0)
        sent = len(opened.way.sent)
        with pytest.raises(LineDown, match=r"it is lost \(read element 1\); connect again") as caught:
            opened.ask(node=NODE, command=READ)
        assert (caught.value.label, caught.value.command) == ("node 5", str(READ))
        opened.way.full = False
        opened.link.notify("end", StreamParams(7))
        assert len(opened.way.sent) == sent

    run()


@in_virtual_time
async def test_the_cause_of_a_loss_is_that_of_the_other_end() -> None:
    for ended, text in ((True, "the program that owns the line has ended; start it"), (False, "was lost; check")):
        opened = Opened()
        opened.way.owner_ended = ended
        opened.link.lost()
        with pytest.raises(LineDown, match=text):
            opened.link.check()


@in_virtual_time
async def test_requests_in_progress_end_with_a_link_that_is_closed() -> None:
    opened = Opened()
    pending = opened.ask()
    await opened.link.close()
    assert opened.way.is_over
    assert isinstance(pending.future.exception(), BusClosed)
    with pytest.raises(BusClosed, match="the bus was closed; make a new one"):
        opened.link.check()


@in_virtual_time
async def test_an_invalid_message_closes_the_connection_with_the_reason() -> None:
    opened = Opened()
    pending = opened.ask()
    opened.reply(pending.number, "noon")
    assert opened.way.is_closed
    error = pending.future.exception()
    assert isinstance(error, LineDown)
    assert error.what.startswith("the program that owns the line sent an invalid message: InvalidParams: now: ")
    assert error.hint == "check whether it is running, and connect again"


@in_virtual_time
async def test_a_notification_of_a_later_version_is_ignored() -> None:
    opened = Opened()
    for method, params in (("solstice", {}), ("access", {"read_only": True})):
        opened.link.received(json.dumps({"jsonrpc": "2.0", "method": method, "params": params}))
    assert [(method, params.read_only) for method, params in opened.notified] == [("access", True)]


@pytest.mark.parametrize(
    ("connection", "error", "text", "hint"),
    [
        ({"status": 401}, OSError(), "here requires a token", "use a token from the token_file"),
        ({"status": 503, "refusal": "full"}, OSError(), "here does not admit this program: full", links.NO_PLACE),
        ({"status": 429, "refusal": "wait"}, OSError(), "here does not check this token: wait", "correct the token"),
        ({"status": 404, "complaint": "404"}, OSError(), "no program serves here: 404", "start busmaster run"),
        ({"close_reason": "no"}, BusClosed("x"), "here does not admit this program: no", links.NO_PLACE),
        ({}, TimeoutError(), "the program that serves here did not reply within 10 s", "if it hangs, stop it"),
        (None, TimeoutError(), "no program serves here: no reply", "start busmaster run"),
        (None, OSError(errno.ECONNREFUSED, "x"), "no program serves here: Connection refused", "or see busmaster"),
        (None, OSError("several causes"), "no program serves here: several causes", "start busmaster run"),
    ],
    ids=range(9),
)
def test_a_program_that_was_not_admitted_gets_the_cause_and_what_to_do(
    connection: dict[str, Any] | None, error: BaseException, text: str, hint: str
) -> None:
    link = Link("tcp://here", None, lambda *_: None, lambda: None)
    known = {"status": None, "refusal": "", "close_reason": "", "complaint": None}
    if connection is not None:
        link._connection = SimpleNamespace(**{**known, **connection})  # type: ignore[assignment]  # replaced here
    shut = link._shut("here", error)
    assert shut is not None
    assert shut.what == text
    assert hint in (shut.hint or "")


def test_an_error_with_another_cause_is_raised_as_it_is() -> None:
    link = Link("tcp://here", "secret", lambda *_: None, lambda: None)
    assert link._shut("here", asyncio.CancelledError()) is None
    assert link._shut("here", LineDown("the owner has ended")) is None
    connection: Any = SimpleNamespace(status=401, refusal="", close_reason="", complaint="401")
    link._connection = connection
    shut = link._shut("here", OSError())
    assert shut is not None
    assert shut.what == "here does not accept this token"


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:7420", "tcp://127.0.0.1:7420/"])
def test_the_address_of_a_tcp_port_may_end_with_a_slash(address: str) -> None:
    assert links._where(address) == ("127.0.0.1:7420", ("127.0.0.1", 7420))
    assert links._where("unix:/run/a.sock") == ("/run/a.sock", None)
    with pytest.raises(InvalidCommand):
        links._where("tcp://127.0.0.1")

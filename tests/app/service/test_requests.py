"""What a program may ask of a line that another one owns: message by message, by a real socket."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import json
import os
import re
import time
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from busmaster import Hcp2Controller, NoReply, Point, Priority, RemoteBus, connect, ext
from busmaster.app import bounds
from busmaster.app.bounds import FARTHEST_REQUESTED
from busmaster.app.service.authorisation import FRESH
from busmaster.app.service.client import MOST_FAILED, Requests
from busmaster.app.service.client_messages import RequestParams, WriteParams
from busmaster.app.service.client_requests import Reading, Writing, client_request_of
from busmaster.app.service.fields import OptionsForm, protocol_of, shortened
from busmaster.app.service.messages import BUS_ERROR, INVALID_PARAMS, Malformed, decode_client_message, encode_value
from busmaster.app.service.permission import Access, Permission
from busmaster.app.service.record import Outcome
from busmaster.app.service.rights import RIGHTS, Role
from busmaster.bus.meaning import Meaning
from busmaster.bus.node import Node
from busmaster.errors import BacklogFull, BusError, InvalidCommand, WriteUnconfirmed
from busmaster.ext import Command, CommandOptions, Hold
from tests.app.service.lines import ABSENT, PATIENT, Raw, Served, on_a_line, on_a_served_line, raw, until
from tests.patience import PATIENCE

READ: dict[str, Any] = {"protocol": "hcp2", "address": 5, "command": {"command": "read", "element": 1}}


def write(*values: float, address: int = 5, **more: Any) -> dict[str, Any]:
    return {
        "protocol": "hcp2",
        "address": address,
        "command": {"command": "write", "element": 1, "values": list(values)},
        **more,
    }


def error_of(said: dict[str, Any]) -> str:
    name: str = said["error"]["data"]["error"]
    return name


@contextlib.asynccontextmanager
async def busy(line: Served) -> AsyncIterator[None]:
    """Keep the line busy with a request to a node that is not there."""
    await Hcp2Controller(line.bus, 6).read(1)  # the line is ready
    holding = asyncio.ensure_future(Hcp2Controller(line.bus, ABSENT, timings=PATIENT).read(1, retries=0))
    await asyncio.sleep(0)
    yield
    with pytest.raises(NoReply):
        await holding


@pytest.mark.parametrize("values", [(0.0, 11.0), (11.0, 0.0), (1.0,)])
def test_what_writes_anything_but_zeros_is_no_stop_and_does_not_pass_the_limits(
    values: tuple[float, ...], tmp_path: Path
) -> None:
    async def story(line: Served) -> None:
        own = Hcp2Controller(line.bus, 5)
        for element in (1, 2):
            own.element(element).limit(minimum=0, maximum=10)
        async with raw(line) as client:
            said = await client.ask("request", **write(*values, stop=True))
            assert "is not a stop, which only writes 0" in said["error"]["message"]
        assert [await own.read(element) for element in (1, 2)] == [0, 0]

    on_a_line(tmp_path, story)


def test_a_stop_of_several_values_passes_the_limits(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        own = Hcp2Controller(line.bus, 5)
        await own.write(1, 20.0, 20.0)
        for element in (1, 2):
            own.element(element).limit(minimum=10)
        async with raw(line) as client:
            assert "minimum of 10" in (await client.ask("request", **write(0.0, 0.0)))["error"]["message"]
            assert (await client.ask("request", **write(0.0, 0.0, stop=True)))["result"] is None
        assert [await own.read(element) for element in (1, 2)] == [0, 0]

    on_a_line(tmp_path, story)


@pytest.mark.parametrize("name", ["start_within", "finish_within"])
@pytest.mark.parametrize("request_", [READ, write(1.0)], ids=["read", "write"])
def test_what_a_request_took_to_come_is_taken_off_its_times(
    name: str, request_: dict[str, Any], tmp_path: Path
) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client, busy(line):
            asked = line.bus.now() - PATIENCE / 2
            said = await client.ask("request", **request_, requested=asked, options={name: PATIENCE / 2 - FRESH})
            assert error_of(said) == "NotStarted"

    on_a_line(tmp_path, story)


@pytest.mark.parametrize("request_", [READ, write(1.0)], ids=["read", "write"])
def test_a_request_that_came_after_its_time_is_not_sent_on_an_idle_line_either(
    request_: dict[str, Any], tmp_path: Path
) -> None:
    async def story(line: Served) -> None:
        controller = Hcp2Controller(line.bus, 5)
        assert await controller.read(1) == 0
        async with raw(line) as client:
            for late, options in ((0.9, {"start_within": 0.5}), (0.9, {"finish_within": 0.5})):
                said = await client.ask("request", **request_, requested=line.bus.now() - late, options=options)
                assert error_of(said) == "NotStarted"
                hint = "its start_within of 0.5 s was over; give it more time" if "start_within" in options else ""
                assert hint in said["error"]["data"]["hint"]
            late_by_seconds = {"requested": line.bus.now() - 7.0, "options": {"start_within": 0.5}}
            said = await client.ask("request", **request_, **late_by_seconds)
            assert re.search(r"arrived \d+\.\d s after the program made it$", said["error"]["data"]["what"])
            assert await controller.read(1) == 0
            in_time = {"start_within": PATIENCE, "finish_within": PATIENCE}
            assert "result" in await client.ask("request", **request_, requested=line.bus.now(), options=in_time)
            at_once = {"start_within": 0.0}  # from its arrival, or from a time ahead of this clock, it is in time
            for requested in ({}, {"requested": line.bus.now() + FARTHEST_REQUESTED / 2}):
                assert "result" in await client.ask("request", **request_, **requested, options=at_once)

    on_a_line(tmp_path, story)


def test_a_stop_is_sent_however_late_it_comes_unless_its_program_has_set_a_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busmaster.app.service.client_requests.FRESH", FRESH)

    async def story(line: Served) -> None:
        controller = Hcp2Controller(line.bus, 5)
        await controller.write(1, 7)
        async with raw(line) as client:
            late: dict[str, Any] = {"requested": line.bus.now() - 10 * FRESH}
            assert error_of(await client.ask("request", **write(0.0), **late)) == "NotStarted"
            late["stop"] = True
            limited = await client.ask("request", **write(0.0), **late, options={"finish_within": FRESH})
            assert error_of(limited) == "NotStarted"
            assert await controller.read(1) == 7
            assert (await client.ask("request", **write(0.0), **late))["result"] is None
            assert await controller.read(1) == 0

    on_a_line(tmp_path, story)


@pytest.mark.parametrize("request_", [READ, write(1.0)], ids=["read", "write"])
def test_a_request_of_the_future_has_no_more_time_than_one_of_now(request_: dict[str, Any], tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client, busy(line):
            said = await client.ask(
                "request",
                **request_,
                requested=line.bus.now() + FARTHEST_REQUESTED / 2,
                options={"finish_within": 0.01},
            )
            assert error_of(said) == "NotStarted"

    on_a_line(tmp_path, story)


@pytest.mark.parametrize("request_", [READ, write(1.0)], ids=["read", "write"])
def test_a_time_that_is_not_of_the_owners_clock_is_refused(request_: dict[str, Any], tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            for requested in (time.time(), line.bus.now() + FARTHEST_REQUESTED + 5):
                said = await client.ask("request", **request_, requested=requested)
                assert (said["error"]["code"], error_of(said)) == (INVALID_PARAMS, "InvalidCommand")
                assert "use the time that `now` returns" in said["error"]["message"]
            nearly = line.bus.now() + FARTHEST_REQUESTED - 5
            assert "result" in await client.ask("request", **request_, requested=nearly)

    on_a_line(tmp_path, story)


def test_an_error_says_by_its_code_whether_the_line_or_the_request_is_at_fault(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        Hcp2Controller(line.bus, 5).element(1).limit(maximum=10)
        async with raw(line) as client:
            for request, code, kind in (
                ({**READ, "address": ABSENT, "options": {"retries": 0}}, BUS_ERROR, "NoReply"),
                (write(11.0), INVALID_PARAMS, "InvalidCommand"),
                ({**READ, "options": {"retries": -1}}, INVALID_PARAMS, "InvalidCommand"),
                ({**READ, "options": {"safe": True}}, INVALID_PARAMS, "InvalidCommand"),
            ):
                said = await client.ask("request", **request)
                assert (said["error"]["code"], error_of(said)) == (code, kind)

    on_a_line(tmp_path, story)


def test_a_group_of_the_owner_has_all_its_points_there_too(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        own = [Hcp2Controller(line.bus, address).point(item) for address in (5, 6) for item in ("1", "2")]
        group = line.bus.poll_group("axes", period=0.02, points=own)
        await until(lambda: remote.groups)
        theirs = remote.group("axes")
        snapshot = await anext(aiter(theirs))
        assert [point.key for point in theirs.points] == ["5/1", "5/2", "6/1", "6/2"]
        assert tuple(snapshot) == theirs.points
        group.remove(own[1])
        async for snapshot in theirs:
            if len(snapshot.samples) == 3:
                break
        assert [point.key for point in theirs.points] == ["5/1", "6/1", "6/2"]
        group.remove(own[3])
        group.add(Hcp2Controller(line.bus, 6).point("3"))
        async for snapshot in theirs:
            if [point.key for point in snapshot] == ["5/1", "6/1", "6/3"]:
                break

    on_a_served_line(tmp_path, story)


def test_of_urgent_requests_too_only_so_many_may_be_unanswered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busmaster.app.service.client.MOST_REQUESTS", 3)
    monkeypatch.setattr("busmaster.app.service.client.MOST_URGENT", 2)

    async def story(line: Served, remote: RemoteBus) -> None:
        async with busy(line):
            reads = (Hcp2Controller(remote, 5).read(1, priority=Priority.URGENT) for _ in range(7))
            ended = await asyncio.gather(*reads, return_exceptions=True)
        assert [type(end) for end in ended if isinstance(end, Exception)] == [BacklogFull] * 2
        assert ended.count(0) == 5

    on_a_served_line(tmp_path, story)


def test_a_request_with_options_has_no_place_of_the_urgent_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busmaster.app.service.client.MOST_REQUESTS", 3)

    async def story(line: Served, remote: RemoteBus) -> None:
        async with busy(line):
            reads = (Hcp2Controller(remote, 5).read(1, priority=Priority.COMMAND) for _ in range(5))
            ended = await asyncio.gather(*reads, return_exceptions=True)
        assert [isinstance(end, BacklogFull) for end in ended] == [False] * 3 + [True] * 2

    on_a_served_line(tmp_path, story)


async def asked(client: Raw, number: int, method: str, **params: Any) -> dict[str, Any]:
    """Return the answer to a question, whatever news come before it."""
    await client.say(method=method, params=params, id=number)
    while (said := await client.hear()).get("id") != number:
        pass
    return said


def polled(stream: int, **more: Any) -> dict[str, Any]:
    point = {"protocol": "hcp2", "address": 5, "item": "1", "command": {"command": "read", "element": 1}}
    return {"name": "mine", "period": 60.0, "stream": stream, "points": [point], **more}


def test_a_poll_group_that_cannot_be_followed_is_not_polled(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            accepted = (await asked(client, 1, "poll", **polled(7)))["result"]
            assert accepted == {"period": 60.0, "name": line.bus.groups[0].name}
            said = await asked(client, 2, "poll", **{**polled(7), "name": "another"})
            assert "stream 7 of this program is in use" in said["error"]["message"]
            assert len(line.bus.groups) == 1

    on_a_line(tmp_path, story)


def test_each_list_of_points_has_a_number_and_is_sent_before_the_cycles_of_these_points(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        controller = Hcp2Controller(line.bus, 5)
        group = line.bus.poll_group("axes", period=3600.0, points=[controller.point("1")])
        heard: list[tuple[str, int, int]] = []
        async with raw(line) as client:
            await client.say(id=1, method="subscribe", params={"group": "axes", "stream": 7})

            async def cycle() -> None:
                group.demand()
                while not (heard and heard[-1][0] == "snapshot" and heard[-1][2] == len(group.points)):
                    said = await client.hear()
                    if said.get("method") in ("points", "snapshot"):
                        body = said["params"]["body"]
                        heard.append((said["method"], body["set"], len(body.get("points", body.get("samples")))))

            await cycle()
            group.add(controller.point("2"))
            await cycle()
        expected = [("points", 0, 1), ("snapshot", 0, 1), ("points", 1, 2), ("snapshot", 1, 2)]
        assert list(dict.fromkeys(heard)) == expected

    on_a_line(tmp_path, story)


def test_a_program_polls_at_the_priority_of_a_poll_at_most(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        controller = Hcp2Controller(remote, 5)
        for asked in Priority:
            name = asked.name.lower()
            group = remote.poll_group(name, period=60.0, points=[controller.point("1")], priority=asked)
            await group.ready()
        found = [group.planned().priority for group in line.bus.groups]
        assert found == [Priority.POLL, Priority.POLL, Priority.POLL, Priority.BACKGROUND]

    on_a_served_line(tmp_path, story)


def test_a_node_that_was_named_wrongly_is_asked_once_it_is_named_rightly(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        Hcp2Controller(line.bus, 5)
        node = {"protocol": "hcp2", "address": 5}
        async with raw(line) as client:
            wrong = await client.ask("node", **node, retries=7)
            assert "other retries" in wrong["error"]["message"]
            assert "other retries" in (await client.ask("request", **READ))["error"]["message"]
            assert (await client.ask("node", **node))["result"]["label"] == "node 5"
            assert (await client.ask("request", **READ))["result"] == 0

    on_a_line(tmp_path, story)


def test_a_program_that_leaves_keeps_its_place_and_nodes_until_each_of_its_writes_has_ended(tmp_path: Path) -> None:
    begun: list[asyncio.Event] = []
    cancelled: list[asyncio.Event] = []

    async def slow(end: asyncio.Event) -> str:
        begun.append(end)
        try:
            await end.wait()
        except asyncio.CancelledError:
            cancelled.append(end)
            await end.wait()
        return ""

    async def story(line: Served) -> None:
        line.authorisation.record = lambda _: slow(asyncio.Event())
        async with raw(line) as client:
            for number in range(3):
                await client.say(method="request", params=write(number), id=number)
            await until(lambda: len(begun) == 3)
        [program] = line.service.clients
        await until(lambda: len(cancelled) == 3)
        first, *others = begun
        first.set()
        await until(lambda: len(program.unfinished) == 2)
        await Hcp2Controller(line.bus, 6).read(1)  # the loop turns meanwhile
        assert line.service.clients == (program,)
        assert {node.address for node in line.bus.nodes} == {5, 6}
        for end in others:
            end.set()
        await line.alone()
        assert [node.address for node in line.bus.nodes] == [6]

    on_a_line(tmp_path, story)


def test_r12_the_times_of_a_request_that_has_waited_are_shorter_by_that() -> None:
    given: CommandOptions = {"start_within": 1.0, "finish_within": 2.0, "retries": 3}
    assert shortened(given, 0.5) == {"start_within": 0.5, "finish_within": 1.5, "retries": 3}
    assert shortened(given, 1.5) == {"start_within": 0.0, "finish_within": 0.5, "retries": 3}
    assert shortened({}, 1.5) == {}


class Replies:
    """Requests of a program whose replies are kept."""

    def __init__(self) -> None:
        self.answers: list[tuple[int, Any]] = []
        self.errors: list[tuple[int, Exception]] = []
        sender: Any = SimpleNamespace(peer="a program")
        line: Any = None
        self.requests = Requests(
            sender,
            line,
            lambda number, value: self.answers.append((number, value)),
            lambda number, error: self.errors.append((number, error)),
        )

    def end(self, value: Any = None, error: BaseException | None = None, **state: bool) -> None:
        """End a request, as its node does."""
        node = SimpleNamespace(label="node 5", address=5, line="line")
        command = SimpleNamespace(writes=state.pop("writes", False))
        request: Any = SimpleNamespace(
            given_up=state.get("given_up"), sent=state.get("sent"), node=node, command=command
        )
        self.requests._under_way[7] = request
        self.requests._ended(7, request, value, error)
        self.requests.check_number(7)  # it is free again


@pytest.mark.parametrize(
    ("writes", "sent", "kind"),
    [(True, True, WriteUnconfirmed), (True, False, BusError), (False, True, BusError), (False, False, BusError)],
)
def test_a_bug_of_a_protocol_is_reported_as_what_it_is_for_the_request(
    writes: bool, sent: bool, kind: type[BusError], caplog: pytest.LogCaptureFixture
) -> None:
    replies = Replies()
    replies.end(error=ValueError("odd"), writes=writes, sent=sent)
    [(number, error)] = replies.errors
    assert (number, type(error)) == (7, kind)
    assert isinstance(error, BusError)
    assert error.what == "the program that owns the line failed: ValueError: odd"
    assert (error.label, error.address) == ("node 5", 5)
    assert error.command
    assert [record.getMessage() for record in caplog.records] == ["a request of a program failed"]
    assert caplog.records[0].exc_info is not None


def test_a_request_that_its_program_gave_up_gets_no_reply(caplog: pytest.LogCaptureFixture) -> None:
    replies = Replies()
    replies.end(5.0, given_up=True)
    replies.end(error=ValueError("odd"), given_up=True)
    replies.end(error=NoReply("no reply"), given_up=True)
    assert (replies.answers, replies.errors, caplog.records) == ([], [], [])
    replies.end(frozenset({1}))
    assert replies.answers == [(7, encode_value(frozenset({1})))]


@pytest.mark.asyncio
async def test_a_safe_state_that_could_not_be_sent_to_its_end_is_reported() -> None:
    async def fail(error: BaseException) -> dict[str, Any]:
        raise error

    replies = Replies()
    for number, error in enumerate((asyncio.CancelledError(), InvalidCommand("not this"), ValueError("odd"))):
        sending: asyncio.Task[dict[str, Any]] = asyncio.ensure_future(fail(error))
        await asyncio.wait([sending])
        replies.requests._under_way[number] = None
        assert replies.requests.sends_safe_state
        assert replies.requests.unfinished == ()
        replies.requests._safe_sent(number, sending)
        assert not replies.requests.sends_safe_state
    assert [(number, type(error)) for number, error in replies.errors] == [
        (0, WriteUnconfirmed),
        (1, InvalidCommand),
        (2, ValueError),
    ]
    assert replies.answers == []


def test_a_cancellation_of_what_has_no_request_is_ignored(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            assert (await client.ask("request", **READ))["result"] == 0
            for number in (1, 4711):  # one that has ended, and one that never was
                await client.say(method="cancel", params={"id": number})
            assert (await client.ask("request", **READ))["result"] == 0

    on_a_line(tmp_path, story)


def test_the_number_of_a_request_in_progress_is_not_used_for_another_of_any_kind(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        await Hcp2Controller(remote, 5).read(1)
        [program] = line.service.clients

        def say(method: str, params: dict[str, Any], **more: int) -> None:
            message = {"jsonrpc": "2.0", "method": method, "params": params, **more}
            program.take(decode_client_message(json.dumps(message)))

        say("request", READ, id=70)  # the line has no turn before it is cancelled
        for method, params in (("now", {}), ("request", READ), ("request", {}), ("plan", {}), ("erase", {})):
            with pytest.raises(Malformed, match="request 70 is already in progress"):
                say(method, params, id=70)
        say("cancel", {"id": 70})
        assert program.unfinished == ()

    on_a_served_line(tmp_path, story)


@pytest.mark.parametrize(
    ("method", "turns", "end"),
    [
        ("request", 0, "cancel"),
        ("write", 0, "cancel cancel"),
        ("request", 0, "connection"),
        ("write", 0, "service"),
        ("request", 1, "cancel"),
        ("write", 1, "service"),
    ],
)
def test_a_write_that_ends_before_it_is_sent_has_one_audit_entry(
    tmp_path: Path, method: str, turns: int, end: str
) -> None:
    async def story(line: Served) -> None:
        line.bus.poll_group("axes", period=100.0, points=[Hcp2Controller(line.bus, 5).point("1")])
        remote = connect(line.address)
        await remote.__aenter__()
        await until(lambda: line.service.clients)
        [program] = line.service.clients

        def say(method: str, params: dict[str, Any], **more: int) -> None:
            message = {"jsonrpc": "2.0", "method": method, "params": params, **more}
            program.take(decode_client_message(json.dumps(message)))

        async with busy(line) if turns else contextlib.nullcontext():
            say(method, write(7.0) if method == "request" else {"group": "axes", "key": "5/1", "value": 7.0}, id=70)
            for _ in range(turns):  # with none, its task has not begun
                await asyncio.sleep(0)
            if end == "service":
                program.requests.end()
            elif end == "connection":
                await program.requests.give_up()
            else:
                for _ in end.split():
                    say("cancel", {"id": 70})
            await remote.__aexit__(None, None, None)
            await line.alone()
        [record] = line.records
        assert (record.point, record.value, record.outcome) == ("5/1", 7, Outcome.NOT_STARTED)
        cause = "the program that owns the line ended" if end == "service" else "its program cancelled it"
        assert record.error == f"{cause} before it was sent"
        assert await Hcp2Controller(line.bus, 5).read(1) == 0

    on_a_line(tmp_path, story)


# checks and reports


def test_a_write_that_is_not_permitted_is_refused_with_its_node_and_the_reason(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        ext.rename(Node.of(Hcp2Controller(line.bus, 5)), "winder")
        async with raw(line) as client:
            reply = await client.ask("request", **write(1.0))
            assert reply["error"]["message"] == "winder: this line is read-only"
        [record] = line.records
        assert (record.outcome, record.error) == (Outcome.REFUSED, "winder: this line is read-only")

    on_a_line(tmp_path, story, read_only=True)


def test_a_check_reports_the_first_refused_write_of_several_and_writes_nothing(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        Hcp2Controller(line.bus, 5).element(1).limit(minimum=5, maximum=10)
        node = {"protocol": "hcp2", "address": 5}
        right, wrong, zero = (write(value)["command"] for value in (7.0, 11.0, 0.0))
        async with raw(line) as client:
            assert (await client.ask("check", **node, commands=[right, READ["command"], right]))["result"] is None
            assert (await client.ask("check", **node, commands=[]))["result"] is None
            assert line.records == []
            reply = await client.ask("check", **node, commands=[right, wrong])
            assert "maximum of 10" in reply["error"]["message"]
            assert line.audit() == [("5/write element 1 = 11", "refused")]
            assert "maximum of 10" in line.records[0].error
            assert "minimum of 5" in (await client.ask("check", **node, commands=[zero]))["error"]["message"]
            assert (await client.ask("check", **node, commands=[zero], stop=True))["result"] is None
            reply = await client.ask("check", **node, commands=[right], stop=True)
            assert "is not a stop" in reply["error"]["message"]
            line.authorisation.read_only = True
            reply = await client.ask("check", **node, commands=[READ["command"], right])
            assert reply["error"]["message"] == "node 5: this line is read-only"
            assert line.records[-1].error == "node 5: this line is read-only"
        assert (await line.bus.statistics()).exchanges == 0

    on_a_line(tmp_path, story)


def test_refusals_that_another_process_reports_are_counted_and_unusable_ones_are_ignored(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        refusals = line.authorisation.refusals
        reports: list[str] = []
        refusals.on_report.append(reports.append)
        async with raw(line) as client:

            async def report(interface: str, kind: str, **peers: int) -> None:
                await client.say(method="refusals", params={"interface": interface, "kind": kind, "peers": peers})
                assert "result" in await client.ask("now")

            await report("web", "logins")
            assert refusals.logins == {"service": 0, "web": 0}  # from 0 on, for metrics
            unusable = {"no": 0, "too many": MOST_FAILED + 1, "x" * (bounds.LONGEST_SENDER + 1): 7, "\x1b[2J": 7}
            await report("web", "logins", **unusable, **{"10.0.0.1": 3, "y" * bounds.LONGEST_SENDER: MOST_FAILED})
            assert refusals.logins["web"] == MOST_FAILED + 3
            assert reports[0].startswith("3 failed logins at web: 3 from 10.0.0.1")
            await report("modbus-tcp", "requests", **{"10.0.0.1": 2})
            for name, kind in (("service", "logins"), ("Web page", "logins"), ("web", "murders")):
                await report(name, kind, **{"10.0.0.1": 2})
            assert refusals.logins == {"service": 0, "web": MOST_FAILED + 3}
            assert refusals.at_interfaces == {("modbus-tcp", "requests"): 2}
            await report("opcua", "connections", **{f"peer {n}": 1 for n in range(bounds.MOST_REPORTED + 9)})
            assert refusals.at_interfaces["opcua", "connections"] == bounds.MOST_REPORTED + 1

    on_a_line(tmp_path, story)


# what changes how the line is polled


def test_a_pause_and_a_suspension_are_noted_with_the_program_until_they_end(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        line.bus.poll_group("axes", period=60, points=[Hcp2Controller(line.bus, 5).point("1")])
        node = {"protocol": "hcp2", "address": 5}
        async with raw(line) as client:
            assert (await client.ask("pause", group="axes", paused=True))["result"] is None
            assert [group.paused for group in line.bus.groups] == [True]
            assert (await client.ask("pause", group="axes", paused=False))["result"] is None
            assert [group.paused for group in line.bus.groups] == [False]
            assert (await client.ask("suspend", **node, **{"for": 60.0}))["result"] is None
            assert [one.suspended for one in line.bus.nodes] == [True]
            assert (await client.ask("suspend", **node, **{"for": 0}))["result"] is None
            assert [one.suspended for one in line.bus.nodes] == [False]
            for wrong in ({"protocol": "mentor", "address": 5}, {"protocol": "hcp2", "address": 6}):
                reply = await client.ask("suspend", **wrong, **{"for": 60.0})
                assert "is not on this line; check protocol and address" in reply["error"]["message"]
            [program] = line.service.clients
        assert [text for _, text in line.service.line.journal.entries if " by " in text] == [
            f"{what} by {program.peer}"
            for what in ("axes is paused", "axes is resumed", "node 5 is suspended for 60 s", "node 5 is resumed")
        ]

    on_a_line(tmp_path, story)


def test_a_program_pauses_a_group_only_if_it_may_write_to_each_of_its_nodes(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        points = [Hcp2Controller(line.bus, address).point("1") for address in (5, 6)]
        group = line.bus.poll_group("axes", period=60, points=points)
        async with raw(line) as client:
            for allowed, paused in (((), False), ((5,), False), ((6,), False), ((5, 6), True)):
                only = {("hcp2", address): None for address in allowed}
                line.authorisation.access = Access(users={os.getuid(): Permission("user me", Role.WRITE, only)})
                reply = await asked(client, 2, "pause", group="axes", paused=True)
                assert ("error" not in reply, group.paused) == (paused, paused)

    on_a_line(tmp_path, story)


def test_a_program_holds_the_line_and_suspends_only_for_a_node_to_which_it_may_write(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        for address in (5, 6):
            Hcp2Controller(line.bus, address)
        some = Hcp2Controller(line.bus, 6).point("1").command.places  # type: ignore[attr-defined]  # of a read of hcp2
        line.authorisation.access = Access(
            users={os.getuid(): Permission("user me", Role.WRITE, {("hcp2", 6): frozenset(some)})}
        )
        async with raw(line) as client:
            for sequence, address in enumerate((5, 6)):
                hold = {"sequence": sequence, "protocol": "hcp2", "address": address, "max_hold": 1.0}
                await client.say(method="hold", params=hold)
            refused = await client.ask("request", **READ, sequence=0)
            assert "node 5: user me may not hold the line" in refused["error"]["message"]
            assert (await client.ask("request", **{**READ, "address": 6}, sequence=1))["result"] == 0
            await client.say(method="release", params={"sequence": 1})
            refused = await client.ask("suspend", protocol="hcp2", address=5, **{"for": 60.0})
            assert "user me may not pause or suspend this" in refused["error"]["message"]
            assert (await client.ask("suspend", protocol="hcp2", address=6, **{"for": 60.0}))["result"] is None

    on_a_line(tmp_path, story)


# limits of one program


def test_a_program_has_so_many_poll_groups_and_each_ends_with_its_stream(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        access = Access(users={os.getuid(): Permission("user me", Role.READ)})
        line.authorisation.access = access
        most = RIGHTS[Role.READ].groups
        async with raw(line) as client:
            for stream in range(most):
                assert "result" in await asked(client, 1, "poll", **polled(stream, name=f"{stream}"))
            reply = await asked(client, 1, "poll", **polled(most))
            assert f"one program has {most} poll groups at most" in reply["error"]["message"]
            await client.say(method="end", params={"stream": 0})
            assert "result" in await asked(client, 1, "poll", **polled(most, name="again"))
            assert len(line.bus.groups) == most
            [program] = line.service.clients
            names = [group.name for group in line.bus.groups]
            assert names[0] == f"1 ({program.peer.short}-{program._number})"
        await line.alone()
        assert line.bus.groups == ()

    on_a_line(tmp_path, story)


def test_a_poll_group_has_the_phase_of_its_program_and_the_beginning_of_its_name(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            assert "result" in await asked(client, 1, "poll", **polled(7, name="n" * 99, phase=12.5, priority=3))
            [group] = line.bus.groups
            for stream, length in ((8, 41), (9, 40)):
                assert "result" in await asked(client, 1, "poll", **polled(stream, name="n" * length))
            [program] = line.service.clients
            number = f"{program.peer.short}-{program._number}"
            beginning = "n" * 40
            assert [own.name for own in line.bus.groups] == [
                f"{beginning} ({number}.7)",
                f"{beginning} ({number}.8)",
                f"{beginning} ({number})",
            ]
            assert (group.planned().phase, group.planned().priority) == (12.5, Priority.BACKGROUND)

    on_a_line(tmp_path, story)


def test_points_that_were_gathered_are_polled_together_and_are_limited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busmaster.app.service.client.MOST_POLLED_POINTS", 3)
    monkeypatch.setattr("busmaster.app.service.client.MOST_POLLED", 2)

    def points(*elements: int, command: str = "read", **more: Any) -> list[dict[str, Any]]:
        node = {"protocol": "hcp2", "address": 5}
        return [{**node, "item": f"{n}", "command": {"command": command, "element": n, **more}} for n in elements]

    async def story(line: Served) -> None:
        async with raw(line) as client:
            for element in (1, 2):
                assert "result" in await asked(client, 1, "gather", stream=7, points=points(element))
            reply = await asked(client, 1, "gather", stream=7, points=points(3, 4))
            assert "a poll group of a program has 3 points at most" in reply["error"]["message"]
            assert "result" in await asked(client, 1, "gather", stream=8, points=points(1, 2, 3))
            reply = await asked(client, 1, "gather", stream=9, points=points(1))
            assert "one program has 2 poll groups at most" in reply["error"]["message"]
            await client.say(method="end", params={"stream": 8})
            reply = await asked(client, 1, "gather", stream=9, points=points(1, command="write", values=[1.0]))
            assert "a poll group reads: it writes nothing" in reply["error"]["message"]
            for last, why in (
                (points(3, 4), "a poll group of a program has 3 points at most"),
                (points(3, command="write", values=[1.0]), "a poll group reads: it writes nothing"),
            ):
                reply = await asked(client, 1, "poll", **polled(7, points=last))
                assert why in reply["error"]["message"]
            assert "result" in await asked(client, 1, "poll", **polled(7, points=points(3)))
            assert [point.item for point in line.bus.groups[0].points] == ["1", "2", "3"]
            assert "result" in await asked(client, 1, "gather", stream=9, points=points(1))
            assert "result" in await asked(client, 1, "gather", stream=10, points=points(1))  # the first is a group now

    on_a_line(tmp_path, story)


@pytest.mark.parametrize(("method", "params"), [("subscribe", {"group": "axes"}), ("events", {})])
def test_a_stream_that_nobody_follows_any_more_keeps_nothing_on_the_line(
    tmp_path: Path, method: str, params: dict[str, Any]
) -> None:
    async def story(line: Served) -> None:
        axes = line.bus.poll_group("axes", period=60.0, points=[Hcp2Controller(line.bus, 5).point("1")])
        followed = axes._consumers_of_changes if method == "subscribe" else line.bus._streams
        before = len(followed)
        async with raw(line) as client:
            for _ in range(2):
                assert "result" in await asked(client, 1, method, stream=7, **params)
                await until(lambda: len(followed) == before + 1)
                await client.say(method="end", params={"stream": 7})
                await until(lambda: len(followed) == before)

    on_a_line(tmp_path, story)


def test_a_program_has_so_many_streams(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busmaster.app.service.client.MOST_STREAMS", 2)

    async def story(line: Served) -> None:
        async with raw(line) as client:
            assert (await asked(client, 1, "events", stream=1))["result"] == {}
            assert (await asked(client, 1, "events", stream=2))["result"] == {}
            reply = await asked(client, 1, "events", stream=3)
            assert "one program has 2 streams at most" in reply["error"]["message"]
            await client.say(method="end", params={"stream": 1})
            reply = await asked(client, 1, "events", stream=2)
            assert "stream 2 of this program is in use" in reply["error"]["message"]
            assert (await asked(client, 1, "exchanges", stream=1))["result"] == {}

    on_a_line(tmp_path, story)


def test_a_program_names_so_many_nodes_and_known_ones_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busmaster.app.service.client.MOST_NODES", 2)

    async def story(line: Served) -> None:
        async with raw(line) as client:
            for address in (5, 6, 5):
                reply = await client.ask("node", protocol="hcp2", address=address)
                assert reply["result"] == {"label": f"node {address}", "health": "unknown"}
            reply = await client.ask("node", protocol="hcp2", address=7)
            assert "one program names 2 nodes at most" in reply["error"]["message"]
            assert (await client.ask("request", **READ))["result"] == 0
            assert (await client.ask("node", protocol="hcp2", address=5))["result"]["health"] == "up"
            assert "result" in await client.ask("node", protocol="hcp2", address=6, retries=2)
            for address in range(10, 20):
                assert "error" in await client.ask("node", protocol="hcp2", address=address)
            [program] = line.service.clients
            assert len(program._refused) == 2

    on_a_line(tmp_path, story)


def test_a_program_that_names_a_node_again_keeps_its_count_of_stops(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            naming: dict[str, Any] = {"protocol": "hcp2", "address": 5, "retries": 2}
            assert "result" in await client.ask("node", **naming)
            assert (await client.ask("request", **write(1.0), stops_seen=0))["result"] is None
            Node.of(Hcp2Controller(line.bus, 5)).note_stop()
            assert (await client.hear())["params"]["stops"] == 1
            assert "result" in await client.ask("node", **naming)
            assert error_of(await client.ask("request", **write(2.0), stops_seen=0)) == "Superseded"
            assert (await client.ask("request", **write(3.0), stops_seen=1))["result"] is None
            none = await client.ask("node", **{**naming, "retries": 0})
            assert "other retries" in none["error"]["message"], "0 is a number of them, too"

    on_a_line(tmp_path, story)


def test_a_stop_by_a_program_that_has_not_named_the_node_supersedes_the_writes_of_others(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as other, raw(line) as stopping:
            assert "result" in await other.ask("node", protocol="hcp2", address=5)
            await stopping.say(method="stop", params={"protocol": "hcp2", "address": 5})
            assert (await asked(stopping, 1, "request", **write(0.0), stop=True))["result"] is None
            assert (await other.hear())["params"]["stops"] == 1
            assert error_of(await other.ask("request", **write(5.0), stops_seen=0)) == "Superseded"
            assert await Hcp2Controller(line.bus, 5).read(1) == 0

    on_a_line(tmp_path, story)


def test_a_stop_of_a_node_that_the_line_cannot_have_is_refused_with_its_request(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            await client.say(method="stop", params={"protocol": "hcp2", "address": 256})
            reply = await client.ask("request", **write(0.0, address=256), stop=True)
            assert error_of(reply) == "InvalidCommand"

    on_a_line(tmp_path, story)


def test_a_write_to_a_point_is_superseded_by_a_stop_that_its_program_has_not_seen(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        own = Hcp2Controller(line.bus, 5)
        line.bus.poll_group("axes", period=60.0, points=[own.point("1")])
        to_point: dict[str, Any] = {"group": "axes", "key": "5/1", "value": 5}
        async with raw(line) as client:
            reply = await client.ask("write", **to_point, stops_seen=0)
            assert "stops are counted from the message `node`" in reply["error"]["message"]
            assert "result" in await client.ask("node", protocol="hcp2", address=5)
            own.node.note_stop()
            assert (await client.hear())["params"]["stops"] == 1
            assert error_of(await client.ask("write", **to_point, stops_seen=0)) == "Superseded"
            assert await own.read(1) == 0
            assert (await client.ask("write", **to_point, stops_seen=1))["result"] is None

    on_a_line(tmp_path, story)


def test_the_number_of_a_request_that_could_not_be_started_is_free_again(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        own = Hcp2Controller(line.bus, 5)
        async with raw(line) as client:
            assert "result" in await client.ask("node", protocol="hcp2", address=5)
            own.node.note_stop()
            assert (await client.hear())["params"]["stops"] == 1
            for _ in range(2):
                assert error_of(await client.ask("request", **READ, stops_seen=0)) == "Superseded"
            assert (await client.ask("request", **READ, stops_seen=1))["result"] == 0

    on_a_line(tmp_path, story)


def test_a_node_that_its_program_names_twice_leaves_the_line_with_it(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            for _ in range(2):
                assert "result" in await client.ask("node", protocol="hcp2", address=5, retries=2)
            assert [node.address for node in line.bus.nodes] == [5]
        await line.alone()
        assert line.bus.nodes == ()

    on_a_line(tmp_path, story)


def test_a_sequence_that_has_begun_is_not_begun_again_under_its_number(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            for address in (5, 6):
                hold = {"sequence": 1, "protocol": "hcp2", "address": address, "max_hold": ext.LONGEST_HOLD}
                await client.say(method="hold", params=hold)
            assert (await client.ask("request", **READ, sequence=1))["result"] == 0
            reply = await client.ask("request", **{**READ, "address": 6}, sequence=1)
            assert "no sequence 1 was begun for it" in reply["error"]["message"]
            [program] = line.service.clients
            held = program._holds[1]
            assert isinstance(held, Hold)
            for _ in range(2):
                await client.say(method="release", params={"sequence": 1})
            assert (await client.ask("request", **READ))["result"] == 0
            assert held.over
            await client.say(method="hold", params=hold)
            assert (await client.ask("request", **{**READ, "address": 6}, sequence=1))["result"] == 0

    on_a_line(tmp_path, story)


def test_a_sequence_that_could_not_begin_may_be_begun_again_under_its_number(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            hold: dict[str, Any] = {"sequence": 1, "protocol": "hcp2", "address": 5, "max_hold": 0.0}
            await client.say(method="hold", params=hold)
            assert "max_hold" in (await client.ask("request", **READ, sequence=1))["error"]["message"]
            await client.say(method="hold", params={**hold, "max_hold": ext.LONGEST_HOLD})
            assert (await client.ask("request", **READ, sequence=1))["result"] == 0

    on_a_line(tmp_path, story)


@pytest.mark.parametrize(
    ("method", "params"), [("subscribe", {"group": "axes"}), ("events", {}), ("overview", {}), (None, {})]
)
def test_a_program_with_a_stream_is_notified_of_values_that_a_write_makes_stale(
    tmp_path: Path, method: str | None, params: dict[str, Any]
) -> None:
    async def story(line: Served) -> None:
        own = Hcp2Controller(line.bus, 5)
        line.bus.poll_group("axes", period=60.0, points=[own.point("1")])
        async with raw(line) as client:
            if method is not None:
                assert "result" in await asked(client, 1, method, stream=1, **params)
            await own.write(1, 2.5)
            await client.say(method="now", params={}, id=2)
            received: list[Any] = []
            while (message := await client.hear()).get("id") != 2:
                received += [message["params"]["items"]] if message.get("method") == "touched" else []
        assert received == ([] if method is None else [["1"]])

    on_a_line(tmp_path, story)


def test_the_names_that_a_program_gives_its_points_hide_no_stale_value_of_the_owner(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        own = Hcp2Controller(line.bus, 5)
        line.bus.poll_group("axes", period=60.0, points=[own.point("1")])
        async with raw(line) as client, raw(line) as other:
            assert "result" in await asked(client, 1, "events", stream=1)
            named_alike = {**polled(1)["points"][0], "command": {"command": "read", "element": 2}}
            assert "result" in await asked(other, 1, "poll", **polled(1, points=[named_alike]))
            await own.write(1, 2.5)
            await client.say(method="now", params={}, id=2)
            received: list[Any] = []
            while (message := await client.hear()).get("id") != 2:
                received += [message["params"]["items"]] if message.get("method") == "touched" else []
        assert received == [["1"]]

    on_a_line(tmp_path, story)


def test_the_names_that_a_program_gives_its_points_are_not_on_record_for_the_writes_of_others(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        line.bus.poll_group("axes", period=60.0, points=[Hcp2Controller(line.bus, 5).point("1")])
        async with raw(line) as client, raw(line) as other:
            point = polled(1)["points"][0]
            second = {**point, "item": "hoist", "command": {"command": "read", "element": 2}}
            points = [{**point, "item": "hoist"}, second]
            assert "result" in await asked(other, 1, "poll", **polled(1, points=points))
            for element in (1, 2):
                command = {**write(3.0)["command"], "element": element}
                said = await asked(client, element, "request", protocol="hcp2", address=5, command=command)
                assert said["result"] is None
        assert [record.point for record in line.records] == ["5/1", "5/raw command"]

    on_a_line(tmp_path, story)


def test_points_without_a_name_have_keys_of_their_own(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        point = polled(1)["points"][0]
        del point["item"]
        reads = [{"command": "read", "element": element} for element in (1, 2)]
        points = [
            {**point, "key": "winder/force", "item": "force"},
            {**point, "key": "speed"},
            *({**point, "command": read} for read in reads),
        ]
        async with raw(line) as client:
            await client.say(method="poll", params=polled(1, points=points), id=1)
            body = (await client.hear())["params"]["body"]
            assert [one["key"] for one in body["points"]] == [
                *("5/force", "5/speed"),
                *("5/read element 1", "5/read element 2"),
            ]

    on_a_line(tmp_path, story)


# writes to points, and the parts of a request


def test_a_value_for_a_point_is_a_label_or_a_number_and_is_on_record_if_it_is_refused(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        own = Hcp2Controller(line.bus, 5)
        mode = replace(own.point("1"), meaning=Meaning(labels={0: "off", 1: "run"}))
        line.bus.poll_group("axes", period=60.0, points=[mode, own.point("2")])
        async with raw(line) as client:

            async def refusal(key: str, value: object) -> str:
                reply = await client.ask("write", group="axes", key=key, value=value)
                assert reply["error"]["message"] == line.records[-1].error
                message: str = reply["error"]["message"]
                return message

            assert (await client.ask("write", group="axes", key="5/1", value="run"))["result"] is None
            assert await own.read(1) == 1
            assert (line.records[-1].point, line.records[-1].value) == ("5/1", 1)
            assert "gallop" in await refusal("5/1", "gallop")
            assert (line.records[-1].outcome, line.records[-1].value) == (Outcome.REFUSED, "'gallop'")
            assert (line.records[-1].interface, line.records[-1].by) == ("service", str(line.service.clients[0].peer))
            assert "on" in await refusal("5/2", "on")  # it has no labels
            line.authorisation.read_only = True
            assert await refusal("5/1", "gallop") == "this line is read-only"
            line.authorisation.read_only = False
            line.authorisation.access = Access(users={os.getuid(): Permission("user me", Role.READ)})
            reply = await asked(client, 2, "write", group="axes", key="5/1", value="run")
            assert "user me may read this line, but not write" in reply["error"]["message"]
        assert await own.read(1) == 1

    on_a_line(tmp_path, story)


def test_of_several_points_of_one_place_the_written_one_is_on_record_with_its_own_value(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        own = Hcp2Controller(line.bus, 5)
        point = own.point("1")

        def in_unit(item: str, factor: float) -> Point[Any]:
            def encode(value: Any) -> Command[None]:
                assert point.encode is not None
                return point.encode(value / factor)

            return replace(point, item=item, decode=lambda raw: raw * factor, encode=encode, unit=item)

        line.bus.poll_group("axes", period=60.0, points=[in_unit("%", 100.0), in_unit("m", 2.0)])
        line.bus.poll_group("slow", period=60.0, points=[in_unit("mm", 2000.0)])
        async with raw(line) as client:
            for group, key, value in (
                ("axes", "5/%", 50),
                ("axes", "5/m", 4),
                ("slow", "5/mm", 6000),
                ("axes", "5/%", 0),
            ):
                assert (await client.ask("write", group=group, key=key, value=value))["result"] is None
                assert (line.records[-1].point, line.records[-1].value) == (key, value)
            assert (await client.ask("request", **write(2.0)))["result"] is None
        known = [("5/%", 200.0), ("5/m", 4.0), ("5/mm", 4000.0)]
        assert (line.records[-1].point, line.records[-1].value) in known, "a raw command has no point of its own"

    on_a_line(tmp_path, story)


def test_a_write_whose_value_the_owners_point_cannot_decode_is_on_record_as_a_command(tmp_path: Path) -> None:
    def reject(_: object) -> Any:
        raise ZeroDivisionError("no scale")

    async def story(line: Served) -> None:
        point = replace(Hcp2Controller(line.bus, 5).point("1"), decode=reject)
        line.bus.poll_group("axes", period=3600.0, points=[point])
        async with raw(line) as client:
            assert (await client.ask("request", **write(2.5)))["result"] is None
        [record] = line.records
        assert (record.point, record.value, record.ok) == ("5/1", "'write element 1 = 2.5'", True)

    on_a_line(tmp_path, story)


def test_a_request_is_made_with_all_that_its_client_has_sent(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        node = Node.of(Hcp2Controller(line.bus, 5))
        node.note_stop()
        line.bus.poll_group("axes", period=60.0, points=[Hcp2Controller(line.bus, 5).point("1")])
        async with raw(line) as client:
            assert "result" in await client.ask("node", protocol="hcp2", address=5)
            hold = {"sequence": 1, "protocol": "hcp2", "address": 5, "max_hold": 1.0}
            await client.say(method="hold", params=hold)
            assert "result" in await client.ask("now")
            [program] = line.service.clients
            held = program._holds[1]
            command, other = write(0.0)["command"], {"command": "read", "element": 2}
            for params, client_of, stops, stop in (
                (RequestParams("hcp2", 5, command, touches=other, stops_seen=2, stop=True), program.turn, 3, True),
                (RequestParams("hcp2", 5, command, touches=other, sequence=1), held, None, False),
            ):
                made = client_request_of(params, program, line.service.line)
                assert isinstance(made, Writing)
                request = made._request
                assert (str(request.command), str(request.touches)) == ("write element 1 = 0", "read element 2")
                assert (request.client, request.stops_seen, request.stop) == (client_of, stops, stop)
            for options in (None, OptionsForm(finish_within=1.0)):
                params = RequestParams("hcp2", 5, other, options=options, stops_seen=2, sequence=1)
                reading = client_request_of(params, program, line.service.line)
                assert isinstance(reading, Reading)
                assert (reading._request.client, reading._request.stops_seen) == (held, 3)
            made = client_request_of(WriteParams("axes", "5/1", 7), program, line.service.line)
            assert isinstance(made, Writing)
            assert (made._request.client, str(made._request.touches)) == (program.turn, "read element 1")
            with pytest.raises(InvalidCommand, match="is not a stop"):
                client_request_of(RequestParams("hcp2", 5, other, stop=True), program, line.service.line)

    on_a_line(tmp_path, story)


def test_a_read_ends_once_although_it_is_cancelled_afterwards(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        node, ends = Node.of(Hcp2Controller(line.bus, 5)), list[tuple[Any, BaseException | None]]()
        ended = asyncio.Event()

        def on_end(_: object, value: Any, error: BaseException | None) -> None:
            ends.append((value, error))
            ended.set()

        reading = Reading(node, protocol_of("hcp2").read_back(READ["command"]), ext.line_of(line.bus).add_client(1.0))
        reading.begin(on_end)
        assert not reading.done()
        await ended.wait()
        assert reading.done()
        reading.cancel()
        assert (ends, reading.given_up) == ([(0.0, None)], False)
        failing = Reading(
            Node.of(Hcp2Controller(line.bus, ABSENT)), reading.command, ext.line_of(line.bus).add_client(1.0)
        )
        failing.begin(on_end)
        failing.cancel()
        failing.cancel()
        assert (ends[1:], failing.given_up, failing.done()) == ([(None, None)], True, True)

    on_a_line(tmp_path, story)


def test_a_write_whose_audit_entry_is_not_on_the_disk_is_unconfirmed(tmp_path: Path) -> None:
    async def durable() -> str:
        return "disk full"

    async def story(line: Served) -> None:
        line.authorisation.record = lambda _: durable()
        async with raw(line) as client:
            reply = await client.ask("request", **write(2.5))
            assert "its audit entry is not on the disk: disk full" in reply["error"]["message"]
            data = reply["error"]["data"]
            assert (data["error"], data["label"], data["command"]) == (
                "WriteUnconfirmed",
                "node 5",
                "write element 1 = 2.5",
            )
            assert data["hint"] == "check why that output failed; the value need not be written again"
        assert await Hcp2Controller(line.bus, 5).read(1) == 2.5

    on_a_line(tmp_path, story)


def test_the_groups_of_programs_are_forgotten_when_they_have_ended(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        of_programs = line.service.line.of_programs
        async with connect(line.address) as remote:
            group = remote.poll_group("axes", period=0.02, points=[Hcp2Controller(remote, 5).point("1")])
            await group.ready()
            assert len(of_programs) == 1
            group.close()
            other = remote.poll_group("others", period=0.02, points=[Hcp2Controller(remote, 5).point("1")])
            await other.ready()
        await line.alone()

        def are_forgotten() -> bool:
            gc.collect()
            return not of_programs

        await until(are_forgotten)

    on_a_line(tmp_path, story)

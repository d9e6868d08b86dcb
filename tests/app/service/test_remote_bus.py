"""Handles, points, groups and errors on a line that another program owns: as on one's own."""

from __future__ import annotations

import asyncio
import gc
import json
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

from busmaster import (
    Hcp2Controller,
    MentorDrive,
    MicroFlexDrive,
    Node,
    Point,
    Priority,
    RemoteBus,
    ReplyTiming,
    Timings,
    connect,
    errors,
    ext,
)
from busmaster.app.bounds import MOST_CHECKED
from busmaster.app.service import link
from busmaster.app.service.failures import encode_error, error_of
from busmaster.app.service.fields import OptionsForm
from busmaster.app.service.link import Link
from busmaster.app.service.owner_messages import ErrorForm
from busmaster.app.service.remote_group import RemoteGroup
from busmaster.errors import (
    BusClosed,
    BusError,
    InvalidCommand,
    LineDown,
    NodeDown,
    NoReply,
    NotStarted,
    Refused,
    Superseded,
    WriteUnconfirmed,
)
from busmaster.events import NodeChanged
from busmaster.ext import CommandOptions
from busmaster.protocols.hcp2 import StatusWord
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.modbus.codec import PROFILE as MODBUS
from tests.app.service.lines import ABSENT, PATIENT, Served, on_a_line, on_a_served_line, served, until
from tests.patience import PATIENCE

RECEIVED = Link.received
BRIEF = Timings.uniform(ReplyTiming(0.02, 0.02, 0.02, 0.02))


def test_a_handle_reads_and_writes_on_another_programs_line(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        theirs, ours = Hcp2Controller(remote, 5), Hcp2Controller(line.bus, 5)
        await theirs.write(1, 123.5, verify=True)
        assert await ours.read(1) == await theirs.read(1, priority=Priority.URGENT) == 123.5
        drive = MicroFlexDrive(remote, 7)
        await drive.enable()
        status = await drive.status()
        assert isinstance(status, StatusWord)
        assert StatusWord.ENABLED in status
        await drive.disable()
        assert (remote.line, remote.about["clients"]) == ("the emulated line", 1)

    on_a_served_line(tmp_path, story)


def test_handles_may_be_made_before_the_bus_is_entered(tmp_path: Path) -> None:
    async def run() -> None:
        async with served(tmp_path) as line:
            ext.rename(Node.of(Hcp2Controller(line.bus, 5)), "winder")
            remote = connect(line.address)
            controller = Hcp2Controller(remote, 5)
            with pytest.raises(BusClosed, match="node 5: the bus is not open"):
                await controller.read(1)
            async with remote:
                await controller.write(1, 1)
                assert controller.node.label == "winder"

    asyncio.run(run())


def test_a_node_that_is_named_later_has_the_owners_label_too(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        ext.rename(Node.of(Hcp2Controller(line.bus, 5)), "winder")
        controller = Hcp2Controller(remote, 5)
        assert await controller.read(1) == 0
        assert controller.node.label == "winder"

    on_a_served_line(tmp_path, story)


def test_nodes_that_were_used_before_the_bus_was_entered_have_their_settings_and_labels_at_once(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        for address in (5, 6):
            ext.rename(Node.of(Hcp2Controller(line.bus, address)), f"winder {address}")
        remote = connect(line.address)
        known = [Hcp2Controller(remote, address) for address in (5, 6)]
        new = [Hcp2Controller(remote, address, timings=BRIEF, retries=0) for address in (ABSENT, ABSENT + 1)]
        async with remote:
            assert [controller.node.label for controller in known] == ["winder 5", "winder 6"]
            assert remote.line == "the emulated line"
            await remote.statistics()
            there = {node.address: node.planned().timings for node in line.bus.nodes}
            assert there[ABSENT] == there[ABSENT + 1] == BRIEF
            for controller in new:
                with pytest.raises(InvalidCommand, match="other retries"):
                    Hcp2Controller(line.bus, controller.node.address, timings=BRIEF, retries=3)
                Hcp2Controller(line.bus, controller.node.address, timings=BRIEF, retries=0)
            with pytest.raises(InvalidCommand, match=r"the bus of .*line.sock was already entered; enter it once"):
                await remote.__aenter__()

    on_a_line(tmp_path, story)


def test_a_write_that_was_prepared_is_checked_when_the_bus_is_entered(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        Hcp2Controller(line.bus, 6).point("1").limit(minimum=1, maximum=10)
        good, bad, stop = hcp2.Write(1, (10.0,)), hcp2.Write(1, (11.0,)), hcp2.Write(1, (0.0,))
        for commands, is_stop, accepted in (
            ([good], None, True),
            ([bad], None, False),
            ([good] * MOST_CHECKED + [bad], None, False),
            ([good] * MOST_CHECKED + [good], None, True),
            ([stop], True, True),
            ([stop], None, False),
            ([stop], False, False),
        ):
            remote = connect(line.address)
            Hcp2Controller(remote, 5).node.check(good)
            Hcp2Controller(remote, 6).node.check(*commands, stop=is_stop)
            if accepted:
                async with remote:
                    Hcp2Controller(remote, 6).node.check(bad)  # the line checks it when it is written
                    await remote.statistics()
            else:
                with pytest.raises(InvalidCommand, match=r"6: .*(maximum of 10|minimum of 1)"):
                    await remote.__aenter__()
            await line.alone()
        assert [outcome for _, outcome in line.audit()] == ["refused"] * 4

    on_a_line(tmp_path, story)


@pytest.mark.parametrize("name", [name for name in errors.__all__ if name not in ("Addressed", "InvalidCommand")])
def test_an_error_comes_back_as_the_same_class_with_the_same_fields(name: str) -> None:
    kind: type[BusError] = getattr(errors, name)
    error = kind("it went wrong", command="read element 1", attempts=3)
    error.line, error.label, error.address = "/dev/ttyUSB0", "winder", 5
    error.__cause__ = NoReply("no reply", hint="look again")
    again = error_of(msgspec.json.decode(msgspec.json.encode(encode_error(error)), type=ErrorForm))
    assert type(again) is kind
    assert vars(again) == vars(error)
    assert str(again) == str(error)
    assert type(again.__cause__) is NoReply
    assert again.__cause__.hint == "look again"


def test_a_final_refusal_stays_one() -> None:
    again = error_of(encode_error(Refused("a prefix may be stored", confirm=False)))
    assert isinstance(again, Refused)
    assert not again.confirm


@pytest.mark.slow
def test_an_error_of_the_line_is_raised_here_with_its_node_and_command(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        with pytest.raises(NoReply, match="no reply") as caught:
            await Hcp2Controller(remote, ABSENT).read(1, retries=0)
        error = caught.value
        assert (error.line, error.address, error.attempts) == ("the emulated line", ABSENT, 1)
        ends: list[type] = [type(error)]
        while NodeDown not in ends:  # until the budget for dead nodes is spent
            [end] = await asyncio.gather(Hcp2Controller(remote, ABSENT).read(1), return_exceptions=True)
            ends.append(type(end))
        assert set(ends) == {NoReply, NodeDown}
        with pytest.raises(InvalidCommand, match="address"):
            Hcp2Controller(remote, 999)

    on_a_served_line(tmp_path, story)


def test_times_run_out_as_on_the_line(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        absent = Hcp2Controller(remote, ABSENT, timings=PATIENT)
        holding = asyncio.ensure_future(absent.read(1, retries=0))
        await line.sent()
        present = Hcp2Controller(remote, 5)
        with pytest.raises(NotStarted):
            await present.write(1, 1, start_within=0.01)
        with pytest.raises(NotStarted):
            await present.write(1, 1, finish_within=0.01)
        with pytest.raises(NoReply):
            await holding
        assert line.audit() == [("5/write element 1 = 1", "not started")] * 2

    on_a_served_line(tmp_path, story)


def test_cancelling_here_cancels_there(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        holding = asyncio.ensure_future(Hcp2Controller(remote, ABSENT, timings=PATIENT).write(1, 1))
        await line.sent()
        waiting = asyncio.ensure_future(Hcp2Controller(remote, 5).write(1, 7))
        await until(lambda: ext.line_statistics(line.bus).backlog)
        waiting.cancel()
        holding.cancel()
        assert await asyncio.gather(waiting, holding, return_exceptions=True)
        await until(lambda: len(line.records) == 2)
        assert sorted(line.audit()) == [
            ("5/write element 1 = 7", "not started"),
            ("9/write element 1 = 1", "unconfirmed"),
        ]
        assert await Hcp2Controller(line.bus, 5).read(1) == 0

    on_a_served_line(tmp_path, story)


def test_a_stop_of_one_program_counts_for_all(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        async with connect(line.address) as other:
            mine, theirs, own = (MicroFlexDrive(bus, 7) for bus in (remote, other, line.bus))
            await mine.status()
            await theirs.status()
            stops = theirs.node.stops
            await mine.disable()
            await until(lambda: theirs.node.stops == stops + 1)
            assert own.node.stops == mine.node.stops == stops + 1
            with pytest.raises(Superseded, match="the node was stopped"):
                await theirs.node.request(hcp2.Write(5, (1,)), stops_seen=stops)
            own.node.note_stop()
            await until(lambda: theirs.node.stops == mine.node.stops == stops + 2)

    on_a_served_line(tmp_path, story)


def test_a_stop_of_long_ago_does_not_keep_cancel_errors_from_leaving_the_drive_enabled(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        own = MicroFlexDrive(line.bus, 7)
        await own.disable()
        await own.enable()
        status = await MicroFlexDrive(remote, 7).cancel_errors()  # it names the drive, and asks at once
        assert StatusWord.ENABLED in status

    on_a_served_line(tmp_path, story)


def test_hearing_of_a_node_is_not_naming_it(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        events = remote.events()
        async with connect(line.address) as other:
            await Hcp2Controller(other, 5).read(1)
            await anext(events)
        await until(lambda: not line.bus.nodes)

    on_a_served_line(tmp_path, story)


def test_handles_of_one_node_agree_on_its_timings(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        first = Hcp2Controller(remote, 5, timings=PATIENT)
        with pytest.raises(InvalidCommand, match="other timings or retries"):
            Hcp2Controller(remote, 5, retries=7)
        with pytest.raises(InvalidCommand, match="other timings or retries"):
            Hcp2Controller(remote, 5, timings=BRIEF)
        with pytest.raises(InvalidCommand, match="other timings or retries"):
            Hcp2Controller(remote, 5, timings=PATIENT, retries=7)
        with pytest.raises(InvalidCommand, match="other timings or retries"):
            Hcp2Controller(remote, 5, retries=0)
        with pytest.raises(InvalidCommand, match="address 999 does not exist"):
            Hcp2Controller(remote, 999)
        Hcp2Controller(remote, 5, timings=PATIENT)
        assert await first.read(1) == await Hcp2Controller(remote, 5).read(1) == 0

    on_a_served_line(tmp_path, story)


def test_a_disable_overtakes_what_another_program_waits_to_write(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        async with connect(line.address) as other:
            holding = asyncio.ensure_future(Hcp2Controller(remote, ABSENT, timings=PATIENT).read(1, retries=0))
            await line.sent()
            enabling = asyncio.ensure_future(MicroFlexDrive(other, 7).enable())
            await until(lambda: ext.line_statistics(line.bus).backlog)
            await MicroFlexDrive(remote, 7).disable()
            with pytest.raises(Superseded):
                await enabling
            await asyncio.gather(holding, return_exceptions=True)

    on_a_served_line(tmp_path, story)


def test_a_node_that_only_a_program_named_leaves_the_line_with_it(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        own = Hcp2Controller(line.bus, 5).node
        async with connect(line.address) as other:
            for bus, address in ((remote, 5), (other, 5), (remote, 6), (other, 6)):
                await Hcp2Controller(bus, address).read(1)
            with pytest.raises(NoReply):
                await Hcp2Controller(other, ABSENT).read(1, retries=0)
            assert {node.address for node in line.bus.nodes} == {5, 6, ABSENT}
        await until(lambda: len(line.bus.nodes) == 2)
        await remote.__aexit__(None, None, None)
        await line.alone()
        assert line.bus.nodes == (own,)
        assert Node.of(Hcp2Controller(line.bus, 5)).health.value == "up"

    on_a_served_line(tmp_path, story)


def test_a_node_with_other_timings_than_the_owners_is_refused_by_its_first_request(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        Hcp2Controller(line.bus, 5)
        with pytest.raises(InvalidCommand, match="other timings"):
            await Hcp2Controller(remote, 5, timings=PATIENT).read(1)
        assert await Hcp2Controller(remote, 6, timings=PATIENT, retries=1).read(1) == 0

    on_a_served_line(tmp_path, story)
    assert not caplog.records


def test_a_poll_group_of_the_owner_is_read_as_there(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        controller, absent = Hcp2Controller(line.bus, 5), Hcp2Controller(line.bus, ABSENT)
        points: list[Point[float]] = [controller.point("1"), absent.point("1")]
        group = line.bus.poll_group("axes", period=0.02, points=points)
        await until(lambda: [group.name for group in remote.groups] == ["axes"])
        theirs = remote.group("axes")
        ours = group.subscribe(1000)
        async for snapshot in theirs:
            same = await anext(ours)
            while same.cycle < snapshot.cycle:
                same = await anext(ours)
            good, bad = snapshot[Hcp2Controller(remote, 5).point("1")], snapshot[Hcp2Controller(remote, 9).point("1")]
            assert good == same[points[0]]
            assert type(bad.error) is type(same[points[1]].error)
            assert (snapshot.wall, snapshot.missed) == (same.wall, same.missed)
            break
        group.close()
        assert [snapshot async for snapshot in theirs.subscribe()] == [] if not theirs._over else True
        await until(lambda: not remote.groups)
        with pytest.raises(InvalidCommand, match="no poll group 'axis'; there are: none"):
            remote.group("axis")

    on_a_served_line(tmp_path, story)


def test_a_program_polls_its_own_points_until_it_leaves(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        async with connect(line.address) as other:
            drive = MicroFlexDrive(other, 7)
            group = other.poll_group("mine", period=0.02, points=[drive.status_word])
            await group.ready()
            async for snapshot in group:
                assert isinstance(snapshot[drive.status_word].value, StatusWord)
                break
            assert other.groups == (group,)
            await until(lambda: remote.groups)
            assert remote.groups[0].name == group.owners_name
            assert group.owners_name.startswith("mine (")
        await until(lambda: not (line.bus.groups or line.bus.nodes))

    on_a_served_line(tmp_path, story)


def test_a_group_that_begins_after_another_has_ended_takes_no_cycles_of_one_that_runs(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        drive = Hcp2Controller(remote, 5)

        def polled(item: str) -> RemoteGroup:
            return remote.poll_group(item, period=0.02, points=[drive.point(item)])

        ended, runs = polled("1"), polled("2")
        await asyncio.gather(ended.ready(), runs.ready())
        ended.close()
        new = polled("3")
        await new.ready()
        for group, item in ((runs, "2"), (new, "3")):
            cycles = group.subscribe()
            before = (await anext(cycles)).cycle
            after = await anext(cycles)
            assert (after.cycle > before, [point.item for point in after]) == (True, [item])

    on_a_served_line(tmp_path, story)


def test_events_tell_what_happens_there(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        events = remote.events()
        await remote.statistics()  # it is told what happens from before this on
        controller = Hcp2Controller(remote, 5)
        await controller.read(1)
        event = await anext(events)
        assert isinstance(event, NodeChanged)
        assert (event.node.label, event.before.value, event.after.value) == (controller.node.label, "unknown", "up")
        statistics = await remote.statistics()
        assert (statistics.exchanges, statistics.waits) == (1, (await line.bus.statistics()).waits)

    on_a_served_line(tmp_path, story)


def test_a_lost_connection_ends_each_request_truthfully(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        events = remote.events()
        writing = asyncio.ensure_future(Hcp2Controller(remote, ABSENT, timings=PATIENT).write(1, 1))
        reading = asyncio.ensure_future(Hcp2Controller(remote, 5).read(1))
        await line.sent()
        [connection] = line.service._clients.values()
        connection.websocket.abort()
        with pytest.raises(WriteUnconfirmed, match="the write may have been sent") as unconfirmed:
            await writing
        error = unconfirmed.value
        assert (error.label, error.address, error.command) == ("node 9", ABSENT, "write element 1 = 1")
        with pytest.raises(LineDown, match="node 5: the connection to the program that owns the line was lost"):
            await reading
        with pytest.raises(LineDown, match="connect again"):
            await Hcp2Controller(remote, 5).write(1, 1)
        assert [event async for event in events] == []

    on_a_served_line(tmp_path, story)


def test_what_was_not_handed_over_when_the_connection_was_lost_was_not_started(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        writing = asyncio.ensure_future(Hcp2Controller(remote, 5).write(1, 1))
        remote.link._end(LineDown, "it is lost", "connect again")  # before the loop turned
        await asyncio.sleep(0)
        remote2 = connect(line.address)
        async with remote2:
            assert remote2.link._connection is not None
            remote2.link._connection.full = True
            waiting = asyncio.ensure_future(Hcp2Controller(remote2, 5).write(1, 1))
            await asyncio.sleep(0)
            remote2.link._end(LineDown, "it is lost", "connect again")
            with pytest.raises(NotStarted, match="it is lost"):
                await waiting
        with pytest.raises(LineDown):
            await writing
        assert line.records == []

    on_a_served_line(tmp_path, story)


def test_an_owner_that_ends_tells_what_became_of_each_request(tmp_path: Path) -> None:
    async def run() -> None:
        async with served(tmp_path) as line:
            remote = connect(line.address)
            async with remote:
                writing = asyncio.ensure_future(Hcp2Controller(remote, ABSENT, timings=PATIENT).write(1, 1))
                await line.sent()
                waiting = asyncio.ensure_future(Hcp2Controller(remote, 5).write(1, 1))
                await until(lambda: ext.line_statistics(line.bus).backlog)
                await line.service.__aexit__(None, None, None)
                assert line.service.clients == ()
                assert len(line.records) == 2, "what became of them is known when the service has ended"
                with pytest.raises(WriteUnconfirmed, match="the program that owns the line ends") as unconfirmed:
                    await writing
                assert unconfirmed.value.hint == WriteUnconfirmed.hint
                with pytest.raises(BusClosed, match=r"that owns the line ends .*; start it, and connect again"):
                    await waiting
                assert sorted(line.audit())[0][1] == "not started"
                assert {record.error for record in line.records} == {
                    "the program that owns the line ended before the reply",
                    "the program that owns the line ended before it was sent",
                }
                await line.service.__aenter__()

    asyncio.run(run())


def test_nobody_there_is_said_with_what_to_do(tmp_path: Path) -> None:
    async def run() -> None:
        with pytest.raises(LineDown, match=r"no program serves .*line.sock: .*; start busmaster run"):
            async with connect(f"unix:{tmp_path}/line.sock"):
                pass
        with pytest.raises(LineDown, match=r"no running line named 'slitter' \(running: "):
            async with connect("slitter"):
                pass
        with socket.create_server(("127.0.0.1", 0)) as left:
            port = left.getsockname()[1]
        with pytest.raises(LineDown, match=f"no program serves 127.0.0.1:{port}: Connection refused; start"):
            async with connect(f"tcp://127.0.0.1:{port}"):
                pass

    asyncio.run(run())


def test_a_program_that_could_not_connect_leaves_no_error_that_nobody_hears(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[link.PendingRequest] = []
    make = link.PendingRequest

    def kept(*arguments: Any) -> link.PendingRequest:
        asked.append(make(*arguments))
        return asked[-1]

    async def run() -> None:
        monkeypatch.setattr(link, "PendingRequest", kept)
        with pytest.raises(LineDown):
            await connect(f"unix:{tmp_path}/line.sock").__aenter__()
        assert [one.future.cancelled() for one in asked] == [True]

    asyncio.run(run())


@pytest.mark.parametrize("withheld", ["hello", "now", "check"])
def test_a_program_that_is_cancelled_while_it_enters_leaves_no_connection(
    withheld: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    receive, ask = Link.received, Link.ask

    def note(self: Link, method: str, params: Any, **options: Any) -> link.PendingRequest:
        asked.append(method)
        return ask(self, method, params, **options)

    def without_the_reply(self: Link, text: str | bytes) -> None:
        if (asked[-1] if asked else "hello") != withheld:
            receive(self, text)

    async def run() -> None:
        async with asyncio.timeout(PATIENCE), served(tmp_path, listen=("127.0.0.1", 0)) as line:
            assert line.service.tcp_address is not None
            with monkeypatch.context() as patch:
                patch.setattr(Link, "ask", note)
                patch.setattr(Link, "received", without_the_reply)
                remote = connect(line.address if withheld == "check" else line.service.tcp_address)
                if withheld == "check":
                    Hcp2Controller(remote, 5).node.check(hcp2.Write(1, (1.0,)))
                entering = asyncio.ensure_future(remote.__aenter__())
                await until(lambda: line.service.clients and (withheld == "hello" or withheld in asked))
                entering.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await entering
            await line.alone()

    asyncio.run(run())


def test_an_owner_of_another_version_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def story(line: Served) -> None:
        monkeypatch.setattr(link, "VERSIONS", (99,))
        with pytest.raises(
            LineDown, match=r"does not admit this program: the service protocol has version 3 here, not \[99\]"
        ):
            await connect(line.address).__aenter__()

    on_a_line(tmp_path, story)


def test_a_program_that_has_the_line_and_stands_still_is_told_from_one_that_is_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busmaster.app.service.link.CONNECT_WITHIN", 0.05)
    path = tmp_path / "line.sock"

    async def run() -> None:
        with pytest.raises(LineDown, match=r"that serves .*line.sock did not reply within 0.05 s; if it hangs"):
            async with connect(f"unix:{path}"):
                pass

    with socket.socket(socket.AF_UNIX) as stopped:
        stopped.bind(str(path))
        stopped.listen()  # the system lets others in, and nobody looks
        asyncio.run(run())


def test_limits_and_the_safe_state_stay_with_the_owner(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        Hcp2Controller(line.bus, 5).point("1").limit(maximum=10)
        controller = Hcp2Controller(remote, 5)
        with pytest.raises(InvalidCommand, match="10"):
            await controller.write(1, 11)
        with pytest.raises(InvalidCommand, match="limits are held by the program that owns the line"):
            controller.point("1").limit(maximum=20)
        with pytest.raises(InvalidCommand, match="the safe state is sent by the program that owns the line"):
            await controller.write(1, 1, safe=True)
        await controller.write(1, 9)
        line.bus._take_only_safe_writes()
        with pytest.raises(Superseded):
            await controller.write(1, 8)
        assert [outcome for _, outcome in line.audit()] == ["refused", "written", "not started"]

    on_a_served_line(tmp_path, story)


@pytest.mark.parametrize(
    "said",
    [
        '{"jsonrpc": "2.0", "id": 1, "error": 3}',
        '{"jsonrpc": "2.0", "id": 1, "error": {"data": {"label": 3}}}',
        "[]",
        "{",
    ],
)
def test_an_answer_that_is_not_understood_leaves_nobody_waiting(
    said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Link, "received", RECEIVED)  # it is not checked by the schema

    async def story(line: Served, remote: RemoteBus) -> None:
        writing = asyncio.ensure_future(Hcp2Controller(remote, ABSENT, timings=PATIENT).write(1, 1))
        await line.sent()
        remote.link.received(said.replace('"id": 1', f'"id": {remote.link._count}'))
        with pytest.raises(WriteUnconfirmed, match="sent an invalid message"):
            await writing

    on_a_served_line(tmp_path, story)


def test_an_event_of_a_node_whose_protocol_is_not_installed_is_ignored(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        events = remote.events()
        await remote.statistics()
        node = {"protocol": "of-a-plugin", "address": 1, "label": "node 1"}
        body = {"event": "NodeChanged", **node, "before": "unknown", "after": "up", "returning": False}
        params = {"stream": 0, "dropped": 0, "body": body}
        remote.link.received(json.dumps({"jsonrpc": "2.0", "method": "event", "params": params}))
        assert await Hcp2Controller(remote, 5).read(1) == 0
        event = await anext(events)
        assert isinstance(event, NodeChanged)
        assert event.node.address == 5

    on_a_served_line(tmp_path, story)


def test_events_of_a_line_that_was_lost_before_it_replied_leave_no_error_that_nobody_hears(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        events = remote.events()
        [connection] = line.service._clients.values()
        connection.websocket.abort()
        assert [event async for event in events] == []

    on_a_served_line(tmp_path, story)
    gc.collect()
    assert not caplog.records


def test_a_message_of_a_stream_that_has_ended_is_ignored(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        params = {"stream": 7, "dropped": 0, "body": {}}  # it was on its way when the stream ended
        remote.link.received(json.dumps({"jsonrpc": "2.0", "method": "ended", "params": params}))
        assert await Hcp2Controller(remote, 5).read(1) == 0

    on_a_served_line(tmp_path, story)


def test_a_sample_of_a_program_serves_until_a_write_by_whatever_program_has_made_it_stale(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        mine, theirs = Hcp2Controller(remote, 5).point("1"), Hcp2Controller(line.bus, 5).point("1")
        assert await mine.read(max_age=60) == 0
        group = remote.poll_group("mine", period=60, points=[mine])
        await group.ready()
        cycles = group.subscribe()
        line.bus.groups[0].demand()
        snapshot = await anext(cycles)
        exchanges = (await line.bus.statistics()).exchanges
        assert mine.node.latest(mine) is snapshot[mine]
        assert await mine.read(max_age=60) == 0
        assert (await line.bus.statistics()).exchanges == exchanges
        await theirs.write(7)
        assert await Hcp2Controller(remote, 6).read(1) == 0
        assert mine.node.latest(mine) is None
        assert await mine.read(max_age=60) == 7
        group.close()
        assert remote.latest(mine) is None

    on_a_served_line(tmp_path, story)


def test_all_that_follow_a_line_are_informed_and_all_streams_end_with_the_connection(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        changed: list[str] = []
        remote.on_access.extend([lambda: changed.append("first"), lambda: changed.append("second")])
        touched: list[tuple[str, object]] = []
        remote.on_touched.append(lambda body: touched.append(("a", body["address"])))
        remote.on_touched.append(lambda body: touched.append(("b", body["address"])))
        events = [remote.events() for _ in range(3)]
        groups = [
            remote.poll_group(name, period=60, points=[Hcp2Controller(remote, 5).point("1")]) for name in ("one", "two")
        ]
        await asyncio.gather(*(group.ready() for group in groups))
        cycles = [group.subscribe() for group in groups]
        await Hcp2Controller(line.bus, 6).write(1, 5)
        seen = [await anext(stream) for stream in events]
        assert seen[0] is seen[1] is seen[2]
        await until(lambda: len(touched) == 2)
        assert touched == [("a", 6), ("b", 6)]
        line.authorisation.read_only = True
        line.service._notify_access()
        await until(lambda: changed == ["first", "second"])
        [connection] = line.service._clients.values()
        connection.websocket.abort()
        for stream in events:
            assert [event async for event in stream if not isinstance(event, NodeChanged)] == []
        for stream_of_cycles in cycles:
            assert len([snapshot async for snapshot in stream_of_cycles]) <= 1
        assert all(group.over for group in groups)
        assert not remote._streams

    on_a_served_line(tmp_path, story)


def test_events_are_requested_once_however_many_follow_them(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        first, second = remote.events(), remote.events()
        await Hcp2Controller(remote, 5).read(1)
        await Hcp2Controller(remote, 6).read(1)
        await remote.statistics()
        for stream in (first, second):
            heard = [await anext(stream) for _ in range(2)]
            assert [event.node.address for event in heard if isinstance(event, NodeChanged)] == [5, 6]
        assert line.service.clients[0]._streams.keys() == {0}

    on_a_served_line(tmp_path, story)


def test_the_youngest_good_sample_of_all_groups_of_this_program_serves(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        point, other = Hcp2Controller(remote, 5).point("1"), Hcp2Controller(remote, 5).point("2")
        names = ("first", "second", "third")
        groups = {name: remote.poll_group(name, period=60, points=[point]) for name in names}
        theirs = line.bus.poll_group("owner", period=60, points=[Hcp2Controller(line.bus, 5).point("2")])
        await until(lambda: len(remote.groups) == 4)
        follows = remote.group("owner")
        for group in (*groups.values(), follows):
            await group.ready()
        for name in ("first", "third", "second"):
            group, before = groups[name], groups[name].latest
            line.bus.group(group.owners_name).demand()
            while group.latest in (None, before):  # noqa: ASYNC110  nothing reports it
                await asyncio.sleep(0.001)
        latest = groups["second"].latest
        assert latest is not None
        assert remote.latest(point) is latest[point]
        theirs.demand()
        await until(lambda: follows.latest)
        assert remote.latest(other) is None, "only of groups of this program"

    on_a_served_line(tmp_path, story)


@pytest.mark.parametrize("count", [1, 2, 3, 6, 7])
def test_a_group_of_many_points_is_sent_in_several_messages(
    count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busmaster.app.service.remote.POINTS_IN_A_MESSAGE", 2)

    async def story(line: Served, remote: RemoteBus) -> None:
        points = [Hcp2Controller(remote, 5).point(str(number + 1)) for number in range(count)]
        group = remote.poll_group("mine", period=60, phase=7.0, priority=Priority.BACKGROUND, points=points)
        await group.ready()
        [own] = line.bus.groups
        assert [point.key for point in own.points] == [point.key for point in points]
        planned = own.planned()
        assert (planned.period, planned.phase, planned.priority) == (60, 7.0, Priority.BACKGROUND)

    on_a_served_line(tmp_path, story)


def test_a_group_that_cannot_be_is_rejected_before_it_is_requested(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        points = [Hcp2Controller(remote, 5).point("1")]
        drive = MentorDrive(remote, 14)
        broadcast: Point[Any] = Point(remote.node(drive.node.profile, 0), "1", points[0].command)
        wrong: list[tuple[dict[str, Any], str]] = [
            ({"period": "soon"}, "poll group 'mine': a period"),
            ({"phase": -1.0}, "poll group 'mine': a phase"),
            ({"priority": 17}, "priority"),
            ({"points": [*points, Hcp2Controller(line.bus, 5).point("1")]}, "5/1 belongs to another bus"),
            ({"points": [*points, broadcast]}, "which is the address of all nodes"),
        ]
        for given, why in wrong:
            with pytest.raises(InvalidCommand, match=why):
                remote.poll_group("mine", **{"period": 60, "points": points, **given})
        assert remote.groups == ()
        with pytest.raises(InvalidCommand, match="node 5: another's line only supports the standard hcp2"):
            remote.node(replace(Hcp2Controller.profile, addresses=range(1, 9)), 5)

    on_a_served_line(tmp_path, story)


def test_a_group_is_rejected_at_once_before_the_bus_is_entered_and_after_its_connection_is_lost(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        remote = connect(line.address)
        points = [Hcp2Controller(remote, 5).point("1")]
        with pytest.raises(BusClosed, match="the bus is not open"):
            remote.poll_group("mine", period=60, points=points)
        async with remote:
            events = remote.events()
            [connection] = line.service._clients.values()
            connection.websocket.abort()
            assert [event async for event in events] == []
            with pytest.raises(LineDown):
                remote.poll_group("mine", period=60, points=points)
            assert remote.groups == ()

    on_a_line(tmp_path, story)


class Requested:
    """The requests and notifications that a program sends to the owner from now on, by their method."""

    def __init__(self, remote: RemoteBus, monkeypatch: pytest.MonkeyPatch) -> None:
        self._all: list[tuple[str, Any]] = []
        ask = remote.link.ask

        def noted(method: str, params: Any, **options: Any) -> link.PendingRequest:
            self._all.append((method, params))
            return ask(method, params, **options)

        notify = remote.link.notify

        def notified(method: str, params: Any) -> None:
            self._all.append((method, params))
            notify(method, params)

        monkeypatch.setattr(remote.link, "ask", noted)
        monkeypatch.setattr(remote.link, "notify", notified)

    def of(self, method: str) -> list[Any]:
        return [params for asked, params in self._all if asked == method]


def test_a_node_and_events_are_requested_once_and_points_a_few_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busmaster.app.service.remote.POINTS_IN_A_MESSAGE", 2)

    async def story(line: Served, remote: RemoteBus) -> None:
        requested = Requested(remote, monkeypatch)
        controllers = [Hcp2Controller(remote, 5) for _ in range(3)]
        for _ in range(2):
            remote.events()
        points = [controllers[0].point(str(number + 1)) for number in range(7)]
        await remote.poll_group("mine", period=60, points=points).ready()
        assert len(requested.of("node")) == len(requested.of("events")) == 1
        assert [len(params.points) for method in ("gather", "poll") for params in requested.of(method)] == [2, 2, 2, 1]

    on_a_served_line(tmp_path, story)


def test_a_group_that_the_owner_rejects_leaves_no_stream_here_or_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busmaster.app.service.client.MOST_STREAMS", 0)

    async def story(line: Served, remote: RemoteBus) -> None:
        requested = Requested(remote, monkeypatch)
        group = remote.poll_group("mine", period=60, points=[Hcp2Controller(remote, 5).point("1")])
        with pytest.raises(InvalidCommand, match="streams at most"):
            await group.ready()
        assert (group.over, remote.groups, remote._streams) == (True, (), {})
        [poll], [end] = requested.of("poll"), requested.of("end")
        assert end.stream == poll.stream

    on_a_served_line(tmp_path, story)


def test_of_groups_of_one_name_that_of_this_program_is_found_and_is_listed_last(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        polled = line.bus.poll_group("axes", period=60, points=[Hcp2Controller(line.bus, 5).point("1")])
        await until(lambda: remote.groups)
        theirs = remote.group("axes")
        own = remote.poll_group("axes", period=60, points=[Hcp2Controller(remote, 6).point("1")])
        assert remote.groups == (theirs, own)
        assert remote.group("axes") is own
        await own.ready()
        polled.close()
        await until(lambda: remote.groups == (own,))

    on_a_served_line(tmp_path, story)


def test_a_group_that_the_owner_has_made_again_has_its_new_period_when_it_is_followed(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        points = [Hcp2Controller(line.bus, 5).point("1")]
        polled = line.bus.poll_group("axes", period=60, points=points)
        await until(lambda: remote.groups)
        polled.close()
        await until(lambda: not remote.groups)
        line.bus.poll_group("axes", period=70, points=points)
        await until(lambda: remote.groups)
        group = remote.group("axes")
        await group.ready()
        assert group.period == 70

    on_a_served_line(tmp_path, story)


def test_all_that_a_caller_chose_is_in_the_request(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        requested = Requested(remote, monkeypatch)
        node = Hcp2Controller(remote, 5).node
        options: CommandOptions = {
            "priority": Priority.URGENT,
            "start_within": 50.0,
            "finish_within": 60.0,
            "retries": 3,
            "idempotent": True,
        }
        write, read = hcp2.Write(1, (0.0,)), hcp2.Read(1)
        form, touches = ({"command": "write", "element": 1, "values": (0.0,)}, {"command": "read", "element": 2})
        before = remote.now()
        await node.request(write, touches=hcp2.Read(2), stops_seen=0, stop=True, **options)
        async with node.exclusive(max_hold=4.5) as held:
            await held.request(write, touches=hcp2.Read(2), stops_seen=0, stop=True, **options)
        await node.request(write)
        await node.request(read)
        await node.request(read, retries=2)
        own, in_sequence, plain, plain_read, read_with_options = requested.of("request")
        for params, sequence in ((own, None), (in_sequence, 1)):
            assert (params.protocol, params.address, params.command, params.touches) == ("hcp2", 5, form, touches)
            assert (params.stops_seen, params.stop, params.sequence) == (0, True, sequence)
            assert params.options == OptionsForm(Priority.URGENT, 50.0, 60.0, 3, True)
            assert before <= params.requested <= remote.now()
        assert plain.requested >= before, "a write is refused if it is old when it arrives"
        assert (plain.options, plain.stop, plain.sequence) == (None, False, None)
        assert plain_read.requested is None
        assert read_with_options.requested >= before
        with pytest.raises(ValueError, match="of the caller"):
            async with node.exclusive(max_hold=5.0):
                raise ValueError("of the caller")
        assert [(params.sequence, params.max_hold) for params in requested.of("hold")] == [(1, 4.5), (2, 5.0)]
        assert [params.sequence for params in requested.of("release")] == [1, 2]
        with pytest.raises(InvalidCommand, match="verify is only available for the write methods of a handle"):
            await node.request(write, verify=True)  # type: ignore[call-arg]  # only a handle has it
        with pytest.raises(InvalidCommand, match="the safe state is sent by the program that owns the line"):
            await node.request(write, safe=True)

    on_a_served_line(tmp_path, story)


def test_a_node_of_another_line_counts_its_stops_at_once_and_has_merged_reads(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        node = Hcp2Controller(remote, 5).node
        node.note_stop()
        assert node.stops == 1, "a write that was decided before it is superseded already here"
        assert node.line == "the emulated line"
        unit = remote.node(MODBUS, 3)
        assert unit.profile.merge is not None

        def merge(*_: object) -> list[Any]:
            return []

        unit.merge_reads(merge)
        assert unit.profile.merge is merge

    on_a_served_line(tmp_path, story)


def test_the_nodes_are_those_of_the_owner_whose_protocol_is_installed_and_those_of_this_program(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        Hcp2Controller(line.bus, 5)
        async with connect(line.address) as remote:
            own = Hcp2Controller(remote, 6).node
            Hcp2Controller(remote, 5)
            foreign = {"protocol": "of-a-plugin", "address": 1, "label": "node 1", "health": "up"}
            remote.about = {**remote.about, "nodes": [foreign, *remote.about["nodes"]]}
            assert [node.address for node in remote.nodes] == [5, 6]
            assert remote.nodes[1] is own

    on_a_line(tmp_path, story)


def test_a_sample_is_not_latest_if_it_failed_or_was_requested_before_the_last_write(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        point = Hcp2Controller(remote, 5).point("1")
        absent = Hcp2Controller(remote, ABSENT, timings=BRIEF, retries=0).point("1")
        group = remote.poll_group("mine", period=60, points=[point, absent])
        await group.ready()
        [own] = line.bus.groups
        for _ in range(2):
            before = group.latest
            own.demand()
            while group.latest in (None, before):  # noqa: ASYNC110  nothing reports it
                await asyncio.sleep(0.001)
            sample = remote.latest(point)
            assert sample is not None
            assert remote.latest(absent) is None
            await Hcp2Controller(line.bus, 5).write(1, 5)
            await until(lambda: remote.latest(point) is None)
        assert sample is not None
        assert sample.started is not None
        remote._touched["hcp2", 5] = (sample.started + sample.finished) / 2
        assert remote.latest(point) is None
        remote._touched["hcp2", 5] = sample.started - 0.001
        assert remote.latest(point) is sample

    on_a_served_line(tmp_path, story)


def test_an_ordinary_request_waits_for_its_place_and_gives_it_back_and_others_need_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busmaster.app.service.sequences.MOST_UNDER_WAY", 1)

    async def story(line: Served, remote: RemoteBus) -> None:
        node, read = Hcp2Controller(remote, 5).node, hcp2.Read(1)
        for priority in (Priority.COMMAND, Priority.URGENT):
            await node.request(read, priority=priority)
            assert remote.room._free == 1
        assert remote.room.take()
        await node.request(read, priority=Priority.URGENT)
        async with node.exclusive(max_hold=5.0) as held:
            await held.request(read)
        requested = Requested(remote, monkeypatch)
        waiting = asyncio.ensure_future(node.request(read, start_within=50.0))
        await until(lambda: remote.room._waiting)
        remote._ahead += 10.0  # seconds that it waits
        remote.room.give_back()
        await waiting
        [params] = requested.of("request")
        assert params.options.start_within <= 40.0
        assert remote.room._free == 1

    on_a_served_line(tmp_path, story)

"""Programs take turns on a line, and hold it for sequences: as they do it, by the socket."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from busmaster import Hcp2Controller, Priority, RemoteBus, Service, connect, ext
from busmaster.app.bounds import MOST_HOLDS, MOST_REQUESTS, MOST_UNDER_WAY
from busmaster.arbiter.choice import MOST_BEFORE
from busmaster.arbiter.clients import Hold, LineClient
from busmaster.arbiter.shared_backlog import PASSED_BY_EACH
from busmaster.arbiter.transaction import Transaction
from busmaster.contract.bounds import MOST_RETRIES
from busmaster.errors import BusError, HoldEnded, InvalidCommand, NotStarted
from busmaster.protocols.hcp2 import codec as hcp2
from tests.app.service.lines import ABSENT, PATIENT, Served, on_a_line, on_a_served_line, raw, until

MANY = MOST_REQUESTS + MOST_REQUESTS // 2


def watched(line: Served) -> list[Transaction]:
    """What is asked on the line from now on, in its order."""
    asked: list[Transaction] = []
    arbiter = line.bus._line.arbiter
    submit = arbiter.submit

    def watch(transaction: Transaction, now: float) -> bool:
        asked.append(transaction)
        return submit(transaction, now)

    arbiter.submit = watch  # type: ignore[method-assign]  # what goes out is seen here
    return asked


def held_no_longer(hold: Hold) -> bool:
    return hold.over


async def given_up(asked: Sequence[asyncio.Future[Any]]) -> None:
    for one in asked:
        one.cancel()
    await asyncio.gather(*asked, return_exceptions=True)


def payer(transaction: Transaction) -> LineClient | None:
    client = transaction.client
    return client.client if isinstance(client, Hold) else client


@pytest.mark.slow
def test_a_program_that_asks_more_than_it_may_at_a_time_has_it_all_answered(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        controller = Hcp2Controller(remote, 5)
        await controller.write(3, 7)
        most = 0

        async def look() -> None:
            nonlocal most
            while True:
                most = max(most, *(len(client.unfinished) for client in line.service.clients))
                await asyncio.sleep(0)

        looking = asyncio.ensure_future(look())
        values = await asyncio.gather(*(controller.read(3) for _ in range(MANY)))
        looking.cancel()
        assert values == [7] * MANY
        assert most <= MOST_UNDER_WAY

    on_a_served_line(tmp_path, story)


@pytest.mark.slow
def test_requests_that_are_given_up_make_room_for_others(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        controller = Hcp2Controller(remote, 5)
        absent = Hcp2Controller(line.bus, ABSENT, timings=PATIENT)
        own = asyncio.ensure_future(absent.read(1))
        asked = [asyncio.ensure_future(controller.read(1)) for _ in range(MANY)]
        await until(lambda: any(len(client.unfinished) == MOST_UNDER_WAY for client in line.service.clients))
        for one in asked:
            one.cancel()
        assert await asyncio.gather(*(controller.read(1) for _ in range(MOST_UNDER_WAY))) == [0] * MOST_UNDER_WAY
        await asyncio.gather(own, *asked, return_exceptions=True)

    on_a_served_line(tmp_path, story)


@pytest.mark.slow
@pytest.mark.parametrize("limit", ["start_within", "finish_within"])
def test_r12_what_waits_in_its_own_program_for_too_long_was_not_started(tmp_path: Path, limit: str) -> None:
    options: dict[str, Any] = {limit: 0.01}

    async def story(line: Served, remote: RemoteBus) -> None:
        absent = Hcp2Controller(remote, ABSENT, timings=PATIENT)
        waiting = [asyncio.ensure_future(absent.read(1)) for _ in range(2 * MOST_UNDER_WAY)]
        await until(lambda: any(len(client.unfinished) == MOST_UNDER_WAY for client in line.service.clients))
        with pytest.raises(NotStarted, match="of this program have no reply yet"):
            await Hcp2Controller(remote, 5).write(1, 7, **options)
        await given_up(waiting)
        # The reply of the absent node could still come: on a busy machine some attempts are ambiguous.
        assert await Hcp2Controller(remote, 5).read(1, retries=MOST_RETRIES) == 0

    on_a_served_line(tmp_path, story)


@pytest.mark.slow
def test_r9_an_urgent_request_waits_for_nothing_else_of_its_program(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        controller = Hcp2Controller(remote, 5)
        flood = [asyncio.ensure_future(controller.read(1)) for _ in range(MANY)]
        await until(lambda: line.service.clients[0].unfinished)
        await controller.read(2, priority=Priority.URGENT)
        assert not flood[-1].done()
        await given_up(flood)

    on_a_served_line(tmp_path, story)


@pytest.mark.slow
def test_r9_a_program_with_thousands_of_requests_delays_anothers_by_two_exchanges_at_most(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        asked = watched(line)
        async with connect(line.address) as other:
            flooding, asking = Hcp2Controller(remote, 5), Hcp2Controller(other, 6)
            await asyncio.gather(flooding.read(1), asking.read(1))
            flooder, asker = payer(asked[0]), payer(asked[1])
            assert flooder is not asker
            await asking.write(1, -1)  # the first write of a line waits for a maximum reply delay, reads do not
            flood = [asyncio.ensure_future(flooding.read(1)) for _ in range(MANY)]
            await until(lambda: ext.line_statistics(line.bus).backlog > MOST_UNDER_WAY / 2)
            for number in range(20):
                await asking.write(1, number)
                await Hcp2Controller(line.bus, 6).read(1)
            assert not flood[-1].done()
            await given_up(flood)
            mine = [one for one in asked if payer(one) is not flooder]
            assert len(mine) >= 40
            ahead = sorted(one.exchanges_ahead for one in mine)
            assert ahead[len(mine) // 2] <= 1 + PASSED_BY_EACH, "beside the one that is on the wire"
            assert ahead[-1] <= 1 + PASSED_BY_EACH * (1 + MOST_BEFORE) + MOST_BEFORE, "with checks before each"

    on_a_served_line(tmp_path, story)


@pytest.mark.slow
def test_r9_a_sequence_of_one_program_is_not_interrupted_by_another(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        async with connect(line.address) as other:
            over = asyncio.Event()

            async def disturb() -> None:
                theirs, ours = Hcp2Controller(other, 5), Hcp2Controller(line.bus, 5)
                while not over.is_set():
                    await asyncio.gather(theirs.write(1, -1), ours.write(1, -2), theirs.read(2))

            others = asyncio.ensure_future(disturb())
            mine = Hcp2Controller(remote, 5)
            for number in range(30):
                async with mine.exclusive(max_hold=5.0) as held:
                    await held.write(1, number)
                    assert await held.read(1) == number
            over.set()
            await others

    on_a_served_line(tmp_path, story)


@pytest.mark.slow
def test_a_sequence_of_a_program_that_floods_the_line_itself_goes_on(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        mine = Hcp2Controller(remote, 5)
        flood = [asyncio.ensure_future(mine.read(2)) for _ in range(MANY)]
        async with mine.exclusive(max_hold=5.0) as held:
            await held.write(1, 5)
            done = sum(one.done() for one in flood)
            for _ in range(5):
                assert await held.read(1) == 5
            assert sum(one.done() for one in flood) == done
        await given_up(flood)

    on_a_served_line(tmp_path, story)


def test_a_sequence_ends_with_its_program(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        asked = watched(line)
        async with connect(line.address) as other, Hcp2Controller(other, 5).exclusive(max_hold=5.0) as held:
            await held.write(1, 5)
            [hold] = {one.client for one in asked}
            assert isinstance(hold, Hold)
            waits = asyncio.ensure_future(Hcp2Controller(remote, 6).read(1))
            await until(lambda: len(asked) == 2)
            assert not held_no_longer(hold)
            other.link._connection.transport.abort()  # type: ignore[union-attr]  # it is connected
            await waits
            assert held_no_longer(hold)
            with pytest.raises(BusError):
                await held.read(1)

    on_a_served_line(tmp_path, story)


@pytest.mark.parametrize("sequences", [1, 3])
def test_a_program_that_leaves_gives_back_its_sequences_and_its_nodes(tmp_path: Path, sequences: int) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            for number in range(sequences):
                hold = {"sequence": number, "protocol": "hcp2", "address": 5 + number, "max_hold": 5.0}
                await client.say(method="hold", params=hold)
            refused = {"sequence": sequences, "protocol": "none", "address": 5, "max_hold": 5.0}
            await client.say(method="hold", params=refused)
            read = {"protocol": "hcp2", "address": 5, "command": {"command": "read", "element": 1}}
            assert (await client.ask("request", **read, sequence=0))["result"] == 0
            [program] = line.service.clients
            holds = [hold for hold in program._holds.values() if isinstance(hold, Hold)]
            assert len(line.bus.nodes) == sequences
            assert ext.line_of(line.bus).clients == 1
        await until(lambda: not line.bus.nodes)
        assert ext.line_of(line.bus).clients == 0
        assert [held_no_longer(hold) for hold in holds] == [True] * sequences

    on_a_line(tmp_path, story)


def test_a_sequence_whose_time_is_over_says_so_to_its_program(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        async with Hcp2Controller(remote, 5).exclusive(max_hold=0.02) as held:
            await held.write(1, 5)
            await Hcp2Controller(line.bus, 6).read(1)  # waits until it is over
            with pytest.raises(HoldEnded, match=r"node 5: the sequence has ended: its 0\.02 s .* max_hold"):
                await held.write(1, 6)
        assert line.audit() == [("5/write element 1 = 5", "written"), ("5/write element 1 = 6", "not started")]

    on_a_served_line(tmp_path, story)


def test_a_program_holds_the_line_for_so_many_sequences_and_none_that_cannot_be(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        with pytest.raises(InvalidCommand, match="max_hold"):
            async with Hcp2Controller(remote, 5).exclusive(max_hold=6.0):
                pass
        async with raw(line) as client:
            read = {"protocol": "hcp2", "address": 5, "command": {"command": "read", "element": 1}}
            for params, complaint in (
                ({}, "'max_hold' is missing"),
                ({"max_hold": 6.0}, "held for 5 s at most"),
                ({"max_hold": "x"}, "max_hold"),
                ({"max_hold": 1.0, "protocol": "none"}, "no such protocol"),
            ):
                named = {"sequence": 1, "protocol": "hcp2", "address": 5, **params}
                await client.say(method="hold", params=named)
                said = await client.ask("request", **read, sequence=1)
                assert complaint in said["error"]["message"]
            for number in range(MOST_HOLDS + 1):
                params = {"sequence": number, "protocol": "hcp2", "address": 5, "max_hold": 1.0}
                await client.say(method="hold", params=params)
            assert "result" in await client.ask("request", **read, sequence=MOST_HOLDS - 1)
            await client.say(method="release", params={"sequence": MOST_HOLDS - 1})
            said = await client.ask("request", **read, sequence=MOST_HOLDS)
            assert "no sequence" in said["error"]["message"]
            said = await client.ask("request", **{**read, "address": 6}, sequence=0)
            assert "no sequence" in said["error"]["message"]

    on_a_served_line(tmp_path, story)


def test_programs_that_have_gone_leave_nothing_on_the_line(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        before = line.bus._line.clients
        for _ in range(5):
            async with connect(line.address) as other:
                async with Hcp2Controller(other, 5).exclusive() as held:
                    await held.read(1)
                await Hcp2Controller(other, 5).read(2, priority=Priority.POLL)
            await until(lambda: line.bus._line.clients == before)
        backlog = line.bus._line.arbiter.dispatcher.share()
        assert all(len(turns._turns) <= 2 for turns in backlog._turns)

    on_a_served_line(tmp_path, story)


def test_r9_the_longest_wait_counts_the_programs_that_are_connected(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        await Hcp2Controller(line.bus, 5).read(1)
        with_one = line.bus.worst_case_wait(), (await line.bus.plan()).worst_waits[Priority.URGENT]
        async with connect(line.address) as other:
            await other.statistics()
            assert line.bus.worst_case_wait() > with_one[0]
            assert (await line.bus.plan()).worst_waits[Priority.URGENT] > with_one[1]

    on_a_served_line(tmp_path, story)


@pytest.mark.parametrize("share", [0.0, 0.05, 11, float("nan"), True])
def test_a_share_that_cannot_be_is_refused(tmp_path: Path, share: float) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        with pytest.raises(InvalidCommand, match=r"0\.1 to 10"):
            Service(line.bus, path=tmp_path / "other.sock", share=share)

    on_a_served_line(tmp_path, story)


def test_the_share_of_a_service_is_that_of_its_programs(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        asked = watched(line)
        async with (
            Service(line.bus, path=tmp_path / "other.sock", share=0.25) as service,
            connect(service.address) as other,
        ):
            await Hcp2Controller(other, 5).node.request(hcp2.Read(1))
            client = asked[0].client
            assert client is not None
            assert client.share == 0.25

    on_a_served_line(tmp_path, story)

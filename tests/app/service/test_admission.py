"""Which programs are admitted to a served line, with processes and sockets: readers cannot take every place."""

from __future__ import annotations

import asyncio
import os
from collections import Counter
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed

from busmaster import Hcp2Controller, connect
from busmaster.app import bounds
from busmaster.app.service.admission import Admission, ConnectionRate, connecting_peer, stranger_to_close
from busmaster.app.service.client_connection import ClientConnection
from busmaster.app.service.messages import Malformed
from busmaster.app.service.permission import Access, Permission, digest_of
from busmaster.app.service.refusals import LimitedReport, Refusals
from busmaster.app.service.rights import RIGHTS, Role
from busmaster.errors import InvalidCommand, LineDown
from busmaster.testing import run_in_virtual_time
from tests.app.service.lines import Served, raw, served, until
from tests.patience import PATIENCE

TOKENS = {role.value: f"token-of-{role.value}-programs" for role in Role}
ACCESS = Access(
    tokens={role.value: Permission(f"token {role.value}", role) for role in Role},
    secrets={name: digest_of(secret) for name, secret in TOKENS.items()},
)


class Crowd:
    """Programs of a role that come by TCP, and stay."""

    def __init__(self, line: Served, stack: AsyncExitStack) -> None:
        self.line = line
        self._stack = stack

    async def come(self, role: Role) -> None:
        assert self.line.service.tcp_address is not None
        remote = connect(self.line.service.tcp_address, token=TOKENS[role.value])
        await self._stack.enter_async_context(remote)

    async def fill(self, role: Role) -> int:
        """Have programs come until one is refused, and return how many are here."""
        count, refusals = 0, list[str]()
        while not refusals:
            try:
                await self.come(role)
            except LineDown as error:
                refusals.append(str(error))
            else:
                count += 1
        assert f"places for role {role.value} are taken" in refusals[0]
        assert "stop a program that uses the line" in refusals[0]
        return count


Story = Callable[[Crowd], Awaitable[None]]


def among(folder: Path, story: Story) -> None:
    async def run() -> None:
        async with (
            asyncio.timeout(PATIENCE),
            served(folder, access=ACCESS, listen=("127.0.0.1", 0)) as line,
            AsyncExitStack() as stack,
        ):
            await story(Crowd(line, stack))

    asyncio.run(run())


def test_readers_do_not_lock_out_writers_and_the_owners_user(tmp_path: Path) -> None:
    async def story(crowd: Crowd) -> None:
        assert await crowd.fill(Role.READ) == bounds.MOST_CLIENTS
        assert await crowd.fill(Role.WRITE) == bounds.RESERVED_FOR_WRITERS
        async with connect(crowd.line.address) as own:  # by its Unix socket
            assert await Hcp2Controller(own, 5).read(1) == 0
        assert await crowd.fill(Role.ADMIN) == bounds.RESERVED_FOR_ADMINS

    among(tmp_path, story)


def test_writers_do_not_lock_out_admins_and_places_that_nobody_reserved_are_everybodys(tmp_path: Path) -> None:
    async def story(crowd: Crowd) -> None:
        assert await crowd.fill(Role.WRITE) == bounds.MOST_CLIENTS + bounds.RESERVED_FOR_WRITERS
        with pytest.raises(LineDown, match="role read are taken; 8 more are for role write"):
            await crowd.come(Role.READ)
        assert await crowd.fill(Role.ADMIN) == RIGHTS[Role.ADMIN].reserved

    among(tmp_path, story)


def test_reserved_places_that_a_role_does_not_use_are_for_no_other_role(tmp_path: Path) -> None:
    async def story(crowd: Crowd) -> None:
        await crowd.come(Role.ADMIN)
        for _ in range(bounds.RESERVED_FOR_WRITERS + 3):
            await crowd.come(Role.WRITE)
        assert await crowd.fill(Role.READ) == bounds.MOST_CLIENTS - 3
        assert await crowd.fill(Role.ADMIN) == bounds.RESERVED_FOR_ADMINS - 1

    among(tmp_path, story)


def test_a_place_is_free_again_when_its_program_has_gone(tmp_path: Path) -> None:
    async def story(crowd: Crowd) -> None:
        async with AsyncExitStack() as stack:
            await Crowd(crowd.line, stack).come(Role.READ)
            assert await crowd.fill(Role.READ) == bounds.MOST_CLIENTS - 1
        await until(lambda: len(crowd.line.service.clients) == bounds.MOST_CLIENTS - 1)
        await crowd.come(Role.READ)

    among(tmp_path, story)


def test_one_that_only_sends_the_safe_state_is_admitted_when_all_places_are_taken_and_can_do_nothing_else(
    tmp_path: Path,
) -> None:
    async def story(crowd: Crowd) -> None:
        line = crowd.line
        await crowd.fill(Role.READ)
        await crowd.fill(Role.ADMIN)
        with pytest.raises(LineDown, match="role admin are taken"):
            await connect(line.address).__aenter__()
        for said in (
            {"method": "now", "params": {}},
            {
                "method": "request",
                "params": {"protocol": "hcp2", "address": 5, "command": {"command": "read", "element": 1}},
            },
            {"method": "hold", "params": {"sequence": 1, "protocol": "hcp2", "address": 5, "max_hold": 1.0}},
        ):
            async with raw(line, hello=False) as client:
                assert "result" in await client.ask("hello", versions=[3], safe_only=True)
                await client.say(**said, **({} if said["method"] == "hold" else {"id": 2}))  # as a plain read is said
                assert "can only send the safe state" in (await client.hear())["error"]["message"]
        async with raw(line, hello=False) as client:
            await client.ask("hello", versions=[3], safe_only=True)
            # It comes as far as authorisation, which has no safe state of this line.
            assert "has no safe state" in (await client.ask("safe", writes={}))["error"]["message"]
            await client.say(method="cancel", params={"id": 1})  # a program whose own time is over sends it
            assert "has no safe state" in (await client.ask("safe", writes={}))["error"]["message"]
        assert line.service.tcp_address is not None
        for address, token in ((line.address, None), (line.service.tcp_address, TOKENS["admin"])):
            async with connect(address, token=token, safe_only=True) as remote:  # entering requests nothing else
                with pytest.raises(InvalidCommand, match="has no safe state"):
                    await remote.enter_safe_state({})

    among(tmp_path, story)


def test_of_idle_programs_in_the_places_for_the_safe_state_the_oldest_goes(tmp_path: Path) -> None:
    async def story(crowd: Crowd) -> None:
        line = crowd.line
        await crowd.fill(Role.READ)
        await crowd.fill(Role.ADMIN)
        async with AsyncExitStack() as stack:
            clients = []
            for _ in range(bounds.RESERVED_FOR_SAFE + 1):
                clients.append(await stack.enter_async_context(raw(line, hello=False)))
                await clients[-1].ask("hello", versions=[3], safe_only=True)
            with pytest.raises(ConnectionClosed):
                await clients[0].hear()
            for client in clients[1:]:
                assert "error" in await client.ask("safe", writes={})

    among(tmp_path, story)


def test_a_reader_has_no_place_of_those_for_the_safe_state(tmp_path: Path) -> None:
    async def story(crowd: Crowd) -> None:
        await crowd.fill(Role.READ)
        assert crowd.line.service.tcp_address is not None
        with pytest.raises(LineDown, match="role read are taken"):
            await connect(crowd.line.service.tcp_address, token=TOKENS["read"], safe_only=True).__aenter__()

    among(tmp_path, story)


def test_refused_programs_are_counted_and_reported_at_most_once_a_minute(tmp_path: Path) -> None:
    async def story(crowd: Crowd) -> None:
        told: list[str] = []
        crowd.line.service.report = told.append
        for _ in range(3):
            await crowd.fill(Role.READ)
        assert crowd.line.authorisation.refusals.connections == {"read": 3}
        assert [text.partition(":")[0] for text in told] == ["1 connection was refused, because no place was free"]
        assert [text for _, text in crowd.line.service.line.journal.entries if "refused" in text] == told
        async with connect(crowd.line.address) as own:
            assert own.about["refused_connections"] == 3

    among(tmp_path, story)


def test_a_report_comes_at_once_and_then_once_a_minute_with_the_count() -> None:
    async def run() -> None:
        told: list[tuple[float, str]] = []
        loop = asyncio.get_running_loop()
        refusals = Refusals()
        refusals.on_report.append(lambda text: told.append((loop.time() - began, text.partition(":")[0])))
        began = loop.time()
        for _ in range(90):
            refusals.note_connection("read")
            await asyncio.sleep(1)
        await asyncio.sleep(300)
        refusals.note_connection("write")
        because = "refused, because no place was free"
        assert told == [
            (0, f"1 connection was {because}"),
            (60, f"59 connections were {because}"),
            (120, f"30 connections were {because}"),
            (390, f"1 connection was {because}"),
        ]

    run_in_virtual_time(run())


def test_what_an_interface_refuses_is_counted_from_0_on_and_logins_apart() -> None:
    async def run() -> None:
        refusals = Refusals()
        refusals.begin("web", "logins")
        refusals.begin("web", "requests")
        assert (refusals.logins, refusals.at_interfaces) == ({"service": 0, "web": 0}, {("web", "requests"): 0})
        refusals.note("web", "logins", "192.0.2.1", 3)
        refusals.note("web", "requests", "192.0.2.1", 2)
        assert (refusals.logins, refusals.at_interfaces) == ({"service": 0, "web": 3}, {("web", "requests"): 2})

    run_in_virtual_time(run())


def test_what_a_report_keeps_of_many_peers_is_bounded() -> None:
    async def run() -> None:
        reported: list[int] = []
        report = LimitedReport(lambda text: reported.append(int(text)), lambda counts: str(len(counts)))
        report.note("first")
        for number in range(10 * bounds.MOST_REPORTED):
            report.note(str(number))
        await asyncio.sleep(61)
        assert reported == [1, bounds.MOST_REPORTED + 1]

    run_in_virtual_time(run())


def test_a_peer_that_a_report_names_is_counted_by_its_name_although_there_are_many_others() -> None:
    async def run() -> None:
        reported: list[Counter[str]] = []

        def text(counts: Counter[str]) -> str:
            reported.append(counts)
            return ""

        report = LimitedReport(lambda _: None, text)
        report.note("first")
        for number in range(bounds.MOST_REPORTED + 3):
            report.note(str(number))
        for peer in ("0", "0", "stranger", "0"):
            report.note(peer)
        await asyncio.sleep(61)
        [_, counts] = reported
        assert (counts["0"], counts["others"], counts.total()) == (4, 4, bounds.MOST_REPORTED + 7)

    run_in_virtual_time(run())


def test_who_opens_many_connections_and_says_nothing_closes_its_own(tmp_path: Path) -> None:
    async def story(crowd: Crowd) -> None:
        service, path = crowd.line.service, crowd.line.address.removeprefix("unix:")
        assert service.tcp_address is not None
        host, _, port = service.tcp_address.removeprefix("tcp://").rpartition(":")
        own = await asyncio.open_unix_connection(path)
        many = [await asyncio.open_connection(host, int(port)) for _ in range(bounds.FREE_CONNECTIONS)]
        await until(lambda: service.refused == bounds.FREE_CONNECTIONS - bounds.MOST_STRANGERS + 1)
        assert service.strangers == bounds.MOST_STRANGERS
        assert os.getuid() in {connection.websocket.origin for connection in service._strangers}
        own[1].write(b"x\r\n\r\n")  # it is still heard
        await own[0].read()
        for _, writer in (own, *many):
            writer.transport.abort()

    among(tmp_path, story)


def test_of_strangers_the_oldest_of_the_crowd_is_closed_once_there_are_too_many() -> None:
    def stranger(origin: str) -> Any:
        connection = ClientConnection.__new__(ClientConnection)
        connection.websocket = type("Connection", (), {"origin": origin})()
        return connection

    one, *crowd = [stranger("alone"), *(stranger("crowd") for _ in range(bounds.MOST_STRANGERS - 2))]
    assert stranger_to_close([one, *crowd]) is None
    last = stranger("another")
    assert stranger_to_close([one, *crowd, last]) is crowd[0]


# programs that connect again and again


def test_a_peer_that_connects_too_fast_waits_and_then_is_refused_and_others_are_not() -> None:
    now = 100.0
    rate = ConnectionRate(lambda: now)
    delays = [rate.delay("hostile") for _ in range(1000)]
    free, most = bounds.FREE_CONNECTIONS, bounds.FREE_CONNECTIONS + bounds.MOST_DELAYED
    assert delays[:free] == [0.0] * free
    waits = [delay or 0.0 for delay in delays[free:most]]
    assert waits == pytest.approx([(one + 1) / bounds.CONNECTIONS_A_SECOND for one in range(bounds.MOST_DELAYED)])
    assert delays[most:] == [None] * (1000 - most)
    assert rate.delay("another") == 0.0
    now += 1.0  # what was refused is not held against it
    again = [rate.delay("hostile") for _ in range(100)]
    assert sum(delay is not None for delay in again) == bounds.CONNECTIONS_A_SECOND
    now += 1000.0
    assert [rate.delay("hostile") for _ in range(free + 1)] == [*[0.0] * free, pytest.approx(0.05)]


def test_programs_that_connect_as_they_should_never_wait() -> None:
    """Ten programs of one machine that try twice a second while the owner is away, and pages with some connections."""
    now = 100.0
    rate = ConnectionRate(lambda: now)
    for _ in range(600):
        assert [rate.delay("plant") for _ in range(10)] == [0.0] * 10
        now += 0.5
    assert [rate.delay("plant") for _ in range(100)] == [0.0] * 100


def test_peers_whose_connections_are_counted_are_bounded() -> None:
    rate = ConnectionRate(lambda: 100.0)
    for number in range(2 * bounds.MOST_CONNECTING_PEERS):
        rate.delay(number)
    assert len(rate._used_until) == bounds.MOST_CONNECTING_PEERS
    assert next(iter(rate._used_until)) == bounds.MOST_CONNECTING_PEERS


def test_each_process_of_the_owners_user_stands_for_itself_and_those_of_another_do_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "getuid", lambda: 1000)
    for user in (0, 1000):
        assert connecting_peer(user, 1) != connecting_peer(user, 2)
    assert connecting_peer(1001, 1) == connecting_peer(1001, 2)
    assert connecting_peer("192.0.2.1", 0) != connecting_peer("192.0.2.2", 0)


@pytest.mark.slow
def test_of_a_crowd_that_connects_at_once_some_wait_and_the_rest_is_closed_and_reported(tmp_path: Path) -> None:
    async def story(crowd: Crowd) -> None:
        told: list[str] = []
        service = crowd.line.service
        service.report = told.append
        assert service.tcp_address is not None
        host, _, port = service.tcp_address.removeprefix("tcp://").rpartition(":")
        for _ in range(bounds.FREE_CONNECTIONS):
            service.delay("127.0.0.1", 0)
        came = [await asyncio.open_connection(host, int(port)) for _ in range(bounds.MOST_DELAYED + 8)]
        for _, writer in came:
            writer.write(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        refusals = crowd.line.authorisation.refusals
        await until(lambda: refusals.connections["unknown"] > 0)
        answers = await asyncio.gather(*(reader.read() for reader, _ in came), return_exceptions=True)
        served = sum(isinstance(answer, bytes) and answer.startswith(b"HTTP/1.1 4") for answer in answers)
        assert served >= bounds.MOST_DELAYED
        assert served + refusals.connections["unknown"] == len(came)
        assert told[0].startswith("1 connection was refused, because the program connects again and again: 1 from 127")
        for _, writer in came:
            writer.close()
        async with connect(crowd.line.address) as own:
            assert own.about["refused_connections"] == refusals.connections["unknown"]

    among(tmp_path, story)


def test_a_program_that_has_to_wait_is_let_in_all_the_same(tmp_path: Path) -> None:
    async def story(crowd: Crowd) -> None:
        for _ in range(bounds.FREE_CONNECTIONS + 2):
            crowd.line.service.delay("127.0.0.1", 0)
        await crowd.come(Role.READ)
        await crowd.come(Role.WRITE)

    among(tmp_path, story)


class Seat:
    """A client, and its connection, as far as admission looks at them."""

    def __init__(self, role: Role, *, in_safe_place: bool = False, sends: bool = False) -> None:
        self.permission = Permission("user me", role)
        self.in_safe_place = in_safe_place
        self.requests = SimpleNamespace(sends_safe_state=sends)
        self.websocket = self
        self.aborted = False

    def abort(self) -> None:
        self.aborted = True


def test_programs_that_are_sending_the_safe_state_keep_their_places_and_idle_ones_do_not() -> None:
    async def run() -> None:
        refusals = Refusals()
        admission, me = Admission(refusals), Permission("user me", Role.ADMIN)
        others = [Seat(Role.ADMIN) for _ in range(bounds.MOST_CLIENTS + bounds.RESERVED_FOR_ADMINS)]
        safe = [Seat(Role.ADMIN, in_safe_place=True, sends=True) for _ in range(bounds.RESERVED_FOR_SAFE)]

        def admit(seats: list[Seat], permission: Permission = me, *, safe_only: bool = True) -> bool:
            clients: Any = {seat: seat for seat in seats}
            return admission.admit(permission, clients, safe_only=safe_only)

        assert admit(others[1:] + safe) is False  # an ordinary place is free
        assert admit(others + safe[1:]) is True
        assert refusals.connections == {}
        with pytest.raises(Malformed, match=f"{len(safe)} programs are already sending the safe state; wait for them"):
            admit(others + safe)
        assert refusals.connections == {"safe": 1}
        assert not any(seat.aborted for seat in others + safe)
        safe[-1].requests.sends_safe_state = False
        assert admit(others + safe) is True
        assert [seat.aborted for seat in safe] == [*[False] * (len(safe) - 1), True]
        places = bounds.MOST_CLIENTS + bounds.RESERVED_FOR_ADMINS
        for permission, safe_only in ((me, False), (Permission("user me", Role.READ), True)):
            with pytest.raises(Malformed, match="places for role"):
                admit(others, permission, safe_only=safe_only)
        with pytest.raises(Malformed) as refused:
            admit(others, safe_only=False)
        assert str(refused.value) == (
            f"all {places} places for role admin are taken; {bounds.RESERVED_FOR_WRITERS} more are for role write"
        )
        assert refusals.connections == {"safe": 1, "admin": 2, "read": 1}

    run_in_virtual_time(run())


ALL, WRITERS, ADMINS = bounds.MOST_CLIENTS, bounds.RESERVED_FOR_WRITERS, bounds.RESERVED_FOR_ADMINS


@pytest.mark.parametrize(
    ("read", "write", "admin", "admitted"),
    [
        # how many programs of each role are there, and which roles one more program may have
        (0, 0, 0, "read write admin"),
        (ALL - 1, 0, 0, "read write admin"),
        (ALL - 1, WRITERS, ADMINS, "read write admin"),
        (ALL, 0, 0, "write admin"),
        (ALL, 1, 0, "write admin"),
        (ALL, 0, 1, "write admin"),
        (ALL, WRITERS - 1, ADMINS - 1, "write admin"),
        (ALL, WRITERS, ADMINS - 1, "admin"),
        (ALL, WRITERS - 1, ADMINS, "write"),
        (ALL, WRITERS, ADMINS, ""),
        (ALL - 3, WRITERS + 2, 1, "read write admin"),
        (ALL - 3, WRITERS + 3, 1, "admin"),
        (ALL - 3, 1, ADMINS + 3, "write"),
        (ALL - 3, WRITERS + 1, ADMINS + 2, ""),
        (0, WRITERS + ALL, 0, "admin"),
        (0, 0, ADMINS + ALL, "write"),
    ],
)
def test_a_program_gets_a_reserved_place_of_its_role_or_one_of_those_for_all_roles(
    read: int, write: int, admin: int, admitted: str
) -> None:
    async def run() -> None:
        admission = Admission(Refusals())
        counts = {Role.READ: read, Role.WRITE: write, Role.ADMIN: admin}
        seats: Any = [Seat(role) for role, count in counts.items() for _ in range(count)]
        # these have places of their own
        seats += [Seat(Role.ADMIN, in_safe_place=True) for _ in range(bounds.RESERVED_FOR_SAFE)]
        found = [role.value for role in counts if not admission.refusal(Permission("user me", role), seats)]
        assert found == admitted.split()

    run_in_virtual_time(run())

"""The service of a line: its options, its reports, the clients that get them, and the state after its end."""

from __future__ import annotations

import asyncio
import os
import socket
import stat
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.client import ClientConnection
from websockets.asyncio.client import connect as connect_websocket
from websockets.exceptions import ConnectionClosedError

from busmaster import Bus, Hcp2Controller, InvalidCommand, MemoryPort, RemoteBus, Service, connect, ext
from busmaster.app import bounds
from busmaster.app.service import service as service_module
from busmaster.app.service.authorisation import Authorisation
from busmaster.app.service.permission import Access, Permission, digest_of
from busmaster.app.service.picture import Picture
from busmaster.app.service.rights import Role
from busmaster.bus.meaning import Meaning
from busmaster.emulator.line import Echo, Line
from busmaster.errors import LineDown
from busmaster.registry import make_device
from tests.app.service.lines import Raw, Served, on_a_line, on_a_served_line, raw, served, until
from tests.app.service.test_bad_clients import UPGRADE
from tests.patience import PATIENCE

SECRET = "a-token-of-the-hmi-0001"
TOKENS = Access(tokens={"hmi": Permission("token hmi", Role.WRITE)}, secrets={"hmi": digest_of(SECRET)})


def test_its_options_are_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def run() -> None:
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
        async with Bus(MemoryPort(Line(Hcp2Controller.profile.line, [make_device("hcp2", 5)], paced=False))) as bus:
            for share in (0.1, 10):  # the least and the most
                service = Service(bus, name="slitter", mode=0o660, group=os.getgid(), share=share, title="Slitter 2")
                async with service, connect("slitter") as remote:
                    path = service.address.removeprefix("unix:")
                    assert path.endswith("/slitter.sock")
                    assert stat.S_IMODE(os.stat(path).st_mode) == 0o660
                    assert service.tcp_address is None
                    picture = Picture()
                    await remote.overview(picture.receive)
                    while picture.frame is None:
                        await remote.statistics()
                    assert picture.frame.title == "Slitter 2"
            with pytest.raises(InvalidCommand, match="name"):
                Service(bus, name="../slitter")

    asyncio.run(run())


def test_it_reports_the_line_and_what_was_refused_to_each_program(tmp_path: Path) -> None:
    async def story(line: Served, first: RemoteBus) -> None:
        own = Hcp2Controller(line.bus, 5)
        await own.read(1)
        Hcp2Controller(line.bus, 6)
        line.bus.poll_group("axes", period=60, points=[own.point("1")])
        refusals = line.authorisation.refusals
        refusals.note_connection("read")
        for kind, count in (("connections", 2), ("requests", 5), ("logins", 7)):
            refusals.note("web", kind, "192.0.2.1", count)
        refusals.note_login("service", "192.0.2.1")
        line.authorisation.read_only = True
        async with connect(line.address) as remote:
            about = remote.about
            endpoint = line.bus.endpoint
            assert (about["name"], about["line"]) == (line.service.name, endpoint.name)
            assert endpoint.settings is not None
            assert (about["baudrate"], about["framing"]) == (endpoint.settings.baudrate, endpoint.settings.framing)
            assert (about["echo"], about["process"], about["tcp"]) == (endpoint.echo, os.getpid(), None)
            assert (about["clients"], about["read_only"], about["state"]) == (2, True, "ready")
            assert (about["refused_connections"], about["refused_requests"], about["failed_logins"]) == (3, 5, 8)
            assert [(node["address"], node["health"]) for node in about["nodes"]] == [(5, "up"), (6, "unknown")]
            assert [(group["name"], group["period"]) for group in about["groups"]] == [("axes", 60)]
            assert abs(about["now"] - line.bus.now()) < PATIENCE
        await until(lambda: len(line.service.clients) == 1)

    on_a_served_line(tmp_path, story)


def test_a_connection_without_a_first_message_is_not_counted_as_a_program(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        _, stranger = await asyncio.open_unix_connection(line.address.removeprefix("unix:"))
        await until(lambda: line.service.strangers)
        async with connect(line.address) as remote:
            assert remote.about["clients"] == 1
        stranger.close()

    on_a_line(tmp_path, story)


@pytest.mark.parametrize("socket_of", ["user", "network"])
def test_programs_that_connect_in_one_moment_are_queued_and_accepted_one_in_a_turn(
    socket_of: str, tmp_path: Path
) -> None:
    async def run() -> None:
        async with asyncio.timeout(PATIENCE), served(tmp_path, listen=("127.0.0.1", 0)) as line:
            comers: list[socket.socket] = []
            for _ in range(bounds.MOST_STRANGERS):  # nothing is accepted in between: the loop does not run
                if socket_of == "network":
                    assert line.service.tcp_address is not None
                    port = int(line.service.tcp_address.rpartition(":")[2])
                    comers.append(socket.create_connection(("127.0.0.1", port), timeout=PATIENCE))
                else:
                    comers.append(socket.socket(socket.AF_UNIX))
                    comers[-1].setblocking(False)
                    comers[-1].connect(line.address.removeprefix("unix:"))
            accepted = [0]
            while accepted[-1] < len(comers):
                await asyncio.sleep(0)
                accepted.append(line.service.strangers)
            assert {after - before for before, after in pairwise(accepted)} <= {0, 1}
            for comer in comers:
                comer.close()

    asyncio.run(run())


def test_a_program_that_does_not_read_gets_the_last_list_of_groups_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service_module, "GROUPS_EVERY", 0.0)

    async def story(line: Served) -> None:
        point = Hcp2Controller(line.bus, 5).point("1")
        async with raw(line) as client:
            [program] = line.service.clients
            connection = line.service._clients[program]
            connection.websocket.full = True
            for number in range(3):
                line.bus.poll_group(f"group {number}", period=60.0, points=[point])
                await until(lambda: line.service._groups_timer is None)
            assert program.outbox.waiting == 1
            connection.websocket.full = False
            connection.writable()
            listed = (await client.hear())["params"]["groups"]
            assert [group["name"] for group in listed] == ["group 0", "group 1", "group 2"]

    on_a_line(tmp_path, story)


def test_every_program_is_informed_of_stops_writes_groups_and_its_permission(tmp_path: Path) -> None:
    async def story(line: Served, first: RemoteBus) -> None:
        async with connect(line.address) as second:
            programs, own = (first, second), Hcp2Controller(line.bus, 5)
            nodes = [Hcp2Controller(remote, 5).node for remote in programs]
            touched: list[list[Mapping[str, Any]]] = [[], []]
            for remote, heard in zip(programs, touched, strict=True):
                remote.on_touched.append(heard.append)
                await remote.statistics()
            await own.write(1, 1)
            await asyncio.gather(*(remote.statistics() for remote in programs))
            assert touched == [[], []], "a program that follows nothing has no values that could be stale"
            for remote in programs:
                remote.events()
                await remote.statistics()
            await own.write(1, 2)
            await until(lambda: all(touched))
            assert [[(body["protocol"], body["address"], body["all"]) for body in heard] for heard in touched] == [
                [("hcp2", 5, False)]
            ] * 2
            own.node.note_stop()
            await until(lambda: [node.stops for node in nodes] == [1, 1])
            line.bus.poll_group("axes", period=60, points=[own.point("1")])
            await until(lambda: all(remote.groups for remote in programs))
            line.authorisation.access = Access(users={os.getuid(): Permission("user me", Role.READ)})
            await until(lambda: all(remote.about["read_only"] for remote in programs))
            assert all(remote.about["name"] == line.service.name for remote in programs), "all else stays"

    on_a_served_line(tmp_path, story)


def test_writes_that_a_program_has_not_received_yet_are_all_reported(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        points = [Hcp2Controller(line.bus, address).point(item) for address in (5, 6) for item in ("1", "2")]
        line.bus.poll_group("axes", period=60, points=points)
        remote.events()
        await remote.statistics()
        touched: list[tuple[object, object]] = []
        remote.on_touched.append(lambda body: touched.append((body["address"], body["items"])))
        [client] = line.service.clients
        connection = line.service._clients[client].websocket
        connection.full = True
        for point in points:
            await point.write(5)
        connection.full = False
        line.service._clients[client].writable()
        await until(lambda: len(touched) == 4)
        assert touched == [(5, ["1"]), (5, ["2"]), (6, ["1"]), (6, ["2"])]

    on_a_served_line(tmp_path, story)


def test_nothing_of_it_stays_on_the_bus_and_its_clients_are_disconnected(tmp_path: Path) -> None:
    async def run() -> None:
        async with Bus(MemoryPort(Line(Hcp2Controller.profile.line, [], paced=False))) as bus:
            line, authorisation = ext.line_of(bus), Authorisation(bus)
            path = tmp_path / "line.sock"
            before = [list(hooks) for hooks in (line.on_stop, line.on_touched, line.on_groups, authorisation.on_access)]
            service = Service(bus, authorisation=authorisation, path=path, listen=("127.0.0.1", 0))
            async with service:
                remote = await connect(service.address).__aenter__()
                stranger, writer = await asyncio.open_unix_connection(path)
                await until(lambda: service.strangers)
                address = service.tcp_address
            assert service.strangers == 0
            assert not bus._streams
            assert await stranger.read() == b""
            writer.close()
            with pytest.raises(LineDown, match="has ended"):
                await remote.statistics()
            assert service.clients == ()
            assert not path.exists()
            assert address is not None
            with pytest.raises(LineDown, match="no program serves"):
                await connect(address).__aenter__()
            hooks = [list(hooks) for hooks in (line.on_stop, line.on_touched, line.on_groups, authorisation.on_access)]
            assert hooks == before
            assert not authorisation.refusals.on_report

    asyncio.run(run())


@pytest.mark.parametrize("versions", [[3], [99, 3], [3, 99]])
def test_one_common_version_is_enough(versions: list[int], tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line, hello=False) as client:
            assert (await client.ask("hello", versions=versions))["result"]["version"] == 3

    on_a_line(tmp_path, story)


@pytest.mark.parametrize("hosts", [b"", b"Host: localhost\r\nHost: localhost\r\n", b"Host: " + b"x" * 200 + b"\r\n"])
def test_a_request_names_this_server_once(hosts: bytes, tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        reader, writer = await asyncio.open_unix_connection(line.address.removeprefix("unix:"))
        writer.write(UPGRADE.replace(b"Host: localhost\r\n", hosts))
        answer = await reader.read()
        assert answer.startswith(b"HTTP/1.1 403")
        assert b"x" * 41 not in answer
        writer.close()
        assert line.service.refused == 1

    on_a_line(tmp_path, story)


@pytest.mark.parametrize("host", [b"localhost", b"localhost:80", b"busmaster"])
def test_its_names_are_accepted_with_and_without_a_port(host: bytes, tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        reader, writer = await asyncio.open_unix_connection(line.address.removeprefix("unix:"))
        writer.write(UPGRADE.replace(b"localhost", host))
        assert (await reader.readline()).startswith(b"HTTP/1.1 101")
        writer.close()

    on_a_line(tmp_path, story)


def test_who_shows_no_token_has_not_failed_to_log_in(tmp_path: Path) -> None:
    async def run() -> None:
        async with asyncio.timeout(PATIENCE), served(tmp_path, access=TOKENS, listen=("127.0.0.1", 0)) as line:
            assert line.service.tcp_address is not None
            for _ in range(20):  # more than failed logins are free
                with pytest.raises(LineDown, match="requires a token"):
                    await connect(line.service.tcp_address).__aenter__()
            assert line.authorisation.refusals.logins == {"service": 0}

    asyncio.run(run())


def test_a_token_that_is_withdrawn_before_the_first_message_is_not_admitted(tmp_path: Path) -> None:
    async def story(line: Served, connection: ClientConnection) -> None:
        line.authorisation.take_secrets({"hmi": digest_of("a-newer-token-of-the-hmi")})
        said = await Raw(connection).ask("hello", versions=[3])
        assert said["error"]["message"] == "this token is not valid any more"
        assert line.service.clients == ()

    with_a_token(tmp_path, story)


def test_a_program_whose_token_is_withdrawn_gets_the_reason_for_its_end(tmp_path: Path) -> None:
    async def story(line: Served, connection: ClientConnection) -> None:
        assert "result" in await Raw(connection).ask("hello", versions=[3])
        line.authorisation.take_secrets({"hmi": digest_of("a-newer-token-of-the-hmi")})
        await line.alone()
        with pytest.raises(ConnectionClosedError) as closed:
            await connection.recv()
        assert closed.value.rcvd is not None
        assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (1008, "this token is not valid any more")

    with_a_token(tmp_path, story)


def test_a_program_whose_token_is_withdrawn_is_cut_off_although_it_does_not_read(tmp_path: Path) -> None:
    async def story(line: Served, connection: ClientConnection) -> None:
        assert "result" in await Raw(connection).ask("hello", versions=[3])
        connection.transport.pause_reading()
        line.authorisation.take_secrets({"hmi": digest_of("a-newer-token-of-the-hmi")})
        for _ in range(5):  # turns of the loop: nothing of the other end is awaited
            await asyncio.sleep(0)
        assert line.service.clients == ()
        connection.transport.abort()

    with_a_token(tmp_path, story)


def with_a_token(folder: Path, story: Callable[[Served, ClientConnection], Awaitable[None]]) -> None:
    """Run a story with a connection that shows a known token, before its first message."""

    async def run() -> None:
        async with asyncio.timeout(PATIENCE), served(folder, access=TOKENS, listen=("127.0.0.1", 0)) as line:
            assert line.service.tcp_address is not None
            known = {"Authorization": f"Bearer {SECRET}"}
            address = line.service.tcp_address.replace("tcp://", "ws://")
            async with connect_websocket(address, additional_headers=known) as connection:
                await story(line, connection)

    asyncio.run(run())


def test_the_name_of_the_user_is_known_and_the_socket_given_to_its_group_before_a_program_comes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[tuple[int, int]] = []
    found: list[bool] = []

    async def find() -> None:
        await asyncio.sleep(0)
        found.append(True)

    async def run() -> None:
        monkeypatch.setattr("busmaster.app.service.service.find_name", lambda _: asyncio.ensure_future(find()))
        monkeypatch.setattr(os, "chown", lambda _, user, group: given.append((user, group)))
        async with (
            Bus(MemoryPort(Line(Hcp2Controller.profile.line, []))) as bus,
            Service(bus, path=tmp_path / "line.sock", group=4711),
        ):
            assert found == [True]
            assert given == [(-1, 4711)]

    asyncio.run(run())


def test_a_service_that_cannot_serve_one_of_its_sockets_serves_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    servers: list[asyncio.Server] = []
    serve = Service._serve_at

    async def serve_once(service: Service, opened: socket.socket) -> asyncio.Server:
        if servers:
            opened.close()
            raise OSError("no more of them")
        servers.append(await serve(service, opened))
        return servers[-1]

    async def run() -> None:
        monkeypatch.setattr(Service, "_serve_at", serve_once)
        async with Bus(MemoryPort(Line(Hcp2Controller.profile.line, []))) as bus:
            with pytest.raises(OSError, match="no more of them"):
                await Service(bus, path=tmp_path / "line.sock", listen=("127.0.0.1", 0)).__aenter__()
        assert [server.is_serving() for server in servers] == [False]
        assert os.listdir(tmp_path) == []

    asyncio.run(run())


def test_events_and_refusals_from_its_start_on_are_kept_for_those_who_look_later(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        point = replace(Hcp2Controller(line.bus, 5).point("11"), meaning=Meaning(high=5))
        await point.write(6)
        line.bus.poll_group("axes", period=60, points=[point]).demand()
        await until(lambda: line.service.line.journal.entries)
        line.authorisation.refusals.note_rate("user 1001")
        picture = Picture()
        await remote.overview(picture.receive)
        await until(lambda: picture.frame)
        assert picture.frame is not None
        texts = [text for _, text in picture.frame.events]
        assert texts[0] == "5/11 = 6 is above its high of 5"
        assert any(text.endswith("connects again and again: 1 from user 1001") for text in texts)

    on_a_served_line(tmp_path, story)


def test_events_are_kept_by_a_service_that_serves_again_too(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        point = replace(Hcp2Controller(line.bus, 5).point("11"), meaning=Meaning(high=5))
        await line.service.__aexit__(None, None, None)
        await line.service.__aenter__()
        await point.write(6)
        line.bus.poll_group("axes", period=60, points=[point]).demand()
        await until(lambda: line.service.line.journal.entries)
        assert [text for _, text in line.service.line.journal.entries] == ["5/11 = 6 is above its high of 5"]

    on_a_line(tmp_path, story)


def test_a_line_whose_adapter_has_an_echo_says_so(tmp_path: Path) -> None:
    async def run() -> None:
        line = Line(Hcp2Controller.profile.line, [make_device("hcp2", 5)], paced=False, echo=Echo())
        async with (
            Bus(MemoryPort(line)) as bus,
            Service(bus, path=tmp_path / "line.sock") as service,
            connect(service.address) as remote,
        ):
            assert remote.about["echo"] is True

    asyncio.run(run())


def test_what_is_refused_is_a_warning_in_the_log(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    async def story(line: Served) -> None:
        line.authorisation.refusals.note_rate("user 4711")

    on_a_line(tmp_path, story)
    [record] = caplog.records
    assert (record.name, record.levelname) == ("busmaster.app.service", "WARNING")
    assert record.getMessage().endswith("connects again and again: 1 from user 4711")


def test_the_address_of_a_socket_holds_in_another_folder_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def run() -> None:
        monkeypatch.chdir(tmp_path)
        async with Bus(MemoryPort(Line(Hcp2Controller.profile.line, []))) as bus:
            async with Service(bus, path="line.sock") as service:
                monkeypatch.chdir("/")
                async with connect(service.address) as remote:
                    assert remote.about["clients"] == 1
            assert os.listdir(tmp_path) == []

    asyncio.run(run())


@pytest.mark.parametrize(("origin", "named"), [("192.0.2.1", "1 from 192.0.2.1"), (4_000_001, "1 from user 4000001")])
def test_connections_that_come_too_fast_are_counted_and_reported(origin: str | int, named: str, tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        told: list[str] = []
        line.service.report = told.append
        most = bounds.FREE_CONNECTIONS + bounds.MOST_DELAYED
        delays = [line.service.delay(origin, 17) for _ in range(most + 1)]
        assert [number for number, delay in enumerate(delays) if delay is None] == [most]
        assert line.service.refused == 1
        assert line.authorisation.refusals.connections == {"unknown": 1}
        assert [text.rpartition(": ")[2] for text in told] == [named]

    on_a_line(tmp_path, story)

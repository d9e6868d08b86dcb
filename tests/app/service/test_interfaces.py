"""Who is let in by TCP, and who may do what: tokens, users and groups."""

from __future__ import annotations

import asyncio
import dataclasses
import errno
import logging
import os
import socket
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from websockets.asyncio.client import connect as connect_websocket
from websockets.exceptions import InvalidStatus

from busmaster import Bus, Hcp2Controller, MemoryPort, MicroFlexDrive, Service, connect
from busmaster.app.service import peers
from busmaster.app.service.connection import NO_MASK, text_frame
from busmaster.app.service.permission import Access, Permission, digest_of
from busmaster.app.service.rights import Role
from busmaster.app.service.tcp import check_listening, is_loopback, is_our_name, listening, listening_error
from busmaster.emulator.line import Line
from busmaster.errors import InvalidCommand, LineDown
from tests.app.service.lines import Raw, Served, served, until
from tests.app.service.test_bad_clients import UPGRADE
from tests.patience import PATIENCE

LOOPBACK = ("127.0.0.1", 0)
SECRETS = {"hmi": "a-token-of-the-hmi-0001", "logger": "a-token-of-the-logger-2"}
TOKENS = Access(
    tokens={
        "hmi": Permission("token hmi", Role.WRITE, {("hcp2", 5): frozenset({1}), ("hcp2", 7): None}),
        "logger": Permission("token logger", Role.READ),
    },
    secrets={name: digest_of(secret) for name, secret in SECRETS.items()},
)


def on_a_port(folder: Path, story: Callable[[Served, str], Awaitable[None]], access: Access = TOKENS) -> None:
    async def run() -> None:
        async with asyncio.timeout(PATIENCE), served(folder, access=access, listen=LOOPBACK) as line:
            assert line.service.tcp_address is not None
            await story(line, line.service.tcp_address)

    asyncio.run(run())


async def refused(address: str, **options: Any) -> int:
    """The status with which a connection is refused."""
    quiet = logging.getLogger("tests.app.service")
    with pytest.raises(InvalidStatus) as refusal:
        await connect_websocket(address.replace("tcp://", "ws://"), logger=quiet, **options)
    return refusal.value.response.status_code


def test_a_program_with_a_token_writes_what_its_token_allows_and_is_named_on_record(tmp_path: Path) -> None:
    async def story(line: Served, address: str) -> None:
        async with connect(address, token=SECRETS["hmi"]) as remote:
            controller = Hcp2Controller(remote, 5)
            await controller.write(1, 12.5)
            assert await controller.read(1) == 12.5
            await MicroFlexDrive(remote, 7).disable()  # all of that node
            for write in (controller.write(2, 1), controller.write(1, 1, 2), Hcp2Controller(remote, 6).write(1, 1)):
                with pytest.raises(InvalidCommand, match="token hmi may not write this; see allow_writes"):
                    await write
            assert await controller.read(2) == 0
        assert line.audit()[0] == ("5/write element 1 = 12.5", "written")
        assert [outcome for _, outcome in line.audit()[2:]] == ["refused"] * 3
        assert {record.by.partition(", from 127.0.0.1:")[0] for record in line.records} == {"token hmi"}

    on_a_port(tmp_path, story)


def test_a_program_with_a_token_that_reads_writes_nothing_and_stops_nothing(tmp_path: Path) -> None:
    async def story(line: Served, address: str) -> None:
        async with connect(address, token=SECRETS["logger"]) as remote:
            assert remote.about["read_only"] is True
            drive = MicroFlexDrive(remote, 7)
            with pytest.raises(InvalidCommand, match="token logger may read this line, but not write"):
                await drive.disable()
            await remote.statistics()
            assert [node.stops for node in line.bus.nodes] == [0]

    on_a_port(tmp_path, story)


def test_who_may_write_a_part_of_a_node_stops_it_with_a_write_that_is_let_through(tmp_path: Path) -> None:
    async def story(line: Served, address: str) -> None:
        async with connect(address, token=SECRETS["hmi"]) as remote:
            controller, own = Hcp2Controller(remote, 5), Hcp2Controller(line.bus, 5).node
            await controller.read(1)
            controller.node.note_stop()
            with pytest.raises(InvalidCommand, match="may not write this"):
                await controller.write(2, 0)
            assert own.stops == controller.node.stops == 0
            controller.node.note_stop()
            await remote.statistics()
            assert own.stops == 0, "it is not known yet what it writes"
            await controller.write(1, 0)
            await controller.write(1, 1)
            assert own.stops == controller.node.stops == 1

    on_a_port(tmp_path, story)


def test_a_program_stops_no_node_of_which_it_may_write_nothing(tmp_path: Path) -> None:
    async def story(line: Served, address: str) -> None:
        async with connect(address, token=SECRETS["hmi"]) as remote:
            controller, own = Hcp2Controller(remote, 6), Hcp2Controller(line.bus, 6).node
            await controller.read(1)
            controller.node.note_stop()
            await remote.statistics()
            assert own.stops == 0

    on_a_port(tmp_path, story)


def test_nobody_comes_by_tcp_without_a_token_that_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busmaster.app.service.refusals.FREE_LOGINS", 9)  # it is not slowed down yet

    async def story(line: Served, address: str) -> None:
        for token in ("a-token-of-nobody-at-all", SECRETS["hmi"][:-1]):
            with pytest.raises(LineDown, match="does not accept this token"):
                await connect(address, token=token).__aenter__()
        with pytest.raises(LineDown, match="requires a token"):
            await connect(address).__aenter__()
        for authorization in ("", "Basic aG1pOmE=", f"Basic {SECRETS['hmi']}", "Bearer", "Bearer \u00fc"):
            assert await refused(address, additional_headers={"Authorization": authorization}) == 401
        several = [("Authorization", f"Bearer {SECRETS[name]}") for name in ("hmi", "hmi")]  # which of them holds?
        assert await refused(address, additional_headers=several) == 401
        assert line.service.clients == ()
        assert line.service.refused == 9

    on_a_port(tmp_path, story)


def test_a_token_of_bytes_that_are_no_text_is_refused_as_any_other(tmp_path: Path) -> None:
    async def story(line: Served, address: str) -> None:
        host, port = address.removeprefix("tcp://").split(":")
        reader, writer = await asyncio.open_connection(host, int(port))
        writer.write(UPGRADE.replace(b"Upgrade: ", b"Authorization: Bearer \xff\xfe\r\nUpgrade: ", 1))
        assert (await reader.readline()).startswith(b"HTTP/1.1 401")
        writer.close()
        assert TOKENS.token_name("\udcff") is None  # as an argument of a command has it

    on_a_port(tmp_path, story)


def test_a_page_cannot_use_the_port(tmp_path: Path) -> None:
    async def story(line: Served, address: str) -> None:
        known = {"Authorization": f"Bearer {SECRETS['hmi']}"}
        assert await refused(address, additional_headers=known, origin="http://plant.example") == 403
        host, port = address.removeprefix("tcp://").split(":")
        assert await refused("ws://plant.example/", host=host, port=int(port), additional_headers=known) == 403

    on_a_port(tmp_path, story)


def test_other_languages_name_the_port_by_its_address(tmp_path: Path) -> None:
    async def story(line: Served, address: str) -> None:
        known = {"Authorization": f"Bearer {SECRETS['hmi']}"}
        async with connect_websocket(address.replace("tcp://", "ws://"), additional_headers=known) as connection:
            said = await Raw(connection).ask("hello", versions=[3])
            assert said["result"]["version"] == 3

    on_a_port(tmp_path, story)


@pytest.mark.parametrize("form", ["bearer {}", "BEARER {}", "Bearer   {}"])
def test_the_kind_of_a_token_is_written_in_small_or_large_letters(form: str, tmp_path: Path) -> None:
    async def story(line: Served, address: str) -> None:
        known = {"Authorization": form.format(SECRETS["hmi"])}
        async with connect_websocket(address.replace("tcp://", "ws://"), additional_headers=known):
            await until(lambda: line.service.strangers)

    on_a_port(tmp_path, story)


@pytest.mark.parametrize(
    ("host", "ours"),
    [
        ("192.0.2.7", True),
        ("192.0.2.7:7420", True),
        ("[::1]", True),
        ("[2001:db8::7]:7420", True),
        ("gateway.example", True),
        ("gateway.example:7420", True),
        ("this-machine:7420", True),
        ("THIS-machine", True),
        ("plant.example:7420", False),
        ("[plant.example]:7420", False),
        ("", False),
    ],
)
def test_a_host_is_ours_by_an_address_by_where_we_listen_and_by_the_name_of_the_machine(
    host: str, ours: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "This-Machine")
    assert is_our_name(host, ("gateway.example", 7420)) is ours
    assert is_our_name(host, ("Gateway.Example", 7420)) is ours


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "::1", "localhost"])
def test_this_machine_alone_is_served_without_tokens(host: str) -> None:
    assert is_loopback(host)
    check_listening((host, 7420), tokens=False)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.1", "gateway.example"])
def test_other_machines_are_served_if_there_are_tokens(host: str) -> None:
    assert not is_loopback(host)
    check_listening((host, 7420), tokens=True)


def has_ipv6() -> bool:
    try:
        with socket.create_server(("::1", 0), family=socket.AF_INET6):
            return True
    except OSError:
        return False


@pytest.mark.skipif(not has_ipv6(), reason="this machine has no IPv6")
def test_a_line_is_served_by_ipv6_too(tmp_path: Path) -> None:
    async def story() -> None:
        async with asyncio.timeout(PATIENCE), served(tmp_path, access=TOKENS, listen=("::1", 0)) as line:
            address = line.service.tcp_address
            assert address is not None
            assert address.startswith("tcp://[::1]:")
            async with connect(address, token=SECRETS["hmi"]) as remote:
                assert await Hcp2Controller(remote, 5).read(1) == 0
                assert remote.about["tcp"] == address

    asyncio.run(story())


@pytest.mark.skipif(not has_ipv6(), reason="this machine has no IPv6")
def test_a_link_local_address_is_one_of_its_interface() -> None:
    with pytest.raises(InvalidCommand, match=os.strerror(errno.EADDRNOTAVAIL)):  # without it, an invalid argument
        listening(("fe80::1%lo", 0))


def test_a_service_that_serves_again_is_at_its_new_port(tmp_path: Path) -> None:
    async def story() -> None:
        async with asyncio.timeout(PATIENCE), served(tmp_path, listen=("127.0.0.1", 0)) as line:
            await line.service.__aexit__(None, None, None)
            await line.service.__aenter__()
            assert line.service.tcp_address is not None
            async with connect(line.service.tcp_address) as remote:
                assert remote.about["tcp"] == line.service.tcp_address

    asyncio.run(story())


def test_without_tokens_whoever_is_on_this_machine_reads_and_writes_nothing(tmp_path: Path) -> None:
    async def story(line: Served, address: str) -> None:
        async with connect(address) as remote:
            controller = Hcp2Controller(remote, 5)
            assert await controller.read(1) == 0
            with pytest.raises(InvalidCommand, match="a program without a token may read this line, but not write"):
                await controller.write(1, 1)
        assert line.records[0].by.startswith("without a token, from 127.0.0.1:")

    on_a_port(tmp_path, story, Access())


def test_a_line_is_not_open_to_the_network_without_tokens() -> None:
    async def run() -> None:
        bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line, [])))
        for host in ("0.0.0.0", "192.0.2.1", "::", "gateway.example"):
            with pytest.raises(InvalidCommand, match="is reachable from the network; give each program a token"):
                Service(bus, listen=(host, 7420))
        Service(bus, listen=("localhost", 7420))

    asyncio.run(run())


def test_a_port_that_is_taken_leaves_no_socket_behind(tmp_path: Path) -> None:
    async def run() -> None:
        with socket.create_server(LOOPBACK) as other:
            where = other.getsockname()
            with pytest.raises(
                InvalidCommand, match=f"127.0.0.1:{where[1]} is in use by another program; end that one"
            ):
                await served(tmp_path, listen=where).__aenter__()
        assert os.listdir(tmp_path) == []

    asyncio.run(run())


def test_a_token_that_holds_no_more_ends_what_came_with_it_and_no_other(tmp_path: Path) -> None:
    async def story(line: Served, address: str) -> None:
        async with connect(address, token=SECRETS["hmi"]) as gone, connect(address, token=SECRETS["logger"]) as stays:
            line.authorisation.take_secrets({"logger": digest_of(SECRETS["logger"])})
            with pytest.raises(LineDown):
                await Hcp2Controller(gone, 5).read(1)
            assert await Hcp2Controller(stays, 5).read(1) == 0
            await until(lambda: len(line.service.clients) == 1)
        with pytest.raises(LineDown, match="does not accept this token"):
            await connect(address, token=SECRETS["hmi"]).__aenter__()

    on_a_port(tmp_path, story)


def test_another_token_of_the_same_name_ends_what_came_with_the_old_one(tmp_path: Path) -> None:
    async def story(line: Served, address: str) -> None:
        async with connect(address, token=SECRETS["hmi"]) as gone, connect(address, token=SECRETS["logger"]) as stays:
            line.authorisation.take_secrets({**TOKENS.secrets, "hmi": digest_of("a-newer-token-of-the-hmi")})
            with pytest.raises(LineDown):
                await Hcp2Controller(gone, 5).read(1)
            assert await Hcp2Controller(stays, 5).read(1) == 0
        async with connect(address, token="a-newer-token-of-the-hmi") as new:
            assert await Hcp2Controller(new, 5).read(1) == 0

    on_a_port(tmp_path, story)


def test_who_may_not_hold_the_line_is_told_so(tmp_path: Path) -> None:
    async def story(line: Served, address: str) -> None:
        async with connect(address, token=SECRETS["logger"]) as remote:
            async with Hcp2Controller(remote, 5).exclusive() as held:
                with pytest.raises(InvalidCommand, match="node 5: token logger may not hold the line"):
                    await held.read(1)
            assert await Hcp2Controller(remote, 5).read(1) == 0

    on_a_port(tmp_path, story)


@pytest.mark.parametrize("token", ["a-token-of-the-hmi-0001", ""])
def test_a_token_is_for_tcp(token: str) -> None:
    with pytest.raises(InvalidCommand, match="a token needs tcp://HOST:PORT"):
        connect("unix:/run/line.sock", token=token)


@pytest.mark.parametrize("token", ["two\r\nwords", "two words", " word", "", "\u00fcber", "a\x7f"])
def test_a_token_is_one_word_that_a_header_can_have(token: str) -> None:
    with pytest.raises(InvalidCommand, match="without spaces"):
        connect("tcp://127.0.0.1:7420", token=token)


def test_what_is_said_by_tcp_has_another_mask_each_time_and_in_the_kernel_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys: list[bytes] = []

    def framed(data: bytes, key: bytes) -> bytes:
        if key:  # a program's: an owner has none
            keys.append(key)
        return text_frame(data, key)

    async def read_by(address: str, token: str | None = None) -> list[bytes]:
        keys.clear()
        async with connect(address, token=token) as remote:
            for _ in range(5):
                assert await Hcp2Controller(remote, 5).read(1) == 0
        assert len(keys) > 5
        return keys

    async def story(line: Served, address: str) -> None:
        assert set(await read_by(line.address)) == {NO_MASK}
        masks = await read_by(address, SECRETS["logger"])
        assert len(set(masks) - {NO_MASK}) == len(masks)

    monkeypatch.setattr("busmaster.app.service.connection.text_frame", framed)
    on_a_port(tmp_path, story)


# who a process is, as the kernel says


def posing_as(monkeypatch: pytest.MonkeyPatch, uid: int, *gids: int) -> None:
    """Have the kernel say that whoever connects is of this user and these groups."""
    process_of = peers.process_of
    monkeypatch.setattr(
        "busmaster.app.service.service.process_of",
        lambda connected: dataclasses.replace(process_of(connected), uid=uid, gids=gids),
    )


def on_a_socket(folder: Path, access: Access, story: Callable[[Served, Hcp2Controller], Awaitable[None]]) -> None:
    async def run() -> None:
        async with asyncio.timeout(PATIENCE), served(folder, access=access) as line, connect(line.address) as remote:
            await story(line, Hcp2Controller(remote, 5))

    asyncio.run(run())


NOBODY, OPERATORS, GUESTS = 4_000_001, 4_000_002, 4_000_003


async def reads(line: Served, controller: Hcp2Controller) -> None:
    assert await controller.read(1) == 0
    with pytest.raises(InvalidCommand, match="may read this line, but not write"):
        await controller.write(1, 1)


async def writes(line: Served, controller: Hcp2Controller) -> None:
    await controller.write(1, 1)


def test_whom_the_socket_lets_in_may_read_and_its_owner_may_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_a_socket(tmp_path, Access(), writes)
    posing_as(monkeypatch, 0)
    on_a_socket(tmp_path, Access(), writes)
    posing_as(monkeypatch, NOBODY, OPERATORS)
    on_a_socket(tmp_path, Access(), reads)


def test_a_users_own_role_goes_before_those_of_groups_and_those_in_their_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    groups = {GUESTS: Permission("group guests", Role.READ), OPERATORS: Permission("group operators", Role.WRITE)}
    posing_as(monkeypatch, NOBODY, 1, OPERATORS)
    on_a_socket(tmp_path, Access(groups=groups), writes)
    posing_as(monkeypatch, NOBODY, OPERATORS, GUESTS)
    on_a_socket(tmp_path, Access(groups=groups), reads)
    on_a_socket(tmp_path, Access(groups=groups, users={NOBODY: Permission("user nobody", Role.WRITE)}), writes)
    posing_as(monkeypatch, os.getuid())
    on_a_socket(tmp_path, Access(users={os.getuid(): Permission("user me", Role.READ)}), reads)


def test_the_kernel_says_which_groups_a_process_has() -> None:
    async def story() -> None:
        ours, theirs = socket.socketpair()
        with ours, theirs:
            process = peers.process_of(ours)
        assert (process.pid, process.uid, process.gids[0]) == (os.getpid(), os.getuid(), os.getgid())
        assert set(process.gids) == {os.getgid(), *os.getgroups()}

    asyncio.run(story())


def test_other_roles_hold_at_once_for_who_is_there(tmp_path: Path) -> None:
    async def story(line: Served, controller: Hcp2Controller) -> None:
        await controller.write(1, 1)
        line.authorisation.access = Access(users={os.getuid(): Permission("user me", Role.READ)})
        with pytest.raises(InvalidCommand, match="user me may read this line"):
            await controller.write(1, 2)

    on_a_socket(tmp_path, Access(), story)


def test_other_roles_are_told_to_who_is_there(tmp_path: Path) -> None:
    async def run() -> None:
        async with asyncio.timeout(PATIENCE), served(tmp_path) as line, connect(line.address) as remote:
            told: list[bool] = []
            remote.on_access.append(lambda: told.append(remote.about["read_only"]))
            assert not remote.about["read_only"]
            line.authorisation.access = Access(users={os.getuid(): Permission("user me", Role.READ)})
            await until(lambda: told == [True])
            line.authorisation.access = Access()
            await until(lambda: told == [True, False])
            assert remote.about["name"] == line.service.name  # and all else is as it was

    asyncio.run(run())


def test_what_a_command_does_not_say_it_changes_is_allowed_with_its_whole_node_alone() -> None:
    class Odd:
        writes = True

    node: Any = type("Node", (), {"profile": Hcp2Controller.profile, "address": 5})()
    odd: Any = Odd()
    assert Permission("x", Role.WRITE, {("hcp2", 5): frozenset({1})}).refusal(node, odd)
    assert not Permission("x", Role.WRITE, {("hcp2", 5): None}).refusal(node, odd)
    assert Permission("x", Role.WRITE, {("hcp2", 6): None}).refusal(node, odd)


@pytest.mark.parametrize("ahead", [-50_000.0, 50_000.0])
def test_a_program_of_a_machine_with_another_clock_reads_and_writes_by_the_owners(
    ahead: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + ahead)
    monkeypatch.setattr("busmaster.app.service.remote.time", clock)

    async def story(line: Served, address: str) -> None:
        async with connect(address, token=SECRETS["hmi"]) as remote:
            point = Hcp2Controller(remote, 5).point("1")
            await point.write(3, start_within=PATIENCE, finish_within=PATIENCE)
            group = remote.poll_group("mine", period=60, points=[point])
            cycles = group.subscribe()
            await group.ready()
            line.bus.groups[0].demand()
            await anext(cycles)
            assert abs(remote.now() - line.bus.now()) < PATIENCE
            assert await point.read(max_age=PATIENCE) == 3

    on_a_port(tmp_path, story)


def test_a_program_that_was_busy_while_it_connected_writes_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    late = [60.0]  # by so much it heard the first that the owner said of its clock
    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + (late.pop() if late else 0))
    monkeypatch.setattr("busmaster.app.service.remote.time", clock)

    async def story(line: Served, address: str) -> None:
        async with connect(address, token=SECRETS["hmi"]) as remote:
            await Hcp2Controller(remote, 5).write(1, 3)

    on_a_port(tmp_path, story)


def test_the_owners_clock_is_read_again_if_the_program_was_busy_when_the_first_reply_arrived(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    late = [10 * PATIENCE, 0.0]  # seconds, of the reply and of the request, from the last one
    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + 50_000.0 + (late.pop() if late else 0.0))
    monkeypatch.setattr("busmaster.app.service.remote.time", clock)

    async def story(line: Served, address: str) -> None:
        async with connect(address, token=SECRETS["hmi"]) as remote:
            assert late == []
            assert abs(remote.now() - line.bus.now()) < PATIENCE

    on_a_port(tmp_path, story)


def test_a_socket_that_listens_does_not_block_and_queues_who_comes() -> None:
    with listening(LOOPBACK) as opened:
        assert not opened.getblocking()
        comers = [socket.create_connection(opened.getsockname(), timeout=PATIENCE) for _ in range(8)]
        for comer in comers:
            comer.close()


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (
            OSError(errno.EADDRINUSE, "error while attempting to bind"),
            "h:1 is in use by another program; end that one, or",
        ),
        (
            OSError(errno.EACCES, "error while attempting to bind"),
            "cannot listen on h:1: Permission denied",
        ),
        (socket.gaierror(-2, "Name or service not known"), "cannot listen on h:1: Name or service not known"),
        (OSError("could not bind on any address"), "cannot listen on h:1: could not bind on any address"),
    ],
)
def test_why_nothing_can_listen_is_said_whatever_the_error_has(error: OSError, text: str) -> None:
    assert listening_error("h", 1, error).startswith(text)

"""How the other end of a connection is named, and what its connections share."""

from __future__ import annotations

import asyncio
import os
import pwd
import socket
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from busmaster.app.service import peers
from busmaster.app.service.peers import Holder, Process, find_name, holder_of, process_of, program_name, user_name
from busmaster.app.service.permission import Access, Permission
from busmaster.app.service.rights import Role


@pytest.fixture(autouse=True)
def _no_names_are_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers, "_names", {})
    monkeypatch.setattr(peers, "_asked", {})


def test_a_process_is_named_with_its_user_once_the_name_is_known() -> None:
    process = Process(4711, 1000, (50, 60), "python3")
    assert (process.user, process.short, process.account) == ("1000", "python3 4711", 1000)
    assert str(process) == "1000, python3 (process 4711)"
    peers._names[1000] = "plant"
    assert str(process) == "plant, python3 (process 4711)"
    second = Permission("group 60", Role.WRITE)
    assert process.permission(Access(groups={60: second})) is second
    assert process.may_stay(Access(secrets={"hmi": b"1"}))


def test_a_holder_of_a_token_is_named_with_its_address_and_stays_as_long_as_the_token() -> None:
    holder, nameless = Holder("hmi", "192.0.2.7:4711", b"1"), Holder("", "192.0.2.7:4712")
    assert (str(holder), holder.short, holder.account) == (
        "token hmi, from 192.0.2.7:4711",
        "hmi 192.0.2.7:4711",
        "hmi",
    )
    assert (str(nameless), nameless.short, nameless.account) == (
        "without a token, from 192.0.2.7:4712",
        "192.0.2.7:4712",
        "",
    )
    for secrets, stays in (({"hmi": b"1"}, (True, False)), ({"hmi": b"2"}, (False, False)), ({}, (False, True))):
        access = Access(secrets=secrets)
        assert (holder.may_stay(access), nameless.may_stay(access)) == stays
    assert "digest" not in repr(holder)


def test_the_address_of_a_holder_has_its_port() -> None:
    connected: Any = SimpleNamespace(getpeername=lambda: ("2001:db8::7", 4711, 0, 0))
    assert holder_of(connected, "hmi", b"1") == Holder("hmi", "2001:db8::7:4711", b"1")


def test_the_name_of_a_user_is_looked_up_once_at_a_time_and_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []

    def look_up(uid: int) -> str:
        calls.append(uid)
        if uid == 7:
            raise OSError("the server of names is away")
        return f"user {uid}"

    async def run() -> None:
        monkeypatch.setattr(peers, "user_name", look_up)
        first = find_name(1000)
        assert first is not None
        assert find_name(1000) is first
        await first
        assert find_name(1000) is None
        assert (calls, peers._names, peers._asked) == ([1000], {1000: "user 1000"}, {})
        failed = find_name(7)
        assert failed is not None
        with pytest.raises(OSError, match="away"):
            await failed
        assert peers._asked == {}  # it is looked up again for the next connection
        assert find_name(7) is not failed
        await asyncio.gather(*peers._asked.values(), return_exceptions=True)

    asyncio.run(run())


def test_the_kernel_names_the_process_that_has_connected() -> None:
    name = Path(f"/proc/{os.getpid()}/comm").read_text().strip()

    async def run() -> None:
        one, other = socket.socketpair()
        with one, other:
            process = process_of(one)
            assert (process.pid, process.uid, process.gids[0]) == (os.getpid(), os.getuid(), os.getgid())
            assert set(os.getgroups()) <= set(process.gids)
            assert process.program == name
        await asyncio.gather(*peers._asked.values())
        assert process.user == user_name(os.getuid())

    asyncio.run(run())


def test_a_user_or_a_process_without_a_name_is_named_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    def nobody(uid: int) -> Any:
        raise KeyError(f"getpwuid(): uid not found: {uid}")

    monkeypatch.setattr(pwd, "getpwuid", nobody)
    assert user_name(12345) == "12345"
    assert program_name(2**22 + 1) == "a program"  # more than the kernel has


def test_of_a_process_with_too_many_groups_the_first_counts() -> None:
    def refuse(*_: object) -> bytes:
        raise OSError(34, "Numerical result out of range")

    connected: Any = SimpleNamespace(getsockopt=refuse)
    assert peers._more_groups(connected) == ()


def test_a_group_may_have_any_number_that_the_kernel_allows() -> None:
    peers._names[1000] = "plant"
    options = {
        socket.SO_PEERCRED: struct.pack("3i", 2**22 + 1, 1000, 50),
        peers.PEER_GROUPS: struct.pack("2I", 60, 2**32 - 2),
    }
    connected: Any = SimpleNamespace(getsockopt=lambda _, option, __: options[option])
    assert process_of(connected).gids == (50, 60, 2**32 - 2)


def test_a_program_whose_name_is_not_text_is_named_all_the_same() -> None:
    """A program chooses its name itself, by prctl, and may connect with any bytes."""
    with open("/proc/self/comm", "rb") as file:
        name = file.read().strip()
    try:
        Path("/proc/self/comm").write_bytes(b"odd \xff")
        assert program_name(os.getpid()) == "odd \ufffd"
    finally:
        Path("/proc/self/comm").write_bytes(name)


def test_the_user_of_a_process_is_not_its_group() -> None:
    """On many machines both have the same number, for example for root."""
    peers._names[1000] = "plant"
    options = {socket.SO_PEERCRED: struct.pack("3i", 2**22 + 1, 1000, 50), peers.PEER_GROUPS: struct.pack("2I", 60, 70)}
    connected: Any = SimpleNamespace(getsockopt=lambda _, option, __: options[option])
    process = process_of(connected)
    assert (process.pid, process.uid, process.gids) == (2**22 + 1, 1000, (50, 60, 70))
    assert str(process) == f"plant, a program (process {2**22 + 1})"

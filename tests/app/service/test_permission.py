"""What a permission covers, and whose permission holds."""

from __future__ import annotations

import os
from typing import Any

import pytest

from busmaster import Bus, MemoryPort, MicroFlexDrive
from busmaster.app.service.permission import EVERYTHING, Access, Permission, digest_of
from busmaster.app.service.rights import Role
from busmaster.emulator.line import Line
from busmaster.protocols.modbus import codec as modbus
from busmaster.protocols.modbus.handle import ModbusUnit

PLACES = frozenset(modbus.WriteRegisters(10, (0, 0)).changes(modbus.PROFILE))
"""Holding registers 10 and 11."""
OWNER = 1234
STRANGER = os.getuid() + 4711
READS, WRITES = Permission("group 60", Role.READ), Permission("group 50", Role.WRITE)
ONLY = {("modbus", 1): None, ("modbus", 2): PLACES}


@pytest.fixture
def units() -> tuple[Any, Any, Any]:
    """Return three units: all of the first may be written, two registers of the second, and nothing of the third."""
    bus = Bus(MemoryPort(Line(modbus.PROFILE.line)))
    first, second, third = (ModbusUnit(bus, address).node for address in (1, 2, 3))
    return first, second, third


def test_a_permission_for_some_places_reaches_their_nodes_and_covers_the_nodes_that_are_permitted_as_a_whole(
    units: tuple[Any, Any, Any],
) -> None:
    permission = Permission("token hmi", Role.WRITE, ONLY)
    assert [permission.reaches(unit) for unit in units] == [True, True, False]
    assert [permission.covers(unit) for unit in units] == [True, False, False]
    everywhere, nowhere = Permission("token hmi", Role.WRITE), Permission("token hmi", Role.READ, ONLY)
    assert [(everywhere.reaches(unit), everywhere.covers(unit)) for unit in units] == [(True, True)] * 3
    assert [(nowhere.reaches(unit), nowhere.covers(unit)) for unit in units] == [(False, False)] * 3


def test_a_write_is_permitted_if_all_places_that_it_changes_are(units: tuple[Any, Any, Any]) -> None:
    permission = Permission("token hmi", Role.WRITE, ONLY)
    writes = [modbus.WriteRegisters(first, values) for first, values in ((10, (1,)), (10, (1, 2)), (9, (1, 2)))]
    nothing_known: Any = object()
    permitted = [[not permission.refusal(unit, write) for write in (*writes, nothing_known)] for unit in units]
    assert permitted == [[True] * 4, [True, True, False, False], [False] * 4]
    why = permission.refusal(units[2], writes[0])
    assert why == "token hmi may not write this; see allow_writes in the line's file"
    reader = Permission("token hmi", Role.READ, ONLY)
    assert reader.refusal(units[0], writes[0]).startswith("token hmi may read this line, but not write")


def test_a_users_own_entry_goes_before_those_of_groups_which_go_in_the_order_of_the_file() -> None:
    own = Permission("user me", Role.READ)
    access = Access(users={STRANGER: own}, groups={60: READS, 50: WRITES})
    assert access.of_process(STRANGER, (50, 60)) is own
    assert access.of_process(STRANGER + 1, (50, 60)) is READS
    assert access.of_process(STRANGER + 1, (7, 50)) is WRITES
    assert access.of_process(STRANGER + 1, ()) == Permission("this user", Role.READ)


@pytest.mark.parametrize("uid", [0, OWNER])
def test_root_and_the_owners_user_are_admin_whatever_their_groups_are_and_an_entry_of_their_own_holds(
    uid: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "getuid", lambda: OWNER)
    assert Access(groups={60: READS}).of_process(uid, (60,)) is EVERYTHING
    own = Permission("user me", Role.READ)
    assert Access(users={uid: own}).of_process(uid, (60,)) is own


def test_a_node_is_known_by_its_protocol_and_not_by_the_kind_of_its_drive() -> None:
    drive: Any = MicroFlexDrive(Bus(MemoryPort(Line(MicroFlexDrive.profile.line))), 7).node
    assert Permission("token hmi", Role.WRITE, {("hcp2", 7): None}).covers(drive)
    assert not Permission("token hmi", Role.WRITE, {("microflex", 7): None}).reaches(drive)


def test_a_token_is_found_by_its_digest_and_a_client_without_an_entry_reads() -> None:
    access = Access(tokens={"hmi": WRITES}, secrets={name: digest_of(f"token of {name}") for name in ("hmi", "log")})
    assert [access.token_name(f"token of {name}") for name in ("hmi", "log", "plc")] == ["hmi", "log", None]
    assert access.of_token("hmi") is WRITES
    assert access.of_token("log") == Permission("token log", Role.READ)
    assert access.of_token("") == Permission("a program without a token", Role.READ)

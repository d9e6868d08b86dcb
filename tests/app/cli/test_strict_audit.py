"""`audit = "strict"`: whatever becomes of the program that owns the line, an acknowledged write is in its audit log."""

from __future__ import annotations

import asyncio
import json
import os
import random
import signal
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from busmaster import Hcp2Controller, connect
from busmaster.errors import WriteUnconfirmed
from tests.app.cli.conftest import owner
from tests.patience import PATIENCE

KILLS = int(os.environ.get("BUSMASTER_KILLS", "3"))
"""How often the owner is killed: more where it is asked for."""


def number(value: str) -> int:
    """What was written: of a point that no group polls the log has the command."""
    return int(value.strip("'").removeprefix("write element 10 = "))


def in_sqlite(folder: Path) -> set[int]:
    """The values of all writes that the database has as written."""
    with closing(sqlite3.connect(folder / "line.sqlite", timeout=10)) as database:
        return {number(value) for (value,) in database.execute("select value from audit where outcome = 'written'")}


def in_json_lines(folder: Path) -> set[int]:
    """The same, of the file of JSON lines."""
    found = set()
    for line in (folder / "line.jsonl").read_text().splitlines():
        try:
            said = json.loads(line)
        except ValueError:  # the half line that a kill leaves
            continue
        if said.get("outcome") == "written":
            found.add(number(said["value"]))
    return found


async def acknowledged(address: str, first: int, count: int, pid: int) -> list[int]:
    """The values whose write was acknowledged, until the owner is killed right after the last of them."""
    done: list[int] = []
    async with asyncio.timeout(PATIENCE), connect(address) as bus:
        controller = Hcp2Controller(bus, 2)
        for value in range(first, first + count):
            await controller.write(10, value)
            done.append(value)
        os.kill(pid, signal.SIGKILL)
    return done


@pytest.mark.slow
def test_no_acknowledged_write_is_missing_in_an_audit_log_after_sigkill(file: Path, tmp_path: Path) -> None:
    text = file.read_text()
    file.write_text(f'{text}audit = "strict"\n[outputs.jsonl]\npath = "{tmp_path}/line.jsonl"\naudit = "strict"\n')
    chance, written = random.Random(7), set[int]()
    for _ in range(KILLS):
        with owner("serve", str(file)) as (process, address):
            try:
                done = asyncio.run(acknowledged(address, len(written) + 1, chance.randint(1, 4), process.pid))
                written.update(done)
            finally:
                process.wait(PATIENCE)
        assert process.returncode == -signal.SIGKILL
        assert written - in_sqlite(tmp_path) == set()
        assert written - in_json_lines(tmp_path) == set()
    assert len(written) >= KILLS


@pytest.mark.slow
def test_a_write_whose_audit_entry_cannot_be_kept_is_not_acknowledged(file: Path, tmp_path: Path) -> None:
    file.write_text(f'{file.read_text()}audit = "strict"\n')

    async def write(address: str) -> None:
        async with asyncio.timeout(PATIENCE), connect(address) as bus:
            controller = Hcp2Controller(bus, 2)
            await controller.write(10, 1)
            with closing(sqlite3.connect(tmp_path / "line.sqlite", isolation_level=None, timeout=10)) as other:
                other.execute("begin immediate")
                with pytest.raises(WriteUnconfirmed) as caught:
                    await controller.write(10, 2)
                other.execute("rollback")
            said = str(caught.value)
            assert (
                "the value was written, but its audit entry is not on the disk: sqlite did not write it within 5 s"
                in said
            )
            assert "the value need not be written again" in said
            assert await controller.read(10) == 2
            await controller.write(10, 3)

    with owner("serve", str(file)) as (_, address):
        asyncio.run(write(address))
    assert in_sqlite(tmp_path) == {1, 2, 3}

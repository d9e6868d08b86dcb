"""Everything that programs can do to the owner of a line, with processes: `python -m tests.app.service.assault`.

Connections are opened and dropped at random moments, left half open, given garbage and messages of 10 MB; programs are
killed while they write. Meanwhile the owner polls a group. Then it is asked how it is, and its record of all writes is
held against what was on the wire. `--connections` and `--kills` say how many of each; it prints what it found, and ends
with 1 if something is not as it should be.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import sys
import tempfile
from asyncio.subprocess import PIPE, Process
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from busmaster.contract.profile import LineSettings
from busmaster.emulator.line import Line
from busmaster.emulator.serve import PtyServer
from busmaster.protocols.modbus.codec import WRITE_REGISTER, WriteRegisters
from busmaster.protocols.modbus.device import make_device
from tests.app.service.writing import UNIT

ROOT = Path(__file__).parents[3]
FIRST_REGISTER = 50
"""Those that are written: no group reads them."""
AT_ONCE = 20
UPGRADE = (
    b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
)
TEN_MEGABYTES = b"\x81\xff" + (10_000_000).to_bytes(8, "big") + bytes(4) + bytes(10_000_000)
HELLO = b'{"jsonrpc":"2.0","id":0,"method":"hello","params":{"versions":[3]}}'


class WatchedLine(Line):
    """Keeps what was written to the registers: each telegram of the host that writes one."""

    def __init__(self) -> None:
        super().__init__(LineSettings(57600), [make_device(UNIT, size=200)], paced=False)
        self.written: Counter[str] = Counter()

    def send(self, data: bytes, now: float) -> None:
        if data[1] == WRITE_REGISTER:
            register, value = int.from_bytes(data[2:4], "big"), int.from_bytes(data[4:6], "big")
            self.written[str(WriteRegisters(register, (value,)))] += 1
        super().send(data, now)


@dataclass
class Report:
    """What was found. `before` and `after` are how the owner was, when nobody else was there."""

    before: dict[str, Any]
    after: dict[str, Any]
    outcomes: Counter[str] = field(default_factory=Counter)
    complaints: list[str] = field(default_factory=list)


class Owner:
    """The process that owns the line."""

    def __init__(self, process: Process, address: str) -> None:
        self.address = address
        self._process = process

    @classmethod
    async def start(cls, port: str, folder: str) -> Owner:
        process = await _python("tests.app.service.assaulted", port, f"{folder}/line.sock")
        return cls(process, await _line_of(process))

    async def ask(self) -> dict[str, Any]:
        """How it is."""
        assert self._process.stdin is not None
        self._process.stdin.write(b"how are you?\n")
        said: dict[str, Any] = json.loads(await _line_of(self._process))
        return said

    async def alone(self) -> dict[str, Any]:
        """How it is once nobody is connected any more, and nothing waits."""
        while True:
            said = await self.ask()
            if not (said["clients"] or said["strangers"] or said["backlog"]):
                return said

    async def end(self) -> list[tuple[str, str]]:
        """Its record of all writes: what, and what became of it."""
        out, _ = await self._process.communicate(b"")
        assert self._process.returncode == 0
        return [(what.strip("'"), outcome) for what, outcome in json.loads(out)]


async def assault(connections: int, kills: int, chance: random.Random) -> Report:
    """Do all that, and return what was found."""
    line = WatchedLine()
    with PtyServer(line) as server, tempfile.TemporaryDirectory() as folder:
        owner = await Owner.start(server.path, folder)
        await _visits(owner, AT_ONCE, chance)
        before = await owner.alone()
        async with asyncio.TaskGroup() as group:
            group.create_task(_visits(owner, connections, chance))
            group.create_task(_kills(owner, kills, chance))
        report = Report(before, await owner.alone())
        records = await owner.end()
        _judge(report, records, server.call(lambda _, __: line.written.copy()))
    return report


# what is done to it


async def _visits(owner: Owner, count: int, chance: random.Random) -> None:
    left = iter(range(count))

    async def come() -> None:
        for _ in left:
            try:
                await _visit(owner.address.removeprefix("unix:"), chance)
            except (ConnectionError, asyncio.IncompleteReadError):
                pass  # it was shown the interface

    await asyncio.gather(*(come() for _ in range(AT_ONCE)))


async def _visit(path: str, chance: random.Random) -> None:
    reader, writer = await asyncio.open_unix_connection(path)
    try:
        match chance.randrange(7):
            case 0:
                pass
            case 1:  # half open
                writer.write(UPGRADE[: chance.randrange(1, len(UPGRADE))])
            case 2:
                writer.write(chance.randbytes(chance.randrange(1, 5000)))
            case 3:  # it shakes hands, and is gone at some moment
                writer.write(UPGRADE + _frame(HELLO)[: chance.randrange(80)])
            case 4:  # frames of garbage
                await _greet(reader, writer)
                writer.write(chance.randbytes(chance.randrange(1, 5000)))
            case 5:  # messages of garbage
                await _greet(reader, writer)
                writer.write(_frame(chance.choice((b"[" * 60_000, b"[" + b"[]," * 20_000 + b"0]", b"{}", b"\xff"))))
            case 6:
                await _greet(reader, writer)
                writer.write(TEN_MEGABYTES)
        await asyncio.sleep(chance.random() * 0.1)
    finally:
        if chance.random() < 0.5:
            writer.transport.abort()
        else:
            writer.close()


async def _greet(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    writer.write(UPGRADE)
    await reader.readuntil(b"\r\n\r\n")
    writer.write(_frame(HELLO))
    await reader.readexactly(2)


def _frame(text: bytes) -> bytes:
    """A message as a client sends it, masked with nothing."""
    return b"\x81\xfe" + len(text).to_bytes(2, "big") + bytes(4) + text


async def _kills(owner: Owner, count: int, chance: random.Random) -> None:
    for number in range(count):
        writer = await _python("tests.app.service.writing", owner.address, str(FIRST_REGISTER + number % 100))
        await _line_of(writer)
        await asyncio.sleep(chance.random() * 0.05)
        writer.kill()
        await writer.communicate()


# what is thought of it


def _judge(report: Report, records: list[tuple[str, str]], written: Counter[str]) -> None:
    """Every write on the wire has a record, and no record says what the wire contradicts."""
    complain = report.complaints.append
    known = Counter(what for what, _ in records)
    for what, outcome in records:
        report.outcomes[outcome] += 1
        if outcome == "written" and not written[what]:
            complain(f"{what} is confirmed, and was never sent")
        elif outcome == "unconfirmed" and not written[what]:
            complain(f"{what} is unconfirmed, and was never sent")
        elif outcome == "not started" and written[what] >= known[what]:
            complain(f"{what} is not started, and was sent")
    for what in written - known:
        complain(f"{what} was sent, and is not on record so often")
    after = report.after
    for what in ("tasks", "descriptors"):
        if after[what] > report.before[what]:
            complain(f"{after[what]} {what} are left, {report.before[what]} there were")


async def _python(module: str, *arguments: str) -> Process:
    return await asyncio.create_subprocess_exec(
        sys.executable, "-m", module, *arguments, stdin=PIPE, stdout=PIPE, cwd=ROOT, env=dict(os.environ)
    )


async def _line_of(process: Process) -> str:
    assert process.stdout is not None
    return (await process.stdout.readline()).decode().strip()


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.app.service.assault")
    parser.add_argument("--connections", type=int, default=1000)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    report = asyncio.run(assault(given.connections, given.kills, random.Random(given.seed)))
    for what in ("missed", "bad"):  # of a machine that has time for it
        if report.after[what]:
            report.complaints.append(f"{report.after[what]} cycles or samples are {what}")
    said = [f"before: {report.before}", f"after:  {report.after}", f"writes: {dict(report.outcomes)}"]
    said += [f"WRONG: {complaint}" for complaint in report.complaints]
    sys.stdout.write("\n".join([*said, ""]))
    return 1 if report.complaints else 0


if __name__ == "__main__":
    sys.exit(main())

"""What programs that were let in can do to a line, with processes: `python -m tests.app.service.attackers`.

`busmaster serve` owns an emulated line of 57600 baud that its poll group keeps about 75 % busy. One attack at a time
runs for some seconds from 62 connections (`--connections`) in a process of its own. Meanwhile a program of the owner's
user follows the group, and an operator with a token of its own writes with URGENT once a second. At the end `serve`
gets SIGTERM and sends its safe state.

It prints a table: the share of the line that the owner's cycles use before the attack (above 75 % on a slow machine),
cycles that started within one period of when they were due, the slowest urgent write, how long the end with its safe
state took and how it ended, the memory of the owner, and whether another program was let in.
`--only NAME` runs some of the attacks, `--write docs/attackers.md` puts their rows into the table of that page, which
holds no figure that was not measured so. `--attack` is for the attacking process itself.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import signal
import socket
import sys
import tempfile
import time
from asyncio.subprocess import DEVNULL, PIPE, Process
from collections.abc import Awaitable, Callable
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.served_line import ServedLine
from busmaster import BusError, InvalidCommand, Priority, RemoteBus, connect
from busmaster.app.service.client_messages import DemandParams, PauseParams
from busmaster.bus.points import Point
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.ext import PlannedGroup, PlannedNode
from busmaster.protocols.modbus.codec import PROFILE, ReadRegisters, WriteRegisters
from tests.app.service import floods

UNIT, ABSENT, PERIOD = 1, 99, 1.0
READER, WRITER, OPERATOR = "reader-" * 4, "writer-" * 4, "operator-" * 4
ALONE = 4
"""Cycles of the owner that are measured before the attack."""
SLOW = Timings.uniform(ReplyTiming(5.0, 5.0, 5.0, 0.02))
LINE = """
port = "{port}"

[service]
listen = "127.0.0.1:{tcp}"
token_file = "{folder}/tokens"
[service.tokens.reader]
role = "read"
[service.tokens.writer]
role = "write"
[service.tokens.operator]
role = "write"

[nodes.unit]
protocol = "modbus"
address = 1
[nodes.unit.points]
{points}
s = {{ item = "holding:90" }}

[groups.fast]
period = {period}
points = [{names}]

[safe]
writes = {{ "unit/s" = 0 }}
repeatable = ["unit/s"]
"""
GROUP = "fast"
HEAD = (
    "| attack | first | alone | kept | slowest urgent write | end, status | memory | others |\n"
    "|---|---|---|---|---|---|---|---|\n"
)
FIRST = {
    "read: urgent reads": "2 of 80",
    "read: own poll groups": "3 of 79",
    "read: ten absent nodes, 5 s": "none for 59 s; safe state not started",
    "read: reads": "37 of 79",
    "read: demand": "299 cycles in 8 s",
}
"""Cycles kept where the attacks were first made, at e1884e4 with another program."""
Attack = Callable[[RemoteBus, int], Awaitable[None]]


async def quiet(asking: Awaitable[Any]) -> None:
    with contextlib.suppress(BusError, InvalidCommand):
        await asking
        return
    await asyncio.sleep(0.001)  # what is refused at once must not keep this process from being ended


async def _each(count: int, again: Callable[[int], Awaitable[Any]]) -> None:
    async def go_on(number: int) -> None:
        while True:
            await quiet(again(number))

    await asyncio.gather(*(go_on(number) for number in range(count)))


async def reads(bus: RemoteBus, number: int) -> None:
    node = bus.node(PROFILE, UNIT)
    await _each(8, lambda one: node.request(ReadRegisters(one, 1)))


async def urgent_reads(bus: RemoteBus, number: int) -> None:
    node = bus.node(PROFILE, UNIT)
    await _each(8, lambda one: node.request(ReadRegisters(one, 1), priority=Priority.URGENT))


async def long_reads(bus: RemoteBus, number: int) -> None:
    node = bus.node(PROFILE, UNIT)
    await _each(4, lambda one: node.request(ReadRegisters(0, 90)))


async def slow_absent(bus: RemoteBus, number: int) -> None:
    await _each(10, lambda one: bus.node(PROFILE, 100 + one, timings=SLOW).request(ReadRegisters(0, 1)))


async def absent(bus: RemoteBus, number: int) -> None:
    await _each(10, lambda one: bus.node(PROFILE, 2 + (10 * number + one) % 240).request(ReadRegisters(0, 1)))


async def retried_absent(bus: RemoteBus, number: int) -> None:
    await _each(4, lambda one: bus.node(PROFILE, ABSENT + one).request(ReadRegisters(0, 1), retries=100))


async def groups(bus: RemoteBus, number: int) -> None:
    for one in range(4):
        point: Point[Any] = Point(bus.node(PROFILE, UNIT), str(one), ReadRegisters(20 + one, 1))
        await quiet(bus.poll_group(f"mine {one}", period=0.01, points=[point]).ready())
    await asyncio.Event().wait()


async def demands(bus: RemoteBus, number: int) -> None:
    while True:
        await quiet(bus.link.answer(bus.link.ask("demand", DemandParams(GROUP))))


async def writes(bus: RemoteBus, number: int) -> None:
    node = bus.node(PROFILE, UNIT)
    await _each(8, lambda one: node.request(WriteRegisters(60 + one, (number,))))


async def urgent_writes(bus: RemoteBus, number: int) -> None:
    node = bus.node(PROFILE, UNIT)
    await _each(8, lambda one: node.request(WriteRegisters(60 + one, (number,)), priority=Priority.URGENT))


async def stops(bus: RemoteBus, number: int) -> None:
    node = bus.node(PROFILE, UNIT)
    await _each(4, lambda one: node.request(WriteRegisters(60, (0,)), priority=Priority.URGENT, stop=True))


async def holds(bus: RemoteBus, number: int) -> None:
    node = bus.node(PROFILE, UNIT)

    async def hold(_: int) -> None:
        async with node.exclusive(max_hold=5.0) as held:
            await held.request(ReadRegisters(0, 1))
            await asyncio.sleep(5.0)

    await _each(1, hold)


async def pauses(bus: RemoteBus, number: int) -> None:
    while True:
        await quiet(bus.link.answer(bus.link.ask("pause", PauseParams(GROUP, True))))


async def plans(bus: RemoteBus, number: int) -> None:
    """Request one plan after the other, each with about as many groups as one message holds."""
    unit = PlannedNode(PROFILE, UNIT, PROFILE.timings)
    reads = [(unit, ReadRegisters(2 * one, 1)) for one in range(2)]
    while True:
        more = [PlannedGroup(f"mine {one}", 0.01 + one / 1000, reads) for one in range(20)]
        await quiet(bus.plan(*more))


async def mixed(bus: RemoteBus, number: int) -> None:
    await (reads, urgent_reads, slow_absent, groups, demands)[number % 5](bus, number)


async def idle(bus: RemoteBus, number: int) -> None:
    await asyncio.Event().wait()


class Kind(NamedTuple):
    """One attack: whose token it shows, what each connection does, and whether it connects anew each time."""

    token: str
    attack: Attack
    anew: bool = False


async def one_read(bus: RemoteBus, number: int) -> None:
    await quiet(bus.node(PROFILE, UNIT).request(ReadRegisters(0, 1)))


KINDS = {
    "none": Kind(READER, idle),
    "read: reads": Kind(READER, reads),
    "read: urgent reads": Kind(READER, urgent_reads),
    "read: reads of 90 registers": Kind(READER, long_reads),
    "read: ten absent nodes, 5 s": Kind(READER, slow_absent),
    "read: 240 absent nodes": Kind(READER, absent),
    "read: absent, 100 retries": Kind(READER, retried_absent),
    "read: own poll groups": Kind(READER, groups),
    "read: demand": Kind(READER, demands),
    "read: pause": Kind(READER, pauses),
    "read: sequences of 5 s": Kind(READER, holds),
    "read: plans of 20 groups": Kind(READER, plans),
    "read: a connection a read": Kind(READER, one_read, anew=True),
    "read: mixed": Kind(READER, mixed),
    "write: reads": Kind(WRITER, reads),
    "write: urgent reads": Kind(WRITER, urgent_reads),
    "write: reads of 90 registers": Kind(WRITER, long_reads),
    "write: writes": Kind(WRITER, writes),
    "write: urgent writes": Kind(WRITER, urgent_writes),
    "write: stops": Kind(WRITER, stops),
    "write: ten absent nodes, 5 s": Kind(WRITER, slow_absent),
    "write: own poll groups": Kind(WRITER, groups),
    "write: demand": Kind(WRITER, demands),
    "write: a connection a read": Kind(WRITER, one_read, anew=True),
    "write: sequences of 5 s": Kind(WRITER, holds),
    "write: mixed": Kind(WRITER, mixed),
}


KINDS |= {name: Kind(READER, floods.on_service(raw, READER)) for name, raw in floods.SERVICE.items()}
KINDS |= {"write: stopped holder of a sequence": Kind(WRITER, floods.stopped_holder)}
KINDS |= {name: Kind("", idle) for interface in floods.INTERFACES for name in interface.attacks}


async def attack(name: str, address: str, connections: int) -> None:
    """Be the attackers, until this process is ended."""
    if (interface := floods.interface_of(name)) is not None:
        await floods.at(interface.attacks[name], address, WRITER)
    kind = KINDS[name]

    async def come(number: int) -> None:
        while True:
            with contextlib.suppress(BusError, InvalidCommand, OSError):
                async with connect(address, token=kind.token) as bus:
                    while not kind.anew:
                        await kind.attack(bus, number)
                    await kind.attack(bus, number)
            await asyncio.sleep(0 if kind.anew else 0.2)

    await asyncio.gather(*(come(number) for number in range(connections)))


class Outcome(NamedTuple):
    """What an attack did. Times are in seconds; `kept` is the share of the owner's cycles that started in time,
    `busy` the share of the line that they need without the attack."""

    busy: float
    kept: float
    cycles: int
    urgent: float
    writes: int
    end: float
    status: int
    megabytes: float
    others: bool


async def run(name: str, connections: int, seconds: float) -> Outcome:
    """Run one attack on a line of its own."""
    with ServedLine(1, delay={"low": 0.068, "high": 0.068}) as served, tempfile.TemporaryDirectory() as folder:
        tcp, file = _written(served.path, folder)
        environment = {**os.environ, "XDG_RUNTIME_DIR": folder}
        owner = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "busmaster", "serve", file, env=environment, stdout=DEVNULL, stderr=PIPE
        )
        address = f"unix:{folder}/busmaster/line.sock"
        attacked, target = owner, f"tcp://127.0.0.1:{tcp}"
        attackers: Process | None = None
        interface, attacked_interface = floods.interface_of(name), None
        try:
            async with await _entered(owner, address) as bus:
                if interface is not None:
                    attacked, target = await interface.start(address, target, f"{folder}/tokens")
                    attacked_interface = attacked
                busy = await _busy(bus)
                attackers = await asyncio.create_subprocess_exec(
                    *(sys.executable, "-m", "tests.app.service.attackers", "--attack", name),
                    *("--address", target, "--connections", str(connections)),
                    stderr=DEVNULL,
                    env={**os.environ, "HOLDER": WRITER},
                )
                await asyncio.sleep(2.0)
                measured = await _measure(bus, f"tcp://127.0.0.1:{tcp}", seconds)
                megabytes = _resident(attacked.pid)
                if interface is not None:
                    measured["others"] = await interface.answers(target)
            began = time.monotonic()
            owner.send_signal(signal.SIGTERM)
            assert owner.stderr is not None
            said = asyncio.ensure_future(owner.stderr.read())
            status = await asyncio.wait_for(owner.wait(), 60.0)
            await said
            return Outcome(
                busy,
                measured["kept"],
                measured["cycles"],
                measured["urgent"],
                measured["writes"],
                time.monotonic() - began,
                status,
                megabytes,
                measured["others"],
            )
        finally:
            for process in (attackers, attacked_interface, owner):
                if process is not None and process.returncode is None:
                    process.kill()
                    await process.wait()


def _written(port: str, folder: str) -> tuple[int, str]:
    """Write the files of a line, and return its TCP port and the path of its LINE.toml."""
    tokens = Path(folder, "tokens")
    tokens.write_text(f"reader {READER}\nwriter {WRITER}\noperator {OPERATOR}\n")
    tokens.chmod(0o600)
    with socket.create_server(("127.0.0.1", 0)) as free:
        tcp = free.getsockname()[1]
    names = [f"p{number}" for number in range(10)]
    # Every second register, so that no two are merged into one read.
    points = "\n".join(f'{name} = {{ item = "holding:{number * 9}" }}' for number, name in enumerate(names))
    shown = ", ".join(f'"unit/{name}"' for name in names)
    file, port = Path(folder, "line.toml"), f"{port}?baudrate=57600&parity=N"
    file.write_text(LINE.format(port=port, tcp=tcp, folder=folder, points=points, names=shown, period=PERIOD))
    return tcp, str(file)


async def _entered(owner: Process, address: str) -> RemoteBus:
    """Return a bus that can be entered: the owner's line is served."""
    for _ in range(300):
        if owner.returncode is not None:
            assert owner.stderr is not None
            raise AssertionError((await owner.stderr.read()).decode())
        with contextlib.suppress(BusError, InvalidCommand, OSError):
            async with connect(address) as bus:
                await bus.group(GROUP).ready()
            return connect(address)
        await asyncio.sleep(0.1)
    raise AssertionError("the owner does not serve its line")


async def _busy(bus: RemoteBus) -> float:
    """Return which share of the line the owner's cycles use, with nothing else on it."""
    used: list[float] = []
    async for snapshot in bus.group(GROUP):
        if snapshot.started is not None:
            used.append((snapshot.finished - snapshot.started) / PERIOD)
        if len(used) > ALONE:  # the first proves that the nodes are there
            break
    return sum(used[1:]) / ALONE


async def _measure(bus: RemoteBus, tcp: str, seconds: float) -> dict[str, Any]:
    group = bus.group(GROUP)
    waits: list[float] = []
    others = False

    async def operate() -> None:
        nonlocal others
        while True:
            with contextlib.suppress(BusError, InvalidCommand, OSError):
                async with connect(tcp, token=OPERATOR) as operator:
                    others = True
                    node = operator.node(PROFILE, UNIT)
                    while True:
                        began = time.monotonic()
                        await node.request(WriteRegisters(95, (1,)), priority=Priority.URGENT)
                        waits.append(time.monotonic() - began)
                        await asyncio.sleep(1.0)
            await asyncio.sleep(0.2)

    operating = asyncio.ensure_future(operate())
    kept = cycles = 0
    missed = -1
    end = time.monotonic() + seconds
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds + 1):
            async for snapshot in group:
                before, missed = missed, snapshot.missed
                if before >= 0:
                    cycles += 1 + missed - before
                    kept += snapshot.started is not None and snapshot.started - snapshot.due < PERIOD
                if time.monotonic() > end:
                    break
    operating.cancel()
    await asyncio.gather(operating, return_exceptions=True)
    cycles = max(cycles, round(0.8 * seconds / PERIOD)) if kept < 5 else cycles
    return {
        "kept": kept / max(cycles, 1),
        "cycles": cycles,
        "urgent": max(waits, default=float("inf")),
        "writes": len(waits),
        "others": others,
    }


def _resident(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def row(name: str, outcome: Outcome) -> str:
    """Return a line of the table."""
    urgent = f"{outcome.urgent * 1e3:.0f} ms ({outcome.writes})" if outcome.writes else "none"
    others = "yes" if outcome.others else "no"
    end = f"{outcome.end:.1f} s, {outcome.status}"
    kept = f"{outcome.kept:.0%} of {outcome.cycles}"
    cells = (name, FIRST.get(name, ""), f"{outcome.busy:.0%}", kept, urgent, end, f"{outcome.megabytes:.0f} MB", others)
    return f"| {' | '.join(cells)} |"


def with_rows(page: str, rows: dict[str, str]) -> str:
    """Return a page whose table has these rows, by attack, in the order of the attacks; others stay as they are."""
    before, head, rest = page.partition(HEAD)
    if not head:
        raise SystemExit("the page has no place for the table")
    old = list(takewhile(lambda line: line.startswith("|"), rest.splitlines(keepends=True)))
    known = {attack_of(line): line for line in old} | {name: f"{line}\n" for name, line in rows.items()}
    return before + head + "".join(known[name] for name in KINDS if name in known) + rest.removeprefix("".join(old))


def attack_of(line: str) -> str:
    """Return the attack of which a line of the table is."""
    return line.split("|")[1].strip()


async def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--attack")
    parser.add_argument("--address", default="")
    parser.add_argument("--connections", type=int, default=62)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--only", action="append", default=[])
    parser.add_argument("--json", action="store_true", help="print each outcome as an object")
    parser.add_argument("--write", type=Path, metavar="PAGE", help="put the rows into the table of this page")
    options = parser.parse_args()
    if options.attack:
        await attack(options.attack, options.address, options.connections)
    for name in KINDS:
        if options.only and name not in options.only:
            continue
        outcome = await run(name, options.connections, options.seconds)
        text = json.dumps({"attack": name, **outcome._asdict()}) if options.json else row(name, outcome)
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()
        if options.write is not None:  # each at once: a run that is broken off has written what it measured
            options.write.write_text(with_rows(options.write.read_text(), {name: row(name, outcome)}))
    return 0


if __name__ == "__main__":
    sys.exit(asyncio.run(main()))

"""What a program pays for asking through the socket of the process that owns the line, and what it costs the others.

The line is idle but for one reader: the owner itself, a program that is connected to it, and one that has a bare socket
and no words, which is the least that it can take, in turn, round by round. Then two programs read two such lines in
turn: of one of them, both ends have the library read and write all WebSocket frames, see `library_frames`.
Then seven programs saturate it, each with one command after the other, without and with an eighth that has ten thousand
waiting; a ninth writes urgently. Then the owner alone saturates it, and polls a group, without and with twenty programs
that read that group; a hold is what the owner's loop does between two looks at its ports, as in `loop_stalls`.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from statistics import median
from typing import Any, cast
from unittest import mock

from benchmarks.apart import Apart
from benchmarks.harness import Claim, Options, Outcome, Table, quantile
from benchmarks.library_frames import LibraryOutgoingConnection
from benchmarks.owned_line import BARE_REQUEST, GROUP, PAUSE, READ, UNIT, read
from benchmarks.served_line import ServedLine
from busmaster import Priority, RemoteBus, connect
from busmaster.app.service import link
from busmaster.protocols.modbus.codec import PROFILE, WriteRegisters

MOST = 0.4
"""Milliseconds that a remote read may take more than a local one."""
WARM_UP = 20
FRAME_READS = 5
"""Reads of each kind in one round: rounds are short, because the machine's speed varies."""
DELAY = 0.002
"""Seconds, always the same, that the unit takes to reply."""
OTHERS = 7
WAITING = 10_000
BESIDE_TURNS = 1.0
"""Milliseconds beside two exchanges for which one with many requests may delay another's command."""
URGENT_EVERY = 0.05
BESIDE_ONE = 1.5
"""Milliseconds beside the exchange on the wire for which an urgent write may wait."""
READERS = 20
LEAST_RATE = 99.0
MOST_LAG = 1.0


def run(options: Options) -> Outcome:
    outcome = Outcome()
    with ServedLine(UNIT, delay={"low": DELAY}) as line:
        owner = Apart("benchmarks.owned_line", paced=False)
        try:
            address, bare = owner.ask({"port": line.path})
            asyncio.run(_idle(owner, address, bare, options, outcome))
            _compare_frames(address, options, outcome)
            asyncio.run(_crowd(address, options, outcome))
            asyncio.run(_audience(owner, address, options, outcome))
        finally:
            owner.close()
    return outcome


# an idle line


async def _idle(owner: Apart, address: str, bare: str, options: Options, outcome: Outcome) -> None:
    local: list[float] = []
    remote: list[float] = []
    least: list[float] = []
    _, asking = await asyncio.get_running_loop().create_unix_connection(BareAsking, bare)
    async with connect(address) as bus:
        node = bus.node(PROFILE, UNIT)
        await read(node, WARM_UP)
        for _ in range(options.pick(40, 2)):
            local += await asyncio.to_thread(owner.ask, {"reads": 25})
            remote += await read(node, 25)
            least += await asking.read(25)
    asking.transport.close()
    table = Table("A read on an idle line, ms", ("who reads", "reads", "p50", "p99"))
    rows = (("the owner", local), ("a program, by its socket", remote), ("the same, by a bare one", least))
    for who, took in rows:
        table.row(who, len(took), quantile(took, 0.5) * 1000, quantile(took, 0.99) * 1000)
    outcome.tables.append(table)
    more = (quantile(remote, 0.5) - quantile(local, 0.5)) * 1000
    outcome.claims.append(Claim("what a remote read takes more than a local one, p50, ms", more, MOST))
    outcome.series = {"local": local, "remote": remote, "by a bare socket": least}


def _compare_frames(address: str, options: Options, outcome: Outcome) -> None:
    with ServedLine(UNIT, delay={"low": DELAY}) as line:
        owner = Apart("benchmarks.owned_line", paced=False)
        try:
            other, _ = owner.ask({"port": line.path, "library": True})
            asyncio.run(_frames(address, other, options, outcome))
        finally:
            owner.close()


async def _frames(address: str, other: str, options: Options, outcome: Outcome) -> None:
    own: list[float] = []
    library: list[float] = []
    ratios: list[float] = []
    async with AsyncExitStack() as stack:
        nodes = [(await stack.enter_async_context(connect(address))).node(PROFILE, UNIT)]
        with mock.patch.object(link, "OutgoingConnection", LibraryOutgoingConnection):
            nodes.append((await stack.enter_async_context(connect(other))).node(PROFILE, UNIT))
        for node in nodes:
            await read(node, WARM_UP)
        for number in range(options.pick(200, 2)):
            taken = {node: await read(node, FRAME_READS) for node in (nodes if number % 2 else reversed(nodes))}
            ratios.append(median(taken[nodes[1]]) / median(taken[nodes[0]]))
            own += taken[nodes[0]]
            library += taken[nodes[1]]
    columns = ("frames", "reads", "p50", "p99")
    note = f"with the library, a read takes {100 * (median(ratios) - 1):.3g} % longer (median of {len(ratios)} ratios)"
    table = Table("A remote read on an idle line, ms", columns, notes=[note])
    for who, took in (("of the service", own), ("of the library", library)):
        table.row(who, len(took), quantile(took, 0.5) * 1000, quantile(took, 0.99) * 1000)
    outcome.tables.append(table)
    outcome.series |= {"library frames": library, "ratios of frames": ratios}


class BareAsking(asyncio.Protocol):
    """The asking end of a bare socket."""

    transport: asyncio.Transport
    _answered: asyncio.Future[None]

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast("asyncio.Transport", transport)

    def data_received(self, data: bytes) -> None:
        self._answered.set_result(None)

    async def read(self, count: int) -> list[float]:
        """Have something read so often, as `owned_line.read` does."""
        took = []
        for _ in range(count):
            await asyncio.sleep(PAUSE)
            begun = time.perf_counter()
            self._answered = asyncio.get_running_loop().create_future()
            self.transport.write(BARE_REQUEST)
            await self._answered
            took.append(time.perf_counter() - begun)
        return took


# a line that programs saturate


async def _crowd(address: str, options: Options, outcome: Outcome) -> None:
    alone: list[float] = []
    beside: list[float] = []
    urgent: list[float] = []
    writes: list[float] = []
    exchanges: list[float] = []
    seconds, rounds = options.pick(4.0, 0.3), options.pick(6, 2)
    async with AsyncExitStack() as stack:
        others = [await stack.enter_async_context(connect(address)) for _ in range(OTHERS)]
        writer = await stack.enter_async_context(connect(address))
        writes += await _write_urgently(writer, options.pick(100, 5))
        for _ in range(rounds):
            counted, took = await _commands(others, seconds)
            exchanges.append(took / len(counted))
            alone += counted
            async with _greedy(address):
                writing = asyncio.create_task(_write_urgently(writer, int(seconds / URGENT_EVERY)))
                counted, _ = await _commands(others, seconds)
                beside += counted
                urgent += await writing
    exchange = median(exchanges) * 1000
    table = Table(f"On a saturated line, ms; an exchange takes {exchange:.3g} ms", ("what", "number", "p50", "p99"))
    rows = {
        f"a command of one of {OTHERS} programs": alone,
        f"the same beside one with {WAITING} waiting": beside,
        "an urgent write on the idle line": writes,
        "an urgent write beside all those": urgent,
    }
    for what, taken in rows.items():
        table.row(what, len(taken), quantile(taken, 0.5) * 1000, quantile(taken, 0.99) * 1000)
    outcome.tables.append(table)
    delay = (quantile(beside, 0.99) - quantile(alone, 0.99)) * 1000
    wait = (quantile(urgent, 0.99) - quantile(writes, 0.5)) * 1000
    outcome.claims += [
        Claim(
            f"for what one with {WAITING} waiting delays others' commands, p99, ms", delay, 2 * exchange + BESIDE_TURNS
        ),
        Claim("for what an urgent remote write waits, p99, ms", wait, exchange + BESIDE_ONE),
    ]
    outcome.series |= {"commands": alone, "commands beside one with many": beside, "urgent writes": urgent}


async def _commands(programs: Sequence[RemoteBus], seconds: float) -> tuple[list[float], float]:
    """Return what each command took, and all together, while each program has one after the other carried out."""
    begun = time.perf_counter()
    taken: list[float] = []

    async def ask(bus: RemoteBus) -> None:
        node = bus.node(PROFILE, UNIT)
        while (asked := time.perf_counter()) < begun + seconds:
            await node.request(READ)
            taken.append(time.perf_counter() - asked)

    await asyncio.gather(*map(ask, programs))
    return taken, time.perf_counter() - begun


@asynccontextmanager
async def _greedy(address: str) -> AsyncIterator[None]:
    """Have a program ask for more than the line can carry out, and all at once."""
    async with connect(address) as bus:
        node = bus.node(PROFILE, UNIT)

        asking = [asyncio.ensure_future(node.request(READ)) for _ in range(WAITING)]
        await asyncio.sleep(0.2)
        yield
        for one in asking:
            one.cancel()
        await asyncio.gather(*asking, return_exceptions=True)


async def _write_urgently(bus: RemoteBus, count: int) -> list[float]:
    node = bus.node(PROFILE, UNIT)
    taken = []
    for number in range(count):
        await asyncio.sleep(URGENT_EVERY * (0.5 + number * 0.618 % 1))  # at no fixed place of the others' turns
        begun = time.perf_counter()
        await node.request(WriteRegisters(50, (number,)), priority=Priority.URGENT)
        taken.append(time.perf_counter() - begun)
    return taken


# a line whose owner is listened to


async def _audience(owner: Apart, address: str, options: Options, outcome: Outcome) -> None:
    def saturate() -> Any:
        return owner.ask({"saturate": options.pick(4.0, 0.3)})

    owner.ask({"polls": True})
    holds: dict[bool, list[float]] = {False: [], True: []}
    rates: dict[bool, list[float]] = {False: [], True: []}
    cycles = 0
    for number in range(options.pick(12, 2)):
        for listened in (True, False) if number % 2 else (False, True):
            async with AsyncExitStack() as stack:
                heard = [await stack.enter_async_context(_reader(address)) for _ in range(READERS if listened else 0)]
                said = await asyncio.to_thread(saturate)
            cycles += sum(map(len, heard))
            holds[listened] += said["holds"]
            rates[listened].append(said["rate"])
    owner.ask({"polls": False})
    columns = ("readers", "exchanges /s", "turns of the loop", "hold p50", "hold p99.9", "longest hold")
    table = Table("The owner's line and loop, ms", columns, notes=[f"{cycles} cycles came to the readers"])
    for listened, each in holds.items():
        figures = (quantile(each, 0.5), quantile(each, 0.999), max(each))
        table.row(READERS if listened else 0, median(rates[listened]), len(each), *figures)
    outcome.tables.append(table)
    kept = 100 * median(a / b for a, b in zip(rates[True], rates[False], strict=True))
    outcome.claims += [
        Claim(f"% of the line's rate that is kept with {READERS} readers", kept, LEAST_RATE, at_most=False),
        Claim(f"hold of the owner's loop with {READERS} readers, p99.9, ms", quantile(holds[True], 0.999), MOST_LAG),
    ]
    outcome.series |= {"rates with readers": rates[True], "rates without": rates[False]}


@asynccontextmanager
async def _reader(address: str) -> AsyncIterator[list[int]]:
    """Have a program read the group; yield the numbers of the cycles that came to it."""
    heard: list[int] = []
    async with connect(address) as bus:
        group = bus.group(GROUP)

        async def hear() -> None:
            heard.extend([snapshot.cycle async for snapshot in group])

        hearing = asyncio.ensure_future(hear())
        yield heard
    await hearing

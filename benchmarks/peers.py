"""On a line where nothing goes wrong: rate and processor time of ours and of the peers, the same frames.

First on a paced line of 57600 baud with a reply time of 2 ms, one caller after another; then on one that is not paced,
without the silence between frames where a master can do without it, so that the masters themselves are measured.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import replace

from benchmarks.harness import Options, Outcome, Table, alternate
from benchmarks.lines import Lines
from benchmarks.masters import Bare, Question
from benchmarks.modbus_masters import PROFILE, TIMINGS, Busmaster, Failed, Minimalmodbus, ModbusMaster, masters, notes
from benchmarks.served_line import SETTINGS, value_of
from busmaster import LineSettings, SerialPort, Timings
from busmaster.protocols.modbus.codec import ReadRegisters, with_crc

DELAY = 0.002
CALLERS = 4
NO_GAP = Timings.uniform(replace(TIMINGS.read, driver_release_time=0.0))
NAMED = [(unit, register) for unit in range(1, 5) for register in (0, 7, 99)]
COLUMNS = ("master", "wrong", "failed", "/s", "us each", "x ours", "CPU us", "x ours")


def run(options: Options) -> Outcome:
    outcome = Outcome()
    paced = f"{SETTINGS.baudrate} baud, reply time {DELAY * 1000:g} ms, each master's own silence between frames"
    outcome.tables.append(asyncio.run(_measure(paced, SETTINGS, options, outcome)))
    outcome.tables.append(asyncio.run(_measure("Not paced; ours without a silence", None, options, outcome)))
    outcome.tables[0].notes += notes(options)
    outcome.tables[0].notes.append("Modbus asks for 1.75 ms of silence between frames; pymodbus does not keep it")
    return outcome


def questions() -> list[Question]:
    found = []
    for unit, register in NAMED:
        command = ReadRegisters(register)
        value = value_of(unit, register)
        reply = with_crc(bytes((unit, 3, 2)) + value.to_bytes(2, "big"))
        found.append(Question(command, unit, command.open(unit, PROFILE.timings).request, (reply,), (value,)))
    return found


async def _measure(title: str, settings: LineSettings | None, options: Options, outcome: Outcome) -> Table:
    compared: list[ModbusMaster] = [maker() for maker in masters(options)]
    if settings is None:
        compared[0] = Busmaster(NO_GAP)
    bare = Bare(questions())
    replies = {ask.request: ask.reply for ask in questions()}
    runs: dict[str, Callable[[int], Awaitable[int]]] = {}
    failed: Counter[str] = Counter()
    delay = DELAY if settings is not None else 0.0
    with Lines(len(compared) + 1, replies, settings=settings, delay=delay) as lines:
        for master, port in zip(compared, lines.ports, strict=False):
            assert isinstance(port, SerialPort)
            await master.open(port.path)
            if isinstance(master, Minimalmodbus):
                runs[master.name] = _blocking(master, failed)
            else:
                runs[master.name] = _concurrent(master, failed)
            await runs[master.name](len(NAMED))
        await bare.open(lines.ports[-1])
        runs[bare.name] = bare.run
        transactions, rounds = (
            options.pick((150, 9), (12, 3)) if settings is not None else options.pick((300, 20), (50, 5))
        )
        timings = await alternate(runs, transactions, rounds)
        for master in compared:
            await master.close()
        await bare.close()
    ours = timings["busmaster"]
    table = Table(title, COLUMNS)
    for name, own in timings.items():
        cpu = own.cpu_each / ours.cpu_each
        table.row(name, own.wrong, failed[name], 1 / own.each, own.each * 1e6, own.ratio(ours), own.cpu_each * 1e6, cpu)
    outcome.wrong += ours.wrong
    return table


def _concurrent(master: ModbusMaster, failed: Counter[str]) -> Callable[[int], Awaitable[int]]:
    async def run(transactions: int) -> int:
        return sum(await asyncio.gather(*(_call(master, n, transactions // CALLERS, failed) for n in range(CALLERS))))

    return run


async def _call(master: ModbusMaster, number: int, transactions: int, failed: Counter[str]) -> int:
    wrong = 0
    for n in range(transactions):
        unit, register = NAMED[(number + n) % len(NAMED)]
        try:
            wrong += await master.read(unit, register) != value_of(unit, register)
        except Failed:
            failed[master.name] += 1
    return wrong


def _blocking(master: Minimalmodbus, failed: Counter[str]) -> Callable[[int], Awaitable[int]]:
    """Without the thread that the other scenarios need: as it is used in a plain script."""

    async def run(transactions: int) -> int:
        wrong = 0
        for n in range(transactions):
            unit, register = NAMED[n % len(NAMED)]
            try:
                wrong += master.read_blocking(unit, register) != value_of(unit, register)
            except Failed:
                failed[master.name] += 1
        return wrong

    return run

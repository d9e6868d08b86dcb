"""Four Modbus TCP clients share a line that loses frames: `python -m tests.verification.modbus_clients`.

pymodbus, libmodbus, mbpoll and modbus-serial (npm) make requests at once to `busmaster modbus-tcp --pass-through`, in
front of `busmaster serve` with eight emulated Modbus RTU units. One percent of the line's frames, requests and replies,
are lost. Each register holds a number that says whose it is, so that a reply to another request is a wrong value. Of
ten requests of a client, but for mbpoll, which only reads, one writes a register of the client's own, the next reads
it back, and one reads a point of the automatic map. Meanwhile the owner polls one register of each unit.

It prints, for each client, its replies, exceptions by code, wrong values, latencies, and how many of its requests were
replied to until the first client had finished; and how many of the owner's cycles were kept. It ends with 1 if a
value is wrong, or if a request had no reply. `--requests` are those of all four. A client that is not installed is left
out, with a line that says so. modbus-serial is found by NODE_PATH.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import ctypes
import json
import os
import random
import re
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
from asyncio.subprocess import DEVNULL, PIPE, Process
from collections import Counter
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import TypeAlias

from benchmarks.served_line import emulated_units, value_of
from busmaster import BusError, InvalidCommand, connect
from busmaster.contract.profile import LineSettings
from busmaster.emulator.line import Line
from busmaster.emulator.serve import serve_tcp
from tests.verification.modbus_clients.clients import LIBRARY

HERE = Path(__file__).parent
ROOT = HERE.parents[2]
UNITS = 8
OWN_REGISTER = 90
"""The first register that clients write; reads of others stay below it."""
POLLED = 1
"""The register of each unit that the owner polls: a point."""
POINTS = 255
"""The unit id of the points."""
MOST_SHOWN = 10

Step: TypeAlias = tuple[str, int, int, int]


def steps_of(number: int, many: int) -> list[Step]:
    """Return the requests of one client."""
    made: list[Step] = []
    for one in range(many):
        unit = 1 + (one // 2 * 7 + 3 * number) % UNITS
        match one % 10:
            case 4:
                made.append(("write", unit, OWN_REGISTER + number, one % 65536))
            case 5:
                made.append(("read", unit, OWN_REGISTER + number, 1))
            case 7:
                made.append(("read", POINTS, 4 * (one % UNITS), 4))
            case _:
                made.append(("read", unit, (one * 13 + number) % 80, 1 + one % 10))
    return made


@dataclass
class Judged:
    """One client: its replies so far, and what is wrong with them."""

    name: str
    wanted: int
    replies: int = 0
    good: int = 0
    at_first_end: int = 0
    """Its replies when the first client had finished."""
    codes: Counter[int] = field(default_factory=Counter)
    seconds: list[float] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    own: dict[int, set[int]] = field(default_factory=dict)
    """What its own register of each unit can hold: several values after a write that was not confirmed."""

    def judge(self, step: Step, code: int, values: list[int]) -> None:
        """Compare a reply with what the registers hold."""
        kind, unit, first, what = step
        self.replies += 1
        own = self.own.get(unit, {value_of(unit, first)})
        if kind == "write":
            self.own[unit] = {what} if code == 0 else own | {what}
        if code != 0:
            self.codes[code] += 1
            return
        self.good += 1
        if kind == "write":
            return
        if unit == POINTS:
            right = values == list(struct.unpack(">4H", struct.pack(">d", value_of(1 + first // 4, POLLED))))
        elif first >= OWN_REGISTER:
            right = len(values) == 1 and values[0] in own
        else:
            right = values == [value_of(unit, register) for register in range(first, first + what)]
        if not right:
            self.wrong.append(f"request {self.replies}, {step}: {values}")


async def library_client(judged: Judged, steps: list[Step], command: list[str]) -> None:
    """Run a client that takes its requests from a file."""
    with tempfile.NamedTemporaryFile("w", suffix=".json") as file:
        json.dump(steps, file)
        file.flush()
        process = await asyncio.create_subprocess_exec(*command, file.name, stdout=PIPE, cwd=ROOT)
        async with ended(process):
            assert process.stdout is not None
            for step in steps:
                line = await process.stdout.readline()
                if not line:
                    break
                reply = json.loads(line)
                judged.seconds.append(reply["seconds"])
                judged.judge(step, reply["code"], reply["values"])


async def mbpoll(judged: Judged, port: int) -> None:
    """Run mbpoll, which reads all units in turn, with a pause of 11 ms, until there are enough replies.

    It reads the same registers for good, so there are several runs one after the other, each with registers of its own.
    """
    run = max(200, judged.wanted // 20)
    for turn in count():
        if judged.replies >= judged.wanted:
            return
        first, many = 7 * turn % 80, 1 + turn % 10
        process = await asyncio.create_subprocess_exec(
            *("stdbuf", "-oL", "mbpoll", "-m", "tcp", "-p", str(port), "-0", "-r", str(first), "-c", str(many)),
            *("-a", f"1:{UNITS}", "-l", "11", "-o", "10", "127.0.0.1"),
            stdout=PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        async with ended(process):
            await _read_mbpoll(process, judged, first, many, min(judged.wanted, judged.replies + run))


async def _read_mbpoll(process: Process, judged: Judged, first: int, many: int, until: int) -> None:
    assert process.stdout is not None
    unit, values, began = 0, list[int](), time.monotonic()
    while judged.replies < until and (line := (await process.stdout.readline()).decode()):
        if found := re.match(r"-- Polling slave (\d+)", line):
            unit, values, began = int(found[1]), [], time.monotonic()
        elif found := re.match(r"\[(\d+)\]:\s+(\d+)", line):
            values.append(int(found[2]))
            if int(found[1]) != first + len(values) - 1:
                judged.wrong.append(f"mbpoll: {line!r} behind {values}")
            if len(values) == many:
                judged.seconds.append(time.monotonic() - began)
                judged.judge(("read", unit, first, many), 0, values)
        elif "failed" in line:
            judged.judge(("read", unit, first, many), code_of_text(line), [])


def code_of_text(line: str) -> int:
    """Return the exception that mbpoll names; -1 for no reply."""
    texts = {"Illegal": 2, "busy": 6, "Slave device": 4, "path": 10, "Target": 11, "target": 11}
    return next((code for text, code in texts.items() if text in line), -1)


@contextlib.asynccontextmanager
async def ended(process: Process) -> AsyncIterator[Process]:
    """End a process at the end."""
    try:
        yield process
    finally:
        if process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()


def missing(node: str | None) -> dict[str, str]:
    """Return which clients are not installed, and why."""
    absent: dict[str, str] = {}
    if shutil.which("mbpoll") is None:
        absent["mbpoll"] = "there is no program mbpoll"
    try:
        ctypes.CDLL(LIBRARY)
    except OSError as error:
        absent["libmodbus"] = str(error)
    if node is None:
        absent["modbus-serial"] = "there is no program node"
    elif subprocess.run([node, "-e", 'require("modbus-serial")'], capture_output=True, check=False).returncode:
        absent["modbus-serial"] = "node finds no modbus-serial: set NODE_PATH to its node_modules"
    return absent


def line_file(folder: str, port: str, baudrate: int, period: float, timing: str) -> str:
    """Write LINE.toml, and return its path."""
    nodes = "\n".join(
        f'[nodes.u{unit}]\nprotocol = "modbus"\naddress = {unit}\ntiming = {{ {timing} }}\n'
        f'points.p = {{ item = "holding:{POLLED}" }}'
        for unit in range(1, UNITS + 1)
    )
    points = ", ".join(f'"u{unit}/p"' for unit in range(1, UNITS + 1))
    path = Path(folder, "line.toml")
    group = f"[groups.polled]\nperiod = {period}\npoints = [{points}]"
    path.write_text(f'port = "{port}?baudrate={baudrate}"\n{nodes}\n{group}\n')
    return str(path)


@contextlib.asynccontextmanager
async def program(*arguments: str, folder: str) -> AsyncIterator[Process]:
    """Run a command of busmaster."""
    environment = {**os.environ, "XDG_RUNTIME_DIR": folder}
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "busmaster", *arguments), env=environment, cwd=ROOT, stdin=DEVNULL, stderr=PIPE
    )
    async with ended(process):
        yield process
        process.send_signal(signal.SIGTERM)
        await process.communicate()


async def await_text(process: Process, pattern: str) -> re.Match[str]:
    """Wait until a process reports something."""
    assert process.stderr is not None
    text = ""
    while line := (await process.stderr.readline()).decode():
        text += line
        if found := re.search(pattern, line):
            return found
    raise SystemExit(f"it ended: {text}")


@dataclass
class Cycles:
    """The cycles of the owner's group."""

    done: int = 0
    missed: int = 0
    failed: int = 0
    latest: float = 0.0
    """The longest time from when a cycle was due until it started."""


async def count_cycles(folder: str, cycles: Cycles) -> None:
    """Follow the owner's group until cancelled."""
    async with connect(f"unix:{folder}/busmaster/line.sock") as bus:
        before: int | None = None
        async for snapshot in bus.group("polled"):
            if before is not None and snapshot.started is not None:
                cycles.done += 1
                cycles.missed += snapshot.missed - before
                cycles.failed += sum(sample.error is not None for _, sample in snapshot.items())
                cycles.latest = max(cycles.latest, snapshot.started - snapshot.due)
            before = snapshot.missed


async def story(options: argparse.Namespace) -> tuple[list[Judged], Cycles, float]:
    """Run the line, its owner, the interface and the clients."""
    node = shutil.which("node")
    absent = missing(node)
    for name, why in absent.items():
        sys.stdout.write(f"{name} is left out: {why}\n")
    names = [name for name in ("pymodbus", "libmodbus", "mbpoll", "modbus-serial") if name not in absent]
    chance = random.Random(options.seed)
    line = Line(LineSettings(options.baudrate), emulated_units(UNITS, {}), chance=chance, paced=not options.unpaced)
    judged = [Judged(name, options.requests // len(names)) for name in names]
    cycles = Cycles()
    with serve_tcp(line) as server, tempfile.TemporaryDirectory() as folder:
        timing = f"window = {options.window}, max_reply_delay = {options.max_reply_delay}"
        file = line_file(folder, server.path, options.baudrate, options.period, timing)
        allowed = [argument for unit in range(1, UNITS + 1) for argument in ("--allow-unit", str(unit))]
        async with (
            program("serve", file, folder=folder) as owner,
            program(
                "modbus-tcp", file, "--bind", "127.0.0.1:0", "--pass-through", *allowed, folder=folder
            ) as interface,
        ):
            port = int((await await_text(interface, r"serving Modbus TCP at 127\.0\.0\.1:(\d+)"))[1])
            await ready(folder)
            quiet = [asyncio.ensure_future(_swallow(process)) for process in (owner, interface)]
            counting = asyncio.ensure_future(count_cycles(folder, cycles))
            await asyncio.sleep(2 * options.period)
            server.call(lambda line, _: setattr(line.faults, "lost", options.lost))
            began = time.monotonic()

            async def run(number: int, one: Judged) -> None:
                if one.name == "mbpoll":
                    await mbpoll(one, port)
                else:
                    module = "tests.verification.modbus_clients.clients"
                    command = [sys.executable, "-m", module, one.name, str(port)]
                    if one.name == "modbus-serial":
                        command = [str(node), str(HERE / "client.js"), str(port)]
                    await library_client(one, steps_of(number, one.wanted), command)
                if not any(other.at_first_end for other in judged):
                    for other in judged:
                        other.at_first_end = other.replies

            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(options.seconds):
                    await asyncio.gather(*(run(number, one) for number, one in enumerate(judged)))
            took = time.monotonic() - began
            counting.cancel()
            for task in quiet:
                task.cancel()
            await asyncio.gather(counting, *quiet, return_exceptions=True)
    return judged, cycles, took


async def ready(folder: str) -> None:
    """Wait until the owner has read its points."""
    while True:
        with contextlib.suppress(BusError, InvalidCommand, OSError):
            async with connect(f"unix:{folder}/busmaster/line.sock") as bus:
                await bus.group("polled").ready()
                return
        await asyncio.sleep(0.1)


async def _swallow(process: Process) -> None:
    assert process.stderr is not None
    while await process.stderr.readline():
        pass


def lines_of(judged: list[Judged], cycles: Cycles, took: float) -> Iterator[str]:
    """Return the report."""
    replies = sum(one.replies for one in judged)
    yield f"{replies} requests in {took:.0f} s ({replies / took:.0f} a second)"
    for one in judged:
        ranked = sorted(one.seconds) or [0.0]
        times = ", ".join(
            f"{1e3 * ranked[min(len(ranked) - 1, int(part * len(ranked)))]:.0f}" for part in (0.5, 0.99, 1)
        )
        codes = ", ".join(f"{many} of code {code}" for code, many in sorted(one.codes.items())) or "none"
        yield (
            f"{one.name}: {one.replies} of {one.wanted} replied to, {len(one.wrong)} wrong, exceptions: {codes}; "
            f"50 %, 99 %, 100 % within {times} ms; {one.at_first_end} when the first had finished"
        )
        yield from (f"  WRONG: {text}" for text in one.wrong[:MOST_SHOWN])
    of_time = f"latest start {1e3 * cycles.latest:.0f} ms after it was due"
    yield f"owner: {cycles.done} cycles, {cycles.missed} missed, {cycles.failed} values not read, {of_time}"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.verification.modbus_clients", description=__doc__)
    parser.add_argument("--requests", type=int, default=5000)
    parser.add_argument("--lost", type=float, default=0.01, help="share of the line's frames that are lost")
    parser.add_argument("--baudrate", type=int, default=115200)
    parser.add_argument("--period", type=float, default=1.0, help="of the owner's group of eight points")
    parser.add_argument("--seconds", type=float, help="end sooner, and report what there is")
    parser.add_argument("--window", type=float, default=0.08, help="reply window of the units, in seconds")
    parser.add_argument("--max-reply-delay", type=float, default=0.25, help="of the units, in seconds")
    parser.add_argument("--unpaced", action="store_true", help="the line takes no time")
    parser.add_argument("--seed", type=int, default=1)
    judged, cycles, took = asyncio.run(story(parser.parse_args()))
    sys.stdout.write("".join(f"{line}\n" for line in lines_of(judged, cycles, took)))
    return int(any(one.wrong or one.codes[-1] or one.replies < one.wanted for one in judged))


if __name__ == "__main__":
    sys.exit(main())

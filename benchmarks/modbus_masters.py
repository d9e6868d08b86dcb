"""Ours and the peers as Modbus RTU masters: same frames, windows, gaps and retries, settings as each one's
documentation has them.

Every adapter reads and writes one holding register of one unit, at once from many tasks. `Failed` is any honest
failure: no reply, a garbled one, a refusal. What a peer lacks and its documentation leaves to the user is added here
and said in `settings`: a lock, retries, a thread.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable
from dataclasses import replace
from importlib import import_module, metadata
from typing import Any, Protocol, TypeVar

from benchmarks.harness import Options, installed
from benchmarks.served_line import SETTINGS
from busmaster import Bus, BusError, Endpoint, Node, Priority, ReplyTiming, Timings, endpoint
from busmaster.ext import Learned, longest_hold
from busmaster.protocols.modbus import codec as modbus
from busmaster.protocols.modbus.codec import SILENCE, ReadRegisters, WriteRegisters

T = TypeVar("T")

WINDOW = 0.1
MAX_REPLY_DELAY = 0.15
RETRIES = 2
LONGEST_REPLY = 8
PROFILE = replace(modbus.PROFILE, line=SETTINGS)
TIMINGS = Timings.uniform(
    ReplyTiming(
        late_after=0.05,
        window=WINDOW,
        max_reply_delay=MAX_REPLY_DELAY,
        inter_byte_timeout=0.02,
        driver_release_time=SILENCE,
    )
)


class Failed(Exception):
    """No value, and the caller knows it."""


class ModbusMaster(Protocol):
    name: str
    settings: str

    async def open(self, path: str) -> None: ...
    async def read(self, unit: int, register: int) -> int: ...
    async def write(self, unit: int, register: int, value: int) -> None:
        """As urgently as this master knows how."""

    async def close(self) -> None: ...


class Busmaster:
    name = "busmaster"
    settings = f"window {WINDOW * 1000:g} ms, maximum reply delay {MAX_REPLY_DELAY * 1000:g} ms, {RETRIES} retries"

    def __init__(self, timings: Timings = TIMINGS, learned: bool = False) -> None:
        self.bus: Bus | None = None
        self.waits: list[float] = []
        """Of each write: seconds until it was sent."""
        self._timings = timings
        self._learned = learned
        if learned:
            self.name = "busmaster, learned times"
        self._nodes: dict[int, Node] = {}

    async def open(self, path: str) -> None:
        await self.open_endpoint(endpoint(path, defaults=SETTINGS))

    async def open_endpoint(self, endpoint: Endpoint) -> None:
        self.bus = Bus(endpoint)
        await self.bus.__aenter__()

    def node(self, unit: int) -> Node:
        assert self.bus is not None
        if unit not in self._nodes:
            timings = Learned(self._timings) if self._learned else self._timings
            self._nodes[unit] = self.bus.node(PROFILE, unit, timings=timings, retries=RETRIES)
        return self._nodes[unit]

    async def read(self, unit: int, register: int) -> int:
        try:
            return (await self.node(unit).request(ReadRegisters(register)))[0]
        except BusError as error:
            raise Failed from error

    async def write(self, unit: int, register: int, value: int) -> None:
        try:
            command = WriteRegisters(register, (value,))
            _, timeline = await self.node(unit).timed_request(command, priority=Priority.URGENT)
        except BusError as error:
            raise Failed from error
        if timeline.started is not None:
            self.waits.append(timeline.started - timeline.queued)

    @property
    def longest_hold(self) -> float:
        """Seconds for which one exchange can keep an urgent one waiting, in the worst case (W_urgent)."""
        assert self.bus is not None
        return longest_hold(ReadRegisters(0).open(1, self._timings), self.bus._byte_time)

    async def close(self) -> None:
        assert self.bus is not None
        await self.bus.__aexit__(None, None, None)


class Pymodbus:
    name = "pymodbus"
    settings = f"async client, timeout {WINDOW * 1000:g} ms, {RETRIES} retries, calls serialised by a lock"

    def __init__(self) -> None:
        self._lock = asyncio.Lock()
        self._client: Any = None

    async def open(self, path: str) -> None:
        from pymodbus.client import AsyncModbusSerialClient

        self._client = AsyncModbusSerialClient(path, baudrate=SETTINGS.baudrate, timeout=WINDOW, retries=RETRIES)
        await self._client.connect()

    async def read(self, unit: int, register: int) -> int:
        reply = await self._ask(lambda: self._client.read_holding_registers(register, count=1, device_id=unit))
        return int(reply.registers[0])

    async def write(self, unit: int, register: int, value: int) -> None:
        await self._ask(lambda: self._client.write_register(register, value, device_id=unit))

    async def _ask(self, call: Callable[[], Awaitable[Any]]) -> Any:
        from pymodbus.exceptions import ModbusException

        async with self._lock:
            try:
                reply = await call()
            except ModbusException as error:
                raise Failed from error
        if reply.isError():
            raise Failed(str(reply))
        return reply

    async def close(self) -> None:
        self._client.close()


class Minimalmodbus:
    name = "minimalmodbus"
    settings = f"timeout {WINDOW * 1000:g} ms, buffers cleared; {RETRIES} retries, a lock and a thread around it"

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._instruments: dict[int, Any] = {}
        self._path = ""

    async def open(self, path: str) -> None:
        self._path = path
        self._instrument(1)

    async def read(self, unit: int, register: int) -> int:
        return await asyncio.to_thread(self.read_blocking, unit, register)

    def read_blocking(self, unit: int, register: int) -> int:
        return int(self._retried(lambda: self._instrument(unit).read_register(register)))

    async def write(self, unit: int, register: int, value: int) -> None:
        write = self._instrument(unit).write_register
        await asyncio.to_thread(self._retried, lambda: write(register, value, functioncode=6), 0)

    def _retried(self, call: Callable[[], T], retries: int = RETRIES) -> T:
        with self._lock:
            for left in reversed(range(retries + 1)):
                try:
                    return call()
                except OSError as error:  # its own exceptions are all IOError
                    if not left:
                        raise Failed from error
        raise AssertionError("a call either returns or raises")

    def _instrument(self, unit: int) -> Any:
        import minimalmodbus

        if unit not in self._instruments:
            instrument = minimalmodbus.Instrument(self._path, unit)
            instrument.serial.baudrate = SETTINGS.baudrate
            instrument.serial.timeout = WINDOW
            self._instruments[unit] = instrument
        return self._instruments[unit]

    async def close(self) -> None:
        self._instrument(1).serial.close()


class Tmodbus:
    name = "tmodbus"
    settings = f"timeout {WINDOW * 1000:g} ms; {RETRIES} retries around it"

    def __init__(self) -> None:
        self._client: Any = None

    async def open(self, path: str) -> None:
        options: dict[str, Any] = {"baudrate": SETTINGS.baudrate}
        self._client = import_module("tmodbus").create_async_rtu_client(path, unit_id=1, timeout=WINDOW, **options)
        await self._client.connect()

    async def read(self, unit: int, register: int) -> int:
        client = self._client.for_unit_id(unit)
        return int((await self._ask(lambda: client.read_holding_registers(register, 1), RETRIES))[0])

    async def write(self, unit: int, register: int, value: int) -> None:
        client = self._client.for_unit_id(unit)
        await self._ask(lambda: client.write_single_register(register, value), 0)

    async def _ask(self, call: Callable[[], Awaitable[Any]], retries: int) -> Any:
        errors = (import_module("tmodbus.exceptions").TModbusError, TimeoutError)
        for left in reversed(range(retries + 1)):
            try:
                return await call()
            except errors as error:
                if not left:
                    raise Failed from error
        raise AssertionError("a call either returns or raises")

    async def close(self) -> None:
        await self._client.disconnect()


class Anymodbus:
    """`late`: with the late-reply window that its documentation offers, off by default."""

    def __init__(self, late: bool) -> None:
        self.name = "anymodbus, late_reply_window" if late else "anymodbus"
        self.settings = f"timeout {WINDOW * 1000:g} ms, {RETRIES} retries"
        if late:
            self.settings += ", late_reply_window by its own estimate"
        self._late = late
        self._bus: Any = None

    async def open(self, path: str) -> None:
        anymodbus = import_module("anymodbus")
        estimate = import_module("anymodbus.config").estimate_late_reply_window
        window = estimate(baudrate=SETTINGS.baudrate, max_turnaround=MAX_REPLY_DELAY, max_reply_bytes=LONGEST_REPLY)
        config = anymodbus.BusConfig(
            request_timeout=WINDOW,
            retries=anymodbus.RetryPolicy(retries=RETRIES),
            timing=anymodbus.TimingConfig(late_reply_window=window if self._late else 0.0),
        )
        self._bus = await anymodbus.open_modbus_rtu(path, baudrate=SETTINGS.baudrate, parity="none", config=config)

    async def read(self, unit: int, register: int) -> int:
        reply = await self._ask(self._bus.slave(unit).read_holding_registers(register, count=1))
        return int(reply[0])

    async def write(self, unit: int, register: int, value: int) -> None:
        await self._ask(self._bus.slave(unit).write_register(register, value))

    async def _ask(self, call: Awaitable[T]) -> T:
        try:
            return await call
        except import_module("anymodbus.exceptions").ModbusError as error:
            raise Failed from error

    async def close(self) -> None:
        await self._bus.aclose()


PEERS: dict[str, list[Callable[[], ModbusMaster]]] = {
    "pymodbus": [Pymodbus],
    "minimalmodbus": [Minimalmodbus],
    "tmodbus": [Tmodbus],
    "anymodbus": [lambda: Anymodbus(late=False), lambda: Anymodbus(late=True)],
}
IN_A_HURRY = 2
"""How many packages a quick run compares."""


def masters(options: Options) -> list[Callable[[], ModbusMaster]]:
    """Ours first, then those that are installed."""
    present = [makers for package, makers in PEERS.items() if installed(package)]
    return [Busmaster, *(maker for makers in options.pick(present, present[:IN_A_HURRY]) for maker in makers)]


def notes(options: Options) -> list[str]:
    """What was compared with what settings, and what was not there to be compared."""
    said = []
    for maker in masters(options):
        master = maker()
        package = master.name.partition(",")[0]
        version = "" if package == "busmaster" else f" {metadata.version(package)}"
        said.append(f"{package}{version}{master.name.removeprefix(package)}: {master.settings}")
    missing = [package for package in PEERS if not installed(package)]
    if missing:
        said.append(f"not installed: {', '.join(missing)} (tmodbus needs Python 3.12, anymodbus 3.13)")
    return said

"""The emulated Modbus line, served on a pty or by TCP from a process of its own, with its faults set from here.

`python -m benchmarks.served_line` is told what to serve in a line of JSON, and prints the path. Each further line there
is an order: {"unit": 3, "dead": true} takes a unit off the line, {"log": true} asks for what passed on the line since
the last time: (seconds, "host" or "line", bytes, seconds taken), {"faults": {"lost": 0.01}} sets the faults of frames.
"""

from __future__ import annotations

import json
import random
import sys
from collections.abc import Mapping
from functools import partial
from types import TracebackType
from typing import Any

from benchmarks.apart import Apart
from busmaster import LineSettings
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.emulator.serve import PtyServer, TcpServer
from busmaster.protocols.modbus.device import EmulatedModbus

SETTINGS = LineSettings(57600)
"""8N1 and not Modbus's 8E1: a pty refuses parity, and some masters take that for an error."""
REGISTERS = 100
LONGEST_LOG = 100_000


def value_of(unit: int, register: int) -> int:
    """What a register holds: a value that says whose it is."""
    return unit * 256 + register


def emulated_units(count: int, delay: Mapping[str, Any]) -> list[EmulatedModbus]:
    """Units 1 to `count`, whose registers hold `value_of` them."""
    registers = range(REGISTERS)
    return [
        EmulatedModbus(unit, [value_of(unit, register) for register in registers], delay=delay_of(delay))
        for unit in range(1, count + 1)
    ]


class LoggedLine(Line):
    """Keeps what passes: when it began, whose it was, how many bytes, how long it took."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.log: list[tuple[float, str, int, float]] = []

    def send(self, data: bytes, now: float) -> None:
        self._note(now, "host", len(data))
        super().send(data, now)

    def receive(self, now: float) -> bytes:
        data = super().receive(now)
        if data:
            self._note(now - len(data) * self.tau, "line", len(data))
        return data

    def _note(self, start: float, who: str, length: int) -> None:
        if len(self.log) < LONGEST_LOG:
            self.log.append((start, who, length, length * self.tau))


class ServedLine:
    """Units 1 to `units` on a paced line of 57600 baud, behind a serial server if `tcp`. Use it in `with`; `path` is
    the port."""

    def __init__(self, units: int, *, delay: dict[str, Any] | None = None, seed: int = 1, tcp: bool = False) -> None:
        self._order = {"units": units, "delay": delay or {}, "seed": seed, "tcp": tcp}
        self.path = ""
        self._server: Apart

    def __enter__(self) -> ServedLine:
        self._server = Apart("benchmarks.served_line", paced=True)
        self.path = self._server.ask(self._order)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._server.close()

    def kill(self, unit: int, dead: bool = True) -> None:
        """Take a unit off the line, or bring it back."""
        self._server.ask({"unit": unit, "dead": dead})

    def spoil(self, **faults: float) -> None:
        """Have these faults strike each frame from now on: shares of them."""
        self._server.ask({"faults": faults})

    def log(self) -> list[tuple[float, str, int, float]]:
        """What passed since the last time."""
        return [(start, who, length, taken) for start, who, length, taken in self._server.ask({"log": True})]


def _obey(order: dict[str, Any], line: Line, now: float) -> Any:
    assert isinstance(line, LoggedLine)
    if "unit" in order:
        unit = line.device(order["unit"])
        if order["dead"]:
            line.cut(now, unit)
        else:
            line.restore(now)
    for name, share in order.get("faults", {}).items():
        setattr(line.faults, name, share)
    if "log" in order:
        log, line.log = line.log, []
        return log
    return True


def delay_of(options: Mapping[str, Any]) -> Delay:
    """From its parameters, as JSON has them."""
    late_reply_delay = options.get("late_reply_delay")
    return Delay(**{**options, "late_reply_delay": tuple(late_reply_delay)}) if late_reply_delay else Delay(**options)


def main() -> None:
    order = json.loads(sys.stdin.readline())
    line = LoggedLine(SETTINGS, emulated_units(order["units"], order["delay"]), chance=random.Random(order["seed"]))
    with TcpServer(line) if order["tcp"] else PtyServer(line) as server:
        print(json.dumps(server.path), flush=True)
        for said in sys.stdin:
            wish = json.loads(said)
            answer = server.call(partial(_obey, wish))
            print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()

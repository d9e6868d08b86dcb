"""The line of a file, emulated: every node that it names, with the reply delays and faults of its `[emulator]`."""

from __future__ import annotations

import random
from dataclasses import replace

from busmaster.config.sections import LineFile
from busmaster.contract.profile import LineSettings
from busmaster.emulator.device import Device
from busmaster.emulator.line import Echo, Line
from busmaster.registry import make_device
from busmaster.transport.serial_port import SerialPort


def emulated_line(file: LineFile, *, paced: bool | None = None, seed: int | None = None) -> Line:
    """Not yet served: `serve_pty`, `serve_tcp` or a MemoryPort puts it to use. `paced` and `seed` go before its own."""
    emulator = file.emulator
    return Line(
        line_settings(file),
        [_device(file, name) for name in file.nodes],
        chance=random.Random(emulator.seed if seed is None else seed),
        paced=emulator.paced if paced is None else paced,
        echo=Echo() if file.port.echo else None,
    )


def line_settings(file: LineFile) -> LineSettings:
    """Those of a serial port; behind a TCP port those of the first node's protocol, at the port's baud rate."""
    if isinstance(file.port, SerialPort):
        return file.port.settings
    own = next(iter(file.nodes.values())).profile.line
    return replace(own, baudrate=file.port.baudrate or own.baudrate)


def _device(file: LineFile, name: str) -> Device:
    node, emulator = file.nodes[name], file.emulator
    device = make_device(node.protocol, node.address, delay=emulator.delays[name], lively=emulator.lively)
    device.faults = emulator.faults[name]
    return device

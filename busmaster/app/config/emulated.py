"""The emulated line of a file: every node in it, with the settings of the node and of `[emulator]`."""

from __future__ import annotations

import random
from dataclasses import replace

from busmaster import InvalidCommand, LineSettings, Rfc2217Port, SerialPort, ext
from busmaster.app.config.names import expanded
from busmaster.app.config.point_section import PointSection
from busmaster.app.config.points import Scale
from busmaster.app.config.sections import LineFile, NodeSection, decimals_of
from busmaster.app.config.source import FileError
from busmaster.emulator import Device, Echo, Line
from busmaster.ext import guess, make_device


def emulated_line(file: LineFile, *, paced: bool | None = None, seed: int | None = None) -> Line:
    """Make the line, not yet served: `serve_pty`, `serve_tcp` or a MemoryPort puts it to use.

    `paced` and `seed` go before the file's own. Raises FileError, naming line and key, for an option or a value that
    an emulated device cannot have.
    """
    emulator = file.emulator
    return Line(
        line_settings(file),
        [_device(file, name) for name in file.nodes],
        chance=random.Random(emulator.seed if seed is None else seed),
        paced=emulator.paced if paced is None else paced,
        echo=Echo() if file.port.echo else None,
    )


def line_settings(file: LineFile) -> LineSettings:
    """Return the settings of the serial port, of this machine or of an RFC 2217 server.

    Behind a port of raw TCP they are those of the first node's protocol, at the port's baud rate.
    """
    if isinstance(file.port, SerialPort | Rfc2217Port):
        return file.port.settings
    own = next(iter(file.nodes.values())).profile.line
    return replace(own, baudrate=file.port.baudrate or own.baudrate)


def _device(file: LineFile, name: str) -> Device:
    node, section = file.nodes[name], file.emulator.nodes[name]
    emulated = {option.name for option in node.kind.emulated}
    # an option of the node and of its device are the same
    options = {key: value for key, value in node.options.items() if key in emulated} | dict(section.options)
    with (section.table or node.table).at():
        device = make_device(node.protocol, node.address, delay=section.reply_delay, lively=section.lively, **options)
    device.faults = section.faults
    for key, (table, values) in section.values.items():
        with table.at(key):
            _hold(device, node, key, values)
    return device


def _hold(device: Device, node: NodeSection, key: str, values: tuple[float, ...]) -> None:
    """Have the device hold values of what the file calls so, as `busmaster run` will show them."""
    named = {name: number for number, name in ext.names_of_items(node.kind.handle).items()}
    named |= {name: str(address) for name, address in node.options.get("symbols", {}).items()}
    known = {*node.points, *named}
    for name in expanded(key, known):
        point = node.points.get(name)
        item = name if point is None else point.item
        base, colon, rest = item.partition(":")
        try:
            sent = map(_scale(node, point, item).write, values)
            device.preset(f"{named.get(base, base)}{colon}{rest}", *sent)
        except FileError:
            raise
        except InvalidCommand as error:
            raise InvalidCommand(f"{error}{'' if name in known else guess(name, known)}") from None


def _scale(node: NodeSection, point: PointSection | None, item: str) -> Scale:
    """Return what a number on the line means to the file."""
    whole = node.kind.whole_numbers(item)
    decimals = 0 if point is None else point.decimals
    if node.kind.takes_decimals:
        decimals = decimals_of(node).get(item.partition(":")[0], node.kind.decimals(item)) if whole else 0
    factor, offset = (1.0, 0.0) if point is None else (point.factor, point.offset)
    return Scale.of(factor, offset, decimals, whole)

"""All that a LINE.toml may say, table by table, as its readers declare it: what the reference is written from."""

from __future__ import annotations

import ast
import inspect
import math
import textwrap
from collections.abc import Iterable, Iterator
from itertools import pairwise

from busmaster import Meaning, Rfc2217Port, SerialPort, TcpPort
from busmaster.app.config import emulator, safe, sections, service, templates, timing
from busmaster.app.config.keys import REQUIRED, Key, TableKeys, keys_of
from busmaster.app.config.point_section import NOT_SAID, PointSection
from busmaster.app.outputs.kinds import kinds as output_kinds
from busmaster.emulator import CALM, NAMES, SECONDS, Faults
from busmaster.ext import MOST_DIGITS
from busmaster.registry import Option, kinds

LATENCY = "How long the adapter or the serial server may hold bytes back: FTDI's latency timer, say."
ECHO = "Whether what is sent is heard too, as on some two-wire adapters. It is compared byte for byte."
SERIAL = {
    "path": "The device, a link to it, or `usb:SERIAL`.",
    "baudrate": "The protocol's by default, where all nodes are meant for one.",
    "bytesize": "Bits of a byte. The protocol's by default.",
    "parity": "N, E, O, M or S. The protocol's by default.",
    "stopbits": "1, 1.5 or 2. The protocol's by default.",
    "rtscts": "Whether RTS and CTS hold up what is sent.",
    "rs485": "Whether the driver is to switch the transmitter.",
    "echo": ECHO,
    "low_latency": "Sets or clears the driver's flag of that name. Left alone by default.",
    "receive_latency": LATENCY,
    "exclusive": "Whether no other program may open the port meanwhile.",
    "paced": "Whether bytes leave at the baud rate. By default so for a serial device, and not for a pseudo-terminal.",
}
TCP = {
    "host": "The name or address of the serial server.",
    "port": "Its TCP port, on which it passes raw bytes.",
    "baudrate": "The baud rate behind it: reply windows run from the end of the request there.",
    "receive_latency": LATENCY,
    "echo": ECHO,
    "paced": "Whether what comes is no quicker than the baud rate allows.",
}
RFC2217 = SERIAL | {
    "host": TCP["host"],
    "port": "Its TCP port, on which it takes line settings by RFC 2217.",
    "rtscts": "Whether RTS and CTS of the remote port hold up what is sent.",
    "dtr": "Sets (true) or clears (false) the line DTR of the remote port. Left to the server by default.",
    "rts": "The same for RTS.",
    "paced": TCP["paced"],
}
WITH_RFC2217 = Key("rfc2217", "flag", "Whether the server takes the line settings by RFC 2217.", "false")
POINT = {
    "item": "The ITEM that it is, as on the command line. The point's own name by default.",
    "unit": "The unit of its value: a name, which nothing is calculated with.",
    "factor": "value = number on the line x factor + offset.",
    "offset": "See `factor`.",
    "decimals": "How many of the number's last digits are decimals, where the line carries no point.",
    "minimum": "The least that may be written, in its unit, by whatever name and whoever writes.",
    "maximum": "The most that may be written, likewise.",
    "max_step": "How far a write may be from the last value that was confirmed; more than 0.",
    "writable": "Whether it may be written at all.",
    "read_after_write": "Whether a polled point is read as soon as a write to it is confirmed, ahead of its next poll.",
    "precision": "Digits behind the point that people are shown. Nothing else is rounded.",
    "bits": "Names of the word's bits, 0 the lowest, each a point of its own: `bits = { READY = 0, FAULT = 3 }`.",
    "labels": 'Names of whole numbers: `labels = { 0 = "off", 1 = "run" }`.',
    "deadband": "Outputs are told a value only where it is further than this from what they were told; 0: each change.",
    "heartbeat": "Outputs are told a value at the latest after so long, which is more than 0.",
    "low": "A value below it begins an alarm.",
    "high": "A value above it begins an alarm.",
    "hysteresis": "How far a value must be back for its alarm to end. By default a hundredth of what is between `low` "
    "and `high`, or of the one that there is.",
    "alarm_if_set": 'Bits that begin an alarm while they are 1, by their names in `bits`: `alarm_if_set = ["FAULT"]`.',
    "alarm_if_clear": "Bits that begin an alarm while they are 0, likewise.",
}
OUTPUTS = {
    "enabled": "Whether it is used. What is said of one that is not must be right, too.",
    "groups": "The poll groups whose values it gets. All by default; of metrics none.",
    "buffer": "Values that may wait for it; the oldest are dropped, and counted.",
    "mode": "Who may read and write the files that it makes, as chmod takes it, narrowed by the umask.",
    "spill": "The file for what waits while the output is down, and over a restart. Best on another disk.",
    "spill_values": "The most values that wait in that file.",
    "sync_every": "After so long at most what was written survives a loss of power, too; 0: after each batch.",
    "audit": "`strict`: a write is acknowledged to its client only after its audit entry is on the disk.",
    "keep_days": "What is older is deleted. More than 0; all is kept by default.",
    "keep_mb": "The oldest is deleted where the database is larger. More than 0; all is kept by default.",
    "host": "The broker; of metrics, where they are served.",
    "port": "The TCP port there.",
    "prefix": "What all topics begin with.",
    "messages": "One message for each point, or one for each cycle of a group.",
    "qos": "0: values may be lost unseen; 1: they are not.",
    "retain": "Whether the broker keeps the last value of each point.",
    "username": "The user to be at the broker.",
    "password_file": "The file with that user's password.",
    "tls": "Whether the connection is encrypted.",
    "ca_file": "The certificates that are trusted; the system's by default.",
    "allow_commands": "The points that messages may write. None by default, and then no command is listened to.",
}
PATHS = {
    "csv": "The file. Fields of a date make new ones: `line-%Y-%m-%d.csv`.",
    "jsonl": "The file. Fields of a date make new ones: `line-%Y-%m-%d.jsonl`.",
    "sqlite": "The database.",
}


def tables() -> Iterator[TableKeys]:
    """Yield every table of a file, in the order of the reference."""
    yield TableKeys("The top", "What stands at the top of the file, before the first table.", sections.KEYS)
    bounds = {"receive_latency": {"kind": "seconds", "unit": "s", "least": 0}}
    framing: dict[str, dict[str, object]] = {name: {"default": ""} for name in ("parity", "stopbits")}
    framing |= {"baudrate": {"default": "", "least": 1}, "bytesize": {"default": "", "least": 5, "most": 8}}
    serial = keys_of(SerialPort, SERIAL, rs485={"kind": "flag"}, **framing, **bounds)
    yield TableKeys("[port]", "A serial port as a table.", serial)
    tcp = keys_of(TcpPort, TCP, port={"least": 1, "most": 65535}, baudrate={"least": 1}, **bounds)
    yield TableKeys("[port] with host", "A serial server as a table.", (*tcp, WITH_RFC2217))
    remote = keys_of(Rfc2217Port, RFC2217, port={"least": 1, "most": 65535}, **framing, **bounds)
    about = "A serial server whose line settings are set from here."
    yield TableKeys("[port] with rfc2217 = true", about, remote)
    common = "What holds for all nodes of one protocol that do not say otherwise. Its options may stand here too."
    yield TableKeys("[protocols.NAME]", common, sections.SHARED_KEYS)
    yield TableKeys("[nodes.NAME]", "A node; several where NAME is a range, as drive4-7.", sections.NODE_KEYS)
    for kind in kinds().values():
        if kind.options:
            yield TableKeys(
                f"[nodes.NAME] of {kind.name}", f"What only nodes of {kind.name} have.", own_keys(kind.options)
            )
    yield TableKeys("timing = {}", "Reply times, from the last byte of a request on the wire.", timing.KEYS)
    yield TableKeys("[nodes.NAME.points]", "Each key is a point, and its value a table of these.", point_keys())
    yield TableKeys("[groups.NAME]", "A poll group: what is read together, on a fixed grid.", sections.GROUP_KEYS)
    yield from _outputs()
    yield TableKeys("[safe]", "What is written, urgently, when the line is left.", safe.KEYS)
    yield TableKeys("[service]", "Who may use the line beside its owner, and how they come.", service.KEYS)
    yield TableKeys(
        "[service.users.NAME]", "A role; so too [service.groups.NAME], [service.tokens.NAME].", service.ROLE_KEYS
    )
    yield from _emulator()
    yield TableKeys("A template", "A file of its own, which `template` names.", templates.KEYS)


def point_keys() -> tuple[Key, ...]:
    """Return what may be said of a point."""
    digits = {"kind": "whole", "least": 0, "most": MOST_DIGITS}
    named = {"kind": "table", "least": -math.inf}
    seconds = {"kind": "seconds", "unit": "s"}
    own = keys_of(PointSection, POINT, without=NOT_SAID, item={"default": ""})
    meaning = keys_of(
        Meaning, POINT, precision=digits, bits=named, labels=named, deadband={"least": 0}, heartbeat=seconds
    )
    return own + meaning


def _outputs() -> Iterator[TableKeys]:
    enabled = Key("enabled", "flag", OUTPUTS["enabled"], "true")
    mode = {"mode": {"kind": "mode", "default": '"0640"', "least": -math.inf}}
    changes = {"sync_every": {"unit": "s"}, "keep_days": {"unit": "days"}, "keep_mb": {"unit": "MB"}}
    for kind in output_kinds():
        about = OUTPUTS | {"path": PATHS.get(kind.name, "")}
        keys = keys_of(kind.settings, about, without=kind.without, **mode, **changes)
        keys = tuple(sorted(keys, key=lambda key: key.default != REQUIRED))  # what must be there first
        yield TableKeys(f"[outputs.{kind.name}]", kind.about, (enabled, *keys))


def _emulator() -> Iterator[TableKeys]:
    yield TableKeys("[emulator]", "How the line is emulated.", emulator.KEYS)
    every = "What differs for one node, or a range of them. What its kind has beside it follows."
    yield TableKeys("[emulator.nodes.NAME]", every, emulator.NODE_KEYS)
    for kind in kinds().values():
        if kind.emulated:
            about = f"What only emulated nodes of {kind.name} have."
            yield TableKeys(f"[emulator.nodes.NAME] of {kind.name}", about, own_keys(kind.emulated))
    yield TableKeys("faults = {}", "The probability of each that it strikes a frame; 0 by default.", tuple(_faults()))


def _faults() -> Iterator[Key]:
    about = attribute_docs(Faults)
    for name in NAMES:
        if name in SECONDS:
            yield Key(name, "seconds", about[name], f"{getattr(CALM, name):g}", "s", least=0)
        else:
            yield Key(name, "number", about[name], "0", least=0, most=1)


def own_keys(options: Iterable[Option]) -> tuple[Key, ...]:
    """Return options of a kind of node as keys; those of tables as `parameters.NAME.low`."""
    return tuple(key for option in options for key in _own_keys(option))


def _own_keys(option: Option, before: str = "") -> Iterator[Key]:
    name, about = before + option.name, option.about or f"{option.help[:1].upper()}{option.help[1:]}."
    match option.kind:
        case "whole":
            yield Key(name, "whole", about, least=1)
        case "positive":
            yield Key(name, "number", f"{about} More than 0.")
        case "share":
            yield Key(name, "number", about, least=0, most=1)
        case "delay":
            yield Key(name, "delay", about, unit="s")
        case "numbers":
            yield Key(name, "wholes", about)
        case "addresses" | "tables":
            yield Key(name, "table", about)
        case "flag":
            yield Key(name, "flag", about)
        case _:
            yield Key(name, option.kind, about, choices=option.choices)
    for field in option.fields:
        yield from _own_keys(field, f"{name}.NAME.")


def attribute_docs(kind: type) -> dict[str, str]:
    """Return what is written under each attribute of a class, by its name."""
    [definition] = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(definition, ast.ClassDef)
    docs = {}
    for statement, text in pairwise(definition.body):
        match statement, text:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(about))):
                docs[name] = about
    return docs

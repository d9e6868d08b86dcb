"""From a request that was heard to the command that would send it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from busmaster.capture.frames import Frame, Kind
from busmaster.errors import InvalidCommand
from busmaster.exchange import Command
from busmaster.profile import Profile
from busmaster.protocols import dc104, hcp, hcp2, mentor, msc

PROFILES: Mapping[str, Profile] = {
    "hcp": hcp.PROFILE,
    "hcp2": hcp2.PROFILE,
    "microflex": hcp2.PROFILE,
    "msc": msc.PROFILE,
    "mentor": mentor.PROFILE,
    "dc104": dc104.PROFILE,
}
SHORT_COMMANDS = {"again": 0, "next": 1, "previous": -1}
"""Mentor II's, with the step each takes."""


def command_of(protocol: str, frame: Frame, shorts: Sequence[str] = ()) -> Command[Any]:
    """The command that a request speaks. `shorts` are the Mentor II short commands that directly follow it.

    Raises InvalidCommand for a request that no command of ours would send.
    """
    if frame.fault:
        raise InvalidCommand(f"{frame.text}: {frame.fault}")
    try:
        return _BUILDERS[protocol](frame, shorts)
    except InvalidCommand:
        raise
    except (KeyError, ValueError) as error:
        raise InvalidCommand(f"no command of ours: {frame.text}") from error


def _comms(read: type[hcp.Read | hcp2.Read], write: type[hcp.Write | hcp2.Write]) -> Callable[..., Command[Any]]:
    def build(frame: Frame, _: Sequence[str]) -> Command[Any]:
        if frame.kind is Kind.READ:
            return read(int(frame.item))
        return write(int(frame.item), tuple(float(value) for value in frame.value.split(",")))

    return build


def _mentor(frame: Frame, shorts: Sequence[str]) -> Command[Any]:
    menu, number = mentor.parse_parameter(frame.item)
    if frame.kind is Kind.READ:
        steps = [SHORT_COMMANDS[short] for short in shorts]
        if not steps or len(set(steps)) > 1:
            return mentor.Read(menu, number)
        return mentor.ReadRun(menu, number, 1 + len(steps), steps[0])
    text = frame.value
    signed = text[:1] in ("+", "-")
    value = bool(int(text)) if len(text) == 1 else int(text)
    return mentor.Write(menu, number, value, wide=not signed and len(text) == 5, high_resolution=len(text) == 6)


def _msc(frame: Frame, _: Sequence[str]) -> Command[Any]:
    where = int("".join(filter(str.isdigit, frame.item.partition(":")[2 if "flag:" in frame.item else 0])) or 0)
    values = [int(value) for value in frame.value.split(",")] if frame.value else []
    commands: Mapping[str, Callable[[], Command[Any]]] = {
        "DREAD": lambda: msc.DataRead(where),
        "DWRITE": lambda: msc.DataWrite(where, *values),
        "BREAD": lambda: msc.BlockRead(where),
        "BWRITE": lambda: msc.BlockWrite(where, tuple(values)),
        "SFLAG": lambda: msc.SetFlag(where),
        "CFLAG": lambda: msc.ClearFlag(where),
        "RFLAG": lambda: msc.ReadFlag(where),
        "RFLAGS": msc.ReadFlags,
        "RQSTAT": msc.ReadStatus,
    }
    return commands[frame.command]()


def _dc104(frame: Frame, _: Sequence[str]) -> Command[Any]:
    if frame.kind is Kind.READ:
        return dc104.Read(int(frame.item), minimum=0)
    return dc104.Write(int(frame.item), int(frame.value), minimum=0)


_BUILDERS: Mapping[str, Callable[[Frame, Sequence[str]], Command[Any]]] = {
    "hcp": _comms(hcp.Read, hcp.Write),
    "hcp2": _comms(hcp2.Read, hcp2.Write),
    "microflex": _comms(hcp2.Read, hcp2.Write),
    "msc": _msc,
    "mentor": _mentor,
    "dc104": _dc104,
}

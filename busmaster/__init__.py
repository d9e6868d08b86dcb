"""busmaster: an asyncio master for drives and motion controllers that share one serial line."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from busmaster.arbiter.counters import LineState
from busmaster.arbiter.health import Health
from busmaster.arbiter.transaction import Priority
from busmaster.bus.bus import Bus
from busmaster.bus.bus_like import BusLike
from busmaster.bus.meaning import Meaning
from busmaster.bus.node import Node
from busmaster.bus.points import Point
from busmaster.bus.polling import PollGroup, Quality, Sample, Snapshot
from busmaster.contract.learning import LEARNED
from busmaster.contract.profile import LineSettings
from busmaster.contract.renames import ROOT
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import (
    BacklogFull,
    BusClosed,
    BusError,
    GarbledReply,
    HoldEnded,
    InvalidCommand,
    LineDown,
    LineNoisy,
    NodeDown,
    NoReply,
    NoSuchParameter,
    NotStarted,
    Refused,
    Superseded,
    VerifyFailed,
    WriteUnconfirmed,
)
from busmaster.transport.endpoints import Endpoint, endpoint
from busmaster.transport.rs485 import Rs485
from busmaster.transport.serial_port import SerialPort
from busmaster.transport.tcp import TcpPort

if TYPE_CHECKING:
    from busmaster.app.line.configured_line import open_line
    from busmaster.app.service.remote import RemoteBus, connect
    from busmaster.app.service.service import Service
    from busmaster.emulator.memory import MemoryPort
    from busmaster.protocols.ct_ansi.handle import CtAnsiDrive
    from busmaster.protocols.dc104.handle import Dc104Drive
    from busmaster.protocols.hcp.handle import HcpController
    from busmaster.protocols.hcp2.handle import Hcp2Controller
    from busmaster.protocols.hcp2.microflex_handle import MicroFlexDrive
    from busmaster.protocols.mentor.handle import MentorDrive
    from busmaster.protocols.modbus.handle import ModbusUnit
    from busmaster.protocols.msc.handle import MscController
    from busmaster.transport.rfc2217 import Rfc2217Port

__all__ = [
    "LEARNED",
    "BacklogFull",
    "Bus",
    "BusClosed",
    "BusError",
    "BusLike",
    "CtAnsiDrive",
    "Dc104Drive",
    "Endpoint",
    "GarbledReply",
    "Hcp2Controller",
    "HcpController",
    "Health",
    "HoldEnded",
    "InvalidCommand",
    "LineDown",
    "LineNoisy",
    "LineSettings",
    "LineState",
    "Meaning",
    "MemoryPort",
    "MentorDrive",
    "MicroFlexDrive",
    "ModbusUnit",
    "MscController",
    "NoReply",
    "NoSuchParameter",
    "Node",
    "NodeDown",
    "NotStarted",
    "Point",
    "PollGroup",
    "Priority",
    "Quality",
    "Refused",
    "RemoteBus",
    "ReplyTiming",
    "Rfc2217Port",
    "Rs485",
    "Sample",
    "SerialPort",
    "Service",
    "Snapshot",
    "Superseded",
    "TcpPort",
    "Timings",
    "VerifyFailed",
    "WriteUnconfirmed",
    "connect",
    "endpoint",
    "open_line",
]


ON_DEMAND = {
    "CtAnsiDrive": "busmaster.protocols.ct_ansi.handle",
    "Dc104Drive": "busmaster.protocols.dc104.handle",
    "Hcp2Controller": "busmaster.protocols.hcp2.handle",
    "HcpController": "busmaster.protocols.hcp.handle",
    "MemoryPort": "busmaster.emulator.memory",
    "MentorDrive": "busmaster.protocols.mentor.handle",
    "MicroFlexDrive": "busmaster.protocols.hcp2.microflex_handle",
    "ModbusUnit": "busmaster.protocols.modbus.handle",
    "MscController": "busmaster.protocols.msc.handle",
    "RemoteBus": "busmaster.app.service.remote",
    "Rfc2217Port": "busmaster.transport.rfc2217",
    "Service": "busmaster.app.service.service",
    "connect": "busmaster.app.service.remote",
    "open_line": "busmaster.app.line.configured_line",
}
"""Public names that a bus alone does not need, and the modules that are imported when one of them is used."""


def __dir__() -> list[str]:
    """List the public names, including those imported on first use."""
    return [*__all__, *(name for name in globals() if name.startswith("__"))]


def __getattr__(name: str) -> object:
    """Import a name on first use, so that a program imports only the protocols that it uses."""
    if name in ON_DEMAND:
        return getattr(import_module(ON_DEMAND[name]), name)
    if name in ROOT:  # an AttributeError's text would not be shown for `from busmaster import ...`
        where, new = ROOT[name]
        raise ImportError(f"busmaster.{name} has moved: from {where} import {new}", name=__name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

"""busmaster: an asyncio master for drives and motion controllers that share one serial line."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from busmaster.arbiter.counters import DriverErrors, LineStatistics, NodeStatistics, Quantiles
from busmaster.arbiter.events import (
    LatenessLowered,
    LatenessRaised,
    LineChange,
    LineChanged,
    NodeChanged,
    PortFailed,
    RepliesLate,
)
from busmaster.arbiter.health import Health
from busmaster.arbiter.learned import LearnedTimes
from busmaster.arbiter.state import LineState
from busmaster.arbiter.transaction import Priority, Timeline
from busmaster.bus.alarms import AlarmChanged
from busmaster.bus.bus import Bus
from busmaster.bus.meaning import Meaning
from busmaster.bus.node import Node
from busmaster.bus.points import Point
from busmaster.bus.polling import GroupStatistics, PollGroup, Quality, Sample, Snapshot, Stream
from busmaster.bus.requester import Requester, RequestOptions
from busmaster.contract.learning import LEARNED, Learned
from busmaster.contract.profile import LineSettings, Profile
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
from busmaster.planning import GroupPlan, Plan, PlannedGroup, PlannedNode
from busmaster.transport.endpoints import Endpoint, endpoint
from busmaster.transport.serial_port import SerialPort
from busmaster.transport.tcp import TcpPort

if TYPE_CHECKING:
    from busmaster.config.line import open_line
    from busmaster.emulator.memory import MemoryPort
    from busmaster.protocols.ct_ansi.handle import CtAnsiDrive
    from busmaster.protocols.dc104.handle import Dc104Drive
    from busmaster.protocols.hcp.handle import HcpController
    from busmaster.protocols.hcp2.handle import Hcp2Controller
    from busmaster.protocols.hcp2.microflex import CommandWord, StatusWord
    from busmaster.protocols.hcp2.microflex_handle import MicroFlexDrive
    from busmaster.protocols.mentor.handle import MentorDrive
    from busmaster.protocols.modbus.handle import ModbusUnit
    from busmaster.protocols.msc.handle import MscController
    from busmaster.protocols.msc.status import ProgramStatus
    from busmaster.service.remote import RemoteBus, connect
    from busmaster.service.service import Service

__all__ = [
    "LEARNED",
    "AlarmChanged",
    "BacklogFull",
    "Bus",
    "BusClosed",
    "BusError",
    "CommandWord",
    "CtAnsiDrive",
    "Dc104Drive",
    "DriverErrors",
    "Endpoint",
    "GarbledReply",
    "GroupPlan",
    "GroupStatistics",
    "Hcp2Controller",
    "HcpController",
    "Health",
    "HoldEnded",
    "InvalidCommand",
    "LatenessLowered",
    "LatenessRaised",
    "Learned",
    "LearnedTimes",
    "LineChange",
    "LineChanged",
    "LineDown",
    "LineNoisy",
    "LineSettings",
    "LineState",
    "LineStatistics",
    "Meaning",
    "MemoryPort",
    "MentorDrive",
    "MicroFlexDrive",
    "ModbusUnit",
    "MscController",
    "NoReply",
    "NoSuchParameter",
    "Node",
    "NodeChanged",
    "NodeDown",
    "NodeStatistics",
    "NotStarted",
    "Plan",
    "PlannedGroup",
    "PlannedNode",
    "Point",
    "PollGroup",
    "PortFailed",
    "Priority",
    "Profile",
    "ProgramStatus",
    "Quality",
    "Quantiles",
    "Refused",
    "RemoteBus",
    "RepliesLate",
    "ReplyTiming",
    "RequestOptions",
    "Requester",
    "Sample",
    "SerialPort",
    "Service",
    "Snapshot",
    "StatusWord",
    "Stream",
    "Superseded",
    "TcpPort",
    "Timeline",
    "Timings",
    "VerifyFailed",
    "WriteUnconfirmed",
    "connect",
    "endpoint",
    "open_line",
]


ON_DEMAND = {
    "CommandWord": "busmaster.protocols.hcp2.microflex",
    "CtAnsiDrive": "busmaster.protocols.ct_ansi.handle",
    "Dc104Drive": "busmaster.protocols.dc104.handle",
    "Hcp2Controller": "busmaster.protocols.hcp2.handle",
    "HcpController": "busmaster.protocols.hcp.handle",
    "MemoryPort": "busmaster.emulator.memory",
    "MentorDrive": "busmaster.protocols.mentor.handle",
    "MicroFlexDrive": "busmaster.protocols.hcp2.microflex_handle",
    "ModbusUnit": "busmaster.protocols.modbus.handle",
    "MscController": "busmaster.protocols.msc.handle",
    "ProgramStatus": "busmaster.protocols.msc.status",
    "RemoteBus": "busmaster.service.remote",
    "Service": "busmaster.service.service",
    "StatusWord": "busmaster.protocols.hcp2.microflex",
    "connect": "busmaster.service.remote",
    "open_line": "busmaster.config.line",
}
"""Public names that a bus alone does not need, and the modules which are imported when these are asked for."""


def __getattr__(name: str) -> object:
    """Import what a bus alone does not need when it is asked for: who uses one protocol pays for one."""
    if name not in ON_DEMAND:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(ON_DEMAND[name]), name)

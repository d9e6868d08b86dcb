"""busmaster: an asyncio master for drives and motion controllers that share one serial line."""

from __future__ import annotations

from typing import TYPE_CHECKING

from busmaster.arbiter.counters import DriverErrors, LineStatistics, NodeStatistics, Quantiles
from busmaster.arbiter.events import LatenessLowered, LatenessRaised, LineChange, LineChanged, NodeChanged, PortFailed
from busmaster.arbiter.health import Health
from busmaster.arbiter.state import LineState
from busmaster.arbiter.transaction import Priority, Timeline
from busmaster.bus import Bus
from busmaster.errors import (
    BacklogFull,
    BusClosed,
    BusError,
    GarbledReply,
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
from busmaster.exchange import ReplyTiming, Timings
from busmaster.node import Node
from busmaster.planning import GroupPlan, Plan, PlannedGroup, PlannedNode
from busmaster.points import Point
from busmaster.polling import GroupStatistics, PollGroup, Quality, Sample, Snapshot, Stream
from busmaster.profile import LineSettings, Profile
from busmaster.protocols.ct_ansi.handle import CtAnsiDrive
from busmaster.protocols.dc104.handle import Dc104Drive
from busmaster.protocols.hcp.handle import HcpController
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.protocols.hcp2.microflex import CommandWord, StatusWord
from busmaster.protocols.hcp2.microflex_handle import MicroFlexDrive
from busmaster.protocols.mentor.handle import MentorDrive
from busmaster.protocols.modbus.handle import ModbusUnit
from busmaster.protocols.msc.codec import ProgramStatus
from busmaster.protocols.msc.handle import MscController
from busmaster.transport.endpoints import Endpoint, endpoint
from busmaster.transport.memory import MemoryPort
from busmaster.transport.serial_port import SerialPort
from busmaster.transport.tcp import TcpPort

if TYPE_CHECKING:
    from busmaster.config.line import open_line

__all__ = [
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
    "InvalidCommand",
    "LatenessLowered",
    "LatenessRaised",
    "LineChange",
    "LineChanged",
    "LineDown",
    "LineNoisy",
    "LineSettings",
    "LineState",
    "LineStatistics",
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
    "ReplyTiming",
    "Sample",
    "SerialPort",
    "Snapshot",
    "StatusWord",
    "Stream",
    "Superseded",
    "TcpPort",
    "Timeline",
    "Timings",
    "VerifyFailed",
    "WriteUnconfirmed",
    "endpoint",
    "open_line",
]


def __getattr__(name: str) -> object:
    """What needs more than a bus is imported when it is asked for."""
    if name != "open_line":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from busmaster.config.line import open_line

    return open_line

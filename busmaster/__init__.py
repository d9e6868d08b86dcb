"""busmaster: an asyncio master for drives and motion controllers that share one serial line."""

from __future__ import annotations

from busmaster.arbiter.counters import LineStatistics, NodeStatistics, Quantiles
from busmaster.arbiter.events import LatenessRaised, LineChange, LineChanged, LineState, NodeChanged
from busmaster.arbiter.health import Health
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
from busmaster.handles import (
    Dc104Drive,
    Hcp2Controller,
    HcpController,
    MentorDrive,
    MicroFlexDrive,
    MscController,
)
from busmaster.node import Node
from busmaster.points import Point
from busmaster.polling import GroupStatistics, PollGroup, Quality, Sample, Snapshot, Stream
from busmaster.profile import LineSettings, Profile
from busmaster.protocols.microflex import CommandWord, StatusWord
from busmaster.protocols.msc import ProgramStatus
from busmaster.transport.endpoints import Endpoint, endpoint
from busmaster.transport.memory import MemoryPort
from busmaster.transport.serial_port import SerialPort
from busmaster.transport.tcp import TcpPort

__all__ = [
    "BacklogFull",
    "Bus",
    "BusClosed",
    "BusError",
    "CommandWord",
    "Dc104Drive",
    "Endpoint",
    "GarbledReply",
    "GroupStatistics",
    "Hcp2Controller",
    "HcpController",
    "Health",
    "InvalidCommand",
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
    "MscController",
    "NoReply",
    "NoSuchParameter",
    "Node",
    "NodeChanged",
    "NodeDown",
    "NodeStatistics",
    "NotStarted",
    "Point",
    "PollGroup",
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
]

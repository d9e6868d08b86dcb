"""A protocol that takes the name of another."""

from __future__ import annotations

from dataclasses import replace

from busmaster.protocols.hcp import PROTOCOL as OTHER
from busmaster.registry import NodeKind, Protocol

THEIRS = OTHER.kinds[0]
PROTOCOL = Protocol(
    profile=replace(OTHER.profile, title="another"),
    kinds=(NodeKind(THEIRS.name, THEIRS.handle, THEIRS.make_device, items="nothing"),),
    commands=OTHER.commands,
    dialect=OTHER.dialect,
)

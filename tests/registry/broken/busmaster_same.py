"""Protocols that take the name, or an option, of another."""

from __future__ import annotations

from dataclasses import replace

from busmaster.protocols.hcp import PROTOCOL as OTHER
from busmaster.registry import NodeKind, Option, Protocol

THEIRS = OTHER.kinds[0]
PROTOCOL = Protocol(
    profile=replace(OTHER.profile, title="another"),
    kinds=(NodeKind(THEIRS.name, THEIRS.handle, THEIRS.make_device, items="nothing"),),
    commands=OTHER.commands,
    dialect=OTHER.dialect,
)
OPTION = Protocol(
    profile=replace(OTHER.profile, name="other"),
    kinds=(
        NodeKind(
            "other", THEIRS.handle, THEIRS.make_device, items="nothing", options=(Option("address_step", "text"),)
        ),
    ),
    commands=OTHER.commands,
    dialect=OTHER.dialect,
)

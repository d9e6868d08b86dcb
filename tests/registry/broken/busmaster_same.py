"""Protocols that take the name, the capture id, or an option of another."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from busmaster.protocols.hcp import PROTOCOL as OTHER
from busmaster.registry import NodeKind, Option, Protocol

THEIRS = OTHER.kinds[0]
PROTOCOL = Protocol(
    profile=replace(OTHER.profile, title="another"),
    kinds=(NodeKind(THEIRS.name, THEIRS.handle, THEIRS.make_device, items="nothing"),),
    commands=OTHER.commands,
    dialect=OTHER.dialect,
)


def other(**options: Any) -> Protocol:
    """A protocol with a name of its own."""
    kind = NodeKind("other", THEIRS.handle, THEIRS.make_device, items="nothing", **options)
    return Protocol(replace(OTHER.profile, name="other"), (kind,), OTHER.commands, OTHER.dialect)


CAPTURE_ID = other(capture_id=THEIRS.capture_id)
OPTION = other(options=(Option("address_step", "text"),))
READ_OPTION = other(read_options=(Option("chain", "text"),))

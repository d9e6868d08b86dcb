"""Checks that a protocol suits a line: the other protocols on it, and its settings."""

from __future__ import annotations

import warnings
from collections.abc import Iterable

from busmaster.contract.profile import Profile
from busmaster.errors import InvalidCommand
from busmaster.transport.endpoints import Endpoint
from busmaster.transport.serial_port import SerialPort
from busmaster.transport.tcp import TcpPort


def check_company(profile: Profile, present: Iterable[Profile]) -> None:
    """Raise InvalidCommand if nodes of this protocol cannot share a line with those of the protocols present."""
    for other in present:
        if not profile.may_share_with(other):
            raise InvalidCommand(
                f"{profile.name} and {other.name} nodes cannot share a line, because they would misread each other's "
                "frames: give each protocol a line and a bus of its own"
            )


def check_settings(profile: Profile, endpoint: Endpoint) -> None:
    """Warn of line settings that the protocol does not have.

    A line in memory has no settings; behind a port of raw TCP the serial server sets the framing.
    """
    settings = endpoint.settings
    # A warning and not an error: the documents leave some settings to the user, and adapters differ.
    if settings is None or not isinstance(endpoint, SerialPort | TcpPort):
        return
    framings = dict.fromkeys(line.framing for line in (profile.line, *profile.other_lines))
    # Not `isinstance`: an Rfc2217Port is a TcpPort too, and it sets the framing of the serial server.
    if type(endpoint) is not TcpPort and settings.framing not in framings:
        usual = " or ".join(framings)
        warnings.warn(
            f"{profile.name} is meant for {usual}, but {endpoint.name} is {settings.framing}",
            stacklevel=4,
        )
    if wrong := profile.wrong_rate(settings.baudrate):
        warnings.warn(f"{endpoint.name}: {wrong}", stacklevel=4)

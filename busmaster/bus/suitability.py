"""Whether a protocol goes with a line: with the others on it, and with its settings."""

from __future__ import annotations

import warnings
from collections.abc import Iterable

from busmaster.contract.profile import Profile
from busmaster.errors import InvalidCommand
from busmaster.transport.endpoints import Endpoint
from busmaster.transport.rfc2217 import Rfc2217Port
from busmaster.transport.serial_port import SerialPort
from busmaster.transport.tcp import TcpPort


def check_company(profile: Profile, present: Iterable[Profile]) -> None:
    """Raise InvalidCommand for a protocol whose nodes cannot be on one line with those of the protocols present."""
    for other in present:
        if not profile.may_share_with(other):
            raise InvalidCommand(
                f"{profile.name} and {other.name} nodes cannot share a line, since they would take each other's frames "
                "for their own: give each protocol a line and a bus of its own"
            )


def check_settings(profile: Profile, endpoint: Endpoint) -> None:
    """Warn of line settings that are none of the protocol's.

    A line in memory has no settings that could be wrong; behind a port of raw TCP the framing is the server's.
    """
    settings = endpoint.settings
    if settings is None or not isinstance(endpoint, SerialPort | TcpPort):
        return
    framings = dict.fromkeys(line.framing for line in (profile.line, *profile.other_lines))
    if isinstance(endpoint, SerialPort | Rfc2217Port) and settings.framing not in framings:
        usual = " or ".join(framings)
        warnings.warn(
            f"{profile.name} is meant for {usual}, but {endpoint.name} is {settings.framing}",
            stacklevel=4,
        )
    if wrong := profile.wrong_rate(settings.baudrate):
        warnings.warn(f"{endpoint.name}: {wrong}", stacklevel=4)

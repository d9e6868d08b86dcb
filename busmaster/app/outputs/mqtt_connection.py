"""What connections to a broker have in common: who we are, what names are called, how much may come."""

from __future__ import annotations

import fcntl
import ssl
import struct
import termios
from typing import TYPE_CHECKING, TypeAlias

from busmaster.app.outputs.settings import MqttSettings

if TYPE_CHECKING:
    from aiomqtt import Client
    from paho.mqtt.properties import Properties

Secrets: TypeAlias = tuple[str | None, str | None, ssl.SSLContext | None]
"""User name, password and TLS context."""


def secrets(settings: MqttSettings) -> Secrets:
    """Return user name, password and TLS context. Raises InvalidCommand for a file that cannot be read."""
    return settings.username, settings.password(), settings.tls_context()


def taking_in(most: int) -> Properties:
    """Return the properties that limit the messages that a broker sends before our acknowledgements."""
    from paho.mqtt.packettypes import PacketTypes
    from paho.mqtt.properties import Properties

    properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]  # the library's
    properties.ReceiveMaximum = most
    return properties


def unread(client: Client) -> int:
    """Return how many bytes have come from the broker, and are not read yet; what an encryption adds is counted too."""
    connection = client._client.socket()
    if connection is None or connection.fileno() < 0:
        return 0
    [waiting] = struct.unpack("i", fcntl.ioctl(connection, termios.FIONREAD, bytes(4)))
    return int(waiting) + (connection.pending() if isinstance(connection, ssl.SSLSocket) else 0)


def topic_part(name: str) -> str:
    """Return the name without the special characters of topics. Different names stay different."""
    return name.replace("%", "%25").replace("+", "%2B").replace("#", "%23")

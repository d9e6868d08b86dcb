"""The settings of each output. A field is a key of its table in LINE.toml: see docs/adding-a-key.md."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from math import inf
from typing import TYPE_CHECKING, Annotated, Literal, Self, TypeAlias

from busmaster import InvalidCommand
from busmaster.app.bounds import MOST_BUFFERED, MOST_SPILLED
from busmaster.ext import MODE, Between, Parsed, read_file

if TYPE_CHECKING:
    import ssl

BUFFER = 50_000
"""Values that may wait, some 500 bytes each: ten minutes of 80 a second."""
DATE_FIELD = re.compile("%(-?.?)", re.DOTALL)
DATE_FIELDS = frozenset("YCyGgmbBhdejaAuwUWVHIklMSspPFTRrXzZ")
"""What may stand behind a % in the path of a file, or behind %-: what makes slashes or ends of lines is none of it."""

AuditMode: TypeAlias = Literal["batched", "strict"]


def file_mode(text: str) -> int:
    """Return the mode of a file that chmod takes in octal. Raises InvalidCommand."""
    if len(text) not in (3, 4) or not set(text) <= set("01234567") or int(text, 8) > 0o777:
        raise InvalidCommand('a mode must be octal, as for chmod: mode = "0640"')
    return int(text, 8)


FileMode: TypeAlias = Annotated[int, Parsed(file_mode, str, "text, octal", "{:04o}".format)]


def _limit(value: float) -> float:
    if value <= 0:
        raise InvalidCommand(f"must be more than 0, not {value}; leave it out to keep all")
    return value


def _topic(topic: str) -> str:
    if not topic or set(topic) & set("+#") or topic.startswith("/") or topic.endswith("/") or not topic.isprintable():
        raise InvalidCommand("a topic must not contain +, # or control characters, nor a slash at an end")
    return topic


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """The keys of every output."""

    enabled: bool = True
    """Whether the output is used. The keys of a disabled output are checked too."""
    groups: tuple[str, ...] = ()
    """The poll groups whose values it gets. By default all of them; for metrics none."""
    buffer: Annotated[int, Between(1, MOST_BUFFERED)] = BUFFER
    """How many values can wait for the output. Beyond it the oldest is dropped and counted."""

    def __post_init__(self) -> None:
        if self.buffer < 1:
            raise InvalidCommand(f"a buffer must hold at least one value, not {self.buffer}")

    @property
    def destination(self) -> str:
        """Return the destination of the values for messages: a file, or host and port; "" if it has no name."""
        return ""

    @property
    def writable(self) -> tuple[str, tuple[str, ...]]:
        """Return the key that names the points which others may write through the output, and those names."""
        return "", ()

    def without_commands(self) -> Self:
        """Return the settings of an output that lets others write nothing."""
        return self

    def check_files(self, at: Callable[[str], AbstractContextManager[object]]) -> None:
        """Read the files of the settings, each within `at(key)`, and raise InvalidCommand for a bad one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpillingSettings(Settings):
    """The keys of an output that writes files, or has one for values that wait."""

    mode: FileMode = MODE
    """The mode of the files that it creates, as in chmod; the umask applies."""
    spill: str | None = None
    """The file for values that wait while the output is down; it survives a restart. Use another disk if possible."""
    spill_values: Annotated[int, Between(1, MOST_SPILLED)] = 1_000_000
    """How many values can wait in that file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FileSettings(SpillingSettings):
    """An output to a file of lines. A new file begins when the name that `path` has at this time changes."""

    path: str
    """The file. Fields of a date make new ones: `line-%Y-%m-%d.csv`; %% is a %."""
    sync_every: Annotated[float, Between(0, unit="s")] = 10.0
    """Longest time until written values survive a loss of power; 0: after each batch."""
    audit: AuditMode = "batched"
    """`strict`: a write is acknowledged to its client only after its audit entry is on the disk."""

    @property
    def destination(self) -> str:
        """Return the file."""
        return self.path

    def __post_init__(self) -> None:
        Settings.__post_init__(self)  # super() does not work in a class with slots
        for field in DATE_FIELD.findall(self.path):
            if field != "%" and field.removeprefix("-") not in DATE_FIELDS:
                raise InvalidCommand(
                    f"{self.path}: %{field} is not a field of a date; use strftime's (%Y %m %d %H), and %% for a %"
                )


@dataclass(frozen=True, slots=True, kw_only=True)
class SqliteSettings(SpillingSettings):
    """An output to a database."""

    path: str
    """The database."""
    audit: AuditMode = "batched"
    """`strict`: a write is acknowledged to its client only after its audit entry is on the disk."""
    keep_days: Annotated[float | None, Between(unit="days"), Parsed(_limit)] = None
    """Older values are deleted. Must be more than 0; by default all are kept."""
    keep_mb: Annotated[float | None, Between(unit="MB"), Parsed(_limit)] = None
    """If the database is larger, the oldest values are deleted. Must be more than 0; by default all are kept."""

    @property
    def destination(self) -> str:
        """Return the file."""
        return self.path

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        for name in ("keep_days", "keep_mb"):
            value = getattr(self, name)
            if value is not None and not 0 < value < inf:
                raise InvalidCommand(f"{name} must be more than 0, not {value}")


@dataclass(frozen=True, slots=True, kw_only=True)
class MqttSettings(SpillingSettings):
    """An output to an MQTT broker."""

    host: str = "127.0.0.1"
    """The broker."""
    port: Annotated[int, Between(1, 65535)] = 1883
    """The TCP port there."""
    prefix: Annotated[str, Parsed(_topic)] = "busmaster"
    """The first part of all topics."""
    messages: Literal["point", "cycle"] = "point"
    """One message for each point, or one for each cycle of a group."""
    qos: Annotated[int, Between(0, 1)] = 1
    """0: values may be lost unseen; 1: they are not."""
    retain: bool = True
    """Whether the broker keeps the last value of each point."""
    username: str | None = None
    """The user name for the broker."""
    password_file: str | None = None
    """The file with that user's password."""
    tls: bool = False
    """Whether the connection is encrypted."""
    ca_file: str | None = None
    """The certificates that are trusted; the system's by default."""
    allow_commands: tuple[str, ...] = ()
    """The points that MQTT commands may write. By default none: commands are then ignored."""

    home_assistant: Annotated[str | None, Parsed(_topic)] = None
    """The discovery prefix of Home Assistant, usually `homeassistant`: points, nodes and alarms appear there by
    themselves. By default no discovery messages are sent."""

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        if self.home_assistant is not None and self.messages == "cycle":
            raise InvalidCommand('home_assistant needs messages = "point": a discovered entity has a topic of its own')

    @property
    def destination(self) -> str:
        """Return the broker."""
        return f"{self.host}:{self.port}"

    @property
    def writable(self) -> tuple[str, tuple[str, ...]]:
        """Return the points that commands may write."""
        return "allow_commands", self.allow_commands

    def without_commands(self) -> Self:
        """Return the settings without `allow_commands`."""
        return replace(self, allow_commands=())

    def check_files(self, at: Callable[[str], AbstractContextManager[object]]) -> None:
        """Read the password and the certificates. Raises InvalidCommand."""
        with at("password_file"):
            self.password()
        with at("ca_file"):
            self.tls_context()

    def password(self) -> str | None:
        """Read the password. Raises InvalidCommand for a file that cannot be read."""
        if self.password_file is None:
            return None
        try:
            return read_file(self.password_file).decode().strip()
        except OSError as error:
            raise InvalidCommand(f"{self.password_file} cannot be read: {error.strerror or error}") from None
        except UnicodeDecodeError:
            raise InvalidCommand(f"{self.password_file} is not text") from None

    def tls_context(self) -> ssl.SSLContext | None:
        """Return the TLS context, None without TLS. Raises InvalidCommand for certificates that cannot be read."""
        if not self.tls:
            return None
        import ssl  # it takes 15 ms, which a line without TLS does not spend

        try:
            return ssl.create_default_context(cafile=self.ca_file)
        except ssl.SSLError:
            raise InvalidCommand(f"{self.ca_file} holds no certificate in PEM form") from None
        except OSError as error:  # it does not name the file
            raise InvalidCommand(f"{self.ca_file} cannot be read: {error.strerror or error}") from None


@dataclass(frozen=True, slots=True, kw_only=True)
class MetricsSettings(Settings):
    """An output that Prometheus reads. The values of `groups` are served too; without any, only counts are."""

    host: str = "127.0.0.1"
    """The address on which the metrics are served."""
    port: Annotated[int, Between(0, 65535)] = 9464
    """The TCP port there."""

    @property
    def destination(self) -> str:
        """Return the address that is served."""
        return f"{self.host}:{self.port}"


__all__ = [
    "Settings",
    "SpillingSettings",
]

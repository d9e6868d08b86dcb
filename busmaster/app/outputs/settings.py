"""What each output is told, as data."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from math import inf
from typing import TYPE_CHECKING, Annotated, Literal, Self, TypeAlias

from busmaster.bounds import MOST_BUFFERED, MOST_SPILLED
from busmaster.errors import InvalidCommand
from busmaster.ext import MODE, Between, read_file

if TYPE_CHECKING:
    import ssl

BUFFER = 50_000
"""Values that may wait, some 500 bytes each: ten minutes of 80 a second."""
DATE_FIELD = re.compile("%(-?.?)", re.DOTALL)
DATE_FIELDS = frozenset("YCyGgmbBhdejaAuwUWVHIklMSspPFTRrXzZ")
"""What may stand behind a % in the path of a file, or behind %-: what makes slashes or ends of lines is none of it."""

AuditMode: TypeAlias = Literal["batched", "strict"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """`groups`: the poll groups whose values it gets, all if there are none. `buffer`: values that may wait for it."""

    groups: tuple[str, ...] = ()
    buffer: Annotated[int, Between(1, MOST_BUFFERED)] = BUFFER

    def __post_init__(self) -> None:
        if self.buffer < 1:
            raise InvalidCommand(f"a buffer holds at least one value, not {self.buffer}")

    @property
    def destination(self) -> str:
        """Return where values go, as messages name it: a file, or host and port; "" for what has no name."""
        return ""

    @property
    def writable(self) -> tuple[str, tuple[str, ...]]:
        """Return the key that names the points which others may write through the output, and those names."""
        return "", ()

    def without_commands(self) -> Self:
        """Return the settings of an output that lets others write nothing."""
        return self

    def check_files(self, at: Callable[[str], AbstractContextManager[object]]) -> None:
        """Read the files that the settings name, each within `at(key)`, and raise InvalidCommand for a bad one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpillingSettings(Settings):
    """`spill` is a file for what waits while the output is down, which then survives a restart: `spill_values` at most.

    It is best on another disk than what it stands in for. `mode` is what new files may be used for and by whom,
    narrowed by the process's umask.
    """

    mode: int = MODE
    spill: str | None = None
    spill_values: Annotated[int, Between(1, MOST_SPILLED)] = 1_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class FileSettings(SpillingSettings):
    """`path` may hold fields of a date (%Y/line-%m-%d.csv): a new file begins when the name changes; %% is a %.

    `sync_every`: after so many seconds at most what was written survives a loss of power too; 0 for after each batch.
    """

    path: str
    sync_every: Annotated[float, Between(0)] = 10.0
    audit: AuditMode = "batched"

    @property
    def destination(self) -> str:
        """Return the file."""
        return self.path

    def __post_init__(self) -> None:
        Settings.__post_init__(self)  # super() does not work in a class with slots
        for field in DATE_FIELD.findall(self.path):
            if field != "%" and field.removeprefix("-") not in DATE_FIELDS:
                raise InvalidCommand(
                    f"{self.path}: %{field} is no field of a date: use those of strftime (%Y %m %d %H), and %% for a %"
                )


@dataclass(frozen=True, slots=True, kw_only=True)
class SqliteSettings(SpillingSettings):
    """What is older than `keep_days` is deleted, and the oldest of more than `keep_mb` megabytes; None keeps all."""

    path: str
    audit: AuditMode = "batched"
    keep_days: float | None = None
    keep_mb: float | None = None

    @property
    def destination(self) -> str:
        """Return the file."""
        return self.path

    def __post_init__(self) -> None:
        for name in ("keep_days", "keep_mb"):
            value = getattr(self, name)
            if value is not None and not 0 < value < inf:
                raise InvalidCommand(f"{name} is more than 0, not {value}")


@dataclass(frozen=True, slots=True, kw_only=True)
class MqttSettings(SpillingSettings):
    """`messages`: one for each "point", or one for each "cycle". `qos` 0 may lose values unseen, 1 does not.

    `allow_commands` names the points ("winder/1") that commands may write; without any, no command is listened to.
    """

    host: str = "127.0.0.1"
    port: Annotated[int, Between(1, 65535)] = 1883
    prefix: str = "busmaster"
    messages: Literal["point", "cycle"] = "point"
    qos: Annotated[int, Between(0, 1)] = 1
    retain: bool = True
    username: str | None = None
    password_file: str | None = None
    tls: bool = False
    ca_file: str | None = None
    allow_commands: tuple[str, ...] = ()

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
    """Where it is served: only there. The values of `groups` are served too; without any, only counts are."""

    host: str = "127.0.0.1"
    port: Annotated[int, Between(0, 65535)] = 9464

    @property
    def destination(self) -> str:
        """Return the address that is served."""
        return f"{self.host}:{self.port}"

"""Whether other programs may use the line of a file, who, and how they come: `[service]`."""

from __future__ import annotations

import grp
import os
import pwd
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, TypeVar

from busmaster import InvalidCommand
from busmaster.app.bounds import SHORTEST_TOKEN
from busmaster.app.config.keys import Form, Internal, read_section, tables_of
from busmaster.app.config.names import NODE_NAME
from busmaster.app.config.table import Table
from busmaster.app.outputs.settings import FileMode
from busmaster.app.service.permission import digest_of
from busmaster.app.service.rights import RIGHTS, Role
from busmaster.app.service.tcp import check_listening
from busmaster.ext import LEAST_SHARE, LONGEST_FILE, MOST_SHARE, Between, Parsed, check_regular, host_and_port

K = TypeVar("K")

MODE = 0o600
GROUP_MODE = 0o660
"""Of the socket where there is a `group`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RoleSection:
    """What a user, a group or a token may do."""

    who: Internal[str]
    role: Role
    """What a program may do: `write` may read too, and `admin` may use line time as the owner does."""
    allow_writes: tuple[str, ...] | None = None
    """The points that a writer may write, as groups name points; `*` is any part of a node's name, and behind the slash
    all of the node. Left out: all of the line."""
    table: Internal[Table] = field(compare=False, repr=False)


def _group_number(group: str) -> int:
    try:
        return grp.getgrnam(group).gr_gid
    except KeyError:
        raise InvalidCommand(f"the group {group!r} does not exist on this machine") from None


@dataclass(frozen=True, slots=True, kw_only=True)
class ServiceSection:
    """The section `[service]`: whether a socket is served, to which clients, and their permissions.

    Roles are stored by user and group numbers, and by token names. They can change while the line runs.
    """

    enabled: bool = True
    """Whether other programs can use the line."""
    group: Annotated[int | None, Parsed(_group_number, str)] = None
    """The group of this machine whose members can open the socket, beside this user."""
    mode: FileMode = MODE
    """The mode of the socket; 0660 if there is a `group`."""
    share: Annotated[float, Between(LEAST_SHARE, MOST_SHARE)] = 1.0
    """The share of line time of each program, where the owner's is 1, while both have requests waiting."""
    listen: Annotated[tuple[str, int] | None, Form("text", {"type": "string"})] = None
    """Address for programs that connect by TCP, as HOST:PORT. An address beyond this machine needs `token_file`."""
    token_file: str | None = None
    """The file of the tokens for programs that connect by TCP: a name and its token on each line."""
    users: Annotated[Mapping[int, RoleSection], tables_of("role")] = field(default_factory=dict, compare=False)
    """A table for each user of this machine that has a role: `[service.users.NAME]`."""
    groups: Annotated[Mapping[int, RoleSection], tables_of("role")] = field(default_factory=dict, compare=False)
    """A table for each group of this machine that has a role: `[service.groups.NAME]`."""
    tokens: Annotated[Mapping[str, RoleSection], tables_of("role")] = field(default_factory=dict, compare=False)
    """A table for each token that has a role: `[service.tokens.NAME]`."""
    table: Internal[Table] = field(compare=False, repr=False)

    def secrets(self) -> dict[str, bytes]:
        """Read the tokens, and return the digest of each by its name.

        Raises FileError, naming the line and no token, for a file that cannot be read, that others may read, or that
        has not all tokens of which the section speaks.
        """
        if self.token_file is None:
            return {}
        with self.table.at("token_file"):
            secrets = read_tokens(self.token_file)
        for name, role in self.tokens.items():
            if name not in secrets:
                raise role.table.error(f"there is no token {name!r} in {self.token_file}; add it there")
        return secrets


def read_service(table: Table) -> ServiceSection:
    """Read `[service]`. Raises FileError with line and key for an error in it."""
    values = read_section(table, ServiceSection)
    if "group" in values:
        values.setdefault("mode", GROUP_MODE)
    bare = ServiceSection(**values, table=table)
    return replace(
        bare,
        listen=_listen(table, bare.token_file),
        users=_roles(table, "users", lambda each: (_user(each), _role(each, "user"))),
        groups=_roles(table, "groups", lambda each: (_group(each), _of_group(each, bare.mode))),
        tokens=_roles(table, "tokens", lambda each: (_token(each, bare.token_file), _role(each, "token"))),
    )


def _listen(table: Table, token_file: str | None) -> tuple[str, int] | None:
    """Read where programs may come by TCP."""
    listen = None
    with table.part():
        if "listen" in table:
            with table.at("listen"):
                listen = host_and_port(table.text("listen"))
                check_listening(listen, tokens=token_file is not None)
        elif token_file is not None:
            raise table.error('tokens need TCP; add an address, such as listen = "127.0.0.1:7420"', "token_file")
    return listen


def _roles(table: Table, key: str, read: Callable[[Table], tuple[K, RoleSection]]) -> dict[K, RoleSection]:
    """Read a table such as `[service.users]`, and return the role of each entry."""
    roles: dict[K, RoleSection] = {}
    for each in table.tables(key):
        with each.part():
            name, roles[name] = read(each)
    return roles


def _role(table: Table, kind: str) -> RoleSection:
    section = RoleSection(**read_section(table, RoleSection), who=f"{kind} {table.name}", table=table)
    if section.allow_writes is not None and not (RIGHTS[section.role].writes and section.allow_writes):
        raise table.error('needs role = "write" or "admin"; leave it out to permit the whole line', "allow_writes")
    return section


def _of_group(table: Table, mode: int) -> RoleSection:
    if not mode & 0o066:
        raise table.error(f"groups cannot open a socket of mode {mode:04o}; set group = {table.name!r}")
    return _role(table, "group")


def _user(table: Table) -> int:
    try:
        return pwd.getpwnam(table.name).pw_uid
    except KeyError:
        raise table.error(f"the user {table.name!r} does not exist on this machine") from None


def _group(table: Table) -> int:
    with table.at():
        return _group_number(table.name)


def _token(table: Table, token_file: str | None) -> str:
    if token_file is None:
        raise table.error("tokens are stored in a separate file; name it with token_file")
    return table.name


def read_tokens(path: str) -> dict[str, bytes]:
    """Return the digest of each token of a file by its name. Raises InvalidCommand, naming no token."""
    secrets = dict(_tokens(path))
    if not secrets:
        raise InvalidCommand(f"{path} has no tokens; write a name and its token on each line")
    return secrets


def _tokens(path: str) -> Iterator[tuple[str, bytes]]:
    """Yield the names and digests of a file of tokens. Raises InvalidCommand."""
    known: set[str] = set()
    for number, line in enumerate(_private_text(path).splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        name = words[0]
        if len(words) != 2 or not NODE_NAME.fullmatch(name):
            raise InvalidCommand(f"{path}:{number}: expected a name and its token")
        if len(words[1]) < SHORTEST_TOKEN:
            raise InvalidCommand(
                f"{path}:{number}: the token of {name} has less than {SHORTEST_TOKEN} characters; "
                "make one with openssl rand -hex 32"
            )
        if name in known:
            raise InvalidCommand(f"{path}:{number}: two tokens have the name {name!r}; rename or remove one")
        known.add(name)
        yield name, digest_of(words[1])


def _private_text(path: str) -> str:
    """Return the text of a file. Raises InvalidCommand if other users can read or write it."""
    try:
        with open(path, "rb", opener=_without_waiting) as file:
            found = os.fstat(file.fileno())
            check_regular(found, path)
            # A group may read it: so may that of a credential that systemd hands over.
            if found.st_mode & 0o027 or found.st_uid not in (0, os.getuid()):
                raise InvalidCommand(f"other users can read or change {path}; run chmod 600 {path} as its owner")
            if found.st_size > LONGEST_FILE:
                raise InvalidCommand(f"{path} has more than {LONGEST_FILE} bytes; it is not a list of tokens")
            return file.read(LONGEST_FILE).decode()
    except OSError as error:
        raise InvalidCommand(f"{path} cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InvalidCommand(f"{path} is not a text file; write a name and its token on each line") from None


def _without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK | os.O_CLOEXEC)

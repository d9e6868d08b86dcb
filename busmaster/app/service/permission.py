"""The permissions for a line, defined in its file for users, groups and tokens."""

from __future__ import annotations

import hashlib
import hmac
import os
from collections.abc import Collection, Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from busmaster.app.service.rights import ADMIN, READ, RIGHTS, Rights, Role
from busmaster.ext import Changing, Command, Requester

Allowed: TypeAlias = Mapping[tuple[str, int], frozenset[Hashable] | None]
"""By protocol and address of a node, the places there that may be written; None for all of the node."""


@dataclass(frozen=True, slots=True)
class Permission:
    """The permission of a program, by its role. `who` names the program in messages: "token hmi".

    `only`: the places that a writer may write, independent of their names and the form of the write; None for all.
    """

    who: str
    role: Role
    only: Allowed | None = None

    @property
    def rights(self) -> Rights:
        """Return the rights of its role."""
        return RIGHTS[self.role]

    @property
    def writes(self) -> bool:
        """Return whether it may write anything."""
        return self.rights.writes

    def reaches(self, node: Requester) -> bool:
        """Return whether anything of a node may be written."""
        return self.writes and (self.only is None or _key(node) in self.only)

    def covers(self, node: Requester) -> bool:
        """Return whether all of a node may be written."""
        return self.writes and (self.only is None or self.only.get(_key(node), frozenset()) is None)

    def refusal(self, node: Requester, command: Command[Any]) -> str:
        """Return why a write is not permitted, "" if it is."""
        if not self.writes:
            return f"{self.who} may read this line, but not write; see [service] in the line's file"
        if self.only is None:
            return ""
        places = self.only.get(_key(node), frozenset())
        if places is None:
            return ""
        changed = command.changes(node.profile).keys() if isinstance(command, Changing) else ()
        if changed and places.issuperset(changed):
            return ""
        return f"{self.who} may not write this; see allow_writes in the line's file"


EVERYTHING = Permission("the owner", ADMIN)


@dataclass(frozen=True, slots=True)
class Access:
    """The permissions of a line, by the numbers of users and groups, and by the names of tokens.

    A user's own entry goes before the groups', and those in their order. Without an entry the user
    whose process owns the line, and root, are ADMIN, and others READ.
    """

    users: Mapping[int, Permission] = field(default_factory=dict)
    groups: Mapping[int, Permission] = field(default_factory=dict)
    tokens: Mapping[str, Permission] = field(default_factory=dict)
    secrets: Mapping[str, bytes] = field(default_factory=dict, repr=False)
    """The digest of each token. The tokens themselves are not stored."""

    def of_process(self, uid: int, gids: Collection[int]) -> Permission:
        """Return the permission of a process of this machine."""
        if uid in self.users:
            return self.users[uid]
        if uid in (0, os.getuid()):
            return EVERYTHING
        for gid, permission in self.groups.items():
            if gid in gids:
                return permission
        return Permission("this user", READ)

    def of_token(self, name: str) -> Permission:
        """Return the permission of a token; "" for a client without one."""
        return self.tokens.get(name) or Permission(f"token {name}" if name else "a program without a token", READ)

    def token_name(self, secret: str) -> str | None:
        """Return the name of a token, None for an unknown one. The duration does not depend on the token."""
        found, digest = None, digest_of(secret)
        for name, known in self.secrets.items():
            if hmac.compare_digest(known, digest):
                found = name
        return found


def digest_of(secret: str) -> bytes:
    """Return the digest of a token, which is stored instead of it."""
    return hashlib.sha256(secret.encode(errors="surrogateescape")).digest()


def _key(node: Requester) -> tuple[str, int]:
    return node.profile.name, node.address

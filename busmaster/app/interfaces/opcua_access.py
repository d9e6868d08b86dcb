"""Who may come to a line by OPC UA, and what may be written there."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable, Collection, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any

from asyncua import Server, ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import SimpleRoleRuleset, User, UserRole
from asyncua.server.address_space import AddressSpace, AttributeService

from busmaster.app.bounds import MOST_CONNECTIONS, MOST_SUBSCRIPTIONS
from busmaster.app.interfaces.opcua_sessions import use_sessions
from busmaster.app.interfaces.opcua_terms import CODES
from busmaster.app.service.permission import Access
from busmaster.app.service.refusals import Logins

OPEN = [ua.SecurityPolicyType.NoSecurity]
SIGNED = [
    ua.SecurityPolicyType.Basic256Sha256_Sign,
    ua.SecurityPolicyType.Aes128Sha256RsaOaep_Sign,
    ua.SecurityPolicyType.Aes256Sha256RsaPss_Sign,
]
ENCRYPTED = [
    ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt,
    ua.SecurityPolicyType.Aes128Sha256RsaOaep_SignAndEncrypt,
    ua.SecurityPolicyType.Aes256Sha256RsaPss_SignAndEncrypt,
]


@dataclass(frozen=True, kw_only=True)
class Rules:
    """The rules for clients.

    `allow` names the points that may be written, by their keys; `*` matches any letters. `secrets` are digests of
    tokens by name: with them, only users with a token can write. `trusted` are the certificates (DER) of permitted
    clients, None for all. `is_signed` rejects connections without signature. `is_local`: only programs of this machine
    can connect; if not, a write needs a token.
    """

    allow: tuple[str, ...] = ()
    secrets: Mapping[str, bytes] = field(default_factory=dict, repr=False)
    trusted: Collection[bytes] | None = None
    is_signed: bool = False
    is_local: bool = True

    def may_be_written(self, key: str) -> bool:
        """Return whether a point is one of those that may be written."""
        return any(fnmatchcase(key, pattern) for pattern in self.allow)

    def refusal(self, user: User) -> str:
        """Return why a user may not write, "" if it may."""
        if self.secrets and user.name is None:
            return "an anonymous user may not write, because there are tokens; log in with a token"
        return "" if self.secrets or self.is_local else "a write from the network needs a token; use --token-file"


class Users:
    """Identifies users: by the name of a token, or as anonymous. There is no administrator."""

    def __init__(self, rules: Rules, failed: Callable[[str], None] = lambda _: None) -> None:
        self._rules = rules
        self._logins = Logins(failed, time.monotonic)
        self.peer = ""
        """The address of the client whose session is being activated, which the library does not hand to `get_user`."""
        self._access = Access(secrets=rules.secrets)

    def get_user(
        self, iserver: Any, username: str | None = None, password: str | None = None, certificate: bytes | None = None
    ) -> User | None:
        """Return the user, None for one that is not admitted.

        `certificate` is that of the client's channel, which has signed with it.
        """
        if self._rules.is_signed and certificate is None:  # the library opens such a channel, though not offered
            return None
        if self._rules.trusted is not None and certificate not in self._rules.trusted:
            return None
        if username is None:
            return User(role=UserRole.User)
        name = self._access.token_name(password or "")
        wait = self._logins.judge(self.peer, name if name == username else None)
        if wait:
            raise ServiceError(CODES.BadServerTooBusy)
        if wait is not None:
            return None
        return User(role=UserRole.User, name=username)


Write = Callable[[ua.WriteValue, User], Awaitable[int]]


class Writes(AttributeService):  # type: ignore[misc]  # it is untyped
    """Hands what clients write to `write`, which returns its status: nothing of it changes the address space."""

    def __init__(self, aspace: AddressSpace, write: Write) -> None:
        super().__init__(aspace)
        self._write = write

    async def write(self, params: ua.WriteParameters, user: User | None = None) -> list[ua.StatusCode]:
        """Write some values in their order, and return the status of each."""
        if user is None or user.role is UserRole.Admin:  # only this process itself
            own: list[ua.StatusCode] = await super().write(params)
            return own
        return [ua.StatusCode(await self._write(wanted, user)) for wanted in params.NodesToWrite]


def _nobody(token: Any) -> None:
    """Find no session: a client that has lost its connection creates a new one."""


def _refuse(*arguments: Any) -> None:
    """Raise the error of an unsupported service."""
    raise ServiceError(CODES.BadServiceUnsupported)


def guard(server: Server, rules: Rules, write: Write, failed: Callable[[str], None]) -> None:
    """Apply the rules to a server, with encryption if it has a certificate.

    `failed` is called with the address of each client whose login failed.
    """
    iserver = server.iserver
    iserver.user_manager = Users(rules, failed)
    use_sessions(iserver, rules.refusal)
    iserver.attribute_service = Writes(iserver.aspace, write)
    iserver.max_connections = MOST_CONNECTIONS
    iserver.max_subscriptions = MOST_SUBSCRIPTIONS
    # The library binds a session to any client that names it, and keeps that even if the client is then refused.
    iserver.lookup_external_session = _nobody
    iserver.register_server = iserver.register_server2 = _refuse  # any client could, without limit
    server.allow_remote_admin(False)
    has_key = iserver.certificate is not None
    server.set_security_policy(ENCRYPTED + SIGNED if has_key else OPEN, SimpleRoleRuleset())
    named = [ua.UserNameIdentityToken] if rules.secrets else []
    server.set_identity_tokens([ua.AnonymousIdentityToken, *named])

"""Which connections the owner of a line admits.

A program that may only read could otherwise take every place, and lock out writers, the owner's user and the command
that sends the safe state.
"""

from __future__ import annotations

import os
from collections import Counter, OrderedDict
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping
from typing import Any

from busmaster.app.bounds import (
    CONNECTIONS_A_SECOND,
    FREE_CONNECTIONS,
    MOST_CLIENTS,
    MOST_CONNECTING_PEERS,
    MOST_DELAYED,
    MOST_STRANGERS,
    RESERVED_FOR_SAFE,
)
from busmaster.app.service.client import Client
from busmaster.app.service.client_connection import ClientConnection
from busmaster.app.service.messages import Malformed
from busmaster.app.service.permission import Permission
from busmaster.app.service.refusals import Refusals
from busmaster.app.service.rights import RIGHTS, Role


class Admission:
    """Decides by their roles which programs are admitted, and which connections are closed for new ones.

    Each role has the places that are reserved for it, and MOST_CLIENTS are for all roles. RESERVED_FOR_SAFE are for
    programs that declare in `hello` that they only send the safe state, if there is no other place.
    """

    def __init__(self, refusals: Refusals) -> None:
        self._refusals = refusals

    def refusal(self, permission: Permission, clients: Iterable[Client]) -> str:
        """Return why a program is not admitted beside `clients`, "" if it is. A refusal is counted and reported."""
        if self._has_place(permission.role, clients):
            return ""
        self._refusals.note_connection(permission.role.value)
        return self._why_not(permission.role)

    def admit(self, permission: Permission, clients: Mapping[Client, ClientConnection], *, safe_only: bool) -> bool:
        """Admit one more program beside `clients`, and return whether it gets a place for the safe state.

        `safe_only`: it has declared that it only sends the safe state. Raises Malformed with the reason for a refusal.
        """
        if self._has_place(permission.role, clients):
            return False
        if not (safe_only and permission.writes):
            raise Malformed(self.refusal(permission, clients))
        here = [client for client in clients if client.in_safe_place]
        if len(here) >= RESERVED_FOR_SAFE:
            idle = next((client for client in here if not client.requests.sends_safe_state), None)
            if idle is None:
                self._refusals.note_connection("safe")
                raise Malformed(f"{len(here)} programs are already sending the safe state; wait for them")
            clients[idle].websocket.abort()
        return True

    def _has_place(self, role: Role, clients: Iterable[Client]) -> bool:
        """Return whether one more program of this role is admitted beside `clients`."""
        counts = Counter(client.permission.role for client in clients if not client.in_safe_place)
        if counts[role] < RIGHTS[role].reserved:
            return True
        return sum(max(0, count - RIGHTS[other].reserved) for other, count in counts.items()) < MOST_CLIENTS

    def _why_not(self, role: Role) -> str:
        """Return the text for a refused program."""
        others = ", ".join(
            f"{rights.reserved} more are for role {other.value}"
            for other, rights in RIGHTS.items()
            if rights.reserved and other is not role
        )
        return f"all {MOST_CLIENTS + RIGHTS[role].reserved} places for role {role.value} are taken; {others}"


class ConnectionRate:
    """How fast each peer connects. One that connects repeatedly would otherwise use up the time of the line's loop:
    a login costs about as much as thirty requests.

    After FREE_CONNECTIONS, a peer's connections are admitted at CONNECTIONS_A_SECOND; MOST_DELAYED wait for that, and
    others are refused. So a client that connects together with others waits, and needs no second attempt.
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._used_until: OrderedDict[Hashable, float] = OrderedDict()
        """Time until which the past connections use up the allowance of each peer, least recently connected first."""

    def delay(self, peer: Hashable) -> float | None:
        """Count a connection of a peer. Return the seconds for which it must wait, None if it is refused."""
        now = self._now()
        used_until = max(now, self._used_until.pop(peer, now)) + 1 / CONNECTIONS_A_SECOND
        delay = used_until - now - FREE_CONNECTIONS / CONNECTIONS_A_SECOND
        refused = delay > MOST_DELAYED / CONNECTIONS_A_SECOND
        self._used_until[peer] = used_until - 1 / CONNECTIONS_A_SECOND if refused else used_until
        if len(self._used_until) > MOST_CONNECTING_PEERS:
            self._used_until.popitem(last=False)
        return None if refused else max(0.0, delay)


def connecting_peer(origin: int | str | None, process: int) -> Hashable:
    """Return the key of a peer that connects, by its `origin`: a user, or an address.

    Each process of the owner's user and of root has its own key: one that connects repeatedly must not delay the
    command that sends the safe state. Processes of another user have one rate together, because there can be many.
    """
    return (origin, process) if origin in (0, os.getuid()) else origin


def stranger_to_close(strangers: Collection[ClientConnection]) -> ClientConnection | None:
    """Return the connection without a first message that is closed for a new one; None if there is space.

    It is the oldest of the user or address with the most connections, so a peer that opens many closes its own.
    """
    if len(strangers) < MOST_STRANGERS:
        return None
    origins: Counter[Any] = Counter(connection.websocket.origin for connection in strangers)
    [(crowd, _)] = origins.most_common(1)
    return next(connection for connection in strangers if connection.websocket.origin == crowd)

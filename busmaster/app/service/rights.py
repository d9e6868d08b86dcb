"""The rights of each role: one table, from which the service, the documentation and the tests are derived.

Line time is a right as writing is. A program that may only read could otherwise keep the line busy with reads, and the
owner's polls, its writes and its safe state would wait.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass

from busmaster import Priority
from busmaster.app.bounds import RESERVED_FOR_ADMINS, RESERVED_FOR_WRITERS
from busmaster.ext import BACKGROUND, COMMAND, POLL, URGENT


class Role(enum.Enum):
    """READ reads; WRITE also writes; ADMIN also uses line time as the owner does."""

    READ = "read"
    WRITE = "write"
    ADMIN = "admin"


READ, WRITE, ADMIN = Role


@dataclass(frozen=True, slots=True, kw_only=True)
class Rights:
    """The rights of a program with this role.

    `reads`, `polls`: the highest priority of its reads and of its own poll groups; a higher one is reduced to this.
    `owner_time`: while the owner waits, the owner may use the line for this many seconds for each second of all
    programs of the role together. With 0, the program takes turns with the owner. `new_nodes`: number of nodes that a
    program may name and that the file does not have. `budgeted`: a node that only such programs name, and that has
    never replied, is polled within the budget of probes (R11). `own_times`: reply times may exceed those of the
    protocol's document. `demand_every`: periods of a group between two cycles that programs of the role demand; 0: no
    limit. `groups`: number of its poll groups. `reserved`: connections that only programs of the role can have, in
    addition to those that all roles share. `writes`: it may write, pause a group, suspend a node and hold the line for
    a sequence, where `allow_writes` permits its writes.
    """

    reads: Priority
    polls: Priority
    owner_time: float
    new_nodes: int
    budgeted: bool
    own_times: bool
    demand_every: int
    groups: int
    reserved: int
    writes: bool


RIGHTS = {
    READ: Rights(
        # So that nothing of them starves on a line that the owner keeps busy, and no more: an eighth, the slots of
        # BACKGROUND (R9), made cycles miss where polls and the writes of an operator use more than 7/8 of the line.
        reads=BACKGROUND,
        polls=BACKGROUND,
        owner_time=31.0,
        new_nodes=16,
        budgeted=True,
        own_times=False,
        demand_every=8,
        groups=8,
        reserved=0,
        writes=False,
    ),
    WRITE: Rights(
        reads=COMMAND,
        polls=POLL,
        owner_time=1.0,
        new_nodes=64,
        budgeted=True,
        own_times=False,
        demand_every=2,
        groups=32,
        reserved=RESERVED_FOR_WRITERS,
        writes=True,
    ),
    ADMIN: Rights(
        reads=URGENT,
        polls=POLL,
        owner_time=0.0,
        new_nodes=1024,
        budgeted=False,
        own_times=True,
        demand_every=0,
        groups=32,
        reserved=RESERVED_FOR_ADMINS,
        writes=True,
    ),
}


def line_parts() -> dict[str, float]:
    """Return by role, where it has one, the part of the line of all its programs together while the owner waits."""
    return {role.value: 1 / (1 + rights.owner_time) for role, rights in RIGHTS.items() if rights.owner_time}


def table() -> list[str]:
    """Return the lines of the table for the documentation."""
    rows: dict[str, Callable[[Rights], str]] = {
        "reads of the file's nodes": lambda r: r.reads.name,
        "`URGENT`": lambda r: "reads and writes" if r.reads is URGENT else "writes" if r.writes else "no",
        "line time while the owner waits": lambda r: (
            f"1/{1 + r.owner_time:g} for all of the role" if r.owner_time else "takes turns with the owner"
        ),
        "new nodes": lambda r: f"{r.new_nodes}" + (", within the probe budget" if r.budgeted else ""),
        "reply times of a new node": lambda r: "any, up to 5 s" if r.own_times else "at most the protocol's",
        "`demand`": lambda r: f"one cycle in {r.demand_every} periods, for all" if r.demand_every else "yes",
        "own poll groups": lambda r: f"{r.groups}, in {r.polls.name}",
        "reserved connections": lambda r: f"{r.reserved}" if r.reserved else "none",
        "pause, suspend": lambda r: "where it may write" if r.writes else "no",
        "write": lambda r: "yes, or `allow_writes`" if r.writes else "no",
        "exclusive": lambda r: "where it may write" if r.writes else "no",
    }
    head = ["| right | " + " | ".join(f"`{role.value}`" for role in RIGHTS) + " |", "|---|" + "---|" * len(RIGHTS)]
    return head + [
        f"| {name} | " + " | ".join(shown(rights) for rights in RIGHTS.values()) + " |" for name, shown in rows.items()
    ]

"""Whether other programs may use the line of a file, and who."""

from __future__ import annotations

import grp
from dataclasses import dataclass, field

from busmaster.arbiter.clients import LEAST_SHARE, MOST_SHARE
from busmaster.config.recording import read_mode
from busmaster.config.table import Table

MODE = 0o600


@dataclass(frozen=True, slots=True)
class ServiceSection:
    """What `[service]` says: whether a socket is served, its mode, and the number of its group, if it is given one; and
    the share of line time that each program has, where the owner's is 1."""

    enabled: bool
    mode: int
    group: int | None
    share: float
    table: Table = field(compare=False, repr=False)


def read_service(table: Table) -> ServiceSection:
    """Read `[service]`. Raises FileError, naming line and key, for what is wrong in it."""
    table.only("enabled", "mode", "group", "share")
    group = table.text("group", None)
    mode = read_mode(table, "mode") if "mode" in table else MODE if group is None else 0o660
    share = table.number("share", 1.0)
    if not LEAST_SHARE <= share <= MOST_SHARE:
        raise table.error(f"must be {LEAST_SHARE:g} to {MOST_SHARE:g}, not {share:g}", "share")
    number = None if group is None else _number(table, group)
    return ServiceSection(table.flag("enabled", True), mode, number, share, table)


def _number(table: Table, group: str) -> int:
    try:
        return grp.getgrnam(group).gr_gid
    except KeyError:
        raise table.error(f"there is no group {group!r} on this machine", "group") from None

"""`busmaster status`: the lines that run, and how they are."""

from __future__ import annotations

import asyncio
import time
from typing import Any

import click

from busmaster import BusError
from busmaster.app.cli.app import FAILED, OK
from busmaster.app.cli.arguments import json_option
from busmaster.app.cli.ending import until_ended
from busmaster.app.cli.output import Level, columns, emit, emit_all, json_line, note
from busmaster.app.service.folder import Owner, owners
from busmaster.app.service.remote import connect
from busmaster.app.service.values import utc

ANSWER_WITHIN = 2.0
"""Seconds within which the owner of a line must report its state."""
NOT_FOR_US = "not for this user"
REFUSED = {
    "refused_connections": "connections refused",
    "refused_requests": "requests refused",
    "failed_logins": "logins failed",
}
"""What the owner has counted, and how it is named."""


@click.command()
@json_option
def command(as_json: bool) -> int:
    """List the lines that programs of this user serve, and those of the system in /run/busmaster.

    Each line is printed with its name, port, process, number of connected programs, utilisation or "offline", and
    number of nodes that are up. The exit status is 1 if a process does not reply. Lines that this user cannot access
    are marked. Refused connections and failed logins are reported on standard error.
    """
    return until_ended(status, as_json)


async def status(as_json: bool) -> int:
    """Request the state of every line, print it, and return the exit status."""
    lines = await asyncio.gather(*map(ask, owners()))
    if as_json:
        emit_all(json_line(**line) for line in lines)
    elif not lines:
        note("no running line of this user; start one with: busmaster run LINE.toml")
    else:
        emit(*columns([("NAME", "PORT", "PROCESS", "PROGRAMS", "BUSY", "NODES UP"), *map(cells, lines)], {2, 3, 4, 5}))
    for line in () if as_json else lines:
        if text := refused_text(line):
            note(f"{line['name']}: {text}", Level.WARNING)
    return FAILED if any(line["error"] not in (None, NOT_FOR_US) for line in lines) else OK


async def ask(owner: Owner) -> dict[str, Any]:
    """Return the state of a line, or why its owner does not report it."""
    line: dict[str, Any] = {"name": owner.name, "port": owner.port, "address": owner.address, "process": owner.pid}
    line |= {"tcp": None, "programs": None, "utilisation": None, "state": None}
    line |= dict.fromkeys(REFUSED)
    line |= {"up": None, "nodes": None, "error": None}
    line["time"] = utc(time.time())
    try:
        async with asyncio.timeout(ANSWER_WITHIN), connect(owner.address) as remote:
            nodes, line["tcp"] = remote.about["nodes"], remote.about["tcp"]
            line["programs"] = remote.about["clients"] - 1  # without this one
            for count in REFUSED:
                line[count] = remote.about.get(count)
            line["state"] = remote.about.get("state", "ready")
            line["up"] = 0 if line["state"] == "offline" else sum(node["health"] == "up" for node in nodes)
            line["nodes"] = len(nodes)
            line["utilisation"] = (await remote.statistics()).utilisation
    except (BusError, TimeoutError) as error:
        if isinstance(error.__cause__, PermissionError):
            line["error"] = NOT_FOR_US
        else:
            line["error"] = error.what if isinstance(error, BusError) else "no reply from its process"
    return line


def refused_text(line: dict[str, Any]) -> str:
    """Return what the owner of a line has refused since it runs, "" for nothing."""
    return ", ".join(f"{line[count]} {name}" for count, name in REFUSED.items() if line[count])


def cells(line: dict[str, Any]) -> tuple[str, ...]:
    """Return a line as the cells of its row."""
    first = line["name"], line["port"], str(line["process"])
    if line["error"]:
        return *first, "", "", line["error"]
    busy = "offline" if line["state"] == "offline" else f"{line['utilisation']:.1%}"
    return *first, str(line["programs"]), busy, f"{line['up']}/{line['nodes']}"

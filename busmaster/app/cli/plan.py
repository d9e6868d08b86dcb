"""`busmaster plan`: does the schedule of a file fit its line?"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import click

from busmaster import Endpoint, LineSettings, Priority, Rfc2217Port, SerialPort
from busmaster.app.bounds import MOST_CLIENTS
from busmaster.app.cli.app import FAILED, OK
from busmaster.app.cli.arguments import json_option
from busmaster.app.cli.lines import file_argument, load
from busmaster.app.cli.output import columns, emit, emit_all, json_line
from busmaster.app.config import emulated_line
from busmaster.app.line import ConfiguredLine
from busmaster.app.service.rights import line_parts
from busmaster.ext import Bounds, GroupPlan, Losses, Plan

SHOWN = (Priority.URGENT, Priority.COMMAND, Priority.POLL)
SOME = 8
"""Names that are listed."""
HEAD = ("GROUP", "PERIOD", "VALUES", "EXCHANGES", "LINE", "CYCLE", "LONGEST", "MISSED")


@click.command()
@file_argument()
@json_option
def command(path: str, as_json: bool) -> int:
    """Calculate the line load of LINE.toml's poll groups, and suggest periods that fit. The port is not opened.
    The settings of emulated nodes are checked too.

    Reply times are the file's `reply_time`, else half of `late_after`. The exit status is 1 if cycles will be
    missed.
    """
    file = load(path)
    line = ConfiguredLine(file, outputs=False)
    emulated_line(file)  # made only for its errors, which are those of `emulate`
    plan = line.plan()
    section = line.file.service
    shared = bool(section.users or section.groups or section.tokens or section.listen)
    assumed = [name for name, node in line.file.nodes.items() if node.reply_time is None]
    if as_json:
        emit(json_line(**fields(plan), assumed_reply_times=assumed))
    else:
        emit_all(page(f"{line.file.title}: {port_text(line.bus.endpoint, plan.line)}", plan, assumed, shared=shared))
    return OK if plan.fits else FAILED


def page(head: str, plan: Plan, assumed: Sequence[str], *, shared: bool = False) -> list[str]:
    """Return the report: a table of the groups, the waits, schedules that fit, and the `assumed` reply times.

    `shared`: other programs may use the line, so the report includes their shares.
    """
    table = columns([HEAD, *(row(group) for group in plan.groups)], right=range(1, len(HEAD)))
    verdict = "it fits" if plan.fits and not plan.advice else "it barely fits" if plan.fits else "it does not fit"
    share = f"the schedule needs {plan.utilisation:.0%} of the line"
    return [
        head,
        *(table if plan.groups else ["no poll groups"]),
        *((f"{verdict}:", *plan.advice) if plan.advice else (f"{verdict}: {share}",)),
        *(waits_text(plan) if plan.groups else ()),
        *(parts_text(plan) if shared and plan.groups else ()),
        *assumed_text(assumed),
        *([losses_text(plan.losses)] if plan.groups else []),
    ]


def waits_text(plan: Plan) -> Iterator[str]:
    """Yield the typical waits, and then the bounds of R9, which real lines do not reach."""
    yield (
        f"a command waits up to {time_text(plan.typical_wait)} on a healthy line; "
        f"while a dead node is probed all waits are about {time_text(plan.dead_wait)} longer"
    )
    bounds = ", ".join(f"{priority.name.lower()} {time_text(plan.worst_waits[priority])}" for priority in SHOWN)
    yield f"worst case (R9), if every exchange takes its longest possible time: {bounds}"


def parts_text(plan: Plan) -> Iterator[str]:
    """Yield what programs of each role can take of the line from the owner."""
    parts = ", ".join(f"{role} {part:.0%}" for role, part in line_parts().items())
    wait = time_text(plan.worst_waits[Priority.URGENT])
    yield (
        f"while polls wait, all programs of a role together can use of the line: {parts}; a safe write or another "
        f"urgent write of the owner waits for the exchange on the wire, at most {wait}"
    )
    waits = ", ".join(f"{time_text(wait)} with {clients}" for clients, wait in program_waits(plan).items())
    yield f"an urgent write of a program that has not used its share waits at most (by number of programs): {waits}"


def program_waits(plan: Plan) -> dict[int, float]:
    """Return how many seconds an urgent write of a program waits at most (R9), by how many programs are connected."""
    hold = plan.worst_waits[Priority.URGENT]
    return {clients: Bounds(hold, hold, clients=clients).wait(Priority.URGENT) for clients in (1, 8, MOST_CLIENTS)}


def assumed_text(nodes: Sequence[str]) -> Iterator[str]:
    """Yield a line with the nodes whose reply times are assumed, if there are any."""
    if nodes:
        some = ", ".join(nodes[:SOME]) + (f" and {len(nodes) - SOME} more" if len(nodes) > SOME else "")
        yield (
            f"reply times are assumed (half of late_after) for {some}; measure them with `busmaster doctor`, and "
            "set `reply_time`"
        )


def losses_text(losses: Losses) -> str:
    """Return what lost frames would cost, and what learned reply times would spare."""
    shortest, longest = map(time_text, losses.windows)
    windows = f"a window of {shortest}" if shortest == longest else f"windows of {shortest} to {longest}"
    return (
        f"if {losses.share:.0%} of all frames are lost, the schedule needs {losses.documented:.0%} of the line, "
        f'and {losses.learned:.0%} with timing = "learned" ({windows})'
    )


def port_text(endpoint: Endpoint, line: LineSettings) -> str:
    """Return the name and the rate of a port, with the framing of a serial one.

    Behind a TCP port the framing is the server's business.
    """
    framing = f" {line.framing}" if isinstance(endpoint, SerialPort | Rfc2217Port) else ""
    return f"{endpoint.name}, {line.baudrate} baud{framing}"


def row(group: GroupPlan) -> tuple[str, ...]:
    """Return the cells of one group."""
    return (
        group.name,
        time_text(group.period),
        str(group.values),
        str(group.exchanges),
        f"{group.utilisation:.0%}",
        time_text(group.cycle),
        time_text(group.longest_cycle),
        f"{group.missed:.0%}",
    )


def time_text(seconds: float) -> str:
    """Return a time as `2.5 ms` or `1.25 s`, to three digits or to the second; `never` for one that does not end."""
    if not math.isfinite(seconds):
        return "never"
    if seconds >= 999.5:
        return f"{seconds:.0f} s"
    return f"{seconds * 1000:.3g} ms" if seconds < 0.9995 else f"{seconds:.3g} s"


def fields(plan: Plan) -> dict[str, Any]:
    """Return the plan for JSON. Times are in seconds; null stands for what never comes."""
    return {
        "fits": plan.fits,
        "utilisation": plan.utilisation,
        "line": {"baudrate": plan.line.baudrate, "framing": plan.line.framing},
        "groups": [
            {
                "group": group.name,
                "period": group.period,
                "values": group.values,
                "exchanges": group.exchanges,
                "utilisation": group.utilisation,
                "line_time": group.line_time,
                "cycle": finite(group.cycle),
                "longest_cycle": finite(group.longest_cycle),
                "worst_wait": finite(group.worst_wait),
                "worst_cycle": finite(group.worst_cycle),
                "missed": group.missed,
                "achieved": finite(group.achieved),
                "fitting_period": group.fitting_period,
                "merged": [
                    {"node": m.node, "command": m.command, "serves": m.serves, "saved": m.saved} for m in group.merged
                ],
            }
            for group in plan.groups
        ],
        "typical_wait": plan.typical_wait,
        "dead_wait": plan.dead_wait,
        "worst_waits": {priority.name.lower(): finite(wait) for priority, wait in plan.worst_waits.items()},
        "role_parts": line_parts(),
        "program_waits": {str(clients): finite(wait) for clients, wait in program_waits(plan).items()},
        "fitting_baudrate": plan.fitting_baudrate,
        "losses": {
            "share": plan.losses.share,
            "utilisation": plan.losses.documented,
            "learned_utilisation": plan.losses.learned,
            "learned_windows": plan.losses.windows,
        },
        "advice": list(plan.advice),
    }


def finite(number: float) -> float | None:
    """Return the number, None for one that is not finite."""
    return number if math.isfinite(number) else None

"""`busmaster run`: poll what a file says, with its outputs."""

from __future__ import annotations

import sys

import click

from busmaster.cli.arguments import View, viewed
from busmaster.cli.capturing import capture_option, capturing
from busmaster.cli.ending import until_ended
from busmaster.cli.lines import file_argument, load, other_port, port_option
from busmaster.cli.output import note
from busmaster.cli.watching import Watch, follow
from busmaster.config import ConfiguredLine
from busmaster.outputs.base import OutputStatistics

SWITCH_INTERVAL = 0.0005
"""Seconds for which an output's thread may keep the interpreter from the loop that owns the line; else it is 5 ms."""


@click.command(short_help="Poll what a file says, with its outputs.")
@file_argument()
@port_option
@capture_option
@viewed
def command(path: str, port: str | None, capture: str | None, view: View) -> int:
    """Poll the groups of LINE.toml until Ctrl-C, and feed the outputs that it enables.

    On a terminal a live table; else, or with --plain, a line a value; with --json a line a cycle. A summary on
    standard error ends it: of groups, of nodes, and of what each output has written and dropped. An output that is
    slow or down never holds up the line.
    """
    file = load(path)
    endpoint = other_port(file, port)
    where = endpoint or file.port
    protocols = {node.protocol for node in file.nodes.values()}
    only = protocols.pop() if len(protocols) == 1 else ""
    usual = sys.getswitchinterval()
    click.get_current_context().call_on_close(lambda: sys.setswitchinterval(usual))
    sys.setswitchinterval(SWITCH_INTERVAL)
    with capturing(capture, port=where.name, protocol=only, echo=where.echo) as recorder:
        return until_ended(run, ConfiguredLine(file, port=endpoint, tap=recorder, read_only=view.read_only), view)


async def run(line: ConfiguredLine, view: View) -> int:
    entered = False
    try:
        async with line:
            entered = True
            watch = Watch(line.bus, line.file.title, view, gate=line.gate)
            if not line.groups:
                note("nothing is polled: the file has no [groups.NAME]")
            for group in line.groups.values():
                watch.add(group)
            line.outputs.tell = watch.announce
            return await follow(watch)
    finally:
        for counts in line.outputs.statistics() if entered else ():
            note(output_text(counts))


def output_text(counts: OutputStatistics) -> str:
    text = f"{counts.kind}: {counts.written} {counts.what}, {counts.dropped} dropped"
    return f"{text}, down: {counts.error}" if counts.error else text

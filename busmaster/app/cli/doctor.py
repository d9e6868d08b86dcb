"""`busmaster doctor`: diagnosis of a port, an adapter or a line, with advice."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace

import click

from busmaster import LineSettings, endpoint
from busmaster.app.cli.arguments import Connection, json_option, nodes_option, nodes_to_ask
from busmaster.app.cli.capturing import capture_option, capturing
from busmaster.app.cli.ending import until_ended
from busmaster.app.cli.output import emit_all, json_line, note
from busmaster.app.cli.parsing import Whole, option_type, parse_window, parsed
from busmaster.app.cli.protocols import protocol_option
from busmaster.app.diagnostics.adapters import Finding
from busmaster.app.diagnostics.examination import Patient, examine
from busmaster.app.service.values import utc
from busmaster.ext import documented

FAILED = 1
TOPIC = 10
"""Columns of a finding's topic."""
USUAL = LineSettings(9600)
"""Line settings of the port if neither a protocol nor the user defines them."""


@click.command()
@click.argument("port")
@protocol_option(required=False)
@nodes_option
@click.option("--baud", type=Whole(min=1), metavar="N", help="Baud rate; the protocol's by default.")
@click.option("--echo", is_flag=True, help="The adapter receives its own transmissions (two-wire).")
@click.option("--timeout", type=option_type(parse_window), metavar="MS", help="The reply window, in milliseconds.")
@json_option
@capture_option
def command(
    port: str,
    protocol: str | None,
    nodes: tuple[int, ...] | None,
    baud: int | None,
    echo: bool,
    timeout: float | None,
    as_json: bool,
    capture: str | None,
) -> int:
    """Examine PORT and, with --protocol, the nodes on it. Each problem is printed with advice.

    Only reads are sent, and nothing while another program holds the port or another master is active. All addresses of
    the protocol are tried unless --nodes names some.
    """
    patient = patient_of(Connection(port, protocol or "", baud, echo, timeout), nodes)
    wrong = 0

    def report(finding: Finding) -> None:
        nonlocal wrong
        wrong += not finding.ok
        emit_all([json_line(**asdict(finding), time=utc(time.time()))] if as_json else lines_of(finding))

    name = patient.endpoint.name
    with capturing(capture, port=name, protocol=protocol or "", echo=patient.endpoint.echo) as recorder:
        until_ended(examine, patient, report, recorder)
    if wrong:
        note(f"{name}: {wrong} thing{'' if wrong == 1 else 's'} to fix")
        return FAILED
    return 0


def patient_of(connection: Connection, nodes: Sequence[int] | None) -> Patient:
    """Return the examination defined by the options. Raises UsageError."""
    from busmaster.app.cli.progress import Bar  # it takes a fifth of the time of --help

    if connection.protocol:
        where = parsed(lambda _: connection.endpoint(), connection.port)
        addresses = nodes_to_ask(connection.profile, nodes)
        return Patient(where, connection.protocol, documented(connection.timings), addresses, nodes is not None, Bar)
    if nodes is not None:
        raise click.UsageError("--nodes needs the protocol of the nodes; add --protocol P")
    settings = USUAL if connection.baud is None else replace(USUAL, baudrate=connection.baud)
    where = parsed(lambda port: endpoint(port, defaults=settings), connection.port)
    return Patient(replace(where, echo=True) if connection.echo else where, progress=Bar)


def lines_of(finding: Finding) -> Iterator[str]:
    """Yield the lines of a finding, the first behind its mark.

    The mark is `ok`; `note`: in order, but could be better; `FAIL`: not in order.
    """
    mark = "FAIL" if not finding.ok else "note" if finding.advice else "ok"
    yield f"{mark:4}  {finding.topic:{TOPIC}}  {finding.what}"
    if finding.advice:
        yield f"{'':4}  {'':{TOPIC}}  -> {finding.advice}"

"""`busmaster safe`: send a file's safe state alone, as after a crash."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager

import anyio
import click

from busmaster import BusError, Endpoint, InvalidCommand
from busmaster.app.cli.app import FAILED, OK
from busmaster.app.cli.capturing import capture_option, capturing
from busmaster.app.cli.ending import until_ended
from busmaster.app.cli.lines import file_argument, keep, load, other_port, port_option
from busmaster.app.cli.output import Level, emit, note
from busmaster.app.cli.reaching import RECORD_THERE, owner_of, print_owner
from busmaster.app.line import ConfiguredLine
from busmaster.app.service.record import WriteRecord
from busmaster.app.service.remote import RemoteBus, connect
from busmaster.app.service.values import event_text
from busmaster.capture import Recorder
from busmaster.events import BusEvent, PortFailed, Stream


@click.command()
@file_argument()
@port_option
@capture_option
def command(path: str, port: str | None, capture: str | None) -> int:
    """Send the writes that [safe] in LINE.toml lists, urgently, read each back, and print `POINT ok`.

    Nothing is polled. Afterwards the outputs log the writes. Points that were not confirmed within the file's time are
    printed on standard error, and the exit status is 1. If the port cannot be opened, the command prints the reason and
    retries during that time. The writes are sent even if --capture cannot record them.

    If another busmaster owns the line and has the same [safe], it sends the writes, and the line continues afterwards.
    """
    file = load(path)
    if not file.safe.writes:
        raise click.UsageError(f"{path} has no safe state; define its writes in [safe]")
    endpoint = other_port(file, port)
    where = endpoint or file.port
    owner = owner_of(where)
    with recorded(None if owner else capture, where) as recorder:
        line = ConfiguredLine(file, port=endpoint, outputs=False, tap=recorder, wait_for_port=True)
        if owner is None:
            return until_ended(leave, line)
        if capture is not None:
            note(f"{owner.port} {RECORD_THERE}", Level.WARNING)
        print_owner(owner)
        return until_ended(leave_through, connect(owner.address, safe_only=True), line.safe_state.values)


@contextmanager
def recorded(capture: str | None, endpoint: Endpoint) -> Iterator[Recorder | None]:
    """Yield the recorder of `capturing`; None, after a message, if recording is not possible. The stop continues."""
    with ExitStack() as recording:
        recorder = None
        try:
            recorder = recording.enter_context(capturing(capture, port=endpoint.name, echo=endpoint.echo))
        except click.UsageError as error:
            note(error.format_message(), Level.WARNING)
        yield recorder


async def leave_through(remote: RemoteBus, values: Mapping[str, float]) -> int:
    """Have the program that owns the line send its safe state, which is to be this one, and return the exit status."""
    async with remote:
        return print_outcomes(await remote.enter_safe_state(values))


async def leave(line: ConfiguredLine) -> int:
    """Send the safe state, print each point that was confirmed, and return the exit status."""
    records: list[WriteRecord] = []
    line.authorisation.record = records.append
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(print_port_events, line.bus.events())
        async with line.bus:
            outcomes = await line.safe_state.enter(line.authorisation, "busmaster safe")
    status = print_outcomes(outcomes)
    # only now: no output, be it broken, is in the way of a stop
    try:
        await keep(line.audit(note), records)
    except InvalidCommand as error:
        note(f"these writes are not in the audit log: {error}", Level.WARNING)
    return status


async def print_port_events(events: Stream[BusEvent]) -> None:
    """Report on standard error why the port cannot be opened, until the bus is closed."""
    async for event in events:
        if isinstance(event, PortFailed):
            note(event_text(event), Level.ERROR)


def print_outcomes(outcomes: Mapping[str, BusError | None]) -> int:
    """Print each point that was confirmed, name each that was not, and return the exit status."""
    for name, error in outcomes.items():
        if error is None:
            emit(f"{name} ok")
    return print_unsafe(outcomes)


def print_unsafe(outcomes: Mapping[str, BusError | None]) -> int:
    """Name each point that was not confirmed on standard error, and return the exit status."""
    unsafe = {name: error for name, error in outcomes.items() if error is not None}
    for name, error in unsafe.items():
        note(f"safe state of {name} not confirmed: {error}", Level.CRITICAL)
    return FAILED if unsafe else OK

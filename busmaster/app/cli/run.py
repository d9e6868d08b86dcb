"""`busmaster run`: poll the groups of a file, and feed its outputs."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio
import click

from busmaster import InvalidCommand, Service, ext
from busmaster.app.cli.app import FAILED, OK
from busmaster.app.cli.arguments import View, viewed
from busmaster.app.cli.audit_log import AuditLog
from busmaster.app.cli.capturing import capture_option, capturing
from busmaster.app.cli.ending import Ending, until_ended
from busmaster.app.cli.hangups import Hangups
from busmaster.app.cli.lines import file_argument, load, other_port, port_option
from busmaster.app.cli.output import Level, note, number_text
from busmaster.app.cli.plan import losses_text
from busmaster.app.cli.reaching import check_no_owner
from busmaster.app.cli.safe import print_unsafe
from busmaster.app.cli.systemd import ServiceManager
from busmaster.app.cli.watching import Watch, follow
from busmaster.app.config import LineFile
from busmaster.app.line import ConfiguredLine
from busmaster.app.outputs.base import OutputStatistics
from busmaster.app.service.folder import line_name

SWITCH_INTERVAL = 0.0005
"""Seconds for which an output's thread may keep the interpreter from the loop that owns the line; else it is 5 ms."""
WORTH_PRINTING = 0.005
"""Share of the line that learned reply times must save to be suggested."""
CLOSE_WITHIN = 2.0
"""Seconds, beyond those of the safe state, in which a second signal does not end the process where it stands."""


def secrets_of(file: LineFile) -> dict[str, bytes]:
    """Return the digests of the tokens with which programs may come to a line. Raises FileError, as their file does."""
    return file.service.secrets() if file.service.enabled else {}


def service_of(line: ConfiguredLine) -> Service | None:
    """Return the service of the line for other programs; None if its file disables that."""
    section = line.file.service
    if not section.enabled:
        return None
    name = line_name(os.path.basename(line.file.path).removesuffix(".toml"))
    return Service(
        line.bus,
        authorisation=line.authorisation,
        name=name,
        mode=section.mode,
        group=section.group,
        share=section.share,
        listen=section.listen,
        title=line.file.title,
    )


@asynccontextmanager
async def served(service: Service | None, *, announce: bool) -> AsyncIterator[Service | None]:
    """Serve a line, and yield its service; None if that is not possible. The line runs in any case.

    With `announce`, the addresses are printed.
    """
    if service is None:
        yield None
        return
    try:
        await service.__aenter__()
    except InvalidCommand as error:
        note(f"no other program can use this line: {error}", Level.WARNING)
        yield None
        return
    try:
        if announce:
            by_tcp = "" if service.tcp_address is None else f" and {service.tcp_address}"
            note(f"{service.line.title} is served at {service.address}{by_tcp}", Level.NOTICE)
        yield service
    finally:
        await service.__aexit__(None, None, None)


@click.command()
@file_argument()
@port_option
@capture_option
@viewed
def command(path: str, port: str | None, capture: str | None, view: View) -> int:
    """Poll the groups of LINE.toml until a signal arrives, and feed the enabled outputs.

    On a terminal, the command shows a live table. Otherwise, or with --plain, it prints a line for each value, and with
    --json for each cycle. Standard error gets each write from outside with its result, and at the end a summary of
    groups, nodes and outputs. A slow or failed output never delays the line. If the port is missing, the command waits
    for it. SIGHUP reloads the file.

    At the end, whatever the reason, the writes of the file's [safe] are sent first. The exit status is 1 if one was not
    confirmed; else 0 after SIGTERM, 130 after Ctrl-C, and 128 plus its number after another signal.
    """
    with Hangups() as hangups:  # first of all: by default SIGHUP ends a process
        return run(path, port, capture, view, hangups)


def run(path: str, port: str | None, capture: str | None, view: View, hangups: Hangups) -> int:
    """Run the line of a file until a signal, and return the exit status."""
    file = load(path)
    endpoint = other_port(file, port)
    where = endpoint or file.port
    check_no_owner(where)
    protocols = {node.protocol for node in file.nodes.values()}
    only = protocols.pop() if len(protocols) == 1 else ""
    usual = sys.getswitchinterval()
    context = click.get_current_context()
    context.call_on_close(lambda: sys.setswitchinterval(usual))
    sys.setswitchinterval(SWITCH_INTERVAL)
    with capturing(capture, port=where.name, protocol=only, echo=where.echo) as recorder:
        line = ConfiguredLine(file, port=endpoint, tap=recorder, wait_for_port=True, read_only=view.read_only)
        line.authorisation.take_secrets(secrets_of(file))
        running = Running(
            line,
            path,
            view,
            hangups,
            ending := context.find_object(Ending),
        )
        if ending is not None:
            ending.patience = running.line.safe_state.within + CLOSE_WITHIN
        try:
            with AuditLog(running.watch.may_print):
                status = until_ended(running.run)
        except (KeyboardInterrupt, SystemExit) as ended:
            stopped = isinstance(ended, SystemExit) and ended.code == 128 + signal.SIGTERM
            if running.left_safely and not stopped:
                raise
            status = OK  # SIGTERM is the normal end of a service
        return status if running.left_safely else FAILED


class Running:
    """One line of a file that runs until a signal. `left_safely`: whether its safe state was confirmed."""

    def __init__(self, line: ConfiguredLine, path: str, view: View, hangups: Hangups, ending: Ending | None) -> None:
        self.line = line
        self.left_safely = True
        self._leaving = False
        self._path = path
        self._view = view
        self._hangups = hangups
        self._ending = ending
        self.watch = Watch(line.bus, line.file.title, view, authorisation=line.authorisation, steady=True, of_file=True)
        self._manager = ServiceManager()

    async def run(self) -> int:
        """Run the line until a signal, send its safe state, and return the exit status."""
        entered = False
        self.line.outputs.report = self._print_output_event
        service = service_of(self.line)  # now: it keeps what happens as the line is opened
        if service is not None:
            service.report = self._print_refusals
        try:
            async with self.line:
                entered = True
                try:
                    async with served(service, announce=self._view.silent) as self.watch.service:
                        return await self._poll()
                finally:
                    await self._leave()
        finally:
            for counts in self.line.outputs.statistics() if entered else ():
                note(output_text(counts))
            self._manager.close()

    async def _poll(self) -> int:
        for group in self.line.groups.values():
            self.watch.add(group)
        self._print_what_is_polled()
        self._manager.ready()

        async def beside() -> None:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(self._manager.show_life, self.line.bus)
                tasks.start_soon(self._hear_hangups)
                tasks.start_soon(self._print_gain_of_learning)
                try:
                    await anyio.sleep_forever()
                finally:
                    # at once: the screen, or an output that a new file replaces, may take time to end
                    await self._leave()

        return await follow(self.watch, beside)

    def _print_what_is_polled(self) -> None:
        if not self.line.groups:
            note("nothing is polled, because the file has no poll group; add [groups.NAME]", Level.WARNING)
        if self.line.safe_state:
            writes = (f"{write.point.key} = {number_text(write.value)}" for write in self.line.safe_state.writes)
            note(f"safe state at the end: {', '.join(writes)} within {self.line.safe_state.within:g} s")
        else:
            note("no safe state: at the end, nodes keep the values that were written last (see [safe])")

    async def _print_gain_of_learning(self) -> None:
        """Report once how much of the line learned reply times would save, if a node has none."""
        if self.line.groups and any(node.could_learn for node in self.line.file.nodes.values()):
            losses = (await self.line.bus.plan()).losses
            if losses.documented - losses.learned >= WORTH_PRINTING:
                note(losses_text(losses))

    async def _hear_hangups(self) -> None:
        while True:
            await self._hangups.next()
            await self._read_again()

    async def _read_again(self) -> None:
        """Apply the changed file, and reopen the port if its name now belongs to another device.

        An error in the file is reported, and the line continues without changes.
        """
        self._manager.reloading()
        ext.accept_device(self.line.bus)
        try:
            file, secrets = await anyio.to_thread.run_sync(self._checked_file)
            await self.line.take(file, secrets)
        except (InvalidCommand, OSError) as error:
            note(f"reload failed, nothing was changed: {error}", Level.ERROR)
        else:
            if self.watch.service is not None:
                self.watch.service.line.title = file.title
            self.watch.replace_groups(self.line.groups.values())
            note(f"{self._path} was reloaded", Level.NOTICE)
            self._print_what_is_polled()
        self._manager.ready()

    def _checked_file(self) -> tuple[LineFile, dict[str, bytes]]:
        """Load the file and its tokens, and check them.

        Raises OSError, and InvalidCommand with line and key for an error in the file.
        """
        file = load(self._path)
        # made for its complaints alone: `take` wants a file of which a line can be made
        ConfiguredLine(file, port=self.line.bus.endpoint)
        return file, secrets_of(file)

    def _print_output_event(self, text: str) -> None:
        down = any(counts.error for counts in self.line.outputs.statistics())
        self.watch.announce(text, Level.WARNING if down else Level.NOTICE)

    def _print_refusals(self, text: str) -> None:
        """Report what the service refused, unless the screen shows it among the events of the line."""
        if self.watch.may_print():
            note(text, Level.WARNING)

    def _why(self) -> str:
        """Return what ends the run."""
        number = self._ending.number if self._ending is not None else 0
        return signal.Signals(number).name if number else "end of run"

    async def _leave(self) -> None:
        """Send the safe state, once: nothing else is written any more."""
        if self._leaving:
            return
        self._leaving = True
        self._manager.stopping()
        if self.line.safe_state:
            outcomes = await self.line.safe_state.enter(self.line.authorisation, self._why())
            self.left_safely = print_unsafe(outcomes) == OK
            if self.left_safely:
                note(f"safe state confirmed: {', '.join(outcomes)}", Level.NOTICE)


def output_text(counts: OutputStatistics) -> str:
    """Return the line with the counts of an output, and its error if it is down."""
    text = f"{counts.kind}: {counts.written} {counts.what}, {counts.dropped} dropped"
    if counts.suppressed:
        text += f", {counts.suppressed} suppressed"
    if counts.spilled:
        text += f", {counts.spilled} kept on disk for the next run"
    return f"{text}, down: {counts.error}" if counts.error else text

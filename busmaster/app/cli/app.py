"""The group of commands, and how each ends: with what status and which one line."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import logging
import os
import sys
import warnings
from collections.abc import Sequence
from typing import Any, TextIO

import click

from busmaster import BusError, InvalidCommand, NoReply
from busmaster.app.cli.ending import Ending
from busmaster.app.cli.output import Level, note
from busmaster.app.cli.terminal import printable
from busmaster.ext import meant

OK, FAILED, WRONG_USAGE, INTERRUPTED = 0, 1, 2, 130
STATUSES = {
    str(OK): "Success.",
    str(FAILED): "The line, a port or a file failed; one line on standard error states the error and a suggestion.",
    str(WRONG_USAGE): "The usage or a value is wrong, and nothing was sent.",
    str(INTERRUPTED): "Ctrl-C ended it.",
    "128 + N": "Signal N ended it. `run` and `serve` end with 0 after SIGTERM.",
}
"""Exit statuses of all commands. The help of a command states further meanings."""
COMMANDS = {
    "demo": "Show an emulated line of drives, polled live.",
    "read": "Read values of one node, or of a file's points.",
    "write": "Write values of one node, or of a file's points.",
    "do": "Enable, disable or reset a drive.",
    "poll": "Read values of several nodes periodically.",
    "trend": "Sample and plot a few values as fast as the line allows.",
    "scan": "Find the nodes that reply.",
    "discover": "Identify the nodes on an unknown line.",
    "emulate": "Emulate drives on a pseudo-terminal or a TCP port.",
    "run": "Poll the groups of a file, and feed its outputs.",
    "serve": "Run a file's line without a screen, for other programs.",
    "status": "List the running lines of this user.",
    "top": "Show a line of another program, live.",
    "web": "Serve a page and a REST API for a line of another program.",
    "opcua": "Serve a line of another program by OPC UA.",
    "safe": "Send the safe state of a file, and verify it.",
    "check": "Check a file without opening its port.",
    "migrate": "Convert a file of an older version.",
    "plan": "Calculate whether the polls of a file fit its line.",
    "points": "Show the points of a file as a table, or import them from one.",
    "monitor": "Listen to a line and decode its frames.",
    "doctor": "Diagnose a port, an adapter or a line.",
    "bench": "Measure the latency and throughput of a line.",
    "replay": "Decode a capture again, and show differences.",
    "items": "List the items in a protocol's documents.",
    "params": "Save, compare and load the parameters of a node.",
}
"""The commands, each with its line in `busmaster --help`. The module of that name, imported when it is used, has it as
`command`."""
INTERFACES = "busmaster.interfaces"
"""The group of entry points by which a package brings an interface: each names a click command, whose name is that
of the entry. docs/adding-an-interface.md shows a whole one."""


class Commands(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands, in the order of the help: installed interfaces are the last."""
        return [*COMMANDS, *(entry.name for entry in installed_interfaces())]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command and return it; None if there is no such command. Raises UsageError for a broken package."""
        if cmd_name in COMMANDS:
            command = importlib.import_module(f"busmaster.app.cli.{cmd_name}").command
            assert isinstance(command, click.Command)
            command.short_help = COMMANDS[cmd_name]
            return command
        found = [entry for entry in installed_interfaces() if entry.name == cmd_name]
        return loaded_interface(found[0]) if found else None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands in the help, without importing those of this package: that would take most of its time."""
        texts = dict(COMMANDS)
        texts |= {entry.name: loaded_interface(entry).get_short_help_str() for entry in installed_interfaces()}
        with formatter.section("Commands"):
            formatter.write_dl(list(texts.items()))

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command that the arguments name. Raises UsageError with the nearest name for an unknown one."""
        known = self.list_commands(ctx)
        if args and not args[0].startswith("-") and args[0] not in known:
            raise click.UsageError(f"no such command {args[0]!r}; {meant(args[0], known)}", ctx)
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command and return its result, or the exit status for the exception that it raised."""
        try:
            return super().invoke(ctx)
        except (click.ClickException, click.exceptions.Exit, click.Abort):
            raise
        except BaseException as error:
            return status_of(error)


def installed_interfaces() -> list[importlib.metadata.EntryPoint]:
    """Return the entry points of installed interfaces by name. A name that a command of this package has is ignored."""
    entries = importlib.metadata.entry_points(group=INTERFACES)
    return sorted((entry for entry in entries if entry.name not in COMMANDS), key=lambda entry: entry.name)


def loaded_interface(entry: importlib.metadata.EntryPoint) -> click.Command:
    """Import the command of an interface. Raises UsageError if its package is broken.

    `--help` lists all commands, and for a broken package a line with the error.
    """
    package = f" of {entry.dist.name}" if entry.dist is not None else ""
    try:
        command = entry.load()
        if not isinstance(command, click.Command):
            raise TypeError(f"expected a click command, not a {type(command).__name__}")
    except Exception as error:  # another package can raise anything
        why = f"the interface {entry.name!r}{package} cannot be used: {error}; fix or uninstall that package"

        def broken() -> None:
            raise click.UsageError(why)

        return click.Command(entry.name, callback=broken, short_help=why)
    return command


def version(ctx: click.Context, _parameter: click.Parameter, asked: bool) -> None:
    """Print the version and end the command, if --version was given."""
    if asked:
        try:
            number = importlib.metadata.version("busmaster")
        except importlib.metadata.PackageNotFoundError:
            number = "(not installed)"
        click.echo(f"busmaster {number}")
        ctx.exit()


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.option("--version", is_flag=True, expose_value=False, is_eager=True, callback=version, help="Print the version.")
def cli() -> None:
    """One master for many drives on one serial line.

    PORT is a device path, with options as in a URL (/dev/ttyUSB0?baudrate=9600&parity=E), or usb:SERIAL, the USB
    adapter with that serial number. socket://HOST:PORT is a serial server with raw TCP. rfc2217://HOST:PORT is a
    serial server whose line settings are set from here.
    A PORT that another busmaster owns is used through its owner; `busmaster status` lists those. `read`, `write`,
    `poll` and `scan` accept the address of an owner too: unix:PATH, or tcp://HOST:PORT with a token in BUSMASTER_TOKEN.
    """


def run(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the exit status.

    The status is 0 if all is good, 1 after an error from the line, 2 after wrong usage, 130 after Ctrl-C. Never raises.
    """
    listen_quietly()
    print_somewhere()
    try:
        with Ending() as ending:
            result = cli.main(args=arguments, prog_name="busmaster", standalone_mode=False, obj=ending)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message(), err=True)
        return WRONG_USAGE
    except click.UsageError as error:
        return complain(usage_text(error), WRONG_USAGE)
    except click.ClickException as error:
        return complain(error.format_message(), WRONG_USAGE)
    except (click.Abort, KeyboardInterrupt):
        return INTERRUPTED
    except (OSError, SystemExit) as error:  # outside a command: --help prints before one is invoked
        return status_of(error)
    return result if isinstance(result, int) else OK


def print_somewhere() -> None:
    """Discard standard output or standard error if it was closed before the start.

    Otherwise `print` would write the text for the closed stream to the other one.
    """
    if sys.stdout is None or sys.stderr is None:
        nowhere = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  it stays open as long as the process
        sys.stdout, sys.stderr = sys.stdout or nowhere, sys.stderr or nowhere


def listen_quietly() -> None:
    """Keep logs and warnings off standard error, which has one line for an error.

    BUSMASTER_DEBUG=1 shows them.
    """
    if os.environ.get("BUSMASTER_DEBUG"):
        logging.basicConfig(level=logging.DEBUG)
    else:
        logging.getLogger().addHandler(logging.NullHandler())
        warnings.showwarning = show_warning


def show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Print a warning meant for the user as one line on standard error; leave out any other."""
    if issubclass(category, UserWarning):
        print(f"busmaster: warning: {printable(str(message))}", file=file or sys.stderr, flush=True)


def usage_text(error: click.UsageError) -> str:
    """Return the error, with the nearest option or the command's help as a hint."""
    text = error.format_message().rstrip(".").replace(". Did you mean", ": did you mean")
    text = text[:1].lower() + text[1:]
    return text if error.ctx is None or text.endswith("?") else f"{text}; see {error.ctx.command_path} --help"


def complain(text: str, status: int) -> int:
    """Print an error on one line of standard error, and return `status`."""
    note(" ".join(text.split()), Level.ERROR)
    return status


def status_of(error: BaseException) -> int:
    """Print an error on one line, and return the exit status of the process.

    If BUSMASTER_DEBUG=1 is set, an internal error is raised again.
    """
    error = only_one(error)
    match error:
        case KeyboardInterrupt():
            return INTERRUPTED
        case SystemExit():
            return error.code if isinstance(error.code, int) else FAILED
        # an OSError, too: so it comes before that case
        case BrokenPipeError():
            forget_standard_output()
            return OK
        case click.ClickException() | InvalidCommand():
            text = error.format_message() if isinstance(error, click.ClickException) else str(error)
            return complain(text, WRONG_USAGE)
        case BusError():
            return complain(bus_error_text(error), FAILED)
        case OSError():
            if not can_flush():  # a full disk: Python would report the buffered bytes again at exit
                forget_standard_output()
            what = error.strerror or str(error)
            return complain(f"{error.filename}: {what}" if error.filename else what, FAILED)
        case _:
            if os.environ.get("BUSMASTER_DEBUG"):
                raise error
            kind = type(error).__name__
            return complain(f"internal error: {kind}: {error}; set BUSMASTER_DEBUG=1 to see where", FAILED)


def bus_error_text(error: BusError) -> str:
    """Return the text of an error, without the command if only the node matters."""
    if not isinstance(error, NoReply):
        return str(error)
    text = f"{error.label}: {error.what}" if error.label else error.what
    if error.attempts:
        text += f", {error.attempts} attempt{'' if error.attempts == 1 else 's'}"
    return f"{text}; {error.hint}" if error.hint else text


def only_one(error: BaseException) -> BaseException:
    """Unwrap the errors of a task group: Ctrl-C if it is among them, otherwise the first one with a text."""
    while isinstance(error, BaseExceptionGroup):
        interrupts = error.subgroup(KeyboardInterrupt)
        error = (interrupts or error).exceptions[0]
    return error


def can_flush() -> bool:
    """Flush standard output, and return whether that worked."""
    try:
        sys.stdout.flush()
    except OSError:
        return False
    return True


def forget_standard_output() -> None:
    """Redirect standard output to /dev/null, so that Python does not report the unwritten rest at exit.

    The reader has closed the pipe, which is not an error.
    """
    devnull = os.open(os.devnull, os.O_WRONLY)
    os.dup2(devnull, sys.stdout.fileno())
    os.close(devnull)

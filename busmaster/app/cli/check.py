"""`busmaster check`: is a LINE.toml right?"""

from __future__ import annotations

import json

import click

from busmaster.app.cli.app import FAILED, OK
from busmaster.app.cli.arguments import json_option
from busmaster.app.cli.lines import file_argument
from busmaster.app.cli.output import Level, emit, json_line, note
from busmaster.app.config import FileError
from busmaster.app.line import Report, check


def print_schema(context: click.Context, option: click.Parameter, wanted: bool) -> None:
    """Print the JSON Schema of LINE.toml and end the command, which then needs no file."""
    from busmaster.app.config.schema import json_schema  # it reads sources, which no other command needs

    if wanted and not context.resilient_parsing:
        emit(*json.dumps(json_schema(), indent=1).splitlines())
        context.exit(OK)


@click.command()
@file_argument()
@json_option
@click.option(
    "--schema",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=print_schema,
    help="Print the JSON Schema of LINE.toml, for editors, and exit: with the options of every protocol installed.",
)
def command(path: str, as_json: bool) -> int:
    """Check LINE.toml. Everything for which `run` would refuse the file is reported, each problem with its line and its
    key. No port and no output is opened. Files that LINE.toml names are read too: templates, symbols, tokens and
    certificates.

    Problems that only follow from others are reported once those are fixed. Warnings do not change the exit status: it
    is 1 if there are problems.
    """
    report = check(path)
    if as_json:
        emit(json_line(file=path, ok=not report.problems, **fields(report)))
    else:
        show(path, report)
    return FAILED if report.problems else OK


def show(path: str, report: Report) -> None:
    """Print the problems of a file and a verdict, and the warnings on standard error."""
    for warning in report.warnings:
        note(f"warning: {warning}", Level.WARNING)
    count = len(report.problems)
    verdict = f"{count} problem{'' if count == 1 else 's'}" if count else "no problems"
    emit(*map(str, report.problems), f"{path}: {verdict}")


def fields(report: Report) -> dict[str, object]:
    """Return a report as JSON has it."""
    return {"problems": [problem(error) for error in report.problems], "warnings": list(report.warnings)}


def problem(error: FileError) -> dict[str, object]:
    """Return a problem as JSON has it. `line` is null, and `key` "", where it is one of the file as a whole."""
    return {"file": error.file, "line": error.line or None, "key": error.key, "problem": error.what}

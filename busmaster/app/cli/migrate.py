"""`busmaster migrate`: a LINE.toml of an older version."""

from __future__ import annotations

import difflib

import click

from busmaster.app.cli.app import FAILED, OK
from busmaster.app.cli.lines import file_argument
from busmaster.app.cli.output import emit
from busmaster.app.config import migration
from busmaster.app.line.points_taking import write_beside


@click.command()
@file_argument()
@click.option("--write", is_flag=True, help="Change the file. Without this option, the changes are only printed.")
def command(path: str, write: bool) -> int:
    """Give each key of LINE.toml that has another name now its new name. Comments, order and values stay as they are.

    Without --write it prints the changes as a unified diff, and the exit status is 1 if there are any.
    """
    before, after = migration(path)
    if before == after:
        emit(f"{path}: nothing to change")
        return OK
    if not write:
        shown = difflib.unified_diff(before.splitlines(), after.splitlines(), path, f"{path} (new names)", lineterm="")
        emit(*shown)
        return FAILED
    write_beside(path, after)
    changed = sum(old != new for old, new in zip(before.splitlines(), after.splitlines(), strict=True))
    emit(f"{path}: {changed} line{'' if changed == 1 else 's'} changed")
    return OK

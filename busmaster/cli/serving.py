"""The line of a file as a service, while it runs."""

from __future__ import annotations

import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.util import find_spec

from busmaster.cli.output import Level, note
from busmaster.config import ConfiguredLine
from busmaster.errors import InvalidCommand
from busmaster.service.folder import line_name
from busmaster.service.service import Service


@asynccontextmanager
async def served(line: ConfiguredLine, *, tell: bool) -> AsyncIterator[None]:
    """Serve the line to other programs, unless its file says otherwise. One that cannot be served runs all the same.

    Says where it is served if it is to `tell`.
    """
    section = line.file.service
    said = bool(section.table.data)
    if not section.enabled or (find_spec("websockets") is None and not (said or tell)):
        yield
        return
    name = line_name(os.path.basename(line.file.path).removesuffix(".toml"))
    service = Service(line.bus, gate=line.gate, name=name, mode=section.mode, group=section.group, share=section.share)
    try:
        await service.__aenter__()
    except InvalidCommand as error:
        note(f"no other program can use this line: {error}", Level.WARNING)
        yield
        return
    try:
        if tell:
            note(f"{line.file.title} is served at {service.address}", Level.NOTICE)
        yield
    finally:
        await service.__aexit__(None, None, None)

"""The line of a file as a service, while it runs."""

from __future__ import annotations

import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from busmaster import InvalidCommand, Service
from busmaster.app.cli.output import Level, note
from busmaster.app.config import LineFile
from busmaster.app.line import ConfiguredLine
from busmaster.app.service.folder import line_name


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

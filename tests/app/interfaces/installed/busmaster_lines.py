"""An interface that another package brings: each TCP client gets the points of a line as text, and writes by text."""

from __future__ import annotations

import asyncio

import click

from busmaster.app.cli.ending import until_ended
from busmaster.app.cli.interfaces import following, interface_options, place_of
from busmaster.app.cli.output import note
from busmaster.app.interfaces.following import Following
from busmaster.errors import BusError, InvalidCommand

LONGEST = 1000
"""Bytes of one request."""


@click.command(short_help="Serve a line that another program owns as lines of text.")
@interface_options("127.0.0.1:4000")
def command(line: str | None, bind: str, read_only: bool) -> int:
    """Serve a line to TCP clients: `POINT` returns the value of a point, `POINT=NUMBER` writes it."""
    until_ended(serve, following(line, read_only=read_only), *place_of(bind))
    return 0


async def serve(line: Following, host: str, port: int) -> None:
    """Follow the line and serve it, until cancelled."""

    async def client(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while request := (await reader.readline()).decode(errors="replace").strip():
                writer.write(f"{await reply(line, request)}\n".encode())
                await writer.drain()
        except (OSError, ValueError):  # ValueError: the request is longer than LONGEST
            pass
        finally:
            writer.close()

    server = await asyncio.start_server(client, host, port, limit=LONGEST)
    try:
        note(f"listening at {server.sockets[0].getsockname()[1]}")
        await line.follow()
    finally:
        server.close()  # `async with` would wait until each client has left


async def reply(line: Following, request: str) -> str:
    """Return a value, "ok" for a write, or why there is none."""
    key, is_write, number = request.partition("=")
    frame, rows = line.picture.frame, line.picture.rows
    if frame is None or len(rows) < frame.points:  # the first picture is not complete
        return "error: the points are not known yet"
    row = next((row for row in rows if row.key == key), None)
    if row is None:
        return f"error: no point {key!r}"
    try:
        if is_write:
            await line.write(row.group, key, float(number))
            return "ok"
    except (BusError, InvalidCommand, ValueError) as error:
        return f"error: {error}"
    # If the owner is away or stopped, or the last read failed, the row still has the last good value.
    return str(row.value) if line.is_current(row) else f"error: {row.error or 'there is no current value'}"

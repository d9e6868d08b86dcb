"""The session that docs/service.md shows: its messages, sent to a served line, get replies of the same form."""

from __future__ import annotations

import asyncio
import json
import random
import re
from pathlib import Path
from typing import Any

from websockets.asyncio.client import unix_connect

from busmaster import Hcp2Controller, MemoryPort, Service
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine
from busmaster.emulator.line import Line
from busmaster.registry import make_device
from tests.app.service import schema
from tests.patience import PATIENCE

PAGE = (schema.PATH.parent / "service.md").read_text()
LINE = """
port = "/dev/ttyUSB0?baudrate=57600"
[nodes.winder]
protocol = "hcp2"
address = 1
points.speed = { item = "100", factor = 0.1, unit = "m/min" }
points.tension = { item = "10", unit = "N", maximum = 500 }
[groups.fast]
period = 0.2
points = ["winder/speed", "winder/tension"]
"""
SENT, RECEIVED = "-> ", "<- "


def session() -> list[str]:
    [block] = re.findall(r"```text\n((?:-> .*\n|<- .*\n)+)```", PAGE)
    return str(block).splitlines()


def form(value: Any) -> Any:
    """What stays the same from one session to another: names, and the number of values in a list."""
    if isinstance(value, dict):
        return {name: form(part) for name, part in value.items()}
    if isinstance(value, list):
        return [form(part) for part in value]
    return "number" if isinstance(value, int | float) and not isinstance(value, bool) else type(value).__name__


async def replies(folder: Path, said: list[str]) -> list[str]:
    """Send the client's messages one after another, and return each with the messages that come after it."""
    emulated = Line(Hcp2Controller.profile.line, [make_device("hcp2", 1)], chance=random.Random(1))
    line = ConfiguredLine(read(Source("line.toml", LINE)), port=MemoryPort(emulated), outputs=False)
    transcript: list[str] = []
    async with (
        asyncio.timeout(PATIENCE),
        line,
        Service(line.bus, authorisation=line.authorisation, path=folder / "line.sock") as service,
        unix_connect(service.address.removeprefix("unix:"), uri="ws://localhost/", compression=None) as connection,
    ):
        for entry in said:
            if entry.startswith(SENT):
                schema.check_program(json.loads(entry.removeprefix(SENT)))
                await connection.send(entry.removeprefix(SENT))
                transcript.append(entry)
            else:
                wanted = json.loads(entry.removeprefix(RECEIVED))
                key = "id" if "id" in wanted else "method"
                while True:  # a snapshot may come at any time
                    heard = json.loads(await connection.recv())
                    schema.check_owner(heard)
                    if heard.get(key) == wanted[key]:
                        break
                transcript.append(RECEIVED + json.dumps(heard))
    return transcript


def test_the_session_of_the_page_is_what_an_owner_says(tmp_path: Path) -> None:
    said = session()
    heard = asyncio.run(replies(tmp_path, said))
    for shown, real in zip(said, heard, strict=True):
        assert form(json.loads(shown[3:])) == form(json.loads(real[3:])), f"the page shows\n{shown}\nand it was\n{real}"

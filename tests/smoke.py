"""Does an installation work at all? Its main commands and each interface, as processes, with nothing but what is
installed.

`python -m tests.smoke` is run by .ci/run with the lowest versions that pyproject.toml lets in. It needs no pytest: the
lowest versions of that are not our users' affair. It prints each step, and ends with 1 at the first that fails.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

BUSMASTER = (sys.executable, "-m", "busmaster")
WITHIN = 60.0
MOST_SHOWN = 3000
"""Characters of what a command printed that are looked at, and shown where it failed: the last ones."""
LINE = """
title = "Smoke"
port = "socket://127.0.0.1:PORT?baudrate=57600"
[nodes.winder]
protocol = "hcp2"
address = 1
points.force = { item = "10", unit = "N", factor = 0.1 }
[groups.fast]
period = 0.05
points = ["winder/force"]
[outputs.sqlite]
path = "FOLDER/smoke.sqlite"
[outputs.metrics]
host = "127.0.0.1"
port = METRICS
[outputs.mqtt]
host = "127.0.0.1"
port = 9
prefix = "smoke"
[safe]
repeatable = ["winder/force"]
writes = { "winder/force" = 0 }
"""


class Failed(Exception):
    """A step failed: the text says how."""


def step(what: str) -> None:
    sys.stdout.write(f"smoke: {what}\n")
    sys.stdout.flush()


def ran(*arguments: str, status: int = 0, shows: str = "") -> str:
    """What a command printed that ended as it should, without a traceback."""
    step(" ".join(("busmaster", *arguments)))
    done = subprocess.run(
        [*BUSMASTER, *arguments], capture_output=True, text=True, timeout=WITHIN, stdin=subprocess.DEVNULL, check=False
    )
    text = done.stdout + done.stderr
    if done.returncode != status or "Traceback" in text or "Warning" in text or shows not in text:
        raise Failed(f"ended with {done.returncode}, not {status}, or did not show {shows!r}:\n{text}")
    return done.stdout


@contextlib.contextmanager
def runs(*arguments: str, until: str) -> Iterator[str]:
    """A command that runs beside, from what it says; ended with SIGTERM, it must not end badly."""
    step(" ".join(("busmaster", *arguments, "&")))
    with (
        tempfile.NamedTemporaryFile() as said,
        subprocess.Popen([*BUSMASTER, *arguments], stdout=said, stderr=said) as process,
    ):

        def text() -> str:
            return Path(said.name).read_text()[-MOST_SHOWN:]

        try:
            found = wait(
                lambda: re.search(until, text()), lambda: f"{arguments[0]} did not say {until!r}:\n{text()}", process
            )
            yield found[1] if found.re.groups else ""
            if process.poll() is not None:
                raise Failed(f"{arguments[0]} ended by itself with {process.returncode}:\n{text()}")
        finally:
            process.terminate()
            process.wait(WITHIN)
        if "Traceback" in text():
            raise Failed(text())


def wait(
    look: Callable[[], re.Match[str] | None], why: Callable[[], str], process: subprocess.Popen[bytes]
) -> re.Match[str]:
    """What `look` finds at last."""
    over = time.monotonic() + WITHIN
    while time.monotonic() < over and process.poll() is None:
        if found := look():
            return found
        time.sleep(0.1)
    raise Failed(why())


def fetched(url: str, data: bytes | None = None) -> str:
    """What a server replies to GET, or to PUT of this JSON."""
    step(f"{'GET' if data is None else 'PUT'} {url}")
    headers = {"Content-Type": "application/json"}
    request = urllib.request.Request(url, data, headers, method="GET" if data is None else "PUT")
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(request, timeout=WITHIN) as reply:
        return str(reply.read().decode())


def free_port() -> int:
    import socket

    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        return int(bound.getsockname()[1])


def smoke(folder: Path) -> None:
    """Raise Failed for the first thing that does not work."""
    os.environ["XDG_RUNTIME_DIR"] = str(folder)
    port, metrics, opcua = free_port(), free_port(), free_port()
    path = folder / "smoke.toml"
    text = LINE.replace("PORT", str(port)).replace("METRICS", str(metrics)).replace("FOLDER", str(folder))
    path.write_text(text)
    file = str(path)
    ran("--version", shows="busmaster")
    ran("--help", shows="Usage")
    ran("no-such-command", status=2, shows="no-such-command")
    ran("run", status=2, shows="LINE.toml")
    ran("read", "--no-such-option", status=2, shows="--no-such-option")
    ran("check", file)
    ran("plan", file)
    ran("points", file)
    ran("demo", "--seconds", "2")
    with runs("emulate", file, until=f"127.0.0.1:{port}"):
        with runs("serve", file, until=r"is served at (unix:\S+)") as address:
            ran("status", shows="smoke")
            ran("write", address, "--protocol", "hcp2", "--node", "1", "1=12.5", "--verify", shows="ok")
            if "12.5" not in ran("read", address, "--protocol", "hcp2", "--node", "1", "1"):
                raise Failed("the value that was written is not read")
            polled = ("--nodes", "1", "--items", "1", "--period", "0.2", "--seconds", "1")
            if "12.5" not in ran("poll", address, "--protocol", "hcp2", *polled):
                raise Failed("the value that was written is not polled")
            if "busmaster_line_up" not in fetched(f"http://127.0.0.1:{metrics}/metrics"):
                raise Failed("there are no metrics")
            with runs("web", address, "--bind", "127.0.0.1:0", until=r"the page is at (\S+)") as url:
                fetched(url)
                over = time.monotonic() + WITHIN
                while not json.loads(fetched(f"{url}api/line"))["connected"] and time.monotonic() < over:
                    time.sleep(0.2)
                fetched(f"{url}api/points/fast/winder/force", b'{"value": 1.5}')
                followed(url)
            with runs("opcua", address, "--bind", f"127.0.0.1:{opcua}", until="opc.tcp://"):
                browsed(opcua)
            with runs("modbus-tcp", address, "--bind", "127.0.0.1:0", until=r"serving Modbus TCP at (\S+)") as modbus:
                exchanged(modbus)
            remote(address)
        ran("safe", file)
    if not (folder / "smoke.sqlite").stat().st_size:
        raise Failed("nothing was written to SQLite")


def followed(url: str) -> None:
    """A page's stream says something."""
    from websockets.sync.client import connect

    step("the stream of a page")
    with connect(f"{url.replace('http', 'ws')}api/stream") as stream:
        json.loads(stream.recv(timeout=WITHIN))


def browsed(port: int) -> None:
    """A client of OPC UA finds the objects."""
    import asyncio

    from asyncua import Client

    async def browse() -> None:
        async with Client(f"opc.tcp://127.0.0.1:{port}") as client:
            if not await client.nodes.objects.get_children():
                raise Failed("there is nothing in OPC UA")

    step("a client of OPC UA")
    asyncio.run(browse())


def exchanged(address: str) -> None:
    """A client of Modbus TCP gets a reply."""
    import socket

    step("a client of Modbus TCP")
    host, _, port = address.rpartition(":")
    with socket.create_connection((host, int(port)), WITHIN) as client:
        client.sendall(bytes.fromhex("000100000006010300000001"))
        if client.recv(2) != bytes.fromhex("0001"):
            raise Failed("the reply is not to this request")


def remote(address: str) -> None:
    """A program reads through the owner, under anyio; and the full-screen view can be made."""
    import anyio

    from busmaster import Hcp2Controller, connect

    async def read() -> None:
        with anyio.fail_after(WITHIN):
            async with connect(address) as bus:
                await Hcp2Controller(bus, 1).read(1)

    step("a program that connects, and the view")
    anyio.run(read)
    import busmaster.app.cli.live  # noqa: F401


def main() -> int:
    """Run all steps, and return the exit status."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            smoke(Path(folder))
        except (Failed, subprocess.TimeoutExpired, OSError) as error:
            sys.stderr.write(f"smoke: failed: {error}\n")
            return 1
    step("all works")
    return 0


if __name__ == "__main__":
    sys.exit(main())

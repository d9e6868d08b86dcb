"""What each consumer reports while something is gone, by real programs: each cell of docs/monitoring.md's table."""

from __future__ import annotations

import json
import re
import signal
import sqlite3
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import opcua
import pytest
from opcua import ua
from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion
from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException

from tests.app.cli.conftest import ENVIRONMENT, ROOT
from tests.app.outputs.brokers import needs_mosquitto, running
from tests.patience import PATIENCE
from tests.ports import free_port

Cells = dict[str, dict[str, str]]
PAGE = ROOT / "docs" / "monitoring.md"
TEXT = """
title = "Slitter"
port = "{pty}?baudrate=57600"
[nodes.winder]
protocol = "hcp2"
address = 1
points.force = {{ item = "10", unit = "N" }}
[nodes.unwinder]
protocol = "hcp2"
address = 2
[groups.fast]
period = 0.1
points = ["winder/force", "unwinder/10"]
[outputs.sqlite]
path = "{folder}/line.sqlite"
[outputs.mqtt]
port = {broker}
prefix = "slitter"
[outputs.metrics]
port = {metrics}
groups = ["fast"]
"""


def table() -> dict[str, Cells]:
    """What the page says: by situation and consumer, each fact and its value."""
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in PAGE.read_text().partition("## Situations")[2].partition("\n## ")[0].splitlines()
        if line.startswith("|")
    ]
    head, _, *rest = rows
    return {
        row[0]: {
            name: dict(fact.split("=") for fact in re.findall(r"`([^`]+)`", cell))
            for name, cell in zip(head[1:], row[1:], strict=True)
        }
        for row in rest
    }


class Plant:
    """The programs of one line, and what reads each consumer."""

    def __init__(self, folder: Path, broker: int, stack: ExitStack) -> None:
        self.stack = stack
        self.folder = folder
        self.pty = folder / "line"
        self.metrics_port, self.web_port, self.opcua_port = free_port(), free_port(), free_port()
        self.modbus_port, self.modbus_last_port = free_port(), free_port()
        self.file = folder / "slitter.toml"
        self.file.write_text(TEXT.format(pty=self.pty, folder=folder, broker=broker, metrics=self.metrics_port))
        self.environment = {**ENVIRONMENT, "XDG_RUNTIME_DIR": str(folder)}
        self.programs: dict[str, subprocess.Popen[bytes]] = {}
        self.begun = 0.0
        """When the situation began, in seconds since 1970."""
        self.heard: dict[str, Any] = {}
        client = Client(CallbackAPIVersion.VERSION2)
        client.on_message = self._hear
        client.connect("127.0.0.1", broker)
        client.subscribe("slitter/#")
        client.loop_start()
        stack.callback(client.loop_stop)
        self._client: opcua.Client | None = None

    def start(self, name: str, *arguments: str) -> None:
        with (self.folder / f"{name}.log").open("ab") as log:
            process = self.programs[name] = subprocess.Popen(
                [sys.executable, "-m", "busmaster", *arguments],
                cwd=ROOT,
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        self.stack.callback(process.wait, PATIENCE)
        self.stack.callback(process.kill)

    def stop(self, name: str, number: signal.Signals = signal.SIGTERM) -> None:
        self.programs[name].send_signal(number)
        self.programs[name].wait(PATIENCE)

    def drives(self, nodes: str) -> None:
        """Have these drives on the line, and no others; "" takes the port away."""
        if "drives" in self.programs:
            self.stop("drives", signal.SIGKILL)
        if nodes:
            if self.pty.is_symlink():
                self.pty.unlink()
            self.start("drives", "emulate", "--protocol", "hcp2", "--nodes", nodes, "--pty", str(self.pty))

    def run(self) -> None:
        self.start("run", "run", str(self.file), "--plain")

    def interfaces(self) -> None:
        """Start the interfaces, or start them again."""
        self._client = None
        for name, port, command in (
            ("web", self.web_port, ("web",)),
            ("opcua", self.opcua_port, ("opcua",)),
            ("modbus-tcp", self.modbus_port, ("modbus-tcp",)),
            ("modbus-tcp with --last", self.modbus_last_port, ("modbus-tcp", "--last")),
        ):
            if name in self.programs:
                self.stop(name, signal.SIGKILL)
            self.start(name, *command, "slitter", "--bind", f"127.0.0.1:{port}")

    # what each consumer says

    def _hear(self, client: Client, data: object, message: MQTTMessage) -> None:
        text = message.payload.decode()
        self.heard[message.topic] = json.loads(text) if text.startswith("{") else text

    def metrics(self) -> dict[str, str]:
        try:
            text = fetched(f"http://127.0.0.1:{self.metrics_port}/metrics")
        except OSError:
            return {"scrape": "fails"}

        def of(name: str, *labels: str) -> str | None:
            for line in text.splitlines():
                if line.startswith((f"{name}{{", f"{name} ")) and all(label in line for label in labels):
                    return f"{float(line.split()[-1]):g}"
            return None

        point = 'node="winder"', 'item="force"'
        return {
            "line_up": str(of("busmaster_line_up")),
            "node_up": str(of("busmaster_node_up", 'node="winder"')),
            "value_good": str(of("busmaster_value_good", *point)),
            "value": "none" if of("busmaster_value", *point) is None else "shown",
            "time": "none" if of("busmaster_value_time_seconds", *point) is None else "shown",
        }

    def rest(self) -> dict[str, str]:
        def get(path: str) -> Any:
            return json.loads(fetched(f"http://127.0.0.1:{self.web_port}/api/{path}"))

        line, nodes, points = get("line"), get("nodes"), get("points")
        [point] = [one for one in points if one["key"] == "winder/force"]
        [node] = [one for one in nodes if one["label"] == "winder"]
        return {
            "state": "offline" if not line["connected"] else line["frame"]["state"],
            "health": node["health"],
            "quality": point["quality"],
            "why": "said" if line["why"] and line["since"] else "none",
        }

    def opc_ua(self) -> dict[str, str]:
        if self._client is None:
            client = opcua.Client(f"opc.tcp://127.0.0.1:{self.opcua_port}/", timeout=PATIENCE)
            client.connect()
            self.stack.callback(client.disconnect)
            self._client = client

        def read(name: str) -> Any:
            assert self._client is not None
            wanted = ua.ReadValueId()
            wanted.NodeId = ua.NodeId.from_string(f"ns={3 if ' ' in name else 2};s={name}")
            wanted.AttributeId = ua.AttributeIds.Value
            asked = ua.ReadParameters()
            asked.NodesToRead.append(wanted)
            [told] = self._client.uaclient.read(asked)
            return told

        health = read("Nodes/hcp2 1 Health")
        return {
            "connected": str(read("Line Connected").Value.Value),
            "health": health.Value.Value if health.StatusCode.is_good() else health.StatusCode.name,
            "value": read("winder/force").StatusCode.name,
        }

    def modbus_tcp(self) -> dict[str, str]:
        def read(port: int, first: int, count: int) -> list[int] | str:
            client: Any = ModbusTcpClient("127.0.0.1", port=port, timeout=PATIENCE, retries=0)
            with closing(client):
                if not client.connect():
                    raise OSError("nothing listens")
                reply = client.read_holding_registers(first, count=count)
            return f"exception {reply.exception_code}" if reply.isError() else list(reply.registers)

        def shown(registers: list[int] | str) -> str:
            return registers if isinstance(registers, str) else "shown"

        last, status = read(self.modbus_last_port, 0, 5), read(self.modbus_last_port, 4, 1)
        return {
            "value": shown(read(self.modbus_port, 0, 4)),
            "last": shown(last),
            "status": status if isinstance(status, str) else str(status[0]),
        }

    def mqtt(self) -> dict[str, str]:
        heard = self.heard
        return {
            "status": heard["slitter/status"],
            "line": heard["slitter/line"]["line"],
            "health": heard["slitter/health/winder"]["health"],
            "quality": heard["slitter/values/winder/force"]["quality"],
        }

    def sqlite(self) -> dict[str, str]:
        with closing(sqlite3.connect(f"file:{self.folder}/line.sqlite?mode=ro", uri=True)) as database:
            moment, quality = database.execute(
                "select time, quality from history where item = 'force' order by time desc limit 1"
            ).fetchone()
        return {"quality": quality, "rows": "go on" if moment > self.begun else "end"}

    def shows(self, situation: str, cells: Cells) -> None:
        """Wait until each consumer says what the page says of the situation."""
        measures = {
            "metrics": self.metrics,
            "REST": self.rest,
            "OPC UA": self.opc_ua,
            "Modbus TCP": self.modbus_tcp,
            "MQTT": self.mqtt,
            "SQLite": self.sqlite,
        }
        assert measures.keys() == cells.keys()
        for name, facts in cells.items():
            assert facts, f"the page says nothing of {name} while {situation}"
            self._is_so(f"{name} while {situation}", facts, measures[name])

    def _is_so(self, what: str, facts: dict[str, str], measure: Callable[[], dict[str, str]]) -> None:
        end, seen = time.monotonic() + PATIENCE, dict[str, str]()
        while time.monotonic() < end:
            try:
                seen = measure()
            except (OSError, KeyError, ValueError, TypeError, sqlite3.Error, ua.UaError, ModbusException) as starting:
                seen = {"no answer": repr(starting)}
            if {fact: seen.get(fact) for fact in facts} == facts:
                return
            time.sleep(0.05)
        raise AssertionError(f"{what}: {seen}, and not {facts}")


def fetched(url: str) -> str:
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(url, timeout=PATIENCE) as answer:
        text: str = answer.read().decode()
    return text


@contextmanager
def plant(folder: Path) -> Iterator[Plant]:
    with running(folder) as broker, ExitStack() as stack:
        yield Plant(folder, broker.port, stack)


@pytest.mark.slow
@needs_mosquitto
def test_every_consumer_reports_each_situation_as_the_page_says(tmp_path: Path) -> None:
    said = table()
    with plant(tmp_path) as line:
        shows = {name: partial(line.shows, name, cells) for name, cells in said.items()}

        def now(situation: str) -> None:
            line.begun = time.time()
            shows.pop(situation)()

        calm = shows["all is well"]
        line.drives("1-2")
        line.run()
        line.interfaces()
        now("all is well")
        line.drives("")
        now("the line is lost")
        line.drives("2")
        now("the drive is dead")
        line.drives("1-2")
        calm()
        line.interfaces()
        now("the interface was restarted")
        line.stop("run")
        now("the owner was stopped")
        summary = (tmp_path / "run.log").read_text()
        assert re.search(r"line: [1-9]\d* disconnects?, offline for [\d.]+ s", summary), summary
        assert re.search(r"fast: .* [1-9]\d* of \d+ values not read", summary), summary
        line.run()
        calm()
        line.stop("run", signal.SIGKILL)
        now("the owner is gone")
        assert not shows, "situations of the page that were not tried"

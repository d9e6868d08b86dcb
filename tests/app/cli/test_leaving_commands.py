"""Commands that stream in while `run` ends: whoever was answered is on record. A real mosquitto, a real SIGTERM."""

from __future__ import annotations

import json
import signal
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.app.cli.conftest import serve, started
from tests.app.outputs.brokers import Broker, needs_mosquitto, running
from tests.patience import PATIENCE

pytestmark = needs_mosquitto

TEXT = """
port = "PORT?baudrate=57600"
[nodes.winder]
protocol = "hcp2"
address = 1
[groups.fast]
period = 0.05
points = ["winder/10"]
[safe]
within = 1.0
repeatable = ["winder/10"]
writes = { "winder/10" = 1.5 }
[outputs.sqlite]
path = "FOLDER/line.sqlite"
[outputs.jsonl]
path = "FOLDER/line.jsonl"
[outputs.mqtt]
port = BROKER
prefix = "line"
allow_commands = ["winder/10"]
"""
UNDER_WAY = 40
"""Commands that are sent and not answered yet, at any moment."""
LAST = "the last one"


class Commander:
    """Sends a command for each that is answered, with ids that count, and keeps all that it is told."""

    def __init__(self, port: int) -> None:
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion

        self.answers: dict[str, dict[str, Any]] = {}
        self.audit: dict[str, dict[str, Any]] = {}
        self.is_busy = threading.Event()
        """Set when so many were answered as are under way."""
        self._heard_all = threading.Event()
        self._sent = 0
        self._client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTProtocolVersion.MQTTv5)
        self._client.on_message = self._heard
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()

    def begin(self) -> None:
        """Begin when `run` listens, as its status says: what is sent before that is lost."""
        self._client.subscribe([("line/result/#", 1), ("line/audit", 1), ("line/status", 1), (LAST, 1)])

    def end(self) -> None:
        """Wait until all is heard that was sent to it before."""
        self._client.publish(LAST, qos=1)
        assert self._heard_all.wait(PATIENCE)
        self._client.disconnect()
        self._client.loop_stop()

    def _send(self) -> None:
        self._sent += 1
        self._client.publish("line/set/winder/10", json.dumps({"value": self._sent % 100, "id": self._sent}), qos=1)

    def _heard(self, _client: object, _data: object, message: Any) -> None:
        if message.topic == LAST:
            self._heard_all.set()
            return
        if message.topic == "line/status":
            for _ in range(UNDER_WAY if message.payload == b"online" else 0):
                self._send()
            return
        said = json.loads(message.payload)
        if message.topic == "line/audit":
            self.audit[said["id"]] = said
            return
        self.answers[said["id"]] = said
        self._send()
        if len(self.answers) >= UNDER_WAY:
            self.is_busy.set()


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    with running(tmp_path) as found:
        yield found


@pytest.mark.slow
def test_every_command_that_is_answered_while_a_run_ends_is_on_record(broker: Broker, tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    with serve("hcp2", 1) as winder:
        path.write_text(
            TEXT.replace("PORT", winder.path).replace("BROKER", str(broker.port)).replace("FOLDER", str(tmp_path))
        )
        with started("run", str(path), "--plain") as process:
            assert process.stdout is not None
            process.stdout.readline()
            commander = Commander(broker.port)
            commander.begin()
            assert commander.is_busy.wait(PATIENCE)
            process.send_signal(signal.SIGTERM)
            _, err = process.communicate(timeout=PATIENCE)
    commander.end()
    assert process.returncode == 0, err
    kept = [json.loads(line) for line in (tmp_path / "line.jsonl").read_text().splitlines()]
    with closing(sqlite3.connect(tmp_path / "line.sqlite")) as database:
        rows = {
            mark: (outcome, error) for mark, outcome, error in database.execute("select id, outcome, error from audit")
        }
    in_lines = {line["id"]: (line["outcome"], line["error"]) for line in kept if "write" in line}
    on_mqtt = {mark: (said["outcome"], said["error"]) for mark, said in commander.audit.items()}
    told = {mark: (said["ok"], said.get("error")) for mark, said in commander.answers.items()}
    for where, records in {"sqlite": rows, "jsonl": in_lines, "mqtt": on_mqtt}.items():
        found = {mark: (records[mark][0] == "written", records[mark][1]) for mark in told if mark in records}
        assert found == told, f"{len(told) - len(found)} of {len(told)} answered commands are not in {where}"

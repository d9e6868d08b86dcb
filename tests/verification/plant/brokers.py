"""A mosquitto that can be killed, stopped and made to refuse, and somebody who keeps all that comes from it."""

from __future__ import annotations

import json
import signal
import subprocess
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from tests.app.outputs.brokers import MOSQUITTO
from tests.ports import free_port
from tests.verification.plant.programs import until

PREFIX = "plant"
MARKER = "marker"
"""What the subscriber says to itself: it has then heard all that was said before."""
TOPICS = ("status", "line", "health/#", "values/#", "cycles/#", "events", "audit", "result/#", MARKER)
ALL = 0
"""Stands for no limit in mosquitto's settings."""


class Heard(NamedTuple):
    """`when` is by the machine's steady clock."""

    when: float
    topic: str
    payload: Any


class Broker:
    """One mosquitto, on a port that it keeps. With `refusing` it lets nobody in."""

    def __init__(self, folder: Path) -> None:
        self.port = free_port()
        self._config = folder / "mosquitto.conf"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, refusing: bool = False) -> None:
        assert MOSQUITTO is not None
        self._config.write_text(
            f"listener {self.port} 127.0.0.1\nallow_anonymous {'false' if refusing else 'true'}\n"
            f"max_queued_messages {ALL}\nmax_inflight_messages {ALL}\nuser root\n"
        )
        self._process = subprocess.Popen(
            [MOSQUITTO, "-c", str(self._config)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

    @property
    def runs(self) -> bool:
        return self._process is not None

    def send(self, number: signal.Signals) -> None:
        assert self._process is not None
        self._process.send_signal(number)

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


class Subscriber:
    """Hears all that comes from `run`, and may send commands."""

    def __init__(self, port: int) -> None:
        self.heard: list[Heard] = []
        self._port = port
        self._subscribed = threading.Event()
        self._client: Client | None = None

    def connect(self) -> None:
        """Return when nothing more is missed. The connection before, if any, is gone."""
        self.close()
        self._subscribed.clear()
        client = self._client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTProtocolVersion.MQTTv5)
        client.max_inflight_messages_set(1000)
        client.max_queued_messages_set(ALL)
        client.on_message = self._note
        client.on_connect = self._subscribe
        client.on_subscribe = lambda *_: self._subscribed.set()
        until(self._connects, "the broker lets us in")
        client.loop_start()
        until(self._subscribed.is_set, "the broker has noted what we want to hear")

    def _connects(self) -> bool:
        assert self._client is not None
        try:
            self._client.connect("127.0.0.1", self._port)
        except OSError:
            return False
        return True

    def _subscribe(self, client: Client, *_: object) -> None:
        client.subscribe([(f"{PREFIX}/{topic}", 1) for topic in TOPICS])

    def _note(self, client: Client, data: object, message: MQTTMessage) -> None:
        if message.retain:
            return  # it was said before we came
        try:
            payload = json.loads(message.payload)
        except (ValueError, RecursionError):
            payload = message.payload.decode(errors="replace")
        self.heard.append(Heard(time.monotonic(), message.topic.removeprefix(f"{PREFIX}/"), payload))

    def send(self, name: str, payload: str | bytes, expires_in: int | None = None, topic: str = "") -> None:
        """Send a command. Returns as soon as it is on its way."""
        assert self._client is not None
        properties = None
        if expires_in is not None:
            properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]  # the library's
            properties.MessageExpiryInterval = expires_in
        self._client.publish(topic or f"{PREFIX}/set/{name}", payload, qos=1, properties=properties)

    def answer(self, mark: str) -> dict[str, Any]:
        """Wait for what became of the command with this id."""
        found: list[dict[str, Any]] = []

        def answered() -> bool:
            found[:] = [
                heard.payload
                for heard in self.heard[:]
                if heard.topic.startswith("result")
                and isinstance(heard.payload, dict)
                and heard.payload.get("id") == mark
            ]
            return bool(found)

        until(answered, f"command {mark} is answered")
        return found[0]

    def catch_up(self) -> None:
        """Return when all is heard that the broker had by now."""
        since = time.monotonic()
        self.send("", "", topic=f"{PREFIX}/{MARKER}")
        until(lambda: bool(self.since(since, MARKER)), "what we say comes back to us")

    def since(self, moment: float, topic: str = "") -> list[Heard]:
        return [heard for heard in self.heard[:] if heard.when >= moment and heard.topic.startswith(topic)]

    def close(self) -> None:
        if self._client is not None:
            self._client.disconnect()
            self._client.loop_stop()
            self._client = None

"""Commands that the file does not permit. They arrive on a connection of their own, which is read slowly.

Theory of operation. A broker has one queue for each connection, and keeps its order. On one connection, permitted
commands would wait behind a flood of others, and reading that flood fast would take the interpreter from the line. So
the main connection subscribes to the permitted topics, and this one to all topics. Here a message is acknowledged only
after a pause. Further messages wait at the broker, or are dropped by it.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any

import anyio

from busmaster.app.outputs.mqtt_connection import Secrets, taking_in
from busmaster.app.outputs.settings import MqttSettings

if TYPE_CHECKING:
    from paho.mqtt.client import Client, MQTTMessage

REST = 0.001
"""Seconds from one message to the next."""
AHEAD = 20
"""Messages that the broker may send before we have acknowledged the first."""


class Forbidden:
    """Receive, in a thread of its own, all commands except to `allowed` topics; `take` gets each on the caller's loop.

    `lost` is done when the connection has ended.
    """

    def __init__(
        self,
        settings: MqttSettings,
        secrets: Secrets,
        topic: str,
        allowed: frozenset[str],
        take: Callable[[MQTTMessage], object],
    ) -> None:
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion

        self._loop = asyncio.get_running_loop()
        self._subscribed: asyncio.Future[None] = self._loop.create_future()
        self._unsubscribed: asyncio.Future[None] = self._loop.create_future()
        self.lost: asyncio.Future[None] = self._loop.create_future()
        self._over = threading.Event()
        self._settings = settings
        self._topic = topic
        self._allowed = allowed
        self._take = take
        self._client: Client = Client(
            CallbackAPIVersion.VERSION2, protocol=MQTTProtocolVersion.MQTTv5, reconnect_on_failure=False
        )
        username, password, tls = secrets
        if username is not None:
            self._client.username_pw_set(username, password)
        if tls is not None:
            self._client.tls_set_context(tls)
        self._client.on_connect = self._ask
        self._client.on_message = self._receive
        self._client.on_subscribe = lambda *_: self._run_on_loop(partial(_done, self._subscribed))
        self._client.on_unsubscribe = lambda *_: self._run_on_loop(partial(_done, self._unsubscribed))
        self._client.on_disconnect = lambda *_: self._run_on_loop(partial(_done, self.lost))

    async def begin(self, keep_alive: int, within: float) -> None:
        """Return when the subscription is active. Raises OSError, including ConnectionError, if that fails."""
        connect = partial(self._client.connect, self._settings.host, self._settings.port, keep_alive)
        await anyio.to_thread.run_sync(partial(connect, properties=taking_in(AHEAD)), abandon_on_cancel=True)
        self._client.loop_start()
        await asyncio.wait({self._subscribed, self.lost}, timeout=within, return_when=asyncio.FIRST_COMPLETED)
        if not self._subscribed.done():
            broker = f"{self._settings.host}:{self._settings.port}"
            raise ConnectionError(f"{broker} did not accept a second connection with a subscription to {self._topic}")

    async def end(self) -> None:
        """Unsubscribe, and return when the messages sent so far have been handled."""
        self._client.unsubscribe(self._topic)
        await asyncio.wait({self._unsubscribed, self.lost}, return_when=asyncio.FIRST_COMPLETED)

    def close(self) -> None:
        """End the connection, without waiting for its thread."""
        self._over.set()
        self._client.disconnect()

    # on its thread

    def _ask(self, client: Client, *_: Any) -> None:
        client.subscribe(self._topic, qos=1)

    def _receive(self, _client: Client, _data: Any, message: MQTTMessage) -> None:
        if message.topic not in self._allowed:
            self._run_on_loop(partial(self._take, message))
        self._over.wait(REST)  # it is acknowledged when this returns

    def _run_on_loop(self, call: Callable[[], object]) -> None:
        with suppress(RuntimeError):  # that loop has ended
            self._loop.call_soon_threadsafe(call)


def _done(future: asyncio.Future[None]) -> None:
    if not future.done():
        future.set_result(None)

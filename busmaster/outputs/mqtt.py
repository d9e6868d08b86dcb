"""MQTT: values and health out, and, where the file allows it, commands in.

    PREFIX/values/NODE/ITEM   {"time": ..., "value": 12.5, "unit": "mm", "error": null, "late": false}
    PREFIX/cycles/GROUP       a whole cycle, as `busmaster run --json` prints it (messages = "cycle")
    PREFIX/health/NODE        {"time": ..., "health": "up"}, retained
    PREFIX/line               {"time": ..., "line": "ready"}, retained; "offline" while the port is gone
    PREFIX/alarms/NODE/ITEM   {"time": ..., "alarm": "high"}, "low" or null, of points with limits; retained
    PREFIX/events             {"time": ..., "node": "winder", "text": "winder is down, was suspect"}
    PREFIX/status             online, or offline, which is also the last will; retained

    PREFIX/set/NODE/ITEM      a number, or several as a JSON list, to be written; or {"value": 12.5, "id": "a1",
                              "expires": 1767225600}, of which value alone must be said
    PREFIX/result/NODE/ITEM   {"ok": true}, or {"ok": false, "error": "..."}, with the command's id if it has one
    PREFIX/audit              each write, by whatever door: who, what, when, what became of it

In names +, # and % are written %2B, %23 and %25. A command is written within a second of its arrival, or by `expires`
or the message's own expiry where it has one; an older one is refused. Times are seconds since 1970. What was not
acknowledged when the broker went away is sent again when it is back. With `spill`, what waits for it does so on disk,
and is sent by the next process if this one ends before.
"""

from __future__ import annotations

import asyncio
import logging
import sqlite3
import ssl
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import anyio

from busmaster.arbiter.state import LineState
from busmaster.bus.bus import Bus
from busmaster.bus.points import Point
from busmaster.bus.polling import Snapshot
from busmaster.errors import InvalidCommand
from busmaster.gate.gate import Gate, Wish
from busmaster.gate.record import WriteRecord
from busmaster.outputs.base import BATCH, PAUSE, TICK, Item, Output, check_extra, reason, size_of
from busmaster.outputs.mqtt_commands import Answer, Commands, Inbox
from busmaster.outputs.settings import MqttSettings
from busmaster.outputs.spool import Record, Spool
from busmaster.outputs.values import cycle_fields, json_line, micros, sample_fields, write_fields

if TYPE_CHECKING:
    from aiomqtt import Client, Message

AT_ONCE = 100
"""Messages on their way to the broker, not yet acknowledged."""
PIECE = 10
BREATH = 0.002
"""Seconds for which the interpreter is let go of after so many messages: when a broker returns, thousands may wait."""
TIMEOUT = 5.0
"""Seconds in which a broker must answer."""
KEEP_ALIVE = 15
SPILL_EVERY = 0.2
"""Seconds between two movings of what waits to disk, while the broker is away."""
ALARMS = "alarms/"
HURRY = 2.0
"""Seconds from the wish to end until what could not be sent goes to disk."""


class Outgoing(NamedTuple):
    topic: str
    payload: str
    retain: bool = False


class MqttOutput(Output):
    """`commands` are the points, by their key, that may be written. Raises InvalidCommand if the extra is missing."""

    def __init__(
        self,
        kind: str,
        settings: MqttSettings,
        bus: Bus,
        say: Callable[[str], None] = lambda _: None,
        *,
        commands: Mapping[str, Point[Any]] | None = None,
        gate: Gate | None = None,
    ) -> None:
        check_extra("aiomqtt", "mqtt")
        super().__init__(kind, settings, say)
        self._settings = settings
        self._secrets = secrets(settings)
        self._bus = bus
        self._gate = gate or Gate(bus)
        self._commands = {topic_part(key): point for key, point in (commands or {}).items()}
        self._arriving: Commands
        self._owner: asyncio.AbstractEventLoop | None = None
        self._held: list[Item] = []
        self._spool: Spool | None = None
        if settings.spill is not None:
            self._spool = Spool(settings.spill, settings.spill_values, say)
            self.offered = self.spilled = self._spool.values  # of the last time
        self._spool_error = ""
        self._published: dict[str, str | None] = {}
        self._alarms: object = None
        """Those that were told last."""
        self._quiet = logging.getLogger("busmaster.mqtt")
        self._quiet.addHandler(logging.NullHandler())
        self._quiet.propagate = False

    def start(self) -> None:
        self._owner = asyncio.get_running_loop()
        super().start()

    def close(self, within: float) -> None:
        super().close(within)
        # A thread that hangs may be in the midst of it.
        if self._spool is not None and not self._thread.is_alive():
            self._spool.close()

    # on the thread

    def work(self) -> None:
        """Publish until it is stopped. What is left in memory then goes to disk, if it may."""
        asyncio.run(self._in_time())

    def rest(self, seconds: float) -> None:
        """Wait so many seconds, or until it is stopped. What comes while the broker is away goes to disk, if it may."""
        over = time.monotonic() + seconds
        while not self._stop.is_set() and time.monotonic() < over:
            self._put_by()
            self._stop.wait(min(SPILL_EVERY, seconds))

    async def _in_time(self) -> None:
        """Publish until it is stopped.

        Whatever happens, what is left in memory is on disk when this ends, if it may: before the process does.
        """
        try:
            async with anyio.create_task_group() as tasks:
                if self._spool is not None:
                    tasks.start_soon(self._hurry, tasks.cancel_scope)
                await self._connected()
                tasks.cancel_scope.cancel()
        finally:
            self._put_by()

    async def _hurry(self, scope: anyio.CancelScope) -> None:
        """Give up on a broker that does not answer when all is to end: it is not waited for to the last moment."""
        while not self._stop.is_set():  # noqa: ASYNC110  # another thread sets it
            await anyio.sleep(TICK)
        await anyio.sleep(HURRY)
        scope.cancel()

    def _put_by(self) -> None:
        """Move what waits from memory to disk. What the disk does not take stays where it is, which is told once."""
        while self._spool is not None and self._fill(BATCH):
            values = sum(map(size_of, self._held))
            try:
                lost = self._spool.put(self._records())
            except sqlite3.Error as error:
                if str(error) != self._spool_error:
                    self._spool_error = str(error)
                    self._say(f"{self.kind}: {self._spool.path}: {error}")
                return
            self._held.clear()
            self.spilled += values - lost
            self.lost += lost
            self._spool_error = ""

    def _records(self) -> Iterator[Record]:
        for item in self._held:
            by_cycle = isinstance(item, Snapshot) and self._settings.messages == "cycle"
            for topic, payload, retain in self._messages(item):
                yield Record(topic, payload, retain, size_of(item) if by_cycle else 1)
            if not self._stop.is_set():
                time.sleep(PAUSE)

    async def _send_spilled(self, client: Client) -> None:
        """Send all that is on disk; what comes meanwhile goes behind it. When all is to end the rest stays there."""
        while self._spool is not None and self.spilled and not self._stop.is_set():
            up_to, records = self._spool.oldest(AT_ONCE)
            await self._send(client, (Outgoing(topic, payload, retain) for topic, payload, retain, _ in records))
            values = sum(record.values for record in records)
            self._spool.remove(up_to, values)  # only now: what is lost before it was acknowledged is sent again
            self.written += values
            self.spilled = self._spool.values
            self._put_by()

    async def _connected(self) -> None:
        async with self._client() as client, anyio.create_task_group() as tasks:
            self._published.clear()
            self._alarms = None
            await self._send(client, [Outgoing(self._topic("status"), "online", True)])
            self.up()
            if self._commands:
                await client.subscribe(self._topic("set/#"), qos=1)
            tasks.start_soon(self._listen, client)
            tasks.start_soon(self._arriving.serve, self._write, self._keep, partial(self._answer, client))
            stopped = False
            while not stopped:
                stopped = self._stop.is_set()  # looked at first, so that a last round sends what waits
                await self._send(client, list(self._changes()))
                await self._send_spilled(client)
                # What is on disk is older: nothing in memory may overtake it.
                while not self.spilled and self._fill(AT_ONCE):
                    await self._send(client, (message for item in self._held for message in self._messages(item)))
                    self.written += sum(map(size_of, self._held))
                    self._held.clear()
                await anyio.sleep(0 if stopped else TICK)
            await self._send(client, [Outgoing(self._topic("status"), "offline", True)])
            tasks.cancel_scope.cancel()

    def _client(self) -> Client:
        import aiomqtt

        settings = self._settings
        username, password, tls = self._secrets
        self._arriving = Commands(settings.prefix, self._gate, self._commands, self._bus.now)
        client = aiomqtt.Client(
            settings.host,
            settings.port,
            protocol=aiomqtt.ProtocolVersion.V5,
            queue_type=cast("type[asyncio.Queue[Message]]", partial(Inbox, self._arriving)),
            username=username,
            password=password,
            tls_context=tls,
            will=aiomqtt.Will(self._topic("status"), "offline", qos=1, retain=True),
            keepalive=KEEP_ALIVE,
            timeout=TIMEOUT,
            max_inflight_messages=AT_ONCE,
            logger=self._quiet,
        )
        client.pending_calls_threshold = AT_ONCE  # above it aiomqtt logs a warning, and so many are meant
        return client

    async def _send(self, client: Client, messages: Iterable[Outgoing]) -> None:
        """Send the messages in order, and acknowledged at QoS 1. Raises what went wrong first."""
        under_way: deque[asyncio.Task[None]] = deque()
        try:
            for number, (topic, payload, retain) in enumerate(messages, 1):
                work = client.publish(topic, payload, qos=self._settings.qos, retain=retain)
                under_way.append(asyncio.ensure_future(work))
                if number % PIECE == 0:
                    await anyio.sleep(BREATH)
                if len(under_way) == AT_ONCE:
                    await under_way.popleft()
            while under_way:
                await under_way.popleft()
        finally:
            for task in under_way:
                task.cancel()
            await asyncio.gather(*under_way, return_exceptions=True)

    def _fill(self, most: int) -> bool:
        """Hold up to `most` values, and return whether there are any. What was not acknowledged comes first."""
        size = sum(map(size_of, self._held))
        while size < most and (item := self.take()) is not None:
            self._held.append(item)
            size += size_of(item)
        return bool(self._held)

    def _messages(self, item: Item) -> Iterator[Outgoing]:
        settings = self._settings
        if isinstance(item, WriteRecord):
            yield Outgoing(self._topic("audit"), json_line(**write_fields(item)))
        elif not isinstance(item, Snapshot):
            payload = json_line(time=item.time, node=item.node or None, text=item.text)
            yield Outgoing(self._topic("events"), payload)
        elif settings.messages == "cycle":
            payload = json_line(**cycle_fields(item, item.wall_at))
            yield Outgoing(self._topic("cycles", item.group), payload, settings.retain)
        else:
            for point, sample in item.samples.items():
                payload = json_line(time=micros(sample.wall), unit=point.unit, **sample_fields(sample))
                yield Outgoing(self._topic("values", topic_part(point.key)), payload, settings.retain)

    def _changes(self) -> Iterator[Outgoing]:
        """Yield what is not as it was when it was told last. Only attributes that are replaced whole are looked at."""
        now: dict[str, tuple[str, str | None]] = {
            "line": ("line", "offline" if self._bus.state is LineState.OFFLINE else "ready")
        }
        for node in self._bus.nodes:
            now[f"health/{topic_part(node.label.removeprefix('node '))}"] = ("health", node.health.value)
        alarms = self._bus.alarms
        if alarms is not self._alarms:
            self._alarms = alarms
            now |= {topic: ("alarm", None) for topic in self._published if topic.startswith(ALARMS)}
            for point, alarm in alarms.items():
                now[f"{ALARMS}{topic_part(point.key)}"] = ("alarm", None if alarm is None else alarm.limit)
        for topic, (name, state) in now.items():
            if self._published.get(topic, "") != state:
                self._published[topic] = state
                payload = json_line(**{"time": round(time.time(), 3), name: state})
                yield Outgoing(self._topic(topic), payload, True)

    def _topic(self, *parts: str) -> str:
        return "/".join((self._settings.prefix, *parts))

    # commands

    async def _listen(self, client: Client) -> None:
        """Raise MqttError when the broker goes away, also while there is nothing to send."""
        async for _ in client.messages:
            raise AssertionError("messages are taken in as they arrive")

    async def _write(self, wish: Wish) -> WriteRecord:
        """Write it on the loop that owns the line."""
        assert self._owner is not None
        return await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(self._gate.write(wish), self._owner))

    def _keep(self, wish: Wish, error: str) -> None:
        """Put on record, on that loop too, what was refused."""
        assert self._owner is not None
        self._owner.call_soon_threadsafe(self._gate.refuse, wish, error)

    async def _answer(self, client: Client, answer: Answer) -> None:
        topic = self._topic("result", answer.name) if answer.name else self._topic("result")
        await self._send(client, [Outgoing(topic, json_line(**answer.fields))])


def topic_part(name: str) -> str:
    """Return the name without what has a meaning in topics. Two names stay two."""
    return name.replace("%", "%25").replace("+", "%2B").replace("#", "%23")


def secrets(settings: MqttSettings) -> tuple[str | None, str | None, ssl.SSLContext | None]:
    """Return user name, password and TLS context. Raises InvalidCommand for a file that cannot be read."""
    password = tls = None
    try:
        if settings.password_file is not None:
            with open(settings.password_file, encoding="utf-8") as file:
                password = file.read().strip()
        if settings.tls:
            tls = ssl.create_default_context(cafile=settings.ca_file)
    except OSError as error:
        raise InvalidCommand(reason(error)) from None
    return settings.username, password, tls

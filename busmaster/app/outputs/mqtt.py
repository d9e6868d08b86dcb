"""MQTT: values and health out and, if the file permits them, commands in.

    PREFIX/values/NODE/ITEM   {"time": ..., "value": 12.5, "unit": "mm", "quality": "good", "error": null,
                              "late": false}, and again, with "stale" or "bad", after a write, or when the line is lost
    PREFIX/cycles/GROUP       a whole cycle, as `busmaster run --json` prints it (messages = "cycle")
    PREFIX/health/NODE        {"time": ..., "health": "up"}, retained
    PREFIX/line               {"time": ..., "line": "ready", "reason": null}, retained; "offline" while the port is gone
    PREFIX/alarms/NODE/ITEM   {"time": ..., "alarm": "high"}, "low" or null, of a bit "set", "clear" or null; retained
    PREFIX/events             {"time": ..., "node": "winder", "text": "winder is down, was suspect"}
    PREFIX/status             online, or offline, which is also the last will; retained
    HOME/.../config           discovery messages of Home Assistant, with home_assistant = "HOME"; retained

    PREFIX/set/NODE/ITEM      a number, or several as a JSON list, to write; or {"value": 12.5, "id": "a1",
                              "expires": 1767225600}, in which only value is required
    PREFIX/result/NODE/ITEM   {"ok": true}, or {"ok": false, "error": "..."}, with the command's id if it has one
    PREFIX/audit              each write, by any interface: source, value, time and outcome

In names +, # and % are written %2B, %23 and %25. A command is written within a second of its arrival, or by `expires`
or the message's own expiry if it has one; an older one is refused. Commands that the file does not permit arrive on a
connection of their own, so that a flood of them does not delay the permitted ones. Times are seconds since 1970.
Messages without an acknowledgement when the broker is lost are sent again when it is back. With `spill`, unsent
messages are stored on disk, and the next process sends them if this one ends before.
"""

from __future__ import annotations

import asyncio
import json
import logging
import socket
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from functools import partial
from math import inf
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, cast

import anyio
from anyio.abc import TaskStatus

from busmaster import Bus, LineState, Point, Sample, Snapshot, ext
from busmaster.app.bounds import LONGEST_TOPIC
from busmaster.app.outputs.base import PAUSE, TICK, Item, OutputKind, OutputLine, Unsuitable, check_extra, size_of
from busmaster.app.outputs.home_assistant import HomeAssistant
from busmaster.app.outputs.mqtt_commands import Answer, Commands, Inbox
from busmaster.app.outputs.mqtt_connection import secrets, taking_in, topic_part, unread
from busmaster.app.outputs.mqtt_forbidden import Forbidden
from busmaster.app.outputs.settings import MqttSettings
from busmaster.app.outputs.spilling import HURRY, SpillingOutput
from busmaster.app.outputs.spool import Record
from busmaster.app.service.authorisation import Authorisation, WriteRequest
from busmaster.app.service.record import WriteRecord
from busmaster.app.service.values import cycle_fields, json_line, micros, sample_fields, write_fields

if TYPE_CHECKING:
    from aiomqtt import Client, Message

AT_ONCE = 100
"""Messages on their way to the broker, not yet acknowledged."""
UNREAD = 32_768
"""Approximate number of bytes in our socket; further commands wait at the broker. Behind many commands in a socket of
megabytes, the last would expire."""
AHEAD = 2_000
"""Commands that the broker may send before we have acknowledged the first; its own acknowledgements overtake the rest.
More than fit in our socket: one that it held back while we stood still would look new when it comes."""
PIECE = 10
BREATH = 0.002
"""Seconds for which the interpreter is let go of after so many messages: when a broker returns, thousands may wait."""
TIMEOUT = 5.0
"""Seconds in which a broker must answer, or send whatever else."""
KEEP_ALIVE = 15
ALARMS = "alarms/"
COMMANDS = "set/#"
UNSUPPORTED_VERSION = 132
"""Reason code of a broker that only supports MQTT 3.1.1, or the client's replacement for it."""
LAST_ANSWERS = 2.0
"""Seconds for replies to the commands received so far, when no more are accepted."""
MARGIN = 1.0
"""Seconds, beyond those, for a thread that does not get on: who does not answer then never will."""


class Outgoing(NamedTuple):
    topic: str
    payload: str
    retain: bool = False


class MqttOutput(SpillingOutput):
    """`commands`: the points, by their key, that may be written. Raises InvalidCommand if the extra is missing.

    Without `in_charge`, it does not report the state of the line and its nodes, nor its own. Without `asks`, it reports
    itself and its samples, but not the state of line and nodes, because that is unknown without requests.
    """

    finds_outdated: ClassVar[bool] = True

    def __init__(
        self,
        kind: str,
        settings: MqttSettings,
        bus: Bus,
        report: Callable[[str], None] = lambda _: None,
        *,
        commands: Mapping[str, Point[Any]] | None = None,
        authorisation: Authorisation | None = None,
        in_charge: bool = True,
        asks: bool = True,
    ) -> None:
        check_extra("aiomqtt", "mqtt")
        super().__init__(kind, settings, report)
        self._settings = settings
        self._secrets = secrets(settings)
        self._bus = bus
        self._authorisation = authorisation or Authorisation(bus)
        self._in_charge = in_charge
        self._asks = asks
        self._commands = {topic_part(key): point for key, point in (commands or {}).items()}
        self._home: HomeAssistant | None = None
        if settings.home_assistant is not None and in_charge:
            self._home = HomeAssistant(
                settings.home_assistant, settings.prefix, self._commands, reports_line=self._asks
            )
        self._announced: set[str] = set()
        """Topics, below `prefix`, of which Home Assistant was informed on this connection."""
        self._arriving: Commands
        self._leaving = threading.Event()
        self._interface_is_closed = threading.Event()
        self._interface_is_closed.set()
        self._owner: asyncio.AbstractEventLoop | None = None
        self._held: list[Item] = []
        self._published: dict[str, str | None] = {}
        self._seen: object = None
        """The last write, and whether the line was there, when values were last looked at."""
        self._alarms: object = None
        """The alarms that were reported last."""
        self._quiet = logging.getLogger("busmaster.mqtt")
        self._quiet.addHandler(logging.NullHandler())
        self._quiet.propagate = False

    def start(self) -> None:
        self._owner = asyncio.get_running_loop()
        super().start()

    def close_interface(self) -> None:
        self._leaving.set()
        self._interface_is_closed.wait(LAST_ANSWERS + MARGIN)

    # on the thread

    def work(self) -> None:
        """Publish until it is stopped."""
        self.open_spool()
        asyncio.run(self._in_time())

    async def _in_time(self) -> None:
        async with anyio.create_task_group() as tasks:
            if self._spool is not None:
                tasks.start_soon(self._hurry, tasks.cancel_scope)
            await self._connected()
            tasks.cancel_scope.cancel()

    async def _hurry(self, scope: anyio.CancelScope) -> None:
        """Give up on a broker that does not answer when all is to end: it is not waited for to the last moment."""
        while not self._stop.is_set():  # noqa: ASYNC110  # another thread sets it
            await anyio.sleep(TICK)
        await anyio.sleep(HURRY)
        scope.cancel()

    def records(self) -> Iterator[Record]:
        """Yield the messages of the queued items, each in its form on disk."""
        for item in self._held:
            by_cycle = isinstance(item, Snapshot) and self._settings.messages == "cycle"
            # Without announcements: they are not values, and each connection begins with its own.
            for message in self._messages(item, announce=False):
                yield Record(json.dumps(message), size_of(item) if by_cycle else 1)
            if not self._stop.is_set():
                time.sleep(PAUSE)

    def let_go(self) -> int:
        """Hold nothing any more, and return how many values were held."""
        size = sum(map(size_of, self._held))
        self._held.clear()
        return size

    def put_back(self) -> None:
        """Have the held items wait again."""
        held, self._held = self._held, []
        self.wait_again(held)

    async def _send_spilled(self, client: Client) -> None:
        """Send all that is on disk. When all is to end the rest stays there."""
        while self._spool is not None and self.spilled and not self._stop.is_set():
            up_to, records = self._spool.oldest(AT_ONCE)
            await self._send(client, (Outgoing(*json.loads(record.content)) for record in records))
            self.forwarded(up_to, records)  # only now: messages that are lost before the acknowledgement are sent again

    async def _connected(self) -> None:
        async with self._connection() as client, anyio.create_task_group() as tasks:
            self._published.clear()
            self._announced.clear()
            self._alarms = self._seen = None  # messages of the last connection can be lost, so all is sent again
            tasks.start_soon(self._listen, client)
            await tasks.start(self._serve, client)
            await self._send(client, self._status("online"))
            self.up()
            stopped = False
            while not stopped:
                stopped = self._stop.is_set()  # looked at first, so that a last round sends what waits
                await self._send(client, list(self._changes()))
                await self._send_spilled(client)
                # The values on disk are older: nothing in memory may overtake them.
                while not self.spilled and self.hold(AT_ONCE):
                    await self._send(client, (message for item in self._held for message in self._messages(item)))
                    self.written += self.let_go()
                await self._send(client, list(self._outdated()))  # after the cycles that these values are of
                await anyio.sleep(0 if stopped else TICK)
            await self._send(client, list(self._farewell()))
            await self._send(client, self._status("offline"))
            tasks.cancel_scope.cancel()

    @asynccontextmanager
    async def _connection(self) -> AsyncIterator[Client]:
        """Connect for the block. Raises ConnectionError, in words, where there is no broker that will do."""
        import aiomqtt

        broker = f"{self._settings.host}:{self._settings.port}"
        async with AsyncExitStack() as stack:
            unconnected = self._client()
            stack.callback(self._arriving.report_unanswered)  # at the very end
            try:
                client = await stack.enter_async_context(unconnected)
            except aiomqtt.MqttCodeError as error:
                if getattr(error.rc, "value", error.rc) == UNSUPPORTED_VERSION:
                    raise ConnectionError(f"{broker} does not support MQTT 5, which this output needs") from None
                raise
            except aiomqtt.MqttError as error:
                if "timed out" in str(error):
                    raise ConnectionError(f"{broker} did not reply within {TIMEOUT:g} s; it needs MQTT 5") from None
                raise
            yield client

    def _client(self) -> Client:
        import aiomqtt

        settings = self._settings
        username, password, tls = self._secrets
        self._arriving = Commands(
            settings.prefix,
            self._authorisation,
            self._commands,
            self._bus.now,
            lambda text: self._report(f"{self.kind}: {text}"),
        )
        client = aiomqtt.Client(
            settings.host,
            settings.port,
            protocol=aiomqtt.ProtocolVersion.V5,
            queue_type=cast("type[asyncio.Queue[Message]]", partial(Inbox, self._arriving)),
            username=username,
            password=password,
            tls_context=tls,
            will=aiomqtt.Will(self._topic("status"), "offline", qos=1, retain=True) if self._in_charge else None,
            keepalive=KEEP_ALIVE,
            properties=taking_in(AHEAD),
            socket_options=[(socket.SOL_SOCKET, socket.SO_RCVBUF, UNREAD)],
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
                work = client.publish(topic, payload, qos=self._settings.qos, retain=retain, timeout=inf)
                under_way.append(asyncio.ensure_future(work))
                if number % PIECE == 0:
                    await anyio.sleep(BREATH)
                if len(under_way) == AT_ONCE:
                    await self._acknowledged(under_way.popleft())
            while under_way:
                await self._acknowledged(under_way.popleft())
        finally:
            for task in under_way:
                task.cancel()
            await asyncio.gather(*under_way, return_exceptions=True)

    async def _acknowledged(self, publishing: asyncio.Task[None]) -> None:
        """Return when it is. Raises ConnectionError where the broker sends nothing at all for too long.

        Commands that come are a life sign, too: an acknowledgement may have to wait behind thousands of them.
        """
        done = publishing.done()
        while not done:
            heard = self._arriving.bytes_read
            done = bool((await asyncio.wait({publishing}, timeout=TIMEOUT))[0])
            if not done and self._arriving.bytes_read == heard:
                publishing.cancel()
                raise ConnectionError(f"{self._settings.host}:{self._settings.port} did not reply within {TIMEOUT:g} s")
        await publishing

    def hold(self, most: int) -> bool:
        """Hold up to `most` values, and return whether there are any. Unacknowledged messages come first."""
        size = sum(map(size_of, self._held))
        while size < most and (item := self.take()) is not None:
            self._held.append(item)
            size += size_of(item)
        return bool(self._held)

    def _messages(self, item: Item, *, announce: bool = True) -> Iterator[Outgoing]:
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
            # Not of an older cycle, such as one that waited for the broker: that is history.
            current = any(
                group.latest is not None and (group.name, group.latest.cycle) == (item.group, item.cycle)
                for group in self._bus.groups
            )
            for point, sample in item.samples.items():
                if announce:
                    yield from self._announce_value(point, sample)
                yield self._value(point, self._bus.as_of_now(point, sample) if current else sample)

    def _announce_value(self, point: Point[Any], sample: Sample[Any]) -> Iterator[Outgoing]:
        """Yield the announcement of a point for Home Assistant, before its first value, which shows its type."""
        if self._home is not None and point.key not in self._announced and sample.error is None:
            self._announced.add(point.key)
            for config in self._home.value(point, sample.value):
                yield Outgoing(*config, True)

    def _announce(self, topic: str, alarms: Mapping[str, Point[Any]]) -> Iterator[Outgoing]:
        """Yield what Home Assistant must know of a topic of the line, a node or an alarm before its first message."""
        if self._home is None or topic in self._announced:
            return
        self._announced.add(topic)
        kind, _, name = topic.partition("/")
        if topic in alarms:
            config = self._home.alarm(alarms[topic])
        else:
            config = self._home.health(name) if kind == "health" else self._home.line()
        yield Outgoing(*config, True)

    def _value(self, point: Point[Any], sample: Sample[Any]) -> Outgoing:
        payload = json_line(time=micros(sample.wall), unit=point.unit, **sample_fields(sample))
        return Outgoing(self._topic("values", topic_part(point.key)), payload, self._settings.retain)

    def _outdated(self) -> Iterator[Outgoing]:
        """Yield the values that a write or a loss of the line has made something else than they were when read."""
        line = ext.line_of(self._bus)
        seen = (line.last_touched, line.condition)
        if self._settings.messages == "cycle" or seen == self._seen:
            return
        self._seen = seen
        for group in self._bus.groups:
            latest = group.latest
            if latest is None or (self.groups and group.name not in self.groups):
                continue
            for point, sample in tuple(latest.samples.items()):
                now = line.as_of_now(point, sample)
                if now is not sample:
                    yield self._value(point, now)

    def _status(self, state: str) -> list[Outgoing]:
        return [Outgoing(self._topic("status"), state, True)] if self._in_charge else []

    def _farewell(self) -> Iterator[Outgoing]:
        """Yield messages that no line and no node is up any more, because retained messages would stay for ever."""
        for topic in self._published if self._in_charge else ():
            name = topic.partition("/")[0]
            if name in ("line", "health"):
                payload = json_line(**{"time": round(time.time(), 3), name: "offline"})
                yield Outgoing(self._topic(topic), payload, True)

    def _changes(self) -> Iterator[Outgoing]:
        """Yield the changes since the last report. Only attributes that are replaced as a whole are compared."""
        if not self._in_charge:
            return
        now: dict[str, tuple[str, str | None]] = {}
        more: dict[str, dict[str, Any]] = {}
        if self._asks:
            now["line"] = ("line", "offline" if self._bus.state is LineState.OFFLINE else "ready")
            more["line"] = {"reason": self._bus.condition.reason or None}
        for node in self._bus.nodes if self._asks else ():
            now[f"health/{topic_part(node.label.removeprefix('node '))}"] = ("health", node.health.value)
        alarms = self._bus.alarms
        with_alarms: dict[str, Point[Any]] = {}
        if alarms is not self._alarms:
            self._alarms = alarms
            with_alarms = {f"{ALARMS}{topic_part(point.key)}": point for point in alarms}
            now |= {topic: ("alarm", None) for topic in self._published if topic.startswith(ALARMS)}
            for topic, point in with_alarms.items():
                alarm = alarms[point]
                now[topic] = ("alarm", None if alarm is None else alarm.name)
        for topic, (name, state) in now.items():
            if self._published.get(topic, "") != state:
                yield from self._announce(topic, with_alarms)
                self._published[topic] = state
                payload = json_line(**{"time": round(time.time(), 3), name: state, **more.get(topic, {})})
                yield Outgoing(self._topic(topic), payload, True)

    def _topic(self, *parts: str) -> str:
        return "/".join((self._settings.prefix, *parts))

    # commands

    async def _listen(self, client: Client) -> None:
        """Raise ConnectionError when the broker goes away, also while there is nothing to send."""
        import aiomqtt

        try:
            async for _ in client.messages:
                raise AssertionError("messages are taken in as they arrive")
        except aiomqtt.MqttError:
            raise self._ended() from None

    def _ended(self) -> ConnectionError:
        return ConnectionError(f"{self._settings.host}:{self._settings.port} ended the connection")

    async def _serve(self, client: Client, *, task_status: TaskStatus[None]) -> None:
        """Accept commands until the interface is to be closed; it has started when the subscription is active."""
        self._interface_is_closed.clear()  # before the check: `close_interface` uses the opposite order
        try:
            if self._commands and not self._leaving.is_set():
                await self._receive(client, task_status)
            else:
                task_status.started()
        finally:
            self._arriving.close(self._keep)
            self._interface_is_closed.set()

    async def _receive(self, client: Client, task_status: TaskStatus[None]) -> None:
        topics = [self._topic("set", name) for name in self._commands]
        forbidden = Forbidden(
            self._settings, self._secrets, self._topic(COMMANDS), frozenset(topics), self._arriving.take
        )
        try:
            await forbidden.begin(KEEP_ALIVE, TIMEOUT)
            await client.subscribe([(topic, 1) for topic in topics])
            task_status.started()
            await self._obey(client, topics, forbidden)
        finally:
            forbidden.close()

    async def _obey(self, client: Client, topics: list[str], forbidden: Forbidden) -> None:
        """Have commands written and answered. None is answered any more when this returns."""
        answer = partial(self._answer, client)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(self._arriving.serve, self._write, self._keep, answer, partial(unread, client))
            while not self._leaving.is_set():
                await asyncio.wait({forbidden.lost}, timeout=TICK)
                if forbidden.lost.done():
                    raise self._ended()
            with anyio.move_on_after(LAST_ANSWERS):
                await client.unsubscribe(topics)
                await forbidden.end()
                await self._arriving.answered()
            tasks.cancel_scope.cancel()

    async def _write(self, request: WriteRequest) -> WriteRecord:
        """Write it on the loop that owns the line."""
        assert self._owner is not None
        return await asyncio.wrap_future(
            asyncio.run_coroutine_threadsafe(self._authorisation.write(request), self._owner)
        )

    def _keep(self, request: WriteRequest, error: str) -> None:
        """Store the audit entry of a refused command, on the owner's loop."""
        assert self._owner is not None
        with suppress(RuntimeError):  # that loop has ended
            self._owner.call_soon_threadsafe(self._authorisation.refuse, request, error)

    async def _answer(self, client: Client, answer: Answer) -> None:
        topic = self._topic("result", answer.name) if answer.name else self._topic("result")
        await self._send(client, [Outgoing(topic, json_line(**answer.fields))])


def make(settings: MqttSettings, line: OutputLine) -> MqttOutput:
    """Make the output of a line."""
    return MqttOutput(
        "mqtt",
        settings,
        line.bus,
        line.report,
        commands=line.commands,
        authorisation=line.authorisation,
        in_charge=line.in_charge,
        asks=line.polls,
    )


def unsuitable(settings: MqttSettings, group: str, points: Mapping[str, str]) -> Unsuitable | None:
    """Return why a name cannot be a part of a topic, or None."""
    names = {group: f"the group {group}"} if settings.messages == "cycle" else {key: key for key in points}
    for name, what in names.items():
        if not name.isprintable():
            return Unsuitable(f"cannot take {what!r}: a topic has no control characters")
        if len(f"{settings.prefix}/cycles/{name}".encode()) > LONGEST_TOPIC:
            return Unsuitable(f"cannot take {what[:40]}...: its name is longer than a topic may be")
    return None


MQTT = OutputKind(
    name="mqtt",
    settings=MqttSettings,
    make=make,
    about="Values, health and events to an MQTT broker; the extra mqtt.",
    keeps_audit=True,
    unsuitable=unsuitable,
)

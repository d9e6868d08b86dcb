"""MQTT, to a real mosquitto: values, health, last will, a broker that goes and comes back, and commands in."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack, asynccontextmanager, contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from busmaster.app.bounds import LONGEST_TOPIC
from busmaster.app.config import FileError, emulated_line
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine
from busmaster.app.outputs.base import Happening, OutputLine
from busmaster.app.outputs.mqtt import KEEP_ALIVE, MQTT, UNREAD, MqttOutput, Outgoing
from busmaster.app.outputs.mqtt_connection import topic_part, unread
from busmaster.app.outputs.mqtt_forbidden import Forbidden
from busmaster.app.outputs.settings import MqttSettings
from busmaster.app.service.authorisation import Authorisation
from busmaster.app.service.payload import NoCommand, Payload, read_payload
from busmaster.bus.bus import Bus
from busmaster.bus.meaning import Meaning
from busmaster.bus.polling import Snapshot
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import InvalidCommand, NoReply
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.registry import make_device
from tests.app.outputs.brokers import Broker, needs_mosquitto
from tests.app.outputs.cycles import BUS, cycle, until
from tests.app.outputs.test_audit import WRITE
from tests.patience import PATIENCE
from tests.ports import free_port

if TYPE_CHECKING:
    from aiomqtt import Client

Heard = tuple[str, Any, bool]
"""Topic, payload, and whether it was retained."""

pytestmark = needs_mosquitto


class Seen(MqttOutput):
    """Whose connection can be cut."""

    client: Client

    def _client(self) -> Client:
        self.client = super()._client()
        return self.client

    def cut(self) -> None:
        connection = self.client._client.socket()
        assert isinstance(connection, socket.socket)
        connection.shutdown(socket.SHUT_RDWR)


def emulated(handle: type[Hcp2Controller], address: int) -> Bus:
    return Bus(MemoryPort(Line(handle.profile.line, [make_device("hcp2", address)], paced=False)))


@asynccontextmanager
async def publishing(
    broker: Broker, bus: Bus = BUS, report: Callable[[str], None] = lambda _: None, **options: Any
) -> AsyncIterator[Seen]:
    commands = options.pop("commands", {})
    settings = MqttSettings(port=broker.port, prefix="line", **options)
    output = Seen("mqtt", settings, bus, report, commands=commands)
    output._retry = 0.02
    output.start()
    try:
        yield output
    finally:
        await asyncio.to_thread(output.close, PATIENCE)


@asynccontextmanager
async def listening(broker: Broker, *topics: str, **options: Any) -> AsyncIterator[Client]:
    import aiomqtt

    async with aiomqtt.Client("127.0.0.1", broker.port, **options) as client:
        for topic in topics:
            await client.subscribe(topic, qos=1)
        yield client


async def heard(client: Client, count: int) -> list[Heard]:
    found: list[Heard] = []
    async with asyncio.timeout(PATIENCE):
        async for message in client.messages:
            text = bytes(message.payload).decode()
            found.append((str(message.topic), json.loads(text) if text[:1] in "{[" else text, message.retain))
            if len(found) == count:
                break
    return found


async def settled(output: MqttOutput) -> None:
    await asyncio.to_thread(until, lambda: output.statistics().waiting == 0)


@pytest.mark.asyncio
async def test_values_and_events_are_published_each_under_its_name(broker: Broker) -> None:
    async with listening(broker, "line/values/#", "line/events") as client, publishing(broker) as output:
        output.offer(cycle(1, 12.5, NoReply("no reply")))
        output.offer(Happening(BUS.wall_time(), "winder", "winder is down"))
        first, second, event = await heard(client, 3)
    assert first[0] == "line/values/5/1"
    assert {key: first[1][key] for key in ("value", "unit", "error", "late")} == {
        "value": 12.5,
        "unit": "",
        "error": None,
        "late": False,
    }
    assert (second[0], second[1]["value"], second[1]["error"]) == ("line/values/5/2", None, "no reply")
    assert (event[0], event[1]["text"]) == ("line/events", "winder is down")
    assert output.statistics().written == 3


@pytest.mark.asyncio
async def test_a_value_has_its_unit_and_the_time_of_its_reply(broker: Broker) -> None:
    found = cycle(1, 12.5)
    samples = {replace(point, unit="mm"): sample._replace(wall=1e9) for point, sample in found.samples.items()}
    async with listening(broker, "line/values/#") as client, publishing(broker) as output:
        output.offer(replace(found, samples=samples))
        [(_, payload, _)] = await heard(client, 1)
    assert (payload["unit"], payload["time"]) == ("mm", 1e9)


@pytest.mark.asyncio
async def test_the_last_values_are_retained_and_a_cycle_may_be_one_message(broker: Broker) -> None:
    async with publishing(broker, messages="cycle") as output:
        output.offer(cycle(1, 1.0, 2.0))
        output.offer(cycle(2, 3.0, 4.0))
        await settled(output)
    async with listening(broker, "line/cycles/#") as client:
        [(topic, payload, retained)] = await heard(client, 1)
    assert (topic, retained, payload["cycle"]) == ("line/cycles/axes", True, 2)
    assert payload["samples"]["5/2"]["value"] == 4
    assert abs(payload["due"] - BUS.wall_time()) < 600


@pytest.mark.asyncio
async def test_a_value_that_a_write_made_stale_is_published_if_its_group_is(broker: Broker) -> None:
    async with emulated(Hcp2Controller, 5) as bus, listening(broker, "line/values/#") as client:
        controller = Hcp2Controller(bus, 5)
        for name, item in (("other", "2"), ("axes", "1")):
            group = bus.poll_group(name, period=0.02, points=[controller.point(item)])
            async for _ in group:
                break
            group.pause()
        async with publishing(broker, bus, groups=("axes",)):
            await controller.write(2, 5.0)
            await controller.write(1, 5.0)
            [(topic, payload, _)] = await heard(client, 1)
    assert (topic, payload["quality"]) == ("line/values/5/1", "stale")


async def heard_to_the_end(client: Client) -> list[Heard]:
    """All messages up to the one by which the output takes its leave."""
    found: list[Heard] = []
    while not (found and found[-1][:2] == ("line/status", "offline")):
        found += await heard(client, 1)
    return found


@pytest.mark.asyncio
async def test_a_value_is_published_as_it_is_now_if_it_is_of_the_latest_cycle_and_once_when_it_becomes_stale(
    broker: Broker,
) -> None:
    async with emulated(Hcp2Controller, 5) as bus, listening(broker, "line/values/#", "line/status") as client:
        controller = Hcp2Controller(bus, 5)
        group = bus.poll_group("axes", period=1000.0, points=[controller.point("1")])
        latest = await anext(aiter(group))
        await controller.write(1, 5.0)
        output = MqttOutput("mqtt", MqttSettings(port=broker.port, prefix="line"), bus)
        for snapshot in (replace(latest, cycle=latest.cycle - 1), latest):
            output.offer(snapshot)
        output.start()
        try:
            found = await heard(client, 4)
        finally:
            await asyncio.to_thread(output.close, PATIENCE)
        found += await heard_to_the_end(client)
    old, *others = [payload["quality"] for topic, payload, _ in found if topic == "line/values/5/1"]
    assert old != "stale", "a value of an earlier cycle is history"
    assert others == ["stale", "stale"]


class CutOnce(Seen):
    """Whose connection is lost while the first stale values are under way."""

    cuts = 0

    def _outdated(self) -> Iterator[Outgoing]:
        found = list(super()._outdated())
        if found and not self.cuts:
            self.cuts = 1
            self.cut()
        return iter(found)


@pytest.mark.asyncio
async def test_a_stale_value_that_is_lost_with_the_connection_is_sent_on_the_next(broker: Broker) -> None:
    async with emulated(Hcp2Controller, 5) as bus, listening(broker, "line/values/#") as client:
        controller = Hcp2Controller(bus, 5)
        group = bus.poll_group("axes", period=1000.0, points=[controller.point("1")])
        output = CutOnce("mqtt", MqttSettings(port=broker.port, prefix="line"), bus)
        output._retry = 0.02
        output.offer(await anext(aiter(group)))
        output.start()
        try:
            [(_, payload, _)] = await heard(client, 1)
            assert payload["quality"] == "good"
            await controller.write(1, 5.0)
            [(_, payload, _)] = await heard(client, 1)
        finally:
            await asyncio.to_thread(output.close, PATIENCE)
    assert (payload["quality"], output.cuts) == ("stale", 1)


@pytest.mark.asyncio
async def test_where_a_cycle_is_one_message_no_value_has_one_of_its_own(broker: Broker) -> None:
    async with emulated(Hcp2Controller, 5) as bus, listening(broker, "line/#") as client:
        controller = Hcp2Controller(bus, 5)
        async for _ in bus.poll_group("axes", period=1000.0, points=[controller.point("1")]):
            break
        await controller.write(1, 5.0)
        async with publishing(broker, bus, messages="cycle"):
            pass
        topics = {topic for topic, *_ in await heard_to_the_end(client)}
    assert topics == {"line/status", "line/line", "line/health/5"}


@pytest.mark.asyncio
async def test_values_that_are_offered_just_before_the_end_are_published(broker: Broker) -> None:
    async with listening(broker, "line/status") as client, publishing(broker) as output:
        await heard(client, 1)
        output.offer(cycle(1, 12.5))
    assert (output.written, output.dropped) == (1, 0)


@pytest.mark.asyncio
async def test_whoever_comes_later_is_not_told_an_event_as_if_it_were_new(broker: Broker) -> None:
    async with publishing(broker) as output:
        output.offer(Happening(BUS.wall_time(), "winder", "winder is down"))
        output.offer(cycle(1, 1.0, 2.0))
        await settled(output)
        async with listening(broker, "line/events", "line/values/#") as client:
            told = await heard(client, 2)
    assert {topic for topic, *_ in told} == {"line/values/5/1", "line/values/5/2"}


@pytest.mark.asyncio
async def test_it_says_that_it_is_there_and_the_broker_says_so_when_it_is_not(broker: Broker) -> None:
    async with listening(broker, "line/status") as client:
        async with publishing(broker) as output:
            said = await heard(client, 1)
            output.cut()
            said += await heard(client, 2)
        said += await heard(client, 1)
    assert [payload for _, payload, _ in said] == ["online", "offline", "online", "offline"]


@pytest.mark.asyncio
async def test_whoever_comes_later_is_told_as_well_whether_it_is_there(broker: Broker) -> None:
    """The status is retained, that which the broker publishes after a lost connection too."""
    import aiomqtt
    from paho.mqtt.subscribeoptions import SubscribeOptions

    async with listening(broker, protocol=aiomqtt.ProtocolVersion.V5) as client:
        await client.subscribe("line/status", options=SubscribeOptions(qos=1, retainAsPublished=True))
        async with publishing(broker) as output:
            said = await heard(client, 1)
            output.cut()
            said += await heard(client, 2)
        said += await heard(client, 1)
    assert [(payload, retained) for _, payload, retained in said] == [
        ("online", True),
        ("offline", True),
        ("online", True),
        ("offline", True),
    ]


@pytest.mark.asyncio
async def test_health_of_line_and_nodes_is_retained_and_told_when_it_changes(broker: Broker) -> None:
    bus = emulated(Hcp2Controller, 5)
    controller = Hcp2Controller(bus, 5)
    async with publishing(broker, bus), listening(broker, "line/line", "line/health/#") as client:
        before = await heard(client, 2)
        async with bus:
            await controller.read(1)
            after = await heard(client, 2)
    states = [
        {topic: payload.get("health", payload.get("line")) for topic, payload, _ in found} for found in (before, after)
    ]
    assert states == [
        {"line/line": "offline", "line/health/5": "unknown"},
        {"line/line": "ready", "line/health/5": "up"},
    ]
    async with listening(broker, "line/line", "line/health/#") as later:  # the output has ended
        left = await heard(later, 2)
    found = {topic: payload.get("health", payload.get("line")) for topic, payload, _ in left}
    assert found == {"line/line": "offline", "line/health/5": "offline"}
    assert all(abs(payload["time"] - BUS.wall_time()) < 600 for _, payload, _ in (*before, *after, *left))


@pytest.mark.asyncio
async def test_a_broker_that_is_down_for_a_while_costs_nothing(broker: Broker) -> None:
    """Sent again is what it had not acknowledged: values may come twice, in order, but none is missing."""
    session = {"identifier": "historian", "clean_session": False}
    said: list[str] = []
    async with listening(broker, "line/values/#", **session):
        pass
    async with publishing(broker, report=said.append) as output:
        for number in range(1, 31):
            output.offer(cycle(number, float(number)))
            if number == 10:
                await settled(output)
                await asyncio.to_thread(broker.stop)
                await asyncio.to_thread(until, lambda: "down" in "".join(said))
        broker.start()
        await settled(output)
    assert (output.written, output.dropped) == (30, 0)
    assert said[-1] == "mqtt is up again"
    async with listening(broker, **session) as client:
        found = [payload["value"] for _, payload, _ in await heard(client, 30)]
    assert found == list(range(1, 31))


@pytest.mark.asyncio
async def test_a_broker_that_has_lost_its_messages_gets_the_state_of_the_line_its_nodes_and_alarms_again(
    broker: Broker,
) -> None:
    async with emulated(Hcp2Controller, 5) as bus:
        point = replace(Hcp2Controller(bus, 5).point("1"), meaning=Meaning(high=1000))
        async for _ in bus.poll_group("axes", period=0.02, points=[point]):
            break
        async with publishing(broker, bus) as output:
            output.offer(cycle(1, 1.0))
            await settled(output)
            await asyncio.to_thread(broker.stop)
            broker.forget()
            broker.start()
            output.offer(cycle(2, 1.0))
            await settled(output)
            async with listening(broker, "line/line", "line/health/#", "line/alarms/#") as client:
                found = await heard(client, 3)
    assert {(topic, retained) for topic, _, retained in found} == {
        ("line/line", True),
        ("line/health/5", True),
        ("line/alarms/5/1", True),
    }


@pytest.mark.asyncio
async def test_without_a_broker_the_oldest_are_dropped_and_counted() -> None:
    output = MqttOutput("mqtt", MqttSettings(port=free_port(), buffer=10), BUS)
    output.start()
    for number in range(100):
        output.offer(cycle(number, 1.0, 2.0))
    await asyncio.to_thread(until, lambda: bool(output.error))
    counts = output.statistics()
    assert (counts.written, counts.dropped, counts.waiting) == (0, 190, 10)
    assert "refused" in counts.error
    await asyncio.to_thread(output.close, PATIENCE)
    assert output.dropped == 200


def test_what_the_broker_has_not_acknowledged_waits_again_in_its_order() -> None:
    output = MqttOutput("mqtt", MqttSettings(), BUS)
    for number in range(1, 4):
        output.offer(cycle(number, 1.0))
    assert output.hold(2)
    output.put_back()
    assert [item.cycle for item in output._waiting if isinstance(item, Snapshot)] == [1, 2, 3]
    assert output.let_go() == 0


@contextmanager
def answering(answer: bytes) -> Iterator[int]:
    """Something that says this to who connects, and nothing else."""

    def serve() -> None:
        while True:
            try:
                connection, _ = server.accept()
            except OSError:
                return  # it was shut down
            connections.enter_context(connection)  # a later try must get its answer too
            connection.recv(1000)
            connection.sendall(answer)

    with ExitStack() as connections, socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield server.getsockname()[1]
        finally:
            server.shutdown(socket.SHUT_RDWR)
            thread.join()


@pytest.mark.slow
@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (b"\x20\x02\x00\x01", "does not support MQTT 5, which this output needs"),  # by 3.1.1
        (b"\x20\x03\x00\x84\x00", "does not support MQTT 5, which this output needs"),
        (b"\x20\x03\x00\x87\x00", "Not authorized"),
        (b"", "did not reply within 0.1 s; it needs MQTT 5"),
    ],
)
async def test_a_broker_that_will_not_do_is_told_in_one_sentence(
    monkeypatch: pytest.MonkeyPatch, answer: bytes, said: str
) -> None:
    if not answer:
        monkeypatch.setattr("busmaster.app.outputs.mqtt.TIMEOUT", 0.1)
    told: list[str] = []

    with answering(answer) as port:
        output = MqttOutput("mqtt", MqttSettings(port=port), BUS, told.append)
        output.start()
        await asyncio.to_thread(until, lambda: bool(told))
        await asyncio.to_thread(output.close, 5)
    assert told[0].startswith("mqtt is down: ")
    assert said in told[0]


@pytest.mark.asyncio
async def test_a_command_is_obeyed_where_the_file_allows_it_and_every_one_is_answered(broker: Broker) -> None:
    bus = emulated(Hcp2Controller, 5)
    controller = Hcp2Controller(bus, 5)
    commands = {"5/1": controller.point("1"), "5/100": controller.element(100)}
    async with listening(broker, "line/result/#") as client:
        await client.publish("line/set/5/1", "99", qos=1, retain=True)
        async with bus, publishing(broker, bus, commands=commands):
            [retained] = await heard(client, 1)
            await client.publish("line/set/5/1", None, qos=1, retain=True)
            await heard(client, 1)
            answers = {}
            for topic, payload in (("5/1", "12.5"), ("5/2", "1"), ("5/1", "on"), ("5/100", "1")):
                await client.publish(f"line/set/{topic}", payload, qos=1)
                [(where, answer, _)] = await heard(client, 1)
                answers[topic, payload] = (where, answer["ok"], answer.get("error", ""))
            assert await controller.read(1) == 12.5
    assert "retained" in retained[1]["error"]
    assert answers["5/1", "12.5"] == ("line/result/5/1", True, "")
    assert answers["5/2", "1"][:2] == ("line/result/5/2", False)
    assert "allow_commands" in answers["5/2", "1"][2]
    assert "'on' is neither a number" in answers["5/1", "on"][2]
    assert "refused" in answers["5/100", "1"][2]


@pytest.mark.asyncio
async def test_without_an_allow_list_nobody_listens(broker: Broker) -> None:
    """Where somebody does, everything is answered."""
    async with listening(broker, "line/status", "line/result/#") as client:
        async with publishing(broker):
            said = await heard(client, 1)
            await client.publish("line/set/5/1", "1", qos=1)
        said += await heard(client, 1)
    assert [payload for _, payload, _ in said] == ["online", "offline"]


COMMANDS = [
    (b"12.5", Payload(12.5)),
    (b"-1", Payload(-1)),
    (b" [1, 2.5] ", Payload([1, 2.5])),
    (bytearray(b"0"), Payload(0)),
    (b'{"value": 1}', Payload(1)),
    (b'{"value": [1], "id": "a1", "expires": 17.5}', Payload([1], "a1", 17.5)),
    (b'{"value": 1, "id": 7}', Payload(1, "7")),
]


@pytest.mark.parametrize(("payload", "said"), COMMANDS)
def test_a_command_is_a_number_or_a_list_of_numbers_perhaps_with_its_id_and_end(payload: bytes, said: Payload) -> None:
    assert read_payload(payload) == said


NO_COMMANDS = [
    *(b"", b"on", b"true", b"null", b"NaN", b"[]", b"{}", b'["1"]', b"[true]", b"\xff", None),
    *(
        b"1e308",
        b"1" * 400,
        b"9" * 5000,
        b"1" + b" " * 4096,
        b"[" * 4000,
        b'{"value": 1, "x": 2}',
        b'{"value": 1, "expires": "soon"}',
    ),
    *(b'{"value": 1e999}', b'{"value": 1, "id": []}', b'{"value": 1, "expires": 1e999}'),
]


@pytest.mark.parametrize("payload", NO_COMMANDS, ids=lambda payload: repr(payload)[:20])
def test_anything_else_is_refused(payload: bytes | None) -> None:
    with pytest.raises(InvalidCommand):
        read_payload(payload)


def test_a_number_that_is_too_large_is_not_said_to_be_none() -> None:
    with pytest.raises(InvalidCommand, match=r"^'\[1, 1e308\]' is larger than 1e\+15"):
        read_payload(b"[1, 1e308]")


@pytest.mark.parametrize(
    ("payload", "mark"),
    [
        (b'{"id": "a", "value": "NaN"}', "a"),
        (b'{"id": 7, "value": NaN}', "7"),
        (b'{"id": 7}', "7"),
        (b'{"id": 0}', "0"),
        (b'{"id": 7, "value": 1, "x": 2}', "7"),
        (b'{"id": 7, "value": 1e308}', "7"),
        (b'{"id": 7, "value": 1, "expires": "soon"}', "7"),
        (b'{"id": [7], "value": 1}', ""),
        (b'{"id": "\\ud800", "value": 1}', ""),
        (b'{"id": "a\\nb", "value": 1}', ""),
        (b'"id"', ""),
    ],
)
def test_what_is_no_command_keeps_the_id_that_it_has(payload: bytes, mark: str) -> None:
    with pytest.raises(NoCommand) as caught:
        read_payload(payload)
    assert caught.value.id == mark


def test_an_end_in_milliseconds_is_refused_since_it_would_never_come() -> None:
    with pytest.raises(InvalidCommand, match="not in milliseconds"):
        read_payload(b'{"value": 1, "expires": 1767225600000}')


def test_a_password_is_the_text_of_its_file_without_the_end_of_its_line(tmp_path: Path) -> None:
    file = tmp_path / "password"
    file.write_bytes(b"a secret\r\n")
    assert MqttSettings(password_file=str(file)).password() == "a secret"
    file.write_bytes(b"\xff\xfe")
    with pytest.raises(InvalidCommand, match="is not text"):
        MqttSettings(password_file=str(file)).password()


def test_a_password_file_that_is_not_there_is_said_at_once(tmp_path: Path) -> None:
    with pytest.raises(InvalidCommand, match="No such file"):
        MqttOutput("mqtt", MqttSettings(password_file=str(tmp_path / "none")), BUS)


def read_output(**options: Any) -> Any:
    """The settings of `[outputs.mqtt]` with these keys."""
    keys = "".join(f"{key} = {json.dumps(value)}\n" for key, value in options.items())
    return read(Source("line.toml", f"{FILE}[outputs.mqtt]\n{keys}")).outputs["mqtt"]


FILE = """
port = "/dev/ttyUSB0"
[nodes.winder]
protocol = "hcp2"
address = 5
[groups.fast]
period = 0.1
points = "winder/1"
"""


@pytest.mark.parametrize("topic", ["", "a/+", "#", "/a", "a/", "a\tb"])
@pytest.mark.parametrize("key", ["prefix", "home_assistant"])
def test_a_topic_without_a_meaning_is_refused(key: str, topic: str) -> None:
    with pytest.raises(FileError, match=f"{key}: a topic must not contain"):
        read_output(**{key: topic})
    assert getattr(read_output(**{key: "a/b"}), key) == "a/b"


def test_each_file_is_checked_at_its_own_key(tmp_path: Path) -> None:
    @contextmanager
    def at(key: str) -> Iterator[None]:
        try:
            yield
        except InvalidCommand as error:
            found.append((key, str(error)))

    (tmp_path / "text").write_text("no certificate")
    none, text = str(tmp_path / "none"), str(tmp_path / "text")
    results = []
    for settings in (
        MqttSettings(password_file=none, tls=True, ca_file=none),
        MqttSettings(password_file=text, tls=True, ca_file=text),
        MqttSettings(password_file=text, tls=True, ca_file=none),
        MqttSettings(password_file=text, ca_file=none),  # without TLS it is not used
    ):
        found: list[tuple[str, str]] = []
        settings.check_files(at)
        results.append(found)
    assert results == [
        [
            ("password_file", f"{none} cannot be read: No such file or directory"),
            ("ca_file", f"{none} cannot be read: No such file or directory"),
        ],
        [("ca_file", f"{text} holds no certificate in PEM form")],
        [("ca_file", f"{none} cannot be read: No such file or directory")],
        [],
    ]


def test_settings_without_commands_permit_none_and_are_the_same_otherwise() -> None:
    settings = MqttSettings(port=1884, allow_commands=("winder/1",))
    assert settings.writable == ("allow_commands", ("winder/1",))
    assert settings.without_commands() == MqttSettings(port=1884)
    assert settings.destination == "127.0.0.1:1884"


@pytest.mark.asyncio
async def test_the_client_has_the_settings_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "password").write_text("secret\n")
    settings = MqttSettings(host="192.0.2.7", port=1884, username="op", password_file=str(tmp_path / "password"))
    output = MqttOutput("mqtt", settings, BUS)
    main = output._client()
    client = main._client
    forbidden = Forbidden(settings, output._secrets, "x/set/#", frozenset(), lambda _: None)
    for paho in (client, forbidden._client):
        assert (paho._username, paho._password) == (b"op", b"secret")
    without_password = MqttSettings(username="op")
    output = MqttOutput("mqtt", without_password, BUS)
    forbidden = Forbidden(without_password, output._secrets, "x/set/#", frozenset(), lambda _: None)
    for paho in (output._client()._client, forbidden._client):
        assert (paho._username, paho._password) == (b"op", None)
    assert client._will_topic == b"busmaster/status"
    assert main._keepalive == KEEP_ALIVE
    assert MqttOutput("mqtt", settings, BUS, in_charge=False)._client()._client._will_topic == b""


@pytest.mark.asyncio
async def test_further_commands_wait_at_the_broker_because_the_socket_holds_few(broker: Broker) -> None:
    async with listening(broker, "line/status") as client, publishing(broker) as output:
        await heard(client, 1)
        connection = output.client._client.socket()
        assert isinstance(connection, socket.socket)
        # The system doubles the number, for its own needs.
        assert connection.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) <= 2 * UNREAD


@pytest.mark.asyncio
async def test_values_are_not_retained_if_the_file_says_so(broker: Broker) -> None:
    for messages in ("point", "cycle"):
        async with publishing(broker, retain=False, messages=messages) as output:
            output.offer(cycle(1, 1.0))
            output.offer(Happening(1.5, "", "the line is lost"))
            await settled(output)
    async with listening(broker, "line/values/#", "line/cycles/#", "line/status") as client:
        assert [(topic, payload) for topic, payload, _ in await heard(client, 1)] == [("line/status", "offline")]


@pytest.mark.asyncio
async def test_messages_have_the_quality_of_service_of_the_file_and_an_event_of_the_line_no_node(
    broker: Broker,
) -> None:
    import aiomqtt

    for qos in (0, 1):
        async with aiomqtt.Client("127.0.0.1", broker.port) as client:
            await client.subscribe("line/events", qos=1)
            async with publishing(broker, qos=qos) as output:
                output.offer(Happening(1.5, "", "the line is lost"))
                message = await anext(aiter(client.messages))
        assert message.qos == qos
        assert json.loads(bytes(message.payload)) == {
            "time": 1.5,
            "node": None,
            "text": "the line is lost",
        }


@asynccontextmanager
async def not_in_charge(broker: Broker, bus: Bus, **options: Any) -> AsyncIterator[MqttOutput]:
    """An output of a process that does not own the line, or only listens."""
    line = OutputLine(bus=bus, authorisation=Authorisation(bus), commands={}, **options)
    output = MQTT.make(MqttSettings(port=broker.port, prefix="line", home_assistant="homeassistant"), line)
    assert isinstance(output, MqttOutput)
    output.start()
    try:
        yield output
    finally:
        await asyncio.to_thread(output.close, PATIENCE)


@pytest.mark.asyncio
async def test_who_does_not_own_the_line_publishes_its_values_and_nothing_of_its_state(broker: Broker) -> None:
    bus = emulated(Hcp2Controller, 5)
    Hcp2Controller(bus, 5)
    async with listening(broker, "#") as client:
        async with not_in_charge(broker, bus, in_charge=False) as output:
            output.offer(cycle(1, 1.0))
            await settled(output)
        async with not_in_charge(broker, bus, polls=False) as output:
            output.offer(cycle(1, 2.0))
            await settled(output)
        found: list[Heard] = []
        while not (found and found[-1][:2] == ("line/status", "offline")):
            found += await heard(client, 1)
    [first, status, config, second, last] = found
    assert (first[0], first[1]["value"]) == ("line/values/5/1", 1)
    assert (status[:2], last[:2]) == (("line/status", "online"), ("line/status", "offline"))
    assert config[0].startswith("homeassistant/sensor/")
    assert [one["topic"] for one in config[1]["availability"]] == ["line/status", "line/values/5/1"]
    assert (second[0], second[1]["value"]) == ("line/values/5/1", 2)


@pytest.mark.asyncio
@pytest.mark.parametrize("read_only", [False, True])
async def test_a_line_writes_the_commands_that_its_file_permits_unless_it_is_read_only(
    broker: Broker, read_only: bool
) -> None:
    keys = f'port = {broker.port}\nprefix = "line"\nallow_commands = "winder/10"\n'
    file = read(Source("line.toml", f"{FILE}[outputs.mqtt]\n{keys}"))
    async with (
        listening(broker, "line/status", "line/result/#", "line/audit") as client,
        ConfiguredLine(file, port=MemoryPort(emulated_line(file)), read_only=read_only) as line,
    ):
        assert [payload for _, payload, _ in await heard(client, 1)] == ["online"]
        await client.publish("line/set/winder/10", "12.5", qos=1)
        found = {topic: payload for topic, payload, _ in await heard(client, 2)}
        assert found["line/result/winder/10"]["ok"] is not read_only
        assert found["line/audit"]["outcome"] == ("refused" if read_only else "written")
        assert await line.point("winder/10").read() == (0 if read_only else 12.5)


@pytest.mark.asyncio
async def test_a_process_that_only_writes_publishes_its_audit_entries_and_nothing_else(
    broker: Broker, tmp_path: Path
) -> None:
    outputs = f'[outputs.mqtt]\nport = {broker.port}\nprefix = "line"\n[outputs.csv]\npath = "{tmp_path}/x.csv"\n'
    metrics = f"[outputs.metrics]\nport = {free_port()}\n"
    line = ConfiguredLine(read(Source("line.toml", f"{FILE}{outputs}{metrics}")), outputs=False)
    async with listening(broker, "#") as client:
        audit = line.audit()
        assert [counts.kind for counts in audit.statistics()] == ["mqtt"], "the others keep no audit log"
        audit.start(())
        audit.record(WRITE)
        await audit.close()
        await client.publish("end", "now")
        found = await heard(client, 2)
    assert [(topic, retained) for topic, _, retained in found] == [("line/audit", False), ("end", False)]


@pytest.mark.asyncio
async def test_the_state_of_the_line_has_its_reason_and_an_alarm_that_is_no_more_is_withdrawn(broker: Broker) -> None:
    bus = emulated(Hcp2Controller, 5)
    controller = Hcp2Controller(bus, 5)
    with_alarm = replace(controller.point("1"), meaning=Meaning(high=5.0))
    async with listening(broker, "line/line", "line/alarms/#") as client:

        async def until(fact: Callable[[str, Any], bool]) -> Any:
            while True:
                [(topic, payload, _)] = await heard(client, 1)
                if fact(topic, payload):
                    return payload

        async with bus, publishing(broker, bus):
            ready = await until(lambda topic, _: topic == "line/line")
            assert (ready["line"], ready["reason"]) == ("ready", None)
            await controller.write(1, 7.0)
            group = bus.poll_group("axes", period=0.02, points=[with_alarm, controller.point("3")])
            await until(lambda topic, payload: topic == "line/alarms/5/1" and payload["alarm"] == "high")
            group.remove(with_alarm)
            await until(lambda topic, payload: topic == "line/alarms/5/1" and payload["alarm"] is None)
            bus._pump.connection_lost(OSError("unplugged"))
            lost = await until(lambda topic, payload: topic == "line/line" and payload["line"] == "offline")
    assert "unplugged" in lost["reason"]


@pytest.mark.parametrize(
    ("messages", "group", "key", "why"),
    [
        ("point", "a\tgroup", "winder/force", ""),
        ("point", "fast", "winder/a\tb", "a topic has no control characters"),
        ("point", "fast", "winder/" + 70_000 * "x", "longer than a topic may be"),
        ("cycle", "a\tgroup", "winder/force", "a topic has no control characters"),
        ("cycle", "fast", "winder/a\tb", ""),
        ("cycle", 70_000 * "x", "winder/force", "longer than a topic may be"),
        ("cycle", "fast", "winder/force", ""),
        ("point", "fast", "winder/Länge", ""),
        ("point", "fast", "winder/" + (LONGEST_TOPIC // 2) * "ä", "longer than a topic may be"),
        ("cycle", (LONGEST_TOPIC - len("busmaster/cycles/")) * "x", "winder/force", ""),
        ("cycle", (LONGEST_TOPIC - len("busmaster/cycles/") + 1) * "x", "winder/force", "longer than a topic may be"),
    ],
)
def test_a_name_that_cannot_be_a_part_of_a_topic_is_refused(messages: Any, group: str, key: str, why: str) -> None:
    found = MQTT.unsuitable(MqttSettings(messages=messages), group, {"winder/first": "number", key: "number"})
    assert (why in found.why) if why else found is None  # type: ignore[union-attr]  # it is there


def test_names_in_topics_stay_different() -> None:
    names = ("a", "a+", "a#", "a%2B", "a%23", "a%", "a%25", "a%2525", "+#%")
    assert len({topic_part(name) for name in names}) == len(names)
    assert not set("".join(map(topic_part, names))) & set("+#")
    assert topic_part("+#%") == "%2B%23%25"


def test_of_a_connection_that_is_closed_nothing_is_unread() -> None:
    here, there = socket.socketpair()
    client: Any = SimpleNamespace(_client=SimpleNamespace(socket=lambda: here))
    there.sendall(bytes(7))
    assert unread(client) == 7
    here.close()
    there.close()
    assert unread(client) == 0
    assert unread(cast("Any", SimpleNamespace(_client=SimpleNamespace(socket=lambda: None)))) == 0

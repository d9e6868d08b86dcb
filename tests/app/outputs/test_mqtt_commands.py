"""Commands by MQTT, to a real mosquitto: how old they may be, how many, how strange; and what is kept of each."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from busmaster.app.bounds import LONGEST_COMMAND, LONGEST_NAME, LONGEST_SENDER, MOST_AT_ONCE, MOST_COMMANDS
from busmaster.app.outputs import mqtt, mqtt_commands, mqtt_forbidden
from busmaster.app.outputs.mqtt import MqttOutput
from busmaster.app.outputs.mqtt_commands import LEAST, Answer, Commands
from busmaster.app.outputs.mqtt_connection import unread
from busmaster.app.outputs.mqtt_forbidden import Forbidden
from busmaster.app.outputs.settings import MqttSettings
from busmaster.app.service.authorisation import Authorisation, WriteRequest
from busmaster.app.service.record import Outcome, WriteRecord
from busmaster.bus.bus import Bus
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import BusError
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.registry import make_device
from tests.app.outputs.brokers import Broker, needs_mosquitto
from tests.app.outputs.cycles import BUS, NODE
from tests.app.outputs.cycles import until as outside_until
from tests.patience import PATIENCE
from tests.ports import free_port

if TYPE_CHECKING:
    from aiomqtt import Client, Message

pytestmark = needs_mosquitto


async def until(fact: Callable[[], object]) -> None:
    """Wait for a fact of this loop: it turns until it is one."""
    while not fact():  # noqa: ASYNC110  nobody tells it
        await asyncio.sleep(0)


class Plant:
    """A line with one controller, whose element 1 may be written by MQTT, and somebody who writes it."""

    def __init__(self, bus: Bus, authorisation: Authorisation, output: MqttOutput, client: Client) -> None:
        self.bus, self.authorisation, self.output, self.client = bus, authorisation, output, client
        self.controller = Hcp2Controller(bus, 5)
        self.records: list[WriteRecord] = []
        authorisation.record = self.keep

    def keep(self, record: WriteRecord) -> None:
        self.records.append(record)
        self.output.offer(record)

    async def send(self, payload: str | bytes, name: str = "5/1", **options: Any) -> None:
        await self.client.publish(f"line/set/{name}", payload, qos=1, **options)

    async def answers(self, count: int = 1) -> list[tuple[str, dict[str, Any]]]:
        found: list[tuple[str, dict[str, Any]]] = []
        async with asyncio.timeout(PATIENCE):
            async for message in self.client.messages:
                found.append((str(message.topic), json.loads(bytes(message.payload))))
                if len(found) == count:
                    break
        return found

    async def ask(self, payload: str | bytes, name: str = "5/1", **options: Any) -> dict[str, Any]:
        await self.send(payload, name, **options)
        [(_, answer)] = await self.answers()
        return answer


@asynccontextmanager
async def plant(
    broker: Broker, *topics: str, read_only: bool = False, report: Callable[[str], None] = lambda _: None
) -> AsyncIterator[Plant]:
    import aiomqtt

    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line, [make_device("hcp2", 5)], paced=False)))
    interface = Authorisation(bus, read_only=read_only)
    controller = Hcp2Controller(bus, 5)
    controller.element(1).limit(maximum=500)
    settings = MqttSettings(port=broker.port, prefix="line")
    commands = {"5/1": controller.point("1"), "5/a+b": controller.point("3")}
    output = MqttOutput("mqtt", settings, bus, report, commands=commands, authorisation=interface)
    async with bus, aiomqtt.Client("127.0.0.1", broker.port, protocol=aiomqtt.ProtocolVersion.V5) as client:
        await client.subscribe("line/status", qos=1)
        output.start()
        async with asyncio.timeout(PATIENCE):
            async for message in client.messages:
                if message.payload == b"online":
                    break
        await client.unsubscribe("line/status")
        for topic in topics or ("line/result/#",):
            await client.subscribe(topic, qos=1)
        try:
            yield Plant(bus, interface, output, client)
        finally:
            await asyncio.to_thread(output.close, PATIENCE)


@pytest.mark.asyncio
async def test_a_write_is_answered_with_its_id_and_kept_whole(broker: Broker) -> None:
    began = time.time() - 0.001  # times are rounded
    async with plant(broker, "line/result/#", "line/audit") as there:
        await there.send('{"value": 12.5, "id": "a1"}')
        found = dict(await there.answers(2))
        assert await there.controller.read(1) == 12.5
    assert found["line/result/5/1"] == {"ok": True, "id": "a1"}
    audit = found["line/audit"]
    assert (audit["interface"], audit["by"], audit["point"], audit["value"]) == ("mqtt", "line/set/5/1", "5/1", 12.5)
    assert (audit["outcome"], audit["error"], audit["id"]) == ("written", None, "a1")
    assert audit["took"] > 0
    assert began <= audit["time"] <= time.time()
    assert audit["process"] > 0
    assert audit["user"]


@pytest.mark.asyncio
async def test_a_limit_is_named_and_nothing_is_sent(broker: Broker) -> None:
    async with plant(broker) as there:
        for payload in ("501", "1e12", "[2, 501]", '{"value": 501, "id": 3}'):
            answer = await there.ask(payload)
            assert not answer["ok"], payload
        assert "maximum of 500" in answer["error"]
        assert answer["id"] == "3"
        assert [record.outcome for record in there.records] == [Outcome.REFUSED] * 4
        assert await there.controller.read(1) == 0


def test_a_command_that_is_refused_is_answered_though_the_lines_loop_has_ended(broker: Broker) -> None:
    import aiomqtt

    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line, [make_device("hcp2", 5)], paced=False)))
    settings = MqttSettings(port=broker.port, prefix="line")
    commands = {"5/1": Hcp2Controller(bus, 5).point("1")}
    output = MqttOutput("mqtt", settings, bus, commands=commands, authorisation=Authorisation(bus))

    async def start() -> None:
        output.start()

    async def ask() -> dict[str, Any]:
        async with (
            asyncio.timeout(PATIENCE),
            aiomqtt.Client("127.0.0.1", broker.port, protocol=aiomqtt.ProtocolVersion.V5) as client,
        ):
            await client.subscribe("line/status", qos=1)
            await client.subscribe("line/result/#", qos=1)
            async for message in client.messages:
                if message.payload == b"online":
                    await client.publish("line/set/5/1", "not a number", qos=1)
                elif str(message.topic) == "line/result/5/1":
                    return dict(json.loads(bytes(message.payload)))
        raise AssertionError("the connection ended")

    asyncio.run(start())
    try:
        answer = asyncio.run(ask())
    finally:
        output.close(PATIENCE)
    assert not answer["ok"]
    assert "number" in answer["error"]


@pytest.mark.asyncio
async def test_an_old_command_is_not_executed_late(broker: Broker, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mqtt_commands, "LOOK", 3600.0)
    async with plant(broker) as there:
        answer = await there.ask(json.dumps({"value": 1, "expires": time.time() - 0.1}))
        assert "has expired" in answer["error"]
        answer = await there.ask(json.dumps({"value": 2, "expires": time.time() + PATIENCE}))
        assert answer["ok"]
        there.output._arriving._looked -= PATIENCE + 1  # as if this process had stood still for so long
        answer = await there.ask("3")
        assert "has expired" in answer["error"]
        assert await there.controller.read(1) == 2


@pytest.mark.asyncio
async def test_the_expiry_of_an_mqtt_message_is_kept(broker: Broker, monkeypatch: pytest.MonkeyPatch) -> None:
    from paho.mqtt.packettypes import PacketTypes
    from paho.mqtt.properties import Properties

    monkeypatch.setattr(mqtt_commands, "LOOK", 3600.0)
    async with plant(broker) as there:
        properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]  # paho has no types
        properties.MessageExpiryInterval = int(PATIENCE)
        assert (await there.ask("4", properties=properties))["ok"]  # now it listens, and has looked at the clock
        both = json.dumps({"value": 5, "expires": time.time() - 0.1})
        assert "has expired" in (await there.ask(both, properties=properties))["error"]  # of two ends the first holds
        there.output._arriving._looked -= PATIENCE + 1
        answer = await there.ask("4", properties=properties)
        assert "has expired" in answer["error"]


STRANGE: dict[str, tuple[str, str | bytes]] = {
    "beyond any number": ("5/1", "1e308"),
    "deep": ("5/1", "[" * 100_000),
    "long": ("5/1", "1" * 200_000),
    "many": ("5/1", "[" + ",".join(["1"] * 2000) + "]"),
    "a topic of 64 kB": ("x" * 65_000, "1"),
    "many levels": ("/".join("a" * 150), "1"),
    "empty": ("5/1", ""),
    "no text": ("5/1", b"\xff\xfe"),
}


@pytest.mark.asyncio
async def test_whatever_is_sent_is_refused_and_answered_and_the_output_stays_up(broker: Broker) -> None:
    async with plant(broker) as there:
        for what, (name, payload) in STRANGE.items():
            answer = await there.ask(payload, name)
            assert not answer["ok"], what
            assert there.output.error == "", what
        assert (await there.ask("7"))["ok"]
        assert len(there.records) == len(STRANGE) + 1
        [long] = [
            record for record in there.records if "a command must have at most 4096 bytes, not 200000" in record.error
        ]
        assert long.value == f"'{'1' * 100}... (200000 bytes)'"


@pytest.mark.asyncio
async def test_a_command_to_what_the_file_does_not_allow_is_told_with_its_value_and_its_id(broker: Broker) -> None:
    async with plant(broker) as there:
        answer = await there.ask('{"value": 80, "id": "a7"}', "5/2")
        assert "allow_commands" in answer["error"]
        assert answer["id"] == "a7"
        await there.ask("on", "5/2")
    assert [(record.value, record.id) for record in there.records] == [(80, "a7"), ("'on'", "")]


@pytest.mark.asyncio
async def test_a_command_to_a_name_that_no_topic_can_have_has_its_characters_replaced(broker: Broker) -> None:
    async with plant(broker) as there:
        await there.send("7", "5/a%2Bb")
        assert await there.answers() == [("line/result/5/a%2Bb", {"ok": True})]
        assert await there.controller.read(3) == 7


@pytest.mark.asyncio
async def test_a_command_whose_name_is_too_long_for_a_reply_is_answered_without_it(broker: Broker) -> None:
    async with plant(broker) as there:
        await there.send("7", "x" * 1000)
        [(topic, answer)] = await there.answers()
    assert (topic, answer["ok"]) == ("line/result", False)


@pytest.mark.asyncio
async def test_a_malformed_command_is_answered_with_its_id_and_on_record_under_it(broker: Broker) -> None:
    async with plant(broker) as there:
        for payload, mark in (('{"value": [1, 2], "id": 7}', "7"), ('{"id": "a", "value": "NaN"}', "a")):
            assert (await there.ask(payload))["id"] == mark
    assert [(record.ok, record.id) for record in there.records] == [(False, "7"), (False, "a")]


@pytest.mark.asyncio
async def test_by_whom_a_command_is_says_its_topic_and_what_its_sender_says_of_itself(broker: Broker) -> None:
    from paho.mqtt.packettypes import PacketTypes
    from paho.mqtt.properties import Properties

    properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]  # paho has no types
    properties.UserProperty = [("shift", "2"), ("by", "recipes")]
    async with plant(broker) as there:
        await there.ask("1", properties=properties)
        await there.ask("1")
    assert [record.by for record in there.records] == ["line/set/5/1, sender 'recipes' (not verified)", "line/set/5/1"]


@pytest.mark.asyncio
async def test_commands_that_are_not_allowed_do_not_hold_up_those_that_are(
    broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mqtt_forbidden, "REST", PATIENCE)  # after the first of them, nothing of the others is read
    monkeypatch.setattr(mqtt, "LAST_ANSWERS", 0.0)
    async with plant(broker, "line/result/5/1") as there:
        for qos in (0, 1):
            for number in range(500):
                await there.client.publish("line/set/5/2", str(number), qos=qos)
        answer = await there.ask('{"value": 8, "expires": %f}' % (time.time() + PATIENCE))
        assert answer["ok"]
        assert there.output._arriving.refused <= 1


@pytest.mark.asyncio
async def test_a_flood_of_commands_that_are_not_allowed_is_refused_to_the_last(
    broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mqtt_forbidden, "REST", 0.0)
    monkeypatch.setattr(mqtt_commands, "BREATH", PATIENCE)  # from the first refusal that is answered to the next
    monkeypatch.setattr(mqtt, "LAST_ANSWERS", 0.0)
    reported: list[str] = []
    async with plant(broker, report=reported.append) as there:
        for number in range(1000):
            await there.client.publish("line/set/5/2", str(number), qos=0)
        await asyncio.to_thread(outside_until, lambda: there.output._arriving.refused == 1000)
        unanswered = there.output._arriving.unanswered
        assert unanswered > 500
        assert len(there.records) < 500
    assert reported == [f"mqtt: {unanswered} refused commands got neither a reply nor an audit entry"]


@pytest.mark.asyncio
async def test_what_came_while_we_stood_still_is_too_old_to_the_last_however_much_it_is(
    broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This broker sends no more than 20 ahead to whom asks for nothing else, and would send the rest afterwards."""
    asked, go = threading.Event(), threading.Event()
    stands: list[Client] = []

    def unread_then(client: Client) -> int:
        if asked.is_set():
            stands.append(client)
            go.wait(PATIENCE)
        return unread(client)

    monkeypatch.setattr(mqtt, "unread", unread_then)
    monkeypatch.setattr(mqtt_commands, "LOOK", 0.0)
    async with plant(broker) as there:
        asked.set()
        await asyncio.to_thread(outside_until, lambda: bool(stands))
        for number in range(10, 70):
            await there.send(str(number))
        size = 7 + len("line/set/5/1" + "10")
        await asyncio.to_thread(outside_until, lambda: unread(stands[0]) >= 60 * size)
        there.output._arriving._looked -= PATIENCE + 1
        go.set()
        answers = await there.answers(60)
        assert [answer["error"] for _, answer in answers] == ["the command has expired; nothing was sent"] * 60
        assert await there.controller.read(1) == 0


@pytest.mark.asyncio
async def test_commands_that_come_are_a_life_sign_of_a_broker_that_does_not_acknowledge(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(mqtt, "TIMEOUT", 0.001)
    output = MqttOutput("mqtt", MqttSettings(), Bus(MemoryPort(Line(Hcp2Controller.profile.line))))
    acknowledged = asyncio.get_running_loop().create_future()

    class Commanded:
        looks = 0

        @property
        def bytes_read(self) -> int:
            self.looks += 1
            if self.looks == 20:
                acknowledged.set_result(None)
            return self.looks

    async def publishing() -> None:
        await acknowledged

    output._arriving = cast("Commands", Commanded())
    await output._acknowledged(asyncio.ensure_future(publishing()))
    acknowledged = asyncio.get_running_loop().create_future()
    output._arriving = Commands("line", output._authorisation, {}, lambda: 0.0)
    with pytest.raises(ConnectionError, match=r"did not reply within 0.001 s"):
        await output._acknowledged(asyncio.ensure_future(publishing()))


@pytest.mark.asyncio
async def test_that_commands_are_not_heard_any_more_is_noticed_on_their_own_connection(broker: Broker) -> None:
    heard: asyncio.Queue[str] = asyncio.Queue()
    forbidden = Forbidden(
        MqttSettings(port=broker.port), (None, None, None), "line/set/#", frozenset({"line/set/5/1"}),
        lambda message: heard.put_nowait(message.topic),
    )  # fmt: skip
    async with asyncio.timeout(PATIENCE):
        await forbidden.begin(60, PATIENCE)
        for name in ("5/1", "5/2", "5/1", "5/3"):
            forbidden._client.publish(f"line/set/{name}", "1", qos=1)
        assert [await heard.get(), await heard.get()] == ["line/set/5/2", "line/set/5/3"]
        connection = forbidden._client.socket()
        assert isinstance(connection, socket.socket)
        connection.shutdown(socket.SHUT_RDWR)
        await forbidden.lost
    forbidden.close()


@pytest.mark.asyncio
async def test_if_the_connection_of_the_other_commands_is_lost_both_are_made_again(
    broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Forbidden] = []

    class Noted(Forbidden):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            made.append(self)

    monkeypatch.setattr(mqtt, "Forbidden", Noted)
    reported: list[str] = []
    async with plant(broker, report=reported.append) as there:
        there.output._retry = 0.01
        connection = made[0]._client.socket()
        assert isinstance(connection, socket.socket)
        connection.shutdown(socket.SHUT_RDWR)
        await asyncio.to_thread(outside_until, lambda: "mqtt is up again" in reported)
        assert (await there.ask("7", "5/2"))["ok"] is False
        assert (await there.ask("7"))["ok"]
    assert reported[0].endswith("ended the connection")
    assert len(made) == 2


@pytest.mark.slow
@pytest.mark.asyncio
async def test_more_commands_than_the_line_takes_are_refused_not_kept(broker: Broker) -> None:
    async with plant(broker) as there:
        for number in range(200):
            await there.send(json.dumps({"value": 1, "expires": time.time() + PATIENCE, "id": number}))
        answers = await there.answers(200)
        written = [answer for _, answer in answers if answer["ok"]]
        assert 0 < len(written) <= 200
        refused = {record.error for record in there.records if record.outcome is Outcome.REFUSED}
        assert refused <= {"100 commands are already waiting; send fewer at a time"}


@pytest.mark.asyncio
async def test_read_only_means_mqtt_too(broker: Broker) -> None:
    async with plant(broker, read_only=True) as there:
        assert "read-only" in (await there.ask("7"))["error"]
        assert await there.controller.read(1) == 0


@pytest.mark.asyncio
async def test_while_the_line_is_left_commands_are_refused_and_recorded(broker: Broker) -> None:
    async with plant(broker) as there:
        there.authorisation.leaving = True
        assert "the line is closing" in (await there.ask('{"value": 7, "id": "late"}'))["error"]
        assert [(record.id, record.outcome) for record in there.records] == [("late", Outcome.REFUSED)]
        assert await there.controller.read(1) == 0


@pytest.mark.asyncio
async def test_behind_a_closed_interface_nothing_is_carried_out_answered_or_recorded(broker: Broker) -> None:
    async with plant(broker) as there:
        assert (await there.ask("7"))["ok"]
        await asyncio.to_thread(there.output.close_interface)
        await there.send("8")
        assert there.output._arriving.unanswered == 0  # the broker keeps it: nobody listens
        there.output._arriving.arrive(cast("Message", Arrived(b"9")))  # what it had sent before that
        await asyncio.to_thread(there.output.close, PATIENCE)
        assert [record.value for record in there.records] == [7]
        assert there.output._arriving.unanswered == 1
        assert await there.controller.read(1) == 7


@pytest.mark.asyncio
async def test_commands_that_are_not_permitted_are_answered_before_the_interface_is_closed(
    broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mqtt_forbidden, "REST", 0.02)  # the last of them is read some time after it has arrived
    monkeypatch.setattr(mqtt, "LAST_ANSWERS", PATIENCE)
    async with plant(broker) as there:
        for number in range(10):
            await there.send(json.dumps({"value": number, "id": number}), "5/2")
        await asyncio.to_thread(there.output.close_interface)
        answers = await there.answers(10)
    assert sorted(answer["id"] for _, answer in answers) == [str(number) for number in range(10)]
    assert sorted(record.value for record in there.records) == list(range(10))


async def close_interface(output: MqttOutput) -> None:
    """Close it. Fails if that waits as for an interface that does not end."""
    began = time.monotonic()
    await asyncio.to_thread(output.close_interface)
    assert time.monotonic() - began < mqtt.LAST_ANSWERS


@pytest.mark.asyncio
async def test_an_interface_that_never_began_is_closed_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an output that was not started, that finds no broker, and that gets no reply from what is there."""
    monkeypatch.setattr(mqtt, "TIMEOUT", 0.1)
    commands = {"5/1": NODE.point("1")}
    await close_interface(MqttOutput("mqtt", MqttSettings(port=free_port()), BUS, commands=commands))
    away = MqttOutput("mqtt", MqttSettings(port=free_port()), BUS, commands=commands)
    away.start()
    await until(lambda: away.error)
    await close_interface(away)
    await asyncio.to_thread(away.close, PATIENCE)
    with socket.create_server(("127.0.0.1", 0)) as server:
        silent = MqttOutput("mqtt", MqttSettings(port=server.getsockname()[1]), BUS, commands=commands)
        silent.start()
        connection = (await asyncio.to_thread(server.accept))[0]
        await close_interface(silent)
    connection.close()
    await asyncio.to_thread(silent.close, PATIENCE)


@pytest.mark.asyncio
async def test_an_interface_whose_broker_is_lost_is_closed_at_once(broker: Broker) -> None:
    output = MqttOutput("mqtt", MqttSettings(port=broker.port), BUS, commands={"5/1": NODE.point("1")})
    output.start()
    await until(lambda: not output._interface_is_closed.is_set())
    await asyncio.to_thread(broker.stop)
    await until(lambda: output.error)
    await close_interface(output)
    await asyncio.to_thread(output.close, PATIENCE)


@pytest.mark.asyncio
async def test_a_stop_passes_while_commands_are_refused(broker: Broker) -> None:
    async with plant(broker) as there:
        for _ in range(300):
            await there.client.publish("line/set/5/1", "501", qos=0)
        there.controller.element(2).limit(writable=False)
        with pytest.raises(ValueError, match="may not be written"):
            await there.controller.write(2, 0.0)
        try:
            await there.controller.node.request(there.controller._write_command(2, (0.0,)), stop=True)
        except BusError as error:
            pytest.fail(str(error))


@dataclass
class Arrived:
    """A message as the client hands it over."""

    payload: bytes
    topic: str = "line/set/5/1"
    retain: bool = False
    properties: object = None


def test_what_came_while_we_stood_still_is_as_old_as_the_standstill() -> None:
    """Whatever lies before it in the socket is read first, and a look at the clock may come in between."""
    clock = [10.0]
    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line)))
    commands = Commands("line", Authorisation(bus), {"5/1": Hcp2Controller(bus, 5).point("1")}, lambda: clock[0])
    commands.look(0)
    clock[0] = 15.0
    commands.look(2 * len("line/set/5/1" + "1") + 20)  # with acknowledgements of ours among it
    for payload in (b"1", b"2"):
        commands.arrive(cast("Message", Arrived(payload)))
    assert [request.arrived for request in commands.queued] == [10.0, 10.0]
    clock[0] = 15.02
    commands.look(0)
    clock[0] = 15.03
    commands.arrive(cast("Message", Arrived(b"3")))
    assert commands.queued[-1].arrived == 15.02


def test_a_flood_does_not_make_what_comes_behind_it_look_old() -> None:
    clock = [0.0]
    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line)))
    commands = Commands("line", Authorisation(bus), {}, lambda: clock[0])
    size = len("line/set/5/1" + "0") + LEAST
    for step in range(500):
        clock[0] = step * 0.02
        commands.look(40 * size)  # so much always lies there, and so much is read between two looks
        for _ in range(40):
            commands.arrive(cast("Message", Arrived(b"0")))
    assert clock[0] - commands._looked <= 0.05


@pytest.mark.asyncio
async def test_refusals_that_were_counted_alone_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mqtt_commands, "REPORT_EVERY", 0.01)
    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line)))
    authorisation = Authorisation(bus)
    said: asyncio.Queue[str] = asyncio.Queue()
    commands = Commands("line", authorisation, {}, lambda: 0.0, said.put_nowait)
    for _ in range(MOST_COMMANDS + 7):
        commands.arrive(cast("Message", Arrived(b"1")))
    answers: asyncio.Queue[object] = asyncio.Queue()
    serving = asyncio.ensure_future(commands.serve(authorisation.write, authorisation.refuse, answers.put, lambda: 0))
    try:
        assert await said.get() == "7 refused commands got neither a reply nor an audit entry"
        before = commands.unanswered
        for _ in range(MOST_COMMANDS + 7):
            commands.arrive(cast("Message", Arrived(b"1")))
        new = commands.unanswered - before
        assert new >= 7
        assert await said.get() == f"{new} refused commands got neither a reply nor an audit entry"
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)


@pytest.mark.asyncio
async def test_what_waits_when_the_connection_ends_is_on_record_each_once() -> None:
    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line)))
    commands = Commands("line", Authorisation(bus), {"5/1": Hcp2Controller(bus, 5).point("1")}, lambda: 0.0)
    kept: list[tuple[Any, str]] = []
    under_way: list[WriteRequest] = []
    for number in range(MOST_AT_ONCE + 2):
        commands.arrive(cast("Message", Arrived(str(number).encode())))
    for refused in (b"on", b"off"):
        commands.arrive(cast("Message", Arrived(refused)))

    async def write(request: WriteRequest) -> WriteRecord:
        under_way.append(request)
        return await asyncio.Future()

    async def say(_: object) -> None:
        await asyncio.Future()

    def keep(request: WriteRequest, why: str) -> None:
        kept.append((request.value, why))

    serving = asyncio.ensure_future(commands.serve(write, keep, say, lambda: 0))
    await until(lambda: len(under_way) == MOST_AT_ONCE and len(kept) == 1)
    serving.cancel()
    await asyncio.gather(serving, return_exceptions=True)
    commands.close(keep)
    assert [value for value, _ in kept] == ["on", "off", MOST_AT_ONCE, MOST_AT_ONCE + 1]
    assert "before it was its turn" in kept[-1][1]
    async with asyncio.timeout(PATIENCE):
        await commands.answered()  # those that were under way are not waited for


def test_of_a_flood_that_nobody_is_told_of_nothing_is_read() -> None:
    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line)))
    commands = Commands("line", Authorisation(bus), {}, lambda: 0.0)
    for _ in range(MOST_COMMANDS):
        commands.arrive(cast("Message", Arrived(b"1")))

    class Unread(bytes):
        def __bytes__(self) -> bytes:
            raise AssertionError("it was read")

    commands.arrive(cast("Message", Arrived(Unread(b"1"))))
    assert (commands.refused, commands.unanswered) == (MOST_COMMANDS + 1, 1)


@pytest.mark.asyncio
async def test_before_the_connection_ends_every_command_that_has_come_is_answered() -> None:
    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line)))
    authorisation = Authorisation(bus, read_only=True)
    commands = Commands("line", authorisation, {"5/1": Hcp2Controller(bus, 5).point("1")}, lambda: 0.0)
    for number in range(5):
        commands.arrive(cast("Message", Arrived(str(number).encode())))
    replies: list[object] = []

    async def reply(answer: object) -> None:
        replies.append(answer)

    answered = asyncio.ensure_future(commands.answered())
    await asyncio.sleep(0)
    assert not answered.done(), "commands are waiting, and none has a reply"
    serving = asyncio.ensure_future(commands.serve(authorisation.write, authorisation.refuse, reply, lambda: 0))
    await answered
    assert len(replies) == 5
    serving.cancel()
    await asyncio.gather(serving, return_exceptions=True)


def commands_of(**points: str) -> Commands:
    """The commands to points of a controller, by their names in topics."""
    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line)))
    named = {f"5/{item}": Hcp2Controller(bus, 5).point(item) for item in points.values()}
    return Commands("line", Authorisation(bus), named, lambda: 0.0)


def test_as_many_commands_wait_as_the_bound_and_the_next_one_is_refused() -> None:
    commands = commands_of(one="1")
    for _ in range(MOST_COMMANDS + 2):
        commands.arrive(cast("Message", Arrived(b'{"value": 1, "id": "a"}')))
    assert (len(commands.queued), commands.refused, commands.unanswered) == (MOST_COMMANDS, 2, 0)
    kept: list[tuple[str, str]] = []
    for _ in range(2):  # each is kept once, however often it is closed
        commands.close(lambda request, why: kept.append((request.id, why)))
    assert len(kept) == MOST_COMMANDS + 2
    assert {why for _, why in kept[:2]} == {f"{MOST_COMMANDS} commands are already waiting; send fewer at a time"}
    assert {mark for mark, _ in kept} == {"a"}
    commands.arrive(cast("Message", Arrived(b"1")))
    assert (len(commands.queued), commands.refused, commands.unanswered) == (0, 3, 1)


def test_of_a_sender_and_of_its_topic_only_so_much_is_kept_as_fits_a_line() -> None:
    commands = commands_of(one="1")
    properties = SimpleNamespace(UserProperty=[("by", 5000 * "x")])
    commands.arrive(cast("Message", Arrived(b"1", properties=properties)))
    commands.arrive(cast("Message", Arrived(b"1", topic="line/set/" + 5000 * "y")))
    kept: list[WriteRequest] = []
    commands.close(lambda request, _: kept.append(request))
    [unknown, known] = kept
    assert known.by == f"line/set/5/1, sender {LONGEST_SENDER * 'x'!r} (not verified)"
    assert len(unknown.by) <= LONGEST_NAME
    assert unknown.name == 40 * "y"


def test_a_command_is_kept_as_it_came_up_to_the_longest_one() -> None:
    commands = commands_of(one="1")
    for size in (LONGEST_COMMAND, LONGEST_COMMAND + 1):
        commands.arrive(cast("Message", Arrived(size * b"x")))
    kept: list[WriteRequest] = []
    commands.close(lambda request, _: kept.append(request))
    assert kept[0].value == LONGEST_COMMAND * "x"
    assert kept[1].value == f"{100 * 'x'}... ({LONGEST_COMMAND + 1} bytes)"


@pytest.mark.parametrize(
    ("payload", "interval", "expires"),
    [
        (b'{"value": 1, "expires": 0}', None, 0),
        (b"1", 0, pytest.approx(time.time(), abs=600)),
        (b"1", None, None),
    ],
)
def test_an_end_at_zero_is_an_end(payload: bytes, interval: int | None, expires: float | None) -> None:
    commands = commands_of(one="1")
    properties = SimpleNamespace() if interval is None else SimpleNamespace(MessageExpiryInterval=interval)
    commands.arrive(cast("Message", Arrived(payload, properties=properties)))
    [request] = commands.queued
    assert request.expires == expires


def test_the_expiry_of_a_message_counts_from_its_arrival_and_not_from_when_it_is_read() -> None:
    clock = [0.0]
    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line)))
    point = Hcp2Controller(bus, 5).point("1")
    commands = Commands("line", Authorisation(bus), {"5/1": point}, lambda: clock[0])
    clock[0] = 1000.0  # nothing was read for so long
    properties = SimpleNamespace(MessageExpiryInterval=5)
    commands.arrive(cast("Message", Arrived(b"1", properties=properties)))
    [request] = commands.queued
    assert request.expires == pytest.approx(time.time() - 995, abs=60)


def test_a_name_is_as_long_as_the_bound_in_the_topic_of_a_reply() -> None:
    commands = commands_of(one="1")
    for size in (LONGEST_NAME, LONGEST_NAME + 1):
        commands.arrive(cast("Message", Arrived(b"1", topic="line/set/" + size * "y")))
    kept: list[str] = []
    commands.close(lambda request, _: kept.append(request.name))
    assert kept == [LONGEST_NAME * "y", 40 * "y"]


def test_an_answer_has_the_id_of_its_command_and_an_error_only_if_it_failed() -> None:
    assert Answer("5/1", True, "").fields == {"ok": True}
    assert Answer("5/1", True, "", "a").fields == {"ok": True, "id": "a"}
    assert Answer("5/1", False, "refused").fields == {"ok": False, "error": "refused"}
    assert Answer("5/1", False, "refused", "a").fields == {"ok": False, "error": "refused", "id": "a"}


@pytest.mark.asyncio
async def test_each_connection_limits_how_much_the_broker_may_send_before_an_acknowledgement(broker: Broker) -> None:
    from paho.mqtt.packettypes import PacketTypes
    from paho.mqtt.properties import Properties

    limits: list[int | None] = []

    async def pass_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(1000):
            writer.write(data)
        writer.close()

    async def relay(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = await reader.readexactly(2)
        connect = await reader.readexactly(head[1])
        properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        properties.unpack(connect[10:])  # type: ignore[no-untyped-call]
        limits.append(getattr(properties, "ReceiveMaximum", None))
        replies, requests = await asyncio.open_connection("127.0.0.1", broker.port)
        requests.write(head + connect)
        await asyncio.gather(pass_on(reader, requests), pass_on(replies, writer))

    async with await asyncio.start_server(relay, "127.0.0.1", 0) as server:
        port = server.sockets[0].getsockname()[1]
        async with plant(cast("Broker", SimpleNamespace(port=port))) as there:
            assert (await there.ask("1"))["ok"]
    assert limits == [None, mqtt.AHEAD, mqtt_forbidden.AHEAD]

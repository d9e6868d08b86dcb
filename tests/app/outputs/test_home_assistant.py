"""Discovery messages for Home Assistant, by a real mosquitto: their fields, and that their templates fit the topics."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from enum import Enum
from typing import Any

import jinja2
import pytest

from busmaster.app.outputs.home_assistant import HomeAssistant
from busmaster.app.outputs.settings import MqttSettings
from busmaster.bus.bus import Bus
from busmaster.bus.meaning import Meaning
from busmaster.bus.points import Point
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import InvalidCommand, NoReply
from busmaster.ext import Named
from busmaster.protocols.hcp2.handle import Hcp2Controller
from tests.app.outputs.brokers import Broker, needs_mosquitto
from tests.app.outputs.cycles import NODE, cycle
from tests.app.outputs.test_mqtt import emulated, heard, heard_to_the_end, listening, publishing, settled

OF_ALL = {
    *("availability", "availability_mode", "device", "device_class", "entity_category", "json_attributes_template"),
    *("json_attributes_topic", "name", "origin", "state_topic", "unique_id", "value_template"),
}
DOCUMENTED = {
    "sensor": OF_ALL | {"state_class", "suggested_display_precision", "unit_of_measurement"},
    "binary_sensor": OF_ALL | {"payload_on", "payload_off"},
    "number": OF_ALL | {"command_topic", "max", "min", "mode", "step", "unit_of_measurement"},
}
"""Of the configuration variables that Home Assistant documents for MQTT entities, those that are used."""
DEVICE = {"identifiers", "manufacturer", "name", "via_device"}
TOPIC = re.compile(r"homeassistant/(sensor|binary_sensor|number)/[a-zA-Z0-9_-]+/[a-zA-Z0-9_-]+/config")


def check(topic: str, config: dict[str, Any]) -> str:
    """Raise AssertionError for a message that Home Assistant would refuse; return its component."""
    found = TOPIC.fullmatch(topic)
    assert found, topic
    assert set(config) <= DOCUMENTED[found[1]], topic
    assert set(config["device"]) <= DEVICE
    assert {"name", "sw_version"} == set(config["origin"])
    assert config["availability_mode"] == "all"
    for one in config["availability"]:
        assert set(one) <= {"topic", "value_template"}
    return found[1]


def shown(template: str | None, payload: Any) -> str:
    """What Home Assistant makes of a payload."""
    if template is None:
        return str(payload)
    environment = jinja2.Environment()
    environment.filters["tojson"] = json.dumps
    return environment.from_string(template).render(value_json=payload)


def is_available(config: dict[str, Any], messages: dict[str, Any]) -> bool:
    """Whether an entity is available after these messages: each topic has its say."""
    states = [
        shown(one.get("value_template"), messages[one["topic"]]) if one["topic"] in messages else "offline"
        for one in config["availability"]
    ]
    assert set(states) <= {"online", "offline"}
    return "offline" not in states


def state(config: dict[str, Any], messages: dict[str, Any]) -> str:
    return shown(config["value_template"], messages[config["state_topic"]])


def made(point: Point[Any], value: Any, **options: Any) -> list[tuple[str, dict[str, Any]]]:
    found = HomeAssistant("homeassistant", "line", options.pop("commands", {}), **options).value(point, value)
    return [(check(topic, json.loads(payload)), json.loads(payload)) for topic, payload in found]


def test_each_sort_of_value_is_the_entity_that_shows_it() -> None:
    length = replace(NODE.point("1"), unit="mm", meaning=Meaning(precision=2))
    [(component, config)] = made(length, 12.5)
    assert (component, config["unit_of_measurement"], config["state_class"]) == ("sensor", "mm", "measurement")
    assert config["suggested_display_precision"] == 2
    assert state(config, {"line/values/5/1": {"value": 12.5}}) == "12.5"
    [(component, config)] = made(NODE.point("1"), True)
    assert component == "binary_sensor"
    assert [state(config, {"line/values/5/1": {"value": bit}}) for bit in (1, 0)] == ["1", "0"]
    assert (config["payload_on"], config["payload_off"]) == ("1", "0")
    [(component, config)] = made(NODE.point("1"), Named(2, "run"))
    assert "state_class" not in config
    assert state(config, {"line/values/5/1": {"value": 2, "label": "run"}}) == "run"
    assert state(config, {"line/values/5/1": {"value": 7, "label": ""}}) == "7"
    [(component, config)] = made(NODE.point("1"), Mode.JOG)
    assert (component, "state_class" in config) == ("sensor", False)
    assert made(NODE.point("1"), (1, 2)) == made(NODE.point("1"), frozenset({1})) == []
    [(_, config)] = made(replace(NODE.point("1"), meaning=Meaning(precision=0)), 12.5)
    assert config["suggested_display_precision"] == 0
    assert "unit_of_measurement" not in config


class Mode(Enum):
    """A word of a device."""

    JOG = 2


def test_entities_of_two_lines_and_two_nodes_are_different_and_a_node_belongs_to_its_line() -> None:
    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line)))
    configs = [
        json.loads(config.payload)
        for prefix in ("line", "hall 3/line")
        for address in (5, 6)
        for config in HomeAssistant("homeassistant", prefix, {}).value(Hcp2Controller(bus, address).point("1"), 1.5)
    ]
    assert len({config["unique_id"] for config in configs}) == 4
    assert all(config["unique_id"].startswith("busmaster/") for config in configs)
    assert len({tuple(config["device"]["identifiers"]) for config in configs}) == 4
    names = [config["device"]["name"] for config in configs]
    assert names == ["line 5", "line 6", "hall 3/line 5", "hall 3/line 6"], "of equal nodes of two lines too"
    of_line = json.loads(HomeAssistant("homeassistant", "line", {}).line().payload)
    assert [config["device"]["via_device"] in of_line["device"]["identifiers"] for config in configs] == [
        *(True, True, False, False)
    ]


def test_entities_of_a_node_share_its_device_and_have_their_attributes() -> None:
    home = HomeAssistant("homeassistant", "line", {})
    [value] = home.value(NODE.point("1"), 1.5)
    made_of = [value, home.alarm(NODE.point("1")), home.health("5"), home.line()]
    entities = [json.loads(config.payload) for config in made_of]
    assert [one["device"]["identifiers"] for one in entities] == [*3 * [["busmaster/line/5"]], ["busmaster/line"]]
    of_line = ["line/status", "line/line"]
    topics = [[one["topic"] for one in entity["availability"]] for entity in entities]
    assert topics == [[*of_line, "line/values/5/1"], of_line, of_line, ["line/status"]]
    payload = {"quality": "bad", "error": "no reply", "alarm": "high", "health": "down", "reason": "unplugged"}
    attributes = [json.loads(shown(entity["json_attributes_template"], payload)) for entity in entities]
    assert attributes == [
        {"quality": "bad", "error": "no reply"},
        {"alarm": "high"},
        {"health": "down"},
        {"reason": "unplugged"},
    ]
    assert all(entity["json_attributes_topic"] == entity["state_topic"] for entity in entities)


def test_where_the_state_of_the_line_is_not_published_availability_does_not_depend_on_it() -> None:
    messages = {"line/status": "online", "line/values/5/1": {"quality": "good"}}
    for reports_line in (True, False):
        [(_, config)] = made(NODE.point("1"), 1.5, reports_line=reports_line)
        assert is_available(config, messages) is not reports_line


def test_a_point_that_can_be_written_within_limits_is_a_number_too() -> None:
    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line)))
    point = replace(Hcp2Controller(bus, 5).point("10"), unit="N", meaning=Meaning(precision=1))
    assert [component for component, _ in made(point, 1.0, commands={"5/10": point})] == ["sensor"]
    point.limit(maximum=400)
    assert [component for component, _ in made(point, 1.0, commands={"5/10": point})] == ["sensor"], "without a minimum"
    point.limit(minimum=-5, maximum=500)
    [(component, number), (other, sensor)] = made(point, 1.0, commands={"5/10": point})
    assert (component, other) == ("number", "sensor")
    assert (number["command_topic"], number["min"], number["max"], number["step"]) == ("line/set/5/10", -5, 400, 0.1)
    assert number["unique_id"] != sensor["unique_id"]
    assert [component for component, _ in made(point, 1.0)] == ["sensor"], "no command is allowed"


@pytest.mark.parametrize(("precision", "step"), [(None, 0.001), (0, 1), (2, 0.01), (5, 0.001)])
def test_the_step_of_a_number_is_that_of_its_digits_if_home_assistant_takes_it(
    precision: int | None, step: float
) -> None:
    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line)))
    point = replace(Hcp2Controller(bus, 5).point("10"), meaning=Meaning(precision=precision))
    point.limit(minimum=0, maximum=1)
    [(_, number), _] = made(point, 1.0, commands={"5/10": point})
    assert number["step"] == step


def test_the_range_of_a_number_is_that_of_its_own_narrowest_limits() -> None:
    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line)))
    controller = Hcp2Controller(bus, 5)
    point, other = controller.point("10"), controller.point("11")
    other.limit(minimum=-1, maximum=1)
    point.limit(minimum=-5, maximum=400)
    point.limit(minimum=-9, maximum=500)
    [(_, number), _] = made(point, 1.0, commands={"5/10": point})
    assert (number["min"], number["max"]) == (-5, 400)
    point.limit(minimum=400)
    assert [component for component, _ in made(point, 1.0, commands={"5/10": point})] == ["sensor"], "one value"


def test_a_limit_of_zero_bounds_the_range_of_a_number_at_either_end() -> None:
    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line)))
    controller = Hcp2Controller(bus, 5)
    up, down = controller.point("10"), controller.point("11")
    up.limit(minimum=-5, maximum=400)
    up.limit(minimum=0)
    down.limit(minimum=-400, maximum=5)
    down.limit(maximum=0)
    configs = [made(point, -1.0, commands={point.key: point})[0][1] for point in (up, down)]
    assert [(number["min"], number["max"]) for number in configs] == [(0, 400), (-400, 0)]


def test_names_in_topics_have_the_characters_that_are_allowed_and_stay_different() -> None:
    names = ("axis0.position", "axis0_position", "axis0-position", "axis0-2e-position", "Länge", "a+b", "a/b")
    topics = set()
    for name in names:
        for topic, payload in HomeAssistant("homeassistant", "hall 3/line", {}).value(
            replace(NODE.point("1"), item=name), 1
        ):
            check(topic, json.loads(payload))
            topics.add(topic)
    assert len(topics) == len(names)


def test_messages_of_cycles_have_no_topics_that_could_be_discovered() -> None:
    with pytest.raises(InvalidCommand, match='home_assistant needs messages = "point"'):
        MqttSettings(home_assistant="homeassistant", messages="cycle")
    with pytest.raises(InvalidCommand, match='home_assistant needs messages = "point"'):
        MqttSettings(enabled=False, home_assistant="homeassistant", messages="cycle")


@needs_mosquitto
@pytest.mark.asyncio
async def test_entities_appear_before_their_values_and_are_retained(broker: Broker) -> None:
    async with emulated(Hcp2Controller, 5) as bus, listening(broker, "#") as client:
        async with publishing(broker, bus, home_assistant="homeassistant") as output:
            output.offer(cycle(1, 12.5, NoReply("no reply")))
            output.offer(cycle(2, 13.5, 2.0))
            await settled(output)
        messages = [(topic, payload) for topic, payload, _ in await heard_to_the_end(client)]
    topics = [topic for topic, _ in messages]
    for item in ("1", "2"):
        config = next(at for at, topic in enumerate(topics) if topic.endswith(f"/5-2f-{item}/config"))
        values = [at for at, topic in enumerate(topics) if topic == f"line/values/5/{item}"]
        good = next(at for at in values if messages[at][1]["error"] is None)
        assert config < good
        assert sum(topic == topics[config] for topic in topics) == 1
    async with listening(broker, "homeassistant/#") as client:
        kept = await heard(client, 3)
    assert {retained for *_, retained in kept} == {True}
    found = sorted(check(topic, config) for topic, config, _ in kept)
    assert found == ["binary_sensor", "sensor", "sensor"]  # the line's state, and the two points


@needs_mosquitto
@pytest.mark.asyncio
async def test_a_broker_that_has_lost_its_messages_gets_the_entities_again(broker: Broker) -> None:
    async with emulated(Hcp2Controller, 5) as bus:
        async with publishing(broker, bus, home_assistant="homeassistant") as output:
            output.offer(cycle(1, 12.5, 2.0))
            await settled(output)
            broker.stop()
            broker.forget()
            broker.start()
            output.offer(cycle(2, 13.5, 3.0))
            await settled(output)
        async with listening(broker, "homeassistant/sensor/#") as client:
            kept = await heard(client, 2)
    assert sorted(topic.rpartition("-2f-")[2] for topic, _, _ in kept) == ["1/config", "2/config"]


@needs_mosquitto
@pytest.mark.asyncio
async def test_availability_follows_the_program_the_line_and_the_point(broker: Broker) -> None:
    async with emulated(Hcp2Controller, 5) as bus, listening(broker, "#") as client:
        async with publishing(broker, bus, home_assistant="homeassistant") as output:
            output.offer(cycle(1, 12.5, 2.0))
            output.offer(cycle(2, 13.5, NoReply("no reply")))
            await settled(output)
        messages = await heard_to_the_end(client)
    configs = {topic: payload for topic, payload, _ in messages if topic.endswith("/config")}
    latest: dict[str, Any] = {}
    states: list[tuple[bool, bool]] = []
    one, two = (configs[f"homeassistant/sensor/line/5-2f-{item}/config"] for item in ("1", "2"))
    for topic, payload, _ in messages:
        latest[topic] = payload
        state_now = (is_available(one, latest), is_available(two, latest))
        if not states or states[-1] != state_now:
            states.append(state_now)
    assert (True, True) in states
    assert states[states.index((True, True)) + 1] == (True, False), "the second point was not read in cycle 2"
    assert states[-1] == (False, False), "the program has ended"
    del latest["line/status"]
    latest["line/status"], latest["line/line"] = "online", {"line": "offline"}
    assert not is_available(one, latest), "the line is lost"
    latest["line/line"] = {"line": "ready"}
    assert is_available(one, latest)


@needs_mosquitto
@pytest.mark.asyncio
async def test_nodes_the_line_and_alarms_are_entities(broker: Broker) -> None:
    bus = emulated(Hcp2Controller, 5)
    point = replace(Hcp2Controller(bus, 5).point("1"), meaning=Meaning(high=100))
    async with bus, listening(broker, "#") as client:
        bus.poll_group("axes", period=0.05, points=[point])
        async with publishing(broker, bus, home_assistant="homeassistant"):
            latest: dict[str, Any] = {}
            while not {"line/health/5", "line/line", "line/alarms/5/1"} <= set(latest):
                [(topic, payload, _)] = await heard(client, 1)
                latest[topic] = payload
    configs = {topic.split("/")[-2]: payload for topic, payload in latest.items() if check_if_config(topic, payload)}
    assert set(configs) == {"line", "health-2f-5", "alarms-2f-5-2f-1"}
    assert state(configs["line"], latest) == "ON"
    assert state(configs["line"], {"line/line": {"line": "offline"}}) == "OFF"
    assert state(configs["alarms-2f-5-2f-1"], latest) == "OFF"
    assert state(configs["alarms-2f-5-2f-1"], {"line/alarms/5/1": {"alarm": "high"}}) == "ON"
    assert configs["line"]["availability"] == [{"topic": "line/status"}], "a lost line is a state, not an absence"
    for health, expected in (("up", "ON"), ("suspect", "ON"), ("down", "OFF"), ("offline", "OFF")):
        assert state(configs["health-2f-5"], {"line/health/5": {"health": health}}) == expected


def check_if_config(topic: str, payload: Any) -> bool:
    return topic.startswith("homeassistant/") and bool(check(topic, payload))


@needs_mosquitto
@pytest.mark.asyncio
async def test_a_command_of_the_number_entity_is_written(broker: Broker) -> None:
    bus = emulated(Hcp2Controller, 5)
    point = Hcp2Controller(bus, 5).point("10")
    point.limit(minimum=0, maximum=500)
    async with bus, listening(broker, "#") as client:
        bus.poll_group("axes", period=0.05, points=[point])
        async with publishing(broker, bus, home_assistant="homeassistant", commands={"5/10": point}) as output:
            output.offer(bus.groups[0].latest or cycle(1, 1.0))
            output.offer(await anext(aiter(bus.groups[0])))
            topic = ""
            while not topic.startswith("homeassistant/number/"):
                [(topic, config, _)] = await heard(client, 1)
            await client.publish(config["command_topic"], "125.0")
            while topic != "line/result/5/10":
                [(topic, result, _)] = await heard(client, 1)
            assert result == {"ok": True}
            assert await point.read() == 125


@needs_mosquitto
@pytest.mark.asyncio
async def test_without_the_option_nothing_is_announced(broker: Broker) -> None:
    async with listening(broker, "#") as client:
        async with publishing(broker) as output:
            output.offer(cycle(1, 12.5))
            await settled(output)
        assert not [topic for topic, *_ in await heard_to_the_end(client) if "/config" in topic]

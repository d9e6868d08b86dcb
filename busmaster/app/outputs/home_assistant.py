"""Discovery messages for Home Assistant: what the topics of the output `mqtt` are, so that it shows them by itself.

Each point, node and alarm is one entity with a retained message at PREFIX/COMPONENT/LINE/NAME/config. An entity is
available while busmaster runs, the line is not lost and, for a value, the point can be read.
"""

from __future__ import annotations

import enum
import json
import re
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from typing import Any, NamedTuple

from busmaster import Node, Point
from busmaster.app.outputs.mqtt_connection import topic_part
from busmaster.ext import Named, Placed

NOT_IN_A_NAME = re.compile("[^a-zA-Z0-9_]")
"""Home Assistant reads a discovery topic only if its names have these characters, or `-`, which escapes others here."""
SMALLEST_STEP = 0.001
"""Of a number in Home Assistant; a smaller one is refused."""
VALUE = "{{ value_json.value }}"
NAME_OR_VALUE = "{{ value_json.label or value_json.value }}"
QUALITY = "{{ {'quality': value_json.quality, 'error': value_json.error} | tojson }}"


class Config(NamedTuple):
    """One discovery message."""

    topic: str
    payload: str


class HomeAssistant:
    """Makes discovery messages for the topics below `prefix`.

    `discovery` is the prefix of Home Assistant. `commands` are the points that commands may write, by their names in
    topics. Without `reports_line`, the line's state is not published, and availability does not depend on it.
    """

    def __init__(
        self, discovery: str, prefix: str, commands: Mapping[str, Point[Any]], *, reports_line: bool = True
    ) -> None:
        self._discovery = discovery
        self._prefix = prefix
        self._commands = commands
        self._available = [{"topic": self._topic("status")}]
        if reports_line:
            template = "{{ 'offline' if value_json.line == 'offline' else 'online' }}"
            self._available.append({"topic": self._topic("line"), "value_template": template})
        self._line = {"identifiers": [f"busmaster/{prefix}"], "name": prefix, "manufacturer": "busmaster"}

    def value(self, point: Point[Any], value: Any) -> Iterator[Config]:
        """Yield the entity of a point that has this value. A list of values has none: it has no single state."""
        if isinstance(value, (list, tuple, set, frozenset)):
            return
        name = topic_part(point.key)
        topic = self._topic("values", name)
        template = "{{ 'offline' if value_json.quality == 'bad' else 'online' }}"
        fields: dict[str, Any] = {
            "name": point.key.partition("/")[2],
            "state_topic": topic,
            "json_attributes_topic": topic,
            "json_attributes_template": QUALITY,
            "availability": [*self._available, {"topic": topic, "value_template": template}],
            "device": self._device(point.key.partition("/")[0]),
        }
        number = self._number(name) if name in self._commands else None
        if isinstance(value, bool):
            fields |= {"value_template": VALUE, "payload_on": "1", "payload_off": "0"}
            yield self._config("binary_sensor", name, topic, fields)
        elif isinstance(value, (Named, enum.Enum)) or not isinstance(value, int | float):
            yield self._config("sensor", name, topic, fields | {"value_template": NAME_OR_VALUE})
        else:
            fields |= {"value_template": VALUE}
            if point.unit:
                fields["unit_of_measurement"] = point.unit
            if number is not None:
                command = {**fields, "command_topic": self._topic("set", name), **number}
                yield self._config("number", name, f"{topic}/set", command)
            fields["state_class"] = "measurement"
            if point.meaning.precision is not None:
                fields["suggested_display_precision"] = point.meaning.precision
            yield self._config("sensor", name, topic, fields)

    def health(self, name: str) -> Config:
        """Return the entity of a node's health, by the node's name in topics."""
        topic = self._topic("health", name)
        fields = {
            "name": "health",
            "device_class": "connectivity",
            "entity_category": "diagnostic",
            "state_topic": topic,
            "value_template": "{{ 'OFF' if value_json.health in ('down', 'offline') else 'ON' }}",
            "json_attributes_topic": topic,
            "json_attributes_template": "{{ {'health': value_json.health} | tojson }}",
            "availability": self._available,
            "device": self._device(name),
        }
        return self._config("binary_sensor", f"health/{name}", topic, fields)

    def line(self) -> Config:
        """Return the entity of the line's state. It is available while busmaster runs, also while the line is lost."""
        topic = self._topic("line")
        fields = {
            "name": "line",
            "device_class": "connectivity",
            "entity_category": "diagnostic",
            "state_topic": topic,
            "value_template": "{{ 'OFF' if value_json.line == 'offline' else 'ON' }}",
            "json_attributes_topic": topic,
            "json_attributes_template": "{{ {'reason': value_json.reason} | tojson }}",
            "availability": self._available[:1],
            "device": self._line,
        }
        return self._config("binary_sensor", "line", topic, fields)

    def alarm(self, point: Point[Any]) -> Config:
        """Return the entity of a point's alarm."""
        topic = self._topic("alarms", topic_part(point.key))
        node, _, item = point.key.partition("/")
        fields = {
            "name": f"{item} alarm",
            "device_class": "problem",
            "state_topic": topic,
            "value_template": "{{ 'ON' if value_json.alarm else 'OFF' }}",
            "json_attributes_topic": topic,
            "json_attributes_template": "{{ {'alarm': value_json.alarm} | tojson }}",
            "availability": self._available,
            "device": self._device(node),
        }
        return self._config("binary_sensor", f"alarms/{topic_part(point.key)}", topic, fields)

    def _config(self, component: str, name: str, unique: str, fields: Mapping[str, Any]) -> Config:
        payload = {
            **fields,
            "unique_id": f"busmaster/{unique}",
            "availability_mode": "all",
            "origin": {"name": "busmaster", "sw_version": version("busmaster")},
        }
        topic = f"{self._discovery}/{component}/{_name(self._prefix)}/{_name(name)}/config"
        return Config(topic, json.dumps(payload, ensure_ascii=False))

    def _device(self, node: str) -> dict[str, Any]:
        line = self._line["identifiers"][0]
        return {
            "identifiers": [f"{line}/{topic_part(node)}"],
            "name": f"{self._prefix} {node}",
            "manufacturer": "busmaster",
            "via_device": line,
        }

    def _number(self, name: str) -> dict[str, Any] | None:
        """Return the range of a point that can be written; None without both limits, which Home Assistant needs."""
        point = self._commands[name]
        lowest, highest = _limits(point)
        if lowest is None or highest is None or not lowest < highest:
            return None
        precision = point.meaning.precision
        step = SMALLEST_STEP if precision is None else max(10.0**-precision, SMALLEST_STEP)
        return {"min": lowest, "max": highest, "step": step, "mode": "box"}

    def _topic(self, *parts: str) -> str:
        return "/".join((self._prefix, *parts))


def _name(name: str) -> str:
    """Return a name with characters that a discovery topic may have. Two names stay two."""
    return NOT_IN_A_NAME.sub(lambda found: f"-{ord(found[0]):x}-", name)


def _limits(point: Point[Any]) -> tuple[float | None, float | None]:
    """Return the narrowest limits of a point: writes below or above them are refused."""
    node, command = point.node, point.command
    limits = [
        limit
        for limit in (node.limits if isinstance(node, Node) else ())
        if isinstance(command, Placed) and set(limit.places) & set(command.places)
    ]
    lowest = [limit.minimum for limit in limits if limit.minimum is not None]
    highest = [limit.maximum for limit in limits if limit.maximum is not None]
    return max(lowest, default=None), min(highest, default=None)

"""A client of OPC UA that is not of the library that the server is of."""

from __future__ import annotations

import contextlib
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import opcua
from opcua import ua

from tests.patience import PATIENCE


@dataclass(frozen=True)
class Told:
    """What a variable was at some time: its value, the name of its status, and when it was read."""

    value: Any
    status: str
    when: datetime


class OtherClient:
    """Reads, writes and subscribes. Points are named as the line names them."""

    def __init__(self, client: Any) -> None:
        self.client = client

    def node(self, name: str) -> Any:
        """A point by its key, or, as "Line Connected", something else that is known of the line."""
        return self.client.get_node(f"ns={3 if ' ' in name else 2};s={name}")

    def read(self, name: str) -> Told:
        wanted = ua.ReadValueId()
        wanted.NodeId, wanted.AttributeId = self.node(name).nodeid, ua.AttributeIds.Value
        asked = ua.ReadParameters()
        asked.NodesToRead.append(wanted)
        [said] = self.client.uaclient.read(asked)
        return _told(said)

    def property(self, name: str, property_: str) -> Any:
        return self.node(name).get_child(f"0:{property_}").get_value()

    def type_of(self, name: str) -> tuple[str, str]:
        """Return the name of a variable's type, as the variable says and as a browse of its parent does."""
        node = self.node(name)
        own = self.client.get_node(node.get_type_definition()).get_browse_name().Name
        [seen] = [one for one in node.get_parent().get_references() if one.IsForward and one.NodeId == node.nodeid]
        return own, self.client.get_node(seen.TypeDefinition).get_browse_name().Name

    def user_access(self, name: str) -> int:
        """Return what this user may do with a point: a mask of bits."""
        return int(self.node(name).get_attribute(ua.AttributeIds.UserAccessLevel).Value.Value)

    def write(self, name: str, value: Any, kind: Any = ua.VariantType.Double) -> str:
        """Write a value, and return the name of the status."""
        wanted = ua.WriteValue()
        wanted.NodeId, wanted.AttributeId = self.node(name).nodeid, ua.AttributeIds.Value
        wanted.Value = ua.DataValue(ua.Variant(value, kind))
        return self.status_of(wanted)

    def status_of(self, wanted: Any) -> str:
        asked = ua.WriteParameters()
        asked.NodesToWrite.append(wanted)
        [status] = self.client.uaclient.write(asked)
        return str(status.name)

    @contextlib.contextmanager
    def subscribed(self, names: Sequence[str], interval: int = 50) -> Iterator[Heard]:
        heard = Heard()
        subscription = self.client.create_subscription(interval, heard)
        subscription.subscribe_data_change([self.node(name) for name in names])
        try:
            yield heard
        finally:
            subscription.delete()


class Heard:
    """What a subscription tells, by the names of the points."""

    def __init__(self) -> None:
        self.told: dict[str, list[Told]] = defaultdict(list)
        self._news = threading.Condition()

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
        with self._news:
            self.told[node.nodeid.Identifier].append(_told(data.monitored_item.Value))
            self._news.notify_all()

    def wait(self, name: str, fact: Callable[[Told], object]) -> None:
        """Wait until `fact` holds for what was told of this one last."""
        with self._news:
            found = self._news.wait_for(lambda: self.told[name] and fact(self.told[name][-1]), PATIENCE)
            assert found, f"{name} was told {self.told[name][-3:]}"


def _told(said: Any) -> Told:
    when = said.SourceTimestamp or datetime.fromtimestamp(0)  # noqa: DTZ006  it is made one of UTC
    return Told(said.Value.Value, said.StatusCode.name, when.replace(tzinfo=UTC))


@contextlib.contextmanager
def other_client(url: str, **options: Any) -> Iterator[OtherClient]:
    client = opcua.Client(url, timeout=PATIENCE)
    for name, value in options.items():
        getattr(client, name)(*value)
    client.connect()
    try:
        yield OtherClient(client)
    finally:
        client.disconnect()

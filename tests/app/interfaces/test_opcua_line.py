"""What OPC UA clients see of a line and write to it, without a server: its address space is a dictionary."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from types import SimpleNamespace
from typing import Any, cast

import pytest
from asyncua import ua
from asyncua.crypto.permission_rules import User

from busmaster.app.interfaces import followed_groups, opcua
from busmaster.app.interfaces.following import Connected, Lost
from busmaster.app.interfaces.opcua import Health, LineServer
from busmaster.app.interfaces.opcua_access import Rules
from busmaster.app.interfaces.opcua_space import Space, Variable
from busmaster.app.interfaces.opcua_terms import CODES
from busmaster.app.service.permission import digest_of
from busmaster.app.service.picture import Group, Node, Row
from busmaster.bus.polling import Quality
from busmaster.errors import InvalidCommand, LineDown, NoReply, NotStarted, WriteUnconfirmed
from tests.app.interfaces.test_following import connected, row, shown_frame
from tests.app.interfaces.test_modbus_tcp import Owner, read_cycle, row_of
from tests.patience import PATIENCE

pytestmark = pytest.mark.asyncio
GONE = CODES.BadOutOfService


class Shown:
    """The address space, as its clients see it."""

    def __init__(self) -> None:
        self.line, self.nodes, self.groups = (ua.NodeId(name, 3) for name in ("Line", "Nodes", "Groups"))
        self.values: dict[str, tuple[Any, int, float]] = {}
        self.puts: list[str] = []
        self.kinds: dict[str, tuple[Any, bool]] = {}
        self.types: dict[str, int] = {}
        self.properties: dict[tuple[str, str], Any] = {}
        self.writable: dict[str, bool] = {}
        self.described: dict[str, str] = {}
        self.objects: list[tuple[str, str]] = []

    async def object(self, key: str, name: str, _parent: ua.NodeId) -> ua.NodeId:
        self.objects.append((key, name))
        return ua.NodeId(key, 3)

    async def variable(self, key: str, _name: str, _parent: ua.NodeId) -> Variable:
        return Variable(cast("Space", self), ua.NodeId(key, 3))

    async def point(self, key: str, _name: str, _parent: ua.NodeId, described: str) -> Variable:
        self.described[key] = described
        return Variable(cast("Space", self), ua.NodeId(key, 2))

    async def put(self, place: ua.NodeId, value: ua.Variant | None, status: int, when: float) -> None:
        self.values[place.Identifier] = None if value is None else value.Value, status, when
        self.puts.append(place.Identifier)

    async def retype(self, place: ua.NodeId, kind: ua.VariantType, *, is_list: bool) -> None:
        self.kinds[place.Identifier] = kind, is_list

    def set_type(self, place: ua.NodeId, type_: int) -> None:
        self.types[place.Identifier] = type_

    async def give_property(self, parent: ua.NodeId, name: str, value: Any) -> None:
        self.properties[parent.Identifier, name] = value

    async def give_access(self, place: ua.NodeId, writable: bool) -> None:
        self.writable[place.Identifier] = writable

    def state(self, *keys: str) -> list[tuple[Any, str]]:
        return [(self.values[key][0], ua.StatusCode(self.values[key][1]).name) for key in keys]


class Overview:
    """What an owner knows of its points, and what becomes of writes to them."""

    def __init__(self) -> None:
        self.limits: list[dict[str, Any]] = []
        self.labels: dict[str, str] = {}
        self.writes: list[tuple[str, str, Any]] = []
        self.error: Exception | None = None
        self.is_gone = False
        self.wrote: Callable[[], None] = lambda: None

    async def details(self, _group: str, key: str) -> dict[str, Any]:
        if self.is_gone:
            raise LineDown("closed")
        command = f"read {key}"
        return {"command": command, "limits": self.limits, "labels": self.labels, "low": None, "high": None}

    async def write(self, *what: Any) -> None:
        self.writes.append(what)
        self.wrote()
        if self.error is not None:
            raise self.error


class Story:
    """A line, its owner, and the nodes that show it."""

    def __init__(self, *rows: Row, rules: Rules | None = None) -> None:
        self.owner = Owner()
        self.overview = Overview()
        self.line = connected(self.owner)
        self.line._overview = cast("Any", self.overview)
        self.reports: list[str] = []
        server: Any = SimpleNamespace(iserver=SimpleNamespace(isession=None))
        self.server = LineServer(server, self.line, rules or Rules(allow=("*",)), self.reports.append)
        self.shown = Shown()
        self.server._space = cast("Space", self.shown)
        self.server._health = Health(cast("Space", self.shown), self.line, self.server._groups)
        self.has(*rows)

    def has(self, *rows: Row) -> None:
        """Give the line these points."""
        self.line.picture._rows = {0: list(rows)}
        self.line.picture.frame = shown_frame(points=len(rows))
        self.server._receive("rows", {})

    async def show(self, *cycles: Any, group: str = "axes") -> None:
        """Have the present state shown, and these cycles of a group."""
        await self.server._show()
        for one in cycles:
            self.owner.groups[group].cycles.put_nowait(one)
        for _ in range(5):
            await asyncio.sleep(0)

    def replace_owner(self, now: float) -> None:
        self.owner = Owner(now)
        self.line._remote, self.line.state = cast("Any", self.owner), Connected({"read_only": False})

    async def end(self) -> None:
        await self.server._groups.leave()

    async def write(self, key: str = "winder/1", value: Any = 12.5, *, user: str | None = None, **data: Any) -> str:
        """The status of a write."""
        wanted = ua.WriteValue(ua.NodeId(key, 2), data.pop("attribute", ua.AttributeIds.Value))
        wanted.IndexRange = data.pop("part", None)
        fields = {"StatusCode": None, "SourceTimestamp": None, "ServerTimestamp": None, **data}
        wanted.Value = ua.DataValue(ua.Variant(value), **fields)
        return str(ua.StatusCode(await self.server.write(wanted, User(name=user))).name)


def touched(item: str, when: float) -> dict[str, Any]:
    return {"protocol": "hcp2", "address": 5, "when": when, "items": [item], "all": False}


async def test_each_point_has_the_value_and_status_of_its_last_read() -> None:
    story = Story(row_of("1"), row_of("2"), row_of("4"))
    await story.show()
    assert story.server.has_points.is_set()
    assert story.shown.described["winder/2"] == "winder 2 (read winder/2)"
    # a value of a point that is not shown, 3, and one that has no type, before one that has
    read = read_cycle(1.5, NoReply("no reply"), 3.0, 4.5)
    await story.show(read)
    times = {point.item: sample.wall for point, sample in read.samples.items()}
    assert {key: story.shown.values[f"winder/{key}"][2] for key in "124"} == {key: times[key] for key in "124"}
    assert story.shown.state("winder/1", "winder/2", "winder/4") == [
        *((1.5, "Good"), (None, "BadNoCommunication"), (4.5, "Good"))
    ]
    await story.show(read_cycle({}, 2.5, 3.0, 4.0, at=101.0))
    assert story.shown.state("winder/1", "winder/2") == [(None, "BadDataEncodingUnsupported"), (2.5, "Good")]
    await story.show(read_cycle(1.0, 2.0, 3.0, 4.0, at=102.0, quality=Quality.STALE))
    assert story.shown.state("winder/2", "winder/4") == [
        (2.0, "UncertainLastUsableValue"),
        (4.0, "UncertainLastUsableValue"),
    ]
    await story.end()


async def test_a_number_beyond_all_types_is_bad_and_the_values_behind_it_are_shown() -> None:
    story = Story(row_of("1"), row_of("2"))
    await story.show()
    for number in (10**400, (1.5, 10**400)):
        await story.show(read_cycle(number, 2.5))
        assert story.shown.state("winder/1", "winder/2") == [(None, "BadDataEncodingUnsupported"), (2.5, "Good")]
    await story.end()


async def test_of_two_points_of_a_group_with_one_item_the_first_is_shown() -> None:
    story = Story(row_of("1"))
    await story.show()
    snapshot = read_cycle(1.0, 2.0)
    same = {replace(point, item="1"): sample for point, sample in snapshot.samples.items()}
    assert len(same) == 2
    await story.show(replace(snapshot, samples=same))
    assert story.shown.state("winder/1") == [(1.0, "Good")]
    await story.end()


async def test_clients_have_their_turn_within_a_long_cycle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opcua, "AT_ONCE", 2)
    story = Story(*(row_of(str(number)) for number in range(1, 6)))
    await story.show()
    before = len(story.shown.puts)
    taking = asyncio.ensure_future(story.server._take("axes", read_cycle(1.0, 2.0, 3.0, 4.0, 5.0)))
    counts = []
    while not taking.done():
        await asyncio.sleep(0)
        counts.append(len(story.shown.puts) - before)
    assert counts == [2, 4, 5]
    await story.end()


async def test_a_write_makes_the_value_of_its_point_uncertain_until_it_was_read_again() -> None:
    story = Story(row_of("1"), row_of("2"))
    await story.show()
    await story.show(read_cycle(1.0, 2.0))
    when = story.shown.values["winder/1"][2]
    story.server._receive_touched(touched("1", 100.5))
    await story.show()
    assert story.shown.state("winder/1", "winder/2") == [(1.0, "UncertainLastUsableValue"), (2.0, "Good")]
    assert story.shown.values["winder/1"][2] == when, "the time of a value is that of its read"
    puts = len(story.shown.puts)
    await story.show()
    assert "winder/1" not in story.shown.puts[puts:]
    await story.show(read_cycle(1.0, 2.0, at=100.2))  # it was read before the write
    assert story.shown.state("winder/1", "winder/2") == [(1.0, "UncertainLastUsableValue"), (2.0, "Good")]
    await story.show(read_cycle(1.0, 2.0, at=100.6))
    assert story.shown.state("winder/1", "winder/2") == [(1.0, "Good"), (2.0, "Good")]
    await story.end()


async def test_a_value_that_was_requested_before_a_write_and_came_after_it_is_uncertain() -> None:
    story = Story(row_of("1"), row_of("2"))
    await story.show()
    snapshot = read_cycle(1.0, 2.0)
    later = {point: sample._replace(started=100.0, finished=100.4) for point, sample in snapshot.samples.items()}
    late = replace(snapshot, samples=later)
    await story.show(late)
    assert story.shown.state("winder/1", "winder/2") == [(1.0, "Good"), (2.0, "Good")]
    story.server._receive_touched(touched("1", 100.2))
    await story.show()
    assert story.shown.state("winder/1", "winder/2") == [(1.0, "UncertainLastUsableValue"), (2.0, "Good")]
    await story.show(late)
    assert story.shown.state("winder/1", "winder/2") == [(1.0, "UncertainLastUsableValue"), (2.0, "Good")]
    await story.end()


async def test_values_of_a_lost_line_are_bad_but_for_those_that_were_read_since() -> None:
    story = Story(row_of("1"), row_of("2"))
    await story.show()
    await story.show(read_cycle(1.0, 2.0))
    await story.show(read_cycle(1.5, at=103.0))
    ended = story.server._by_id[ua.NodeId("winder/2", 2)].read
    story.line.picture.frame = shown_frame(points=2, now=ended, state="offline")  # in the moment of its reply
    await story.show()
    assert story.shown.state("winder/1", "winder/2") == [(1.5, "Good"), (None, "BadNoCommunication")]
    puts = len(story.shown.puts)
    await story.show()
    assert "winder/2" not in story.shown.puts[puts:]
    await story.end()


async def test_a_group_without_cycles_makes_its_values_uncertain() -> None:
    story = Story(row_of("1", "fast"), row_of("2", "slow"))
    story.line.picture._groups = {0: [Group("fast", 0.02), Group("slow", 10.0)]}
    await story.show()
    await story.show(read_cycle(1.0), group="fast")
    await story.show(read_cycle(0.0, 2.0), group="slow")
    assert story.shown.state("winder/1", "winder/2") == [(1.0, "Good"), (2.0, "Good")]
    story.owner.time = 102.0
    await story.show()
    assert story.shown.state("winder/1", "winder/2") == [(1.0, "UncertainLastUsableValue"), (2.0, "Good")]
    await story.end()


async def test_while_the_owner_is_away_there_are_no_values_and_the_next_one_has_a_clock_of_its_own() -> None:
    story = Story(row_of("1"))
    story.line.picture._nodes = {0: [Node("winder", "hcp2", 5, "up")]}
    await story.show()
    await story.show(read_cycle(1.0))
    story.server._receive_touched(touched("1", 100.5))
    groups = story.owner.groups
    story.line.state = Lost("gone")
    story.line._remote = None
    await story.show()
    assert story.shown.state("winder/1", "Line Connected", "Line State", "Nodes/hcp2 5 Health") == [
        *((None, "BadOutOfService"), (False, "Good"), (None, "BadOutOfService"), (None, "BadOutOfService"))
    ]
    assert groups["axes"].closes == 1
    puts = len(story.shown.puts)
    await story.show()
    assert len(story.shown.puts) == puts, "what does not change is not sent again"
    story.replace_owner(7.0)
    await story.show()
    await story.show(read_cycle(1.0, at=7.0))
    assert story.shown.state("winder/1", "Line Connected") == [(1.0, "Good"), (True, "Good")]
    await story.end()


async def test_points_of_an_owner_that_ends_while_they_are_described_are_described_by_the_next_look() -> None:
    story = Story(row_of("1"))
    story.overview.is_gone = True
    await story.show()
    assert not story.server.has_points.is_set()
    story.overview.is_gone = False
    await story.show()
    assert story.server.has_points.is_set()
    await story.end()


async def test_points_are_shown_when_all_are_known_and_one_that_has_gone_says_so() -> None:
    story = Story(row_of("1"), row_of("2"))
    story.line.picture.frame = shown_frame(points=3)
    await story.show()
    assert story.shown.described == {}
    story.line.picture.frame = shown_frame(points=2)
    await story.show()
    await story.show(read_cycle(1.0, 2.0))
    story.has(row_of("1", unit="mm"))
    await story.show()
    assert story.shown.state("winder/1", "winder/2") == [(1.0, "Good"), (None, "BadConfigurationError")]
    assert story.shown.properties["winder/1", "EngineeringUnits"].DisplayName.Text == "mm"
    assert story.shown.properties["winder/2", "EngineeringUnits"] is None
    await story.show(read_cycle(1.0, at=101.0))
    story.line.picture.frame = shown_frame(points=1, now=200.0, state="offline")
    await story.show()
    assert story.shown.state("winder/1", "winder/2") == [(None, "BadNoCommunication"), (None, "BadConfigurationError")]
    await story.end()


async def test_of_a_point_in_two_groups_the_values_of_the_first_are_shown() -> None:
    story = Story(row_of("1", "fast"), row_of("1", "slow"), row_of("2", "slow"))
    await story.show()
    await story.show(read_cycle(1.0), group="fast")
    await story.show(read_cycle(9.0, 2.0), group="slow")
    assert story.shown.state("winder/1", "winder/2") == [(1.0, "Good"), (2.0, "Good")]
    await story.end()


async def test_groups_that_end_are_requested_again_and_count_what_was_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(followed_groups, "ASK_AGAIN", 0.0)
    story = Story(row_of("1"))
    story.line.picture._groups = {0: [Group("axes", 0.02)]}
    await story.show()
    group = story.owner.groups["axes"]
    group.dropped = 3
    await story.show(read_cycle(1.0), NoReply("gone"))
    await story.show(read_cycle(2.0))
    await story.show()
    assert (group.subscriptions, group.closes) == (2, 1)
    assert story.shown.state("winder/1", "Groups/axes Dropped") == [(2.0, "Good"), (3, "Good")]
    story.has(row_of("1", "other"))
    await story.show()
    assert group.closes == 2
    await story.show(read_cycle(5.0, at=101.0), group="other")
    assert story.shown.state("winder/1") == [(5.0, "Good")], "the values are those of the group that has the point now"
    await story.end()


async def test_points_beyond_the_bound_are_not_shown_and_two_with_one_name_are_different(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(opcua, "MOST_SHOWN_POINTS", 2)
    of_another = row(item="1", key="winder/1", protocol="modbus", writable=True)
    story = Story(row_of("1", writable=True), of_another, row_of("3"))
    await story.show()
    assert list(story.shown.described) == ["winder/1", "modbus:winder/1"]
    assert story.shown.writable == {"winder/1": True, "modbus:winder/1": False}
    await story.end()


@pytest.mark.parametrize(
    ("writable", "allow", "shown"),
    [(True, ("winder/*",), True), (True, ("other/*", "winder/1"), True), (True, (), False), (False, ("*",), False)],
)
async def test_a_point_is_writable_if_it_is_and_the_rules_name_it(
    writable: bool, allow: tuple[str, ...], shown: bool
) -> None:
    story = Story(row_of("1", writable=writable), rules=Rules(allow=allow))
    await story.show()
    await story.show(read_cycle(1.0))
    assert story.shown.writable == {"winder/1": shown}
    assert await story.write() == ("Good" if shown else "BadNotWritable")
    await story.end()


async def ready(rules: Rules | None = None) -> Story:
    """A line with one writable point that has been read."""
    story = Story(row_of("1", writable=True), rules=rules)
    await story.show()
    await story.show(read_cycle(1.0))
    return story


NOW = datetime(2026, 1, 1, tzinfo=UTC)


@pytest.mark.parametrize(
    ("what", "status"),
    [
        ({"key": "winder/9"}, "BadNotWritable"),
        ({"attribute": ua.AttributeIds.Description}, "BadNotWritable"),
        ({"part": "0:1"}, "BadWriteNotSupported"),
        ({"SourceTimestamp": NOW}, "BadWriteNotSupported"),
        ({"ServerTimestamp": NOW}, "BadWriteNotSupported"),
        ({"StatusCode": ua.StatusCode(CODES.BadOutOfService)}, "BadWriteNotSupported"),
        ({"StatusCode": ua.StatusCode(CODES.Good)}, "Good"),
        ({"value": "fast"}, "BadTypeMismatch"),
        ({"value": None}, "BadTypeMismatch"),
        ({"value": 7}, "Good"),
    ],
)
async def test_a_write_that_cannot_be_carried_out_as_it_is_meant_is_refused(what: dict[str, Any], status: str) -> None:
    story = await ready()
    assert await story.write(**what) == status
    assert len(story.overview.writes) == (status == "Good")
    await story.end()


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (None, "Good"),
        (InvalidCommand("the node is locked"), "BadRequestNotAllowed"),
        (NotStarted("busy"), "BadNoCommunication"),
        (WriteUnconfirmed("no reply"), "BadTimeout"),
    ],
)
async def test_a_write_is_reported_with_its_client_and_its_outcome(error: Exception | None, status: str) -> None:
    story = await ready()
    story.overview.error = error
    story.overview.wrote = lambda: story.server._receive_touched(touched("1", 100.5))
    assert await story.write(user="scada") == status
    assert await story.write(value=13.0) == status
    assert story.overview.writes == [("axes", "winder/1", 12.5), ("axes", "winder/1", 13.0)]
    outcome = "written" if error is None else str(error)
    assert story.reports == [
        f"user scada: winder/1 = 12.5: {outcome}",
        f"an anonymous user: winder/1 = 13.0: {outcome}",
    ]
    assert story.shown.state("winder/1") == [(1.0, "UncertainLastUsableValue")], "before the client has its reply"
    await story.end()


async def test_a_value_beyond_a_limit_is_out_of_range() -> None:
    story = await ready()
    story.overview.error = InvalidCommand("above its maximum of 5")
    story.overview.limits = [{"name": "1", "minimum": None, "maximum": 5}]
    assert await story.write() == "BadOutOfRange"
    assert await story.write(value=4.0) == "BadRequestNotAllowed"
    story.overview.wrote = lambda: setattr(story.overview, "is_gone", True)
    assert await story.write() == "BadRequestNotAllowed", "the limits are not known any more"
    story.overview.error = NotStarted("busy")
    story.overview.wrote = lambda: None
    story.overview.is_gone = False
    assert await story.write() == "BadNoCommunication", "it was not refused, whatever the limits are"
    await story.end()


async def test_who_may_not_write_is_refused_and_reported() -> None:
    story = await ready(Rules(allow=("*",), secrets={"scada": digest_of("0123456789abcdef")}))
    assert await story.write() == "BadUserAccessDenied"
    assert story.reports[-1].startswith("an anonymous user: winder/1 was not written: an anonymous user may not write")
    assert await story.write(user="scada") == "Good"
    story.line.state = Connected({"read_only": True})
    assert await story.write(user="scada") == "BadNotWritable"
    assert len(story.overview.writes) == 1
    await story.end()


@pytest.mark.parametrize(
    ("value", "kind", "labelled", "converted"),
    [
        ([1.0, 2.0], ua.VariantType.Int64, False, (1, 2)),
        ([1.0, 2.5], ua.VariantType.Int64, False, None),
        ([1, 2], ua.VariantType.Double, False, (1.0, 2.0)),
        ([1, 0], ua.VariantType.Boolean, False, (True, False)),
        ([1, 2], ua.VariantType.Boolean, False, None),
        (2**53 + 1, ua.VariantType.Double, False, None),  # it would be another number
        (7, ua.VariantType.Double, False, 7.0),
        (7, None, False, 7),
        ("jog", ua.VariantType.Int64, True, "jog"),
        ("jog", ua.VariantType.Int64, False, None),
        ("jog", ua.VariantType.String, False, "jog"),
        ("jog", None, False, "jog"),
        (True, ua.VariantType.Int64, False, None),
    ],
)
async def test_a_written_value_is_converted_if_it_means_the_same(
    value: Any, kind: Any, labelled: bool, converted: Any
) -> None:
    found = opcua._converted(ua.Variant(value), kind, labelled)
    assert found == converted
    assert type(found) is type(converted)


async def test_the_state_of_the_line_its_groups_and_its_nodes_is_shown() -> None:
    story = Story(row_of("1"))
    groups = [Group("fast", 0.02, 5, 1, 0.03, 0.001), Group("slow", 10.0, 6, paused=True)]
    nodes = [Node("winder", "hcp2", 5, "up", 10, 1, 2), Node("press", "modbus", 5, "down", 11, 3, 4)]
    story.line.picture._groups, story.line.picture._nodes = {0: list(groups)}, {0: list(nodes)}
    await story.show()
    await story.show()

    def shown(owner: str, *names: str) -> list[Any]:
        return [story.shown.values[f"{owner} {name}"][0] for name in names]

    assert shown("Line", "State", "Name", "Utilisation", "Backlog", "Losses", "ReadOnly", "Connected") == [
        *("ready", "slitter", 0.5, 3, 2, False, True)
    ]
    of_group = ("Period", "Achieved", "Jitter", "Cycles", "Missed", "Paused", "Dropped")
    assert shown("Groups/fast", *of_group) == [0.02, 0.03, 0.001, 5, 1, False, 0]
    assert shown("Groups/slow", *of_group) == [10.0, 0.0, 0.0, 6, 0, True, 0]
    of_node = ("Health", "Requests", "Failed", "Late")
    assert shown("Nodes/hcp2 5", *of_node) == ["up", 10, 1, 2]
    assert shown("Nodes/modbus 5", *of_node) == ["down", 11, 3, 4]
    keys = [key for key, _ in story.shown.objects]
    assert sorted(keys) == ["Groups/fast", "Groups/slow", "Nodes/hcp2 5", "Nodes/modbus 5"]
    assert dict(story.shown.objects)["Nodes/modbus 5"] == "press"
    story.line.picture.frame = shown_frame(points=1, read_only=True)
    await story.show()
    assert shown("Line", "ReadOnly") == [True]
    await story.end()


async def test_each_change_of_a_line_is_shown_at_once_until_it_is_cancelled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opcua, "LOOK_EVERY", PATIENCE)
    story = Story(row_of("1"))

    async def begin() -> None:
        """Make nothing."""

    story.shown.begin = begin  # type: ignore[attr-defined]  # of the subclass

    async def shows(key: str, value: Any, status: str) -> None:
        async with asyncio.timeout(PATIENCE):
            while key not in story.shown.values or story.shown.state(key) != [(value, status)]:  # noqa: ASYNC110
                await asyncio.sleep(0)

    running = asyncio.ensure_future(story.server.run())
    await story.server.has_points.wait()
    story.owner.groups["axes"].cycles.put_nowait(read_cycle(1.0))
    await shows("winder/1", 1.0, "Good")
    story.line._receive_touched(touched("1", 100.5))
    await shows("winder/1", 1.0, "UncertainLastUsableValue")
    await shows("Line Backlog", 3, "Good")
    story.line.picture.frame = shown_frame(points=1, backlog=4)
    for receive in list(story.line._listeners):
        receive("frame", {})
    await shows("Line Backlog", 4, "Good")
    story.line._remote = None
    story.line._change(Lost("gone"))
    await shows("winder/1", None, "BadOutOfService")
    await shows("Line Connected", False, "Good")
    story.replace_owner(7.0)
    story.line._change(Connected({"read_only": False, "name": "slitter"}))
    await shows("Line Connected", True, "Good")
    while "axes" not in story.owner.groups:  # noqa: ASYNC110  nothing reports it
        await asyncio.sleep(0)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    assert (story.line._listeners, story.line._watchers, story.line._touch_listeners) == ([], [], [])
    assert story.owner.groups["axes"].closes == 1


# one variable


async def made() -> tuple[Shown, Variable]:
    shown = Shown()
    return shown, await shown.point("p", "p", shown.nodes, "")


async def test_a_variable_has_the_type_of_its_values_and_keeps_its_value_while_it_is_doubted() -> None:
    shown, variable = await made()
    await variable.doubt()
    assert shown.values == {}, "there is nothing to doubt yet"
    await variable.put(None, GONE, 1.0)
    assert shown.kinds == {}
    await variable.put((1, 2), CODES.Good, 2.0)
    assert shown.kinds["p"] == (ua.VariantType.Int64, True)
    await variable.put(1, CODES.Good, 3.0)
    await variable.put(1.5, CODES.UncertainLastUsableValue, 4.0)
    assert shown.kinds["p"] == (ua.VariantType.Double, False)
    assert shown.values["p"] == (1.5, CODES.UncertainLastUsableValue, 4.0)
    await variable.doubt()
    assert len(shown.puts) == 4, "it is uncertain already"
    await variable.put(2, CODES.Good, 5.0)
    await variable.doubt()
    assert shown.values["p"] == (2.0, CODES.UncertainLastUsableValue, 5.0)
    await variable.put(None, GONE, 6.0)
    await variable.doubt()
    assert shown.state("p") == [(None, "BadOutOfService")]


async def test_a_value_that_is_known_now_is_put_if_it_is_news() -> None:
    shown, variable = await made()
    for value in (1, 1, 2):
        await variable.show(value)
    assert len(shown.puts) == 2
    await variable.put(None, GONE, 1.0)
    await variable.show(2)
    assert shown.state("p") == [(2, "Good")]
    assert len(shown.puts) == 4


@pytest.mark.parametrize(
    ("unit", "limited", "type_"),
    [
        ("", False, ua.ObjectIds.DataItemType),
        ("mm", False, ua.ObjectIds.AnalogUnitType),
        ("", True, ua.ObjectIds.AnalogItemType),
        ("mm", True, ua.ObjectIds.AnalogUnitRangeType),
    ],
)
async def test_a_number_has_the_variable_type_of_its_properties_whenever_they_come(
    unit: str, limited: bool, type_: int
) -> None:
    for described_first in (True, False):
        shown, variable = await made()
        if not described_first:
            await variable.put(1.5, CODES.Good, 1.0)
        await variable.describe(unit=unit, range_=ua.Range() if limited else None, writable=True)
        if described_first:
            await variable.put(1.5, CODES.Good, 1.0)
        assert shown.types["p"] == type_
        unit_shown = shown.properties["p", "EngineeringUnits"]
        assert (None if unit_shown is None else unit_shown.DisplayName.Text) == (unit or None)
        assert (shown.properties["p", "EURange"] is not None) is limited
        await variable.put("text", CODES.Good, 2.0)
        assert shown.types["p"] == ua.ObjectIds.DataItemType

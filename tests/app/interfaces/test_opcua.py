"""A line by OPC UA, as a client of another library sees it: statuses, times, writes, and coming and going."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import opcua
import pytest
import pytest_asyncio
from opcua import ua

from busmaster import Bus, Hcp2Controller, MemoryPort, ModbusUnit, Service
from busmaster.app.interfaces import following
from busmaster.app.interfaces import opcua as interface
from busmaster.app.interfaces.following import Following
from busmaster.app.interfaces.opcua import serving
from busmaster.app.interfaces.opcua_access import Rules
from busmaster.app.interfaces.opcua_connections import Acceptor, OpcuaServer
from busmaster.app.service import overview, picture
from busmaster.app.service.authorisation import Authorisation
from busmaster.app.service.owner_messages import StreamMessage
from busmaster.app.service.record import WriteRecord
from busmaster.app.service.remote_group import RemoteGroup
from busmaster.bus.meaning import Meaning
from busmaster.bus.polling import PollGroup
from busmaster.emulator.device import Device
from busmaster.emulator.line import Line
from busmaster.emulator.serve import serve_tcp
from busmaster.registry import make_device
from busmaster.transport.endpoints import endpoint
from tests.app.cli.conftest import serve
from tests.app.interfaces.opcua_client import OtherClient, Told, other_client
from tests.app.service.lines import until
from tests.patience import PATIENCE

pytestmark = pytest.mark.asyncio(loop_scope="module")


@dataclass
class Owned:
    """A line with controllers 5 and 6 that its owner serves."""

    bus: Bus
    line: Line
    devices: list[Device]
    records: list[WriteRecord] = field(default_factory=list)

    def poll(self, *items: str, name: str = "axes", **options: Any) -> PollGroup:
        points = [Hcp2Controller(self.bus, 5).point(item) for item in items]
        return self.bus.poll_group(name, period=0.02, points=[replace(point, **options) for point in points])

    def audit(self) -> list[tuple[str, str]]:
        return [(record.point, record.outcome.value) for record in self.records]


@dataclass
class Opened:
    """An interface that was opened once, and a client that stays in it whatever becomes of the line."""

    url: str
    client: OtherClient
    folder: Path
    said: list[str]
    line: Following
    server: OpcuaServer

    @contextlib.asynccontextmanager
    async def owned(self, port: Any = None) -> AsyncIterator[Owned]:
        devices = [make_device("hcp2", 5), make_device("hcp2", 6)]
        line = Line(Hcp2Controller.profile.line, devices, paced=False)
        async with Bus(port or MemoryPort(line)) as bus:
            authorisation, owned = Authorisation(bus), Owned(bus, line, devices)
            authorisation.record = owned.records.append
            async with Service(bus, authorisation=authorisation, path=self.folder / "line.sock"):
                yield owned

    async def shows(self, name: str, fact: Callable[[Told], object]) -> Told:
        """Wait until a client reads a value for which `fact` holds."""
        while True:
            told = await asyncio.to_thread(self.client.read, name)
            if fact(told):
                return told

    async def is_(self, name: str, status: str) -> Told:
        return await self.shows(name, lambda told: told.status == status)

    async def write(self, *what: Any) -> str:
        return await asyncio.to_thread(self.client.write, *what)


@contextlib.asynccontextmanager
async def subscribed(client: OtherClient, names: Sequence[str]) -> AsyncIterator[Callable[[str, Any], Awaitable[None]]]:
    """A subscription to these, and a function that waits until a fact holds for the last news of one of them."""
    entered = client.subscribed(names)
    heard = await asyncio.to_thread(entered.__enter__)
    try:
        yield lambda name, fact: asyncio.to_thread(heard.wait, name, fact)
    finally:
        await asyncio.to_thread(entered.__exit__, None, None, None)


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def opened(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Opened]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(following, "FIRST_PAUSE", 0.001)
        patch.setattr(following, "LONGEST_PAUSE", 0.001)
        patch.setattr(picture, "LEAST_AGE", PATIENCE)  # a machine that stands still makes no value old
        servers: list[OpcuaServer] = []

        def made() -> OpcuaServer:
            servers.append(OpcuaServer())
            return servers[-1]

        patch.setattr(interface, "OpcuaServer", made)
        patch.setattr(interface, "LISTEN_AFTER", 0.0)  # no line is served yet
        folder, said = tmp_path_factory.mktemp("opcua"), list[str]()
        line = Following(lambda: f"unix:{folder}/line.sock")
        async with serving(line, Rules(allow=("5/1*", "1/*")), ("127.0.0.1", 0), said.append) as url:
            entered = other_client(url)
            client = await asyncio.to_thread(entered.__enter__)
            yield Opened(url, client, folder, said, line, servers[0])
            await asyncio.to_thread(entered.__exit__, None, None, None)


@pytest.mark.slow
async def test_none_of_60_reads_after_60_writes_is_the_old_value_as_good(opened: Opened) -> None:
    async with opened.owned() as line:
        controller = Hcp2Controller(line.bus, 5)
        group = line.bus.poll_group("axes", period=1000, points=[controller.point("10"), controller.point("11")])
        await opened.is_("5/10", "Good")
        for number in range(1, 61):
            assert await opened.write("5/10", float(number)) == "Good"
            told = await asyncio.to_thread(opened.client.read, "5/10")
            assert (told.value, told.status) == (0.0, "UncertainLastUsableValue")
        assert (await asyncio.to_thread(opened.client.read, "5/11")).status == "Good"  # another register
        group.demand()
        assert (await opened.is_("5/10", "Good")).value == 60.0


@pytest.mark.slow
async def test_with_read_after_write_none_of_60_reads_is_the_old_value_as_good(opened: Opened) -> None:
    async with opened.owned() as line:
        point = replace(Hcp2Controller(line.bus, 5).point("10"), read_after_write=True)
        group = line.bus.poll_group("axes", period=1000, points=[point])
        await opened.is_("5/10", "Good")
        for number in range(1, 61):
            assert await opened.write("5/10", float(number)) == "Good"
            told = await asyncio.to_thread(opened.client.read, "5/10")
            assert told.status in ("UncertainLastUsableValue", "Good")
            assert told.status != "Good" or told.value == number
        assert (await opened.is_("5/10", "Good")).value == 60.0  # without another cycle
        assert group.statistics().cycles == 1


@pytest.mark.slow
async def test_a_point_has_its_unit_range_status_and_time(opened: Opened) -> None:
    async with opened.owned() as line:
        began = time.time()
        group = line.poll("10", unit="mm")
        group.points[0].limit(minimum=-5, maximum=250)
        told = await opened.is_("5/10", "Good")
        assert (told.value, type(told.value)) == (0.0, float)
        assert began - 1 < told.when.timestamp() < time.time() + 1
        unit = await asyncio.to_thread(opened.client.property, "5/10", "EngineeringUnits")
        assert (unit.DisplayName.Text, unit.UnitId) == ("mm", 5066068)
        limits = await asyncio.to_thread(opened.client.property, "5/10", "EURange")
        assert (limits.Low, limits.High) == (-5, 250)
        assert (await opened.shows("Nodes/hcp2 5 Health", lambda told: told.value == "up")).status == "Good"
        assert (await opened.is_("Groups/axes Period", "Good")).value == 0.02
        assert (await opened.is_("Line Connected", "Good")).value is True


async def test_a_point_is_found_from_the_line_and_has_its_name_its_description_and_its_access(opened: Opened) -> None:
    def found() -> tuple[list[str], list[tuple[str, str, int]]]:
        root = opened.client.client.get_objects_node()
        path = ["3:Line", "3:Nodes", "3:node 5"]
        references = []
        for count in range(len(path)):
            parent = root.get_child(path[:count]) if count else root
            child = parent.get_child(path[count])
            [reference] = [one for one in parent.get_references() if one.IsForward and one.NodeId == child.nodeid]
            references.append(ua.ObjectIdNames[reference.ReferenceTypeId.Identifier])
        points = []
        for name in ("5/10", "5/20"):
            point = root.get_child([*path, f"2:{name[2:]}"])
            assert point.nodeid == opened.client.node(name).nodeid
            access = point.get_attribute(ua.AttributeIds.AccessLevel).Value.Value
            assert opened.client.user_access(name) == access
            points.append((point.get_display_name().Text, point.get_description().Text, access))
        return references, points

    async with opened.owned() as line:
        line.poll("10", "20")
        await opened.is_("5/10", "Good")
        await opened.is_("5/20", "Good")
        read, read_and_write = 1, 3
        assert await asyncio.to_thread(found) == (
            ["Organizes", "HasComponent", "Organizes"],
            [
                ("10", "node 5 10 (read element 10)", read_and_write),
                ("20", "node 5 20 (read element 20)", read),  # it is not on the list
            ],
        )


@pytest.mark.parametrize(
    ("unit", "limit", "type_"),
    [
        ("", False, "DataItemType"),
        ("mm", False, "AnalogUnitType"),
        ("", True, "AnalogItemType"),
        ("mm", True, "AnalogUnitRangeType"),
    ],
)
async def test_a_point_is_an_analog_item_only_with_what_that_type_requires(
    opened: Opened, unit: str, limit: bool, type_: str
) -> None:
    async with opened.owned() as line:
        group = line.poll("10", unit=unit)
        if limit:
            group.points[0].limit(minimum=-5, maximum=250)
        await opened.is_("5/10", "Good")
        assert await asyncio.to_thread(opened.client.type_of, "5/10") == (type_, type_)


async def test_a_browse_of_a_point_shows_the_names_of_the_type_that_it_has_now(opened: Opened) -> None:
    """A point is a DataItemType until its unit and its first number are known."""

    def names() -> tuple[str, str]:
        [reference] = opened.client.node("5/10").get_references(ua.ObjectIds.HasTypeDefinition)
        return reference.BrowseName.Name, reference.DisplayName.Text

    async with opened.owned() as line:
        line.poll("10", unit="mm")
        await opened.is_("5/10", "Good")
        assert await asyncio.to_thread(names) == ("AnalogUnitType", "AnalogUnitType")


@pytest.mark.parametrize(
    ("item", "value", "kind", "status", "stored"),
    [
        ("holding:5", 7, ua.VariantType.Int64, "Good", 7),
        ("holding:5", 7.0, ua.VariantType.Double, "Good", 7),
        ("holding:5", 7, ua.VariantType.Int16, "Good", 7),
        ("holding:5", 7.5, ua.VariantType.Double, "BadTypeMismatch", 0),
        ("holding:5", True, ua.VariantType.Boolean, "BadTypeMismatch", 0),
        ("holding:5", "jog", ua.VariantType.String, "BadTypeMismatch", 0),
        ("coil:5", True, ua.VariantType.Boolean, "Good", True),
        ("coil:5", 1, ua.VariantType.Int64, "Good", True),
        ("coil:5", 1.0, ua.VariantType.Float, "Good", True),
        ("coil:5", 2, ua.VariantType.Int64, "BadTypeMismatch", False),
        ("coil:5", "on", ua.VariantType.String, "BadTypeMismatch", False),
        ("holding:6", 1, ua.VariantType.Int64, "Good", 1),
        ("holding:6", "jog", ua.VariantType.String, "Good", 1),
        ("holding:6", "fast", ua.VariantType.String, "BadRequestNotAllowed", 0),
    ],
)
async def test_a_value_is_written_in_each_type_that_means_it(
    opened: Opened, item: str, value: object, kind: Any, status: str, stored: object
) -> None:
    line = Line(ModbusUnit.profile.line, [make_device("modbus", 1)], paced=False)
    async with Bus(MemoryPort(line)) as bus, Service(bus, path=opened.folder / "line.sock"):
        unit = ModbusUnit(bus, 1)
        mode = replace(unit.point("holding:6"), meaning=Meaning(labels={0: "off", 1: "jog"}))
        bus.poll_group("press", period=0.02, points=[unit.point("holding:5"), unit.point("coil:5"), mode])
        await opened.is_(f"1/{item}", "Good")
        assert await opened.write(f"1/{item}", value, kind) == status
        assert await unit.read(item) == stored
        if item == "coil:5":
            assert await asyncio.to_thread(opened.client.type_of, "1/coil:5") == ("DataItemType", "DataItemType")


async def test_a_point_shows_the_type_of_its_values_and_whether_they_are_lists(opened: Opened) -> None:
    def types(*names: str) -> list[tuple[str, int]]:
        nodes = [opened.client.node(name) for name in names]
        kinds = [ua.ObjectIdNames[node.get_data_type().Identifier] for node in nodes]
        return [(kind, int(node.get_value_rank())) for kind, node in zip(kinds, nodes, strict=True)]

    line = Line(ModbusUnit.profile.line, [make_device("modbus", 1)], paced=False)
    async with Bus(MemoryPort(line)) as bus, Service(bus, path=opened.folder / "line.sock"):
        unit = ModbusUnit(bus, 1)
        items = ("holding:20", "holding:30:3", "holding:40:float32", "coil:9")
        bus.poll_group("press", period=0.02, points=[unit.point(item) for item in items])
        for item in items:
            await opened.is_(f"1/{item}", "Good")
        assert await asyncio.to_thread(types, *(f"1/{item}" for item in items)) == [
            *(("Int64", -1), ("Int64", 1), ("Double", -1), ("Boolean", -1))
        ]


async def test_cycles_that_the_interface_was_too_slow_for_are_counted(
    opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    really = RemoteGroup.receive

    def receive(group: RemoteGroup, method: str, message: StreamMessage[Any]) -> None:
        really(group, method, StreamMessage(message.stream, 3, message.body))  # as the owner counts them

    monkeypatch.setattr(RemoteGroup, "receive", receive)
    async with opened.owned() as line:
        line.poll("10", name="counted")
        await opened.shows("Groups/counted Dropped", lambda told: told.value == 3)


async def test_a_unit_that_its_owner_has_changed_is_told(opened: Opened) -> None:
    async def unit() -> str | None:
        told = await asyncio.to_thread(opened.client.property, "5/10", "EngineeringUnits")
        text: str | None = told.DisplayName.Text
        return text

    async with opened.owned() as line:
        line.poll("10", unit="mm").points[0].limit(minimum=0, maximum=100)
        await opened.is_("5/10 EURange", "Good")
        assert await unit() == "mm"
    await opened.shows("5/10", lambda told: told.status != "Good")
    async with opened.owned() as line:
        line.poll("10", unit="m")
        await opened.is_("5/10", "Good")
        assert await unit() == "m"
        assert (await asyncio.to_thread(opened.client.read, "5/10 EURange")).status == "BadConfigurationError"


async def test_a_write_passes_the_owners_authorisation_and_is_good_only_when_it_is_confirmed(opened: Opened) -> None:
    async with opened.owned() as line:
        group = line.poll("10", "20")
        group.points[0].limit(maximum=250)
        await opened.is_("5/10", "Good")
        await opened.is_("5/20", "Good")
        assert await opened.write("5/10", 12.5) == "Good"
        await opened.shows("5/10", lambda told: told.value == 12.5)
        assert await opened.write("5/10", 251.0) == "BadOutOfRange"
        assert "above its maximum of 250" in opened.said[-1]
        assert await opened.write("5/10", "3", ua.VariantType.String) == "BadTypeMismatch"
        assert await opened.write("5/20", 1.0) == "BadNotWritable"  # it is not on the list
        assert await opened.write("Line Backlog", 1, ua.VariantType.Int64) == "BadNotWritable"
        assert line.audit() == [("5/10", "written"), ("5/10", "refused")]
        line.line.remove(line.devices[0])
        assert await opened.write("5/10", 13.5) in ("BadTimeout", "BadNoCommunication")
        assert [outcome for _, outcome in line.audit()[2:]] != ["written"]
    assert await opened.write("5/10", 12.5) in ("BadTimeout", "BadNoCommunication")


async def test_a_client_changes_nothing_but_values(opened: Opened) -> None:
    async with opened.owned() as line:
        line.poll("10")
        await opened.is_("5/10", "Good")
        node = opened.client.node("5/10")
        wanted = ua.WriteValue()
        wanted.NodeId, wanted.AttributeId = node.nodeid, ua.AttributeIds.DisplayName
        wanted.Value = ua.DataValue(ua.Variant(ua.LocalizedText("another")))
        assert await asyncio.to_thread(opened.client.status_of, wanted) == "BadNotWritable"
        with pytest.raises(ua.UaStatusCodeError, match="BadUserAccessDenied"):
            await asyncio.to_thread(node.add_object, 2, "another")
        with pytest.raises(ua.UaStatusCodeError, match="BadUserAccessDenied"):
            await asyncio.to_thread(opened.client.client.delete_nodes, [node])
        assert line.audit() == []


@pytest.mark.slow
async def test_a_node_that_does_not_answer_has_no_values_until_it_does_again(opened: Opened) -> None:
    async with opened.owned() as line:
        line.poll("10")
        await opened.is_("5/10", "Good")
        line.line.remove(line.devices[0])
        gone = await opened.is_("5/10", "BadNoCommunication")
        assert gone.value is None
        await opened.shows("Nodes/hcp2 5 Health", lambda told: told.value == "down")
        line.line.add(line.devices[0])
        assert (await opened.is_("5/10", "Good")).when > gone.when
        await opened.shows("Nodes/hcp2 5 Health", lambda told: told.value == "up")


async def test_a_line_that_is_lost_has_no_values_until_it_is_back(opened: Opened) -> None:
    server = serve("hcp2", 5)
    port = int(server.path.rpartition(":")[2])
    async with opened.owned(endpoint(server.path, defaults=Hcp2Controller.profile.line)) as line:
        line.poll("10")
        await opened.is_("5/10", "Good")
        server.close()
        gone = await opened.is_("5/10", "BadNoCommunication")
        await opened.shows("Line State", lambda told: told.value == "offline")
        with serve_tcp(Line(Hcp2Controller.profile.line, [make_device("hcp2", 5)], paced=False), port=port):
            assert (await opened.is_("5/10", "Good")).when > gone.when
            await opened.shows("Line State", lambda told: told.value == "ready")


async def test_while_its_owner_is_away_a_line_has_no_values_and_they_come_back_by_themselves(opened: Opened) -> None:
    for _ in range(3):
        async with opened.owned() as line:
            line.poll("10")
            await opened.is_("5/10", "Good")
            assert (await opened.is_("Line Connected", "Good")).value is True
        gone = await opened.is_("5/10", "BadOutOfService")
        assert (gone.value, gone.when.timestamp() > time.time() - PATIENCE) == (None, True)
        await opened.is_("Groups/axes Cycles", "BadOutOfService")
        assert (await opened.shows("Line Connected", lambda told: told.value is False)).status == "Good"


async def test_what_is_not_read_any_more_is_of_some_time_ago(opened: Opened, monkeypatch: pytest.MonkeyPatch) -> None:
    async with opened.owned() as line:
        group = line.poll("10")
        good = await opened.is_("5/10", "Good")
        group.pause()
        monkeypatch.setattr(picture, "LEAST_AGE", 0.1)
        old = await opened.is_("5/10", "UncertainLastUsableValue")
        assert (old.value, old.when >= good.when) == (good.value, True)
        monkeypatch.setattr(picture, "LEAST_AGE", PATIENCE)
        group.resume()
        assert (await opened.is_("5/10", "Good")).when > old.when


async def test_a_point_that_the_line_has_no_longer_says_so(opened: Opened) -> None:
    async with opened.owned() as line:
        group = line.poll("10", "11")
        await opened.is_("5/11", "Good")
        group.remove(group.points[1])
        await opened.is_("5/11", "BadConfigurationError")
        assert (await opened.is_("5/10", "Good")).value == 0.0
        group.add(Hcp2Controller(line.bus, 5).point("11"))
        await opened.is_("5/11", "Good")


async def test_a_point_that_is_added_while_the_others_are_taken_over_is_shown(
    opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, go_on = asyncio.Event(), asyncio.Event()
    details = opened.line.details

    async def held(*point: str) -> Mapping[str, Any]:
        begun.set()
        await go_on.wait()
        return await details(*point)

    def are_told() -> bool:
        picture = opened.line.picture
        return picture.frame is not None and picture.frame.points == len(picture.rows) == 2

    async def another_look() -> None:
        before = (await opened.is_("Groups/axes Cycles", "Good")).value
        await opened.shows("Groups/axes Cycles", lambda told: told.value != before)

    monkeypatch.setattr(opened.line, "details", held)
    monkeypatch.setattr(overview, "COUNTED_EVERY", 0.0)
    async with opened.owned() as line:
        group = line.poll("10")
        await begun.wait()
        group.add(Hcp2Controller(line.bus, 5).point("12"))
        await until(are_told)
        go_on.set()
        await another_look()  # it may end the one that has been held
        await another_look()
        assert (await asyncio.to_thread(opened.client.read, "5/12")).status != "BadNodeIdUnknown"
        assert (await opened.is_("5/12", "Good")).value == 0.0


@pytest.mark.slow
async def test_a_subscription_is_told_of_each_change_of_value_and_status(opened: Opened) -> None:
    async with contextlib.AsyncExitStack() as leave:
        line = await leave.enter_async_context(opened.owned())
        points = [Hcp2Controller(line.bus, node).point(str(item)) for node in (5, 6) for item in range(1, 11)]
        line.bus.poll_group("all", period=0.1, points=points)
        names = [point.key for point in points]
        await opened.is_(names[-1], "Good")
        async with subscribed(opened.client, names) as told:
            for name in names:
                await told(name, lambda last: last.status == "Good")
            await points[0].write(77.0)
            await told("5/1", lambda last: last.value == 77.0)
            line.line.remove(line.devices[1])
            await told("6/10", lambda last: last.status == "BadNoCommunication")
            await told("5/10", lambda last: last.status == "Good")
            await leave.aclose()
            for name in names:
                await told(name, lambda last: last.status == "BadOutOfService")


async def test_nobody_comes_by_the_session_of_another(opened: Opened) -> None:
    async with opened.owned() as line:
        line.poll("10")
        await opened.is_("5/10", "Good")

        def intrude() -> None:
            thief = opcua.Client(opened.url, timeout=PATIENCE)
            thief.connect_socket()
            try:
                thief.send_hello()
                thief.open_secure_channel()
                known = opened.client.client.uaclient._uasocket.authentication_token
                thief.uaclient._uasocket.authentication_token = known
                with pytest.raises(ua.UaStatusCodeError, match="BadSessionIdInvalid"):
                    thief.uaclient.activate_session(ua.ActivateSessionParameters())
                with pytest.raises(ua.UaStatusCodeError, match="BadUserAccessDenied"):
                    OtherClient(thief).write("5/10", 1.0)
                thief.close_secure_channel()
            finally:
                thief.disconnect_socket()

        await asyncio.to_thread(intrude)
        assert line.audit() == []


async def test_clients_are_accepted_when_the_points_of_the_line_are_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(interface, "LISTEN_AFTER", PATIENCE)
    monkeypatch.setattr(following, "FIRST_PAUSE", 0.001)
    monkeypatch.setattr(following, "LONGEST_PAUSE", 0.001)
    ports, end = list[int](), asyncio.Event()
    urls: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    line, start = Following(lambda: f"unix:{tmp_path}/line.sock"), Acceptor.start

    async def started(acceptor: Acceptor) -> None:
        await start(acceptor)
        ports.append(acceptor.port)

    async def serve_line() -> None:
        async with serving(line, Rules(), ("127.0.0.1", 0), lambda _: None) as url:
            urls.set_result(url)
            await end.wait()

    def status(url: str) -> str:
        with other_client(url) as client:
            return client.read("5/10").status

    monkeypatch.setattr(Acceptor, "start", started)
    serving_it = asyncio.create_task(serve_line())
    await until(lambda: "no program serves" in getattr(line.state, "why", ""))
    with pytest.raises(ConnectionRefusedError):
        await asyncio.open_connection("127.0.0.1", ports[0])
    devices = [make_device("hcp2", 5)]
    async with Bus(MemoryPort(Line(Hcp2Controller.profile.line, devices, paced=False))) as bus:
        bus.poll_group("axes", period=0.02, points=[Hcp2Controller(bus, 5).point("10")])
        async with Service(bus, path=tmp_path / "line.sock"):
            async with asyncio.timeout(PATIENCE):
                url = await urls
            assert await asyncio.to_thread(status, url) != "BadNodeIdUnknown"
            end.set()
            await serving_it


@pytest.mark.slow
async def test_sessions_that_come_and_go_are_nothing_to_the_line(opened: Opened) -> None:
    async with opened.owned() as line:
        line.poll("10")
        await opened.is_("5/10", "Good")
        for _ in range(20):
            entered = other_client(opened.url)
            client = await asyncio.to_thread(entered.__enter__)
            assert (await asyncio.to_thread(client.read, "5/10")).status == "Good"
            await asyncio.to_thread(entered.__exit__, None, None, None)
        await until(lambda: line.bus.groups[0].statistics().cycles > 20)

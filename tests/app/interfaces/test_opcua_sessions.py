"""Sessions and subscriptions of OPC UA clients, without a server and its thousands of nodes."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from asyncua import ua
from asyncua.common.connection import TransportLimits
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.server.address_space import AddressSpace, AttributeService, AttributeValue, NodeData
from asyncua.server.internal_session import SessionState
from asyncua.server.subscription_service import SubscriptionService
from asyncua.ua.uaprotocol_auto import DataChangeFilter, EventFilter  # those of `ua` are subclasses

from busmaster.app import bounds
from busmaster.app.interfaces import opcua_sessions
from busmaster.app.interfaces.opcua_access import Rules, Writes, guard
from busmaster.app.interfaces.opcua_connections import Requests
from busmaster.app.interfaces.opcua_sessions import Session, use_sessions
from busmaster.app.interfaces.opcua_terms import CODES
from busmaster.app.service.permission import digest_of

pytestmark = pytest.mark.asyncio
NUMBER, OTHER, TEXT, UNKNOWN = (ua.NodeId(name, 2) for name in ("number", "other", "text", "unknown"))
KINDS = {NUMBER: ua.ObjectIds.Double, OTHER: ua.ObjectIds.Int64, TEXT: ua.ObjectIds.String}
VALUES = {NUMBER: 1.0, OTHER: 7, TEXT: "x"}
READ = ua.AccessLevel.CurrentRead.mask
READ_WRITE = ua.AccessLevel.CurrentRead.mask | ua.AccessLevel.CurrentWrite.mask


class Clients:
    """The sessions of a server that has three variables, and a fourth without a value yet."""

    def __init__(self, refusal: Callable[[User], str] = lambda _: "") -> None:
        self.space = AddressSpace()
        for node in (NUMBER, OTHER, TEXT, UNKNOWN):
            kind = KINDS.get(node, ua.ObjectIds.BaseDataType)
            self.space[node] = data = NodeData(node)
            for attribute, value in (
                (ua.AttributeIds.DataType, ua.Variant(ua.NodeId(kind), ua.VariantType.NodeId)),
                (ua.AttributeIds.AccessLevel, ua.Variant(READ_WRITE, ua.VariantType.Byte)),
                (ua.AttributeIds.UserAccessLevel, ua.Variant(READ_WRITE, ua.VariantType.Byte)),
                (ua.AttributeIds.Value, ua.Variant(VALUES.get(node))),
            ):
                data.attributes[attribute] = AttributeValue(ua.DataValue(value))

        async def dispatch(*_: object) -> None:
            """Keep no callback."""

        self.server: Any = SimpleNamespace(
            callback_service=SimpleNamespace(dispatch=dispatch),
            attribute_service=AttributeService(self.space),
            view_service=SimpleNamespace(browse=lambda params: [None] * len(params.NodesToBrowse)),
            max_subscriptions=100,
            max_lifetime_count=1000,
            max_keep_alive_count=100,
            aspace=self.space,
        )
        self.service = SubscriptionService(self.space, self.server)
        self.server.subscription_service = self.service
        use_sessions(self.server, refusal)

    def session(self) -> Session:
        session = self.server.create_session("a client")
        assert isinstance(session, Session)
        return session

    async def subscribe(self, session: Session, interval: float = 60_000.0) -> ua.CreateSubscriptionResult:
        params = ua.CreateSubscriptionParameters()
        params.RequestedPublishingInterval = interval

        async def published(*_: object) -> None:
            """Send nothing."""

        return await session.create_subscription(params, published, lambda *_: None)

    async def put(self, value: Any, status: int = CODES.Good, node: ua.NodeId = NUMBER) -> None:
        data = ua.DataValue(ua.Variant(value), StatusCode=ua.StatusCode(status))
        assert (await self.space.write_attribute_value(node, ua.AttributeIds.Value, data)).is_good()

    def queued(self, subscription: int, item: int) -> list[Any]:
        """The values of an item that its client has not got yet."""
        queues = self.service.subscriptions[subscription]._triggered_datachanges
        return [one.Value.Value.Value for one in queues.get(item, [])]

    async def end(self) -> None:
        await self.service.delete_subscriptions(list(self.service.subscriptions))


@pytest.fixture
def clients() -> Clients:
    return Clients()


def item(
    node: ua.NodeId = NUMBER,
    filter_: Any = None,
    *,
    queue: int = 10,
    attribute: Any = ua.AttributeIds.Value,
    part: str | None = None,
    encoding: str | None = None,
) -> ua.MonitoredItemCreateRequest:
    wanted = ua.MonitoredItemCreateRequest()
    wanted.ItemToMonitor = ua.ReadValueId(node, attribute, part, ua.QualifiedName(encoding))
    wanted.MonitoringMode = ua.MonitoringMode.Reporting
    wanted.RequestedParameters = ua.MonitoringParameters(ClientHandle=3, Filter=filter_, QueueSize=queue)
    return wanted


def deadband(value: float, kind: Any = ua.DeadbandType.Absolute) -> Any:
    return DataChangeFilter(ua.DataChangeTrigger.StatusValue, kind, value)


async def monitor(session: Session, number: int, *items: ua.MonitoredItemCreateRequest) -> list[Any]:
    return await session.create_monitored_items(ua.CreateMonitoredItemsParameters(number, ItemsToCreate=list(items)))


def names(results: list[Any]) -> list[str]:
    return [getattr(one, "StatusCode", one).name for one in results]


async def code_of(raising: Any) -> str:
    """The error of a service, "" for none."""
    try:
        if asyncio.iscoroutine(raising):
            await raising
        else:
            raising()
    except ServiceError as error:
        return str(ua.StatusCode(error.code).name)
    return ""


async def test_a_session_has_a_bounded_number_of_subscriptions_whatever_others_have(
    clients: Clients, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(opcua_sessions, "MOST_SESSION_SUBSCRIPTIONS", 2)
    one, other = clients.session(), clients.session()
    first = await clients.subscribe(one)
    await clients.subscribe(one)
    assert await code_of(clients.subscribe(one)) == "BadTooManySubscriptions"
    for _ in range(2):
        assert await code_of(clients.subscribe(other)) == ""
    await one.delete_subscriptions([first.SubscriptionId])
    assert await code_of(clients.subscribe(one)) == ""
    await clients.end()


async def test_a_failed_login_is_of_the_address_of_its_session(monkeypatch: pytest.MonkeyPatch) -> None:
    server: Any = Guarded(has_key=False)
    failed: list[str] = []

    async def write(*_: object) -> int:
        return int(CODES.Good)

    guard(server, Rules(secrets={"scada": digest_of("0123456789abcdef")}), write, failed.append)
    server.iserver.supported_tokens = (ua.UserNameIdentityToken,)
    server.iserver.decrypt_user_token = lambda _session, _token: ("scada", "wrong")
    for address in ("10.0.0.1", "10.0.0.2"):
        session = server.iserver.create_session((address, 50_000))
        login = ua.ActivateSessionParameters(UserIdentityToken=ua.UserNameIdentityToken())
        assert await code_of(lambda session=session, login=login: session.activate_session(login, None)) == (
            "BadUserAccessDenied"
        )
    assert failed == ["10.0.0.1", "10.0.0.2"]


async def test_a_session_that_was_not_activated_ends_with_its_connection(clients: Clients) -> None:
    transport = SimpleNamespace(get_extra_info=lambda _: ("127.0.0.1", 50_000), close=lambda: None)
    requests = Requests(clients.server, transport, TransportLimits())
    requests.session = session = clients.session()
    await clients.subscribe(session)
    assert not requests.has_session
    await requests.close()
    assert session.state is SessionState.Closed
    assert not clients.service.subscriptions


@pytest.mark.parametrize(
    ("requested", "revised"),
    [
        (500.0, 500.0),
        (1.0, 1000 * bounds.SHORTEST_PUBLISHING),
        (0.0, 1000 * bounds.SHORTEST_PUBLISHING),
        (-5.0, 1000 * bounds.SHORTEST_PUBLISHING),
        (1e9, 1000 * bounds.LONGEST_PUBLISHING),
        (math.nan, 1000 * bounds.SHORTEST_PUBLISHING),
        (math.inf, 1000 * bounds.SHORTEST_PUBLISHING),
    ],
)
async def test_an_interval_of_publishing_is_within_its_bounds(
    clients: Clients, requested: float, revised: float
) -> None:
    assert (await clients.subscribe(clients.session(), requested)).RevisedPublishingInterval == revised
    await clients.end()


async def test_a_session_reaches_no_subscription_of_another_one(clients: Clients) -> None:
    owner, thief = clients.session(), clients.session()
    number = (await clients.subscribe(owner)).SubscriptionId
    [created] = await monitor(owner, number, item())
    own = (await clients.subscribe(thief)).SubscriptionId
    subscription = clients.service.subscriptions[number]
    subscription._not_acknowledged_results[5] = ua.PublishResult()

    def requests(session: Session) -> list[Any]:
        ids = [created.MonitoredItemId]
        modified = ua.MonitoredItemModifyRequest(ids[0], ua.MonitoringParameters(QueueSize=3))
        return [
            monitor(session, number, item()),
            session.modify_monitored_items(ua.ModifyMonitoredItemsParameters(number, ItemsToModify=[modified])),
            session.set_monitoring_mode(ua.SetMonitoringModeParameters(number, ua.MonitoringMode.Reporting, ids)),
            session.delete_monitored_items(ua.DeleteMonitoredItemsParameters(number, ids)),
            lambda: session.modify_subscription(ua.ModifySubscriptionParameters(number)),
            lambda: session.republish(ua.RepublishParameters(number, 5)),
        ]

    assert [await code_of(one) for one in requests(thief)] == ["BadSubscriptionIdInvalid"] * 6
    assert len(subscription.monitored_item_srv._monitored_items) == 1
    off = ua.SetPublishingModeParameters(False, [own, number])
    assert names(await thief.set_publishing_mode(off)) == ["Good", "BadSubscriptionIdInvalid"]
    assert (subscription._publishing_enabled, clients.service.subscriptions[own]._publishing_enabled) == (True, False)
    transfer = ua.TransferSubscriptionsParameters([number, own])
    assert names(await thief.transfer_subscriptions(transfer, print)) == ["BadSubscriptionIdInvalid", "Good"]
    count, statuses = thief.publish([ua.SubscriptionAcknowledgement(number, 5)])
    assert (count, names(statuses)) == (1, ["BadSubscriptionIdInvalid"])
    assert names(await thief.delete_subscriptions([number, own])) == ["BadSubscriptionIdInvalid", "Good"]
    assert list(clients.service.subscriptions) == [number]
    assert [await code_of(one) for one in requests(owner)] == [""] * 6
    assert names(await owner.set_publishing_mode(off)) == ["BadSubscriptionIdInvalid", "Good"]
    assert names(await owner.delete_subscriptions([number])) == ["Good"]


async def test_messages_that_were_not_acknowledged_can_be_requested_again(clients: Clients) -> None:
    session = clients.session()
    assert await code_of(lambda: session.publish([])) == "BadNoSubscription"
    number = (await clients.subscribe(session)).SubscriptionId
    messages = {sequence: ua.PublishResult(number) for sequence in (7, 5)}
    clients.service.subscriptions[number]._not_acknowledged_results.update(messages)
    [moved] = await session.transfer_subscriptions(ua.TransferSubscriptionsParameters([number]), print)
    assert moved.AvailableSequenceNumbers == [5, 7]
    assert session.republish(ua.RepublishParameters(number, 5)) is messages[5].NotificationMessage
    assert await code_of(lambda: session.republish(ua.RepublishParameters(number, 6))) == "BadMessageNotAvailable"
    acknowledged = ua.SubscriptionAcknowledgement(number, 5)
    count, statuses = session.publish([acknowledged, acknowledged])
    assert (count, names(statuses)) == (1, ["Good", "BadSequenceNumberUnknown"])
    assert session.publish(None) == (1, [])
    assert await code_of(lambda: session.republish(ua.RepublishParameters(number, 5))) == "BadMessageNotAvailable"
    await clients.end()


async def test_a_request_has_a_bounded_number_of_operations(clients: Clients, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opcua_sessions, "MOST_OPERATIONS", 2)
    session = clients.session()
    number = (await clients.subscribe(session)).SubscriptionId
    value = ua.DataValue(ua.Variant(2.0))
    for count, code in ((2, ""), (3, "BadTooManyOperations")):
        reads = [ua.ReadValueId(NUMBER, ua.AttributeIds.Value)] * count
        writes = [ua.WriteValue(NUMBER, ua.AttributeIds.Value, Value=value)] * count
        for request in (
            session.read(ua.ReadParameters(NodesToRead=reads)),
            session.write(ua.WriteParameters(writes)),
            session.browse(ua.BrowseParameters(NodesToBrowse=[ua.BrowseDescription()] * count)),
            monitor(session, number, *[item()] * count),
        ):
            assert await code_of(request) == code
    await clients.end()


async def test_a_read_that_is_not_supported_is_refused_beside_others_that_are(clients: Clients) -> None:
    session = clients.session()

    def wanted(part: str | None = None, encoding: str | None = None) -> ua.ReadValueId:
        of = None if encoding is None else ua.QualifiedName(Name=encoding)
        return ua.ReadValueId(NUMBER, ua.AttributeIds.Value, part, of or ua.QualifiedName())

    reads = [wanted(), wanted(part="0:1"), wanted(encoding="Default Binary"), wanted(encoding="Default XML")]
    results = await session.read(ua.ReadParameters(NodesToRead=reads))
    assert names(results) == ["Good", "BadIndexRangeInvalid", "Good", "BadDataEncodingUnsupported"]
    assert (results[0].Value.Value, results[1].Value.Value) == (1.0, None)
    for age, code in ((0.0, ""), (1000.0, ""), (-1.0, "BadMaxAgeInvalid"), (math.nan, "BadMaxAgeInvalid")):
        assert await code_of(session.read(ua.ReadParameters(age, NodesToRead=reads))) == code


@pytest.mark.parametrize(
    ("of_a_point", "why", "access"),
    [(READ_WRITE, "", READ_WRITE), (READ_WRITE, "log in", READ), (READ, "", READ), (READ, "log in", READ)],
)
async def test_the_access_of_a_user_is_without_writing_for_one_that_may_not_write(
    of_a_point: int, why: str, access: int
) -> None:
    clients = Clients(lambda _: why)
    for attribute in (ua.AttributeIds.AccessLevel, ua.AttributeIds.UserAccessLevel):
        value = ua.DataValue(ua.Variant(of_a_point, ua.VariantType.Byte))
        clients.space[NUMBER].attributes[attribute] = AttributeValue(value)
    session = clients.session()
    attributes = (ua.AttributeIds.AccessLevel, ua.AttributeIds.UserAccessLevel, ua.AttributeIds.Value)
    reads = [ua.ReadValueId(NUMBER, attribute) for attribute in attributes]
    reads.append(ua.ReadValueId(ua.NodeId("gone", 2), ua.AttributeIds.UserAccessLevel))
    of_point, of_user, value, gone = await session.read(ua.ReadParameters(NodesToRead=reads))
    assert (of_point.Value.Value, of_user.Value.Value, value.Value.Value) == (of_a_point, access, 1.0)
    assert gone.StatusCode.name == "BadNodeIdUnknown"


async def test_items_are_bounded_in_all_subscriptions_of_a_session_and_in_all_sessions(
    clients: Clients, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(opcua_sessions, "MOST_SESSION_ITEMS", 3)
    monkeypatch.setattr(opcua_sessions, "MOST_ITEMS", 4)
    one, other = clients.session(), clients.session()
    numbers = [(await clients.subscribe(session)).SubscriptionId for session in (one, one, other)]
    full = "BadTooManyMonitoredItems"
    first = await monitor(one, numbers[0], item(), item())
    assert names(first) == ["Good", "Good"]
    assert names(await monitor(one, numbers[1], item(), item())) == ["Good", full]
    assert names(await monitor(other, numbers[2], item(), item())) == ["Good", full]
    ids = [result.MonitoredItemId for result in first]
    deleted = await one.delete_monitored_items(ua.DeleteMonitoredItemsParameters(numbers[0], [*ids, 9999]))
    assert names(deleted) == ["Good", "Good", "BadMonitoredItemIdInvalid"]
    assert names(await monitor(other, numbers[2], item(), item())) == ["Good", "Good"]
    await clients.end()


@pytest.mark.parametrize(
    ("wanted", "code"),
    [
        (item(), "Good"),
        (item(TEXT), "Good"),
        (item(ua.NodeId("gone", 2)), "BadNodeIdUnknown"),
        (item(part="0:1"), "BadIndexRangeInvalid"),
        (item(encoding="Default XML"), "BadDataEncodingUnsupported"),
        (item(filter_=deadband(0.0, ua.DeadbandType.None_)), "Good"),
        (item(TEXT, deadband(0.0, ua.DeadbandType.None_)), "Good"),
        (item(filter_=deadband(0.0)), "Good"),
        (item(OTHER, deadband(1.0)), "Good"),
        (item(UNKNOWN, deadband(1.0)), "Good"),
        (item(TEXT, deadband(1.0)), "BadFilterNotAllowed"),
        (item(filter_=deadband(1.0), attribute=ua.AttributeIds.AccessLevel), "BadFilterNotAllowed"),
        (item(filter_=deadband(-1.0)), "BadDeadbandFilterInvalid"),
        (item(filter_=deadband(math.inf)), "BadDeadbandFilterInvalid"),
        (item(filter_=deadband(math.nan)), "BadDeadbandFilterInvalid"),
        (item(filter_=deadband(1.0, 7)), "BadDeadbandFilterInvalid"),
        (item(filter_=deadband(1.0, ua.DeadbandType.Percent)), "BadMonitoredItemFilterUnsupported"),
        (item(filter_=ua.AggregateFilter()), "BadMonitoredItemFilterUnsupported"),
        (item(filter_=EventFilter()), "BadMonitoredItemFilterUnsupported"),
        (item(attribute=ua.AttributeIds.EventNotifier), "BadEventFilterInvalid"),
    ],
)
async def test_an_item_that_is_not_supported_is_refused_and_the_next_one_is_made(
    clients: Clients, wanted: ua.MonitoredItemCreateRequest, code: str
) -> None:
    session = clients.session()
    number = (await clients.subscribe(session)).SubscriptionId
    assert names(await monitor(session, number, wanted, item())) == [code, "Good"]
    await clients.end()


async def test_an_item_is_changed_as_a_whole_or_not_at_all(clients: Clients) -> None:
    session = clients.session()
    subscription = await clients.subscribe(session)
    number = subscription.SubscriptionId
    [created] = await monitor(session, number, item(filter_=deadband(5.0), queue=2))
    [before] = clients.service.subscriptions[number].monitored_item_srv._monitored_items.values()

    async def modify(filter_: Any, queue: int = 3, of: int = created.MonitoredItemId) -> Any:
        parameters = ua.MonitoringParameters(ClientHandle=9, Filter=filter_, QueueSize=queue)
        request = ua.MonitoredItemModifyRequest(of, parameters)
        return (
            await session.modify_monitored_items(ua.ModifyMonitoredItemsParameters(number, ItemsToModify=[request]))
        )[0]

    assert (await modify(deadband(-1.0))).StatusCode.name == "BadDeadbandFilterInvalid"
    assert (await modify(None, of=9999)).StatusCode.name == "BadMonitoredItemIdInvalid"
    assert (before.filter.DeadbandValue, before.client_handle, before.queue_size) == (5.0, 3, 2)
    changed = await modify(deadband(2.0), 1000)
    assert changed.StatusCode.name == "Good"
    assert changed.RevisedQueueSize == bounds.LONGEST_ITEM_QUEUE
    assert changed.RevisedSamplingInterval == subscription.RevisedPublishingInterval
    assert (before.filter.DeadbandValue, before.client_handle) == (2.0, 9)
    assert before.queue_size == bounds.LONGEST_ITEM_QUEUE
    await modify(None)
    assert before.filter is None, "a filter that is left out is none"
    await clients.end()


async def test_a_deadband_is_from_the_value_that_was_reported_last(clients: Clients) -> None:
    session = clients.session()
    number = (await clients.subscribe(session)).SubscriptionId
    [created] = await monitor(session, number, item(filter_=deadband(1.0), queue=10))
    for value in (1.6, 2.2, 2.8, 2.9, 1.7, 4.0):
        await clients.put(value)
    assert clients.queued(number, created.MonitoredItemId) == [1.0, 2.2, 4.0]
    await clients.put(4.1, CODES.UncertainLastUsableValue)  # another status is always news
    await clients.put(4.2, CODES.UncertainLastUsableValue)
    await clients.put(None, CODES.BadNoCommunication)
    await clients.put(4.3)
    assert clients.queued(number, created.MonitoredItemId)[3:] == [4.1, None, 4.3]
    await clients.end()


async def test_an_item_that_is_deleted_is_told_nothing_more(clients: Clients) -> None:
    session = clients.session()
    number = (await clients.subscribe(session)).SubscriptionId
    kept, deleted = await monitor(session, number, item(queue=3), item(queue=3))
    await clients.put(2.0)
    assert clients.queued(number, deleted.MonitoredItemId) == [1.0, 2.0]
    await session.delete_monitored_items(ua.DeleteMonitoredItemsParameters(number, [deleted.MonitoredItemId]))
    for value in (3.0, 4.0):
        await clients.put(value)
    assert clients.queued(number, deleted.MonitoredItemId) == []
    assert clients.queued(number, kept.MonitoredItemId) == [2.0, 3.0, 4.0]
    callbacks = clients.space[NUMBER].attributes[ua.AttributeIds.Value].datachange_callbacks
    assert len(callbacks) == 1
    await clients.end()
    assert not callbacks


# writers, and the policies that are offered


async def test_what_clients_write_is_handed_on_one_by_one_and_changes_nothing_here(clients: Clients) -> None:
    written: list[tuple[str, str | None]] = []

    async def write(wanted: ua.WriteValue, user: User) -> int:
        written.append((wanted.NodeId.Identifier, user.name))
        return int(CODES.BadOutOfRange if wanted.NodeId == OTHER else CODES.Good)

    writes = Writes(clients.space, write)
    params = ua.WriteParameters(
        [ua.WriteValue(node, ua.AttributeIds.Value, Value=ua.DataValue(ua.Variant(5.0))) for node in (NUMBER, OTHER)]
    )
    user = User(role=UserRole.User, name="scada")
    assert names(await writes.write(params, user)) == ["Good", "BadOutOfRange"]
    assert written == [("number", "scada"), ("other", "scada")]

    def value() -> Any:
        return clients.space.read_attribute_value(NUMBER, ua.AttributeIds.Value).Value.Value

    assert value() == 1.0
    params.NodesToWrite = params.NodesToWrite[:1]
    assert names(await writes.write(params)) == ["Good"]
    assert (value(), len(written)) == (5.0, 2), "the server itself writes the values"


class Guarded:
    """A server, as far as its rules."""

    def __init__(self, has_key: bool) -> None:
        self.policies: list[Any] = []
        self.tokens: list[Any] = []
        self.remote_admin: list[bool] = []
        space = AddressSpace()
        self.iserver: Any = SimpleNamespace(
            certificate=b"own" if has_key else None, aspace=space, subscription_service=SubscriptionService(space)
        )

    def allow_remote_admin(self, allowed: bool) -> None:
        self.remote_admin.append(allowed)

    def set_security_policy(self, policies: list[Any], _rules: Any) -> None:
        self.policies = policies

    def set_identity_tokens(self, tokens: list[Any]) -> None:
        self.tokens = tokens


@pytest.mark.parametrize("has_key", [False, True])
@pytest.mark.parametrize("secrets", [{}, {"scada": b"digest"}])
async def test_a_server_offers_what_its_rules_and_its_certificate_permit(
    has_key: bool, secrets: dict[str, bytes]
) -> None:
    server: Any = Guarded(has_key)

    async def write(*_: object) -> int:
        return int(CODES.Good)

    guard(server, Rules(secrets=secrets), write, lambda _: None)
    offered = {policy.name for policy in server.policies}
    assert ("NoSecurity" in offered) is not has_key
    assert len(offered) == (6 if has_key else 1)
    assert any(name.endswith("_Sign") for name in offered) is has_key
    anonymous = [ua.AnonymousIdentityToken]
    assert server.tokens == ([*anonymous, ua.UserNameIdentityToken] if secrets else anonymous)
    assert server.remote_admin == [False]
    iserver = server.iserver
    assert (iserver.max_connections, iserver.max_subscriptions) == (bounds.MOST_CONNECTIONS, bounds.MOST_SUBSCRIPTIONS)
    assert iserver.max_monitored_item_queue_size == bounds.LONGEST_ITEM_QUEUE
    assert iserver.max_unacked_messages_per_subscription == bounds.MOST_UNACKNOWLEDGED
    assert iserver.lookup_external_session(ua.NodeId(1001)) is None
    for register in (iserver.register_server, iserver.register_server2):
        assert await code_of(lambda register=register: register(None)) == "BadServiceUnsupported"
    assert bool(iserver.create_session("x").refusal(User(role=UserRole.User))) is bool(secrets)

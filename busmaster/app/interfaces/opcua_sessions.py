"""Sessions and subscriptions of OPC UA clients: the services that the library answers incompletely."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from math import isfinite
from typing import Any

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import User
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession
from asyncua.server.internal_subscription import InternalSubscription
from asyncua.server.monitored_item_service import MonitoredItemService
from asyncua.server.subscription_service import SubscriptionService
from asyncua.ua.uaprotocol_auto import DataChangeFilter, EventFilter  # those of `ua` are subclasses

from busmaster.app.bounds import (
    LONGEST_ITEM_QUEUE,
    LONGEST_PUBLISHING,
    MOST_ITEMS,
    MOST_OPERATIONS,
    MOST_SESSION_ITEMS,
    MOST_SESSION_SUBSCRIPTIONS,
    MOST_UNACKNOWLEDGED,
    SHORTEST_PUBLISHING,
)
from busmaster.app.interfaces.opcua_terms import CODES, NUMBERS

WRITE_BIT = ua.AccessLevel.CurrentWrite.mask
BINARY = (None, "", "Default Binary")
"""Names of the encodings that a client can request."""


def refusal_of_read(wanted: ua.ReadValueId) -> int:
    """Return the status of a read that the library would answer as another one; Good if it is supported."""
    if wanted.IndexRange:
        return int(CODES.BadIndexRangeInvalid)
    if wanted.DataEncoding is not None and wanted.DataEncoding.Name not in BINARY:
        return int(CODES.BadDataEncodingUnsupported)
    return int(CODES.Good)


class Session(InternalSession):  # type: ignore[misc]  # it is untyped
    """A session of a client. It reaches its own subscriptions only, and ends with its connection."""

    refusal: Callable[[User], str]
    """Returns why a user may not write, "" if it may."""

    # The library ignores unsupported parameters, so that the client would misinterpret the reply.

    def activate_session(
        self, params: ua.ActivateSessionParameters, peer_certificate: bytes | None
    ) -> ua.ActivateSessionResult:
        """Log a user in. Raises BadUserAccessDenied, and BadServerTooBusy for a peer that has failed too often."""
        self.iserver.user_manager.peer = str(self.name[0])
        return super().activate_session(params, peer_certificate)

    async def read(self, params: ua.ReadParameters) -> list[ua.DataValue]:
        """Read attributes. Each node whose read is not supported has a Bad status."""
        if not params.MaxAge >= 0:
            raise ServiceError(CODES.BadMaxAgeInvalid)
        _check_count(params.NodesToRead)
        results: list[ua.DataValue] = await super().read(params)
        may_write = not self.refusal(self.user)
        for number, wanted in enumerate(params.NodesToRead):
            if code := refusal_of_read(wanted):
                results[number] = ua.DataValue(StatusCode=ua.StatusCode(code))
            elif wanted.AttributeId == ua.AttributeIds.UserAccessLevel and not may_write:
                access = results[number].Value
                if access is not None and access.Value is not None:
                    results[number] = ua.DataValue(ua.Variant(access.Value & ~WRITE_BIT, ua.VariantType.Byte))
        return results

    async def write(self, params: ua.WriteParameters) -> list[ua.StatusCode]:
        """Write values of points."""
        _check_count(params.NodesToWrite)
        statuses: list[ua.StatusCode] = await super().write(params)
        return statuses

    async def browse(self, params: ua.BrowseParameters) -> list[ua.BrowseResult]:
        """Return the references of nodes."""
        _check_count(params.NodesToBrowse)
        found: list[ua.BrowseResult] = await super().browse(params)
        return found

    async def create_subscription(
        self, params: ua.CreateSubscriptionParameters, callback: Any, request_callback: Any = None
    ) -> ua.CreateSubscriptionResult:
        """Create a subscription. Raises BadTooManySubscriptions beyond the bound of a session, or of the server."""
        subscriptions = self.subscription_service.subscriptions
        if sum(sub.session_id == self.session_id for sub in subscriptions.values()) >= MOST_SESSION_SUBSCRIPTIONS:
            raise ServiceError(CODES.BadTooManySubscriptions)
        interval = float(params.RequestedPublishingInterval) / 1000
        interval = interval if isfinite(interval) else 0.0
        params.RequestedPublishingInterval = 1000 * min(max(interval, SHORTEST_PUBLISHING), LONGEST_PUBLISHING)
        result = await super().create_subscription(params, callback, request_callback=request_callback)
        created = subscriptions[result.SubscriptionId]
        created.monitored_item_srv = MonitoredItems(created, self.aspace, self.subscription_service)
        return result

    def _own(self, number: int) -> InternalSubscription:
        """Return a subscription of this session. Raises BadSubscriptionIdInvalid if it has no such subscription."""
        found = self.subscription_service.subscriptions.get(number)
        if found is None or found.session_id != self.session_id:
            raise ServiceError(CODES.BadSubscriptionIdInvalid)
        return found

    def _owns(self, number: int) -> bool:
        found = self.subscription_service.subscriptions.get(number)
        return found is not None and found.session_id == self.session_id

    # A client that has lost its connection requests the missed messages and its former subscriptions. The library
    # replies Good to both and sends nothing, so the client repeats that for ever and never subscribes again.

    def republish(self, params: ua.RepublishParameters) -> ua.NotificationMessage:
        """Return a message that was sent and not acknowledged. Raises BadMessageNotAvailable for any other."""
        unacknowledged = self._own(params.SubscriptionId)._not_acknowledged_results
        result = unacknowledged.get(params.RetransmitSequenceNumber)
        if result is None:
            raise ServiceError(CODES.BadMessageNotAvailable)
        return result.NotificationMessage

    async def transfer_subscriptions(
        self, params: ua.TransferSubscriptionsParameters, callback: Callable[..., Any]
    ) -> list[ua.TransferResult]:
        """Return BadSubscriptionIdInvalid for all but the session's own: a subscription ends with its connection."""
        results = []
        for number in params.SubscriptionIds:
            result = ua.TransferResult()
            if self._owns(number):
                result.AvailableSequenceNumbers = sorted(self._own(number)._not_acknowledged_results)
            else:
                result.StatusCode = ua.StatusCode(CODES.BadSubscriptionIdInvalid)
            results.append(result)
        return results

    def publish(self, acks: Iterable[ua.SubscriptionAcknowledgement] | None = None) -> tuple[int, list[ua.StatusCode]]:
        """Take acknowledgements; return how many subscriptions the session has, and a status for each of these."""
        count = sum(sub.session_id == self.session_id for sub in self.subscription_service.subscriptions.values())
        if not count:
            raise ServiceError(CODES.BadNoSubscription)
        return count, [ua.StatusCode(self._acknowledge(ack)) for ack in acks or ()]

    def _acknowledge(self, ack: ua.SubscriptionAcknowledgement) -> int:
        if not self._owns(ack.SubscriptionId):
            return int(CODES.BadSubscriptionIdInvalid)
        sent = self._own(ack.SubscriptionId)._not_acknowledged_results.pop(ack.SequenceNumber, None)
        return int(CODES.BadSequenceNumberUnknown if sent is None else CODES.Good)

    # The library lets every session change the subscriptions of every other one.

    async def create_monitored_items(
        self, params: ua.CreateMonitoredItemsParameters
    ) -> list[ua.MonitoredItemCreateResult]:
        """Add items to a subscription of this session."""
        self._own(params.SubscriptionId)
        _check_count(params.ItemsToCreate)
        created: list[ua.MonitoredItemCreateResult] = await super().create_monitored_items(params)
        return created

    async def modify_monitored_items(
        self, params: ua.ModifyMonitoredItemsParameters
    ) -> list[ua.MonitoredItemModifyResult]:
        """Change items of a subscription of this session."""
        self._own(params.SubscriptionId)
        modified: list[ua.MonitoredItemModifyResult] = await super().modify_monitored_items(params)
        return modified

    async def delete_monitored_items(self, params: ua.DeleteMonitoredItemsParameters) -> list[ua.StatusCode]:
        """Remove items from a subscription of this session."""
        self._own(params.SubscriptionId)
        deleted: list[ua.StatusCode] = await super().delete_monitored_items(params)
        return deleted

    async def set_monitoring_mode(self, params: ua.SetMonitoringModeParameters) -> list[ua.StatusCode]:
        """Enable or disable items of a subscription of this session."""
        self._own(params.SubscriptionId)
        changed: list[ua.StatusCode] = await super().set_monitoring_mode(params)
        return changed

    def modify_subscription(self, params: ua.ModifySubscriptionParameters) -> ua.ModifySubscriptionResult:
        """Return the settings of a subscription of this session, which stay as they are."""
        self._own(params.SubscriptionId)
        return super().modify_subscription(params)

    async def set_publishing_mode(self, params: ua.SetPublishingModeParameters) -> list[ua.StatusCode]:
        """Start or stop the publishing of some subscriptions of this session."""
        service = self.subscription_service
        results = []
        for number in params.SubscriptionIds:
            own = ua.SetPublishingModeParameters(params.PublishingEnabled, [number if self._owns(number) else 0])
            results += await service.set_publishing_mode(own)
        return results

    async def delete_subscriptions(self, ids: list[int]) -> list[ua.StatusCode]:
        """Delete some subscriptions of this session."""
        deleted: list[ua.StatusCode] = await self.subscription_service.delete_subscriptions(
            [number if self._owns(number) else 0 for number in ids]  # 0 is the number of none
        )
        return deleted


def _check_count(operations: Iterable[Any] | None) -> None:
    """Raise BadTooManyOperations for a request above the server's limit."""
    if operations is not None and len(list(operations)) > MOST_OPERATIONS:
        raise ServiceError(CODES.BadTooManyOperations)


class MonitoredItems(MonitoredItemService):  # type: ignore[misc]  # it is untyped
    """The monitored items of one subscription."""

    def __init__(self, subscription: InternalSubscription, aspace: Any, service: SubscriptionService) -> None:
        super().__init__(subscription, aspace)
        self._service = service

    async def create_monitored_items(
        self, params: ua.CreateMonitoredItemsParameters
    ) -> list[ua.MonitoredItemCreateResult]:
        """Add items. One that is not supported or beyond a bound has a Bad status, and the others are added."""
        results = []
        for item in params.ItemsToCreate:
            wanted = item.ItemToMonitor
            code = self._refusal() or refusal_of_read(wanted)
            code = code or self._refusal_of_filter(wanted, item.RequestedParameters.Filter)
            if code:
                results.append(ua.MonitoredItemCreateResult(StatusCode=ua.StatusCode(code)))
            else:
                one = ua.CreateMonitoredItemsParameters(ItemsToCreate=[item])
                results += await super().create_monitored_items(one)
        return results

    def _refusal(self) -> int:
        """Return the status of one more item: Good while there are fewer than the bounds."""
        counts: dict[Any, int] = {}
        for subscription in self._service.subscriptions.values():
            count = len(subscription.monitored_item_srv._monitored_items)
            counts[subscription.session_id] = counts.get(subscription.session_id, 0) + count
        full = counts.get(self.isub.session_id, 0) >= MOST_SESSION_ITEMS or sum(counts.values()) >= MOST_ITEMS
        return int(CODES.BadTooManyMonitoredItems if full else CODES.Good)

    def _refusal_of_filter(self, wanted: ua.ReadValueId, filter_: Any) -> int:
        """Return the status of a filter: Good for none, and for one that the server applies as it is meant."""
        if wanted.AttributeId == ua.AttributeIds.EventNotifier:
            return int(CODES.Good if isinstance(filter_, EventFilter) else CODES.BadEventFilterInvalid)
        if not filter_:  # absent, or an extension object without a body
            return int(CODES.Good)
        if not isinstance(filter_, DataChangeFilter):
            return int(CODES.BadMonitoredItemFilterUnsupported)
        if filter_.DeadbandType == ua.DeadbandType.None_:
            return int(CODES.Good)
        if filter_.DeadbandType == ua.DeadbandType.Percent:
            return int(CODES.BadMonitoredItemFilterUnsupported)
        deadband = filter_.DeadbandValue
        if filter_.DeadbandType != ua.DeadbandType.Absolute or not isfinite(deadband) or deadband < 0:
            return int(CODES.BadDeadbandFilterInvalid)
        value = self.aspace.read_attribute_value(wanted.NodeId, ua.AttributeIds.DataType).Value
        kinds = {ua.NodeId(kind.value) for kind in NUMBERS} | {ua.NodeId(ua.ObjectIds.BaseDataType)}
        is_number = wanted.AttributeId == ua.AttributeIds.Value and value is not None and value.Value in kinds
        return int(CODES.Good if is_number else CODES.BadFilterNotAllowed)

    def _modify_monitored_item(self, params: ua.MonitoredItemModifyRequest) -> ua.MonitoredItemModifyResult:
        item = self._monitored_items.get(params.MonitoredItemId)
        if item is None:
            return ua.MonitoredItemModifyResult(StatusCode=ua.StatusCode(CODES.BadMonitoredItemIdInvalid))
        asked = params.RequestedParameters
        if code := self._refusal_of_filter(item.read_value_id, asked.Filter):
            return ua.MonitoredItemModifyResult(StatusCode=ua.StatusCode(code))
        item.filter, item.client_handle = asked.Filter, asked.ClientHandle
        item.queue_size = self._revise_queue_size(asked.QueueSize)
        result = ua.MonitoredItemModifyResult()
        result.RevisedSamplingInterval = self.isub.data.RevisedPublishingInterval
        result.RevisedQueueSize = item.queue_size
        return result

    def _delete_monitored_items(self, mid: int) -> ua.StatusCode:
        # The library looks through all items for each: 2,000 of a client that is gone took seconds.
        item = self._monitored_items.get(mid)
        if item is None or item.callback_handle is None:
            return super()._delete_monitored_items(mid)
        self.aspace.delete_datachange_callback(item.callback_handle)
        del self._monitored_items[mid], self._monitored_datachange[item.callback_handle]
        self.isub._triggered_datachanges.pop(mid, None)
        return ua.StatusCode()

    def _is_deadband_exceeded(self, values: Any, filter_: ua.DataChangeFilter) -> bool:
        """Return whether a value is to be reported. One without a number, or after one without, always is."""
        old, new = values.get_old_datavalue(), values.get_current_datavalue()
        if old is None or not (_is_number(old) and _is_number(new)) or old.StatusCode != new.StatusCode:
            return True
        return bool(super()._is_deadband_exceeded(values, filter_))

    async def datachange_callback(self, handle: int, value: ua.DataValue, error: ua.StatusCode | None = None) -> None:
        """Queue a value for the client if it is news."""
        item = self._monitored_items[self._monitored_datachange[handle]]
        before = item.mvalue.current_dvalue
        queued = self.isub._triggered_datachanges.get(item.monitored_item_id, [])
        last = queued[-1] if queued else None
        await super().datachange_callback(handle, value, error)
        queued = self.isub._triggered_datachanges.get(item.monitored_item_id, [])
        if before is not None and item.mvalue.current_dvalue is not before and (queued[-1] if queued else None) is last:
            # The deadband is from the value that was reported last, or a slow drift would never be reported.
            item.mvalue.current_dvalue = before


def _is_number(value: ua.DataValue) -> bool:
    return value.Value is not None and type(value.Value.Value) in (int, float)


def use_sessions(iserver: InternalServer, refusal: Callable[[User], str]) -> None:
    """Have clients of a server get a `Session` each. `refusal` returns why a user may not write, "" if it may."""
    service = iserver.subscription_service
    iserver.max_monitored_item_queue_size = LONGEST_ITEM_QUEUE
    iserver.max_unacked_messages_per_subscription = MOST_UNACKNOWLEDGED

    def create_session(name: str, user: Any = None, external: bool = False) -> Session:
        session = Session(iserver, iserver.aspace, service, name, external=external)
        session.refusal = refusal
        return session

    iserver.create_session = create_session

"""Sessions and subscriptions of OPC UA clients: the services that the library answers incompletely."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession
from asyncua.server.internal_subscription import InternalSubscription
from asyncua.server.subscription_service import SubscriptionService

from busmaster.doors.opcua_terms import CODES


class Session(InternalSession):  # type: ignore[misc]  # it is untyped
    """A session of a client. It reaches its own subscriptions only, and ends with its connection."""

    def _own(self, number: int) -> InternalSubscription:
        """Return a subscription of this session. Raises BadSubscriptionIdInvalid if it has no such subscription."""
        found = self.subscription_service.subscriptions.get(number)
        if found is None or found.session_id != self.session_id:
            raise ServiceError(CODES.BadSubscriptionIdInvalid)
        return found

    def _owns(self, number: int) -> bool:
        found = self.subscription_service.subscriptions.get(number)
        return found is not None and found.session_id == self.session_id

    # A client that has lost its connection asks for the messages that it missed, and for its former subscriptions.
    # The library answers Good to both and sends nothing, so the client asks again for ever and never subscribes anew.

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


class Subscriptions(SubscriptionService):  # type: ignore[misc]  # it is untyped
    """The subscriptions of all sessions."""


def use_sessions(iserver: InternalServer) -> None:
    """Have clients of a server get a `Session` each."""
    service = Subscriptions(iserver.aspace, iserver=iserver)
    iserver.subscription_service = iserver.isession.subscription_service = service

    def create_session(name: str, user: Any = None, external: bool = False) -> Session:
        return Session(iserver, iserver.aspace, service, name, external=external)

    iserver.create_session = create_session

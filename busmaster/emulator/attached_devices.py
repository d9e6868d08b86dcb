"""Distributes the bytes on the line to the devices, and collects their replies.

Every device receives every byte. An undisturbed frame of the host is passed in one piece to the device with a matching
route; the other devices receive it only if they are attentive. Incomplete, corrupted or joined frames are passed to all
devices byte by byte. If they contain no byte with which a route begins, they cannot change the state of an idle device,
and are passed to attentive devices only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from busmaster.emulator.chance import Chance
from busmaster.emulator.collision import Collision
from busmaster.emulator.device import NEVER, Device
from busmaster.emulator.disturbance import misses

Send = Callable[[Device, float, bytes], None]
"""A device will transmit: the start time and the bytes."""
TakeBack = Callable[[Device, float], None]
"""A device has restarted at this time: its pending transmissions are discarded."""


class AttachedDevices:
    """The devices of a line. `send` is called with their replies, `take_back` after a restart."""

    def __init__(self, send: Send, take_back: TakeBack, chance: Chance, tau: float) -> None:
        self.devices: list[Device] = []
        self.wakeup = NEVER
        """Earliest time at which a device must be woken."""
        self.cut_off: frozenset[Device] = frozenset()
        self._send = send
        self._take_back = take_back
        self._chance = chance
        self._tau = tau
        self._routes: dict[bytes, tuple[Device, ...]] = {}
        self._route_sizes: tuple[int, ...] = ()
        self._openers: frozenset[int] = frozenset()
        self._attentive: dict[Device, None] = {}

    def add(self, device: Device) -> None:
        """Attach a device, which then uses the line's time and random source."""
        device.tau = self._tau
        device.chance = self._chance
        self.devices.append(device)
        self._learn_routes()
        self._note(device, 0.0)

    def remove(self, device: Device) -> None:
        """Detach a device. Raises ValueError if it is not attached."""
        self.devices.remove(device)
        self._attentive.pop(device, None)
        self._learn_routes()

    def request(self, frame: bytes, start: float, end: float) -> None:
        """Process an undisturbed frame of the host, on the line from `start` to `end`."""
        for size in self._route_sizes:
            routed = self._routes.get(frame[:size])
            if routed is not None:
                break
        else:
            self.overhear(frame, start, end, None, whole=False)
            return
        left: list[Device] = []
        # Also while the device is attentive, as a Mentor II drive is after a read: byte by byte to all would be slow.
        for device in routed:
            if device in self.cut_off or (self._faulty(device) and misses(device, start, end, True, self._chance)):
                self._note(device, end)
            elif not device.take(frame, end):
                left.append(device)
            else:
                self._note(device, end)
        if left:
            left += [device for device in self.devices if device not in routed]
            self.hear(left, frame, start, end)
        elif self._attentive:
            self.hear([device for device in self._attentive if device not in routed], frame, start, end)

    def overhear(self, data: bytes, start: float, end: float, talker: Device | None, whole: bool) -> None:
        """Process bytes that are not a request in one piece.

        With `whole` they are a reply in one piece, which does not begin with a route.
        """
        if whole or self._openers.isdisjoint(data):
            if not self._attentive:
                return
            listeners: Iterable[Device] = tuple(self._attentive)
        else:
            listeners = self.devices
        self.hear([device for device in listeners if device is not talker], data, start, end)

    def scatter(self, collision: Collision, end: float) -> None:
        """Pass the result of a collision to each device, except for its own transmission time."""
        for device in self.devices:
            for start, byte in collision.heard(device):
                self.hear((device,), bytes((byte,)), start, end)

    def wake(self) -> None:
        """Wake the devices whose wake-up time has been reached."""
        now = self.wakeup
        self.wakeup = NEVER
        for device in self.devices:
            if device.wakeup <= now:
                device.wake(now)
                self._note(device, now)
            elif device.wakeup < self.wakeup:
                self.wakeup = device.wakeup

    def restart(self, device: Device, now: float) -> None:
        """Restart a device at `now`."""
        device.restart(now)
        self._note(device, now)

    def hear(self, listeners: Iterable[Device], data: bytes, start: float, now: float) -> None:
        """Pass `data` to `listeners` byte by byte; its last byte ended at `now`."""
        for device in listeners:
            if device in self.cut_off:
                continue
            if not self._faulty(device) or not misses(device, start, now, False, self._chance):
                device.hear(data, start)
            self._note(device, now)

    @staticmethod
    def _faulty(device: Device) -> bool:
        return bool(device.faults.hearing) or device.away_until > 0.0

    def _note(self, device: Device, now: float) -> None:
        """Collect its replies, whether it must receive every byte from now on, and the time at which to wake it."""
        if device.restarted:
            device.restarted = False
            self._take_back(device, now)
        if device.outbox:
            replies = device.outbox
            device.outbox = []
            if now >= device.away_until and not device.faults.dead:
                for start, data in replies:
                    self._send(device, start if start > now else now, data)
        device.lag = 0.0
        if device.attentive:
            self._attentive[device] = None
        elif self._attentive:
            self._attentive.pop(device, None)
        if device.wakeup < self.wakeup:
            self.wakeup = device.wakeup

    def _learn_routes(self) -> None:
        routes: dict[bytes, tuple[Device, ...]] = {}
        for device in self.devices:
            for route in device.routes:
                routes[route] = (*routes.get(route, ()), device)
        self._routes = routes
        self._route_sizes = tuple(sorted({len(route) for route in routes}, reverse=True))
        self._openers = frozenset(route[0] for route in routes)
